#pragma once

#include "processes/model_monitor/changes/change_size.h"

namespace bodyschema {

/// A drift is a transform of a place that goes on: T(t) in a link of the edge, for the root behind
/// the camera's pose.

/// Prior of a rate, standard deviations a sample: in 15 samples, at which a fast one is told from a
/// step, it goes as far as a small transform (kSmallWidth: 0.03 m, 0.1 rad).
constexpr Noise kDriftRateSigma{0.03 / 15, 0.1 / 15};

/// The transform that has come about; `link`: as BodyChange::at.
BodyChange drift_step(const BodySchema& schema, int part, int link);

/// Of a drift by `rate` (log T a sample) of what follows `schema`'s edge to `part`.
ChangeSize size_of_rate(const BodySchema& schema, int part, int link, const Vector6d& rate,
                        const Matrix6d& covariance);

}  // namespace bodyschema
