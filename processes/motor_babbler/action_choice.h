#pragma once

#include <Eigen/Core>
#include <cstddef>
#include <vector>

#include "common/schema/body_schema.h"
#include "common/schema/visibility.h"

namespace bodyschema {

/// Index of the candidate with the largest expected information; the first of equals.
///
/// The expected information of an action is a sum over the edges, each times the probability that
/// both of its parts are seen, of the growth of log det of the information [nats ×2] (D-optimality,
/// first order) on
///   - the parameters of the edge: log det(I + Σ⁻¹ J C Jᵀ), with C their covariance after the past
///     actions, those after the schema's last sample included, and Σ the noise of a relative pose;
///   - the residual of the edge: six coefficients of each of (1, x_s, x_s²) of every signal s, that
///     is 6 log(1 + φᵀ(Λ + Σ_past φφᵀ)⁻¹φ). These reveal a false model, so a design that is best
///     for the edges as they are must not leave them unobserved (potential
///     terms: DuMouchel and Jones, A simple Bayesian modification of D-optimal designs, 1994).
/// A part without an edge counts with the second alone: actions explore where it may be seen and
/// was not tried yet.
///
/// A pure function. `past` in order of sample_index; there must be a candidate, and actions have
/// one value per signal of the schema.
/// @throws std::invalid_argument otherwise.
std::size_t choose_action(const BodySchema& schema, const std::vector<SeenAction>& past,
                          const std::vector<Eigen::VectorXd>& candidates);

}  // namespace bodyschema
