#pragma once

#include <cstdint>
#include <functional>
#include <optional>
#include <vector>

#include "common/geometry/pose.h"

namespace bodyschema {

/// What one camera view says about one body part B, in the camera's frame C.
struct PartObservation {
  int part = 0;
  Pose X_CB = Pose::Identity();
  /// False: a position alone. X_CB then has no rotation, its covariance no rotation rows: they are
  /// zero, so that the covariance is that of the position in the camera's axes.
  bool has_rotation = true;
  /// 6×6 covariance of X_CB, tangent order (translation [m], rotation [rad]), right perturbation in
  /// the part's frame: X_CB = X_CB_true · exp(ε), ε ~ N(0, covariance).
  Matrix6d covariance = Matrix6d::Zero();
  /// The second pose hypothesis of a planar marker, if there is one.
  std::optional<Pose> X_CB_other;
  /// Reprojection error of the other hypothesis over that of X_CB; ≥ 1. 0 when there is no other.
  double error_ratio = 0;
  /// Ids of the tags that the pose rests on, ascending; empty where that is not known.
  std::vector<int> tags;
};

/// What `covariance` of X_CB, from the observation or assumed, is for X_CB_other. The position's is
/// a fact of the camera (depth is not lateral): it is carried over into the other frame. Tilt and
/// in-plane rotation belong to the marker's axes in both readings. Requires X_CB_other.
Matrix6d covariance_of_other(const PartObservation& observation, const Matrix6d& covariance);

enum class Purpose : std::int8_t { kTrain = 0, kTest = 1, kProbe = 2, kControl = 3 };

/// One action and what was seen after the arm had come to rest.
struct ActionPoseSample {
  std::int64_t utime = 0;
  /// Counts the instants of a recording from 0.
  std::int64_t sample_index = 0;
  /// Of the tags and the lens (common/config/calibration_id.h); 0: not told.
  std::int64_t calibration_id = 0;
  Purpose purpose = Purpose::kTrain;
  /// Action signals q_1..q_m in command units.
  Eigen::VectorXd action;
  /// Seen parts only, by the tags that agree; ascending part id, each at most once.
  std::vector<PartObservation> parts;
  /// By a single tag each that disagrees with the part's others. Where no two agree the part is
  /// only here. Ascending part id, then tag.
  std::vector<PartObservation> contradictions;

  const PartObservation* find(int part) const;
  /// As if such tags had not been seen: of those of a part that contradict each other the only one
  /// that is left is believed.
  const PartObservation* find_without(const std::function<bool(int tag)>& is_such, int part) const;
  void leave_out(const std::function<bool(int tag)>& is_such);
};

/// Of the action and the parts' poses. Noise never repeats itself: samples of the same numbers are
/// one, told twice.
std::vector<double> numbers_of(const ActionPoseSample& sample);

/// TEST samples judge, those of the controller follow its model.
inline bool is_learned_from(const ActionPoseSample& sample) {
  return sample.purpose == Purpose::kTrain || sample.purpose == Purpose::kProbe;
}

}  // namespace bodyschema
