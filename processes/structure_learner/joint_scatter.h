#pragma once

#include "processes/structure_learner/local_model.h"

namespace bodyschema {

/// Standard deviations of what the displacements of the joints are off by from one frame to the
/// next [half ranges]: backlash, steps of the motors, droop. Maximum likelihood of the
/// leave-one-out residuals, whitened, r ~ N(0, I + U S Uᵀ), the distance of outliers bounded, with
/// U the whitened twists of the joints and S diagonal; a joint has a scatter if it gains half the
/// log of the number of independent frames (BIC). Zeros of a pair of positions alone.
///
/// `told` has the frames of `pair` with the noise as it is told: a structure that was found with
/// more noise may have been so because its joints scatter. Where a factor on the told noise
/// explains more than scatter does, scatter is what that factor leaves.
Eigen::VectorXd joint_scatter(const Fit& fit, const LeaveOneOut& loo, const PairData& pair,
                              const PairData& told, const NormalizedActions& actions);

}  // namespace bodyschema
