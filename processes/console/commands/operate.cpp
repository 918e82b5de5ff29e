#include <fmt/format.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdlib>
#include <functional>
#include <iostream>
#include <memory>
#include <stdexcept>
#include <vector>

#include "common/bus/bus.h"
#include "common/bus/check.h"
#include "common/text/clock.h"
#include "common/text/text.h"
#include "processes/console/commands/commands.h"
#include "processes/console/hint.h"
#include "processes/console/interruption.h"
#include "processes/console/target_follower.h"

namespace bodyschema {
namespace {

constexpr std::int64_t kPatience_us = 5'000'000;  // for what is answered at once
constexpr std::int64_t kAlone_us = 2'500'000;     // twice what the processes of a group repeat in

/// A terminal gets a line that rewrites itself, a file a line for each change.
class ProgressLine {
 public:
  ~ProgressLine() {
    if (is_terminal_ && !shown_.empty()) std::cerr << "\r\x1b[2K" << std::flush;
  }
  void show(const std::string& line) {
    if (line == shown_) return;
    shown_ = line;
    std::cerr << (is_terminal_ ? in_place(line, STDERR_FILENO) : line + "\n") << std::flush;
  }

 private:
  const bool is_terminal_ = isatty(STDERR_FILENO) == 1;
  std::string shown_;
};

pose_target_t make_target(std::int8_t kind) {
  pose_target_t target{};
  target.utime = target.epoch = wall_clock_us();
  target.sender = kConsole;
  target.target_kind = kind;
  target.target_part = -1;
  target.keep_s = -1;
  return target;
}

struct OperateArguments {
  std::string in = default_url();
  int part = -1;
  std::vector<double> position_m;
  double keep_s = -1;
  double timeout_s = 120;
  double tolerance_m = 0.02;
  bool json = false;
};

/// Nobody waits longer; microseconds of it are far from overflow [s].
constexpr double kLongest_s = 1e7;

/// CLI::Range lets "nan" pass.
std::function<std::string(const std::string&)> within(double lowest, double highest) {
  return [=](const std::string& text) {
    char* end = nullptr;
    const auto value = static_cast<double>(std::strtold(text.c_str(), &end));
    const bool is_number = !text.empty() && *end == '\0';
    return is_number && value >= lowest && value <= highest
               ? std::string()
               : fmt::format("expected a number within {} … {}, found '{}'", lowest, highest,
                             abbreviated(text));
  };
}

/// The result is on stdout; exit code 1.
[[noreturn]] void fail() {
  if (!std::cout.flush()) throw std::runtime_error("stdout: the result could not be written");
  end_as_failed();
}

/// The bus of a command that somebody must answer: whoever lives there says so once a second.
class Session {
 public:
  explicit Session(const std::string& url) : bus(url, url), url_(url) {
    catch_interruption();
    for_anybody(kProcessInfo);
    for_anybody(kMotionStatus);
    for_anybody(kControlStatus);
  }

  /// Turns the bus until `is_done` or Ctrl-C, at most for so long; `on_turn` gets the clock.
  void turn(std::int64_t most_us, const std::function<bool()>& is_done,
            const std::function<void(std::int64_t)>& on_turn = nullptr) {
    const std::int64_t end_us = clock_us() + most_us;
    while (!is_done() && clock_us() < end_us && !is_interrupted()) {
      if (on_turn) on_turn(clock_us());
      bus.handle(kTurn);
    }
  }

  /// Shows the follower's progress until it has come to an end; `on_turn` on every turn.
  void follow(TargetFollower& follower,
              const std::function<void(std::int64_t)>& on_turn = nullptr) {
    bus.subscribe(kControlStatus, [&](const auto& m) { follower.on_control_status(m); });
    bus.subscribe(kProcessInfo, [&](const auto& m) { follower.on_process_info(m); });
    bus.subscribe(kMotionStatus, [&](const auto& m) { follower.on_motion_status(m); });
    ProgressLine line;
    while (follower.end() == TargetFollower::End::kOpen) {
      expect_company();
      if (is_interrupted()) follower.interrupt();
      if (const auto target = follower.on_tick(clock_us())) bus.publish(kPoseTarget, *target);
      if (on_turn) on_turn(clock_us());
      line.show(follower.progress());
      bus.handle(kTurn);
    }
  }

  /// @throws std::runtime_error with what to type once nobody can be there.
  void expect_company() const {
    if (is_heard_ || clock_us() - start_us_ < kAlone_us) return;
    throw std::runtime_error(
        "nothing is heard on " + url_ +
        ": no group runs there. ./run --keep starts one, ./run exec bodyschema "
        "… speaks to one that runs");
  }

  Bus bus;

 private:
  static constexpr std::chrono::milliseconds kTurn{50};

  template <class Message>
  void for_anybody(const Channel<Message>& channel) {
    bus.subscribe(channel, [this](const Message&) { is_heard_ = true; });
  }

  const std::string url_;
  const std::int64_t start_us_ = clock_us();
  bool is_heard_ = false;
};

/// Makes the controller drop what `follower` follows no longer; says what became of it.
std::string withdraw(Session& session, const TargetFollower& follower) {
  clear_interruption();  // a second Ctrl-C ends this too
  const pose_target_t withdrawal = follower.withdrawal();
  TargetFollower dropped(withdrawal, kPatience_us);
  session.follow(dropped);
  switch (dropped.end()) {
    case TargetFollower::End::kAsked:
      return withdrawal.target_kind == pose_target_t::KIND_HOLD
                 ? "the target was dropped: the arm is held until another target or: " +
                       to_type("release")
                 : "the target was dropped: the arm is the babbler's";
    case TargetFollower::End::kRefused:
      return dropped.status().why;
    default:
      return "the controller does not say that it dropped the target, so the arm may move; it is "
             "stopped by: " +
             to_type("halt");
  }
}

/// How a target ended, before the controller's own words, which begin with "reached".
const char* ending(TargetFollower::End end, const control_status_t& status) {
  if (end == TargetFollower::End::kAsked) return "";
  if (end == TargetFollower::End::kMissed) return "missed: ";
  if (status.control_state == control_status_t::CONTROL_HOLDING) return "held: ";
  return status.control_state == control_status_t::CONTROL_REFUSED ? "refused: " : "not reached: ";
}

void run_target(const OperateArguments& arguments) {
  pose_target_t target = make_target(pose_target_t::KIND_POSITION);
  target.target_part = arguments.part;
  std::copy(arguments.position_m.begin(), arguments.position_m.end(), target.position_m);
  target.keep_s = arguments.keep_s;
  if (const std::string problem = check(target); !problem.empty())
    throw std::runtime_error("target: " + problem);
  Session session(arguments.in);
  TargetFollower follower(target, std::llround(arguments.timeout_s * 1e6), arguments.tolerance_m);
  session.follow(follower);
  control_status_t status = follower.status();
  if (follower.end() == TargetFollower::End::kInterrupted)
    status.why = "interrupted; " + withdraw(session, follower);
  if (follower.end() == TargetFollower::End::kTimedOut)
    status.why = fmt::format("no end within {} s; {}; {}", arguments.timeout_s,
                             follower.diagnosis(), withdraw(session, follower));
  std::cout << (arguments.json ? target_json(status, follower.end())
                               : fmt::format("{}{} ({})", ending(follower.end(), status),
                                             status.why, course_text(status)))
            << "\n";
  if (follower.end() != TargetFollower::End::kAsked) fail();
  if (arguments.keep_s < 0)
    std::cerr << "The arm stays there until: " << to_type("release") << "\n";
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
  Arguments target = add("target", "Bring a body part to a position", run_target);
  target.add_option("--part", arguments->part, "Body part").required().in_range(0, 9999);
  target.add_option("--position", arguments->position_m, "X Y Z of its origin in the root part [m]")
      .required()
      .expected(3)
      .check(within(-1000, 1000), "NUMBER");
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
                  "Seen farther than this from the target [m], it was missed")
      .check(within(1e-6, 1000), "NUMBER");
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
