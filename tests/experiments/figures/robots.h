#pragma once

#include <optional>
#include <string>
#include <vector>

#include "common/schema/body_schema.h"
#include "processes/structure_learner/baseline/learn_baseline.h"
#include "processes/structure_learner/learn.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema::experiments {

/// A robot, its observations of itself, and the actions at which it is judged. A function of kind,
/// regime and seed. Observations have covariances, as the observer's do.
struct Trial {
  test::SyntheticRobot robot;
  test::Regime regime = test::Regime::kFree;
  std::vector<ActionPoseSample> samples;
  std::vector<Eigen::VectorXd> test_actions;  ///< independent, uniform over the limits

  /// Samples 1 … N.
  std::vector<ActionPoseSample> first(int num_samples) const;
  int root() const { return robot.visible_parts().front(); }
  int end_effector() const { return robot.visible_parts().back(); }
};

/// Poses at which a robot is judged.
inline constexpr int kTestPoses = 200;

/// `kind`: of test::chapter_robot(), or "tree", "tree3" (two hidden parts in a row), "tree40" (40
/// parts, 3 hidden). `bend` [command units]: of SyntheticRobot.
Trial make_trial(const std::string& kind, test::Regime regime, int num_samples, int seed,
                 double bend = 0);

/// Errors of the end effector's pose in the root over the test actions, against the noise-free
/// truth.
struct PoseErrors {
  double position_mean_m = 0, position_rms_m = 0;
  double rotation_mean_rad = 0;
};
/// std::nullopt if the schema does not connect the end effector with the root.
std::optional<PoseErrors> end_effector_errors(const BodySchema& schema, const Trial& trial);

/// σ_z of the chapter (50 mm, 15°) in its noise; else derived from the markers' noise, at least
/// 1 mm and 0.3° per axis.
BaselineOptions baseline_options(test::Regime regime);

/// The chapter's local models on the tree that learning ought to find: its predictions if its
/// structure search made no mistake. A part without two samples in common with its neighbour is
/// left out.
BodySchema baseline_on_true_structure(const Trial& trial,
                                      const std::vector<ActionPoseSample>& samples);

/// Structures as they were judged.
struct Judgements {
  int right = 0, incomplete = 0, wrong = 0;
  int total() const { return right + incomplete + wrong; }
  void add(test::Rightness rightness);
  /// "99.5 % (≥ 97.2) / 0.5 / 0": right with its Wilson lower bound, incomplete, wrong.
  std::string text() const;
};

/// A learned structure for people: "1–2 {}, 2–3 {q1}".
std::string structure_of(const BodySchema& schema);

}  // namespace bodyschema::experiments
