#include <fmt/format.h>

#include <iostream>
#include <stdexcept>
#include <string>

#include "common/bus/event_log.h"
#include "common/text/text.h"
#include "processes/console/commands/commands.h"
#include "processes/console/commands/files.h"
#include "processes/console/commands/urdf_files.h"

namespace bodyschema {
namespace {

struct UrdfArguments {
  std::string schema, out, placement;
  bool nominal = false;
};

void run_urdf(const UrdfArguments& arguments) {
  const BodySchema schema = load_schema(arguments.schema);
  check_outs({{"--out", arguments.out}, {"--placement", arguments.placement}}, {arguments.schema});
  const UrdfModel model =
      write_urdf(schema, arguments.schema, arguments.nominal, arguments.out, arguments.placement);
  std::cout << urdf_text(model, arguments.out) << std::flush;
}

}  // namespace

UrdfModel write_urdf(const BodySchema& schema, const std::string& schema_file, bool nominal,
                     const std::string& urdf, const std::string& placement) {
  UrdfModel model;
  try {
    model = urdf_model(schema, nominal);
  } catch (const std::invalid_argument& error) {
    throw std::runtime_error(schema_file + ": " + error.what());
  }
  if (!placement.empty()) write_file_atomically(placement, model.placement);
  write_file_atomically(urdf, model.urdf);
  return model;
}

std::string urdf_text(const UrdfModel& model, const std::string& urdf) {
  std::string text = fmt::format("{}: {}, {} that move\n", urdf, counted(model.num_links, "link"),
                                 counted(model.num_moving_joints, "joint"));
  for (const std::string& remark : model.remarks) text += "  " + remark + "\n";
  return text;
}

Json urdf_json(const UrdfModel& model, const std::string& urdf) {
  return {{"file", urdf},
          {"links", model.num_links},
          {"moving_joints", model.num_moving_joints},
          {"remarks", model.remarks}};
}

void add_urdf_command(Arguments console) {
  auto [urdf, arguments] = console.add_command(
      "urdf",
      "A URDF from a schema, and where signals and parts are on it; the inverse of engineer",
      run_urdf);
  urdf.add_option("SCHEMA", arguments.schema, "Schema file").required();
  urdf.add_option("--out", arguments.out, "Write the URDF to this file").required();
  urdf.add_option("--placement", arguments.placement,
                  "Write signals and parts to this YAML file, as engineer reads it")
      .required();
  urdf.add_flag("--nominal", arguments.nominal,
                "Write the nearest pure joint for what a URDF does not have: helical joints, bent "
                "commands, Gaussian processes");
}

}  // namespace bodyschema
