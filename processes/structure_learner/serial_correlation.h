#pragma once

#include <vector>

#include "processes/structure_learner/local_model.h"

namespace bodyschema {

/// Noise that lasts from one sample to the next, as an autoregression of first order.
class SerialCorrelation {
 public:
  /// Residuals of one marker or pair, whitened, at two successive samples.
  void add(const FrameFit& before, const FrameFit& now);
  void add(const SerialCorrelation& other);
  /// Correlation of one sample's noise with the next, in that axis where it is largest (a pose from
  /// several tags in turn keeps it in some only); unbiased to first order where each series of
  /// residuals has so many samples. 0 unless significant and positive.
  double coefficient(int num_samples) const;

 private:
  Vector6d products_ = Vector6d::Zero(), squares_ = Vector6d::Zero();
  int count_ = 0;
};

/// Variance of Σ x_t e_t over what it is in white noise, at least 1: noise that lasts agrees by
/// chance with what happens to last as well. Never less than what it does for random x in one of
/// forty cases: what a joint on x moves depends on other signals, too.
double variance_inflation(const std::vector<double>& x, const std::vector<int>& samples,
                          double coefficient);

/// How many successive samples tell as much as one whose noise is new, at least 1: 1 + 2 Σ ρ_lag of
/// their scores Jᵀ W r (columns) at the optimum, in the metric of the parameters' covariance, while
/// the sum over pairs of lags is positive (Geyer 1992, initial positive sequence). What the model
/// does not say lasts as well, and counts.
double correlation_time(const Eigen::MatrixXd& scores, const Eigen::MatrixXd& covariance);

}  // namespace bodyschema
