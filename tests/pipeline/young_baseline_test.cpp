// Learner and monitor in the first samples of a run, in one thread, on synthetic robots with
// tag-like noise: a first structure that is wrong is learned better, not explained as a change of
// the body; and a real change of the body is still found.

#include <gtest/gtest.h>

#include <algorithm>
#include <string>
#include <vector>

#include "common/bus/check.h"
#include "common/bus/codec.h"
#include "common/bus/convert.h"
#include "tests/support/live_run.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::Rng;

const ModelMonitorConfig kMonitor{
    .max_mahalanobis2 = 20.06,
    .max_outlier_share = 0.2,
    .measurement = {.systematic = {.position_m = 0.0007, .rotation_rad = 0.0025}}};

/// Babbling, every fifth sample TEST; from `broken_at` on another robot.
std::vector<sample_t> babble(const test::SyntheticRobot& robot, std::int64_t num_samples, Rng& rng,
                             const test::SyntheticRobot* broken = nullptr,
                             std::int64_t broken_at = -1) {
  const test::ObservationOptions options{
      .regime = test::Regime::kTag, .with_covariances = true, .with_other_hypothesis = true};
  std::vector<sample_t> samples;
  for (std::int64_t n = 0; n < num_samples; ++n) {
    const test::SyntheticRobot& body = broken && n >= broken_at ? *broken : robot;
    ActionPoseSample sample = observe(body, robot.random_action(rng), options, n, rng);
    sample.utime = 1'000'000 * (n + 1);
    if (n % 5 == 4) sample.purpose = Purpose::kTest;
    samples.push_back(to_message(sample));
  }
  return samples;
}

StructureLearnerConfig learner_of(const test::SyntheticRobot& robot) {
  StructureLearnerConfig config;
  config.signals = robot.signals;
  config.options.root = 1;
  config.options.measurement.systematic = kTagSystematic;
  return config;
}

std::string told_text(const test::LiveRun& run) {
  std::string text;
  for (const health_event_t& event : run.events)
    text += std::to_string(event.event_sample) + "  " + event.event_text + "\n";
  return text;
}

class HealthyBody : public testing::TestWithParam<const char*> {};

TEST_P(HealthyBody, NothingIsToldAndWhatIsHeldIsNoWorseThanLearnedOffline) {
  const int num_seeds = GetParam() == std::string("d") ? 1 : 3;  // half a minute each
  for (int seed = 1; seed <= num_seeds; ++seed) {
    Rng rng(static_cast<Rng::result_type>(seed));
    const test::SyntheticRobot robot = test::chapter_robot(GetParam(), rng);
    const std::vector<sample_t> samples = babble(robot, 60, rng);
    for (const int hidden : robot.visible_parts()) {
      if (hidden == 1) continue;  // the root
      const std::string name = "seed " + std::to_string(seed) + ", part " + std::to_string(hidden);
      const auto seen = test::without_part(samples, hidden);
      test::SyntheticRobot truth = robot;
      for (test::TrueLink& link : truth.links) link.hidden |= link.part == hidden;
      const StructureLearnerConfig learner = learner_of(robot);
      test::LiveRun run = test::live_run(seen, learner, kMonitor);
      EXPECT_TRUE(run.events.empty()) << name << "\n" << told_text(run);
      ASSERT_TRUE(run.schema) << name;
      EXPECT_LE(test::judge(*run.schema, truth),
                test::judge(test::learned_offline(seen, learner), truth))
          << name;
    }
  }
}

INSTANTIATE_TEST_SUITE_P(Robots, HealthyBody, testing::Values("a", "c", "d"),
                         [](const auto& info) { return std::string(info.param); });

/// A few samples after the first structure was accepted a link is bent, or a joint sticks.
TEST(YoungBodyThatChanges, IsFoundOutWithinFewSamples) {
  constexpr std::int64_t kBrokenAt = 18, kSoon = 20, kEnd = 80;
  for (const bool is_stuck : {false, true}) {
    for (int seed = 1; seed <= 3; ++seed) {
      SCOPED_TRACE((is_stuck ? "stuck, seed " : "bent, seed ") + std::to_string(seed));
      Rng rng(static_cast<Rng::result_type>(seed));
      const test::SyntheticRobot robot = test::chapter_robot("a", rng);
      test::SyntheticRobot broken = robot;
      test::TrueLink* link = nullptr;
      for (test::TrueLink& l : broken.links)
        if (l.signal >= 0) link = &l;
      if (is_stuck) {
        link->turn = link->slide = 0;
      } else {
        link->X_before.linear() = link->X_before.linear() * exp_so3({0.5, 0, 0.3});
        link->X_before.translation() += Eigen::Vector3d(0.02, 0.01, 0);
      }
      const auto samples = babble(robot, kEnd, rng, &broken, kBrokenAt);
      const StructureLearnerConfig learner = learner_of(robot);
      const auto first =
          test::live_run({samples.begin(), samples.begin() + kBrokenAt}, learner, kMonitor);
      ASSERT_TRUE(first.schema && first.schema->complete);
      const auto soon =
          test::live_run({samples.begin(), samples.begin() + kBrokenAt + kSoon}, learner, kMonitor);
      const auto told = std::find_if(soon.events.begin(), soon.events.end(), [](const auto& e) {
        return e.event_kind == health_event_t::EVENT_CANDIDATE;
      });
      ASSERT_NE(told, soon.events.end());
      // The link behind the joint belongs to the edge that leads to it.
      EXPECT_EQ(robot.path_signals(told->event_from, told->event_to).contains(link->signal), true);
      const auto run = test::live_run(samples, learner, kMonitor);
      ASSERT_TRUE(run.schema);
      double worst = 0;
      for (int n = 0; n < 50; ++n) {
        const Eigen::VectorXd action = robot.random_action(rng);
        const auto truth = broken.poses_in_camera(action);
        for (const auto& [part, X_RB] : run.schema->predict_all(action))
          worst = std::max(
              worst,
              ((run.schema->X_CR * X_RB).translation() - truth.at(part).translation()).norm());
      }
      EXPECT_LT(worst, 0.015) << told_text(run);
    }
  }
}

}  // namespace
}  // namespace bodyschema
