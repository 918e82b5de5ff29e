#include "processes/structure_learner/noise_in_common.h"

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include "common/geometry/angle.h"
#include "common/kinematics/kinematic_path.h"
#include "processes/structure_learner/learn.h"
#include "tests/support/soft_arm.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::Rng;

constexpr Noise kNoise{0.002, 0.01};

Vector6d drawn(const Noise& noise, Rng& rng) {
  Vector6d e = test::gaussian6(rng);
  e.head<3>() *= noise.position_m;
  e.tail<3>() *= noise.rotation_rad;
  return e;
}

/// Of the chapter's arm; what carries part `loose`, and all beyond, is off by `play` anew each
/// time.
std::vector<ActionPoseSample> observed(const test::SyntheticRobot& robot, int num_samples,
                                       int loose, const Noise& play, Rng& rng) {
  std::vector<ActionPoseSample> samples(static_cast<std::size_t>(num_samples));
  for (ActionPoseSample& sample : samples) {
    sample.sample_index = &sample - samples.data();
    sample.utime = 2'000'000 * sample.sample_index;
    sample.action = robot.random_action(rng);
    const auto poses = robot.poses_in_camera(sample.action);
    const Pose& at = poses.at(loose);
    const Pose off = at * exp(drawn(play, rng)) * at.inverse();
    for (const auto& [part, X] : poses) {
      PartObservation o;
      o.part = part;
      o.X_CB = (part >= loose ? off * X : X) * exp(drawn(kNoise, rng));
      sample.parts.push_back(o);
    }
  }
  return samples;
}

// Known to a half, the less the more the body is off: 200 samples tell a tenth of it.
TEST(NoiseInCommon, IsThatOfTheMarkersWhateverTheBodyDoes) {
  for (int seed = 1; seed <= 24; ++seed) {
    const double times = seed % 3 * 5;  // as the noise
    const Noise play{times * kNoise.position_m, times * kNoise.rotation_rad};
    Rng rng(seed);
    const test::SyntheticRobot robot = test::chapter_robot("c", rng);
    const auto samples = observed(robot, 200, 3, play, rng);
    BodySchema schema = test::true_schema(robot);
    for (Edge& edge : schema.edges) {
      const bool is_loose = edge.to == 3;
      edge.position_rms_m = is_loose ? 0.02 : 0.01;
      edge.rotation_rms_rad = std::sqrt(3) * std::hypot(std::sqrt(2) * kNoise.rotation_rad,
                                                        is_loose ? play.rotation_rad : 0);
    }
    const auto noise = noise_in_common(schema, samples);
    ASSERT_TRUE(noise);
    for (const double ratio :
         {noise->position_m / kNoise.position_m, noise->rotation_rad / kNoise.rotation_rad}) {
      EXPECT_GT(ratio, 0.85) << play.rotation_rad << ", seed " << seed;
      EXPECT_LT(ratio, 1.25 + 0.1 * times) << play.rotation_rad << ", seed " << seed;
    }
  }
}

TEST(NoiseInCommon, OneEdgeTellsNone) {
  Rng rng(3);
  const test::SyntheticRobot robot = test::chapter_robot("c", rng);
  const auto samples = observed(robot, 200, 3, {}, rng);
  BodySchema schema = test::true_schema(robot);
  schema.edges.resize(1);
  EXPECT_FALSE(noise_in_common(schema, samples));
}

TEST(AddUnexplained, IsWhatAnEdgeLeavesBesideTheNoise) {
  Rng rng(3);
  BodySchema schema = test::true_schema(test::chapter_robot("c", rng));
  for (Edge& edge : schema.edges) {
    edge.parameter_covariance = Eigen::MatrixXd::Zero(edge.num_parameters(), edge.num_parameters());
    edge.rotation_rms_rad = std::sqrt(3 * 2) * kNoise.rotation_rad;
    edge.position_rms_m = 0.001;
  }
  EXPECT_FALSE(add_unexplained(kNoise, {}, &schema));
  schema.edges[1].rotation_rms_rad *= 3;
  EXPECT_TRUE(add_unexplained(kNoise, {}, &schema));
  const Eigen::VectorXd theta = schema.displacements(mid_range(schema.signals));
  for (std::size_t e = 0; e < schema.edges.size(); ++e) {
    const Matrix6d covariance = schema.edges[e].prediction_covariance(theta);
    const double rotation = covariance.bottomRightCorner<3, 3>().trace();
    const double noise = kNoise.rotation_rad * kNoise.rotation_rad;
    EXPECT_NEAR(rotation, e == 1 ? 3 * 2 * (9 - 1) * noise : 0, 1e-12);
    EXPECT_EQ(covariance(0, 0), 0);
  }
}

// An edge that leaves three times the noise, with noise that is estimated somewhat or much too
// large.
TEST(TellNoiseFromBody, WhatOneEdgeLeavesIsItsOwn) {
  for (const double factor : {1.4, 1.6}) {
    Rng rng(3);
    BodySchema schema = test::true_schema(test::chapter_robot("c", rng));
    for (Edge& edge : schema.edges) {
      edge.parameter_covariance =
          Eigen::MatrixXd::Zero(edge.num_parameters(), edge.num_parameters());
      edge.rotation_rms_rad = std::sqrt(3 * 2) * kNoise.rotation_rad;
      edge.position_rms_m = 0.001;
    }
    schema.edges[1].rotation_rms_rad *= 3;
    schema.noise = {factor * kNoise.position_m, factor * kNoise.rotation_rad};
    EXPECT_TRUE(tell_noise_from_body(kNoise, {}, &schema));
    EXPECT_NEAR(schema.noise.rotation_rad, (factor < 1.5 ? factor : 1) * kNoise.rotation_rad, 1e-9);
    const Eigen::VectorXd theta = schema.displacements(mid_range(schema.signals));
    for (std::size_t e = 0; e < schema.edges.size(); ++e)
      EXPECT_EQ(schema.edges[e].prediction_covariance(theta)(5, 5) > 0, e == 1) << factor;
  }
}

struct Told {
  int num_complete = 0;
  double error2 = 0, variance = 0;  ///< of positions, summed
  double ratio() const { return std::sqrt(error2 / variance); }
  /// Of part `part` in the root, at samples not learned from; nothing of an incomplete schema.
  void add(const BodySchema& schema, int root, int part,
           const std::vector<ActionPoseSample>& samples) {
    if (!schema.complete) return;
    ++num_complete;
    for (const ActionPoseSample& sample : samples) {
      const auto predicted = schema.predict(root, part, sample.action, Variance::kOneAction);
      const Pose seen = sample.find(root)->X_CB.inverse() * sample.find(part)->X_CB;
      error2 += (predicted->X_AB.translation() - seen.translation()).squaredNorm();
      variance += predicted->covariance.topLeftCorner<3, 3>().trace();
    }
  }
};

// A base that moves while its own pose is given as a constant is no frame.
TEST(PredictionVariance, OfABaseThatMovesCountsThatOrItIsDoubted) {
  Told told;
  int num_doubted = 0;
  for (int seed = 1; seed <= 6; ++seed) {
    Rng rng(seed);
    const test::SyntheticRobot robot = test::chapter_robot("c", rng);
    const auto samples = [&] {
      auto result = observed(robot, 60, 2, {0.01, 2 * kDegree}, rng);
      for (ActionPoseSample& sample : result) sample.parts[0].X_CB = result[0].parts[0].X_CB;
      return result;
    };
    const BodySchema schema = learn(robot.signals, samples()).schema;
    told.add(schema, 1, 2, samples());
    num_doubted += std::ranges::any_of(schema.unconnected, [](const UnconnectedPart& part) {
      return part.detail.find("keeps its pose at all samples") != std::string::npos;
    });
  }
  EXPECT_GE(told.num_complete + num_doubted, 5) << told.num_complete << " complete";
  if (told.num_complete > 0) EXPECT_LT(told.ratio(), 2);
}

// Tendons that stop elsewhere each time.
TEST(PredictionVariance, OfASoftArmWithPlayCountsThat) {
  Told told;
  for (int seed = 1; seed <= 2; ++seed) {
    Rng rng(seed);
    const test::SoftArm arm{.num_sections = 2, .num_chambers = 2};
    const auto samples = [&] {
      auto result = arm.babble(200, {0.0003, 0.005}, rng);
      for (ActionPoseSample& sample : result)
        for (double& q : sample.action) q += test::uniform(rng, -0.08, 0.08);
      return result;
    };
    const BodySchema schema = learn(arm.signals(), samples()).schema;
    told.add(schema, 0, 2, samples());
  }
  ASSERT_GE(told.num_complete, 1);
  EXPECT_LT(told.ratio(), 2);
}

}  // namespace
}  // namespace bodyschema
