#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <iostream>
#include <iterator>
#include <memory>
#include <stdexcept>
#include <vector>

#include "common/bus/bus.h"
#include "common/bus/check.h"
#include "common/geometry/angle.h"
#include "common/text/clock.h"
#include "common/text/text.h"
#include "processes/console/commands/commands.h"
#include "processes/console/commands/files.h"
#include "processes/console/commands/session.h"
#include "processes/console/hint.h"
#include "processes/console/target_follower.h"

namespace bodyschema {
namespace {

struct OperateArguments {
  std::string in = default_url();
  int part = -1;
  std::optional<int> tag;
  std::vector<double> position_m, orientation;
  double keep_s = -1;
  double timeout_s = 120;
  double tolerance_m = 0, tolerance_deg = 0;  ///< 0: by default
  bool json = false;
};

void run_target(const OperateArguments& arguments) {
  if (arguments.tag.has_value() != arguments.position_m.empty())
    refuse_argument("target", "expected --position X Y Z or --tag ID");
  if (arguments.tolerance_deg > 0 && arguments.orientation.empty())
    refuse_argument("--tolerance-deg", "without --orientation W X Y Z nothing is turned");
  pose_target_t target = make_target(arguments.tag                   ? pose_target_t::KIND_TAG
                                     : arguments.orientation.empty() ? pose_target_t::KIND_POSITION
                                                                     : pose_target_t::KIND_POSE);
  target.target_tag = arguments.tag.value_or(0);
  target.target_part = arguments.part;
  std::ranges::copy(arguments.position_m, target.position_m);
  if (!arguments.orientation.empty()) {
    const Eigen::Quaterniond q = unit_quaternion("--orientation", arguments.orientation);
    const double wxyz[] = {q.w(), q.x(), q.y(), q.z()};
    std::ranges::copy(wxyz, target.orientation_wxyz);
  }
  target.tolerance_m = arguments.tolerance_m;
  target.tolerance_rad = arguments.tolerance_deg * kDegree;
  target.expiry_s = arguments.timeout_s + kExpiryAfterTimeout_s;
  target.keep_s = arguments.keep_s;
  if (const std::string problem = check(target); !problem.empty())
    throw std::runtime_error("target: " + problem);
  Session session(arguments.in);
  TargetFollower follower(
      target, std::llround(arguments.timeout_s * 1e6),
      {.m = arguments.tolerance_m > 0 ? arguments.tolerance_m : kSeenNear_m,
       .rad = (arguments.tolerance_deg > 0 ? arguments.tolerance_deg : kSeenNear_deg) * kDegree});
  const control_status_t status = session.follow_to_end(follower, arguments.timeout_s);
  std::cout << (arguments.json ? target_json(status, follower.end()).dump()
                               : fmt::format("{}{} ({})", ending(follower.end(), status),
                                             status.why, course_text(status)))
            << "\n";
  if (follower.end() != TargetFollower::End::kAsked) fail();
  if (arguments.keep_s < 0)
    std::cerr << "The arm stays there until: " << to_type("release")
              << (arguments.tag ? "; it does not follow the tag: where that was moved, give the "
                                  "target again"
                                : "")
              << "\n";
}

void run_hold(const OperateArguments& arguments) {
  Session session(arguments.in);
  const pose_target_t target = make_target(pose_target_t::KIND_HOLD);
  TargetFollower follower(target, kPatience_us);
  const action_command_t command =
      make_console_command(action_command_t::KIND_HOLD, target.epoch, 0);
  bool is_answered = false;
  session.bus.subscribe(kMotionStatus, [&](const motion_status_t& motion) {
    is_answered |= motion.source == command.source && motion.epoch == command.epoch;
  });
  std::int64_t sent_us = -1;
  const auto tell_driver = [&](std::int64_t now_us) {
    if (is_answered || (sent_us >= 0 && now_us - sent_us < kCommandPeriod_us)) return;
    sent_us = now_us;
    session.bus.publish(kActionCommand, command);
  };
  session.follow(follower, tell_driver);
  session.turn(
      kPatience_us, [&] { return is_answered; }, tell_driver);
  const bool is_held = follower.end() == TargetFollower::End::kAsked;
  std::cout << (is_answered ? "the driver holds" : "the driver does not answer") << "; "
            << (is_held ? "the controller keeps the arm still until another target or: " +
                              to_type("release")
                        : "no controller keeps the arm still: the babbler goes on with its next "
                          "action; what latches is: " +
                              to_type("halt"))
            << "\n";
  if (!is_held || !is_answered) fail();
}

void run_release(const OperateArguments& arguments) {
  Session session(arguments.in);
  TargetFollower follower(make_target(pose_target_t::KIND_RELEASE), kPatience_us);
  session.follow(follower);
  if (follower.end() != TargetFollower::End::kAsked)
    throw std::runtime_error("release: " + follower.diagnosis());
  std::cout << "released: the babbler may move the arm\n";
}

/// @throws std::runtime_error unless MOTION_STATUS soon says what was asked for. The session hears
/// the follower from then on.
void latch(Session& session, LatchFollower& follower, const std::string& name) {
  session.bus.subscribe(kMotionStatus, [&](const auto& m) { follower.on_motion_status(m); });
  session.turn(
      kPatience_us, [&] { return follower.is_done(); },
      [&](std::int64_t now_us) {
        session.expect_company();
        if (const auto command = follower.on_tick(now_us))
          session.bus.publish(kActionCommand, *command);
      });
  if (follower.is_done()) return;
  throw std::runtime_error(
      name + (follower.has_heard_driver()
                  ? ": the driver was told for 5 s, but MOTION_STATUS does not say so"
                  : ": no MOTION_STATUS for 5 s: does the driver run, and on this bus?"));
}

void run_halt(const OperateArguments& arguments) {
  Session session(arguments.in);
  LatchFollower follower(action_command_t::KIND_STOP, wall_clock_us());
  latch(session, follower, "halt");
  std::cout << "halted, until: " << to_type("resume") << "\n";
}

void run_resume(const OperateArguments& arguments) {
  Session session(arguments.in);
  bool owns_arm = false;
  session.bus.subscribe(kControlStatus, [&](const auto& m) { owns_arm = m.owns_arm == 1; });
  LatchFollower follower(action_command_t::KIND_RESUME, wall_clock_us());
  latch(session, follower, "resume");
  // Whether the arm is the controller's is repeated at 1 Hz.
  session.turn(1'500'000, [&] { return owns_arm; });
  std::cout << "resumed; "
            << (owns_arm
                    ? "the controller holds the arm until another target or: " + to_type("release")
                    : "the babbler goes on if it is not done; a target that was dropped is "
                      "not taken up again")
            << "\n";
}

}  // namespace

void add_operate_commands(Arguments console) {
  const auto arguments = std::make_shared<OperateArguments>();
  const auto add = [&](const char* name, const char* what, auto run) {
    Arguments command = console.add_subcommand(name, what);
    command.add_option("--in", arguments->in, "URL of the bus");
    command.callback([arguments, run] { run(*arguments); });
    return command;
  };
  Arguments target = add("target", "Bring a body part to a position, a pose or a tag", run_target);
  target.add_option("--part", arguments->part, "Body part").required().in_range(0, 9999);
  Argument position = target.add_option("--position", arguments->position_m,
                                        "X Y Z of its origin in the root part [m]");
  position.expected(3).check(within(-1000, 1000), "NUMBER");
  Argument orientation = target.add_option("--orientation", arguments->orientation,
                                           "W X Y Z: unit quaternion, in the root part");
  orientation.expected(4).check(within(-1, 1), "NUMBER");
  target
      .add_option("--tag", arguments->tag,
                  "Instead of --position: to where this tag of target_tags in markers.yaml is seen")
      .in_range(0, 586)
      .excludes(position)
      .excludes(orientation);
  target
      .add_option("--keep", arguments->keep_s,
                  "Stay so long [s] before the babbler gets the arm; default: until released")
      .check(within(0, kLongest_s), "NUMBER");
  target
      .add_option("--timeout", arguments->timeout_s,
                  "Follow it for so long [s]; then it is dropped and the arm held")
      .check(within(1e-3, kLongest_s), "NUMBER");
  target
      .add_option("--tolerance", arguments->tolerance_m,
                  "Reached this near by the schema, missed if seen farther [m]; default: as "
                  "controller.yaml says, and 0.02")
      .check(within(1e-6, 1000), "NUMBER");
  target
      .add_option("--tolerance-deg", arguments->tolerance_deg,
                  "The same of the orientation; default: as controller.yaml says, and 5")
      .check(within(1e-3, 180), "NUMBER");
  target.add_flag("--json", arguments->json, "The result as JSON");
  add("hold", "Stop where the arm is; nothing moves it until another target", run_hold);
  add("release", "Give the arm back to the babbler", run_release);
  add("halt", "Stop the arm at once; latches until resume", run_halt);
  add("resume", "End a halt", run_resume);
  // Both meanings were once typed so, and one of them ends everything.
  Arguments stop = console.add_subcommand("stop", "Nothing: see halt, and ./run stop").group("");
  stop.allow_extras();
  stop.callback([] {
    refuse_argument("stop",
                    "`" + to_type("halt") + "` stops the arm; a group is ended by `./run stop`");
  });
}

}  // namespace bodyschema
