#pragma once

#include <vector>

#include "processes/model_monitor/changes/change_family.h"

namespace bodyschema {

/// A model of an edge that has a Gaussian process in it.
struct LearnedEdge {
  BodyChange change;  ///< kNonlinear, kResidual or kFresh, with its signals
  Edge edge;
  /// The same predictions without the process's uncertainty: at the peak of the posterior.
  Edge certain;
  /// log of prior odds, of the density of the function at that peak and of the peak's width
  /// (Laplace; exact here): with Σ log p(observations | certain) it is the evidence [nats].
  double log_prior = 0;
  double log_evidence = 0;  ///< by the measurements alone
};

/// Measurements that learn_edge() takes: its time grows as their cube.
inline constexpr std::size_t kMostMeasurements = 64;

/// What an edge may be if no form with parameters explains it, by its measurements alone:
///   kNonlinear: a joint goes farther by g(Q),
///   kResidual:  Δ(θ) · Exp(ρ(Q)) with the model Δ that stood (refined prior),
///   kFresh:     X · Exp(ρ(Q)) with a constant X;
/// g and ρ are Gaussian processes of one or two signals. g too becomes a residual GP: of a screw at
/// the end of the chain, Exp(ŝ(θ + g)) X_after = Exp(ŝθ) X_after · Exp(Ad(X_after⁻¹) ŝ g).
///
/// All signal sets are screened by one factorisation each; prior odds favour few signals and those
/// nearest to the edge's own (structural_proximity()). The likeliest are fitted: length scales and
/// variances by marginal likelihood on a small grid, whose number of cells is paid for, without
/// measurements that the others make less likely (leave-one-out) than an outlier. A model must
/// halve, by leave-one-out, what the old one is off by (Student-t).
///
/// The best of every kind, most evidence first; none if there are fewer measurements than
/// BodyChange::fewest_samples(), or more than kMostMeasurements. An edge that has a process already
/// is only learned afresh.
std::vector<LearnedEdge> learn_edge(const BodySchema& base, int part,
                                    const std::vector<PlaceMeasurement>& measurements,
                                    double outlier_rate);

/// The ratio of shared to all nodes of the Bayesian networks of two local models of one pair of
/// parts: (2 + |Q₁ ∩ Q₂|) / (2 + |Q₁ ∪ Q₂|).
double structural_proximity(const std::vector<int>& signals, const std::vector<int>& other);

}  // namespace bodyschema
