#include "processes/console/conformance.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <stdexcept>

#include "common/bus/convert.h"

namespace bodyschema {
namespace {

using Command = action_command_t;
using Status = motion_status_t;

constexpr char kSource[] = "driver-test";
constexpr char kOtherSource[] = "driver-test-2";
/// A motion that ends sooner than this after its command cannot be interrupted [s].
constexpr double kNoTime_s = 0.15;
/// Long enough for one repetition at 1 Hz to come [s].
constexpr double kWatch_s = 1.5;

struct Failed {
  std::string note;
};
struct Skipped {
  std::string note;
};

const char* name_of_state(std::int8_t state) {
  constexpr const char* kNames[] = {"IDLE",     "ACCEPTED", "MOVING",  "SETTLED",
                                    "REJECTED", "STOPPED",  "EXPIRED", "HOLDING"};
  return state >= 0 && state < 8 ? kNames[state] : "an unknown state";
}

std::string text_of(const Status& status) {
  return fmt::format("{}{} (id {} of {}, rest since {}, latched {})", name_of_state(status.state),
                     status.reason.empty() ? "" : ": " + status.reason, status.action_id,
                     status.source.empty() ? "nobody" : status.source, status.rest_since_utime,
                     int{status.stop_latched});
}

std::string text_of(const std::optional<Status>& status) {
  return status ? text_of(*status) : "nothing";
}

bool is_answer(const Status& status, const Command& command) {
  return status.source == command.source && status.epoch == command.epoch &&
         status.action_id == command.action_id;
}

class Tester {
 public:
  Tester(const DriverLink& link, const ConformanceOptions& options)
      : link_(link), options_(options) {}

  const Status& newest() const { return heard_.back(); }
  bool has_heard() const { return !heard_.empty(); }

  /// The first status from index `from` on that `wanted` likes; waits for it.
  std::optional<Status> await(std::size_t from, double seconds,
                              const std::function<bool(const Status&)>& wanted) {
    const double end_s = link_.now_s() + seconds;
    for (std::size_t i = from;;) {
      for (; i < heard_.size(); ++i) {
        if (wanted(heard_[i])) return heard_[i];
      }
      const double left_s = end_s - link_.now_s();
      if (left_s <= 0) return std::nullopt;
      listen(std::min(left_s, 0.1));
    }
  }

  /// All that comes within `seconds`.
  std::vector<Status> watch(double seconds) {
    const std::size_t from = heard_.size();
    const double end_s = link_.now_s() + seconds;
    while (link_.now_s() < end_s) listen(std::min(0.1, end_s - link_.now_s()));
    return {heard_.begin() + from, heard_.end()};
  }

  Command make(std::int8_t kind, const std::string& source = kSource,
               std::vector<double> action = {}) {
    Command command{};
    command.utime = newest().utime;
    command.source = source;
    command.epoch = options_.epoch;
    command.action_id = source == kSource ? next_id_++ : next_other_id_++;
    command.kind = kind;
    command.purpose = Command::PURPOSE_CONTROL;
    command.expiry_utime = newest().utime + 3'600'000'000;
    set_array(command.num_signals, command.action, std::move(action));
    return command;
  }
  Command move(const std::vector<double>& action, const std::string& source = kSource) {
    return make(Command::KIND_MOVE, source, action);
  }

  /// Sends and waits for the first answer.
  Status ask(const Command& command) {
    sent_at_ = heard_.size();
    sent_s_ = link_.now_s();
    link_.send(command);
    const auto answer =
        await(sent_at_, options_.answer_s, [&](const Status& s) { return is_answer(s, command); });
    if (!answer) {
      throw Failed{fmt::format("no answer within {} s to id {} of {}", options_.answer_s,
                               command.action_id, command.source)};
    }
    return *answer;
  }

  /// Index of the first status after the last ask(), and its time.
  std::size_t sent_at() const { return sent_at_; }
  double sent_s() const { return sent_s_; }
  double now_s() const { return link_.now_s(); }

  /// Waits for the end of a MOVE; what was said of it from index `from` on.
  std::vector<Status> life(const Command& command, std::size_t from) {
    const auto end = await(from, options_.motion_s, [&](const Status& s) {
      return is_answer(s, command) && s.state != Status::STATE_ACCEPTED &&
             s.state != Status::STATE_MOVING;
    });
    if (!end) {
      throw Failed{fmt::format("the motion did not end within {} s; the newest status is {}",
                               options_.motion_s, text_of(newest()))};
    }
    std::vector<Status> said;
    for (std::size_t i = from; i < heard_.size(); ++i) {
      if (is_answer(heard_[i], command)) said.push_back(heard_[i]);
    }
    return said;
  }

  /// A MOVE that must succeed.
  Status settle(const std::vector<double>& action, const std::string& source = kSource) {
    const Command command = move(action, source);
    ask(command);
    const Status end = life(command, sent_at_).back();
    expect(end.state == Status::STATE_SETTLED, "SETTLED", end);
    return end;
  }

  Status await_rest(const std::function<bool(const Status&)>& also) {
    const auto rest = await(heard_.size() - 1, options_.motion_s,
                            [&](const Status& s) { return s.rest_since_utime >= 0 && also(s); });
    if (!rest) {
      throw Failed{fmt::format("not at rest within {} s; the newest status is {}",
                               options_.motion_s, text_of(newest()))};
    }
    return *rest;
  }

  static void expect(bool is_so, const std::string& expected, const std::optional<Status>& came) {
    if (!is_so) throw Failed{"expected " + expected + ", came " + text_of(came)};
  }

  /// For `seconds` no status says that the arm left this rest.
  std::vector<Status> expect_unmoved(const Status& rest, double seconds) {
    const std::vector<Status> came = watch(seconds);
    for (const Status& status : came) {
      expect(status.rest_since_utime == rest.rest_since_utime,
             fmt::format("the arm at rest since {}", rest.rest_since_utime), status);
    }
    return came;
  }

  void expect_refused(const Command& command, std::int8_t state) {
    const Status before = newest();
    const Status answer = ask(command);
    expect(answer.state == state && !answer.reason.empty(),
           std::string(name_of_state(state)) + " with a reason", answer);
    expect(answer.rest_since_utime == before.rest_since_utime,
           fmt::format("the arm at rest since {}", before.rest_since_utime), answer);
    expect_unmoved(before, 0.3);
  }

  void restart() {
    link_.restart();
    const std::size_t from = heard_.size();
    if (!await(from, options_.restart_s, [](const Status&) { return true; })) {
      throw Failed{fmt::format("no MOTION_STATUS within {} s of the restart", options_.restart_s)};
    }
  }

  /// Ready for the next rule, whatever the last one left behind. False if the arm will not rest.
  bool recover() {
    if (newest().stop_latched) link_.send(make(Command::KIND_RESUME));
    return await(heard_.size() - 1, options_.motion_s,
                 [](const Status& s) { return s.rest_since_utime >= 0 && !s.stop_latched; })
        .has_value();
  }

  const std::optional<std::string>& time_ran_backwards() const { return time_ran_backwards_; }
  std::size_t num_heard() const { return heard_.size(); }
  const Status& heard(std::size_t i) const { return heard_[i]; }

 private:
  void listen(double seconds) {
    for (const Status& status : link_.receive(seconds)) {
      if (!heard_.empty() && status.utime < newest().utime && !time_ran_backwards_) {
        time_ran_backwards_ = fmt::format("utime {} came after {}", status.utime, newest().utime);
      }
      const bool is_ours = status.source == kSource || status.source == kOtherSource;
      if (!is_ours && has_heard() &&
          (status.state == Status::STATE_ACCEPTED || status.state == Status::STATE_MOVING)) {
        throw std::runtime_error(status.source +
                                 " moves the arm: end it, the test must be alone with the driver");
      }
      heard_.push_back(status);
    }
  }

  const DriverLink& link_;
  const ConformanceOptions& options_;
  std::vector<Status> heard_;
  std::int64_t next_id_ = 0, next_other_id_ = 0;
  std::size_t sent_at_ = 0;
  double sent_s_ = 0;
  std::optional<std::string> time_ran_backwards_;
};

/// Begins a motion and returns while it goes on. @throws Skipped where there is no such moment.
Command begin_motion(Tester& tester, const std::vector<double>& action) {
  const Command command = tester.move(action);
  tester.ask(command);
  const auto next = tester.await(tester.sent_at(), 10, [&](const Status& s) {
    return is_answer(s, command) && s.state != Status::STATE_ACCEPTED;
  });
  Tester::expect(next && next->state == Status::STATE_MOVING, "MOVING", next);
  // In lock-step everything has been said by now.
  const auto end = tester.await(
      tester.sent_at(), kNoTime_s - (tester.now_s() - tester.sent_s()),
      [&](const Status& s) { return is_answer(s, command) && s.state == Status::STATE_SETTLED; });
  if (end) throw Skipped{"the motion took no time"};
  return command;
}

/// An arm that rests is this near to where it was sent, as a share of the step.
constexpr double kNear = 0.3;

std::vector<double> step_of(const std::vector<double>& from, const std::vector<double>& to) {
  std::vector<double> step;
  for (std::size_t i = 0; i < to.size(); ++i) step.push_back(std::abs(to[i] - from[i]));
  return step;
}

/// Whether `is` lies between `from` and `to`, give or take `slack` of `step`, in each signal.
bool is_between(const std::vector<double>& is, const std::vector<double>& from,
                const std::vector<double>& to, const std::vector<double>& step, double slack) {
  if (is.size() != to.size()) return false;
  for (std::size_t i = 0; i < to.size(); ++i) {
    // Written so that NaN is not.
    if (!(is[i] >= std::min(from[i], to[i]) - slack * step[i] &&
          is[i] <= std::max(from[i], to[i]) + slack * step[i])) {
      return false;
    }
  }
  return true;
}

/// HOLD or STOP in the middle of a motion.
void end_motion(Tester& tester, std::int8_t kind, const std::vector<double>& from,
                const std::vector<double>& to) {
  const Command motion = begin_motion(tester, to);
  const Command end = tester.make(kind);
  const std::int8_t state =
      kind == Command::KIND_HOLD ? Status::STATE_HOLDING : Status::STATE_STOPPED;
  const std::size_t sent_at = tester.num_heard();
  const Status answer = tester.ask(end);
  Tester::expect(answer.state == state, name_of_state(state), answer);
  const Status motion_end = tester.life(motion, sent_at).back();
  Tester::expect(motion_end.state == Status::STATE_STOPPED && !motion_end.reason.empty(),
                 "the MOVE STOPPED with a reason", motion_end);
  const Status rest = tester.await_rest([&](const Status& s) { return is_answer(s, end); });
  Tester::expect(rest.state == state, name_of_state(state), rest);
  if (kind != Command::KIND_HOLD) return;
  Tester::expect(rest.commanded.size() == to.size(), "where it holds, in `commanded`", rest);
  if (!is_between(rest.commanded, from, to, step_of(from, to), kNear)) {
    throw Failed{fmt::format("it says that it holds at {}, which is not on the way from {} to {}",
                             rest.commanded, from, to)};
  }
}

struct Rule {
  int number;
  std::string name;
  std::function<void()> test;
};

}  // namespace

ConformancePlan plan_conformance(const DriverLink& link, const ConformanceOptions& options) {
  Tester tester(link, options);
  const auto first = tester.await(0, 5, [](const Status&) { return true; });
  if (!first) {
    throw std::runtime_error(
        "no MOTION_STATUS within 5 s: does the driver run, and on this bus (--in)?");
  }
  if (first->stop_latched) {
    throw std::runtime_error("the driver is stopped: RESUME it first, once the arm is clear");
  }
  const auto rest =
      tester.await(0, options.motion_s, [](const Status& s) { return s.rest_since_utime >= 0; });
  if (!rest) {
    throw std::runtime_error(fmt::format("the arm does not come to rest within {} s; {}",
                                         options.motion_s, text_of(tester.newest())));
  }
  // HOLD moves nothing and says where the arm is.
  Command hold = tester.make(Command::KIND_HOLD);
  hold.epoch -= 1;
  link.send(hold);
  const auto held = tester.await(0, options.answer_s, [&](const Status& s) {
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
  Tester t(link, options);
  const std::vector<double>& here = plan.here;
  const std::vector<double>& there = plan.there;
  const std::vector<Signal>& signals = options.signals.signals;
  const auto expect = &Tester::expect;
  std::vector<double> ranges;
  for (const Signal& signal : signals) ranges.push_back(signal.upper - signal.lower);
  std::int64_t first_utime = 0;
  std::optional<Command> refused_move;

  const std::vector<Rule> rules = {
      {1, "every command is answered",
       [&] {
         const Command command = t.move(there);
         const Status answer = t.ask(command);
         expect(answer.kind == command.kind && answer.purpose == command.purpose,
                "kind and purpose of the command", answer);
         t.life(command, t.sent_at());
       }},
      {2, "a MOVE is accepted, moves, settles",
       [&] {
         const Command command = t.move(here);
         t.ask(command);
         const std::vector<Status> said = t.life(command, t.sent_at());
         int progress_so_far = -1;
         for (const Status& status : said) {
           const bool is_known = status.state == Status::STATE_ACCEPTED ||
                                 status.state == Status::STATE_MOVING ||
                                 status.state == Status::STATE_SETTLED;
           expect(is_known && status.state >= progress_so_far, "ACCEPTED, MOVING, SETTLED", status);
           progress_so_far = status.state;
           // A driver may count in other units than ours.
           expect(is_between(status.commanded, here, here, ranges, 1e-6),
                  "`commanded` as the action", status);
           expect(status.state != Status::STATE_MOVING || status.rest_since_utime == -1,
                  "rest_since_utime -1 while it moves", status);
         }
         expect(std::any_of(said.begin(), said.end(),
                            [](const Status& s) { return s.state == Status::STATE_MOVING; }),
                "MOVING before SETTLED", said.front());
         const Status& settled = said.back();
         expect(settled.rest_since_utime >= said.front().utime &&
                    settled.rest_since_utime <= settled.utime,
                fmt::format("rest_since_utime within the motion's {} … {}", said.front().utime,
                            settled.utime),
                settled);
       }},
      {4, "MOTION_STATUS is repeated at 1 Hz, without refusals",
       [&] {
         t.settle(there);
         const Status rest = t.newest();
         Command wrong = t.move(here);
         wrong.action[0] = signals[0].upper + 1;
         t.ask(wrong);
         t.watch(0.3);
         std::vector<Status> came = t.expect_unmoved(rest, 3.2);
         if (came.size() < 2) throw Failed{fmt::format("{} statuses in 3.2 s", came.size())};
         for (const Status& status : came) {
           expect(status.action_id == rest.action_id && status.state == rest.state,
                  "the settled MOVE repeated, not the refused one", status);
         }
       }},
      {5, "what cannot be is rejected",
       [&] {
         std::vector<double> action = here;
         action.push_back(0);
         t.expect_refused(refused_move.emplace(t.move(action)), Status::STATE_REJECTED);
         if (here.size() > 1) {
           action.resize(here.size() - 1);
           t.expect_refused(t.move(action), Status::STATE_REJECTED);
         }
         for (std::size_t i = 0; i < signals.size(); ++i) {
           const double beyond = 0.01 * (signals[i].upper - signals[i].lower);
           for (const double value : {signals[i].lower - beyond, signals[i].upper + beyond}) {
             action = here;
             action[i] = value;
             t.expect_refused(t.move(action), Status::STATE_REJECTED);
           }
         }
       }},
      {6, "one motion at a time",
       [&] {
         t.settle(here);
         const Command motion = begin_motion(t, there);
         const std::size_t from = t.num_heard();
         const Status answer = t.ask(t.move(here, kOtherSource));
         expect(answer.state == Status::STATE_REJECTED && !answer.reason.empty(),
                "REJECTED with a reason", answer);
         const Status end = t.life(motion, from).back();
         expect(end.state == Status::STATE_SETTLED, "the first motion SETTLED", end);
       }},
      {7, "what has expired is not carried out",
       [&] {
         Command late = t.move(here);
         late.expiry_utime = t.newest().utime - 1;
         t.expect_refused(late, Status::STATE_EXPIRED);
       }},
      {8, "no command is carried out twice",
       [&] {
         const Command first = t.move(there);
         t.ask(first);
         Status end = t.life(first, t.sent_at()).back();
         expect(end.state == Status::STATE_SETTLED, "SETTLED", end);
         Status again = t.ask(first);
         expect(
             again.state == Status::STATE_SETTLED && again.rest_since_utime == end.rest_since_utime,
             "SETTLED as before", again);
         end = t.settle(here);
         again = t.ask(first);
         expect(again.state == Status::STATE_STOPPED && !again.reason.empty(),
                "STOPPED with a reason: the arm has moved on", again);
         expect(again.rest_since_utime == end.rest_since_utime, "the arm at rest", again);
         t.expect_unmoved(end, kWatch_s);
         if (refused_move) t.expect_refused(*refused_move, Status::STATE_REJECTED);
       }},
      {9, "every source has its own ids",
       [&] {
         t.settle(here);
         t.settle(there, kOtherSource);
         Command other_epoch = t.move(here, kOtherSource);
         other_epoch.action_id = 0;
         other_epoch.epoch += 1;
         const Status answer = t.ask(other_epoch);
         expect(answer.state == Status::STATE_ACCEPTED || answer.state == Status::STATE_MOVING,
                "ACCEPTED", answer);
         const Status end = t.life(other_epoch, t.sent_at()).back();
         expect(end.state == Status::STATE_SETTLED, "SETTLED", end);
       }},
      {10, "HOLD is served at rest",
       [&] {
         t.settle(there);
         const Command hold = t.make(Command::KIND_HOLD);
         const Status answer = t.ask(hold);
         expect(answer.state == Status::STATE_HOLDING, "HOLDING", answer);
         const Status held = t.await_rest([&](const Status& s) { return is_answer(s, hold); });
         expect(held.commanded.size() == there.size(), "where it holds, in `commanded`", held);
         if (!is_between(held.commanded, there, there, step_of(here, there), kNear)) {
           throw Failed{fmt::format("it says that it holds at {}, but it settled at {}",
                                    held.commanded, there)};
         }
         t.settle(here);
       }},
      {11, "HOLD ends a motion",
       [&] {
         t.settle(here);
         end_motion(t, Command::KIND_HOLD, here, there);
         t.settle(there);
       }},
      {12, "STOP latches",
       [&] {
         const Status answer = t.ask(t.make(Command::KIND_STOP));
         expect(answer.state == Status::STATE_STOPPED && !answer.reason.empty(),
                "STOPPED with a reason", answer);
         expect(answer.stop_latched == 1, "stop_latched 1", answer);
         t.await_rest([](const Status&) { return true; });
         const Status refused = t.ask(t.move(here));
         expect(refused.state == Status::STATE_REJECTED && !refused.reason.empty(),
                "REJECTED with a reason", refused);
         const Status held = t.ask(t.make(Command::KIND_HOLD));
         expect(held.state == Status::STATE_HOLDING, "HOLDING", held);
         for (const Status& status : t.watch(kWatch_s)) {
           expect(status.stop_latched == 1, "stop_latched 1 until RESUME", status);
         }
       }},
      {13, "STOP ends a motion, and nothing takes it up again",
       [&] {
         t.settle(here);
         end_motion(t, Command::KIND_STOP, here, there);
         const Status resumed = t.ask(t.make(Command::KIND_RESUME));
         t.expect_unmoved(resumed, 2 * kWatch_s);
         t.settle(here);
       }},
      {14, "RESUME clears the latch and moves nothing",
       [&] {
         t.ask(t.make(Command::KIND_STOP));
         const Status rest = t.await_rest([](const Status& s) { return s.stop_latched == 1; });
         const Status answer = t.ask(t.make(Command::KIND_RESUME));
         expect(answer.state == Status::STATE_IDLE && answer.stop_latched == 0,
                "IDLE with stop_latched 0", answer);
         for (const Status& status : t.expect_unmoved(rest, kWatch_s)) {
           expect(status.stop_latched == 0, "stop_latched 0", status);
         }
         t.settle(there);
       }},
      {15, "a restart ends a motion, and nothing takes it up again",
       [&] {
         if (!link.restart) throw Skipped{"neither --restart nor --kill is given"};
         t.settle(here);
         std::optional<Command> motion;
         bool took_no_time = false;
         try {
           motion = begin_motion(t, there);
         } catch (const Skipped&) {
           took_no_time = true;
         }
         t.restart();
         const Status rest = t.await_rest([](const Status&) { return true; });
         if (took_no_time) {
           t.expect_unmoved(rest, kWatch_s);
           throw Skipped{"the motion took no time; the arm was at rest after the restart"};
         }
         const Status answer = t.ask(*motion);
         expect((answer.state == Status::STATE_STOPPED && !answer.reason.empty()) ||
                    answer.state == Status::STATE_SETTLED,
                "STOPPED with a reason", answer);
         t.expect_unmoved(rest, 2 * kWatch_s);
       }},
      {16, "what was sent before the start is not carried out",
       [&] {
         if (!link.restart) throw Skipped{"neither --restart nor --kill is given"};
         t.restart();
         t.await_rest([](const Status&) { return true; });
         Command old = t.move(here);
         old.utime = first_utime;
         t.expect_refused(old, Status::STATE_EXPIRED);
         t.settle(here);
       }},
      {17, "a STOP outlives the driver",
       [&] {
         if (!link.restart) throw Skipped{"neither --restart nor --kill is given"};
         t.ask(t.make(Command::KIND_STOP));
         t.restart();
         const Status rest = t.await_rest([](const Status&) { return true; });
         expect(rest.stop_latched == 1, "stop_latched 1", rest);
         const Status refused = t.ask(t.move(there));
         expect(refused.state == Status::STATE_REJECTED, "REJECTED", refused);
       }},
  };

  if (!t.await(0, 5, [](const Status&) { return true; })) {
    throw std::runtime_error("the driver fell silent before the test began");
  }
  first_utime = t.newest().utime;
  std::vector<RuleResult> results;
  bool is_ready = true;
  int blamed = 0;
  for (const Rule& rule : rules) {
    RuleResult& result = results.emplace_back();
    result.rule = rule.number;
    result.name = rule.name;
    if (is_ready && !t.recover()) {
      is_ready = false;
      blamed = t.newest().stop_latched ? 14 : rule.number;
    }
    if (!is_ready) {
      const bool is_blamed = blamed == rule.number;
      result.outcome = is_blamed ? RuleResult::Outcome::kFailed : RuleResult::Outcome::kSkipped;
      result.note =
          (is_blamed ? "expected the arm at rest after RESUME, came " : "the arm is not ready: ") +
          text_of(t.newest());
      continue;
    }
    if (progress) progress(fmt::format("{:2} {}", rule.number, rule.name));
    try {
      rule.test();
    } catch (const Failed& failed) {
      result.outcome = RuleResult::Outcome::kFailed;
      result.note = failed.note;
    } catch (const Skipped& skipped) {
      result.outcome = RuleResult::Outcome::kSkipped;
      result.note = skipped.note;
    }
  }
  if (is_ready) t.recover();
  RuleResult time{3, "time never runs backwards", RuleResult::Outcome::kOk, ""};
  if (t.time_ran_backwards()) {
    time.outcome = RuleResult::Outcome::kFailed;
    time.note = *t.time_ran_backwards();
  }
  results.insert(results.begin() + 2, time);
  return results;
}

}  // namespace bodyschema
