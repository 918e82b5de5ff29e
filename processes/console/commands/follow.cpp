#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <iostream>
#include <iterator>
#include <limits>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include "common/bus/arguments.h"
#include "common/bus/channels.h"
#include "common/geometry/angle.h"
#include "common/text/text.h"
#include "processes/console/commands/commands.h"
#include "processes/console/commands/session.h"
#include "processes/console/hint.h"
#include "processes/console/interruption.h"
#include "processes/console/progress_line.h"
#include "processes/console/views/prediction_view.h"
#include "processes/console/way_points.h"
#include "processes/controller/controller.h"
#include "processes/controller/trajectory.h"

namespace bodyschema {
namespace {

using End = TargetFollower::End;

/// A step is reached so near by the schema.
constexpr double kNear_m = 5e-3, kNear_rad = 1 * kDegree;

struct FollowArguments {
  std::string in = default_url();
  std::string file;
  int part = -1;
  double step_m = 0.02;
  double timeout_s = 120;
  double tolerance_m = kSeenNear_m;
  std::string rig;
  Workspace workspace;  ///< of the rig
  bool json = false;
};

/// What became of a way point.
struct Passed {
  control_status_t status;
  End end = End::kOpen;
};

std::vector<PoseTarget> read_way_points(const std::string& file) {
  std::ifstream stream;
  if (file != "-") {
    if (std::filesystem::exists(file) && !std::filesystem::is_regular_file(file))
      throw WayPointError(file + ": is a folder, a device or a pipe, no file");
    stream.open(file);
    if (!stream) throw WayPointError(file + ": cannot be read");
  }
  const std::string text{
      std::istreambuf_iterator<char>(file == "-" ? std::cin : static_cast<std::istream&>(stream)),
      {}};
  return parse_way_points(text, file == "-" ? "stdin" : file);
}

Trajectory read_trajectory(const FollowArguments& arguments) {
  try {
    return Trajectory(read_way_points(arguments.file), arguments.step_m);
  } catch (const std::invalid_argument& error) {
    throw WayPointError(arguments.file + ": " + error.what());
  }
}

/// `heard` gets what comes as long as the session lives. @throws std::runtime_error unless a schema
/// does.
void listen(Session& session, Heard* heard) {
  heard->listen(session.bus);
  session.turn(
      kPatience_us, [&] { return heard->schema && heard->motion; },
      [&](std::int64_t) { session.expect_company(); });
  if (!heard->schema)
    throw std::runtime_error("no schema is known yet: it comes with the first samples");
}

Trajectory::Limits limits_of(const FollowArguments& arguments) {
  return {.position_sd_m = arguments.tolerance_m,
          .error_m = std::min(arguments.tolerance_m, kNear_m),
          .error_rad = kNear_rad,
          .off_line_m = arguments.step_m,
          .workspace = arguments.workspace};
}

/// Nothing is begun that the schema says cannot be ended. @throws std::runtime_error that says why
/// not.
void check_reach(const Heard& heard, const FollowArguments& arguments,
                 const Trajectory& trajectory) {
  const BodySchema& schema = *heard.schema;
  const int part = arguments.part;
  const Eigen::VectorXd action = heard.position().value_or(mid_range(schema.signals));
  if (!schema.has_part(part) || part == schema.root || !schema.predict(schema.root, part, action))
    throw std::runtime_error(no_way_text(schema, part));
  if (trajectory.leg(0).front().q_RT && !schema.has_rotation(part))
    throw std::runtime_error(
        fmt::format("of part {} positions alone are known: leave out qw,qx,qy,qz", part));
  ProgressLine line;
  const auto show = [&](std::size_t n) {
    if (is_interrupted()) throw std::runtime_error("interrupted; nothing was moved");
    line.show(
        fmt::format("looking at the way to point {} of {}", n + 1, trajectory.num_way_points()));
  };
  const std::string why = trajectory.objection(schema, part, action, limits_of(arguments), show);
  if (!why.empty()) throw std::runtime_error(why + "; nothing was moved");
}

/// "" or why the arm cannot go on to way point `n` from where it is, by the schema as it is now:
/// the posture may be another than was foreseen, or a link bent. How well the part is known does
/// not count while an edge is in doubt: the controller's small steps and probes end the doubt.
std::string objection_to_leg(const Heard& heard, const FollowArguments& arguments,
                             const Trajectory& trajectory, std::size_t n) {
  const auto position = heard.position();
  if (n == 0 || !position) return "";
  Trajectory::Limits limits = limits_of(arguments);
  const auto chain = chain_to(*heard.schema, arguments.part);
  if (chain && std::ranges::any_of(chain->edges,
                                   [](const Edge& edge) { return edge.state != EdgeState::kOk; }))
    limits.position_sd_m = std::numeric_limits<double>::infinity();
  return trajectory.objection_to_leg(n, *heard.schema, arguments.part, *position, limits);
}

pose_target_t target_at(const PoseTarget& step, const FollowArguments& arguments) {
  pose_target_t target =
      make_target(step.q_RT ? pose_target_t::KIND_POSE : pose_target_t::KIND_POSITION);
  target.target_part = arguments.part;
  std::ranges::copy(step.p_RT, target.position_m);
  if (const auto& q = step.q_RT) {
    const double wxyz[] = {q->w(), q->x(), q->y(), q->z()};
    std::ranges::copy(wxyz, target.orientation_wxyz);
  }
  target.tolerance_m = std::min(arguments.tolerance_m, kNear_m);
  target.tolerance_rad = kNear_rad;
  target.expiry_s = arguments.timeout_s + kExpiryAfterTimeout_s;
  return target;
}

/// Goes there step by step; moves and probes are those of all steps.
Passed pass(Session& session, const std::vector<PoseTarget>& steps, const pose_target_t& first,
            const FollowArguments& arguments, std::int64_t* next_id) {
  Passed passed;
  int num_moves = 0, num_probes = 0;
  for (const PoseTarget& step : steps) {
    pose_target_t target = target_at(step, arguments);
    target.epoch = first.epoch;
    target.target_id = (*next_id)++;
    target.way_point = first.way_point;
    target.num_way_points = first.num_way_points;
    TargetFollower follower(target, std::llround(arguments.timeout_s * 1e6),
                            {.m = arguments.tolerance_m});
    passed.status = session.follow_to_end(
        follower, arguments.timeout_s,
        fmt::format("way point {} of {} · ", first.way_point, first.num_way_points));
    passed.end = follower.end();
    num_moves += passed.status.num_moves;
    num_probes += passed.status.num_probes;
    if (passed.end != End::kAsked && passed.end != End::kMissed) break;
  }
  passed.status.num_moves = num_moves;
  passed.status.num_probes = num_probes;
  return passed;
}

Json follow_json(const std::vector<Passed>& passed, std::size_t num_way_points) {
  int num_moves = 0, num_probes = 0;
  for (const Passed& one : passed) {
    num_moves += one.status.num_moves;
    num_probes += one.status.num_probes;
  }
  // Reached by the schema is not enough: seen there.
  const bool is_reached =
      passed.size() == num_way_points && std::ranges::all_of(passed, [](const Passed& one) {
        return one.end == End::kAsked && one.status.observed_error_m >= 0;
      });
  return {{"reached", is_reached},
          {"way_points",
           array_of(passed, [](const Passed& one) { return target_json(one.status, one.end); })},
          {"of", num_way_points},
          {"moves", num_moves},
          {"probes", num_probes}};
}

void run_follow(const FollowArguments& given) {
  FollowArguments arguments = given;
  if (!arguments.rig.empty())
    arguments.workspace =
        ControllerConfig::load(std::filesystem::path(arguments.rig) / "controller.yaml").workspace;
  const Trajectory trajectory = read_trajectory(arguments);
  const std::size_t num_way_points = trajectory.num_way_points();
  Heard heard;
  Session session(arguments.in);
  listen(session, &heard);
  std::vector<Passed> passed;
  try {
    check_reach(heard, arguments, trajectory);
  } catch (const std::runtime_error& error) {
    Json json = follow_json(passed, num_way_points);
    json["why"] = error.what();
    if (arguments.json) std::cout << json.dump() << "\n";
    throw;
  }
  pose_target_t target = make_target(pose_target_t::KIND_POSITION);
  target.num_way_points = static_cast<int>(num_way_points);
  std::int64_t next_id = 0;
  std::string left;  // why the path was left
  for (std::size_t n = 0; n < num_way_points; ++n) {
    left = objection_to_leg(heard, arguments, trajectory, n);
    if (!left.empty()) break;
    target.way_point = static_cast<int>(n) + 1;
    try {
      passed.push_back(pass(session, trajectory.leg(n), target, arguments, &next_id));
    } catch (const std::runtime_error& error) {
      left = error.what();
      break;
    }
    const auto& [status, end] = passed.back();
    if (!arguments.json)
      std::cout << fmt::format("way point {} of {}: {}{} ({})\n", n + 1, num_way_points,
                               ending(end, status), status.why, course_text(status))
                << std::flush;
    if (end != End::kAsked && end != End::kMissed) break;
  }
  Json json = follow_json(passed, num_way_points);
  if (!left.empty()) json["why"] = left;
  if (arguments.json) std::cout << json.dump() << "\n";
  if (!left.empty()) std::cerr << "The path is left: " << left << "\n";
  const End end = passed.empty() ? End::kOpen : passed.back().end;
  const bool is_followed = end == End::kAsked || end == End::kMissed;
  if (session.is_in_company() && is_followed && passed.back().status.owns_arm == 1)
    std::cerr << "The arm stays there until: " << to_type("release") << "\n";
  if (!json["reached"].get<bool>()) fail();
}

}  // namespace

void add_follow_command(Arguments console) {
  auto [follow, arguments] = console.add_command(
      "follow", "Bring a body part through way points, straight from each to the next", run_follow);
  follow
      .add_option("FILE", arguments.file,
                  "CSV with x,y,z or x,y,z,qw,qx,qy,qz in the root part [m]; - is stdin")
      .required();
  follow.add_option("--in", arguments.in, "URL of the bus");
  follow.add_option("--part", arguments.part, "Body part").required().in_range(0, 9999);
  follow.add_option("--step", arguments.step_m, "Longest way between two looks [m]")
      .check(within(1e-4, 1000), "NUMBER");
  follow
      .add_option("--timeout", arguments.timeout_s,
                  "Of one step [s]; then the path is left and the arm held")
      .check(within(1e-3, kLongest_s), "NUMBER");
  follow
      .add_option("--tolerance", arguments.tolerance_m,
                  "A way point that is seen farther off [m] was missed; the path goes on")
      .check(within(1e-6, 1000), "NUMBER");
  follow.add_option("--rig", arguments.rig,
                    "Folder of the rig whose workspace is looked at beforehand; ./run follow names "
                    "that of its group");
  follow.add_flag("--json", arguments.json, "The result as JSON");
}

}  // namespace bodyschema
