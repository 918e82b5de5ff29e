// A body whose last part is seen without its orientation.
#include <gtest/gtest.h>

#include <algorithm>
#include <string>
#include <vector>

#include "common/estimation/chi_square.h"
#include "common/estimation/quantile.h"
#include "processes/model_monitor/likelihood/tree_filter.h"
#include "tests/processes/model_monitor/adaptation_life.h"

namespace bodyschema {
namespace {

using test::Regime;
using test::Rng;

class PositionsAlone : public testing::TestWithParam<int> {
 protected:
  PositionsAlone() {
    schema_ = test::true_schema(robot_);
    schema_.position_parts = {leaf_};
  }

  std::vector<ActionPoseSample> babble(int num_samples, std::int64_t first, Regime regime) {
    auto samples =
        test::with_positions_alone(test::babble(robot_, num_samples, {regime}, rng_), {leaf_});
    for (ActionPoseSample& sample : samples) {
      sample.sample_index += first;
      sample.utime += 1000000 * first;
    }
    return samples;
  }

  double leaf_error_m(const BodySchema& schema) {
    double worst = 0;
    for (int n = 0; n < 20; ++n) {
      const Eigen::VectorXd q = robot_.random_action(rng_);
      const auto poses = robot_.poses_in_camera(q);
      const Eigen::Vector3d truth = poses.at(schema.root).inverse() * poses.at(leaf_).translation();
      const auto predicted = schema.predict(schema.root, leaf_, q);
      worst = std::max(worst, (predicted->X_AB.translation() - truth).norm());
    }
    return worst;
  }

  Rng rng_{static_cast<std::uint64_t>(GetParam())};
  test::SyntheticRobot robot_ = test::chapter_robot("c", rng_);
  const int leaf_ = robot_.visible_parts().back();
  BodySchema schema_;
};
INSTANTIATE_TEST_SUITE_P(, PositionsAlone, testing::Range(1, 6));

TEST_P(PositionsAlone, AreJudgedByThreeResiduals) {
  const MeasurementModel measurement{.noise = test::nominal_noise(Regime::kChapter)};
  const TreeFilter filter(schema_, measurement);
  const int node = filter.node_of(leaf_);
  std::vector<double> distances;
  double without = 0;
  for (ActionPoseSample& sample : babble(400, 0, Regime::kChapter)) {
    const auto instant = filter.prepare(sample);
    EXPECT_EQ(instant.seen[static_cast<std::size_t>(node)]->num_residuals, 3);
    const auto judgement = filter.judge(instant);
    EXPECT_TRUE(std::isfinite(judgement.log_likelihood));
    distances.push_back(judgement.squared_distance[static_cast<std::size_t>(node)]);
    without += distances.back() > kOutlierThreshold;
  }
  EXPECT_NEAR(median(distances), chi_square_median(6), 0.8);
  EXPECT_LT(without, 8) << "of 400 samples one is expected";
}

TEST_P(PositionsAlone, AHealthyBodyHasNoEvents) {
  Adaptation adaptation(schema_, test::adaptation_options(Regime::kTagIso));
  for (const ActionPoseSample& sample : babble(300, 0, Regime::kTagIso))
    for (const AdaptationEvent& e : adaptation.on_sample(sample)) ADD_FAILURE() << test::text(e);
  EXPECT_NEAR(adaptation.noise_scale(), 1, 0.15);
}

TEST_P(PositionsAlone, AnExchangedToolIsFoundAndLearned) {
  Adaptation adaptation(schema_, test::adaptation_options(Regime::kTagIso));
  constexpr int kHealthy = 80;
  for (const ActionPoseSample& sample : babble(kHealthy, 0, Regime::kTagIso))
    for (const AdaptationEvent& e : adaptation.on_sample(sample)) ADD_FAILURE() << test::text(e);
  robot_.links.back().X_after.translation() += Eigen::Vector3d(0.05, 0.03, 0);
  std::string events;
  for (const ActionPoseSample& sample : babble(60, kHealthy, Regime::kTagIso))
    for (const AdaptationEvent& e : adaptation.on_sample(sample)) {
      events += test::text(e) + "\n";
      EXPECT_TRUE(e.part == leaf_ || e.to == leaf_) << test::text(e);
    }
  EXPECT_NE(events, "");
  EXPECT_LT(leaf_error_m(adaptation.schema()), 0.01) << events;
}

}  // namespace
}  // namespace bodyschema
