#include <fmt/format.h>

#include <cmath>
#include <string>
#include <vector>

#include "processes/console/commands/commands.h"
#include "processes/console/commands/files.h"
#include "processes/console/views/prediction_view.h"
#include "processes/console/views/reach_view.h"
#include "processes/console/way_points.h"

namespace bodyschema {
namespace {

struct ReachArguments {
  std::string schema;
  int part = 0;
  std::vector<double> position, orientation, from;
  bool json = false;
};

void require_finite(const std::string& option, const std::vector<double>& numbers) {
  for (const double number : numbers)
    if (!std::isfinite(number)) refuse_argument(option, "expected finite numbers");
}

PoseTarget target_of(const ReachArguments& arguments) {
  require_finite("--position", arguments.position);
  for (const double coordinate : arguments.position)
    if (std::abs(coordinate) > kFarthestTarget_m)
      refuse_argument("--position", fmt::format("expected metres, within ±{}", kFarthestTarget_m));
  PoseTarget target;
  target.p_RT = Eigen::Vector3d::Map(arguments.position.data());
  if (arguments.orientation.empty()) return target;
  target.q_RT = unit_quaternion("--orientation", arguments.orientation);
  return target;
}

Eigen::VectorXd start_of(const ReachArguments& arguments, const BodySchema& schema) {
  if (arguments.from.empty()) return mid_range(schema.signals);
  require_finite("--from", arguments.from);
  if (arguments.from.size() != schema.signals.size())
    refuse_argument(
        "--from", fmt::format("expected {} values, in the schema's order", schema.signals.size()));
  for (std::size_t s = 0; s < schema.signals.size(); ++s) {
    const Signal& signal = schema.signals[s];
    const double rounding = 1e-3 * (signal.upper - signal.lower);
    if (arguments.from[s] < signal.lower - rounding || arguments.from[s] > signal.upper + rounding)
      refuse_argument("--from", fmt::format("{} = {} is beyond its limits {} … {}", signal.name,
                                            arguments.from[s], signal.lower, signal.upper));
  }
  return Eigen::VectorXd::Map(arguments.from.data(),
                              static_cast<Eigen::Index>(arguments.from.size()));
}

void run_reach(const ReachArguments& arguments) {
  const BodySchema schema = load_schema(arguments.schema);
  const PoseTarget target = target_of(arguments);
  if (!schema.has_part(arguments.part) || arguments.part == schema.root ||
      !schema.predict(schema.root, arguments.part, start_of(arguments, schema)))
    refuse_argument("--part", no_way_text(schema, arguments.part));
  if (target.q_RT && !schema.has_rotation(arguments.part))
    refuse_argument("--orientation",
                    fmt::format("of part {} positions alone are known", arguments.part));
  const Reach reach = reach_of(schema, arguments.part, target, start_of(arguments, schema));
  print(arguments.json, reach_json(schema, reach), reach_text(schema, reach));
  if (!reach.solution.is_within_tolerance) end_as_failed();
}

}  // namespace

void add_reach_command(Arguments console) {
  auto [reach, arguments] = console.add_command(
      "reach", "An action that brings a part to a pose by a schema, or the nearest", run_reach);
  reach.add_option("SCHEMA", arguments.schema, "Schema file").required();
  reach.add_option("--part", arguments.part, "Which part").required();
  reach.add_option("--position", arguments.position, "In the root's frame [m]")
      .expected(3)
      .type_name("X Y Z")
      .required();
  reach.add_option("--orientation", arguments.orientation, "Unit quaternion, in the root's frame")
      .expected(4)
      .type_name("W X Y Z");
  reach.add_option("--from", arguments.from,
                   "The action that it begins at, a value for each signal; of several answers one "
                   "near it is found first; the middle of the ranges if not given");
  reach.add_flag("--json", arguments.json, "Print JSON");
}

}  // namespace bodyschema
