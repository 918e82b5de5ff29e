#include <fmt/format.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <cmath>
#include <cstring>
#include <filesystem>
#include <iostream>
#include <memory>
#include <stdexcept>

#include "common/bus/convert.h"
#include "common/bus/event_log.h"
#include "common/bus/rig_door.h"
#include "common/config/rig.h"
#include "common/geometry/angle.h"
#include "processes/console/commands/commands.h"
#include "processes/console/commands/files.h"
#include "processes/console/evaluation.h"
#include "processes/console/recording.h"
#include "processes/console/rig_check.h"
#include "processes/console/views/structure_view.h"
#include "processes/structure_learner/baseline/learn_baseline.h"
#include "processes/structure_learner/learn.h"

namespace bodyschema {
namespace {

Recording load(const std::string& file) {
  Recording recording = load_recording(file);
  if (!recording.damage.empty()) std::cerr << "bodyschema: " << recording.damage << std::endl;
  for (const std::string& hint : recording.hints)
    std::cerr << "bodyschema: " << file << ": " << hint << std::endl;
  return recording;
}

struct LearnArguments {
  std::string samples;
  std::string out;
  std::optional<int> root;
  std::vector<double> noise;
  std::string method = "screw";
  bool json = false;
};

/// The chapter's own method: a result to compare with.
LearnResult learn_as_the_chapter(const Recording& recording,
                                 const std::vector<ActionPoseSample>& training,
                                 const LearnOptions& options) {
  BaselineOptions baseline;
  baseline.root = options.root;
  SourcedNoise noise = marker_noise(training, static_cast<int>(recording.signals.size()), options);
  noise.position_m = std::hypot(noise.position_m, options.measurement.systematic.position_m);
  noise.rotation_rad = std::hypot(noise.rotation_rad, options.measurement.systematic.rotation_rad);
  baseline.set_noise(noise);
  baseline.max_samples = std::min(baseline.max_samples, ResidualGp::kMaxSamples);  // to be written
  const BaselineResult result = learn_baseline(recording.signals, training, baseline);
  std::cerr << result.num_fits << " local models learned, " << result.num_valid << " valid, "
            << result.seconds << " s" << std::endl;
  LearnResult learned;
  learned.schema = result.schema;
  learned.noise_source = noise.source;
  return learned;
}

void run_learn(const LearnArguments& arguments) {
  std::optional<Noise> noise;
  if (!arguments.noise.empty()) noise = noise_given(arguments.noise);
  const Recording recording = load(arguments.samples);
  LearnOptions options;
  options.root = arguments.root;
  options.measurement = recording.measurement;
  options.measurement.noise = noise;
  check_out(arguments.out, {arguments.samples});
  const std::vector<ActionPoseSample> training = recording.training();
  if (options.root) {
    bool is_seen = false;
    for (const ActionPoseSample& sample : training)
      is_seen |= sample.find(*options.root) != nullptr;
    if (!is_seen) {
      throw std::invalid_argument("--root: part " + std::to_string(*options.root) +
                                  " is never seen in " + arguments.samples);
    }
  }
  LearnResult result;
  if (arguments.method == "chapter") {
    result = learn_as_the_chapter(recording, training, options);
  } else {
    result = learn(recording.signals, training, options);
  }
  if (!arguments.out.empty()) {
    BodySchema schema = result.schema;
    schema.version = schema.last_sample_index + 1;
    write_one_event_log(arguments.out, kBodySchema, to_message(schema));
  }
  if (arguments.json) {
    std::cout << structure_json(result.schema, result.outliers, result.noise_source).dump(2)
              << std::endl;
  } else {
    std::cout << structure_text(result.schema, result.noise_source) << std::flush;
  }
}

void run_predict(const std::string& schema_file, const std::string& samples_file, bool json) {
  const BodySchema schema = load_schema(schema_file);
  const Recording recording = load_for(samples_file, schema);
  const auto errors = evaluate(schema, recording.samples);
  if (json) {
    std::cout << errors_json(static_cast<int>(recording.samples.size()), errors).dump(2)
              << std::endl;
  } else {
    std::cout << errors_text(errors) << std::flush;
  }
}

void run_show(const std::string& schema_file, bool json) {
  const BodySchema schema = load_schema(schema_file);
  if (json) {
    std::cout << schema_json(schema).dump(2) << std::endl;
  } else {
    std::cout << structure_text(schema) << std::flush;
  }
}

struct RigArguments {
  std::string rig;
  std::optional<int> hidden_part;
  std::vector<std::string> group;
  std::string host;
  std::string initial;
};

/// This machine's name if the rig has a host of that name. Where the group is not split: "all".
std::string own_host(const Network& network) {
  std::array<char, 256> name{};
  if (network.hosts.empty() || ::gethostname(name.data(), name.size() - 1) != 0) return "all";
  return name.data();
}

/// Checks a rig and prints where its group would run: the line that ./run's launch reads.
void run_rig(const RigArguments& arguments) {
  const std::filesystem::path folder = find_rig(arguments.rig);
  const RigCheck check = check_rig(folder);
  for (const std::string& remark : check.remarks) std::cerr << "bodyschema: " << remark << "\n";
  if (!check.problems.empty()) {
    throw std::runtime_error(fmt::format("{}", fmt::join(check.problems, "\n")));
  }
  const std::vector<int> parts = load_markers(folder).parts();
  if (arguments.hidden_part &&
      !std::binary_search(parts.begin(), parts.end(), *arguments.hidden_part)) {
    throw std::invalid_argument("--hide: " + folder.string() + " has no part " +
                                std::to_string(*arguments.hidden_part));
  }
  if (!arguments.initial.empty()) RigDoor(folder).load_initial_schema(arguments.initial);
  const Network network = load_network(folder, arguments.group);
  const std::string host = arguments.host.empty() ? own_host(network) : arguments.host;
  std::cout << (network.is_private ? "private " : "host ") << network.bus_url() << ' '
            << network.images_url() << ' ' << host;
  for (const std::string& process : host == "all" ? arguments.group : network.share_of(host))
    std::cout << ' ' << process;
  std::cout << fmt::format("\nOK: {} parts, {} signals, {} tags\n", check.num_parts,
                           check.num_signals, check.num_tags)
            << std::flush;
}

}  // namespace

BodySchema load_schema(const std::filesystem::path& file) {
  const std::vector<body_schema_t> schemas = read_log(file, kBodySchema);
  if (schemas.empty())
    throw std::runtime_error(file.string() + ": expected a schema, found no BODY_SCHEMA");
  return from_message(schemas.back());
}

Recording load_for(const std::string& file, const BodySchema& schema) {
  Recording recording = load(file);
  try {
    recording.samples = samples_by_signals(recording, schema.signals);
  } catch (const std::invalid_argument& error) {
    throw RecordingError(file + ": " + error.what());
  }
  recording.signals = schema.signals;
  return recording;
}

Noise noise_given(const std::vector<double>& numbers) {
  const auto refuse = [](const std::string& why) { refuse_argument("--noise", why); };
  for (const double number : numbers)
    if (!std::isfinite(number) || number <= 0) refuse("expected two standard deviations above 0");
  const Noise noise{numbers[0], numbers[1] * kDegree};
  if (noise.position_m > kNoiseCeiling.position_m) {
    refuse(fmt::format("{} m is no noise of a marker; did you mean: --noise {} {}", numbers[0],
                       numbers[0] / 1000, numbers[1]));
  }
  if (noise.rotation_rad > kNoiseCeiling.rotation_rad) {
    refuse(fmt::format("{} degrees are no noise of a marker; at most {:.0f} are", numbers[1],
                       kNoiseCeiling.rotation_rad / kDegree));
  }
  if (looks_like_radians(noise))
    std::cerr << fmt::format("bodyschema: --noise {} {} looks like radians; expected degrees\n",
                             numbers[0], numbers[1]);
  return noise;
}

void check_out(const std::string& out, const std::vector<std::string>& inputs) {
  std::error_code is_new;
  for (const std::string& input : inputs)
    if (!out.empty() && std::filesystem::equivalent(out, input, is_new) && !is_new)
      throw std::invalid_argument("--out: " + out + " is an input itself: " + input);
  if (out.empty()) return;
  const std::filesystem::path folder = std::filesystem::absolute(out).parent_path();
  if (::access(folder.c_str(), W_OK | X_OK) != 0)
    throw std::invalid_argument("--out: cannot write " + out + ": " + std::strerror(errno));
}

void add_offline_commands(Arguments console) {
  const auto learning = std::make_shared<LearnArguments>();
  Arguments learn =
      console.add_subcommand("learn", "Learn a body schema from a recording (LCM log or CSV)");
  learn.add_option("SAMPLES", learning->samples, "Recording; - reads stdin").required();
  learn.add_option("--out", learning->out, "Write the schema to this file");
  learn.add_option("--root", learning->root, "Root part; the lowest id if not given");
  learn
      .add_option("--noise", learning->noise,
                  "Standard deviation per axis and marker: position [m], rotation [deg]; "
                  "estimated if neither this nor the recording says it")
      .expected(2)
      .type_name("POS_M ROT_DEG");
  learn
      .add_option("--method", learning->method,
                  "screw, or chapter: matrix GPs, and thresholds on mean errors at three times the "
                  "noise, for comparison")
      .one_of({"screw", "chapter"});
  learn.add_flag("--json", learning->json, "Print JSON");
  learn.callback([learning] { run_learn(*learning); });

  struct Files {
    std::string schema, samples;
    bool json = false;
  };
  const auto predicting = std::make_shared<Files>();
  Arguments predict =
      console.add_subcommand("predict", "Compare a schema's predictions with a recording");
  predict.add_option("SCHEMA", predicting->schema, "Schema file").required();
  predict.add_option("SAMPLES", predicting->samples, "Recording").required();
  predict.add_flag("--json", predicting->json, "Print JSON");
  predict.callback(
      [predicting] { run_predict(predicting->schema, predicting->samples, predicting->json); });

  const auto showing = std::make_shared<Files>();
  Arguments show = console.add_subcommand("show", "Print a schema file");
  show.add_option("SCHEMA", showing->schema, "Schema file").required();
  show.add_flag("--json", showing->json, "Print JSON");
  show.callback([showing] { run_show(showing->schema, showing->json); });

  const auto checking = std::make_shared<RigArguments>();
  Arguments rig = console.add_subcommand(
      "rig",
      "Check every file of a rig by its process's own reader, and against the others; print its "
      "network (kind, bus, images, this host, its processes) and what it has");
  rig.add_option("RIG", checking->rig, "Folder, or name of one in config/").required();
  rig.add_option("--hide", checking->hidden_part, "A part that is to be hidden: is there one?");
  rig.add_option("--group", checking->group, "All processes; each must run on exactly one host");
  rig.add_option("--host", checking->host, "Host of network.yaml; this machine if not given");
  rig.add_option("--initial", checking->initial, "A schema to begin with: is it of this rig?");
  rig.callback([checking] { run_rig(*checking); });
}

}  // namespace bodyschema
