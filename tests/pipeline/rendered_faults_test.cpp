// The simulated arm breaks while it babbles and is repaired again: from rendered images to the body
// schema, with the configuration of the rig, in one thread. The sample's index decides when it
// breaks, so every run is the same.

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <set>
#include <string>
#include <vector>

#include "bodyschema/fault_command_t.hpp"
#include "common/bus/cause_names.h"
#include "common/bus/check.h"
#include "common/bus/convert.h"
#include "tests/support/rendered_run.h"

namespace bodyschema::test {
namespace {

constexpr std::int64_t kBrokenAt = 30, kRepairedAt = 50, kEnd = 65;
/// Samples until the monitor has decided and the schema must be right.
constexpr std::int64_t kSoon = 5;
constexpr double kFalseAlarmRate = 1e-5;  // as the rig says

struct Case {
  std::string name;
  std::int8_t fault;
  std::string place;
  std::vector<int> numbers{-1};
  double amount_deg = 0;
  /// The edge that leads to this part, for a marker or the camera the part itself.
  int part = 0;
  std::set<std::string> causes;
};

void PrintTo(const Case& c, std::ostream* out) { *out << c.name; }

class AdaptationTest : public testing::TestWithParam<Case> {
 protected:
  AdaptationTest() : run_(BODYSCHEMA_SOURCE_FOLDER "/config/arm7", 1, {}, Choice::kActive) {}

  /// One more sample. Keeps the monitor's events.
  void step() {
    const RenderedRun::Step step = run_.next();
    for (const PartObservation& o : step.sample.parts) ++num_seen_[o.part];
    const model_health_t& health = run_.monitor().health();
    ASSERT_EQ(check(health), "");
    if (run_.monitor().schema()) {
      ASSERT_EQ(check(*run_.monitor().schema()), "");
    }
    for (const health_event_t& event : health.events)
      if (event.event_number >= static_cast<std::int64_t>(events_.size())) events_.push_back(event);
    error_m_ = -1;
    if (!run_.monitor().schema()) return;
    const BodySchema schema = from_message(*run_.monitor().schema());
    for (const auto& [part, X_RB] : schema.predict_all(step.sample.action)) {
      if (part == moved_marker_) continue;
      const Pose X_CB = schema.X_CR * X_RB;
      error_m_ =
          std::max(error_m_, (X_CB.translation() - step.truth.at(part).translation()).norm());
    }
  }

  /// The first decision on a change at sample `since` or later.
  const health_event_t* decision(std::int64_t since) const {
    for (const health_event_t& event : events_) {
      if (event.event_sample >= since && (event.event_kind == health_event_t::EVENT_CANDIDATE ||
                                          event.event_kind == health_event_t::EVENT_RESTORED ||
                                          event.event_kind == health_event_t::EVENT_MISSING))
        return &event;
    }
    return nullptr;
  }
  std::string told() const {
    std::string text;
    for (const health_event_t& event : events_)
      text += std::to_string(event.event_sample) + "  " + event.event_text + "\n";
    return text;
  }

  RenderedRun run_;
  std::vector<health_event_t> events_;
  std::map<int, int> num_seen_;  // of a part: samples
  int moved_marker_ = -1;        // its part is where its tags are, and these disagree
  double error_m_ = -1;          // of the worst part, camera included, against the truth
};

TEST_P(AdaptationTest, IsFoundNamedAndMendedAndSoIsTheRepair) {
  const Case& c = GetParam();
  double healthy_m = 0;
  for (std::int64_t n = 0; n < kBrokenAt; ++n) {
    ASSERT_NO_FATAL_FAILURE(step());
    if (n >= kBrokenAt - kSoon) healthy_m = std::max(healthy_m, error_m_);
  }
  ASSERT_TRUE(run_.monitor().schema());
  ASSERT_EQ(run_.monitor().schema()->is_complete, 1);
  for (const health_event_t& event : events_)
    ASSERT_LE(event.event_kind, health_event_t::EVENT_SCHEMA_REFUSED) << told();

  for (const int number : c.numbers) run_.break_body(c.fault, c.place, number, c.amount_deg);
  // A missing part is reported when a run of misses of this length is rarer than the allowed false
  // alarms, whatever share of the samples shows the part (Jeffreys' prior).
  std::int64_t soon = kSoon;
  if (c.fault == fault_command_t::FAULT_MARKER_LOST) {
    const double seen = num_seen_[c.part] + 0.5, missed = kBrokenAt - num_seen_[c.part] + 0.5;
    double chance = seen / (seen + missed);
    for (soon = 2; chance > kFalseAlarmRate / 50; ++soon)  // ten parts and their forty tags
      chance *= (missed + static_cast<double>(soon) - 2) /
                (seen + missed + static_cast<double>(soon) - 1);
  }
  if (c.fault == fault_command_t::FAULT_MARKER_MOVED) {
    soon = kRepairedAt - kBrokenAt;  // when the tag is in sight
    moved_marker_ = c.part;
  }
  for (std::int64_t n = kBrokenAt; n < kRepairedAt; ++n) {
    ASSERT_NO_FATAL_FAILURE(step());
    if (n >= kBrokenAt + kSoon) {
      EXPECT_LT(error_m_, 2 * healthy_m) << n << "\n" << told();
    }
  }
  const health_event_t* found = decision(kBrokenAt);
  ASSERT_TRUE(found) << told();
  EXPECT_LT(found->event_sample, kBrokenAt + soon) << told();
  EXPECT_EQ(found->event_from >= 0 ? found->event_to : found->event_part, c.part) << told();
  EXPECT_TRUE(c.causes.contains(cause_text(found->event_cause))) << told();

  run_.break_body(fault_command_t::FAULT_REPAIR);
  moved_marker_ = -1;
  for (std::int64_t n = kRepairedAt; n < kEnd; ++n) {
    ASSERT_NO_FATAL_FAILURE(step());
    if (n >= kRepairedAt + kSoon) {
      EXPECT_LT(error_m_, 2 * healthy_m) << n << "\n" << told();
    }
  }
}

/// One of the four tags of a part; real tags come off one by one.
class OneTag : public AdaptationTest {
 protected:
  static constexpr std::int64_t kRepaired = 90, kLast = 120;

  void live(std::int8_t fault, int tag) {
    for (std::int64_t n = 0; n < kLast; ++n) {
      if (n == kBrokenAt) run_.break_body(fault, "", tag);
      if (n == kRepaired) run_.break_body(fault_command_t::FAULT_REPAIR);
      ASSERT_NO_FATAL_FAILURE(step());
      errors_m_.push_back(error_m_);
    }
  }
  std::vector<const health_event_t*> events_of(int tag) const {
    std::vector<const health_event_t*> result;
    for (const health_event_t& event : events_)
      if (event.event_tag == tag) result.push_back(&event);
    return result;
  }

  std::vector<double> errors_m_;
};

TEST_F(OneTag, ThatMovedIsNamedAndLeftOutUntilItIsBack) {
  ASSERT_NO_FATAL_FAILURE(live(fault_command_t::FAULT_MARKER_MOVED, 28));
  const auto of_tag = events_of(28);
  ASSERT_EQ(of_tag.size(), 2U) << told();
  EXPECT_EQ(of_tag[0]->event_kind, health_event_t::EVENT_CANDIDATE);
  EXPECT_EQ(of_tag[0]->event_part, 8);
  EXPECT_EQ(of_tag[0]->event_cause, health_event_t::CAUSE_MARKER_MOVED);
  EXPECT_LT(of_tag[0]->event_sample, kBrokenAt + 30) << told();
  EXPECT_EQ(of_tag[1]->event_kind, health_event_t::EVENT_RESTORED);
  EXPECT_GE(of_tag[1]->event_sample, kRepaired);
  const double healthy_m =
      *std::max_element(errors_m_.begin() + kBrokenAt - kSoon, errors_m_.begin() + kBrokenAt);
  for (std::int64_t n = of_tag[0]->event_sample; n < kLast; ++n) {
    EXPECT_LT(errors_m_[static_cast<std::size_t>(n)], 2 * healthy_m) << n << "\n" << told();
  }
  for (const health_event_t& event : events_) {
    EXPECT_TRUE(event.event_sample <= of_tag[0]->event_sample || &event == of_tag[1] ||
                event.event_kind <= health_event_t::EVENT_SCHEMA_REFUSED)
        << event.event_text << "\n"
        << told();
  }
}

TEST_F(OneTag, ThatIsLostIsNamedAndThePartIsSeenByTheOthers) {
  ASSERT_NO_FATAL_FAILURE(live(fault_command_t::FAULT_MARKER_LOST, 28));
  const auto of_tag = events_of(28);
  ASSERT_EQ(of_tag.size(), 2U) << told();
  EXPECT_EQ(of_tag[0]->event_kind, health_event_t::EVENT_MISSING);
  EXPECT_LT(of_tag[0]->event_sample, kRepaired) << told();
  EXPECT_EQ(of_tag[1]->event_kind, health_event_t::EVENT_RECOVERED);
  EXPECT_GE(of_tag[1]->event_sample, kRepaired);
  int num_of_part = 0;
  for (const health_event_t& event : events_) num_of_part += event.event_part == 8;
  EXPECT_LE(num_of_part, 6) << told();
}

INSTANTIATE_TEST_SUITE_P(
    Faults, AdaptationTest,
    testing::Values(
        Case{"stuck", fault_command_t::FAULT_STUCK, "q3", {-1}, 0, 5, {"joint_stuck"}},
        Case{"bend", fault_command_t::FAULT_BEND, "forearm", {-1}, 10, 6, {"geometry"}},
        Case{"tool", fault_command_t::FAULT_TOOL, "", {1}, 0, 8, {"geometry"}},
        Case{"camera_bump", fault_command_t::FAULT_CAMERA_BUMP, "", {-1}, 0, 1, {"camera_moved"}},
        Case{"marker_moved", fault_command_t::FAULT_MARKER_MOVED, "", {28}, 0, 8, {"marker_moved"}},
        Case{"marker_lost",
             fault_command_t::FAULT_MARKER_LOST,
             "",
             {32, 33, 34, 35},
             0,
             9,
             {"marker_missing"}}),
    [](const auto& info) { return info.param.name; });

}  // namespace
}  // namespace bodyschema::test
