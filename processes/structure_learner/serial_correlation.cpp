#include "processes/structure_learner/serial_correlation.h"

#include <algorithm>
#include <cmath>
#include <numeric>

namespace bodyschema {

void SerialCorrelation::add(const FrameFit& before, const FrameFit& now) {
  // With the influence that they have on a robust fit.
  const Vector6d x = before.weight() * before.residual;
  const Vector6d y = now.weight() * now.residual;
  products_ += x.cwiseProduct(y);
  squares_ += 0.5 * (x.cwiseAbs2() + y.cwiseAbs2());
  ++count_;
}

void SerialCorrelation::add(const SerialCorrelation& other) {
  products_ += other.products_;
  squares_ += other.squares_;
  count_ += other.count_;
}

double SerialCorrelation::coefficient(int num_samples) const {
  constexpr int kFewest = 20;
  constexpr double kLargest = 0.98, kNothing = 1e-6;
  if (count_ < kFewest || !(squares_.head<3>().minCoeff() > 0)) return 0;
  // An axis in which nothing is left, as of a frame that was told, says nothing.
  const double nothing = kNothing * count_;
  const double seen = products_.cwiseQuotient(squares_.cwiseMax(nothing)).maxCoeff();
  if (seen < 2.5 / std::sqrt(count_)) return 0;
  // Kendall 1954: a series about its own mean.
  return std::min(seen + (1 + 4 * seen) / num_samples, kLargest);
}

double variance_inflation(const std::vector<double>& x, const std::vector<int>& samples,
                          double coefficient) {
  if (coefficient == 0 || x.empty()) return 1;
  const auto n = static_cast<double>(x.size());
  const double mean = std::accumulate(x.begin(), x.end(), 0.0) / n;
  double squares = 0, products = 0;
  double past = 0;  // Σ ρ^(t − u) x_u over the samples u before t
  for (std::size_t t = 0; t < x.size(); ++t) {
    if (t > 0) past = std::pow(coefficient, samples[t] - samples[t - 1]) * (past + x[t - 1] - mean);
    squares += (x[t] - mean) * (x[t] - mean);
    products += (x[t] - mean) * past;
  }
  // Of random x the excess has the standard deviation 2 √(Σ_k ρ^2k / n).
  const double r2 = coefficient * coefficient;
  const double large = 2 * 2 * std::sqrt(r2 / (1 - r2) / n);
  return 1 + std::max(squares > 0 ? 2 * products / squares : 0, large);
}

double correlation_time(const Eigen::MatrixXd& scores, const Eigen::MatrixXd& covariance) {
  const Eigen::Index n = scores.cols();
  if (n == 0) return 1;
  const Eigen::MatrixXd weighted = covariance * scores;
  const auto product_at = [&](Eigen::Index lag) {
    return scores.leftCols(n - lag).cwiseProduct(weighted.rightCols(n - lag)).sum();
  };
  const double squares = product_at(0);
  double sum = -squares;
  for (Eigen::Index lag = 0; lag + 1 < n / 2; lag += 2) {
    const double pair = product_at(lag) + product_at(lag + 1);
    if (!(pair > 0)) break;
    sum += 2 * pair;
  }
  return squares > 0 ? std::max(sum / squares, 1.0) : 1;
}

}  // namespace bodyschema
