#pragma once

#include <optional>
#include <set>
#include <vector>

#include "processes/structure_learner/tree_fit.h"

namespace bodyschema {

/// Rao's score test of one more joint, for every rigid cluster and every moving signal: how much
/// the residuals shrink, to second order, if Exp(ξ q_g) moves some of what is in or on the cluster
/// and all other parameters of the tree adapt. The parting that explains most is found by greedy
/// exchange; of a sliding (3 degrees of freedom) and a general joint (6), the less likely by
/// chance. A marker's own bias, which turns with the signals that turn it to the camera, is no
/// joint: `bias`, standard deviations at half range of a signal, adds to the noise of ξ however
/// many samples there are, and so does `unknown_bias`, in standard deviations of the noise of one
/// sight of what moves. The least likely by chance first.
std::vector<MissingJoint> missing_joints(const TreeFit& fit, const Noise& bias,
                                         double unknown_bias = 0);

/// The one that chance explains least, if it is significant (Bonferroni over all that was tried).
/// An idle signal, which moves nothing in a spanning forest, is probably somewhere: it has an error
/// rate of its own, spent on fewer hypotheses. The rates are those of few frames; they fall with
/// n^(−dof/2), as the odds do (Schwarz 1978), so that more samples end in fewer errors of both
/// kinds.
std::optional<MissingJoint> most_significant(const std::vector<MissingJoint>& joints,
                                             int num_frames, const std::set<int>& idle_signals);

/// How clearly one more joint would show: χ² that Exp(turn · q) puts into the residuals, about the
/// least visible axis through a node's origin, where that node and all beyond it move and every
/// other parameter of the tree adapts [per (rad per half range)²]. Nodes × moving signals; 0 at the
/// tree's root.
Eigen::MatrixXd missing_joint_information(const TreeFit& fit);

}  // namespace bodyschema
