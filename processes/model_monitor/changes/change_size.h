#pragma once

#include <cstdint>
#include <functional>
#include <vector>

#include "processes/model_monitor/changes/body_change.h"

namespace bodyschema {

/// How large a change is, in numbers that mean something to who stands beside the robot. Those of
/// poses are where the frame that follows the change went with all signals in mid-range: its
/// distance [m] and angle [rad].
struct ChangeSize {
  enum class Kind : std::int8_t {
    kUnknown,
    kCommand,  ///< [command units] kStuck: the command that it stands at; kOffset: the difference
    kFactor,   ///< kGain: how many times as far the joint goes
    kPose,     ///< distance, angle
    kRate      ///< the same per sample
  };
  Kind kind = Kind::kUnknown;
  int signal = -1;              ///< index of the signal concerned; −1: of none
  std::vector<double> amounts;  ///< 0, 1 or 2 by kind
  std::vector<double> sds;      ///< their standard deviations, first order; −1: not known
};

/// Of a change of `schema` with the parameters θ; `covariance` of θ may be empty.
ChangeSize size_of(const BodySchema& schema, const BodyChange& change, const Eigen::VectorXd& theta,
                   const Eigen::MatrixXd& covariance);

/// What became of a place, where no fit says it: by the two local models alone.
struct FoundDifference {
  std::string cause;  ///< as BodyChange::cause()
  ChangeSize size;    ///< without standard deviations
};
FoundDifference difference_at(const BodySchema& before, const BodySchema& now,
                              const ElementId& element);

/// The size whose amounts are a function of θ, with their standard deviations.
ChangeSize sized(ChangeSize::Kind kind, int signal,
                 const std::function<std::vector<double>(const Eigen::VectorXd&)>& amounts,
                 const Eigen::VectorXd& theta, const Eigen::MatrixXd& covariance);
/// The pose that a change of the edge to `part` moves: the part in its parent; of the root, which
/// hangs on nothing, the camera in the root.
Pose pose_at(const BodySchema& schema, int part);
std::vector<double> distance_and_angle(const Pose& T);

}  // namespace bodyschema
