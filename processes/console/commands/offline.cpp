#include <fmt/format.h>

#include <cmath>
#include <filesystem>
#include <fstream>
#include <iostream>
#include <stdexcept>

#include "common/bus/convert.h"
#include "common/bus/event_log.h"
#include "common/bus/rig_door.h"
#include "common/config/rig.h"
#include "common/estimation/evaluation.h"
#include "common/text/pose_text.h"
#include "processes/console/commands/commands.h"
#include "processes/console/commands/files.h"
#include "processes/console/engineered_model.h"
#include "processes/console/engineered_place.h"
#include "processes/console/rig_check.h"
#include "processes/console/views/prediction_view.h"
#include "processes/console/views/structure_view.h"
#include "processes/structure_learner/baseline/learn_baseline.h"
#include "processes/structure_learner/learn.h"
#include "processes/structure_learner/pair_data.h"
#include "processes/structure_learner/recording/recording.h"

namespace bodyschema {
namespace {

struct LearnArguments {
  std::string samples;
  std::string out;
  std::optional<int> root;
  std::vector<double> noise;
  std::string method = "screw";
  bool json = false;
};

/// Correlations of the noise above it are told. Chosen: cameras that drift or are bumped have 0.45
/// to 0.57 in five recordings of `foreign_robots`, robots whose camera rests at most 0.18 in
/// twelve.
constexpr double kMuchLeft = 0.35;

/// The chapter's own method: a result to compare with.
LearnResult learn_as_the_chapter(const Recording& recording,
                                 const std::vector<ActionPoseSample>& training,
                                 const LearnOptions& options) {
  if (!parts_without_rotation(training).empty())
    throw std::invalid_argument(
        "--method chapter needs orientations: the chapter's models are of "
        "poses; the samples have positions alone");
  BaselineOptions baseline;
  baseline.root = options.root;
  SourcedNoise noise = marker_noise(training, static_cast<int>(recording.signals.size()), options);
  noise.position_m = std::hypot(noise.position_m, options.measurement.systematic.position_m);
  noise.rotation_rad = std::hypot(noise.rotation_rad, options.measurement.systematic.rotation_rad);
  baseline.set_noise(noise);
  baseline.max_samples = std::min(baseline.max_samples, MatrixGp::kMaxSamples);  // to be written
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
  const Recording recording = load_and_warn(arguments.samples);
  LearnOptions options;
  options.root = arguments.root;
  options.measurement = recording.measurement;
  options.measurement.noise = noise;
  check_out(arguments.out, {arguments.samples});
  const std::vector<ActionPoseSample> training = recording.training();
  const auto shows_root = [&](const auto& sample) { return sample.find(*options.root); };
  if (options.root && std::ranges::none_of(training, shows_root))
    throw std::invalid_argument(
        fmt::format("--root: part {} is never seen in {}", *options.root, arguments.samples));
  const LearnResult result = arguments.method == "chapter"
                                 ? learn_as_the_chapter(recording, training, options)
                                 : learn(recording.signals, training, options);
  if (!arguments.out.empty()) {
    BodySchema schema = result.schema;
    schema.version = schema.last_sample_index + 1;
    write_one_event_log(arguments.out, kBodySchema, to_message(schema));
  }
  Json json = structure_json(result.schema, result.outliers, result.noise_source);
  json["one_cluster"] = result.is_one_cluster;
  json["serial_correlation"] = result.serial_correlation;
  json["command_lag_s"] = static_cast<double>(result.command_delay.lag_us) / 1e6;
  json["command_smear_s"] = static_cast<double>(result.command_delay.smear_us) / 1e6;
  std::string text = structure_text(result.schema, result.noise_source);
  if (result.command_delay != CommandDelay{})
    text += "  " + delay_text(result.command_delay) + "\n";
  if (noise && result.noise_source == NoiseSource::kResiduals)
    text += fmt::format("  the best models leave more than --noise says, {}\n",
                        pose_text(noise->position_m, noise->rotation_rad));
  if (result.serial_correlation > kMuchLeft)
    text += fmt::format(
        "  what the models leave lasts from one pose to the next (correlation {:.2f}): if the "
        "camera or what it stands on moved meanwhile, learn from before and from after it\n",
        result.serial_correlation);
  if (result.is_one_cluster)
    text +=
        "  the poses are one cluster: what is learned holds near them alone; move all joints "
        "farther\n";
  print(arguments.json, json, text);
}

/// Of `predict` and `show`.
struct SchemaArguments {
  std::string schema, samples, out;
  std::vector<double> action;
  bool json = false;
};

void predict_action(const SchemaArguments& arguments, const BodySchema& schema) {
  if (!arguments.out.empty()) refuse_argument("--out", "expected with SAMPLES");
  if (arguments.action.size() != schema.signals.size())
    refuse_argument("--action", fmt::format("expected {} values: {}", schema.signals.size(),
                                            fmt::join(signal_names(schema), " ")));
  for (const double value : arguments.action)
    if (!std::isfinite(value)) refuse_argument("--action", "expected finite values");
  const Eigen::VectorXd action = Eigen::Map<const Eigen::VectorXd>(
      arguments.action.data(), static_cast<Eigen::Index>(arguments.action.size()));
  print(arguments.json, prediction_json(schema, action), prediction_text(schema, action));
}

void run_predict(const SchemaArguments& arguments) {
  if (arguments.samples.empty() == arguments.action.empty())
    refuse_argument("SAMPLES", "expected either these or --action");
  const BodySchema schema = load_schema(arguments.schema);
  if (!arguments.action.empty()) return predict_action(arguments, schema);
  check_out(arguments.out, {arguments.schema, arguments.samples});
  const std::vector<ActionPoseSample> samples = load_for(arguments.samples, schema).samples;
  const auto errors = evaluate(schema, samples);
  const PredictionSummary summary = summary_of(schema, samples);
  if (!arguments.out.empty()) {
    std::ofstream file(arguments.out);
    write_predictions(schema, samples, file);
    if (!file.flush()) throw std::runtime_error("--out: cannot write " + arguments.out);
  }
  Json json = errors_json(static_cast<int>(samples.size()), errors);
  add_summary(schema, summary, &json);
  print(arguments.json, json, errors_text({.parts = errors}) + summary_text(schema, summary));
}

void run_show(const SchemaArguments& arguments) {
  const BodySchema schema = load_schema(arguments.schema);
  print(arguments.json, schema_json(schema), structure_text(schema));
}

struct EngineerArguments {
  std::string urdf, placement, samples, out;
  bool json = false;
};

void run_engineer(const EngineerArguments& arguments) {
  BodySchema schema = engineered_model(arguments.urdf, arguments.placement);
  const Recording recording = load_for(arguments.samples, schema);
  place_in_camera(recording, &schema);
  check_out(arguments.out, {arguments.samples, arguments.urdf, arguments.placement});
  write_one_event_log(arguments.out, kBodySchema, to_message(schema));
  print(arguments.json, schema_json(schema), structure_text(schema));
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
  if (!check.problems.empty())
    throw std::runtime_error(fmt::format("{}", fmt::join(check.problems, "\n")));
  const std::vector<int> parts = load_markers(folder).parts();
  if (arguments.hidden_part && !std::ranges::binary_search(parts, *arguments.hidden_part))
    throw std::invalid_argument(
        fmt::format("--hide: {} has no part {}", folder.string(), *arguments.hidden_part));
  if (!arguments.initial.empty()) RigDoor(folder).load_initial_schema(arguments.initial);
  const Network network = load_network(folder, arguments.group);
  const std::string host = arguments.host.empty() ? own_host(network) : arguments.host;
  std::vector<std::string> words = {network.is_private ? "private" : "host", network.bus_url(),
                                    network.images_url(), host};
  for (const std::string& process : host == "all" ? arguments.group : network.share_of(host))
    words.push_back(process);
  std::cout << fmt::format("{}\nOK: {} parts, {} signals, {} tags\n", fmt::join(words, " "),
                           check.num_parts, check.num_signals, check.num_tags);
}

}  // namespace

void add_offline_commands(Arguments console) {
  auto [learn, learning] = console.add_command(
      "learn", "Learn a body schema from a recording (LCM log or CSV)", run_learn);
  learn.add_option("SAMPLES", learning.samples, "Recording; - reads stdin").required();
  learn.add_option("--out", learning.out, "Write the schema to this file");
  learn.add_option("--root", learning.root, "Root part; the lowest id if not given");
  add_noise(learn, learning.noise, "; estimated if neither this nor the recording says it");
  learn
      .add_option("--method", learning.method,
                  "screw, or chapter: matrix GPs, and thresholds on mean errors at three times the "
                  "noise, for comparison")
      .one_of({"screw", "chapter"});
  learn.add_flag("--json", learning.json, "Print JSON");

  auto [predict, predicting] = console.add_command(
      "predict", "A schema's predictions: of one action, or compared with a recording",
      run_predict);
  predict.add_option("SCHEMA", predicting.schema, "Schema file").required();
  predict.add_option("SAMPLES", predicting.samples, "Recording");
  predict.add_option("--action", predicting.action,
                     "Instead of SAMPLES: a value for each signal, in the schema's order");
  predict.add_option("--out", predicting.out,
                     "Write the prediction for each sample and part to this CSV file");
  predict.add_flag("--json", predicting.json, "Print JSON");

  auto [show, showing] = console.add_command("show", "Print a schema file", run_show);
  show.add_option("SCHEMA", showing.schema, "Schema file").required();
  show.add_flag("--json", showing.json, "Print JSON");

  auto [rig, checking] = console.add_command(
      "rig",
      "Check every file of a rig by its process's own reader, and against the others; print its "
      "network (kind, bus, images, this host, its processes) and what it has",
      run_rig);
  rig.add_option("RIG", checking.rig, "Folder, or name of one in config/").required();
  rig.add_option("--hide", checking.hidden_part, "A part that is to be hidden: is there one?");
  rig.add_option("--group", checking.group, "All processes; each must run on exactly one host");
  rig.add_option("--host", checking.host, "Host of network.yaml; this machine if not given");
  rig.add_option("--initial", checking.initial, "A schema to begin with: is it of this rig?");
}

void add_engineer_command(Arguments console) {
  auto [engineer, arguments] = console.add_command(
      "engineer", "A schema from a URDF and where the parts are on its links", run_engineer);
  engineer.add_option("URDF", arguments.urdf, "The robot").required();
  engineer.add_option("PLACEMENT", arguments.placement, "YAML: root, signals, parts on links")
      .required();
  engineer
      .add_option("--samples", arguments.samples,
                  "A recording that shows where the root stands in the camera's frame")
      .required();
  engineer.add_option("--out", arguments.out, "Write the schema to this file").required();
  engineer.add_flag("--json", arguments.json, "Print JSON");
}

}  // namespace bodyschema
