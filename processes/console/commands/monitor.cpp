#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include "common/bus/cause_names.h"
#include "common/bus/convert.h"
#include "common/bus/event_log.h"
#include "common/geometry/angle.h"
#include "processes/console/commands/commands.h"
#include "processes/console/commands/files.h"
#include "processes/console/evaluation.h"
#include "processes/console/recording.h"
#include "processes/console/views/health_view.h"
#include "processes/console/views/structure_view.h"
#include "processes/model_monitor/adaptation.h"
#include "processes/model_monitor/chapter_adaptation.h"
#include "processes/model_monitor/health_words.h"
#include "processes/model_monitor/live_schema.h"
#include "processes/structure_learner/baseline/fit_matrix_gp.h"
#include "processes/structure_learner/baseline/learn_baseline.h"
#include "processes/structure_learner/learn.h"

namespace bodyschema {
namespace {

using Json = nlohmann::ordered_json;

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

std::vector<std::string> names_of(const std::vector<Signal>& signals) {
  std::vector<std::string> names;
  for (const Signal& signal : signals) names.push_back(signal.name);
  return names;
}

Json event_json(const AdaptationEvent& event, const ActionPoseSample& sample,
                const std::vector<Signal>& signals) {
  const health_event_t message = to_message(event, signals, sample.utime);
  Json json;
  json["sample"] = event.sample_index;
  json["t"] = seconds(sample);
  json["event"] = name_of(event.kind);
  if (event.part >= 0) {
    json["part"] = event.part;
    if (event.tag >= 0) json["tag"] = event.tag;
  } else {
    json["from"] = event.from;
    json["to"] = event.to;
  }
  if (!event.cause.empty())
    json["cause"] = cause_text(message.event_cause, message.event_other_cause);
  add_size(message.event_size, message.event_since, names_of(signals), &json);
  json["margin"] = event.margin;
  json["samples_used"] = event.num_samples;
  json["text"] = message.event_text;
  if (event.probe.size() > 0)
    json["action"] =
        std::vector<double>(event.probe.data(), event.probe.data() + event.probe.size());
  return json;
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
  if (!noise) {
    std::cerr << "noise: the covariances of " << arguments.samples << "\n";
    return;
  }
  std::cerr << fmt::format("noise per axis and marker: {:.2f} mm {:.2f}°, {}\n",
                           noise->position_m * 1e3, noise->rotation_rad / kDegree,
                           arguments.noise.empty() ? "that of " + arguments.schema : "given");
}

/// A procedure that keeps the schema true.
class Method {
 public:
  virtual ~Method() = default;
  virtual std::vector<AdaptationEvent> on_sample(const ActionPoseSample& sample) = 0;
  virtual const BodySchema& schema() const = 0;
};

template <class Adapting>
class MethodOf : public Method {
 public:
  explicit MethodOf(Adapting adapting) : adapting_(std::move(adapting)) {}
  std::vector<AdaptationEvent> on_sample(const ActionPoseSample& sample) override {
    return adapting_.on_sample(sample);
  }
  const BodySchema& schema() const override { return adapting_.schema(); }

 private:
  Adapting adapting_;
};

std::unique_ptr<Method> method_of(const std::string& name, const AdaptationOptions& options,
                                  const BodySchema& schema) {
  if (name == "evidence")
    return std::make_unique<MethodOf<Adaptation>>(Adaptation(schema, options));
  ChapterAdaptationOptions chapter;
  if (options.measurement.noise) {
    BaselineOptions baseline;
    baseline.set_noise(*options.measurement.noise);
    chapter.sigma_position_m = baseline.sigma_position_m;
    chapter.sigma_rotation_rad = baseline.sigma_rotation_rad;
  }
  return std::make_unique<MethodOf<ChapterAdaptation>>(
      ChapterAdaptation(schema, chapter, fit_matrix_gp_edge));
}

void run_monitor(const MonitorArguments& arguments) {
  BodySchema schema = load_schema(arguments.schema);
  const Recording recording = load_for(arguments.samples, schema);
  std::optional<Recording> evaluation;
  if (!arguments.evaluate.empty()) evaluation = load_for(arguments.evaluate, schema);
  if (schema.edges.empty())
    throw std::invalid_argument(arguments.schema + ": expected a schema with edges, found none");
  const bool is_seen = std::any_of(
      recording.samples.begin(), recording.samples.end(), [&](const ActionPoseSample& sample) {
        return std::any_of(sample.parts.begin(), sample.parts.end(), [&](const auto& o) {
          return std::find(schema.parts.begin(), schema.parts.end(), o.part) != schema.parts.end();
        });
      });
  if (!is_seen)
    throw std::invalid_argument(arguments.samples + ": none of the parts of " + arguments.schema +
                                " is seen in it; is it of another body?");
  check_out(arguments.out, {arguments.samples, arguments.schema, arguments.evaluate});

  const AdaptationOptions options = options_of(arguments, recording, schema);
  const std::unique_ptr<Method> method = method_of(arguments.method, options, schema);
  tell_noise(arguments, options.measurement.noise);
  int num_events = 0;
  for (const ActionPoseSample& sample : recording.samples) {
    for (const AdaptationEvent& event : method->on_sample(sample)) {
      ++num_events;
      if (arguments.json)
        std::cout << event_json(event, sample, schema.signals).dump() << '\n';
      else
        std::cout << fmt::format("sample {:5} {:9.2f} s  {}\n", event.sample_index, seconds(sample),
                                 text_of(event, schema.signals));
    }
    if (!evaluation) continue;
    const auto errors = evaluate(method->schema(), evaluation->samples);
    Json line;
    line["sample"] = sample.sample_index;
    line["t"] = seconds(sample);
    line.update(errors_json(static_cast<int>(evaluation->samples.size()), errors));
    if (arguments.json) {
      std::cout << line.dump() << '\n';
    } else if (sample.sample_index + 1 == std::ssize(recording.samples)) {
      std::cout << errors_text(errors);
    }
  }
  if (!arguments.json)
    std::cout << fmt::format("{} samples, {} events\n", recording.samples.size(), num_events);
  std::cout << std::flush;
  if (arguments.out.empty()) return;
  schema = method->schema();
  schema.base_version = schema.version;
  schema.last_sample_index = recording.samples.back().sample_index;
  schema.version = schema.last_sample_index + 1;
  write_one_event_log(arguments.out, kBodySchema, to_message(schema));
}

}  // namespace

void add_monitor_command(Arguments console) {
  const auto arguments = std::make_shared<MonitorArguments>();
  Arguments monitor = console.add_subcommand(
      "monitor", "Keep a schema true over a recording in which the body changes");
  monitor.add_option("SCHEMA", arguments->schema, "Schema file to start from").required();
  monitor.add_option("SAMPLES", arguments->samples, "Recording (LCM log or CSV)").required();
  monitor.add_option("--out", arguments->out, "Write the schema as it is in the end to this file");
  monitor.add_option("--evaluate", arguments->evaluate,
                     "Compare the schema with this recording after every sample");
  monitor
      .add_option("--noise", arguments->noise,
                  "Standard deviation per axis and marker: position [m], rotation [deg]")
      .expected(2)
      .type_name("POS_M ROT_DEG");
  monitor
      .add_option(
          "--method", arguments->method,
          "evidence, or the chapter's procedure: a window of 15, 3 sigma (its own, or --noise)")
      .one_of({"evidence", "chapter"})
      .capture_default_str();
  monitor.add_flag("--json", arguments->json, "Print one JSON line an event (and a sample)");
  monitor.callback([arguments] { run_monitor(*arguments); });
}

}  // namespace bodyschema
