#pragma once

#include <cstdint>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "common/geometry/pose.h"
#include "common/schema/matrix_gp.h"
#include "common/schema/residual_gp.h"
#include "common/schema/sample.h"
#include "common/schema/signal.h"

namespace bodyschema {

/// One screw joint inside a local model: Exp(ŝ ϑ) · X_after with ϑ = gain·θ + offset and
/// ŝ = (0, 0, slide, 0, 0, turn), that is a motion along and about the joint frame's z axis.
/// Revolute: slide = 0. Prismatic: turn = 0. Helical: both.
struct ScrewJoint {
  int signal = 0;                   ///< index into BodySchema::signals
  double gain = 1;                  ///< a (0: a stuck joint)
  double offset = 0;                ///< b, in command units
  double slide = 0;                 ///< [m per command unit]
  double turn = 0;                  ///< [rad per command unit]
  Pose X_after = Pose::Identity();  ///< the constant transform that follows
  /// Joints of an edge with the same number: their mutual order is open. −1: it is settled.
  int order_group = -1;
  /// Standard deviation, from one action to the next, of what a θ + b is off by [command units]:
  /// backlash, steps, droop. 0: none was found.
  double scatter = 0;
};

/// Noise of one marker per axis, as configured or estimated.
struct Noise {
  double position_m = 0;
  double rotation_rad = 0;
};

/// Derivative of a pose by an action, 6×m: (translation [m], rotation [rad]) per command unit.
using PoseJacobian = Eigen::Matrix<double, 6, Eigen::Dynamic>;

/// What the covariance of a prediction is made from.
enum class Variance {
  /// Of the mean: what the samples left open about the parameters, to first order. Small where the
  /// model is right, and too small where it is not.
  kFirstOrder,
  /// Of where the part is at one action: kFirstOrder, and what the joints on the way scatter from
  /// one action to the next, see ScrewJoint::scatter; of soft edges what they leave beside the
  /// noise.
  kOneAction,
  /// Of what will be seen: mean squares of the edges' leave-one-out residuals (the chapter prefers
  /// variances estimated from the data, Section 3.3). The noise of two markers is in every edge, so
  /// along a path this is an upper bound; see empirical_covariance() in kinematic_path.h for that
  /// of a whole path.
  kEmpirical,
};

enum class EdgeState : std::int8_t { kOk = 0, kSuspect = 1, kInvalid = 2, kProvisional = 3 };

/// A local model Δ_ij(θ) = X_ij between two body parts (Section 3.1 of the chapter):
///   Δ(θ) = left · ∏_d [Exp(ŝ_d (a_d θ_d + b_d)) · X_after_d] · Exp(ρ(θ)) · right,
/// ρ = 0 unless there is a residual GP (soft bodies).
/// No joints: a rigid edge. θ holds the displacement of every signal: BodySchema::displacements()
/// of the action, which is the action itself where commands are linear. Where there is a matrix GP
/// it stands between left and right instead.
struct Edge {
  int from = 0;
  int to = 0;
  Pose left = Pose::Identity();
  std::vector<ScrewJoint> joints;
  /// The chapter's local model, or null. It never changes, so copies of the edge share it.
  std::shared_ptr<const MatrixGp> matrix_gp;
  /// What the screws leave of a soft body, or null. It never changes either.
  std::shared_ptr<const ResidualGp> residual_gp;
  Pose right = Pose::Identity();

  /// Covariance of the parameters, order: left tangent (6); per joint: slide, turn, X_after tangent
  /// (6). Right perturbations. Side num_parameters(). Singular along the gauge of the screw frames.
  /// Of the fit of the whole tree where the root rests, else of the two parts' own poses.
  Eigen::MatrixXd parameter_covariance;

  /// Root mean square of the leave-one-out residuals of the inliers: over the three axes together.
  double position_rms_m = 0;
  double rotation_rms_rad = 0;
  int num_samples = 0;
  int num_outliers = 0;
  std::int64_t valid_since_sample = 0;
  double confidence = 1;
  EdgeState state = EdgeState::kOk;

  /// By value: has the same Gaussian process in it, or none as the other.
  bool has_process_of(const Edge& other) const;
  /// "rigid", "screw", "screw_gp" (with a residual GP, also without any joint) or "matrix_gp".
  const char* kind() const;
  /// Distinct signal indices, in the order of the joints; then those of the residual GP alone.
  std::vector<int> signals() const;
  /// Of the screws: 6 + 8·|joints|.
  Eigen::Index num_parameters() const;

  Pose predict(const Eigen::VectorXd& theta) const;
  /// ∂/∂θ of the predicted pose: 6×m, right perturbation in the frame of `to`:
  /// predict(θ + δ) = predict(θ) · exp(J δ + O(δ²)).
  Eigen::MatrixXd jacobian(const Eigen::VectorXd& theta) const;
  /// ∂/∂parameters of the predicted pose, 6×num_parameters(): right perturbation in the frame of
  /// `to`, parameters in the order of parameter_covariance. Of the screws, not of a matrix GP.
  Eigen::MatrixXd parameter_jacobian(const Eigen::VectorXd& theta) const;
  /// First-order covariance of the prediction (right perturbation in the frame of `to`): from
  /// parameter_covariance and the residual GP's variances, or from the matrix GP's.
  Matrix6d prediction_covariance(const Eigen::VectorXd& theta) const;
  /// What the scatter of the joints adds to the covariance of one pose (right perturbation in the
  /// frame of `to`): Σ_d scatter_d² t_d t_dᵀ with t_d the twist of joint d.
  Matrix6d scatter_covariance(const Eigen::VectorXd& theta) const;
  /// Of a residual GP: what it leaves that the noise of its two markers does not explain, with the
  /// parts `X` apart: hysteresis, what is no function of the action. From position_rms_m and
  /// rotation_rms_rad, alike along all axes.
  Matrix6d unexplained_covariance(const Pose& X, const Noise& noise) const;
  /// Covariance of an observed pose about the predicted one, from position_rms_m and
  /// rotation_rms_rad, alike along all axes; the same everywhere.
  Matrix6d empirical_covariance() const;
};

/// Why a part has no edge.
enum class Unconnected : std::int8_t {
  kNeverSeen = 0,
  kNotEnoughData = 1,  ///< nothing speaks against a model yet, but too few samples to trust one
  kNoValidModel = 2,   ///< enough data, and every model up to the largest k was refuted
};

/// Detail of a part that was alone: nothing can be said of how it moves.
inline constexpr const char* kOnlyPart = "the only part that was seen: nothing to connect it with";

struct UnconnectedPart {
  int part = 0;
  Unconnected reason = Unconnected::kNotEnoughData;
  /// For people: what was tried and what is missing.
  std::string detail;
};

/// From sample `found` on it was known that the body is as it is since `since` only.
struct KnownChange {
  std::int64_t found = 0;
  std::int64_t since = 0;
};

/// A tag that moved on its part, or fell off it: what rests on it says nothing of the part.
struct MovedTag {
  int tag = 0;
  std::int64_t found = 0;   ///< known from this sample on
  std::int64_t since = 0;   ///< first sample that showed it
  std::int64_t until = -1;  ///< known to be where it was from this sample on; −1: it is not

  bool operator==(const MovedTag&) const = default;
};

struct PosePrediction {
  Pose X_AB = Pose::Identity();
  Matrix6d covariance = Matrix6d::Zero();  ///< right perturbation in frame B
};

/// The body schema: a forest of local models over the observed parts, spanning when complete.
/// An immutable value once published: change a copy, give it a new version.
struct BodySchema {
  std::int64_t utime = 0;
  std::int64_t version = 0;
  std::int64_t base_version = 0;
  /// Index of the last sample that this schema rests on; −1 before the first.
  std::int64_t last_sample_index = -1;
  /// Of the samples that it rests on (common/config/calibration_id.h); 0: not told.
  std::int64_t calibration_id = 0;
  int num_samples = 0;  ///< samples used
  bool complete = false;
  bool refined = false;    ///< fitted by the refiner
  std::vector<int> parts;  ///< observed parts, ascending
  /// Those of which positions alone are known, ascending: leaves, whose frames' rotation is
  /// nobody's measurement but turned as their last joint's.
  std::vector<int> position_parts;
  int root = -1;  ///< −1: no part was seen yet
  /// Pose of the root part in the camera's frame, and its covariance (right perturbation).
  Pose X_CR = Pose::Identity();
  Matrix6d X_CR_covariance = Matrix6d::Zero();
  std::vector<Signal> signals;
  std::vector<Edge> edges;  ///< ordered from the root outwards; `from` is nearer to the root
  /// By part, right perturbation in its frame: what X_CR and the edges that meet there have in
  /// common with opposite sign, for a part's frame is where its markers were seen. Along a path it
  /// cancels. Of parts whose edges were fitted together.
  std::map<int, Matrix6d> frame_covariances;
  std::vector<UnconnectedPart> unconnected;
  /// Signals of which the samples do not tell yet what they move, if anything (indices, ascending).
  std::vector<int> undecided_signals;
  Noise noise;
  std::vector<KnownChange> changes;  ///< of the body, the newest kMaxChanges, ascending by `found`
  static constexpr std::size_t kMaxChanges = 128;
  std::vector<MovedTag> moved_tags;  ///< the newest kMaxMovedTags, ascending by `found`
  static constexpr std::size_t kMaxMovedTags = 64;

  bool has_part(int part) const;
  /// Does a prediction of this part say how it is turned?
  bool has_rotation(int part) const;
  /// The first sample of the body as it was known after sample `sample_index`; 0 before any change.
  std::int64_t body_since(std::int64_t sample_index) const;
  /// The moved tags as they were known after sample `sample_index`.
  std::vector<MovedTag> moved_tags_known(std::int64_t sample_index) const;
  /// Signals that no edge uses, and none would: what is undecided is not among them (indices).
  std::vector<int> unused_signals() const;

  /// Sets what of each signal `samples` covered, where every edge that it moves lay between two
  /// parts that were seen; of a signal that moves none, or one never so seen, all of them.
  void set_covered(const std::vector<ActionPoseSample>& samples);

  /// θ of every signal, in command units: what edges take.
  /// @throws std::invalid_argument if `action` does not have one value per signal.
  Eigen::VectorXd displacements(const Eigen::VectorXd& action) const;

  /// Pose of part `to` in part `from` along the tree (Section 3.3, eq. 17). std::nullopt if they
  /// are not connected. Finds the way anew each time: who asks often makes a KinematicPath.
  /// @throws std::invalid_argument if `action` does not have one value per signal.
  std::optional<PosePrediction> predict(int from, int to, const Eigen::VectorXd& action,
                                        Variance variance = Variance::kFirstOrder) const;
  /// All parts connected to the root, X_RB by part id.
  std::map<int, Pose> predict_all(const Eigen::VectorXd& action) const;
  /// 6×m Jacobian of the pose of `to` in `from`; right perturbation in the frame of `to`.
  std::optional<Eigen::MatrixXd> jacobian(int from, int to, const Eigen::VectorXd& action) const;
};

/// Beside another recording, whose samples count anew: the schema holds for all of them, and tags
/// that had moved stay so.
void forget_when_it_changed(BodySchema* schema);

/// By then.
bool has_moved(const std::vector<MovedTag>& moved, int tag, std::int64_t sample_index);
/// The sample as if tags that had moved had not been seen.
void drop_moved_tags(const std::vector<MovedTag>& moved, ActionPoseSample* sample);

}  // namespace bodyschema
