// Class Adaptation along a path: many samples from nearly the same place.

#include <gtest/gtest.h>

#include <array>
#include <cmath>

#include "common/geometry/angle.h"
#include "processes/model_monitor/hypotheses/schema_difference.h"
#include "tests/processes/model_monitor/adaptation_life.h"

namespace bodyschema::test {
namespace {

/// The engineered arm, seen with errors of lens, tags and joints: most of the noise that is told is
/// a smooth function of the action, about the same a small step farther on.
class PathTest : public testing::TestWithParam<unsigned> {
 protected:
  PathTest()
      : rng_(GetParam()),
        schema_(BrokenArm({Fault::kNone, "", 1}, Regime::kTagIso, 1, 3).engineered()),
        body_(schema_),
        adaptation_(schema_, adaptation_options(Regime::kTagIso)),
        action_(Eigen::VectorXd::Zero(7)) {
    for (auto& of_part : waves_)
      for (Wave& wave : of_part) {
        wave.phase = uniform(rng_, 0, 2 * M_PI);
        wave.slope = Eigen::VectorXd::NullaryExpr(7, [this] { return 2 * gaussian(rng_); });
      }
  }

  void babble(int count) {
    for (int n = 0; n < count; ++n) {
      for (double& q : action_) q = uniform(rng_, -1.3, 1.3);
      see();
    }
  }
  /// In steps of a thousandth of the ranges.
  void go(int count) {
    for (int n = 0; n < count; ++n) {
      action_.head<4>().array() += 0.0027 * (action_[0] > 1.2 ? -1 : 1);
      see();
    }
  }
  void see() {
    ActionPoseSample sample;
    sample.sample_index = num_samples_;
    sample.utime = 2'000'000 * num_samples_++;
    sample.action = action_;
    const Noise told = nominal_noise(Regime::kTagIso);
    for (const auto& [part, X_RB] : body_.predict_all(action_)) {
      Vector6d error;
      for (int i = 0; i < 6; ++i) {
        const Wave& wave = waves_[static_cast<std::size_t>(part)][static_cast<std::size_t>(i)];
        error[i] = std::sin(wave.phase + wave.slope.dot(action_)) + 0.1 * gaussian(rng_);
      }
      error.head<3>() *= told.position_m;
      error.tail<3>() *= told.rotation_rad;
      PartObservation& o = sample.parts.emplace_back();
      o.part = part;
      o.X_CB = body_.X_CR * X_RB * exp(error);
    }
    int num_probes = 0;
    for (const AdaptationEvent& e : adaptation_.on_sample(sample)) {
      life_.events.push_back(e);
      num_probes += e.kind == Kind::kProbeWanted;
    }
    EXPECT_LE(num_probes, 1);  // who makes it makes one
  }
  void bend(int part) {
    for (Edge& edge : body_.edges)
      if (edge.to == part)
        edge.left.linear() =
            edge.left.linear() * exp_so3(8 * kDegree * Eigen::Vector3d(0.6, 0.8, 0));
  }
  double error_m() {
    double sum = 0;
    for (int n = 0; n < 100; ++n) {
      Eigen::VectorXd action(7);
      for (double& q : action) q = uniform(rng_, -1.3, 1.3);
      sum += (adaptation_.schema().predict(1, 7, action)->X_AB.translation() -
              body_.predict(1, 7, action)->X_AB.translation())
                 .norm();
    }
    return sum / 100;
  }
  bool is_probe_wanted() const { return life_.has(Kind::kProbeWanted); }

  struct Wave {
    double phase;
    Eigen::VectorXd slope;
  };
  Rng rng_;
  std::array<std::array<Wave, 6>, 8> waves_;
  BodySchema schema_, body_;
  Adaptation adaptation_;
  Eigen::VectorXd action_;
  int num_samples_ = 0;
  Life life_;
};

TEST_P(PathTest, ABendIsFoundInItsMiddleAndInTheRightPlaceOnceTheArmMovesFar) {
  babble(60);
  go(60);
  EXPECT_TRUE(life_.events.empty()) << life_.log();
  bend(6);
  const int bent = num_samples_;
  while (life_.events.empty() && num_samples_ < bent + 60) go(1);
  EXPECT_LE(num_samples_ - bent, 8) << life_.log();
  go(60);
  // Along the path the link may be bent or the marker moved.
  EXPECT_TRUE(is_probe_wanted()) << life_.log();
  babble(30);
  EXPECT_LT(error_m(), 0.012) << life_.log();
}

// A camera that was moved and a first edge that was bent look alike whatever the arm does.
TEST(MostTellingAction, IsByWhatTheCameraSees) {
  const BodySchema a = BrokenArm({Fault::kNone, "", 1}, Regime::kTagIso, 1, 3).engineered();
  Vector6d twist;
  twist << 0.1, 0, 0, 0, 0.2, 0;
  const Pose T = exp(twist);
  BodySchema bent = a, moved = a;
  for (Edge& edge : bent.edges)
    if (edge.from == a.root) edge.left = T * edge.left;
  moved.X_CR = moved.X_CR * T;
  const Noise tolerance{0.001, 0.1 * kDegree};
  EXPECT_EQ(most_telling_action(bent, moved, tolerance).size(), 0);
  bent.edges.back().left = bent.edges.back().left * T;
  EXPECT_GT(most_telling_action(bent, moved, tolerance).size(), 0);
}

INSTANTIATE_TEST_SUITE_P(Seeds, PathTest, testing::Values(1, 2, 3));

}  // namespace
}  // namespace bodyschema::test
