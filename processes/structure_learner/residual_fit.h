#pragma once

#include <memory>
#include <optional>
#include <vector>

#include "common/schema/residual_gp.h"
#include "processes/structure_learner/validity.h"

namespace bodyschema {

/// Independent frames below which a function of the signals is not fitted.
inline constexpr int kFewestSoftFrames = 30;

/// A chain of screws and what it leaves, as a Gaussian process of the signals in Q.
struct SoftModel {
  LocalModel screws;  ///< none, one or two joints: whatever explains most
  std::shared_ptr<const ResidualGp> residual_gp;
  std::vector<int> signals;  ///< Q: of the screws and of the process
};

/// A soft model's judgement on every frame of a pair, without that frame's block of time.
struct SoftFit {
  SoftModel model;
  /// Of model.signals: the left-out blocks miss them, but not by so much that it is sure.
  std::vector<int> doubtful_signals;
  std::vector<FrameFit> frames;  ///< reading and whitened residual log(Δ̂₋B⁻¹ z)
  /// d² = rᵀ(I + S)⁻¹r with S the whitened covariance of the prediction: χ²₆ under a true model.
  std::vector<double> squared_distance;
  std::vector<Vector6d> residual;  ///< not whitened: (translation [m], rotation [rad])
  Verdict verdict = Verdict::kRefuted;
  double mean_inlier = 0;       ///< of d²
  double mean_uncertainty = 0;  ///< trace S over the inliers: 6 is as large as the noise
  int num_outliers = 0;
  double score = 0;  ///< mean over the inliers of the log density of z, up to a constant [nats]
  /// What the data say of two models of one pair [nats]: the sum over the independent frames of
  /// −½[min(d², 2c) + log|fI + S|] with d² = rᵀ(fI + S)⁻¹r, f the factor on the assumed variance
  /// that the marginal likelihood chose, c kOutlierThreshold.
  double log_density = 0;
};

/// SoftFit::log_density of a chain of screws, by the blocks that are left out, with the best f; its
/// own uncertainty counts in d² alone. Both favour screws.
double log_density_of_screws(const Fit& fit, const PairData& pair,
                             const NormalizedActions& actions);

/// Fits the model to a pair: Log(f_screw(q)⁻¹ z) by processes with shared length scales of largest
/// marginal likelihood, Student-t weights throughout, at most ResidualGp::kMaxSamples instants that
/// cover the actions evenly (farthest-point sampling), fewer where these predict better. Signals
/// without which the blocks that were left out are predicted no worse are dropped, unless `signals`
/// says which to keep. std::nullopt: too few data.
///
/// Valid: as few outliers and as small a mean d² as V1 asks of screws, and the model must know what
/// it says: where its own uncertainty in the left-out blocks exceeds that of a measurement, a wide
/// process would agree with anything (kNotEnoughData).
std::optional<SoftFit> fit_soft_model(const LocalModel& screws, const PairData& pair,
                                      const NormalizedActions& actions,
                                      const ValidityOptions& options,
                                      const std::vector<int>& signals = {});

}  // namespace bodyschema
