#include <fmt/format.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <random>

#include "common/bus/channels.h"
#include "common/bus/codec.h"
#include "common/bus/convert.h"
#include "common/geometry/angle.h"
#include "processes/refiner/held_out.h"
#include "processes/refiner/refine.h"
#include "processes/structure_learner/learn.h"
#include "tests/processes/refiner/tagged_robot.h"

namespace bodyschema {
namespace {

using test::Rng;
using test::SyntheticRobot;
using test::TaggedRobot;

constexpr test::RigError kRigError = {.tags = {0.0005, 0.3 * kDegree, 0.003},
                                      .focal_length_share = 0.005,
                                      .centre_px = 3,
                                      .distortion = 0.005};

RefineOptions all() {
  RefineOptions options;
  options.placements = options.intrinsics = true;
  options.measurement.systematic = {0.002, 0.01};
  return options;
}

BodySchema start_of(const SyntheticRobot& robot) {
  BodySchema schema = test::true_schema(robot);
  schema.X_CR = robot.X_CR;
  for (Edge& edge : schema.edges) {
    Vector6d step;
    step << 0.001, -0.002, 0.001, 0.01, 0.005, -0.01;
    edge.left = edge.left * exp(step);
    for (ScrewJoint& joint : edge.joints) joint.turn *= 1.01;
  }
  return schema;
}

/// Largest error of a tag relative to another of its part, both seen often. Of parts that move: of
/// a tag that rests one view cannot tell whether it is large or near.
Noise worst_placement(const Markers& refined, const Markers& truth,
                      const std::vector<RefinerSample>& samples) {
  std::map<int, int> num_seen;
  for (const RefinerSample& seen : samples)
    for (const TagSight& sight : seen.tags)
      if (is_learned_from(seen.sample)) ++num_seen[sight.tag];
  Noise worst;
  for (const TagPlacement& one : truth.tags)
    for (const TagPlacement& other : truth.tags) {
      if (one.part != other.part || one.id >= other.id || one.part == 1) continue;
      if (std::min(num_seen[one.id], num_seen[other.id]) < 10) continue;
      const Pose expected = one.X_BM->inverse() * *other.X_BM;
      const Pose found = refined.find(one.id)->X_BM->inverse() * *refined.find(other.id)->X_BM;
      const Vector6d error = log(expected.inverse() * found);
      worst.position_m = std::max(worst.position_m, error.head<3>().norm());
      worst.rotation_rad = std::max(worst.rotation_rad, error.tail<3>().norm());
    }
  return worst;
}

struct Case {
  explicit Case(int seed, int num_samples = 60, double noise_px = 0.05,
                const test::RigError& error = kRigError)
      : rng(seed),
        robot(test::tagged(test::chapter_robot("c", rng), 4, rng)),
        rig(test::claimed(robot, error, rng)),
        samples(test::seen_corners(robot, rig, num_samples, noise_px, rng)),
        start(start_of(robot.robot)) {}

  Rng rng;
  TaggedRobot robot;
  RigCalibration rig;
  std::vector<RefinerSample> samples;
  BodySchema start;
};

TEST(RefineCorners, FindPlacementsAndLensFromExactCorners) {
  const Case c(1, 60, 0);
  const Refinement result = refine(c.start, c.samples, c.rig, all());
  EXPECT_TRUE(result.used_corners);
  EXPECT_NEAR(result.rig.camera.fx / c.robot.truth.camera.fx, 1, 1e-5);
  EXPECT_NEAR(result.rig.camera.cx, c.robot.truth.camera.cx, 0.02);
  const Noise worst = worst_placement(result.rig.markers, c.robot.truth.markers, c.samples);
  // The common scale of prints stays what their mean is: 0.3 %/√20 of 50 mm.
  EXPECT_LT(worst.position_m, 1e-4);
  EXPECT_LT(worst.rotation_rad, 0.001 * kDegree);
  // Exact joints are not off their commands by the least that the search knows.
  ASSERT_EQ(result.plays.size(), 4U);
  for (const JointPlay& play : result.plays) EXPECT_EQ(play.turn_rad, 0) << play.joint;
  EXPECT_LT(*result.after.px_rms, 1e-3);
  EXPECT_GT(*result.before.px_rms, 1);
  double mean = 0;
  for (const TagPlacement& tag : result.rig.markers.tags)
    mean += tag.size_m / c.rig.markers.find(tag.id)->size_m /
            static_cast<double>(c.rig.markers.tags.size());
  EXPECT_NEAR(mean, 1, 2e-4);
}

// To the noise of the corners, though each joint may be off its command at every sample as well.
TEST(RefineCorners, BendCommandsWithTheRest) {
  Rng rng(3);
  TaggedRobot robot = test::tagged(test::chapter_robot("a", rng), 4, rng);
  robot.robot.bend = 0.1;
  const RigCalibration rig = test::claimed(robot, kRigError, rng);
  const auto samples = test::seen_corners(robot, rig, 100, 0.05, rng);
  std::vector<ActionPoseSample> training;
  for (const RefinerSample& seen : samples)
    if (is_learned_from(seen.sample)) training.push_back(seen.sample);
  LearnOptions learning;
  learning.measurement.systematic = {0.002, 0.01};
  const BodySchema learned = learn(robot.robot.signals, training, learning).schema;
  ASSERT_TRUE(test::is_right(learned, robot.robot));
  ASSERT_FALSE(learned.signals[0].warp.empty());
  const Refinement result = refine(learned, samples, rig, all());
  EXPECT_TRUE(result.held.empty());
  EXPECT_TRUE(result.undetermined.empty());
  EXPECT_NE(result.schema.signals[0].warp, learned.signals[0].warp);
  EXPECT_LT(*result.after.px_rms, 0.06);
  EXPECT_GT(*result.before.px_rms, 0.2);
}

// Tags and lens that are off bend no command.
TEST(RefineCorners, FindNoBendsByWrongTagsAndLens) {
  for (int seed = 1; seed <= 4; ++seed) {
    const Case c(seed);
    RefineOptions options = all();
    options.measurement.systematic = {0.002, 0.01};
    EXPECT_TRUE(refine(c.start, c.samples, c.rig, options).bends.empty());
    options.placements = options.intrinsics = false;
    EXPECT_TRUE(refine(c.start, c.samples, c.rig, options).bends.empty());
  }
}

TEST(RefineCorners, PutThePartsFramesWhereTheirTagsAreClosestToTheClaims) {
  const Case c(1, 60, 0);
  const RefineOptions options = all();
  const Markers found = refine(c.start, c.samples, c.rig, options).rig.markers;
  // Of the priors, where the frame of a part is shifted on it.
  const auto cost = [&](int part, const Vector6d& shift) {
    double sum = 0;
    for (const TagPlacement& tag : found.tags) {
      if (tag.part != part) continue;
      const Vector6d error =
          log(c.rig.markers.find(tag.id)->X_BM->inverse() * exp(shift) * *tag.X_BM);
      sum += error.head<3>().squaredNorm() / std::pow(options.config.tags.position_m, 2) +
             error.tail<3>().squaredNorm() / std::pow(options.config.tags.rotation_rad, 2);
    }
    return sum;
  };
  for (const int part : found.parts())
    for (int direction = 0; direction < 6; ++direction)
      for (const double sign : {-1, 1})
        EXPECT_GT(cost(part, sign * (direction < 3 ? 1e-4 : 1e-3) * Vector6d::Unit(direction)),
                  cost(part, Vector6d::Zero()))
            << part << " " << direction;
}

TEST(RefineCorners, ReachTheNoise) {
  const Case c(2);
  const Refinement result = refine(c.start, c.samples, c.rig, all());
  EXPECT_NEAR(*result.after.px_rms, 0.05, 0.01);
  EXPECT_LT(result.noise_scale, 1.1);
  EXPECT_NEAR(result.rig.camera.fx / c.robot.truth.camera.fx, 1, 5e-4);
  const Noise worst = worst_placement(result.rig.markers, c.robot.truth.markers, c.samples);
  EXPECT_LT(worst.position_m, 2e-4);
  EXPECT_LT(worst.rotation_rad, 0.15 * kDegree);
  EXPECT_TRUE(result.undetermined.empty()) << result.undetermined.front();
  EXPECT_NE(result.schema.calibration_id, c.samples.front().sample.calibration_id);
  // What edges leave is that of the tags and the lens that were found, not of the claims.
  BodySchema by_claims = result.schema;
  set_residuals(c.samples, c.rig, &by_claims);
  double found = 0, claimed = 0;
  for (std::size_t e = 0; e < by_claims.edges.size(); ++e) {
    found += result.schema.edges[e].rotation_rms_rad;
    claimed += by_claims.edges[e].rotation_rms_rad;
  }
  EXPECT_GT(found, 0);
  EXPECT_LT(found, 0.9 * claimed);
}

TEST(RefineCorners, WithoutOptionsPosesAreFittedAndTagsAndLensStayAsClaimed) {
  const Case c(3, 40, 0.05, {});
  RefineOptions options = all();
  options.placements = options.intrinsics = false;
  const Refinement result = refine(c.start, c.samples, c.rig, options);
  EXPECT_FALSE(result.used_corners);
  EXPECT_LT(*result.after.px_rms, 0.1 * *result.before.px_rms);
  EXPECT_EQ(result.schema.calibration_id, c.samples.front().sample.calibration_id);
  EXPECT_EQ(calibration_id(result.rig.markers, result.rig.camera),
            calibration_id(c.rig.markers, c.rig.camera));
}

TEST(RefineCorners, SamplesWithoutCornersAreNamedAndNotCounted) {
  Case c(3, 40);
  for (std::size_t n = 0; n < c.samples.size(); n += 5) c.samples[n].tags.clear();
  const Refinement result = refine(c.start, c.samples, c.rig, all());
  EXPECT_EQ(result.num_available, 32 - 8);
  EXPECT_EQ(result.num_samples, 32 - 8);
  ASSERT_EQ(result.held.size(), 1U);
  EXPECT_EQ(result.held.front(), "8 samples without corners: not fitted");
}

TEST(RefineCorners, AloneTheLensIsFoundAmongTagsAsClaimed) {
  const Case c(3, 40, 0.05, {.focal_length_share = 0.01});
  RefineOptions options = all();
  options.placements = false;
  const Refinement result = refine(c.start, c.samples, c.rig, options);
  EXPECT_NEAR(result.rig.camera.fx / c.robot.truth.camera.fx, 1, 3e-3);
  for (const TagPlacement& tag : result.rig.markers.tags)
    EXPECT_TRUE(tag.X_BM->isApprox(*c.rig.markers.find(tag.id)->X_BM, 1e-12));
  ASSERT_EQ(result.held.size(), 1U);
  EXPECT_NE(result.held.front().find("tags"), std::string::npos);
}

TEST(RefineCorners, OrderOfSamplesAndNamesOfSignalsChangeNothing) {
  Case c(4, 30);
  const auto bytes = [](const BodySchema& schema) {
    return encode(kBodySchema, to_message(schema));
  };
  const Refinement first = refine(c.start, c.samples, c.rig, all());
  std::shuffle(c.samples.begin(), c.samples.end(), c.rng);
  EXPECT_EQ(bytes(refine(c.start, c.samples, c.rig, all()).schema), bytes(first.schema));
  for (Signal& signal : c.start.signals) signal.name = "other " + signal.name;
  Refinement renamed = refine(c.start, c.samples, c.rig, all());
  for (std::size_t s = 0; s < c.start.signals.size(); ++s)
    renamed.schema.signals[s].name = first.schema.signals[s].name;
  EXPECT_EQ(bytes(renamed.schema), bytes(first.schema));
}

TEST(RefineCorners, TestSamplesAreJudgedAndNotFitted) {
  Case c(5, 30);
  const Refinement first = refine(c.start, c.samples, c.rig, all());
  EXPECT_EQ(first.num_samples, 24);
  EXPECT_EQ(first.after.num_samples, 6);
  for (RefinerSample& seen : c.samples)
    if (seen.sample.purpose == Purpose::kTest)
      for (TagSight& sight : seen.tags) sight.corners_px.array() += 5;
  const Refinement second = refine(c.start, c.samples, c.rig, all());
  EXPECT_TRUE(first.schema.X_CR.isApprox(second.schema.X_CR, 0));
  EXPECT_GT(*second.after.px_rms, 10 * *first.after.px_rms);
}

TEST(RefineCorners, WhatIsPredictedBehindTheCameraIsNoBetter) {
  Case c(5, 40);
  BodySchema behind = c.start;
  behind.X_CR.translation().z() -= 50;
  const RefineOptions options = all();
  const HeldOutErrors before = held_out_errors(c.start, c.samples, c.rig, options.corner_noise);
  const HeldOutErrors lost = held_out_errors(behind, c.samples, c.rig, options.corner_noise);
  EXPECT_FALSE(predicts_corners_better(lost, before));
  EXPECT_TRUE(predicts_corners_better(before, lost));
}

TEST(RefineCorners, WrongCornersAreNamedAsOutliersAndHardlyMoveTheModel) {
  Case c(6);
  const Refinement clean = refine(c.start, c.samples, c.rig, all());
  std::vector<std::pair<std::int64_t, int>> wrong;
  for (std::size_t n = 0; n < c.samples.size(); n += 7) {
    if (c.samples[n].sample.purpose == Purpose::kTest) continue;
    TagSight& sight = c.samples[n].tags.front();
    sight.corners_px.array() += 4;
    wrong.emplace_back(c.samples[n].sample.sample_index, sight.tag);
  }
  const Refinement result = refine(c.start, c.samples, c.rig, all());
  for (const auto& [index, tag] : wrong)
    EXPECT_TRUE(std::any_of(result.outliers.begin(), result.outliers.end(), [&](const auto& o) {
      return o.sample_index == index && o.tag == tag;
    })) << index;
  EXPECT_LE(result.outliers.size(), wrong.size() + 2);
  EXPECT_NEAR(*result.after.px_rms, *clean.after.px_rms, 0.005);
}

TEST(RefineCorners, AJointThatDidNotMoveIsNamedAndNothingElse) {
  Case c(7, 40);
  Case resting = c;
  // q2 rests.
  SyntheticRobot& robot = resting.robot.robot;
  const Signal moving = robot.signals[1];
  robot.signals[1].lower = robot.signals[1].upper = 0.3;
  resting.samples = test::seen_corners(resting.robot, resting.rig, 40, 0.05, resting.rng);
  resting.start.signals[1] = moving;
  const Refinement result = refine(resting.start, resting.samples, resting.rig, all());
  ASSERT_EQ(result.undetermined.size(), 1U);
  EXPECT_TRUE(result.undetermined.front().ends_with(": move q2 farther"))
      << result.undetermined.front();
  for (const RefinedParameter& parameter : result.parameters) {
    if (parameter.sd) continue;
    EXPECT_NE(parameter.name.find("q2"), std::string::npos) << parameter.name;
  }
  EXPECT_LT(result.coverage[1].share, 1e-12);
  EXPECT_GT(result.coverage[0].share, 0.8);
  EXPECT_LT(*result.after.px_rms, 0.08);
}

// The end's second tag was read at one place of q4 alone: where it sits is told by how far q4 goes.
TEST(RefineCorners, WhatATagAndAJointShareIsNamedWithWhatWouldTellThemApart) {
  Case c(9, 0);
  const int end = c.robot.robot.visible_parts().back();
  std::vector<int> tags;
  for (const TagPlacement& tag : c.rig.markers.tags)
    if (tag.part == end) tags.push_back(tag.id);
  for (const bool is_second : {false, true}) {
    Signal& q4 = c.robot.robot.signals[3];
    q4.lower = is_second ? 0.9 : -0.01;
    q4.upper = is_second ? 0.9 : 0.01;
    for (RefinerSample& seen :
         test::seen_corners(c.robot, c.rig, is_second ? 40 : 80, 0.05, c.rng)) {
      std::erase_if(seen.tags, [&](const TagSight& sight) {
        const bool is_of_end = c.rig.markers.find(sight.tag)->part == end;
        return is_of_end && sight.tag != (is_second ? tags[1] : tags[0]);
      });
      seen.sample.sample_index = std::ssize(c.samples);
      c.samples.push_back(seen);
    }
  }
  RefineOptions options = all();
  options.config.tags = {0.05, 0.5, 0.003};
  const Refinement result = refine(c.start, c.samples, c.rig, options);
  const std::string advice = fmt::format("show tag {} while q4 moves", tags[1]);
  EXPECT_TRUE(std::ranges::any_of(result.correlations, [&](const ParameterCorrelation& found) {
    return found.advice == advice &&
           found.other.starts_with(fmt::format("placement of tag {}", tags[1]));
  }));
}

TEST(RefineCorners, ARootThatMovesHasAPoseAtEverySample) {
  Case c(8, 40);
  std::vector<RefinerSample> samples;
  for (int n = 0; n < 40; ++n) {
    Vector6d step;
    step << 0.05 * test::gaussian6(c.rng).head<3>(), 0.1 * test::gaussian6(c.rng).head<3>();
    TaggedRobot moved = c.robot;
    moved.robot.X_CR = c.robot.robot.X_CR * exp(step);
    RefinerSample seen = test::seen_corners(moved, c.rig, 1, 0.05, c.rng).front();
    seen.sample.sample_index = n;
    samples.push_back(std::move(seen));
  }
  const Refinement result = refine(c.start, samples, c.rig, all());
  EXPECT_TRUE(result.root_moves);
  EXPECT_LT(result.noise_scale, 1.1);
  EXPECT_NEAR(result.rig.camera.fx / c.robot.truth.camera.fx, 1, 2e-3);
  const Noise worst = worst_placement(result.rig.markers, c.robot.truth.markers, samples);
  EXPECT_LT(worst.position_m, 3e-4);
}

}  // namespace
}  // namespace bodyschema
