#include "processes/refiner/refine.h"

#include <fmt/format.h>

#include <filesystem>
#include <iostream>
#include <stdexcept>

#include "common/bus/channels.h"
#include "common/bus/convert.h"
#include "common/bus/event_log.h"
#include "processes/console/commands/commands.h"
#include "processes/console/commands/files.h"
#include "processes/console/commands/urdf_files.h"
#include "processes/console/engineered_model.h"
#include "processes/console/engineered_place.h"
#include "processes/console/gravity_load.h"
#include "processes/console/hint.h"
#include "processes/console/rig_check.h"
#include "processes/console/views/refinement_view.h"
#include "processes/refiner/proposed_files.h"
#include "processes/refiner/refiner_settings.h"

namespace bodyschema {
namespace {

struct RefineArguments {
  std::string schema, samples, test, out, rig, proposed, urdf, urdf_placement;
  std::string structure, placement, elastic;  ///< of a robot whose structure is known
  std::vector<double> noise;
  bool placements = false, intrinsics = false, json = false;

  std::vector<std::string> inputs() const {
    return structure.empty() ? std::vector{schema, samples, test}
                             : std::vector{structure, placement, samples, test};
  }
};

/// Where the refinement begins, and what it is fitted to.
struct Start {
  BodySchema schema;
  Recording recording;
  JointLoads loads;  ///< where they are asked for
};

Start begin_with(const RefineArguments& arguments) {
  Start start;
  if (arguments.structure.empty()) {
    start.schema = load_schema(arguments.schema);
    start.recording = load_for(arguments.samples, start.schema);
    forget_changes_of_another(start.recording, &start.schema);
    return start;
  }
  std::vector<std::string> joints;
  start.schema = engineered_model(arguments.structure, arguments.placement, &joints);
  if (!arguments.elastic.empty())
    start.loads = GravityLoad(arguments.structure, arguments.placement, joints);
  start.recording = load_for(arguments.samples, start.schema);
  place_in_camera(start.recording, &start.schema);
  return start;
}

/// Those that are fitted, and judged by after them those of --test.
std::vector<RefinerSample> samples_of(const RefineArguments& arguments, const BodySchema& schema,
                                      const Recording& recording) {
  std::vector<RefinerSample> samples = refiner_samples(recording.samples, recording.sights);
  if (arguments.test.empty()) return samples;
  const Recording test = load_for(arguments.test, schema);
  const std::int64_t first = samples.empty() ? 0 : index_of(samples.back()) + 1;
  for (RefinerSample& seen : refiner_samples(test.samples, test.sights)) {
    seen.sample.purpose = Purpose::kTest;
    seen.sample.sample_index += first;
    samples.push_back(std::move(seen));
  }
  return samples;
}

/// The rig's folder: that which is told, else the run's own beside a log.
std::filesystem::path rig_folder(const RefineArguments& arguments, bool is_log) {
  if (!arguments.rig.empty()) return find_rig(arguments.rig);
  const auto own = std::filesystem::path(arguments.samples).parent_path() / "config";
  return is_log && std::filesystem::exists(own / "markers.yaml") ? own : std::filesystem::path();
}

/// Of poses: as told, as the recording says, else as the schema was learned with.
MeasurementModel measurement_of(const RefineArguments& arguments, const Recording& recording,
                                const BodySchema& schema) {
  MeasurementModel measurement = recording.measurement;
  if (!arguments.noise.empty())
    measurement.noise = noise_given(arguments.noise);
  else if (!recording.has_noise)
    measurement.noise = schema.noise;
  if (measurement.noise && !(measurement.noise->position_m > 0))
    throw std::invalid_argument(
        "neither the recording nor the schema tells the noise: give --noise");
  return measurement;
}

/// What to do with it.
std::string next_steps(const RefineArguments& arguments, const Refinement& result) {
  std::string text;
  if (!arguments.structure.empty() && arguments.elastic.empty() && !result.bends.empty())
    text +=
        "  joints that give way to gravity look like bent commands: --elastic SCHEMA3 fits "
        "compliances in their place\n";
  if (arguments.proposed.empty()) return text;
  std::filesystem::path folder = std::filesystem::path(arguments.proposed).lexically_normal();
  if (!folder.has_filename()) folder = folder.parent_path();
  const std::filesystem::path run = folder.parent_path();
  if (folder.filename() == "proposed" && std::filesystem::is_directory(run / "config"))
    return text + fmt::format("  to write tags and lens into the rig: `{}`\n",
                              to_type("adopt " + run.string()));
  return text + fmt::format(
                    "  tags and lens as found are in {}; `adopt RUN` writes those of RUN/proposed "
                    "into the rig\n",
                    arguments.proposed);
}

/// Prints the result, with the URDF where one is asked for. A schema that has none is refined all
/// the same. @throws std::runtime_error then, after the result.
void write_urdf_and_print(const RefineArguments& arguments, const Refinement& result,
                          const std::optional<RigCalibration>& rig) {
  Json json = refinement_json(result, rig);
  std::string text = refinement_text(result, rig) + next_steps(arguments, result);
  std::string problem;
  if (!arguments.urdf.empty()) {
    json["urdf"] = nullptr;
    try {
      // As the file holds it, so that `urdf` makes the same bytes of that.
      const BodySchema written = from_message(to_message(result.schema));
      const UrdfModel model =
          write_urdf(written, arguments.out, false, arguments.urdf, arguments.urdf_placement);
      json["urdf"] = urdf_json(model, arguments.urdf);
      text += urdf_text(model, arguments.urdf);
    } catch (const std::runtime_error& error) {
      problem = error.what();
    }
  }
  print(arguments.json, json, text);
  if (problem.empty()) return;
  const std::string placement =
      arguments.urdf_placement.empty() ? "PLACEMENT" : arguments.urdf_placement;
  throw std::runtime_error(
      fmt::format("--urdf: {}. The refined schema was written; to make a URDF of it: `{}`", problem,
                  to_type(fmt::format("urdf {} --out {} --placement {} [--nominal]", arguments.out,
                                      arguments.urdf, placement))));
}

void run_refine(const RefineArguments& given) {
  RefineArguments arguments = given;
  if (!arguments.structure.empty()) {
    if (!arguments.samples.empty()) refuse_argument("SCHEMA", "expected none with --structure");
    std::swap(arguments.schema, arguments.samples);
  } else if (arguments.schema.empty()) {
    refuse_argument("SCHEMA", "expected, or --structure");
  }
  if (arguments.samples.empty()) refuse_argument("SAMPLES", "expected");
  std::error_code is_new;
  if (std::filesystem::equivalent(arguments.test, arguments.samples, is_new) && !is_new)
    refuse_argument("--test", arguments.test + " is the recording that is fitted");
  if (!arguments.proposed.empty() && !arguments.placements && !arguments.intrinsics)
    refuse_argument("--proposed", "expected with --placements or --intrinsics");
  if (std::filesystem::exists(arguments.proposed) &&
      !std::filesystem::is_directory(arguments.proposed))
    refuse_argument("--proposed", arguments.proposed + " is no folder");
  if (!arguments.elastic.empty() && (arguments.placements || arguments.intrinsics))
    refuse_argument("--elastic",
                    "expected without --placements and --intrinsics: poses are fitted");
  const auto [schema, recording, loads] = begin_with(arguments);
  RefineOptions options;
  std::optional<RigCalibration> rig;
  const std::filesystem::path folder = rig_folder(arguments, recording.is_log);
  if (!folder.empty()) {
    const std::filesystem::path file = folder / "refiner.yaml";
    const RefinerSettings settings = RefinerSettings::load(
        folder, std::filesystem::exists(file) ? RefinerConfig::load(file) : RefinerConfig());
    options = settings.options;
    rig = settings.rig;
  }
  options.placements = arguments.placements;
  options.intrinsics = arguments.intrinsics;
  options.measurement = measurement_of(arguments, recording, schema);
  options.joint_loads = loads;
  check_outs({{"--out", arguments.out},
              {"--elastic", arguments.elastic},
              {"--urdf", arguments.urdf},
              {"--urdf-placement", arguments.urdf_placement}},
             arguments.inputs());
  Refinement result = refine(schema, samples_of(arguments, schema, recording), rig, options);
  result.warnings.insert(result.warnings.begin(), recording.hints.begin(), recording.hints.end());
  write_one_event_log(arguments.out, kBodySchema, to_message(result.schema));
  if (result.elasticity)
    write_one_event_log(arguments.elastic, kBodySchema, to_message(result.elasticity->schema));
  if (!arguments.proposed.empty()) write_proposed_files(result.rig, arguments.proposed);
  write_urdf_and_print(arguments, result, rig);
  if (!arguments.elastic.empty() && !result.elasticity)
    throw std::runtime_error(
        fmt::format("--elastic: {} was not written: no joint's load changes over the samples",
                    arguments.elastic));
}

}  // namespace

void add_refine_command(Arguments console) {
  auto [refine, arguments] = console.add_command(
      "refine", "Fit all parameters of a schema at once to a recording", run_refine);
  refine.add_option("SCHEMA", arguments.schema,
                    "Schema file: where to begin; left out with --structure");
  refine.add_option("SAMPLES", arguments.samples, "Recording (LCM log or CSV)");
  refine.add_option("--test", arguments.test,
                    "Also tell the error on this recording, which is not fitted");
  Argument structure = refine.add_option("--structure", arguments.structure,
                                         "Begin with the robot of this URDF, as engineer does");
  Argument placement =
      refine.add_option("--placement", arguments.placement,
                        "YAML: root, signals, parts on links of that URDF, as engineer reads it");
  structure.needs(placement);
  placement.needs(structure);
  refine
      .add_option("--elastic", arguments.elastic,
                  "Also fit joints that give way to gravity, by the masses of that URDF; write the "
                  "schema of the unloaded robot to this file")
      .needs(structure);
  refine.add_option("--rig", arguments.rig,
                    "Folder of the rig that the samples are of, or name of one in config/: its "
                    "tags and lens; the run's own if not given");
  refine.add_flag("--placements", arguments.placements,
                  "Also where the tags sit on their parts, and their sizes, by the tags' corners");
  refine.add_flag("--intrinsics", arguments.intrinsics, "Also focal length, centre and distortion");
  refine.add_option("--out", arguments.out, "Write the refined schema to this file").required();
  refine.add_option("--proposed", arguments.proposed,
                    "Write markers.yaml and camera_info.yaml as found into this folder");
  const Argument urdf = refine.add_option("--urdf", arguments.urdf,
                                          "Write the refined schema as a URDF to this file");
  refine
      .add_option("--urdf-placement", arguments.urdf_placement,
                  "Write where signals and parts are on the URDF to this YAML file, as engineer "
                  "reads it")
      .needs(urdf);
  add_noise(refine, arguments.noise, "; of poses");
  refine.add_flag("--json", arguments.json, "Print JSON");
}

}  // namespace bodyschema
