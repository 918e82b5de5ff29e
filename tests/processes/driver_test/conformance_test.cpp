#include "processes/driver_test/conformance.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <deque>
#include <functional>
#include <map>
#include <set>

#include "common/bus/convert.h"

namespace bodyschema {
namespace {

using Command = action_command_t;
using Status = motion_status_t;

/// How a driver may break a rule.
enum class Sin {
  kNone,
  kLockStep,  // no sin: motions take no time
  kMute,
  kForgetsPurpose,
  kSettlesInThePast,
  kMovesWhileAtRestByItsOwnWords,
  kClockStartsAnew,
  kRepeatsSeldom,
  kRepeatsRefusals,
  kIgnoresLimits,
  kIgnoresCount,
  kRefusesWithoutReason,
  kTakesASecondMotion,
  kIgnoresExpiry,
  kMovesAgain,
  kSettledForEver,
  kOneListOfIds,
  kHoldsNowhere,
  kHoldsElsewhere,
  kRounds,  // no sin: commanded is the action to seven digits
  kHoldsLater,
  kForgetsTheInterrupted,
  kLatchIsForgotten,
  kMovesWhileStopped,
  kResumesTheMotion,
  kResumeStaysLatched,
  kGoesOnAfterRestart,
  kNoStartGuard,
  kStopDiesWithIt,
};

/// A driver in virtual time, µs. A motion takes one second.
class FakeDriver {
 public:
  explicit FakeDriver(Sin sin) : sin_(sin) { last_ = make(none(), Status::STATE_IDLE); }

  DriverLink link() {
    return {[this](const Command& c) { on_command(c); },
            [this](double seconds) {
              for (double waited = 0; waited < seconds && out_.empty(); waited += 0.01) tick();
              return std::exchange(out_, {});
            },
            [this] { return 1e-6 * static_cast<double>(now_); }, [this] { restart(); }};
  }

  /// Somebody else's motion.
  void disturb() {
    Command other = none();
    other.source = "motor_babbler";
    other.action_id = 3;
    say(make(other, Status::STATE_MOVING));
  }

 private:
  static Command none() {
    Command command{};
    command.action_id = -1;
    return command;
  }

  Status make(const Command& c, std::int8_t state, const std::string& reason = "") const {
    Status s{};
    s.utime = now_ - offset_;
    s.source = c.source;
    s.epoch = c.epoch;
    s.action_id = c.action_id;
    s.kind = c.kind;
    s.purpose = sin_ == Sin::kForgetsPurpose ? 0 : c.purpose;
    s.state = state;
    s.reason = sin_ == Sin::kRefusesWithoutReason ? "" : reason;
    s.rest_since_utime = rest_since_;
    s.stop_latched = latched_;
    if (sin_ == Sin::kHoldsElsewhere && c.kind == Command::KIND_HOLD && c.epoch == 1'000) {
      set_array(s.num_signals, s.commanded, std::vector<double>{0, 0});
      return s;
    }
    const bool is_move = c.kind == Command::KIND_MOVE && c.action_id >= 0;
    set_array(s.num_signals, s.commanded,
              is_move                      ? c.action
              : sin_ == Sin::kHoldsNowhere ? std::vector<double>()
                                           : position());
    return s;
  }

  std::vector<double> position() const {
    if (!motion_) return at_;
    const double share = 1e-6 * static_cast<double>(now_ - begin_);
    std::vector<double> q = at_;
    for (std::size_t i = 0; i < q.size(); ++i) q[i] += share * (motion_->action[i] - at_[i]);
    return q;
  }

  void say(const Status& s) {
    out_.push_back(s);
    const bool is_refusal = s.state == Status::STATE_REJECTED || s.state == Status::STATE_EXPIRED;
    if (!is_refusal || sin_ == Sin::kRepeatsRefusals) last_ = s;
    said_at_ = now_;
  }

  void conclude(const Command& c, std::int8_t state, const std::string& reason = "") {
    say(make(c, state, reason));
    served_[key(c)] = out_.back();
  }

  using Key = std::tuple<std::string, std::int64_t, std::int64_t>;
  Key key(const Command& c) const {
    if (sin_ == Sin::kOneListOfIds) return {"", 0, c.action_id};
    return {c.source, c.epoch, c.action_id};
  }

  void arrive() {
    at_ = motion_->action;
    rest_since_ = sin_ == Sin::kSettlesInThePast ? begin_ - 1'000'000 : now_ - offset_;
    const Command done = *motion_;
    motion_.reset();
    conclude(done, Status::STATE_SETTLED);
    if (hold_later_) {
      const Command hold = *hold_later_;
      hold_later_.reset();
      conclude(hold, Status::STATE_HOLDING);
    }
  }

  void begin(const Command& c) {
    begin_ = now_;
    say(make(c, Status::STATE_ACCEPTED));
    motion_ = c;
    rest_since_ = sin_ == Sin::kMovesWhileAtRestByItsOwnWords ? rest_since_ : -1;
    say(make(c, Status::STATE_MOVING));
    served_[key(c)] = out_.back();
    if (sin_ == Sin::kLockStep) {
      now_ += 1'000'000;
      arrive();
    }
  }

  /// Ends the motion here and now.
  void halt(const std::string& reason) {
    if (!motion_) return;
    at_ = position();
    rest_since_ = now_ - offset_;
    interrupted_ = *motion_;
    const Command moved = *motion_;
    motion_.reset();
    if (sin_ != Sin::kForgetsTheInterrupted) conclude(moved, Status::STATE_STOPPED, reason);
  }

  void answer_again(const Command& c, Status again) {
    again.utime = now_ - offset_;
    again.rest_since_utime = rest_since_;
    again.stop_latched = latched_;
    again.source = c.source;
    again.epoch = c.epoch;
    if (again.state == Status::STATE_SETTLED && again.commanded != at_ &&
        sin_ != Sin::kSettledForEver) {
      again.state = Status::STATE_STOPPED;
      again.reason = "moved on";
    }
    out_.push_back(again);
  }

  void on_command(const Command& c) {
    if (sin_ == Sin::kMute) return;
    if (const auto found = served_.find(key(c)); found != served_.end()) {
      if (sin_ == Sin::kMovesAgain && c.kind == Command::KIND_MOVE && !motion_) return begin(c);
      return answer_again(c, found->second);
    }
    switch (c.kind) {
      case Command::KIND_HOLD:
        if (sin_ == Sin::kHoldsLater && motion_) {
          hold_later_ = c;
          return;
        }
        halt("HOLD");
        return conclude(c, Status::STATE_HOLDING);
      case Command::KIND_STOP:
        latched_ = true;
        halt("STOP");
        conclude(c, Status::STATE_STOPPED, "STOP");
        if (sin_ == Sin::kLatchIsForgotten) latched_ = false;
        return;
      case Command::KIND_RESUME:
        latched_ = sin_ == Sin::kResumeStaysLatched;
        conclude(c, Status::STATE_IDLE);
        if (sin_ == Sin::kResumesTheMotion && interrupted_) begin(*interrupted_);
        interrupted_.reset();
        return;
      default:
        break;
    }
    if (latched_ && sin_ != Sin::kMovesWhileStopped) {
      return conclude(c, Status::STATE_REJECTED, "stopped");
    }
    if (c.utime < start_ && sin_ != Sin::kNoStartGuard) {
      return conclude(c, Status::STATE_EXPIRED, "before the start");
    }
    if (c.expiry_utime < now_ - offset_ && sin_ != Sin::kIgnoresExpiry) {
      return conclude(c, Status::STATE_EXPIRED, "late");
    }
    Command accepted = c;
    if (c.action.size() != at_.size()) {
      if (sin_ != Sin::kIgnoresCount) return conclude(c, Status::STATE_REJECTED, "count");
      accepted.action.resize(at_.size());
    }
    for (double& q : accepted.action) {
      if (sin_ == Sin::kRounds) q = static_cast<float>(q);
      if (std::abs(q) > 1 && sin_ != Sin::kIgnoresLimits) {
        return conclude(c, Status::STATE_REJECTED, "limits");
      }
    }
    if (motion_) {
      if (sin_ != Sin::kTakesASecondMotion) return conclude(c, Status::STATE_REJECTED, "moving");
      at_ = position();
    }
    begin(accepted);
  }

  void tick() {
    now_ += 10'000;
    if (motion_ && now_ - begin_ >= 1'000'000) arrive();
    if (now_ - said_at_ >= (sin_ == Sin::kRepeatsSeldom ? 4'000'000 : 1'000'000) &&
        sin_ != Sin::kMute) {
      last_.utime = now_ - offset_;
      last_.rest_since_utime = rest_since_;
      last_.stop_latched = latched_;
      out_.push_back(last_);
      said_at_ = now_;
    }
    if (sin_ == Sin::kMute && out_.empty()) out_.push_back(last_);
  }

  void restart() {
    out_.clear();
    now_ += 500'000;
    if (sin_ == Sin::kClockStartsAnew) offset_ = now_;
    if (sin_ == Sin::kStopDiesWithIt) latched_ = false;
    start_ = now_ - offset_;
    if (!motion_) {
      rest_since_ = start_;
      return;
    }
    if (sin_ == Sin::kGoesOnAfterRestart) {
      const Command moved = *motion_;
      at_ = position();
      rest_since_ = start_;
      motion_.reset();
      served_.erase(key(moved));
      start_ = 0;
      say(make(moved, Status::STATE_STOPPED, "restart"));
      return;
    }
    halt("restart");
  }

  const Sin sin_;
  std::int64_t now_ = 5'000'000, offset_ = 0, start_ = 5'000'000, begin_ = 0, said_at_ = 0;
  std::int64_t rest_since_ = 5'000'000;
  bool latched_ = false;
  std::vector<double> at_ = {0.2, -0.1};
  std::optional<Command> motion_, interrupted_, hold_later_;
  std::map<Key, Status> served_;
  Status last_{};
  std::vector<Status> out_;
};

ConformanceOptions options() {
  ConformanceOptions result;
  result.signals.signals = {{"a", -1, 1}, {"b", -1, 1}};
  result.step_share = 0.1;
  result.motion_s = 10;
  result.restart_s = 5;
  result.epoch = 1'000;
  return result;
}

std::vector<RuleResult> results_of(FakeDriver& driver, bool can_restart = true) {
  DriverLink link = driver.link();
  if (!can_restart) link.restart = nullptr;
  return test_conformance(link, options(), plan_conformance(link, options()));
}

std::set<int> rules_with(const std::vector<RuleResult>& results, RuleResult::Outcome outcome) {
  std::set<int> rules;
  for (const RuleResult& result : results) {
    if (result.outcome == outcome) rules.insert(result.rule);
  }
  return rules;
}

std::string text_of(const std::vector<RuleResult>& results) {
  std::string text;
  for (const RuleResult& result : results) {
    if (result.outcome != RuleResult::Outcome::kOk) {
      text += std::to_string(result.rule) + ": " + result.note + "\n";
    }
  }
  return text;
}

TEST(Conformance, PassesADriverThatKeepsTheRules) {
  FakeDriver driver(Sin::kNone);
  const auto results = results_of(driver);
  ASSERT_EQ(results.size(), 17U);
  for (int i = 0; i < 17; ++i) EXPECT_EQ(results[i].rule, i + 1);
  EXPECT_EQ(text_of(results), "");
}

TEST(Conformance, PassesADriverThatCountsInSingles) {
  FakeDriver driver(Sin::kRounds);
  EXPECT_EQ(text_of(results_of(driver)), "");
}

TEST(Conformance, SkipsWhatALockStepSimulatorHasNoMomentFor) {
  FakeDriver driver(Sin::kLockStep);
  const auto results = results_of(driver);
  EXPECT_EQ(rules_with(results, RuleResult::Outcome::kFailed), std::set<int>{}) << text_of(results);
  EXPECT_EQ(rules_with(results, RuleResult::Outcome::kSkipped), (std::set<int>{6, 11, 13, 15}));
}

TEST(Conformance, SkipsTheRulesOfARestartThatItCannotMake) {
  FakeDriver driver(Sin::kNone);
  const auto results = results_of(driver, false);
  EXPECT_EQ(rules_with(results, RuleResult::Outcome::kFailed), std::set<int>{}) << text_of(results);
  EXPECT_EQ(rules_with(results, RuleResult::Outcome::kSkipped), (std::set<int>{15, 16, 17}));
}

class Sinner : public testing::TestWithParam<std::pair<Sin, int>> {};

TEST_P(Sinner, IsFoundByTheRuleThatItBreaks) {
  FakeDriver driver(GetParam().first);
  const auto results = results_of(driver);
  EXPECT_TRUE(rules_with(results, RuleResult::Outcome::kFailed).contains(GetParam().second))
      << text_of(results);
}

INSTANTIATE_TEST_SUITE_P(
    Conformance, Sinner,
    testing::Values(std::pair{Sin::kMute, 1}, std::pair{Sin::kForgetsPurpose, 1},
                    std::pair{Sin::kSettlesInThePast, 2},
                    std::pair{Sin::kMovesWhileAtRestByItsOwnWords, 2},
                    std::pair{Sin::kClockStartsAnew, 3}, std::pair{Sin::kRepeatsSeldom, 4},
                    std::pair{Sin::kRepeatsRefusals, 4}, std::pair{Sin::kIgnoresLimits, 5},
                    std::pair{Sin::kIgnoresCount, 5}, std::pair{Sin::kRefusesWithoutReason, 5},
                    std::pair{Sin::kTakesASecondMotion, 6}, std::pair{Sin::kIgnoresExpiry, 7},
                    std::pair{Sin::kMovesAgain, 8}, std::pair{Sin::kSettledForEver, 8},
                    std::pair{Sin::kOneListOfIds, 9}, std::pair{Sin::kHoldsNowhere, 10},
                    std::pair{Sin::kHoldsElsewhere, 10}, std::pair{Sin::kHoldsLater, 11},
                    std::pair{Sin::kForgetsTheInterrupted, 11},
                    std::pair{Sin::kLatchIsForgotten, 12}, std::pair{Sin::kMovesWhileStopped, 12},
                    std::pair{Sin::kResumesTheMotion, 13}, std::pair{Sin::kResumeStaysLatched, 14},
                    std::pair{Sin::kGoesOnAfterRestart, 15}, std::pair{Sin::kNoStartGuard, 16},
                    std::pair{Sin::kStopDiesWithIt, 17}),
    [](const auto& info) {
      return "OfRule" + std::to_string(info.param.second) + "Number" + std::to_string(info.index);
    });

TEST(Conformance, EndsWhenSomebodyElseMovesTheArm) {
  FakeDriver driver(Sin::kNone);
  const DriverLink link = driver.link();
  const ConformancePlan plan = plan_conformance(link, options());
  int rules = 0;
  try {
    test_conformance(link, options(), plan, [&](const std::string&) {
      if (++rules == 4) driver.disturb();
    });
    FAIL() << "went on";
  } catch (const std::runtime_error& error) {
    EXPECT_NE(std::string(error.what()).find("motor_babbler moves the arm"), std::string::npos);
  }
}

TEST(Conformance, PlansSmallStepsAboutWhereTheArmIs) {
  FakeDriver driver(Sin::kNone);
  const ConformancePlan plan = plan_conformance(driver.link(), options());
  EXPECT_FALSE(plan.is_from_middle);
  EXPECT_EQ(plan.here, (std::vector<double>{0.2, -0.1}));
  EXPECT_NEAR(plan.there[0], 0, 1e-12);
  EXPECT_NEAR(plan.there[1], 0.1, 1e-12);
}

}  // namespace
}  // namespace bodyschema
