#include <iostream>
#include <memory>
#include <stdexcept>
#include <string>

#include "common/bus/convert.h"
#include "common/bus/event_log.h"
#include "common/geometry/angle.h"
#include "processes/console/commands/commands.h"
#include "processes/console/commands/files.h"
#include "processes/console/engineered_model.h"
#include "processes/console/views/structure_view.h"
#include "processes/structure_learner/root_pose.h"

namespace bodyschema {
namespace {

struct EngineerArguments {
  std::string urdf, placement, samples, out;
  bool json = false;
};

void run_engineer(const EngineerArguments& arguments) {
  BodySchema schema = engineered_model(arguments.urdf, arguments.placement);
  const Recording recording = load_for(arguments.samples, schema);
  MeasurementModel measurement = recording.measurement;
  if (!recording.has_noise) measurement.noise = Noise{0.001, 0.2 * kDegree};  // weights alone
  estimate_root_pose(recording.samples, measurement, &schema);
  schema.calibration_id = recording.samples.front().calibration_id;
  if (schema.X_CR_covariance.isZero(0))
    throw std::runtime_error(arguments.samples + ": the root, part " + std::to_string(schema.root) +
                             ", is never seen");
  check_out(arguments.out, {arguments.samples, arguments.urdf, arguments.placement});
  write_one_event_log(arguments.out, kBodySchema, to_message(schema));
  if (arguments.json) {
    std::cout << schema_json(schema).dump(2) << std::endl;
  } else {
    std::cout << structure_text(schema) << std::flush;
  }
}

}  // namespace

void add_engineer_command(Arguments console) {
  const auto arguments = std::make_shared<EngineerArguments>();
  Arguments engineer = console.add_subcommand(
      "engineer", "A schema from a URDF and where the parts are on its links");
  engineer.add_option("URDF", arguments->urdf, "The robot").required();
  engineer.add_option("PLACEMENT", arguments->placement, "YAML: root, signals, parts on links")
      .required();
  engineer
      .add_option("--samples", arguments->samples,
                  "A recording that shows where the root stands in the camera's frame")
      .required();
  engineer.add_option("--out", arguments->out, "Write the schema to this file").required();
  engineer.add_flag("--json", arguments->json, "Print JSON");
  engineer.callback([arguments] { run_engineer(*arguments); });
}

}  // namespace bodyschema
