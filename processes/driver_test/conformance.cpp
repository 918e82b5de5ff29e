#include "processes/driver_test/conformance.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <cmath>
#include <optional>
#include <stdexcept>

#include "processes/driver_test/driver_probe.h"

namespace bodyschema {
namespace {

/// Long enough for one repetition at 1 Hz to come [s].
constexpr double kWatch_s = 1.5;
/// An arm that rests is this near to where it was sent, as a share of the step.
constexpr double kNear = 0.3;
/// A driver may count in other units than ours: `commanded` within this share of the range.
constexpr double kRounding = 1e-6;

/// Whether `is` lies between `from` and `to`, give or take `slack` of `scale`, in each signal.
bool is_between(const std::vector<double>& is, const std::vector<double>& from,
                const std::vector<double>& to, const std::vector<double>& scale, double slack) {
  if (is.size() != to.size()) return false;
  for (std::size_t i = 0; i < to.size(); ++i) {
    // Written so that NaN is not.
    if (!(is[i] >= std::min(from[i], to[i]) - slack * scale[i] &&
          is[i] <= std::max(from[i], to[i]) + slack * scale[i])) {
      return false;
    }
  }
  return true;
}

/// The tests of the rules of lcmtypes/DRIVER.md, each for an arm at rest that is not stopped. Some
/// build on what those before have done.
class DriverRules {
 public:
  struct Rule {
    int number;  ///< in lcmtypes/DRIVER.md
    const char* name;
    void (DriverRules::*test)();  ///< @throws RuleBroken, RuleSkipped
  };

  DriverRules(DriverProbe& probe, const ConformanceOptions& options, const ConformancePlan& plan,
              bool can_restart)
      : probe_(probe),
        signals_(options.signals.signals),
        here_(plan.here),
        there_(plan.there),
        can_restart_(can_restart),
        first_utime_(probe.newest().utime) {
    for (const Signal& signal : signals_) ranges_.push_back(signal.upper - signal.lower);
    for (std::size_t i = 0; i < here_.size(); ++i) steps_.push_back(std::abs(there_[i] - here_[i]));
  }

  /// Ascending; rule 3 (time never runs backwards) is watched throughout and none of them.
  static const std::vector<Rule>& all() {
    using R = DriverRules;
    static const std::vector<Rule> kRules = {
        {1, "every command is answered", &R::every_command_is_answered},
        {2, "a MOVE is accepted, moves, settles", &R::a_move_settles},
        {4, "MOTION_STATUS is repeated at 1 Hz, without refusals", &R::status_is_repeated},
        {5, "what cannot be is rejected", &R::the_impossible_is_rejected},
        {6, "one motion at a time", &R::one_motion_at_a_time},
        {7, "what has expired is not carried out", &R::the_expired_is_refused},
        {8, "no command is carried out twice", &R::no_command_twice},
        {9, "every source has its own ids", &R::every_source_has_its_ids},
        {10, "HOLD is served at rest", &R::hold_at_rest},
        {11, "HOLD ends a motion", &R::hold_ends_a_motion},
        {12, "STOP latches", &R::stop_latches},
        {13, "STOP ends a motion, and nothing takes it up again", &R::stop_ends_a_motion},
        {14, "RESUME clears the latch and moves nothing", &R::resume_clears_the_latch},
        {15, "a restart ends a motion, and nothing takes it up again", &R::restart_ends_a_motion},
        {16, "what was sent before the start is not carried out", &R::the_past_is_refused},
        {17, "a STOP outlives the driver", &R::stop_outlives_the_driver}};
    return kRules;
  }

 private:
  using Command = action_command_t;
  using Status = motion_status_t;

  void every_command_is_answered() {
    const Command command = probe_.move(there_);
    const Status answer = probe_.ask(command);
    expect(answer.kind == command.kind && answer.purpose == command.purpose,
           "kind and purpose of the command", answer);
    probe_.life(command);
  }

  void a_move_settles() {
    const Command command = probe_.move(here_);
    probe_.ask(command);
    const std::vector<Status> said = probe_.life(command);
    int progress = -1;
    for (const Status& status : said) {
      const bool is_known = status.state == Status::STATE_ACCEPTED ||
                            status.state == Status::STATE_MOVING ||
                            status.state == Status::STATE_SETTLED;
      expect(is_known && status.state >= progress, "ACCEPTED, MOVING, SETTLED", status);
      progress = status.state;
      expect(is_between(status.commanded, here_, here_, ranges_, kRounding),
             "`commanded` as the action", status);
      expect(status.state != Status::STATE_MOVING || status.rest_since_utime == -1,
             "rest_since_utime -1 while it moves", status);
    }
    expect(std::any_of(said.begin(), said.end(),
                       [](const Status& s) { return s.state == Status::STATE_MOVING; }),
           "MOVING before SETTLED", said.front());
    const Status& settled = said.back();
    expect(
        settled.rest_since_utime >= said.front().utime && settled.rest_since_utime <= settled.utime,
        fmt::format("rest_since_utime within the motion's {} … {}", said.front().utime,
                    settled.utime),
        settled);
  }

  void status_is_repeated() {
    probe_.settle(there_);
    const Status rest = probe_.newest();
    Command wrong = probe_.move(here_);
    wrong.action[0] = signals_[0].upper + 1;
    probe_.ask(wrong);
    probe_.watch(0.3);
    const std::vector<Status> came = probe_.expect_unmoved(rest, 3.2);
    if (came.size() < 2) throw RuleBroken{fmt::format("{} statuses in 3.2 s", came.size())};
    for (const Status& status : came) {
      expect(status.action_id == rest.action_id && status.state == rest.state,
             "the settled MOVE repeated, not the refused one", status);
    }
  }

  void the_impossible_is_rejected() {
    std::vector<double> action = here_;
    action.push_back(0);
    probe_.expect_refused(refused_move_.emplace(probe_.move(action)), Status::STATE_REJECTED);
    if (here_.size() > 1) {
      action.resize(here_.size() - 1);
      probe_.expect_refused(probe_.move(action), Status::STATE_REJECTED);
    }
    for (std::size_t i = 0; i < signals_.size(); ++i) {
      const double beyond = 0.01 * ranges_[i];
      for (const double value : {signals_[i].lower - beyond, signals_[i].upper + beyond}) {
        action = here_;
        action[i] = value;
        probe_.expect_refused(probe_.move(action), Status::STATE_REJECTED);
      }
    }
  }

  void one_motion_at_a_time() {
    probe_.settle(here_);
    const Command motion = probe_.begin_motion(there_);
    const std::size_t from = probe_.num_heard();
    const Status answer = probe_.ask(probe_.move(here_, DriverProbe::kOtherSource));
    expect(answer.state == Status::STATE_REJECTED && !answer.reason.empty(),
           "REJECTED with a reason", answer);
    const Status end = probe_.life(motion, from).back();
    expect(end.state == Status::STATE_SETTLED, "the first motion SETTLED", end);
  }

  void the_expired_is_refused() {
    Command late = probe_.move(here_);
    late.expiry_utime = probe_.newest().utime - 1;
    probe_.expect_refused(late, Status::STATE_EXPIRED);
  }

  void no_command_twice() {
    const Command first = probe_.move(there_);
    probe_.ask(first);
    Status end = probe_.life(first).back();
    expect(end.state == Status::STATE_SETTLED, "SETTLED", end);
    Status again = probe_.ask(first);
    expect(again.state == Status::STATE_SETTLED && again.rest_since_utime == end.rest_since_utime,
           "SETTLED as before", again);
    end = probe_.settle(here_);
    again = probe_.ask(first);
    expect(again.state == Status::STATE_STOPPED && !again.reason.empty(),
           "STOPPED with a reason: the arm has moved on", again);
    expect(again.rest_since_utime == end.rest_since_utime, "the arm at rest", again);
    probe_.expect_unmoved(end, kWatch_s);
    if (refused_move_) probe_.expect_refused(*refused_move_, Status::STATE_REJECTED);
  }

  void every_source_has_its_ids() {
    probe_.settle(here_);
    probe_.settle(there_, DriverProbe::kOtherSource);
    Command other_epoch = probe_.move(here_, DriverProbe::kOtherSource);
    other_epoch.action_id = 0;
    other_epoch.epoch += 1;
    const Status answer = probe_.ask(other_epoch);
    expect(answer.state == Status::STATE_ACCEPTED || answer.state == Status::STATE_MOVING,
           "ACCEPTED", answer);
    const Status end = probe_.life(other_epoch).back();
    expect(end.state == Status::STATE_SETTLED, "SETTLED", end);
  }

  void hold_at_rest() {
    probe_.settle(there_);
    const Command hold = probe_.make(Command::KIND_HOLD);
    const Status answer = probe_.ask(hold);
    expect(answer.state == Status::STATE_HOLDING, "HOLDING", answer);
    const Status held = probe_.await_rest([&](const Status& s) { return is_answer(s, hold); });
    expect(held.commanded.size() == there_.size(), "where it holds, in `commanded`", held);
    if (!is_between(held.commanded, there_, there_, steps_, kNear)) {
      throw RuleBroken{
          fmt::format("it says that it holds at {}, but it settled at {}", held.commanded, there_)};
    }
    probe_.settle(here_);
  }

  void hold_ends_a_motion() {
    probe_.settle(here_);
    end_motion(Command::KIND_HOLD);
    probe_.settle(there_);
  }

  void stop_latches() {
    const Status answer = probe_.ask(probe_.make(Command::KIND_STOP));
    expect(answer.state == Status::STATE_STOPPED && !answer.reason.empty(), "STOPPED with a reason",
           answer);
    expect(answer.stop_latched == 1, "stop_latched 1", answer);
    probe_.await_rest();
    const Status refused = probe_.ask(probe_.move(here_));
    expect(refused.state == Status::STATE_REJECTED && !refused.reason.empty(),
           "REJECTED with a reason", refused);
    const Status held = probe_.ask(probe_.make(Command::KIND_HOLD));
    expect(held.state == Status::STATE_HOLDING, "HOLDING", held);
    for (const Status& status : probe_.watch(kWatch_s)) {
      expect(status.stop_latched == 1, "stop_latched 1 until RESUME", status);
    }
  }

  void stop_ends_a_motion() {
    probe_.settle(here_);
    end_motion(Command::KIND_STOP);
    const Status resumed = probe_.ask(probe_.make(Command::KIND_RESUME));
    probe_.expect_unmoved(resumed, 2 * kWatch_s);
    probe_.settle(here_);
  }

  void resume_clears_the_latch() {
    probe_.ask(probe_.make(Command::KIND_STOP));
    const Status rest = probe_.await_rest([](const Status& s) { return s.stop_latched == 1; });
    const Status answer = probe_.ask(probe_.make(Command::KIND_RESUME));
    expect(answer.state == Status::STATE_IDLE && answer.stop_latched == 0,
           "IDLE with stop_latched 0", answer);
    for (const Status& status : probe_.expect_unmoved(rest, kWatch_s)) {
      expect(status.stop_latched == 0, "stop_latched 0", status);
    }
    probe_.settle(there_);
  }

  void restart_ends_a_motion() {
    require_restart();
    probe_.settle(here_);
    std::optional<Command> motion;
    try {
      motion = probe_.begin_motion(there_);
    } catch (const RuleSkipped&) {
      // Tested as far as that goes.
    }
    probe_.restart();
    const Status rest = probe_.await_rest();
    if (!motion) {
      probe_.expect_unmoved(rest, kWatch_s);
      throw RuleSkipped{"the motion took no time; the arm was at rest after the restart"};
    }
    const Status answer = probe_.ask(*motion);
    expect((answer.state == Status::STATE_STOPPED && !answer.reason.empty()) ||
               answer.state == Status::STATE_SETTLED,
           "STOPPED with a reason", answer);
    probe_.expect_unmoved(rest, 2 * kWatch_s);
  }

  void the_past_is_refused() {
    require_restart();
    probe_.restart();
    probe_.await_rest();
    Command old = probe_.move(here_);
    old.utime = first_utime_;
    probe_.expect_refused(old, Status::STATE_EXPIRED);
    probe_.settle(here_);
  }

  void stop_outlives_the_driver() {
    require_restart();
    probe_.ask(probe_.make(Command::KIND_STOP));
    probe_.restart();
    const Status rest = probe_.await_rest();
    expect(rest.stop_latched == 1, "stop_latched 1", rest);
    const Status refused = probe_.ask(probe_.move(there_));
    expect(refused.state == Status::STATE_REJECTED, "REJECTED", refused);
  }

  /// HOLD or STOP in the middle of a motion from `here_` to `there_`.
  void end_motion(std::int8_t kind) {
    const Command motion = probe_.begin_motion(there_);
    const Command end = probe_.make(kind);
    const bool is_hold = kind == Command::KIND_HOLD;
    const std::int8_t state = is_hold ? Status::STATE_HOLDING : Status::STATE_STOPPED;
    const std::size_t sent_at = probe_.num_heard();
    const Status answer = probe_.ask(end);
    expect(answer.state == state, name_of_motion_state(state), answer);
    const Status motion_end = probe_.life(motion, sent_at).back();
    expect(motion_end.state == Status::STATE_STOPPED && !motion_end.reason.empty(),
           "the MOVE STOPPED with a reason", motion_end);
    const Status rest = probe_.await_rest([&](const Status& s) { return is_answer(s, end); });
    expect(rest.state == state, name_of_motion_state(state), rest);
    if (!is_hold) return;
    expect(rest.commanded.size() == there_.size(), "where it holds, in `commanded`", rest);
    if (!is_between(rest.commanded, here_, there_, steps_, kNear)) {
      throw RuleBroken{
          fmt::format("it says that it holds at {}, which is not on the way from {} to {}",
                      rest.commanded, here_, there_)};
    }
  }

  void require_restart() const {
    if (!can_restart_) throw RuleSkipped{"neither --restart nor --kill is given"};
  }

  DriverProbe& probe_;
  const std::vector<Signal>& signals_;
  const std::vector<double> here_, there_;
  std::vector<double> ranges_, steps_;  ///< per signal: of the limits, from here_ to there_
  const bool can_restart_;
  const std::int64_t first_utime_;
  std::optional<Command> refused_move_;
};

void test_rule(DriverRules& rules, const DriverRules::Rule& rule, RuleResult& result) {
  try {
    (rules.*rule.test)();
  } catch (const RuleBroken& broken) {
    result.outcome = RuleResult::Outcome::kFailed;
    result.note = broken.note;
  } catch (const RuleSkipped& skipped) {
    result.outcome = RuleResult::Outcome::kSkipped;
    result.note = skipped.note;
  }
}

}  // namespace

ConformancePlan plan_conformance(const DriverLink& link, const ConformanceOptions& options) {
  using Status = motion_status_t;
  DriverProbe probe(link, options);
  const auto first = probe.await(0, 5, [](const Status&) { return true; });
  if (!first) {
    throw std::runtime_error(
        "no MOTION_STATUS within 5 s: does the driver run, and on this bus (--in)?");
  }
  if (first->stop_latched) {
    throw std::runtime_error("the driver is stopped: RESUME it first, once the arm is clear");
  }
  const auto rest =
      probe.await(0, options.motion_s, [](const Status& s) { return s.rest_since_utime >= 0; });
  if (!rest) {
    throw std::runtime_error(fmt::format("the arm does not come to rest within {} s; {}",
                                         options.motion_s, text_of(probe.newest())));
  }
  // HOLD moves nothing and says where the arm is.
  action_command_t hold = probe.make(action_command_t::KIND_HOLD);
  hold.epoch -= 1;
  probe.send(hold);
  const auto held = probe.await(0, options.answer_s, [&](const Status& s) {
    return is_answer(s, hold) && s.rest_since_utime >= 0;
  });
  const std::vector<Signal>& signals = options.signals.signals;
  ConformancePlan plan;
  plan.is_from_middle = !held || held->commanded.size() != signals.size();
  for (std::size_t i = 0; i < signals.size(); ++i) {
    const double range = signals[i].upper - signals[i].lower;
    const double middle = 0.5 * (signals[i].lower + signals[i].upper);
    const double here = plan.is_from_middle ? middle : held->commanded[i];
    plan.here.push_back(std::clamp(here, signals[i].lower, signals[i].upper));
    plan.there.push_back(plan.here[i] +
                         (plan.here[i] > middle ? -1 : 1) * options.step_share * range);
  }
  return plan;
}

std::vector<RuleResult> test_conformance(const DriverLink& link, const ConformanceOptions& options,
                                         const ConformancePlan& plan,
                                         const std::function<void(const std::string&)>& progress) {
  using Outcome = RuleResult::Outcome;
  DriverProbe probe(link, options);
  if (!probe.await(0, 5, [](const motion_status_t&) { return true; })) {
    throw std::runtime_error("the driver fell silent before the test began");
  }
  DriverRules rules(probe, options, plan, link.restart != nullptr);
  std::vector<RuleResult> results;
  bool is_ready = true;
  int blamed = 0;
  for (const DriverRules::Rule& rule : DriverRules::all()) {
    RuleResult& result = results.emplace_back(RuleResult{rule.number, rule.name, Outcome::kOk, ""});
    if (is_ready && !probe.recover()) {
      is_ready = false;
      blamed = probe.newest().stop_latched ? 14 : rule.number;
    }
    if (!is_ready) {
      const bool is_blamed = blamed == rule.number;
      result.outcome = is_blamed ? Outcome::kFailed : Outcome::kSkipped;
      result.note =
          (is_blamed ? "expected the arm at rest after RESUME, came " : "the arm is not ready: ") +
          text_of(probe.newest());
      continue;
    }
    if (progress) progress(fmt::format("{:2} {}", rule.number, rule.name));
    test_rule(rules, rule, result);
  }
  if (is_ready) probe.recover();
  RuleResult time{3, "time never runs backwards", Outcome::kOk, ""};
  if (probe.time_ran_backwards()) {
    time.outcome = Outcome::kFailed;
    time.note = *probe.time_ran_backwards();
  }
  results.insert(results.begin() + 2, time);
  return results;
}

}  // namespace bodyschema
