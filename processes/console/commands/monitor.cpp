#include <fmt/format.h>

#include <algorithm>
#include <iostream>
#include <optional>
#include <stdexcept>
#include <string>
#include <variant>
#include <vector>

#include "common/bus/convert.h"
#include "common/bus/event_log.h"
#include "common/estimation/evaluation.h"
#include "processes/console/commands/commands.h"
#include "processes/console/commands/files.h"
#include "processes/console/hint.h"
#include "processes/console/views/health_view.h"
#include "processes/console/views/structure_view.h"
#include "processes/model_monitor/baseline/chapter_adaptation.h"
#include "processes/model_monitor/health/health_words.h"
#include "processes/model_monitor/live_schema.h"
#include "processes/structure_learner/baseline/fit_matrix_gp.h"
#include "processes/structure_learner/baseline/learn_baseline.h"
#include "processes/structure_learner/learn.h"
#include "processes/structure_learner/pair_data.h"
#include "processes/structure_learner/recording/recording.h"

namespace bodyschema {
namespace {

struct MonitorArguments {
  std::string schema;
  std::string samples;
  std::string out;
  std::string evaluate;
  std::vector<double> noise;
  std::string method = "evidence";
  bool json = false;
};

double seconds(const ActionPoseSample& sample) { return 1e-6 * static_cast<double>(sample.utime); }

/// event_json() with the time, without what is not told.
Json event_line(const AdaptationEvent& event, const ActionPoseSample& sample,
                const BodySchema& schema) {
  Json told = event_json(to_message(event, schema.signals, sample.utime), signal_names(schema));
  std::vector<std::string> untold = {"number"};
  if (event.part >= 0) {
    untold.insert(untold.end(), {"from", "to"});
    if (event.tag < 0) untold.push_back("tag");
  } else {
    untold.insert(untold.end(), {"part", "tag"});
  }
  if (event.cause.empty()) untold.push_back("cause");
  for (const std::string& key : untold) told.erase(key);
  Json line = {{"sample", event.sample_index}, {"t", seconds(sample)}};
  line.update(told);
  if (event.probe.size() > 0)
    line["action"] = std::vector<double>(event.probe.begin(), event.probe.end());
  return line;
}

AdaptationOptions options_of(const MonitorArguments& arguments, const Recording& recording,
                             const BodySchema& schema) {
  AdaptationOptions options;
  options.measurement = recording.measurement;
  if (recording.is_log) options.least_noise_scale = 1;  // as model_monitor has it
  if (!arguments.noise.empty()) {
    options.measurement.noise = noise_given(arguments.noise);
  } else if (!recording.has_noise) {
    if (!(schema.noise.position_m > 0 && schema.noise.rotation_rad > 0))
      throw std::invalid_argument(arguments.samples + " and " + arguments.schema +
                                  " do not say how noisy the markers are: give --noise");
    options.measurement.noise = schema.noise;
  }
  return options;
}

void tell_noise(const MonitorArguments& arguments, const std::optional<Noise>& noise) {
  if (!noise)
    std::cerr << "noise: the covariances of " << arguments.samples << "\n";
  else
    std::cerr << fmt::format("noise per axis and marker: {}, {}\n",
                             pose_text(noise->position_m, noise->rotation_rad),
                             arguments.noise.empty() ? "that of " + arguments.schema : "given");
}

/// A procedure that keeps the schema true.
using Method = std::variant<LiveSchema, ChapterAdaptation>;

Method method_of(const std::string& name, const AdaptationOptions& options,
                 const BodySchema& schema) {
  if (name == "evidence") return LiveSchema(schema, options, {}, {});
  ChapterAdaptationOptions chapter;
  if (options.measurement.noise) {
    BaselineOptions baseline;
    baseline.set_noise(*options.measurement.noise);
    chapter.sigma_position_m = baseline.sigma_position_m;
    chapter.sigma_rotation_rad = baseline.sigma_rotation_rad;
  }
  return ChapterAdaptation(schema, chapter, fit_matrix_gp_edge);
}

/// Whether any of the parts of the schema is seen.
bool shows_any_part(const std::vector<ActionPoseSample>& samples, const BodySchema& schema) {
  return std::ranges::any_of(samples, [&](const ActionPoseSample& sample) {
    return std::ranges::any_of(sample.parts,
                               [&](const auto& seen) { return schema.has_part(seen.part); });
  });
}

void run_monitor(const MonitorArguments& arguments) {
  BodySchema schema = load_schema(arguments.schema);
  const Recording recording = load_for(arguments.samples, schema);
  forget_changes_of_another(recording, &schema);
  std::optional<Recording> evaluation;
  if (!arguments.evaluate.empty()) evaluation = load_for(arguments.evaluate, schema);
  if (schema.edges.empty())
    throw std::invalid_argument(arguments.schema + ": expected a schema with edges, found none");
  if (!shows_any_part(recording.samples, schema))
    throw std::invalid_argument(arguments.samples + ": none of the parts of " + arguments.schema +
                                " is seen in it; is it of another body?");
  check_out(arguments.out, {arguments.samples, arguments.schema, arguments.evaluate});

  if (arguments.method == "chapter" && !parts_without_rotation(recording.samples).empty())
    throw std::invalid_argument("--method chapter needs orientations: " + arguments.samples +
                                " has positions alone");

  const AdaptationOptions options = options_of(arguments, recording, schema);
  Method method = method_of(arguments.method, options, schema);
  const auto adapted = [&]() -> const BodySchema& {
    return std::visit([](const auto& by) -> const BodySchema& { return by.schema(); }, method);
  };
  tell_noise(arguments, options.measurement.noise);
  int num_events = 0;
  for (const ActionPoseSample& sample : recording.samples) {
    for (const AdaptationEvent& event :
         std::visit([&](auto& by) { return by.on_sample(sample); }, method)) {
      ++num_events;
      if (arguments.json)
        std::cout << event_line(event, sample, schema).dump() << '\n';
      else
        std::cout << fmt::format("sample {:5} {:9.2f} s  {}\n", event.sample_index, seconds(sample),
                                 text_of(event, schema.signals));
    }
    if (evaluation && arguments.json) {
      const auto errors = evaluate(adapted(), evaluation->samples);
      Json line = {{"sample", sample.sample_index}, {"t", seconds(sample)}};
      line.update(errors_json(static_cast<int>(evaluation->samples.size()), errors));
      std::cout << line.dump() << '\n';
    }
  }
  if (evaluation && !arguments.json)
    std::cout << errors_text({.parts = evaluate(adapted(), evaluation->samples)});
  if (!arguments.json)
    std::cout << fmt::format("{} samples, {} events\n", recording.samples.size(), num_events);
  std::cout << std::flush;
  if (arguments.out.empty()) return;
  schema = adapted();
  schema.base_version = schema.version;
  schema.last_sample_index = recording.samples.back().sample_index;
  schema.utime = recording.samples.back().utime;
  schema.version = schema.last_sample_index + 1;
  write_one_event_log(arguments.out, kBodySchema, to_message(schema));
}

}  // namespace

void add_monitor_command(Arguments console) {
  auto [monitor, arguments] = console.add_command(
      "monitor", "Keep a schema true over a recording in which the body changes", run_monitor);
  monitor.add_option("SCHEMA", arguments.schema, "Schema file to start from").required();
  monitor.add_option("SAMPLES", arguments.samples, "Recording (LCM log or CSV)").required();
  monitor.add_option("--out", arguments.out, "Write the schema as it is in the end to this file");
  monitor.add_option("--evaluate", arguments.evaluate,
                     "Compare the schema with this recording after every sample");
  add_noise(monitor, arguments.noise);
  monitor
      .add_option(
          "--method", arguments.method,
          "evidence, or the chapter's procedure: a window of 15, 3 sigma (its own, or --noise)")
      .one_of({"evidence", "chapter"})
      .capture_default_str();
  monitor.add_flag("--json", arguments.json, "Print one JSON line an event (and a sample)");
}

}  // namespace bodyschema
