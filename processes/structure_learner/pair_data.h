#pragma once

#include <optional>
#include <utility>
#include <vector>

#include "common/estimation/measurement_model.h"
#include "common/estimation/time_blocks.h"
#include "common/geometry/pose.h"
#include "common/schema/body_schema.h"
#include "common/schema/sample.h"

namespace bodyschema {

/// What a joint reads that is held still is no command, though it may go with the load: its range
/// is next to nothing beside that of the signal that moves `farthest`, and small in its own unit,
/// or beside its value. So a stage of 1 mm in metres beside 3 rad moves, and 5 cm beside 180 in
/// degrees.
bool is_jitter(double lower, double upper, double farthest);

/// The training actions, each signal scaled to [−1, 1] over its observed range, so that nothing in
/// the fits depends on command units, but for what counts as jitter.
class NormalizedActions {
 public:
  /// @throws std::invalid_argument if an action does not have `num_signals` values.
  NormalizedActions(const std::vector<ActionPoseSample>& samples, int num_signals);

  int num_signals() const { return static_cast<int>(centre_.size()); }
  int num_samples() const { return static_cast<int>(values_.cols()); }
  double operator()(int sample, int signal) const { return values_(signal, sample); }
  /// q = centre + half_range · value, in command units.
  double centre(int signal) const { return centre_(signal); }
  double half_range(int signal) const { return half_range_(signal); }
  /// The signals that move, by more than jitter, ascending. The others can explain nothing.
  const std::vector<int>& moving() const { return moving_; }
  /// Of two signals that move over all samples, −1 … 1.
  double correlation(int a, int b) const;
  /// They move alike, as a command and what a drive reports of it, or sides that are always moved
  /// together. Chosen: a joint of ± 60° and a drive that misses it by 3° have 0.996; of signals
  /// that are moved independently ten samples rarely have 0.9.
  bool are_alike(int a, int b) const { return std::abs(correlation(a, b)) > 0.99; }
  const TimeBlocks& blocks() const { return blocks_; }
  /// The commands of sample order[n] at sample n.
  NormalizedActions reordered(const std::vector<int>& order) const;
  /// Of the signals that move, signals × samples.
  Eigen::MatrixXd moving_values() const { return values_(moving_, Eigen::all); }

 private:
  Eigen::MatrixXd values_;  // signals × samples
  Eigen::VectorXd centre_, half_range_;
  std::vector<int> moving_;
  TimeBlocks blocks_;
};

/// So near to each other [half ranges] are values of a signal that rests.
inline constexpr double kResting = 0.02;
/// The value [half ranges] that a signal has, within kResting, at more than half of these, if it
/// has one.
std::optional<double> usual_value(std::vector<double> values);

/// One reading of z_ij = y_i⁻¹ y_j.
struct PairHypothesis {
  /// Of a position alone without rotation.
  Pose z = Pose::Identity();
  /// 6 of a pose, 3 of a position alone.
  int num_residuals = 6;
  /// L⁻¹ of Σ_z = L Lᵀ: whitens a residual log(Δ̂⁻¹ z). Of a position alone the upper left block
  /// whitens z − Δ̂ in the frame of i, where Σ_z is known; the rest is the identity, whose residuals
  /// are 0 under every prediction.
  Matrix6d whitening = Matrix6d::Identity();
  /// log |2πΣ_z|
  double log_det = 0;
  /// tr Σ_z⁻¹ M, of the systematic part M of Σ_z: what it is expected to make of d².
  double systematic = 0;
  /// −2 log of the prior odds against this reading: 0 for the first hypotheses of both markers.
  double penalty = 0;

  /// log(Δ̂⁻¹ z) for `inverse` = Δ̂⁻¹: (translation [m], rotation [rad]); a position alone agrees
  /// with every rotation.
  Vector6d error(const Pose& inverse) const;
  /// The whitened residual of that error.
  Vector6d whitened(const Vector6d& error, const Pose& prediction) const;
  /// ∂(whitened residual)/∂(right perturbation of the prediction).
  Matrix6d residual_jacobian(const Vector6d& error, const Pose& prediction) const;
};

/// One instant at which both parts were seen. Planar markers may be read in two ways, so there are
/// up to four readings; the first is that of both primary hypotheses.
struct PairFrame {
  int sample = 0;
  int first_hypothesis = 0;
  int num_hypotheses = 0;
  /// Of make_part_data(): frames with the same number rest on the same tags. Counts from 0.
  int tag_set = 0;
};

struct PairData {
  int part_i = 0;
  int part_j = 0;
  std::vector<PairFrame> frames;
  std::vector<PairHypothesis> hypotheses;
  /// Of make_part_data(): ids of the tags, by PairFrame::tag_set; an empty set: not known.
  std::vector<std::vector<int>> tag_sets;

  int size() const { return static_cast<int>(frames.size()); }
  /// Of a frame; where part j has poses at some instants and positions at others those of the first
  /// are all that is used (see with_uniform_parts()).
  int num_residuals() const { return hypotheses.empty() ? 6 : hypotheses.front().num_residuals; }
  /// The reading of both primary hypotheses.
  const PairHypothesis& primary(int frame) const {
    return hypotheses[frames[frame].first_hypothesis];
  }
};

/// The parts that were seen, ascending.
std::vector<int> seen_parts(const std::vector<ActionPoseSample>& samples);

/// Number of instants at which both parts were seen.
int count_common(const std::vector<ActionPoseSample>& samples, int part_i, int part_j);

/// Parts that have positions alone at most instants, ascending.
std::vector<int> parts_without_rotation(const std::vector<ActionPoseSample>& samples);
/// Each part's observations of one kind: of the parts `alone` (parts_without_rotation(), ascending)
/// the positions without orientation, of all others the poses.
std::vector<ActionPoseSample> with_uniform_parts(std::vector<ActionPoseSample> samples,
                                                 const std::vector<int>& alone);

/// The pair's data, thinned evenly to at most `max_frames` instants.
PairData make_pair_data(const std::vector<ActionPoseSample>& samples, int part_i, int part_j,
                        const MeasurementModel& measurement, int max_frames);

/// The poses of one part in the camera's frame, as if the camera were part i and known exactly.
PairData make_part_data(const std::vector<ActionPoseSample>& samples, int part,
                        const MeasurementModel& measurement, int max_frames);

}  // namespace bodyschema
