#include "common/estimation/measurement_model.h"

#include <gtest/gtest.h>

#include <array>
#include <limits>
#include <random>

#include "common/geometry/angle.h"
#include "processes/model_monitor/likelihood/tree_filter.h"
#include "processes/structure_learner/pair_data.h"

namespace bodyschema {
namespace {

constexpr Noise kNoise{.position_m = 0.003, .rotation_rad = 1 * kDegree};

/// The same standard deviations as an observation's own, as told, and as systematic.
std::array<MeasurementModel, 3> three_ways() {
  std::array<MeasurementModel, 3> models;
  models[1].noise = kNoise;
  models[2].systematic = kNoise;
  return models;
}

/// Two rigid parts and what is seen of them.
struct Scene {
  Pose X_CA = Pose::Identity(), X_AB = Pose::Identity();
  std::vector<ActionPoseSample> samples;

  explicit Scene(int num_samples) {
    std::mt19937 random(1);
    std::normal_distribution<double> normal(0, 1);
    X_CA.translation() << 0.1, -0.2, 1.5;
    X_AB.linear() = exp_so3(Eigen::Vector3d(0.3, -0.8, 0.5));
    X_AB.translation() << 0.4, 0.1, -0.2;
    for (int n = 0; n < num_samples; ++n) {
      ActionPoseSample& sample = samples.emplace_back();
      sample.sample_index = n;
      sample.action = Eigen::VectorXd::Constant(1, n);
      for (const int part : {1, 2}) {
        PartObservation& seen = sample.parts.emplace_back();
        seen.part = part;
        Vector6d error;
        for (double& x : error) x = normal(random);
        error.head<3>() *= kNoise.position_m;
        error.tail<3>() *= kNoise.rotation_rad;
        seen.X_CB = (part == 1 ? X_CA : X_CA * X_AB) * exp(error);
      }
    }
  }

  /// With covariances of their own where `model` tells none.
  std::vector<ActionPoseSample> as_told_by(const MeasurementModel& model) const {
    std::vector<ActionPoseSample> result = samples;
    if (!model.noise && model.systematic.position_m == 0)
      for (ActionPoseSample& sample : result)
        for (PartObservation& seen : sample.parts) seen.covariance = isotropic(kNoise);
    return result;
  }
};

TEST(MeasurementModel, ToldInThreeWaysIsTheSameDistanceToThePairsTheRootAndTheMonitor) {
  constexpr int kNum = 200;
  const Scene scene(kNum);
  BodySchema schema;
  schema.signals = {{"q", 0, kNum}};
  schema.parts = {1, 2};
  schema.root = 1;
  schema.X_CR = scene.X_CA;
  Edge edge;
  edge.from = 1;
  edge.to = 2;
  edge.left = scene.X_AB;
  schema.edges = {edge};
  schema.complete = true;
  std::array<double, 3> of_pair{}, of_root{}, of_monitor{};
  for (std::size_t way = 0; way < 3; ++way) {
    const MeasurementModel model = three_ways()[way];
    const auto samples = scene.as_told_by(model);
    const PairData pair = make_pair_data(samples, 1, 2, model, kNum);
    const PairData root = make_part_data(samples, 1, model, kNum);
    const TreeFilter filter(schema, model);
    for (int t = 0; t < kNum; ++t) {
      of_pair[way] +=
          (pair.primary(t).whitening * log(scene.X_AB.inverse() * pair.primary(t).z)).squaredNorm();
      of_root[way] +=
          (root.primary(t).whitening * log(scene.X_CA.inverse() * root.primary(t).z)).squaredNorm();
      of_monitor[way] += filter.judge(filter.prepare(samples[t])).squared_distance[0];
    }
    // χ²₆, five standard deviations of the mean.
    EXPECT_NEAR(of_pair[way] / kNum, 6, 5 * std::sqrt(12.0 / kNum)) << way;
    EXPECT_NEAR(of_root[way], of_monitor[way], 1e-2 * of_root[way]) << way;
  }
  for (const std::size_t way : {1U, 2U}) {
    EXPECT_NEAR(of_pair[way], of_pair[0], 1e-3 * of_pair[0]);
    EXPECT_NEAR(of_root[way], of_root[0], 1e-3 * of_root[0]);
    EXPECT_NEAR(of_monitor[way], of_monitor[0], 1e-3 * of_monitor[0]);
  }
}

TEST(MeasurementModel, ScalesTheNoiseAndLeavesTheSystematicError) {
  MeasurementModel model{.noise = kNoise, .systematic = {0.001, 0.002}, .scale = 2};
  const PartObservation seen;
  const Matrix6d covariance = model.covariance(seen);
  EXPECT_NEAR(covariance(0, 0), 4 * 0.003 * 0.003 + 1e-6, 1e-9);
  EXPECT_NEAR(covariance(5, 5), 4 * kNoise.rotation_rad * kNoise.rotation_rad + 4e-6, 1e-9);
  EXPECT_EQ(covariance(0, 5), 0);
}

TEST(MeasurementModel, ReadsAPositionAloneAsTurnedAsExpected) {
  MeasurementModel measurement;
  measurement.noise = Noise{0.01, 0.1};
  PartObservation o;
  o.has_rotation = false;
  o.X_CB.translation() << 1, 2, 3;
  EXPECT_TRUE(measurement.covariance(o).bottomRows<3>().isZero(0));
  EXPECT_TRUE(measurement.covariance(o).rightCols<3>().isZero(0));
  measurement.noise.reset();
  o.covariance.diagonal() << 1, 4, 9, 0, 0, 0;
  Pose expected = Pose::Identity();
  expected.linear() = Eigen::AngleAxisd(M_PI / 2, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  const auto reading = measurement.reading(o, expected);
  EXPECT_EQ(reading.num_residuals, 3);
  EXPECT_EQ(reading.X_CB.translation(), o.X_CB.translation());
  EXPECT_EQ(reading.X_CB.linear(), expected.linear());
  EXPECT_NEAR(reading.covariance(0, 0), 4, 1e-9) << "x of the part is y of the camera";
  EXPECT_NEAR(reading.covariance(1, 1), 1, 1e-9);
  EXPECT_EQ(reading.covariance.llt().info(), Eigen::Success);
}

}  // namespace
}  // namespace bodyschema
