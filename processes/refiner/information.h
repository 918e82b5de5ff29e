#pragma once

#include <Eigen/Core>
#include <map>
#include <string>
#include <vector>

#include "processes/refiner/refinement_problem.h"

namespace bodyschema {

/// What the samples tell of the parameters at the refined values: the covariance of an M-estimator
/// (Huber), with what each instant has of its own (a moving root's pose, the joints' plays)
/// eliminated (Schur complement: of A, and of B with the gain that A's has).
///
///   Cov = A⁻¹ B A⁻¹ + K C Kᵀ,  A = α H + P,  B = β H + P + Σ G Gᵀ,  H = Σ w JᵀJ,
///
/// w the Student-t weights, P the priors' information (the plays' too), α and β the means of the
/// second derivative and of the squared score per weight over all residuals, G what an error does
/// that several poses share (shared_errors.h); where residuals of successive samples are correlated
/// by ρ, the β H of B is (1 + ρ) / (1 − ρ) times as large. K C Kᵀ is what the held parameters'
/// priors C (tags, lens) make of the refined ones.
class Information {
 public:
  /// `measurement`: of poses. `num_not_fitted`: free directions that the fit did not move.
  Information(RefinementProblem& problem, const MeasurementModel& measurement,
              int num_not_fitted = 0);

  /// Blocks of `covariance`: refined ones, those of instants left out.
  const std::vector<ParameterBlock*>& blocks() const { return blocks_; }
  /// First row of a block; −1 if it is not among them.
  int offset(const ParameterBlock* block) const;
  /// Of the free directions of all blocks. Directions that nothing tells have a finite, huge
  /// variance, so that it can be stored.
  const Eigen::MatrixXd& covariance() const { return covariance_; }
  /// Orthonormal columns in parameters scaled to unit information: directions that nothing tells.
  const Eigen::MatrixXd& undetermined() const { return undetermined_; }
  /// A, over the free directions of all blocks.
  const Eigen::MatrixXd& curvature() const { return curvature_; }
  /// The part of B that further samples do not reduce, of errors that poses share and of what is
  /// held: it is in Cov as A⁻¹ X A⁻¹.
  const Eigen::MatrixXd& lasting_score() const { return lasting_score_; }
  /// A further observation is expected to add as many times JᵀJ to A.
  double worth() const { return worth_; }
  /// Part of a block's covariance in its whole tangent: zero along held directions.
  Eigen::MatrixXd cross_covariance(const ParameterBlock* one, const ParameterBlock* other) const;

 private:
  struct Sums;
  struct Weights;
  static Sums weighted(RefinementProblem& problem, const Weights& weights,
                       const MeasurementModel& measurement);
  void invert(const RefinementProblem& problem, const Sums& sums, const Weights& weights);

  std::vector<ParameterBlock*> blocks_;
  std::map<const ParameterBlock*, int> offsets_;
  Eigen::MatrixXd covariance_, undetermined_, curvature_, lasting_score_;
  double worth_ = 1;
};

}  // namespace bodyschema
