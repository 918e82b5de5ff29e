#pragma once

#include <vector>

#include "common/estimation/student_t.h"
#include "common/kinematics/screw_chain.h"
#include "processes/structure_learner/pair_data.h"

namespace bodyschema {

/// Largest number of joints of the models that closed-form starts lead to, pair by pair
/// (screen.h). Longer ones: long_chain.h.
inline constexpr int kMaxScreenedJoints = 2;

/// A local model in the learner's own terms, over normalised signals q ∈ [−1, 1]:
///   Δ(q) = A_0 ∏_d Exp(ŝ_d q_d) A_d,  ŝ_d = (0, 0, slide_d, 0, 0, turn_d)
/// Revolute, prismatic and helical joints in one form; the command's gain is in ŝ, its offset in
/// A_0. k = 0 is a rigid connection.
struct LocalModel {
  struct Joint {
    int signal = 0;
    double slide = 0;                 ///< [m per half range]
    double turn = 0;                  ///< [rad per half range]
    Pose X_after = Pose::Identity();  ///< A_(d+1) of joint d, counted from 0
    int order_group = -1;             ///< as ScrewJoint::order_group
    bool slides = false;              ///< its turn stays 0 in fits
  };
  Pose first = Pose::Identity();  ///< A_0
  std::vector<Joint> joints;
  bool is_position = false;  ///< no data tell how the end is turned: it stays as it is in fits

  int num_joints() const { return static_cast<int>(joints.size()); }
  int num_parameters() const { return ScrewChainLayout::size(num_joints()); }
  /// A_d
  Pose& transform(int d) { return d == 0 ? first : joints[d - 1].X_after; }
  bool uses(int s) const;
  /// Pose of j in i at sample `sample`.
  Pose predict(const NormalizedActions& actions, int sample) const;
  /// The same motion seen from the other side: Δ_ji = Δ_ij⁻¹.
  LocalModel inverse() const;
};

using ParameterJacobian = Eigen::Matrix<double, 6, Eigen::Dynamic>;
using ParameterMatrix = Eigen::MatrixXd;
using ParameterVector = Eigen::VectorXd;

/// Prediction and its Jacobian ∂(right perturbation)/∂parameters, in the order of ScrewChainLayout.
Pose predict_with_jacobian(const LocalModel& model, const NormalizedActions& actions, int sample,
                           ParameterJacobian* jacobian);

/// ∂Δ/∂q_d of the normalised signal of joint d, right perturbation in frame j: 6 × num_joints.
using MotionJacobian = Eigen::Matrix<double, 6, Eigen::Dynamic>;
MotionJacobian motion_jacobian(const LocalModel& model, const NormalizedActions& actions,
                               int sample);

/// The model moved by a parameter step.
LocalModel perturbed(const LocalModel& model, const ParameterVector& step);

/// What one frame says about a model.
struct FrameFit {
  int hypothesis = 0;                    ///< index into PairData::hypotheses: the likeliest reading
  Vector6d error = Vector6d::Zero();     ///< log(Δ̂⁻¹ z): (translation [m], rotation [rad])
  Vector6d residual = Vector6d::Zero();  ///< whitened log(Δ̂⁻¹ z)
  double squared_distance = 0;           ///< |residual|²
  int num_residuals = 6;                 ///< 3 of a position alone, whose others are 0

  double weight() const { return robust_weight(squared_distance, num_residuals); }
  double cost() const { return robust_cost(squared_distance, num_residuals); }
};

struct Fit {
  LocalModel model;
  double cost = 0;  ///< Σ (ν + n)/2 · log(1 + d²/ν)
  std::vector<FrameFit> frames;
};

/// The likeliest reading of a frame under a prediction. Deterministic; no memory of earlier
/// choices.
FrameFit best_reading(const PairData& pair, int frame, const Pose& prediction);

/// Residuals and cost of a model as it is.
Fit evaluate(const LocalModel& model, const PairData& pair, const NormalizedActions& actions);

/// Levenberg–Marquardt from `start` with Student-t weights and analytic Jacobian. The gauge freedom
/// of the screw frames is held by the damping alone. Ends when a step gains less than `tolerance`
/// [nats].
Fit fit_local_model(const LocalModel& start, const PairData& pair, const NormalizedActions& actions,
                    int max_iterations, double tolerance = 1e-8);

/// Leave-one-out diagnostics of a fit in closed form.
struct LeaveOneOut {
  /// d²_t = rᵀ(I − H_tt)⁻¹ r, χ²₆ a frame under a true model (χ²₃ of positions alone).
  std::vector<double> squared_distance;
  /// log(Δ̂₋ₜ⁻¹ z) predicted without frame t, not whitened: (translation [m], rotation [rad]).
  std::vector<Vector6d> residual;
  /// Pseudo-inverse (JᵀWJ)⁺ along the gauge, over normalised parameters.
  ParameterMatrix parameter_covariance;
  /// Rank of JᵀWJ: 6 + 6k for revolute and helical joints, less for prismatic ones and for
  /// positions alone.
  int rank = 0;
};
LeaveOneOut leave_one_out(const Fit& fit, const PairData& pair, const NormalizedActions& actions);

/// What each frame adds to the gradient of a fit, Jᵀ W r: parameters × frames.
Eigen::MatrixXd scores(const Fit& fit, const PairData& pair, const NormalizedActions& actions);

}  // namespace bodyschema
