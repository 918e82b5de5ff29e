#pragma once

#include <vector>

#include "processes/structure_learner/structure_search.h"

namespace bodyschema {

/// Finds the signals whose commands are not linear in the displacement of their joints and sets
/// their Signal::warp: a Gaussian process a signal, shared by all models on it. Returns true if any
/// warp changed.
///
/// Each local model tells θ without knowing the command: a screw is fitted with slack along its own
/// motion (Σ_z + J σ² Jᵀ, J = ∂Δ/∂θ), and what is left along J, with the precision JᵀΣ_z⁻¹J, is a
/// measurement of θ. What of it depends on q beyond a line (gain and offset of the model, free for
/// each) is regressed on the warp's basis; amplitude and length of the process are those of
/// largest marginal likelihood. A reading weighs as its pose does in a fit (student_t.h), by what
/// is off across the motion and along it. Both steps are repeated until the warp stands still. A
/// signal is bent if that beats the straight line by kWarpEvidence and was read at 15 positions or
/// more. Beyond the positions seen the process returns to the line.
///
/// The models are those of `found`; where these leave parts unconnected, or where one of them
/// already speaks for a bent command, the best single joint of every pair as well: a linear command
/// may have kept it out. No two models on a signal share a part, so that their noise is
/// independent.
///
/// `signals`: as known so far; `samples` have the commands, not the displacements.
bool estimate_warps(const std::vector<ActionPoseSample>& samples, const std::vector<int>& parts,
                    const SearchResult& found, const SearchOptions& options,
                    std::vector<Signal>* signals);

/// The samples with θ(q) in place of q.
std::vector<ActionPoseSample> displaced(std::vector<ActionPoseSample> samples,
                                        const std::vector<Signal>& signals);

}  // namespace bodyschema
