#include <gtest/gtest.h>

#include <cmath>

#include "common/geometry/angle.h"
#include "processes/refiner/refine.h"
#include "tests/support/elastic_arm.h"

namespace bodyschema {
namespace {

using test::ElasticArm;
using test::Rng;

/// The unloaded arm, and how its model as built is off: by 5 mm and 1° per axis and link.
struct Models {
  BodySchema truth, built;
};
Models models_of(const ElasticArm& arm, Rng& rng) {
  const int base = arm.robot.links.front().part, hand = arm.robot.links.back().part;
  Models models;
  models.truth = test::true_schema(arm.robot);
  models.truth.X_CR = arm.robot.X_CR;
  models.truth.parts = {base, hand};
  models.truth.edges = {arm.robot.true_edge(base, hand)};
  models.built = models.truth;
  const auto moved = [&](const Pose& X) {
    Vector6d step = test::gaussian6(rng);
    step.head<3>() *= 0.005;
    step.tail<3>() *= kDegree;
    return Pose(X * exp(step));
  };
  Edge& edge = models.built.edges.front();
  edge.left = moved(edge.left);
  for (ScrewJoint& joint : edge.joints) joint.X_after = moved(joint.X_after);
  return models;
}

Elasticity elasticity_of(const ElasticArm& arm, bool has_orientation, Rng& rng) {
  Models models = models_of(arm, rng);
  std::vector<ActionPoseSample> samples = test::babble(arm, 250, rng);
  const int hand = arm.robot.links.back().part;
  if (!has_orientation) {
    samples = test::with_positions_alone(samples, {hand});
    models.built.position_parts = {hand};
  }
  for (int n = 200; n < 250; ++n) samples[n].purpose = Purpose::kTest;
  RefineOptions options;
  options.joint_loads = [&](const Eigen::VectorXd& action) {
    return arm.loads(models.built.edges.front(), action);
  };
  const Refinement result = refine(models.built, refiner_samples(samples), {}, options);
  EXPECT_TRUE(result.elasticity);
  return result.elasticity.value_or(Elasticity());
}

double held_out_mm(const Elasticity::Errors& errors) {
  EXPECT_EQ(errors.held_out.size(), 1U);
  EXPECT_GT(errors.held_out.front().count, 35);
  return errors.held_out.front().position_rms_m * 1e3;
}

TEST(Elasticity, OfJointsThatGiveWayIsFoundAndLikelier) {
  for (const bool has_orientation : {true, false}) {
    Rng rng(5);
    const ElasticArm arm = test::elastic_arm(6, 0.02, rng);
    const Elasticity elasticity = elasticity_of(arm, has_orientation, rng);
    EXPECT_GT(elasticity.evidence, 20);
    EXPECT_LT(held_out_mm(elasticity.elastic), 0.8 * held_out_mm(elasticity.stiff));
    EXPECT_LT(elasticity.elastic.noise_scale, 1.1);
    EXPECT_GT(elasticity.stiff.noise_scale, 1.2);
    ASSERT_EQ(elasticity.joints.size(), 6U);
    int num_of_their_own = 0;
    double droop = 0;
    for (int d = 0; d < 6; ++d) {
      const JointCompliance& joint = elasticity.joints[d];
      EXPECT_GT(joint.sd, 0);
      EXPECT_LT(std::abs(joint.value - arm.compliance_rad_per_Nm(d)), 4 * joint.sd)
          << joint.joint << " " << joint.value << " ± " << joint.sd;
      num_of_their_own += joint.evidence > 0 ? 1 : 0;
      droop = std::max(droop, joint.droop);
    }
    EXPECT_GT(num_of_their_own, 0);
    EXPECT_GT(droop, 0.1 * kDegree);
  }
}

TEST(Elasticity, OfStiffJointsIsLessLikely) {
  Rng rng(6);
  const ElasticArm arm = test::elastic_arm(6, 0, rng);
  const Elasticity elasticity = elasticity_of(arm, false, rng);
  EXPECT_LT(elasticity.evidence, 0);
  for (const JointCompliance& joint : elasticity.joints)
    EXPECT_LT(std::abs(joint.value), 4 * joint.sd) << joint.joint;
}

TEST(Elasticity, OfJointsThatRiseUnderTheirLoadsIsNegativeAndToldSo) {
  Rng rng(5);
  ElasticArm arm = test::elastic_arm(6, 0.02, rng);
  arm.compliance_rad_per_Nm *= -1;
  const Elasticity elasticity = elasticity_of(arm, true, rng);
  EXPECT_GT(elasticity.evidence, 20);
  int num_rising = 0;
  for (const JointCompliance& joint : elasticity.joints) {
    EXPECT_EQ(joint.rises(), joint.evidence > 0) << joint.joint;
    num_rising += joint.rises() ? 1 : 0;
  }
  EXPECT_GT(num_rising, 0);
}

TEST(Elasticity, OfAJointWhoseLoadDoesNotChangeIsNotFitted) {
  Rng rng(7);
  const ElasticArm arm = test::elastic_arm(3, 0.02, rng);
  const Models models = models_of(arm, rng);
  RefineOptions options;
  options.joint_loads = [&](const Eigen::VectorXd& action) {
    Eigen::VectorXd loads = arm.loads(models.built.edges.front(), action);
    loads(1) = 5;
    return loads;
  };
  const auto samples = refiner_samples(test::babble(arm, 60, rng));
  const auto elasticity = refine(models.built, samples, {}, options).elasticity;
  ASSERT_TRUE(elasticity);
  EXPECT_EQ(elasticity->joints[1].value, 0);
  EXPECT_EQ(elasticity->joints[1].sd, 0);
  EXPECT_GT(elasticity->joints[0].sd, 0);
  options.joint_loads = [](const Eigen::VectorXd&) { return Eigen::Vector3d(1, 2, 3); };
  const Refinement without = refine(models.built, samples, {}, options);
  EXPECT_FALSE(without.elasticity);
  EXPECT_EQ(without.held.back(), "compliances of joints: no load of them changes");
}

}  // namespace
}  // namespace bodyschema
