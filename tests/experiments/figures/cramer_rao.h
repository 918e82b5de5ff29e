#pragma once

#include <map>
#include <vector>

#include "common/geometry/pose.h"
#include "common/schema/sample.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema::experiments {

/// The Cramér–Rao bound of a robot's forward kinematics: the least covariance of any unbiased
/// estimate from these marker poses.
///
/// Unknown are the resting root's pose X_CR and, for every link, X_before, and of a joint slide and
/// turn per command unit and X_after too: 6 + 6 or 14 a link; the structure and each joint's signal
/// are known, as are the markers' covariances. A marker's pose y = x · Exp(ε), ε ~
/// N(0, Σ) adds Jᵀ Σ⁻¹ J to the Fisher information, J = ∂x/∂parameters (right perturbation, marker
/// frame; terms of the second order in ε are left out). The pose of one part in another at some
/// action has at least the covariance G F⁺ Gᵀ, G its derivative: the null space of F is gauge (the
/// place of a screw's frame along and about its axis), which no pose depends on.
///
/// Outliers are left out: the bound is that of the same markers without flips.
class CramerRao {
 public:
  /// `knows_kinds`: that joints which turn do not slide, and the other way round, is known. The
  /// robot must outlive this.
  explicit CramerRao(const test::SyntheticRobot& robot, bool knows_kinds = false);

  /// Adds the information of one sample, by its true poses and the observations' covariances (which
  /// must be invertible), for the parts that were seen.
  void add(const ActionPoseSample& sample);

  /// 6×6 lower bound of the covariance of the pose of `to` in `from`; right perturbation in the
  /// frame of `to`. Infinite if the samples leave the pose open.
  Matrix6d bound(int from, int to, const Eigen::VectorXd& action) const;
  /// The same of its pose in the camera's frame.
  Matrix6d bound_in_camera(int part, const Eigen::VectorXd& action) const;

  /// 6 × number of parameters: derivative of a part's pose in the camera frame.
  Eigen::MatrixXd pose_jacobian(int part, const Eigen::VectorXd& action) const;
  int num_parameters() const { return num_parameters_; }

  /// `robot` with its parameters moved by a step, in the order of pose_jacobian().
  test::SyntheticRobot perturbed(const Eigen::VectorXd& step) const;

 private:
  void factorize() const;
  /// Of what has the derivative `G`.
  Matrix6d bound_of(const Eigen::MatrixXd& G) const;

  const test::SyntheticRobot& robot_;
  const bool knows_kinds_;
  std::vector<int> first_parameter_;  // of each link
  int num_parameters_ = 0;
  Eigen::MatrixXd information_;
  mutable bool is_factorized_ = false;
  mutable Eigen::MatrixXd root_;   // F⁺ = root · rootᵀ
  mutable Eigen::MatrixXd gauge_;  // null space of F
};

/// √ of the mean over `actions` of the position's part of the bound's trace [m].
double position_bound_rms(const CramerRao& bound, int from, int to,
                          const std::vector<Eigen::VectorXd>& actions);

}  // namespace bodyschema::experiments
