#include <fmt/format.h>

#include <filesystem>
#include <iostream>
#include <memory>
#include <stdexcept>
#include <string>

#include "common/bus/event_log.h"
#include "common/text/text.h"
#include "processes/console/commands/commands.h"
#include "processes/console/commands/files.h"
#include "processes/console/urdf_model.h"

namespace bodyschema {
namespace {

struct UrdfArguments {
  std::string schema, out, placement;
  bool nominal = false;
};

void run_urdf(const UrdfArguments& arguments) {
  const BodySchema schema = load_schema(arguments.schema);
  check_out(arguments.out, {arguments.schema});
  check_out(arguments.placement, {arguments.schema}, "--placement");
  const auto place = [](const std::string& file) {
    return std::filesystem::weakly_canonical(std::filesystem::absolute(file));
  };
  if (place(arguments.out) == place(arguments.placement))
    throw std::invalid_argument("--placement: expected another file than --out");
  UrdfModel model;
  try {
    model = urdf_model(schema, arguments.nominal);
  } catch (const std::invalid_argument& error) {
    throw std::runtime_error(arguments.schema + ": " + error.what());
  }
  write_file_atomically(arguments.placement, model.placement);
  write_file_atomically(arguments.out, model.urdf);
  std::string text =
      fmt::format("{}: {}, {} that move\n", arguments.out, counted(model.num_links, "link"),
                  counted(model.num_moving_joints, "joint"));
  for (const std::string& remark : model.remarks) text += "  " + remark + "\n";
  std::cout << text << std::flush;
}

}  // namespace

void add_urdf_command(Arguments console) {
  const auto arguments = std::make_shared<UrdfArguments>();
  Arguments urdf = console.add_subcommand(
      "urdf",
      "A URDF from a schema, and where signals and parts are on it; the inverse of engineer");
  urdf.add_option("SCHEMA", arguments->schema, "Schema file").required();
  urdf.add_option("--out", arguments->out, "Write the URDF to this file").required();
  urdf.add_option("--placement", arguments->placement,
                  "Write signals and parts to this YAML file, as engineer reads it")
      .required();
  urdf.add_flag("--nominal", arguments->nominal,
                "Write the nearest pure joint for what a URDF does not have: helical joints, bent "
                "commands, Gaussian processes");
  urdf.callback([arguments] { run_urdf(*arguments); });
}

}  // namespace bodyschema
