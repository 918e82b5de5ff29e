// Class Adaptation: markers that are missing, fall or move.

#include <gtest/gtest.h>

#include <algorithm>
#include <functional>
#include <map>

#include "tests/processes/model_monitor/adaptation_life.h"

namespace bodyschema::test {
namespace {

TEST(AdaptationTest, AMarkerThatIsMissingIsToldAndComesBack) {
  BrokenArm arm({Fault::kNone, "", 1}, Regime::kTagIso, 50, 1);
  Adaptation adaptation(arm.engineered(), adaptation_options(Regime::kTagIso));
  std::vector<AdaptationEvent> events;
  for (int t = 0; t < 120; ++t) {
    ActionPoseSample sample = arm.observe(t);
    if (t >= 50 && t < 80)
      std::erase_if(sample.parts, [](const PartObservation& o) { return o.part == 5; });
    for (const auto& e : adaptation.on_sample(sample)) events.push_back(e);
    if (t == 79) {
      EXPECT_EQ(adaptation.missing_parts(), std::vector<int>{5});
    }
  }
  ASSERT_EQ(events.size(), 2U);
  EXPECT_EQ(events[0].kind, Kind::kMissing);
  EXPECT_EQ(events[0].part, 5);
  EXPECT_LT(events[0].sample_index, 60);
  EXPECT_EQ(events[1].kind, Kind::kRecovered);
  EXPECT_EQ(events[1].sample_index, 80);
  EXPECT_TRUE(adaptation.missing_parts().empty());
}

TEST(AdaptationTest, AMarkerThatFellAndLiesInSightIsMissingAndNoFault) {
  // A marker of one tag; of two, which are seen by turns and lie each at its own place.
  for (const auto& [part, num_tags] : {std::pair{3, 1}, {5, 1}, {7, 1}, {3, 2}, {5, 2}, {7, 2}}) {
    BrokenArm arm({Fault::kNone, "", 1}, Regime::kTagIso, 50, 1);
    Adaptation adaptation(arm.engineered(), adaptation_options(Regime::kTagIso));
    Life life;
    Pose X_CM = Pose::Identity();
    X_CM.translation() << 0.4, 0.3, 1.5;
    const Noise noise = nominal_noise(Regime::kTagIso);
    Rng rng(1);
    for (int t = 0; t < 120; ++t) {
      ActionPoseSample sample = arm.observe(t);
      for (PartObservation& o : sample.parts) {
        if (o.part == part && num_tags == 2) o.tags = {10, 11};
        if (o.part != part || t < 50 || t >= 80) continue;
        if (num_tags == 2) o.tags = {10 + t % 2};
        X_CM.translation().x() = 0.4 + 0.2 * (num_tags == 2 ? t % 2 : 0);
        Vector6d error = gaussian6(rng);
        error.head<3>() *= noise.position_m;
        error.tail<3>() *= noise.rotation_rad;
        o.X_CB = X_CM * exp(error);
        o.X_CB_other.reset();
      }
      for (const auto& e : adaptation.on_sample(sample)) life.events.push_back(e);
      life.error.push_back(arm.error(adaptation.schema(), t));
      if (t == 79) {
        EXPECT_EQ(adaptation.missing_parts(), std::vector<int>{part}) << life.log();
      }
    }
    SCOPED_TRACE("part " + std::to_string(part) + ", events:\n" + life.log());
    const auto missing = std::find_if(life.events.begin(), life.events.end(),
                                      [](const auto& e) { return e.kind == Kind::kMissing; });
    ASSERT_NE(missing, life.events.end());
    EXPECT_EQ(missing->part, part);
    EXPECT_LE(missing->sample_index, 55);
    for (auto e = missing + 1; e != life.events.end(); ++e) {
      EXPECT_TRUE(e->kind == Kind::kReverted || e->kind == Kind::kRecovered) << text(*e);
    }
    EXPECT_EQ(life.events.back().kind, Kind::kRecovered);
    EXPECT_EQ(life.events.back().sample_index, 80);
    EXPECT_TRUE(adaptation.is_settled());
    EXPECT_NEAR(life.error.back(), life.error[49], 1e-9);
  }
}

/// Every part carries four tags, one of which is in sight at a time.
class FourTagsAPart : public testing::TestWithParam<int> {
 protected:
  static constexpr int kPart = 4, kTag = 41, kBroken = 100, kRepaired = 220, kEnd = 320;

  /// `change` of what is seen of kTag while it is broken; false: it is not seen.
  Life live_with(const std::function<bool(PartObservation*)>& change) {
    Life life;
    for (int t = 0; t < kEnd; ++t) {
      ActionPoseSample sample = arm_.observe(t);
      std::erase_if(sample.parts, [&](PartObservation& o) {
        o.tags = {10 * o.part + static_cast<int>(uniform(rng_, 0, 4))};
        return o.tags.front() == kTag && t >= kBroken && t < kRepaired && !change(&o);
      });
      for (const auto& e : adaptation_.on_sample(sample)) life.events.push_back(e);
      life.error.push_back(arm_.error(adaptation_.schema(), t));
    }
    return life;
  }

  BrokenArm arm_{{Fault::kNone, "", 1}, Regime::kTagIso, 200, 1};
  Adaptation adaptation_{arm_.engineered(), adaptation_options(Regime::kTagIso)};
  Rng rng_{static_cast<std::uint64_t>(GetParam())};
};

TEST_P(FourTagsAPart, OneThatMovesIsNamedAndLeftOutUntilItIsBack) {
  const bool has_fallen = GetParam() % 2;
  Pose X_BS = Pose::Identity(), X_CS = Pose::Identity();
  X_BS.translation() << 0.03, 0.04, 0;
  X_BS.linear() = exp_so3({0, 0, 0.5});
  X_CS.translation() << 0.4, 0.3, 1.5;
  const Noise noise = nominal_noise(Regime::kTagIso);
  const Life life = live_with([&](PartObservation* o) {
    Vector6d error = gaussian6(rng_);
    error.head<3>() *= noise.position_m;
    error.tail<3>() *= noise.rotation_rad;
    o->X_CB = has_fallen ? X_CS * exp(error) : o->X_CB * X_BS;
    o->X_CB_other.reset();
    return true;
  });
  SCOPED_TRACE("events:\n" + life.log());
  const auto is_of_tag = [](const AdaptationEvent& e) { return e.tag == kTag; };
  const auto moved = std::find_if(life.events.begin(), life.events.end(), is_of_tag);
  ASSERT_NE(moved, life.events.end());
  EXPECT_EQ(moved->kind, has_fallen ? Kind::kMissing : Kind::kCandidate);
  EXPECT_EQ(moved->part, kPart);
  EXPECT_EQ(moved->cause, has_fallen ? "marker_missing" : "marker_moved");
  EXPECT_LT(moved->sample_index, kBroken + 40);
  const auto back = std::find_if(moved + 1, life.events.end(), is_of_tag);
  ASSERT_NE(back, life.events.end());
  EXPECT_EQ(back->kind, has_fallen ? Kind::kRecovered : Kind::kRestored);
  EXPECT_EQ(back->cause, moved->cause);
  EXPECT_GT(back->sample_index, kRepaired);
  EXPECT_LT(back->sample_index, kRepaired + 40);
  // Once it is known there is peace, and the body is as it was.
  for (auto e = moved + 1; e != life.events.end(); ++e) {
    EXPECT_TRUE(e == back || e->sample_index == moved->sample_index) << text(*e);
  }
  for (const AdaptationEvent& e : life.events) {
    EXPECT_GE(e.sample_index, kBroken) << text(e);
  }
  for (std::int64_t t = moved->sample_index; t < kEnd; ++t) {
    EXPECT_NEAR(life.error[static_cast<std::size_t>(t)], life.error[kBroken - 1], 1e-3) << t;
  }
  ASSERT_EQ(adaptation_.schema().moved_tags.size(), 1U);
  const MovedTag& tag = adaptation_.schema().moved_tags.front();
  EXPECT_EQ(tag.tag, kTag);
  EXPECT_GE(tag.since, kBroken);
  EXPECT_EQ(tag.found, moved->sample_index);
  EXPECT_EQ(tag.until, back->sample_index);
}

TEST_P(FourTagsAPart, OneThatIsLostIsNamedAndThePartIsNotMissedForLong) {
  const Life life = live_with([](PartObservation*) { return false; });
  SCOPED_TRACE("events:\n" + life.log());
  int num_part_events = 0;
  std::vector<AdaptationEvent> of_tag;
  for (const AdaptationEvent& e : life.events) {
    EXPECT_EQ(e.part, kPart);
    EXPECT_EQ(e.cause, "marker_missing");
    if (e.tag >= 0)
      of_tag.push_back(e);
    else
      ++num_part_events;
  }
  EXPECT_LE(num_part_events, 4);  // missing and back, twice
  ASSERT_EQ(of_tag.size(), 2U);
  EXPECT_EQ(of_tag[0].tag, kTag);
  EXPECT_EQ(of_tag[0].kind, Kind::kMissing);
  EXPECT_GE(of_tag[0].sample_index, kBroken);
  EXPECT_LT(of_tag[0].sample_index, kRepaired);
  EXPECT_EQ(of_tag[1].kind, Kind::kRecovered);
  EXPECT_GE(of_tag[1].sample_index, kRepaired);
}

/// The camera sees two neighbours of four tags at a time, and always those that lie in the room.
TEST_P(FourTagsAPart, TwoThatFallOneAfterTheOtherAndLieInSightAreNamedOnceEach) {
  const Noise noise = nominal_noise(Regime::kTagIso);
  const auto lying = [&](int tag) {
    PartObservation o;
    o.part = kPart;
    o.tags = {tag};
    o.X_CB.translation() << 0.4, 0.1 * (tag - kTag), 1.5;
    Vector6d error = gaussian6(rng_);
    error.head<3>() *= noise.position_m;
    error.tail<3>() *= noise.rotation_rad;
    o.X_CB = o.X_CB * exp(error);
    return o;
  };
  Life life;
  for (int t = 0; t < kEnd; ++t) {
    ActionPoseSample sample = arm_.observe(t);
    std::vector<int> fallen;
    for (const int tag : {kTag, kTag + 1})
      if (t >= kBroken + 50 * (tag - kTag) && t < kRepaired) fallen.push_back(tag);
    std::vector<PartObservation> readings;
    if (const PartObservation* seen = sample.find(kPart)) {
      PartObservation& o = readings.emplace_back(*seen);
      const int side = static_cast<int>(uniform(rng_, 0, 4));
      o.tags.clear();
      for (const int i : {side, (side + 1) % 4})
        if (std::find(fallen.begin(), fallen.end(), 10 * kPart + i) == fallen.end())
          o.tags.push_back(10 * kPart + i);
      std::sort(o.tags.begin(), o.tags.end());
      if (o.tags.empty()) readings.clear();
    }
    for (const int tag : fallen) readings.push_back(lying(tag));
    // As the observer has it.
    std::erase_if(sample.parts, [](const PartObservation& o) { return o.part == kPart; });
    for (PartObservation& o : readings) {
      o.X_CB_other.reset();
      const bool is_agreed = readings.size() == 1 || o.tags.size() > 1;
      (is_agreed ? sample.parts : sample.contradictions).push_back(std::move(o));
    }
    std::sort(sample.parts.begin(), sample.parts.end(),
              [](const PartObservation& a, const PartObservation& b) { return a.part < b.part; });
    for (const auto& e : adaptation_.on_sample(sample)) life.events.push_back(e);
    life.error.push_back(arm_.error(adaptation_.schema(), t));
  }
  SCOPED_TRACE("events:\n" + life.log());
  std::map<int, std::vector<AdaptationEvent>> of_tag;
  for (const AdaptationEvent& e : life.events) of_tag[e.tag].push_back(e);
  for (const int tag : {kTag, kTag + 1}) {
    ASSERT_EQ(of_tag[tag].size(), 2U) << tag;
    EXPECT_EQ(of_tag[tag][0].kind, Kind::kMissing);
    EXPECT_LT(of_tag[tag][0].sample_index, kBroken + 50 * (tag - kTag) + 20);
    EXPECT_EQ(of_tag[tag][1].kind, Kind::kRecovered);
    EXPECT_GE(of_tag[tag][1].sample_index, kRepaired);
    EXPECT_LT(of_tag[tag][1].sample_index, kRepaired + 40);
    of_tag.erase(tag);
  }
  for (const auto& [tag, events] : of_tag) EXPECT_LE(events.size(), 2U) << tag;
  for (std::size_t t = kBroken + 20; t < kEnd; ++t)
    EXPECT_NEAR(life.error[t], life.error[kBroken - 1], 1e-3) << t;
}

/// A part that now is where it should be and now is not, whatever tag shows it.
TEST_P(FourTagsAPart, NoneHasMovedWhereTheBodyIsWrong) {
  for (const Fault fault : {Fault::kStuck, Fault::kGain, Fault::kWorn, Fault::kElastic}) {
    BrokenArm arm({fault, "", 0.9}, Regime::kTagIso, kBlock, GetParam());
    Adaptation adaptation(arm.engineered(), adaptation_options(Regime::kTagIso));
    for (int t = 0; t < arm.num_samples(); ++t) {
      ActionPoseSample sample = arm.observe(t);
      for (PartObservation& o : sample.parts)
        o.tags = {10 * o.part + static_cast<int>(uniform(rng_, 0, 4))};
      for (const auto& e : adaptation.on_sample(sample)) {
        EXPECT_FALSE(e.tag >= 0 && e.cause == "marker_moved") << text(e);
      }
    }
  }
}

INSTANTIATE_TEST_SUITE_P(AdaptationTest, FourTagsAPart, testing::Range(1, 4));

/// The root does not turn: both its tags are always in sight.
class TwoTagsOnTheRoot : public testing::Test {
 protected:
  static constexpr int kTag = 10, kOther = 11, kBroken = 100, kRepaired = 220, kEnd = 320;

  /// `tags_of`: those that the root's pose rests on, not both. kTag sits elsewhere from `moved` on.
  Life live_with(int moved, const std::function<std::vector<int>(int)>& tags_of) {
    Pose X_BS = Pose::Identity();
    X_BS.translation() << 0.03, 0.04, 0;
    Life life;
    for (int t = 0; t < kEnd; ++t) {
      ActionPoseSample sample = arm_.observe(t);
      for (PartObservation& o : sample.parts) {
        if (o.part != BrokenArm::kRoot) continue;
        o.tags = {kTag, kOther};
        if (t < kBroken || t >= kRepaired) continue;
        o.tags = tags_of(t);
        if (o.tags == std::vector<int>{kTag} && t >= moved) o.X_CB = o.X_CB * X_BS;
        o.X_CB_other.reset();
      }
      for (const auto& e : adaptation_.on_sample(sample)) life.events.push_back(e);
    }
    return life;
  }
  /// Of the root's marker from where it was, as the schema has it [m].
  double error() const {
    const BodySchema now = adaptation_.schema(), then = arm_.engineered();
    return (now.X_CR.translation() - then.X_CR.translation()).norm();
  }

  BrokenArm arm_{{Fault::kNone, "", 1}, Regime::kTagIso, 200, 1};
  Adaptation adaptation_{arm_.engineered(), adaptation_options(Regime::kTagIso)};
};

/// The observer gives the one or the other by turns.
TEST_F(TwoTagsOnTheRoot, TheOneThatMovesIsNamedAndNotTheOther) {
  const Life life =
      live_with(kBroken, [](int t) { return std::vector<int>{t % 2 == 0 ? kTag : kOther}; });
  SCOPED_TRACE("events:\n" + life.log());
  std::vector<AdaptationEvent> of_tag;
  for (const AdaptationEvent& e : life.events)
    if (e.tag >= 0) of_tag.push_back(e);
  ASSERT_EQ(of_tag.size(), 2U);
  EXPECT_EQ(of_tag[0].tag, kTag);
  EXPECT_EQ(of_tag[0].kind, Kind::kCandidate);
  EXPECT_LT(of_tag[0].sample_index, kBroken + 10);
  EXPECT_EQ(of_tag[1].tag, kTag);
  EXPECT_EQ(of_tag[1].kind, Kind::kRestored);
  EXPECT_LT(of_tag[1].sample_index, kRepaired + 10);
  EXPECT_LT(error(), 0.003);
}

TEST_F(TwoTagsOnTheRoot, WhatWasTakenForLostIsBelievedAgainWhereThereIsNothingElse) {
  const Life life = live_with(kBroken + 20, [](int) { return std::vector<int>{kTag}; });
  SCOPED_TRACE("events:\n" + life.log());
  EXPECT_TRUE(std::any_of(life.events.begin(), life.events.end(), [](const AdaptationEvent& e) {
    return e.kind == Kind::kCandidate && e.part == BrokenArm::kRoot && e.tag < 0;
  }));
  EXPECT_TRUE(std::any_of(life.events.begin(), life.events.end(), [](const AdaptationEvent& e) {
    return e.kind == Kind::kRecovered && e.tag == kOther && e.sample_index > kRepaired;
  }));
  EXPECT_LT(error(), 0.003);
}

}  // namespace
}  // namespace bodyschema::test
