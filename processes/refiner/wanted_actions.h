#pragma once

#include <optional>
#include <vector>

#include "processes/refiner/information.h"
#include "processes/refiner/refine.h"
#include "processes/refiner/refinement_problem.h"

namespace bodyschema {

/// The kMostWantedActions actions that lower the predicted variances most, that of most help first,
/// each on top of those before it.
///
/// The criterion is the mean variance of the predicted poses of all parts in the root over the
/// signals' ranges, tr(M A⁻¹), M = mean of Gᵀ W G, G a pose's derivative by the parameters, W a
/// radian as 0.2 m: V- or I-optimality (Atkinson, Donev and Tobias, Optimum Experimental Designs,
/// with SAS, 2007, section 10.6; a linear criterion tr(Kᵀ A⁻¹ K) in Pukelsheim, Optimal Design of
/// Experiments, 1993). D-optimality, also restricted to what predicts, would count halving a
/// deviation of a micrometre as much as halving the worst one, and depends on which parameters are
/// counted as predicting. tr(M A⁻¹) depends neither on these nor on the gauge.
///
/// A is the information's curvature; where an action would be expected to show tags or parts
/// (ExpectedSights), each adds its JᵀJ times its probability, with what belongs to the instant (a
/// root's pose, plays) eliminated. Tags are learned with the rest. Edges begin with a prior of 1 m
/// and 1 rad, a joint's over half of its signal's range, so that what nothing tells has a finite
/// variance. An action has about as many rows as there are parameters beside the tags': these are
/// eliminated, and what is left is factored anew for each candidate, which costs no more than an
/// update of low rank. As for correlations, it is taken as known where one tag of each part sits.
///
/// Candidates are 200 points frac(n √p_s) of Richtmyer's sequence, p_s the primes, alike in every
/// run (unlike Halton's they stay spread where there are dozens of signals), over the ranges,
/// denser towards their ends (arcsine distribution), where optimal designs have most of their
/// points. Signals that move no joint that is refined (stuck, or of Gaussian processes alone), and
/// those without a range, stay as they were at the last sample. Where no signal is left there is no
/// action. What a driver refuses is not known here.
std::vector<WantedAction> wanted_actions(const BodySchema& refined,
                                         const std::optional<RigCalibration>& rig,
                                         const std::vector<RefinerSample>& samples,
                                         RefinementProblem& problem,
                                         const Information& information);

}  // namespace bodyschema
