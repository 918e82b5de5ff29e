#include "processes/model_monitor/changes/body_change.h"

#include <gtest/gtest.h>

#include <cmath>
#include <map>

#include "tests/processes/model_monitor/changed_arm.h"

namespace bodyschema {
namespace {

class BodyChangeTest : public ChangedArm {
 protected:
  BodyChangeTest() : ChangedArm(3) {
    for (Edge& edge : schema_.edges) edge.right = test::random_pose(rng_, 0.05, 0.1);
    schema_.edges[2].joints[0].gain = 1.2;
    schema_.edges[2].joints[0].slide = 0.05;
    action_ = Eigen::VectorXd::Constant(7, 0.4);
    action_(2) = -0.7;
  }

  Pose predict(const BodySchema& schema) const {
    return edge(schema).predict(schema.displacements(action_));
  }
  /// The edge's screw by hand.
  Pose by_hand(double displacement) const {
    const Edge& e = edge(schema_);
    Vector6d screw = Vector6d::Zero();
    screw(2) = e.joints[0].slide;
    screw(5) = e.joints[0].turn;
    return e.left * exp(screw * displacement) * e.joints[0].X_after * e.right;
  }

  Eigen::VectorXd action_;
};

TEST_F(BodyChangeTest, EveryFormIsWhatItSays) {
  const double q = action_(2);
  const auto of = [&](Form form, const Eigen::VectorXd& theta) {
    return predict(changed(schema_, {form, kPart}, theta));
  };
  const Eigen::VectorXd one = Eigen::VectorXd::Constant(1, 0.3);
  EXPECT_TRUE(of(Form::kStuck, one).isApprox(by_hand(0.3), 1e-12));
  EXPECT_TRUE(of(Form::kOffset, one).isApprox(by_hand(1.2 * q + 0.3), 1e-12));
  EXPECT_TRUE(
      of(Form::kGain, Eigen::Vector2d(-0.3, 0.1)).isApprox(by_hand(1.2 * 0.7 * q + 0.1), 1e-12));
  const Pose before = predict(schema_);
  const Eigen::VectorXd six = random_theta({Form::kBent, kPart});
  const auto bent = [&](int link) {
    return predict(changed(schema_, {Form::kBent, kPart, link}, six));
  };
  EXPECT_TRUE(bent(0).isApprox(transform(six) * before, 1e-12));
  EXPECT_TRUE(bent(1).isApprox(before * transform(six), 1e-12));
  EXPECT_TRUE(of(Form::kRigid, six).isApprox(by_hand(0) * transform(six), 1e-12));
  const Eigen::VectorXd twelve = random_theta({Form::kBoth, kPart});
  EXPECT_TRUE(
      of(Form::kBoth, twelve)
          .isApprox(transform(twelve.head<6>()) * before * transform(twelve.tail<6>()), 1e-12));
  const BodyChange other{Form::kOtherSignal, kPart, 0, 5};
  EXPECT_TRUE(predict(changed(schema_, other, Eigen::VectorXd(0)))
                  .isApprox(by_hand(1.2 * action_(5)), 1e-12));
}

TEST_F(BodyChangeTest, ADisplacementMayBeAsLargeAsTheJointsGainMakesIt) {
  const BodyChange stuck{Form::kStuck, kPart}, offset{Form::kOffset, kPart},
      gain{Form::kGain, kPart};
  ScrewJoint& joint = schema_.edges[2].joints[0];
  joint.gain = 1;
  const auto displacement = [&](const BodyChange& change) {
    const Eigen::VectorXd sigma = prior_of(change, schema_).sigma;
    return sigma(sigma.size() - 1);
  };
  const std::vector<double> before{displacement(stuck), displacement(offset), displacement(gain)};
  joint.gain = -20;  // a gear: 20 times the command
  EXPECT_NEAR(displacement(stuck), 20 * before[0], 1e-12);
  EXPECT_NEAR(displacement(offset), 20 * before[1], 1e-12);
  EXPECT_NEAR(displacement(gain), 20 * before[2], 1e-12);
  EXPECT_EQ(prior_of(gain, schema_).sigma(0), 1);
  joint.gain = 0;  // stuck already: it may be moved by hand
  EXPECT_NEAR(displacement(stuck), before[0], 1e-12);
}

TEST_F(BodyChangeTest, APriorIsADensity) {
  for (const BodyChange& change : {BodyChange{Form::kStuck, kPart},
                                   {Form::kOffset, kPart},
                                   {Form::kOffset, kPart, 0, 0, true}}) {
    const ChangePrior prior = prior_of(change, schema_);
    const double sigma = prior.sigma(0), reach = prior.is_uniform ? std::sqrt(3) : 8;
    double integral = 0;
    for (double t = -reach; t < reach; t += 1e-3)
      integral += 1e-3 * sigma * std::exp(prior.log_density(prior.mean.array() + t * sigma));
    EXPECT_NEAR(integral, std::sqrt(2 * M_PI), 3e-3);
  }
}

TEST_F(BodyChangeTest, AMovedMarkerMovesItsPartAndNothingElse) {
  for (const int part : {1, kPart, 7}) {
    const Eigen::VectorXd theta = random_theta({Form::kMarkerMoved, part});
    const BodySchema with = changed(schema_, {Form::kMarkerMoved, part}, theta);
    const auto before = schema_.predict_all(action_), after = with.predict_all(action_);
    for (const auto& [other, X_RB] : before) {
      const Pose in_camera = schema_.X_CR * X_RB;
      const Pose expected = other == part ? in_camera * transform(theta) : in_camera;
      EXPECT_TRUE((with.X_CR * after.at(other)).isApprox(expected, 1e-9))
          << "marker of " << part << ", part " << other;
    }
  }
}

TEST_F(BodyChangeTest, EveryPossibleChangeKeepsTheEdgesFlatAndTheOthersAsTheyWere) {
  const auto all = possible_changes(schema_, {ElementId::Kind::kJoint, kPart});
  std::map<Form, int> forms;
  for (const BodyChange& change : all) {
    ++forms[change.form];
    const BodySchema with = changed(schema_, change, random_theta(change));
    ASSERT_EQ(with.edges.size(), schema_.edges.size());
    EXPECT_LE(edge(with).joints.size(), edge(schema_).joints.size());
    for (std::size_t e = 0; e < with.edges.size(); ++e) {
      if (with.edges[e].to == kPart) continue;
      const auto theta = schema_.displacements(action_);
      EXPECT_TRUE(with.edges[e].predict(theta).isApprox(schema_.edges[e].predict(theta), 1e-12));
    }
    EXPECT_EQ(prior_of(change, schema_).sigma.size(), change.size());
    EXPECT_EQ(prior_of(change, schema_).mean.size(), change.size());
    EXPECT_TRUE((prior_of(change, schema_).sigma.array() > 0).all());
    EXPECT_LT(change.log_odds(), 0);
  }
  for (const Form form : {Form::kStuck, Form::kOffset, Form::kGain, Form::kBent, Form::kBoth,
                          Form::kRigid, Form::kOtherSignal})
    EXPECT_GT(forms[form], 0);
  EXPECT_EQ(forms[Form::kOtherSignal], 6);
}

/// The covariance of θ goes into the edge's parameters: to first order the prediction must be as
/// uncertain as ∂(prediction)/∂θ, here by central differences, says.
TEST_F(BodyChangeTest, UncertaintyOfTheParametersIsThatOfThePrediction) {
  schema_.edges[2].joints[0].offset = 0;
  for (const BodyChange& change : possible_changes(schema_, {ElementId::Kind::kJoint, kPart})) {
    if (change.size() == 0) continue;
    SCOPED_TRACE("form " + std::to_string(static_cast<int>(change.form)));
    const Eigen::Index d = change.size();
    Eigen::VectorXd theta = random_theta(change);
    if (change.form == Form::kGain) theta(1) = 0;
    const Eigen::VectorXd sigma = Eigen::VectorXd::LinSpaced(d, 0.01, 0.03);
    Eigen::MatrixXd covariance = sigma.cwiseAbs2().asDiagonal();
    if (d == 6) covariance(0, 4) = covariance(4, 0) = 1e-4;
    const BodySchema exactly = changed(schema_, change, theta);
    const BodySchema about = changed(schema_, change, theta, covariance);
    const Pose X = predict(exactly);
    EXPECT_TRUE(predict(about).isApprox(X, 1e-12));
    Eigen::MatrixXd J(6, d);
    for (Eigen::Index p = 0; p < d; ++p) {
      Eigen::VectorXd plus = theta, minus = theta;
      plus(p) += 1e-5;
      minus(p) -= 1e-5;
      J.col(p) = (log(X.inverse() * predict(changed(schema_, change, plus))) -
                  log(X.inverse() * predict(changed(schema_, change, minus)))) /
                 2e-5;
    }
    const auto displacements = schema_.displacements(action_);
    const Matrix6d added = edge(about).prediction_covariance(displacements) -
                           edge(exactly).prediction_covariance(displacements);
    const Matrix6d expected = J * covariance * J.transpose();
    EXPECT_LT((added - expected).norm(), 1e-5 * expected.norm() + 1e-12);
  }
}

TEST_F(BodyChangeTest, ACameraMoves) {
  const BodyChange change{Form::kCamera, schema_.root};
  const Eigen::VectorXd theta = random_theta(change);
  const BodySchema with = changed(schema_, change, theta, Matrix6d::Identity() * 1e-4);
  EXPECT_TRUE(with.X_CR.isApprox(schema_.X_CR * transform(theta), 1e-12));
  EXPECT_GT(with.X_CR_covariance.trace(), schema_.X_CR_covariance.trace());
}

TEST_F(BodyChangeTest, EveryFormSaysItsCauseAndItsParameters) {
  constexpr const char* kCauses[] = {
      "stored",          "joint_stuck", "joint_offset", "joint_gain",   "other_signal",
      "geometry",        "geometry",    "rigid",        "marker_moved", "camera_moved",
      "joint_nonlinear", "new_model",   "new_model"};
  constexpr int kSizes[] = {0, 1, 1, 2, 0, 6, 12, 6, 6, 6, 0, 0, 0};
  for (std::size_t n = 0; n < std::size(kSizes); ++n) {
    const BodyChange change{static_cast<Form>(n), kPart};
    EXPECT_EQ(change.cause(schema_), kCauses[n]) << n;
    EXPECT_EQ(change.size(), kSizes[n]) << n;
  }
  EXPECT_EQ((BodyChange{Form::kStored, schema_.root}.cause(schema_)), "camera_moved");
  BodyChange learned{Form::kFresh, kPart};
  learned.share = 0.5;
  const double one_input = learned.log_odds();
  learned.second_signal = 3;
  EXPECT_DOUBLE_EQ(one_input, -13 + std::log(0.5));
  EXPECT_DOUBLE_EQ(learned.log_odds(), one_input - 3);
}

TEST_F(BodyChangeTest, RefusesPlacesAndParametersThatAreNotThere) {
  const Eigen::VectorXd six = Eigen::VectorXd::Zero(6), one = Eigen::VectorXd::Zero(1);
  EXPECT_THROW(changed(schema_, {Form::kBent, kPart, 1}, one), std::invalid_argument);
  EXPECT_THROW(changed(schema_, {Form::kBent, 77, 1}, six), std::invalid_argument);
  EXPECT_THROW(changed(schema_, {Form::kMarkerMoved, 77}, six), std::invalid_argument);
  EXPECT_THROW(changed(schema_, {Form::kStuck, schema_.root}, one), std::invalid_argument);
  EXPECT_TRUE(possible_changes(schema_, {ElementId::Kind::kJoint, 77}).empty());
}

}  // namespace
}  // namespace bodyschema
