#include "processes/model_monitor/hypotheses/change_fit.h"

#include <gtest/gtest.h>

#include <cmath>

#include "tests/processes/model_monitor/changed_arm.h"

namespace bodyschema {
namespace {

class ChangeFitTest : public ChangedArm {
 protected:
  ChangeFitTest() : ChangedArm(11) {}

  static ElementId edge() { return {ElementId::Kind::kJoint, kPart}; }
};

/// Also of an edge with something behind its joint, of one that no joint moves any more, of a
/// marker and of the camera.
TEST_F(ChangeFitTest, TheResidualsJacobianIsThatOfCentralDifferences) {
  for (Edge& edge : schema_.edges) edge.right = test::random_pose(rng_, 0.05, 0.3);
  schema_.edges[2].joints[0].gain = 1.2;
  schema_.edges[2].joints[0].slide = 0.05;
  const auto samples = observe(schema_, 5);
  for (const ElementId& element :
       {edge(), tag_element(kPart), edge_element(schema_.root, schema_.root)}) {
    const PlaceEvidence evidence(schema_, measurement_, element, pointers(samples));
    for (const BodyChange& change : possible_changes(schema_, element)) {
      SCOPED_TRACE("form " + std::to_string(static_cast<int>(change.form)));
      const Eigen::VectorXd theta = random_theta(change);
      Eigen::MatrixXd J;
      const Eigen::VectorXd r = evidence.residuals(change, theta, &J);
      ASSERT_EQ(r.size(), 30);
      ASSERT_EQ(J.cols(), theta.size());
      for (Eigen::Index p = 0; p < theta.size(); ++p) {
        constexpr double kStep = 1e-6;
        Eigen::VectorXd plus = theta, minus = theta;
        plus(p) += kStep;
        minus(p) -= kStep;
        const Eigen::VectorXd expected =
            (evidence.residuals(change, plus) - evidence.residuals(change, minus)) / (2 * kStep);
        EXPECT_LT((J.col(p) - expected).norm(), 1e-5 * (1 + expected.norm())) << p;
      }
    }
  }
}

TEST_F(ChangeFitTest, AJointThatIsNoMoreCannotHaveChanged) {
  FittedChange rigid, offset;
  rigid.change = {Form::kRigid, kPart};
  rigid.theta = Eigen::VectorXd::Zero(6);
  offset.change = {Form::kOffset, kPart};
  offset.theta = Eigen::VectorXd::Constant(1, 0.1);
  const BodySchema without = with_change(schema_, rigid);
  EXPECT_TRUE(is_possible(offset, schema_));
  EXPECT_FALSE(is_possible(offset, without));
  EXPECT_TRUE(is_possible(rigid, without));
  offset.origin = schema_;  // which has it
  EXPECT_TRUE(is_possible(offset, without));
}

TEST_F(ChangeFitTest, EveryChangeIsFoundAgainAndPreferred) {
  for (const Case& c : cases()) {
    SCOPED_TRACE("form " + std::to_string(static_cast<int>(c.change.form)));
    const BodySchema truth = changed(schema_, c.change, c.theta);
    const auto samples = observe(truth, 12);
    const int part = c.change.part;
    const ElementId element =
        c.change.form == Form::kMarkerMoved ? tag_element(part) : edge_element(part, schema_.root);
    const PlaceEvidence evidence(schema_, measurement_, element, pointers(samples));
    EXPECT_EQ(evidence.num_usable(), 12);
    std::optional<FittedChange> best;
    for (const BodyChange& change : possible_changes(schema_, element)) {
      auto fitted = evidence.fit(change);
      ASSERT_TRUE(fitted);
      if (!best || fitted->log_evidence > best->log_evidence) best = std::move(fitted);
    }
    EXPECT_EQ(best->change.form, c.change.form);
    EXPECT_GT(best->log_evidence, log_likelihood(schema_, measurement_, pointers(samples)) + 12);
    if (c.change.form == Form::kBoth) continue;  // its two sides share the turn about the axis
    const Eigen::VectorXd error = best->theta - c.theta;
    EXPECT_LT(error.dot(best->covariance.ldlt().solve(error)), 25);
  }
}

TEST_F(ChangeFitTest, AMovedMarkerIsNoMovedPart) {
  const BodyChange change{Form::kMarkerMoved, kPart};
  const auto samples = observe(changed(schema_, change, vector({0.05, 0, 0, 0, 1, 0})), 6);
  const auto marker =
      PlaceEvidence(schema_, measurement_, tag_element(kPart), pointers(samples)).fit(change);
  const auto part =
      PlaceEvidence(schema_, measurement_, edge(), pointers(samples)).fit({Form::kBent, kPart, 1});
  EXPECT_GT(marker->log_evidence, part->log_evidence + 12);
}

TEST_F(ChangeFitTest, LaplaceEvidenceIsTheIntegralOverTheParameter) {
  const BodyChange change{Form::kOffset, kPart};
  const auto samples = observe(changed(schema_, change, Eigen::VectorXd::Constant(1, 0.35)), 4);
  const auto fitted = PlaceEvidence(schema_, measurement_, edge(), pointers(samples)).fit(change);
  ASSERT_TRUE(fitted);
  const double sigma = prior_of(change, schema_).sigma(0);
  const double peak = fitted->theta(0), width = std::sqrt(fitted->covariance(0, 0));
  const double at_peak =
      log_likelihood(changed(schema_, change, fitted->theta), measurement_, pointers(samples));
  double integral = 0;
  const double h = width / 10;
  for (double t = peak - 8 * width; t <= peak + 8 * width; t += h) {
    const BodySchema with = changed(schema_, change, Eigen::VectorXd::Constant(1, t));
    integral += h *
                std::exp(log_likelihood(with, measurement_, pointers(samples)) - at_peak -
                         0.5 * t * t / (sigma * sigma)) /
                (sigma * std::sqrt(2 * M_PI));
  }
  EXPECT_NEAR(fitted->log_evidence, change.log_odds() + at_peak + std::log(integral), 0.3);
}

TEST_F(ChangeFitTest, AHealthyBodyIsBetterThanAnyChange) {
  const auto samples = observe(schema_, 12);
  const double null = log_likelihood(schema_, measurement_, pointers(samples));
  for (const ElementId& element : {edge(), tag_element(kPart)}) {
    const PlaceEvidence evidence(schema_, measurement_, element, pointers(samples));
    for (const BodyChange& change : possible_changes(schema_, element))
      EXPECT_LT(evidence.fit(change)->log_evidence, null);
  }
}

TEST_F(ChangeFitTest, AnOutlierDoesNotTurnTheFit) {
  const Eigen::VectorXd theta = vector({0.2, 0, 0.1, 0.8, -0.5, 0.3});
  const BodyChange change{Form::kBent, 7, 1};
  auto samples = observe(changed(schema_, change, theta), 6);
  for (PartObservation& o : samples.back().parts)
    if (o.part == 7) o.X_CB = o.X_CB * exp((Vector6d() << 0, 0, 0, 1, 0, 0).finished());
  const auto fitted =
      PlaceEvidence(schema_, measurement_, {ElementId::Kind::kJoint, 7}, pointers(samples))
          .fit(change);
  ASSERT_TRUE(fitted);
  const Eigen::VectorXd error = fitted->theta - theta;
  EXPECT_LT(error.head<3>().norm(), 0.01);
  EXPECT_LT(error.tail<3>().norm(), 0.05);
}

TEST_F(ChangeFitTest, TooFewSamplesFitNothing) {
  auto samples = observe(schema_, 1);
  const PlaceEvidence one(schema_, measurement_, edge(), pointers(samples));
  EXPECT_TRUE(one.fit({Form::kStuck, kPart}));
  EXPECT_FALSE(one.fit({Form::kBent, kPart, 1}));
  // Nothing beyond the edge was seen: the sample says nothing of it.
  std::erase_if(samples[0].parts, [](const PartObservation& o) { return o.part >= kPart; });
  const PlaceEvidence none(schema_, measurement_, edge(), pointers(samples));
  EXPECT_EQ(none.num_usable(), 0);
  EXPECT_FALSE(none.fit({Form::kStuck, kPart}));
}

TEST_F(ChangeFitTest, AStoredEdgeComesBackAsItWas) {
  const BodySchema bent =
      changed(schema_, {Form::kStuck, kPart}, Eigen::VectorXd::Constant(1, 0.5));
  FittedChange stored;
  stored.change = {Form::kStored, kPart};
  stored.origin = schema_;
  const BodySchema back = with_change(bent, stored);
  EXPECT_EQ(edge_to(back, kPart)->joints[0].gain, 1);
  EXPECT_EQ(edge_to(with_edge_of(bent, schema_, 5), kPart)->joints[0].gain, 0);
}

}  // namespace
}  // namespace bodyschema
