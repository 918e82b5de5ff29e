#include <gtest/gtest.h>

#include <algorithm>
#include <functional>
#include <random>

#include "processes/structure_learner/recording/recording.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

/// Recordings of many robots, of noise, of flips and of parts that are not seen.
template <class Visit>
void for_each_robot(int count, Visit visit) {
  test::Rng rng(45);
  for (int n = 0; n < count; ++n) {
    const char* const names[] = {"a", "b", "c", "co", "d", "dP"};
    const auto robot =
        n % 4 == 3 ? test::random_tree({}, rng) : test::chapter_robot(names[n % 6], rng);
    const test::Regime regimes[] = {test::Regime::kFree, test::Regime::kTag, test::Regime::kTagIso,
                                    test::Regime::kChapter};
    Recording recording;
    recording.samples = test::babble(robot, n % 2 ? 15 : 60, {.regime = regimes[n / 4 % 4]}, rng);
    visit(recording, n);
  }
}

void change_poses(Recording& recording, const std::function<void(Pose&)>& change) {
  for (ActionPoseSample& sample : recording.samples)
    for (PartObservation& o : sample.parts) change(o.X_CB);
}

/// The pose that is read where x, y, z, w was written.
void as_x_y_z_w(Pose& X) {
  const Eigen::Quaterniond q(X.linear());
  X.linear() = Eigen::Quaterniond(q.x(), q.y(), q.z(), q.w()).toRotationMatrix();
}

bool is_hinted(const Recording& recording, const std::string& word) {
  const auto hints = hints_of(recording);
  return std::any_of(hints.begin(), hints.end(),
                     [&](const std::string& hint) { return hint.find(word) != std::string::npos; });
}

TEST(RecordingHintsTest, ARecordingAsItShouldBeGetsNone) {
  for_each_robot(300, [](Recording& recording, int n) {
    for (const std::string& hint : hints_of(recording))
      ADD_FAILURE() << "robot " << n << ": " << hint;
  });
}

TEST(RecordingHintsTest, SignalsThatHardlyMoveAreNamed) {
  Recording recording;
  recording.signals = {{.name = "shoulder"}, {.name = "elbow"}, {.name = "wrist"}};
  for (int t = 0; t < 20; ++t) {
    ActionPoseSample& sample = recording.samples.emplace_back();
    sample.action = Eigen::Vector3d(0.1 * t, 1e-6 * t, 1.5);
    sample.parts.push_back({.part = 1, .X_CB = Pose::Identity()});
  }
  ASSERT_TRUE(is_hinted(recording, "elbow varies by 1.9e-05 at most, where others move by 1.9"));
  EXPECT_FALSE(is_hinted(recording, "wrist"));
}

TEST(RecordingHintsTest, MillimetresAreNamed) {
  for_each_robot(100, [](Recording& recording, int n) {
    change_poses(recording, [](Pose& X) { X.translation() *= 1000; });
    EXPECT_TRUE(is_hinted(recording, "positions look like millimetres")) << n;
  });
}

TEST(RecordingHintsTest, TheQuaternionOrderXYZWIsNamedWhereTheDataTell) {
  int num_named = 0;
  for_each_robot(300, [&](Recording& recording, int) {
    change_poses(recording, as_x_y_z_w);
    num_named += is_hinted(recording, "x y z w");
  });
  // Measured: 276. The others are small or noisy.
  EXPECT_GT(num_named, 250);
  // A frame's own pose is no rotation.
  const std::string header = "t,q1,part,x,y,z,qw,qx,qy,qz\n";
  EXPECT_EQ(parse_csv(header + "0,1,0,0,0,0,0,0,0,1\n0,1,1,0,0,1,0.6,0,0,0.8\n", "f").hints.size(),
            1U);
  EXPECT_TRUE(
      parse_csv(header + "0,1,0,0,0,0,1,0,0,0\n0,1,1,0,0,1,0.6,0,0,0.8\n", "f").hints.empty());
}

/// Three parts, two hinges, a root that rests: few joints tell the order, and half of them in
/// either.
Recording small_arm(std::uint32_t seed, double noise_m, double noise_rad) {
  test::Rng rng(seed);
  std::normal_distribution<double> normal;
  std::uniform_real_distribution<double> angle(-1, 1);
  const auto vector = [&](double sigma) {
    return Eigen::Vector3d(sigma * normal(rng), sigma * normal(rng), sigma * normal(rng));
  };
  const auto turn = [](const Eigen::Vector3d& v) { return Pose(exp_so3(v)); };
  const auto move = [](double x, double y, double z) {
    return Pose(Eigen::Translation3d(x, y, z));
  };
  Recording recording;
  for (int i = 0; i < 40; ++i) {
    const Pose X_C1 = move(0.1, 0.2, 1.5) * turn({2, 0, 0});
    const Pose X_C2 =
        X_C1 * move(0, 0, 0.2) * turn({0, 0, angle(rng)}) * move(0.1, 0, 0) * turn({0.3, 0, 0});
    const Pose X_C3 = X_C2 * move(0, 0, 0.1) * turn({0, angle(rng), 0}) * move(0.3, 0, 0);
    ActionPoseSample& sample = recording.samples.emplace_back();
    for (const Pose& X : {X_C1, X_C2, X_C3}) {
      PartObservation& o = sample.parts.emplace_back();
      o.part = static_cast<int>(sample.parts.size());
      o.X_CB = Eigen::Translation3d(vector(noise_m)) * X * turn(vector(noise_rad));
    }
  }
  return recording;
}

TEST(RecordingHintsTest, TheQuaternionOrderOfThreePartsIsNamed) {
  for (std::uint32_t seed = 1; seed <= 20; ++seed) {
    for (const double noise_m : {0.002, 0.01}) {
      Recording recording = small_arm(seed, noise_m, 2.5 * noise_m);
      EXPECT_TRUE(hints_of(recording).empty()) << seed;
      change_poses(recording, as_x_y_z_w);
      EXPECT_TRUE(is_hinted(recording, "x y z w")) << seed << ", " << noise_m;
    }
  }
}

TEST(RecordingHintsTest, StandardDeviationsInMillimetresAreNamed) {
  const std::string header = "t,q,part,x,y,z,qw,qx,qy,qz,sp_m,sr_deg\n";
  EXPECT_TRUE(is_hinted(parse_csv(header + "0,1,1,0,0,0,1,0,0,0,3,1\n", "f"), "sp_m"));
  EXPECT_TRUE(parse_csv(header + "0,1,1,0,0,0,1,0,0,0,0.003,1\n", "f").hints.empty());
}

TEST(RecordingHintsTest, StandardDeviationsInRadiansAreNamed) {
  const std::string header = "t,q,part,x,y,z,qw,qx,qy,qz,sp_m,sr_deg\n";
  EXPECT_TRUE(is_hinted(parse_csv(header + "0,1,1,0,0,0,1,0,0,0,0.001,0.0035\n", "f"), "sr_deg"));
  EXPECT_TRUE(parse_csv(header + "0,1,1,0,0,0,1,0,0,0,0.001,0.2\n", "f").hints.empty());
}

}  // namespace
}  // namespace bodyschema
