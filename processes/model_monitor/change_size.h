#pragma once

#include <cstdint>
#include <vector>

#include "processes/model_monitor/body_change.h"

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

/// Of a drift by `rate` (log T a sample) of what follows `schema`'s edge to `part`; `left`: T
/// stands before the edge's model.
ChangeSize size_of_rate(const BodySchema& schema, int part, bool left, const Vector6d& rate,
                        const Matrix6d& covariance);

/// What became of a place, where no fit says it: by the two local models alone.
struct FoundDifference {
  std::string cause;  ///< as BodyChange::cause()
  ChangeSize size;    ///< without standard deviations
};
FoundDifference difference_at(const BodySchema& before, const BodySchema& now, const Place& place);

}  // namespace bodyschema
