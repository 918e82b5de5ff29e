#pragma once

#include <optional>
#include <vector>

#include "common/kinematics/screw_chain.h"
#include "common/schema/body_schema.h"
#include "common/schema/sample.h"

namespace bodyschema {

/// The way from part A to part B along the tree of one schema, made once and asked often (Section
/// 3.3 of the chapter, eq. 17): the forward kinematics of a learned robot.
///
/// A value that never changes and may be shared by threads. Constants stand side by side in it: a
/// path of k screws costs k sines, cosines and products of two transforms, whatever rigid edges and
/// edges walked backwards lie between. Where all edges are rigid or screws, nothing is allocated.
/// Actions are in command units, one value per signal of the schema; what bends a command
/// (Signal::warp) is in all results, also in the derivatives.
class KinematicPath {
 public:
  /// std::nullopt if the parts are not connected. @throws std::invalid_argument if a joint on the
  /// way names a signal that the schema does not have.
  static std::optional<KinematicPath> between(const BodySchema& schema, int from, int to);

  int num_signals() const { return static_cast<int>(signals_.size()); }

  /// X_AB. All that take an action: @throws std::invalid_argument if it does not have one value per
  /// signal.
  Pose predict(const Eigen::Ref<const Eigen::VectorXd>& action) const;
  /// The same, and its derivative by the action, 6×m: right perturbation in frame B,
  /// predict(q + δ) = predict(q) · exp(J δ + O(δ²)).
  Pose predict(const Eigen::Ref<const Eigen::VectorXd>& action, PoseJacobian* jacobian) const;
  /// Right perturbation in frame B. Of first order, what the legs have in common
  /// (BodySchema::frame_covariances) is taken out; else they add up as if independent.
  Matrix6d covariance(const Eigen::Ref<const Eigen::VectorXd>& action, Variance variance) const;

  /// The columns of `actions`, m×T, one after another.
  std::vector<Pose> predict_trajectory(const Eigen::MatrixXd& actions) const;
  std::vector<PosePrediction> predict_trajectory(const Eigen::MatrixXd& actions,
                                                 Variance variance) const;
  std::vector<PoseJacobian> jacobian_trajectory(const Eigen::MatrixXd& actions) const;

 private:
  /// One edge on the way.
  struct Leg {
    Edge edge;
    bool is_forward = true;
    /// BodySchema::frame_covariances of the part between the leg before and this one.
    std::optional<Matrix6d> start = std::nullopt;
    Noise noise = {};  ///< BodySchema::noise
  };
  /// A motion, and the constant transform X_after up to the next one: a screw motion along
  /// and about z, or else a leg of another kind, asked as a whole.
  struct Step {
    int signal = 0;
    Screw screw = {};  ///< per command unit
    int leg = -1;      ///< index into legs_; −1: a screw
    Pose X_after = Pose::Identity();
  };

  KinematicPath() = default;
  void append(const Pose& constant);
  void append(const ScrewJoint& joint, double sense);
  void check_size(Eigen::Index num_values) const;
  Eigen::VectorXd displacements(const Eigen::Ref<const Eigen::VectorXd>& action) const;
  Pose predict_unchecked(const Eigen::Ref<const Eigen::VectorXd>& action) const;

  std::vector<Signal> signals_;
  std::vector<Leg> legs_;
  Pose X_before_ = Pose::Identity();  ///< before the first step
  std::vector<Step> steps_;
};

/// The chapter's global variance of a prediction (Section 3.3: "estimating the variance directly
/// from the training data is more reliable"): how the poses of B in A that were seen scatter about
/// those that the path predicts. Right perturbation in frame B; the noise of both markers, the
/// uncertainty of the model and what it cannot represent are all in it, each once, where
/// Variance::kEmpirical adds up edges. Outliers (d² > χ²₆(.9973)) are set aside, found by
/// concentration steps from medians (Rousseeuw and Van Driessen 1999). The model should not have
/// been fitted to `samples`, or to many of them: residuals of a fit are too small by its degrees of
/// freedom.
/// std::nullopt below 7 inliers.
std::optional<Matrix6d> empirical_covariance(const KinematicPath& path, int from, int to,
                                             const std::vector<ActionPoseSample>& samples);

}  // namespace bodyschema
