#pragma once

#include <vector>

#include "processes/structure_learner/local_model.h"
#include "processes/structure_learner/tree_fit.h"

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

/// The same of all joints of a tree whose root rests, in the order of its nodes: every part beyond
/// a joint is a witness of what it is off by, where a pair has two noisy ones. Readings that are
/// outliers even so are left out; `start` says what is scatter at first. `told` as TreeFit's data.
Eigen::VectorXd joint_scatter(const TreeFit& fit, const std::vector<PairData>& told,
                              const Eigen::VectorXd& start);

}  // namespace bodyschema
