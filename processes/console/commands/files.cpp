#include "processes/console/commands/files.h"

#include <fmt/format.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cmath>
#include <cstring>
#include <iostream>
#include <map>
#include <stdexcept>

#include "common/bus/convert.h"
#include "common/bus/event_log.h"
#include "common/geometry/angle.h"
#include "processes/structure_learner/noise_estimate.h"

namespace bodyschema {

Recording load_and_warn(const std::string& file) {
  Recording recording = load_recording(file);
  if (!recording.damage.empty()) std::cerr << "bodyschema: " << recording.damage << std::endl;
  for (const std::string& hint : recording.hints)
    std::cerr << "bodyschema: " << file << ": " << hint << std::endl;
  return recording;
}

BodySchema load_schema(const std::filesystem::path& file) {
  LogReport report;
  const std::vector<body_schema_t> schemas = read_log(file, kBodySchema, &report);
  if (schemas.empty())
    throw std::runtime_error(
        file.string() + ": expected a schema, found no BODY_SCHEMA" +
        (report.truncated_at_byte
             ? fmt::format("; it ends within the event at byte {}: copy it again",
                           *report.truncated_at_byte)
             : ""));
  return from_message(schemas.back());
}

std::string delay_text(const CommandDelay& delay) {
  const auto seconds = [](std::int64_t us) { return static_cast<double>(std::abs(us)) * 1e-6; };
  std::string text = fmt::format("the poses come {:.3f} s {} their commands", seconds(delay.lag_us),
                                 delay.lag_us < 0 ? "before" : "after");
  if (delay.smear_us != 0)
    text +=
        fmt::format(", drives follow with a time constant of {:.3f} s", seconds(delay.smear_us));
  return text + ": each counts with the command that brought it there";
}

Recording load_for(const std::string& file, const BodySchema& schema) {
  Recording recording = load_and_warn(file);
  try {
    recording.samples = samples_by_signals(recording, schema.signals);
  } catch (const std::invalid_argument& error) {
    throw RecordingError(file + ": " + error.what());
  }
  recording.signals = schema.signals;
  if (const CommandDelay delay = command_delay(recording.samples, schema);
      delay != CommandDelay{}) {
    recording.samples = with_commands_of_before(recording.samples, delay);
    std::cerr << "bodyschema: " << file << ": " << delay_text(delay) << "\n";
  }
  return recording;
}

void forget_changes_of_another(const Recording& recording, BodySchema* schema) {
  const bool is_of_it = std::ranges::any_of(recording.samples, [&](const auto& sample) {
    return sample.sample_index == schema->last_sample_index && sample.utime == schema->utime;
  });
  if (!is_of_it) forget_when_it_changed(schema);
}

void add_noise(Arguments& command, std::vector<double>& numbers, const std::string& more) {
  command
      .add_option("--noise", numbers,
                  "Standard deviation per axis and marker: position [m], rotation [deg]" + more)
      .expected(2)
      .type_name("POS_M ROT_DEG");
}

Noise noise_given(const std::vector<double>& numbers) {
  const auto refuse = [](const std::string& why) { refuse_argument("--noise", why); };
  for (const double number : numbers)
    if (!std::isfinite(number) || number <= 0) refuse("expected two standard deviations above 0");
  const Noise noise{numbers[0], numbers[1] * kDegree};
  if (noise.position_m > 1000 * kNoiseCeiling.position_m)
    refuse(fmt::format("{} m is no noise of a marker; at most {} m are", numbers[0],
                       kNoiseCeiling.position_m));
  if (noise.position_m > kNoiseCeiling.position_m)
    refuse(fmt::format("{} m is no noise of a marker; did you mean: --noise {} {}", numbers[0],
                       numbers[0] / 1000, numbers[1]));
  if (noise.rotation_rad > kNoiseCeiling.rotation_rad)
    refuse(fmt::format("{} degrees are no noise of a marker; at most {:.0f} are", numbers[1],
                       kNoiseCeiling.rotation_rad / kDegree));
  if (looks_like_radians(noise))
    std::cerr << fmt::format("bodyschema: --noise {} {} looks like radians; expected degrees\n",
                             numbers[0], numbers[1]);
  return noise;
}

Eigen::Quaterniond unit_quaternion(const std::string& option, const std::vector<double>& wxyz) {
  const Eigen::Quaterniond q(wxyz[0], wxyz[1], wxyz[2], wxyz[3]);
  if (!(std::abs(q.norm() - 1) <= 0.01))
    refuse_argument(option, "expected a unit quaternion W X Y Z, such as 1 0 0 0");
  return q.normalized();
}

void check_out(const std::string& out, const std::vector<std::string>& inputs,
               const std::string& option) {
  std::error_code is_new;
  for (const std::string& input : inputs)
    if (!out.empty() && std::filesystem::equivalent(out, input, is_new) && !is_new)
      throw std::invalid_argument(option + ": " + out + " is an input itself: " + input);
  if (out.empty()) return;
  if (std::filesystem::exists(out, is_new) && !std::filesystem::is_regular_file(out, is_new))
    throw std::invalid_argument(option + ": " + out + " is no regular file");
  const std::filesystem::path folder = std::filesystem::absolute(out).parent_path();
  if (::access(folder.c_str(), W_OK | X_OK) != 0)
    throw std::invalid_argument(option + ": cannot write " + out + ": " + std::strerror(errno));
}

void check_outs(const std::vector<OutFile>& outs, const std::vector<std::string>& inputs) {
  std::map<std::filesystem::path, std::string> options;
  for (const auto& [option, file] : outs) {
    check_out(file, inputs, option);
    if (file.empty()) continue;
    const auto place = std::filesystem::weakly_canonical(std::filesystem::absolute(file));
    const auto [other, is_first] = options.try_emplace(place, option);
    if (!is_first)
      throw std::invalid_argument(option + ": expected another file than " + other->second);
  }
}

void print(bool as_json, const Json& json, const std::string& text) {
  std::cout << (as_json ? json.dump(2) + "\n" : text) << std::flush;
}

}  // namespace bodyschema
