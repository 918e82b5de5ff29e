#pragma once

namespace bodyschema {

/// Quantile of χ² with `dof` degrees of freedom at 1 − `tail`.
double chi_square_quantile(double dof, double tail);
inline double chi_square_median(double dof) { return chi_square_quantile(dof, 0.5); }

/// log P(X > x). Finite however far out.
double log_chi_square_tail(double x, double dof);

/// Mean and variance of χ² given that it is at most `limit`.
struct ChiSquareMoments {
  double mean = 0;
  double variance = 0;
};
ChiSquareMoments chi_square_below(double limit, double dof);

/// Smallest n with P(X ≤ n) ≥ p for X ~ Binomial(trials, rate).
int binomial_quantile(int trials, double rate, double p);

/// Squared Mahalanobis distance of a pose beyond which it is an outlier: what 0.27 % of true
/// residuals exceed, as three standard deviations do in one dimension.
inline const double kOutlierThreshold = chi_square_quantile(6, 0.0027);
/// The same of so many residuals: 6 of a pose, 3 of a position alone.
inline double outlier_threshold(int num_residuals) {
  static const double of_position = chi_square_quantile(3, 0.0027);
  return num_residuals == 3 ? of_position : kOutlierThreshold;
}

/// The χ²₆ that is exceeded as rarely as this χ² with `dof` degrees of freedom: positions alone are
/// judged by the thresholds of poses. Closed form of Wilson and Hilferty (1931), within 2 %.
double as_of_six(double chi_square, int dof);

}  // namespace bodyschema
