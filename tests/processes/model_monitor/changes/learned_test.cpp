#include "processes/model_monitor/changes/learned.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

#include "processes/model_monitor/likelihood/tree_filter.h"
#include "tests/processes/model_monitor/changed_arm.h"

namespace bodyschema {
namespace {

constexpr int kOwn = 2, kOther = 5;
constexpr double kOutlierRate = 0.04;

class LearnedEdgeTest : public ChangedArm {
 protected:
  LearnedEdgeTest() : ChangedArm(5) {}

  /// With 3 mm and 1°.
  template <typename PoseOf>
  std::vector<PlaceMeasurement> measure_pose(int count, PoseOf pose_of) {
    const Vector6d sigma = nominal_sigma();
    std::vector<PlaceMeasurement> result;
    for (int n = 0; n < count; ++n) {
      PlaceMeasurement m;
      m.displacements.resize(7);
      for (double& q : m.displacements) q = test::uniform(rng_, -1.35, 1.35);
      m.z = pose_of(m.displacements) * exp(sigma.cwiseProduct(test::gaussian6(rng_)));
      m.covariance = sigma.cwiseAbs2().asDiagonal();
      result.push_back(m);
    }
    return result;
  }
  template <typename Displacement>
  std::vector<PlaceMeasurement> measure(int count, Displacement displacement) {
    return measure_pose(count,
                        [&](const Eigen::VectorXd& theta) { return at(displacement(theta)); });
  }
  Pose at(double displacement) const {
    return edge().predict(Eigen::VectorXd::Constant(7, displacement));
  }
  const Edge& edge() const { return ChangedArm::edge(schema_); }
  /// Mean error of the position over the range [m].
  template <typename Displacement>
  double error(const Edge& learned, Displacement displacement) {
    return pose_error(learned, [&](const Eigen::VectorXd& q) { return at(displacement(q)); });
  }
  template <typename PoseOf>
  double pose_error(const Edge& learned, PoseOf pose_of) {
    constexpr int kActions = 200;
    double sum = 0;
    for (int n = 0; n < kActions; ++n) {
      Eigen::VectorXd theta(7);
      for (double& q : theta) q = test::uniform(rng_, -1.3, 1.3);
      sum += (learned.predict(theta).translation() - pose_of(theta).translation()).norm();
    }
    return sum / kActions;
  }
};

double worn(const Eigen::VectorXd& q) { return q(kOwn) + 0.6 * std::sin(3 * q(kOwn)); }
double coupled(const Eigen::VectorXd& q) { return q(kOwn) + 0.5 * q(kOther); }

TEST_F(LearnedEdgeTest, AWornJointIsAFunctionOfItsOwnSignal) {
  const double before = error(edge(), worn);
  for (const int count : {12, 40}) {
    const auto learned = learn_edge(schema_, kPart, measure(count, worn), kOutlierRate);
    ASSERT_FALSE(learned.empty());
    EXPECT_EQ(learned.front().change.form, Form::kNonlinear);
    EXPECT_EQ(learned.front().change.signal, kOwn);
    EXPECT_EQ(learned.front().change.second_signal, -1);
    EXPECT_EQ(learned.front().edge.signals(), std::vector<int>{kOwn});
    EXPECT_LT(error(learned.front().edge, worn), (count == 12 ? 0.3 : 0.05) * before);
  }
}

TEST_F(LearnedEdgeTest, AJointThatFollowsASecondSignalIsAFunctionOfBoth) {
  const double before = error(edge(), coupled);
  const auto learned = learn_edge(schema_, kPart, measure(20, coupled), kOutlierRate);
  ASSERT_FALSE(learned.empty());
  const std::vector<int> signals = learned.front().edge.signals();
  EXPECT_EQ(signals, (std::vector<int>{kOwn, kOther}));
  EXPECT_LT(error(learned.front().edge, coupled), 0.1 * before);
}

TEST_F(LearnedEdgeTest, AnExchangedJointOnAnotherSignalIsLearnedAfreshOnThatAlone) {
  const Pose left = test::random_pose(rng_, 0.06, 0.16),
             right = test::random_pose(rng_, 0.06, 0.16);
  const auto exchanged = [&](const Eigen::VectorXd& q) {
    Vector6d turn = Vector6d::Zero();
    turn(3) = std::sin(1.5 * q(kOther));
    return left * exp(turn) * right;
  };
  const auto learned = learn_edge(schema_, kPart, measure_pose(30, exchanged), kOutlierRate);
  ASSERT_FALSE(learned.empty());
  EXPECT_EQ(learned.front().change.form, Form::kFresh);
  EXPECT_EQ(learned.front().edge.signals(), std::vector<int>{kOther});
  EXPECT_LT(pose_error(learned.front().edge, exchanged), 0.1 * pose_error(edge(), exchanged));
}

TEST_F(LearnedEdgeTest, OutliersAreNotTrainedOn) {
  auto measurements = measure(20, worn);
  for (const int n : {4, 11}) {
    Pose& z = measurements[static_cast<std::size_t>(n)].z;
    z = z * exp((Vector6d() << 0.1, 0, 0, 0.9, 0, 0).finished());
  }
  const auto learned = learn_edge(schema_, kPart, measurements, kOutlierRate);
  ASSERT_FALSE(learned.empty());
  const ResidualGp& process = *learned.front().edge.residual_gp;
  EXPECT_LE(process.num_samples(), 18);
  EXPECT_GE(process.num_samples(), 16);
  for (const int n : {4, 11})
    EXPECT_FALSE(
        (process.inputs().array() == measurements[static_cast<std::size_t>(n)].displacements(kOwn))
            .any());
  EXPECT_LT(error(learned.front().edge, worn), 0.2 * error(edge(), worn));
}

TEST_F(LearnedEdgeTest, ItsEvidenceIsThePriorsShareAndTheLikelihoodAtThePeak) {
  const auto measurements = measure(15, worn);
  const auto learned = learn_edge(schema_, kPart, measurements, kOutlierRate);
  ASSERT_FALSE(learned.empty());
  const LearnedEdge& best = learned.front();
  ASSERT_EQ(best.edge.residual_gp->num_samples(), 15);
  double sum = best.log_prior;
  for (const PlaceMeasurement& m : measurements) {
    sum += std::log1p(-kOutlierRate) +
           log_normal_density(log(best.certain.predict(m.displacements).inverse() * m.z),
                              m.covariance);
    EXPECT_LT(best.certain.residual_gp->variance(m.displacements).norm(),
              1e-6 * best.edge.residual_gp->variance(m.displacements).norm());
  }
  // Log is not linear: large residuals cost the difference.
  EXPECT_NEAR(best.log_evidence, sum, 1);
}

TEST_F(LearnedEdgeTest, WhatIsElsewhereAtEverySampleIsNoFunction) {
  auto measurements = measure(30, [](const Eigen::VectorXd& q) { return q(kOwn); });
  for (PlaceMeasurement& m : measurements) {
    Vector6d wobble = Vector6d::Zero();
    for (int c = 3; c < 6; ++c) wobble(c) = test::uniform(rng_, -1, 1);
    m.z = m.z * exp(wobble);
  }
  for (const std::size_t count : {8, 15, 30})
    EXPECT_TRUE(learn_edge(schema_, kPart,
                           {measurements.begin(),
                            measurements.begin() + static_cast<std::ptrdiff_t>(count)},
                           kOutlierRate)
                    .empty())
        << count;
}

TEST_F(LearnedEdgeTest, AnEdgeThatHasAProcessIsOnlyLearnedAfresh) {
  const auto measurements = measure(30, worn);
  const auto first = learn_edge(schema_, kPart, measurements, kOutlierRate);
  ASSERT_FALSE(first.empty());
  edge_at(&schema_, kPart) = first.front().edge;
  const auto inverse = [](const Eigen::VectorXd& q) { return -q(kOwn); };
  const auto again = learn_edge(schema_, kPart, measure(30, inverse), kOutlierRate);
  ASSERT_FALSE(again.empty());
  for (const LearnedEdge& learned : again) EXPECT_EQ(learned.change.form, Form::kFresh);
}

TEST_F(LearnedEdgeTest, TooFewMeasurementsOrNoEdgeTeachNothing) {
  EXPECT_TRUE(learn_edge(schema_, kPart, measure(4, worn), kOutlierRate).empty());
  EXPECT_TRUE(learn_edge(schema_, kPart, {}, kOutlierRate).empty());
  EXPECT_TRUE(learn_edge(schema_, schema_.root, measure(20, worn), kOutlierRate).empty());
}

}  // namespace
}  // namespace bodyschema
