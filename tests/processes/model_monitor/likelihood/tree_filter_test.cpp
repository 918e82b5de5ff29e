#include "processes/model_monitor/likelihood/tree_filter.h"

#include <gtest/gtest.h>

#include <cmath>

#include "common/geometry/angle.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::Rng;

Matrix6d random_covariance(Rng& rng, double position_m, double rotation_rad) {
  Matrix6d A;
  for (Eigen::Index n = 0; n < 36; ++n) A(n) = test::gaussian(rng);
  Vector6d scale;
  scale << Eigen::Vector3d::Constant(position_m), Eigen::Vector3d::Constant(rotation_rad);
  return scale.asDiagonal() * (A * A.transpose() / 6 + 0.2 * Matrix6d::Identity()) *
         scale.asDiagonal();
}

/// Five parts: 1 the root, 2 and 3 on it, 4 and 5 on 2. All edges move, and all are uncertain by
/// about a tenth of a millimetre and a hundredth of a degree: there the filter is linear.
class TreeFilterTest : public testing::Test {
 protected:
  TreeFilterTest() {
    schema_.root = 1;
    schema_.X_CR = test::random_pose(rng_, 1, 2);
    schema_.X_CR_covariance = random_covariance(rng_, 1e-4, 0.01 * kDegree);
    for (int s = 0; s < 4; ++s) schema_.signals.push_back({"q" + std::to_string(s + 1), -1, 1});
    schema_.parts = {1, 2, 3, 4, 5};
    for (const auto& [from, to] : {std::pair{1, 2}, {1, 3}, {2, 4}, {2, 5}}) {
      Edge edge;
      edge.from = from;
      edge.to = to;
      edge.left = test::random_pose(rng_, 0.1, 0.2);
      ScrewJoint joint;
      joint.signal = to - 2;
      joint.turn = 1;
      joint.X_after = test::random_pose(rng_, 0.1, 0.2);
      edge.joints.push_back(joint);
      edge.parameter_covariance = Eigen::MatrixXd::Zero(14, 14);
      edge.parameter_covariance.block<6, 6>(8, 8) = random_covariance(rng_, 1e-4, 0.01 * kDegree);
      schema_.edges.push_back(edge);
    }
    sample_.action.resize(4);
    for (double& q : sample_.action) q = test::uniform(rng_, -1, 1);
    for (const auto& [part, X_RB] : schema_.predict_all(sample_.action)) {
      PartObservation o;
      o.part = part;
      o.covariance = random_covariance(rng_, 2e-4, 0.02 * kDegree);
      const Matrix6d root = o.covariance.llt().matrixL();
      o.X_CB = schema_.X_CR * X_RB * exp(root * test::gaussian6(rng_));
      sample_.parts.push_back(o);
    }
  }

  void hide(int part) {
    std::erase_if(sample_.parts, [part](const PartObservation& o) { return o.part == part; });
  }

  /// The errors of X_CR and of every edge are independent, e ~ N(0, C); the markers see y = H e +
  /// noise. All of them at once, without a tree.
  struct Joint {
    Eigen::MatrixXd H, C, noise;
    Eigen::VectorXd y;
  };
  Joint joint() const {
    const TreeFilter filter(schema_, measurement_);
    const TreeFilter::Instant instant = filter.prepare(sample_);
    const Eigen::Index n = filter.num_nodes();
    Joint j;
    j.C = Eigen::MatrixXd::Zero(6 * n, 6 * n);
    std::vector<Eigen::MatrixXd> rows;  // δ_k as a function of all e
    std::vector<Pose> poses;
    std::vector<int> seen;
    for (Eigen::Index k = 0; k < n; ++k) {
      const auto node = static_cast<std::size_t>(k);
      const int parent = filter.parent(static_cast<int>(k));
      j.C.block<6, 6>(6 * k, 6 * k) = instant.edge_covariance[node];
      Eigen::MatrixXd row = Eigen::MatrixXd::Zero(6, 6 * n);
      Pose X = instant.delta[node];
      if (parent >= 0) {
        row = adjoint(X.inverse()) * rows[static_cast<std::size_t>(parent)];
        X = poses[static_cast<std::size_t>(parent)] * X;
      }
      row.block<6, 6>(0, 6 * k) += Matrix6d::Identity();
      rows.push_back(row);
      poses.push_back(X);
      if (instant.seen[node]) seen.push_back(static_cast<int>(k));
    }
    const auto m = static_cast<Eigen::Index>(seen.size());
    j.H.resize(6 * m, 6 * n);
    j.y.resize(6 * m);
    j.noise = Eigen::MatrixXd::Zero(6 * m, 6 * m);
    for (Eigen::Index s = 0; s < m; ++s) {
      const auto node = static_cast<std::size_t>(seen[static_cast<std::size_t>(s)]);
      j.H.middleRows<6>(6 * s) = rows[node];
      j.y.segment<6>(6 * s) = log(poses[node].inverse() * instant.seen[node]->X_CB);
      j.noise.block<6, 6>(6 * s, 6 * s) = instant.seen[node]->covariance;
    }
    return j;
  }

  Rng rng_{7};
  BodySchema schema_;
  ActionPoseSample sample_;
  MeasurementModel measurement_ = [] {
    MeasurementModel measurement;
    measurement.outlier_rate = 1e-9;
    return measurement;
  }();
};

double log_normal(const Eigen::VectorXd& y, const Eigen::MatrixXd& S) {
  const Eigen::LLT<Eigen::MatrixXd> llt(S);
  return -0.5 * y.dot(llt.solve(y)) - llt.matrixLLT().diagonal().array().log().sum() -
         0.5 * static_cast<double>(y.size()) * std::log(2 * M_PI);
}

TEST_F(TreeFilterTest, AnEdgeIsAlsoUncertainByTheScatterOfItsJoints) {
  const Eigen::VectorXd theta = Eigen::VectorXd::Constant(4, 0.3);
  Edge edge = schema_.edges[0];
  EXPECT_EQ(model_covariance(edge, theta), edge.prediction_covariance(theta));
  edge.joints[0].scatter = 0.02;
  EXPECT_TRUE(
      model_covariance(edge, theta)
          .isApprox(edge.prediction_covariance(theta) + edge.scatter_covariance(theta), 1e-12));
  EXPECT_GT(edge.scatter_covariance(theta).trace(), 0.02 * 0.02);
}

TEST_F(TreeFilterTest, LikelihoodIsThatOfAllMarkersTogether) {
  const TreeFilter filter(schema_, measurement_);
  const Joint j = joint();
  const double expected = log_normal(j.y, j.H * j.C * j.H.transpose() + j.noise);
  const auto judgement = filter.judge(filter.prepare(sample_));
  EXPECT_NEAR(judgement.log_likelihood, expected, 0.02);
  EXPECT_EQ(judgement.believed, std::vector<int>(5, 1));
}

TEST_F(TreeFilterTest, LikelihoodIsThatOfTheMarkersSeen) {
  hide(2);
  hide(1);
  const TreeFilter filter(schema_, measurement_);
  const Joint j = joint();
  const double expected = log_normal(j.y, j.H * j.C * j.H.transpose() + j.noise);
  const auto judgement = filter.judge(filter.prepare(sample_));
  EXPECT_NEAR(judgement.log_likelihood, expected, 0.02);
  EXPECT_EQ(judgement.believed[0], -1);
  EXPECT_EQ(judgement.squared_distance[0], -1);
}

/// The error of an edge as all markers tell it when its own model says nothing.
TEST_F(TreeFilterTest, VirtualMeasurementIsWhatTheOtherMarkersSayOfAnEdge) {
  for (const int hidden : {0, 2, 5}) {
    if (hidden > 0) hide(hidden);
    const TreeFilter filter(schema_, measurement_);
    const auto instant = filter.prepare(sample_);
    const Joint j = joint();
    for (int node = 0; node < filter.num_nodes(); ++node) {
      SCOPED_TRACE("edge to part " + std::to_string(filter.part(node)) + ", hidden " +
                   std::to_string(hidden));
      const auto measured = filter.measure_edge(instant, node);
      if (filter.part(node) == hidden && filter.children(node).empty()) {
        EXPECT_FALSE(measured);
        continue;
      }
      ASSERT_TRUE(measured);
      Eigen::MatrixXd information = j.H.transpose() * j.noise.inverse() * j.H;
      for (int other = 0; other < filter.num_nodes(); ++other)
        if (other != node)
          information.block<6, 6>(6 * other, 6 * other) +=
              j.C.block<6, 6>(6 * other, 6 * other).inverse();
      const Eigen::MatrixXd covariance = information.inverse();
      const Eigen::VectorXd e = covariance * (j.H.transpose() * j.noise.inverse() * j.y);
      const Matrix6d expected = covariance.block<6, 6>(6 * node, 6 * node);
      const Vector6d sigma = expected.diagonal().cwiseSqrt();
      const Vector6d error =
          log(instant.delta[static_cast<std::size_t>(node)].inverse() * measured->z) -
          e.segment<6>(6 * node);
      EXPECT_LT(error.cwiseQuotient(sigma).norm(), 0.02);
      EXPECT_LT((measured->covariance - expected).cwiseQuotient(sigma * sigma.transpose()).norm(),
                0.02);
    }
  }
}

TEST_F(TreeFilterTest, AMarkerIsMeasuredWithoutItself) {
  const Pose T = test::random_pose(rng_, 0.1, 0.2);
  for (PartObservation& o : sample_.parts)
    if (o.part == 2) o.X_CB = o.X_CB * T;
  const TreeFilter filter(schema_, measurement_);
  const auto measured = filter.measure_marker(filter.prepare(sample_), filter.node_of(2));
  ASSERT_TRUE(measured);
  const Vector6d error = log(T.inverse() * measured->z);
  EXPECT_LT(error.dot(measured->covariance.ldlt().solve(error)), 22.5);  // χ²₆(.999)
  hide(2);
  EXPECT_FALSE(filter.measure_marker(filter.prepare(sample_), filter.node_of(2)));
}

TEST_F(TreeFilterTest, AnEdgeWithNothingSeenBehindItIsNotMeasured) {
  hide(4);
  const TreeFilter filter(schema_, measurement_);
  EXPECT_FALSE(filter.measure_edge(filter.prepare(sample_), filter.node_of(4)));
  hide(2);
  hide(5);
  const auto instant = filter.prepare(sample_);
  EXPECT_FALSE(filter.measure_edge(instant, filter.node_of(2)));
  EXPECT_TRUE(filter.measure_edge(instant, filter.node_of(3)));
}

/// The chain of evidence: a wrong edge speaks for being cut, a wrong marker for being detached.
TEST_F(TreeFilterTest, TellsAWrongEdgeFromAWrongMarker) {
  measurement_.outlier_rate = 0.03;
  const Pose T = test::random_pose(rng_, 0.1, 0.2);
  const TreeFilter filter(schema_, measurement_);
  const int node = filter.node_of(2);
  Alternative cut, detached;
  cut.cut_edges = {node};
  detached.detached_node = node;
  const auto ratio = [&](const ActionPoseSample& sample, const Alternative& alternative) {
    const auto instant = filter.prepare(sample);
    return filter.judge(instant, alternative).log_likelihood - filter.judge(instant).log_likelihood;
  };
  EXPECT_LT(ratio(sample_, cut), 0);
  EXPECT_LT(ratio(sample_, detached), 0);
  ActionPoseSample edge = sample_, marker = sample_;
  for (PartObservation& o : edge.parts)
    if (o.part == 2 || o.part == 4 || o.part == 5) {
      const Pose X_C1 = edge.find(1)->X_CB;
      o.X_CB = X_C1 * T * X_C1.inverse() * o.X_CB;
    }
  for (PartObservation& o : marker.parts)
    if (o.part == 2) o.X_CB = o.X_CB * T;
  EXPECT_GT(ratio(edge, cut), ratio(edge, detached) + 5);
  EXPECT_GT(ratio(marker, detached), ratio(marker, cut) + 5);
}

TEST_F(TreeFilterTest, AFlippedMarkerIsReadInItsOtherPoseOrNotBelieved) {
  measurement_.outlier_rate = 0.03;
  const TreeFilter filter(schema_, measurement_);
  const int node = filter.node_of(4);
  const double healthy = filter.judge(filter.prepare(sample_)).log_likelihood;
  Vector6d tilt = Vector6d::Zero();
  tilt(3) = 40 * kDegree;
  for (PartObservation& o : sample_.parts) {
    if (o.part != 4) continue;
    o.X_CB_other = o.X_CB;
    o.X_CB = o.X_CB * exp(tilt);
  }
  const auto read = filter.judge(filter.prepare(sample_));
  EXPECT_EQ(read.believed[static_cast<std::size_t>(node)], 1);
  EXPECT_NEAR(read.log_likelihood, healthy, 5);
  for (PartObservation& o : sample_.parts) o.X_CB_other.reset();
  const auto refused = filter.judge(filter.prepare(sample_));
  EXPECT_EQ(refused.believed[static_cast<std::size_t>(node)], 0);
  EXPECT_LT(refused.log_likelihood, healthy - 5);
}

TEST_F(TreeFilterTest, AFlippedTagBesideThePartsOriginSpeaksForNoBrokenEdge) {
  // The tag sits 5 cm beside the part's origin: the flip moves the part. Its other reading is near
  // the truth, not quite.
  measurement_.outlier_rate = 0.03;
  const TreeFilter filter(schema_, measurement_);
  Vector6d tilt = Vector6d::Zero();
  tilt(4) = 40 * kDegree;
  Pose X_BM = Pose::Identity();
  X_BM.translation().x() = 0.05;
  for (PartObservation& o : sample_.parts) {
    if (o.part != 4) continue;
    o.X_CB_other = o.X_CB * Eigen::Translation3d(8 * std::sqrt(o.covariance(0, 0)), 0, 0);
    o.X_CB = o.X_CB * X_BM * exp(tilt) * X_BM.inverse();
  }
  const TreeFilter::Instant instant = filter.prepare(sample_);
  Alternative cut;
  cut.cut_edges = {filter.node_of(4)};
  EXPECT_LT(filter.judge(instant, cut).log_likelihood - filter.judge(instant).log_likelihood, 3);
}

TEST_F(TreeFilterTest, NothingCrossesAnInvalidEdge) {
  const int node = TreeFilter(schema_, measurement_).node_of(2);
  schema_.edges[0].state = EdgeState::kInvalid;
  const TreeFilter filter(schema_, measurement_);
  const auto before = filter.judge(filter.prepare(sample_));
  // Wherever the whole branch behind it is, it is as likely.
  const Pose T = test::random_pose(rng_, 0.1, 0.2);
  for (PartObservation& o : sample_.parts)
    if (o.part == 2 || o.part == 4 || o.part == 5) o.X_CB = T * o.X_CB;
  const auto after = filter.judge(filter.prepare(sample_));
  EXPECT_NEAR(before.log_likelihood, after.log_likelihood, 1e-6);
  EXPECT_EQ(after.believed[static_cast<std::size_t>(node)], 1);
}

TEST_F(TreeFilterTest, PartsWithoutAWayToTheRootTakeNoPart) {
  schema_.edges.erase(schema_.edges.begin());
  const TreeFilter filter(schema_, measurement_);
  EXPECT_EQ(filter.num_nodes(), 2);
  EXPECT_EQ(filter.node_of(4), -1);
  EXPECT_TRUE(std::isfinite(filter.judge(filter.prepare(sample_)).log_likelihood));
}

TEST_F(TreeFilterTest, RefusesAnActionOfAnotherLength) {
  sample_.action.resize(3);
  const TreeFilter filter(schema_, measurement_);
  EXPECT_THROW(filter.prepare(sample_), std::invalid_argument);
}

// Behind a cut two markers agree or do not, whichever of them the belief is begun from.
TEST_F(TreeFilterTest, BehindACutTheBeginningsAreAlternatives) {
  hide(2);
  hide(3);
  const TreeFilter filter(schema_, measurement_);
  const TreeFilter::Instant instant = filter.prepare(sample_);
  const int top = filter.node_of(2), a = filter.node_of(4), b = filter.node_of(5);
  const auto at = [](int node) { return static_cast<std::size_t>(node); };
  const double together = filter.judge(instant, {.cut_edges = {top}}).log_likelihood;
  hide(4);
  hide(5);
  const double rest = filter.judge(filter.prepare(sample_), {.cut_edges = {top}}).log_likelihood;
  // 5 as seen from 4, by way of 2.
  const Pose X = instant.seen[at(a)]->X_CB * instant.delta[at(a)].inverse() * instant.delta[at(b)];
  const Matrix6d F = adjoint(X.inverse() * instant.seen[at(a)]->X_CB);
  const Matrix6d at_2 = instant.seen[at(a)]->covariance + instant.edge_covariance[at(a)];
  const Matrix6d S =
      F * at_2 * F.transpose() + instant.edge_covariance[at(b)] + instant.seen[at(b)]->covariance;
  const Vector6d y = log(X.inverse() * instant.seen[at(b)]->X_CB);
  EXPECT_NEAR(together - rest, log_flat_density() + log_normal(y, S), 0.05);
}

}  // namespace
}  // namespace bodyschema
