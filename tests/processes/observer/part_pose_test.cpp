#include "processes/observer/part_pose.h"

#include <gtest/gtest.h>

#include <Eigen/LU>
#include <cmath>
#include <random>

#include "common/estimation/measurement_model.h"
#include "processes/marker_estimator/tag_pose.h"

namespace bodyschema {
namespace {

constexpr double kSize_m = 0.08;
constexpr double kFocal_px = 1159;

PartPoseOptions options() {
  PartPoseOptions options;
  options.max_tag_error_px = 1.5;
  options.min_other_rotation_rad = 0.035;
  options.max_error_ratio = 10;
  return options;
}

/// Three sides of a box with edges of 10 cm: all seen from the front left above.
std::vector<Pose> box() {
  std::vector<Pose> X_BM(3, Pose::Identity());
  X_BM[0].translation() = Eigen::Vector3d(0, 0, -0.05);
  X_BM[1].linear() = exp_so3(Eigen::Vector3d(0, M_PI / 2, 0));
  X_BM[1].translation() = Eigen::Vector3d(-0.05, 0, 0);
  X_BM[2].linear() = exp_so3(Eigen::Vector3d(-M_PI / 2, 0, 0));
  X_BM[2].translation() = Eigen::Vector3d(0, -0.05, 0);
  return X_BM;
}

Pose X_CB_of(std::mt19937& random) {
  std::uniform_real_distribution<double> u(-1, 1);
  Pose X = Pose::Identity();
  X.linear() = exp_so3(Eigen::Vector3d(0.55 + 0.1 * u(random), -0.6 + 0.1 * u(random), 0)) *
               exp_so3(Eigen::Vector3d(0, 0, 0.2 * u(random)));
  X.translation() = Eigen::Vector3d(0.1 * u(random), 0.1 * u(random), 1.2 + 0.2 * u(random));
  return X;
}

/// `printed_m`: the true side of the print.
SeenTag seen(int id, const Pose& X_CB, const Pose& X_BM, double sigma_px, std::mt19937& random,
             double printed_m = kSize_m) {
  std::normal_distribution<double> noise(0, sigma_px / kFocal_px);
  SeenTag tag{id, kSize_m, X_BM, {}, sigma_px * sigma_px * Matrix8d::Identity(), {}};
  for (const Eigen::Vector3d& p_MP : tag_corners(printed_m)) {
    const Eigen::Vector3d p_C = X_CB * X_BM * p_MP;
    ImagePoint point;
    point.ray = p_C.head<2>() / p_C.z() + Eigen::Vector2d(noise(random), noise(random));
    point.px_per_ray = kFocal_px * Eigen::Matrix2d::Identity();
    point.sigma_px = sigma_px;
    tag.corners.push_back(point);
  }
  for (const PoseFit& fit : solve_tag_pose(kSize_m, tag.corners)) tag.X_CM.push_back(fit.X_CB);
  return tag;
}

std::vector<SeenTag> seen_box(const Pose& X_CB, int num_tags, double sigma_px,
                              std::mt19937& random) {
  std::vector<SeenTag> tags;
  for (int i = 0; i < num_tags; ++i) tags.push_back(seen(i, X_CB, box()[i], sigma_px, random));
  return tags;
}

TEST(SolvePartPose, IsBetterOverSeveralTagsThanOverOne) {
  std::mt19937 random(1);
  double squares[4] = {};
  constexpr int kViews = 200;
  for (int i = 0; i < kViews; ++i) {
    const Pose X_CB = X_CB_of(random);
    for (const int num_tags : {1, 2, 3}) {
      const auto pose = solve_part_pose(seen_box(X_CB, num_tags, 0.1, random), options()).agreed;
      ASSERT_TRUE(pose);
      squares[num_tags] += (pose->X_CB.translation() - X_CB.translation()).squaredNorm();
    }
  }
  for (const int num_tags : {1, 2, 3}) {
    RecordProperty("rms_mm_" + std::to_string(num_tags) + "_tags",
                   std::to_string(1e3 * std::sqrt(squares[num_tags] / kViews)));
  }
  EXPECT_LT(squares[2], 0.5 * squares[1]);
  EXPECT_LT(squares[3], squares[2]);
}

// Tags are displaced from markers.yaml, and printed larger or smaller: d² of the part's pose.
TEST(SolvePartPose, HasACovarianceThatIsConsistentWithTagsThatAreOff) {
  PartPoseOptions off = options();
  off.calibration = {.position_m = 0.0005, .rotation_rad = 0.005, .size_share = 0.002};
  constexpr int kViews = 300;
  for (const int num_tags : {1, 2, 3}) {
    std::mt19937 random(num_tags);
    std::normal_distribution<double> normal;
    const auto drawn = [&](double sd) {
      return Eigen::Vector3d(Eigen::Vector3d::NullaryExpr([&] { return sd * normal(random); }));
    };
    double sum = 0;
    int count = 0;
    for (int i = 0; i < kViews; ++i) {
      const Pose X_CB = X_CB_of(random);
      std::vector<SeenTag> tags;
      for (int n = 0; n < num_tags; ++n) {
        Vector6d moved;
        moved << drawn(off.calibration.position_m), drawn(off.calibration.rotation_rad);
        const double size_m = kSize_m * (1 + off.calibration.size_share * normal(random));
        tags.push_back(seen(n, X_CB, box()[n] * exp(moved), 0.02, random, size_m));
        tags.back().X_BM = box()[n];
      }
      const auto pose = solve_part_pose(tags, off).agreed;
      ASSERT_TRUE(pose);
      if (static_cast<int>(pose->tags.size()) < num_tags) continue;
      const Vector6d e = log(pose->X_CB.inverse() * X_CB);
      sum += e.dot(pose->covariance.inverse() * e);
      ++count;
    }
    EXPECT_GT(count, 0.95 * kViews);
    EXPECT_NEAR(sum / count, 6, 4 * std::sqrt(12.0 / kViews)) << num_tags << " tags";
  }
}

// What tags that are off add to a part's covariance is what MeasurementModel takes to be common to
// all sights of them: exactly for a tag at the part's origin, by and large for two beside it.
TEST(SolvePartPose, TagsThatAreOffDoWhatTheMeasurementModelSays) {
  PartPoseOptions off = options();
  off.calibration = {.position_m = 0.0005, .rotation_rad = 0.005, .size_share = 0.002};
  std::mt19937 random(1);
  for (const int num_tags : {1, 2}) {
    const Pose X_CB = X_CB_of(random);
    std::vector<SeenTag> tags;
    for (int n = 0; n < num_tags; ++n) {
      Pose X_BM = Pose::Identity();
      X_BM.translation().x() = num_tags == 1 ? 0 : 0.1 * n - 0.05;
      tags.push_back(seen(n, X_CB, X_BM, 0.02, random));
    }
    const auto with = solve_part_pose(tags, off).agreed,
               without = solve_part_pose(tags, options()).agreed;
    ASSERT_TRUE(with && without);
    const Matrix6d added = with->covariance - without->covariance;
    const auto effect =
        MeasurementModel{.tags = off.calibration}.effect_of_tag(with->X_CB, tags.size());
    const Matrix6d told = num_tags * effect * effect.transpose();
    if (num_tags == 1) {
      EXPECT_LT((added - told).norm(), 1e-6 * told.norm()) << added << "\n\n" << told;
    }
    for (int axis = 0; axis < 6; ++axis)
      EXPECT_NEAR(added(axis, axis) / told(axis, axis), 1, 0.2) << num_tags << " tags, " << axis;
  }
}

TEST(SolvePartPose, HasACovarianceThatIsConsistentWithGaussianCornerNoise) {
  for (const unsigned seed : {1u, 2u, 3u}) {
    for (const int num_tags : {1, 2, 3}) {
      std::mt19937 random(seed);
      double sum = 0;
      constexpr int kViews = 300;
      for (int i = 0; i < kViews; ++i) {
        const Pose X_CB = X_CB_of(random);
        const auto pose = solve_part_pose(seen_box(X_CB, num_tags, 0.1, random), options()).agreed;
        ASSERT_TRUE(pose);
        const Vector6d error = log(pose->X_CB.inverse() * X_CB);
        sum += error.dot(pose->covariance.inverse() * error);
      }
      RecordProperty("mean_d2_" + std::to_string(num_tags) + "_tags_seed_" + std::to_string(seed),
                     std::to_string(sum / kViews));
      EXPECT_NEAR(sum / kViews, 6, 0.9) << num_tags << " tags, seed " << seed;
    }
  }
}

TEST(SolvePartPose, TellsTheOtherPoseOfASingleDistantTagButNotOfTagsInTwoPlanes) {
  std::mt19937 random(3);
  int num_other_single = 0, num_other_two = 0;
  for (int i = 0; i < 100; ++i) {
    Pose X_CB = Pose::Identity();
    X_CB.linear() = exp_so3(Eigen::Vector3d(0.2, 0.15, 0));
    X_CB.translation() = Eigen::Vector3d(0, 0, 2);
    const auto single =
        solve_part_pose({seen(0, X_CB, Pose::Identity(), 0.3, random)}, options()).agreed;
    ASSERT_TRUE(single);
    if (single->X_CB_other) {
      ++num_other_single;
      EXPECT_GE(single->error_ratio, 1);
      EXPECT_LE(single->error_ratio, 10);
      const double best = std::min(rotation_angle(single->X_CB.inverse() * X_CB),
                                   rotation_angle(single->X_CB_other->inverse() * X_CB));
      EXPECT_LT(best, 0.25);
    } else {
      EXPECT_EQ(single->error_ratio, 0);
    }
    const auto two = solve_part_pose(seen_box(X_CB_of(random), 2, 0.1, random), options()).agreed;
    ASSERT_TRUE(two);
    num_other_two += two->X_CB_other.has_value();
  }
  EXPECT_GT(num_other_single, 50);
  EXPECT_EQ(num_other_two, 0);
}

TEST(SolvePartPose, TakesOutTheTagThatDisagrees) {
  std::mt19937 random(4);
  for (int i = 0; i < 20; ++i) {
    const Pose X_CB = X_CB_of(random);
    std::vector<SeenTag> tags = seen_box(X_CB, 3, 0.1, random);
    Pose moved = X_CB;
    moved.translation().x() += 0.02;
    tags[i % 3] = seen(i % 3, moved, box()[i % 3], 0.1, random);
    const auto [agreed, contradictions] = solve_part_pose(tags, options());
    ASSERT_TRUE(agreed);
    EXPECT_EQ(agreed->tags.size(), 2u);
    EXPECT_LT((agreed->X_CB.translation() - X_CB.translation()).norm(), 3e-3);
    ASSERT_EQ(contradictions.size(), 1u);
    EXPECT_EQ(contradictions[0].tags, std::vector<int>{i % 3});
    EXPECT_LT((contradictions[0].X_CB.translation() - moved.translation()).norm(), 1e-2);
  }
}

TEST(SolvePartPose, BelievesNoneOfTwoTagsThatDisagree) {
  std::mt19937 random(7);
  const Pose X_CB = X_CB_of(random);
  std::vector<SeenTag> tags = seen_box(X_CB, 2, 0.1, random);
  Pose moved = X_CB;
  moved.translation().x() += 0.02;
  tags[0] = seen(0, moved, box()[0], 0.1, random);
  const auto [agreed, contradictions] = solve_part_pose(tags, options());
  EXPECT_FALSE(agreed);
  ASSERT_EQ(contradictions.size(), 2u);
  for (int i = 0; i < 2; ++i) {
    const Pose& by_it = i == 0 ? moved : X_CB;
    EXPECT_EQ(contradictions[i].tags, std::vector<int>{i});
    EXPECT_LT((contradictions[i].X_CB.translation() - by_it.translation()).norm(), 1e-2);
  }
  // A tag that fits no pose contradicts nobody.
  tags[0].corners[0].ray.x() += 20 / kFocal_px;
  const PartPoses by_one = solve_part_pose(tags, options());
  ASSERT_TRUE(by_one.agreed);
  EXPECT_EQ(by_one.agreed->tags, std::vector<int>{1});
  EXPECT_TRUE(by_one.contradictions.empty());
}

TEST(SolvePartPose, GivesNothingForATagThatFitsNoPose) {
  std::mt19937 random(6);
  SeenTag tag = seen(0, X_CB_of(random), Pose::Identity(), 0.1, random);
  tag.corners[0].ray.x() += 20 / kFocal_px;
  EXPECT_FALSE(solve_part_pose({tag}, options()).agreed);
  EXPECT_FALSE(solve_part_pose({}, options()).agreed);
}

}  // namespace
}  // namespace bodyschema
