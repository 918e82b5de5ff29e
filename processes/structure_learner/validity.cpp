#include "processes/structure_learner/validity.h"

#include <algorithm>
#include <boost/math/distributions/binomial.hpp>
#include <boost/math/distributions/chi_squared.hpp>
#include <boost/math/special_functions/beta.hpp>
#include <cmath>

namespace bodyschema {
namespace {

// Moments of χ²₆ cut at kOutlierThreshold.
constexpr double kInlierMean = 5.964;
constexpr double kInlierVariance = 11.309;

// Squared distance beyond which V2 trusts a frame no further.
constexpr double kClip = 20;
// Below this number of frames an excess of outliers may be bad luck.
constexpr int kFewFrames = 60;

// Sum of squares that regressors F_t (rows of F) explain of the whitened residuals, all six
// outputs.
double explained_sum(const Eigen::MatrixXd& F, const Eigen::Matrix<double, 6, Eigen::Dynamic>& r) {
  Eigen::MatrixXd gram = F.transpose() * F;
  gram.diagonal().array() += 1e-9 * std::max(gram.trace(), 1e-300);
  const Eigen::MatrixXd projected = r * F;
  return (projected * gram.ldlt().solve(projected.transpose())).trace();
}

}  // namespace

double chi_square_quantile(double dof, double tail) {
  return boost::math::quantile(
      boost::math::complement(boost::math::chi_squared_distribution<double>(dof), tail));
}

double pair_outlier_rate(const ValidityOptions& options) {
  return std::min(2 * options.outlier_rate + 0.01, 0.35);
}

int binomial_quantile(int trials, double rate, double p) {
  using namespace boost::math::policies;
  using RoundUp = policy<discrete_quantile<integer_round_up>>;
  return static_cast<int>(
      boost::math::quantile(boost::math::binomial_distribution<double, RoundUp>(trials, rate), p));
}

Validity check_validity(const Fit& fit, const LeaveOneOut& loo, const PairData& pair,
                        const NormalizedActions& actions, const ValidityOptions& options) {
  Validity result;
  const int n = pair.size();
  if (n < 2) {
    result.verdict = Verdict::kNotEnoughData;
    return result;
  }
  double inlier_sum = 0;
  for (int t = 0; t < n; ++t) {
    const double d2 = loo.squared_distance[t];
    const double log_det = pair.hypotheses[fit.frames[t].hypothesis].log_det;
    result.mean_capped += std::min(d2, 2 * kOutlierThreshold) / n;
    result.score -= 0.5 * (std::min(d2, 2 * kOutlierThreshold) + log_det) / n;
    if (d2 > kOutlierThreshold)
      ++result.num_outliers;
    else
      inlier_sum += d2;
  }
  const int inliers = n - result.num_outliers;
  const int p = loo.rank;
  // Of a stream a block of time counts as one frame. `share`: independent frames per frame.
  const int num_independent =
      actions.blocks().count(pair.frames, [](const PairFrame& f) { return f.sample; });
  const double share = static_cast<double>(num_independent) / n;
  if (inliers > 0) result.mean_inlier = inlier_sum / inliers;

  // V1
  const double rate = pair_outlier_rate(options);
  const int max_outliers = std::min(
      static_cast<int>(
          binomial_quantile(num_independent, rate, options.lenient ? 0.99999 : 0.9997) / share),
      static_cast<int>(0.35 * n));
  // With few frames a true model may meet more outliers than the bound by bad luck: then it is not
  // refuted, only not to be trusted yet.
  const bool suspicious = result.num_outliers > max_outliers;
  result.doubtful = num_independent < kFewFrames &&
                    result.num_outliers > binomial_quantile(num_independent, rate, 0.8) / share;
  const double independent_inliers = share * inliers;
  const double dof = 6 * independent_inliers - p;
  if (dof < 6) {
    // So few frames fit that nothing is left over to test with.
    result.verdict = suspicious ? Verdict::kRefuted : Verdict::kNotEnoughData;
    return result;
  }
  if (suspicious && (n >= kFewFrames || 2 * result.num_outliers > n)) return result;
  const double sampling =
      (options.lenient ? 5 : 3) *
      std::sqrt(kInlierVariance / independent_inliers * (6.0 * independent_inliers / dof));
  // A fifth of slack: the noise is known to some ten per cent at best.
  const double max_mean = std::min(1.2 * kInlierMean + sampling, 0.75 * kOutlierThreshold);
  if (result.mean_inlier > max_mean) return result;

  // V2
  const int k = fit.model.num_joints;
  const int others = static_cast<int>(actions.moving().size()) - k;
  Eigen::Matrix<double, 6, Eigen::Dynamic> r(6, n);
  double bias = 0;
  for (int t = 0; t < n; ++t) {
    bias += pair.hypotheses[fit.frames[t].hypothesis].systematic;
    const double d2 = fit.frames[t].squared_distance;
    // Clipped, and fading where it is far beyond what a missed joint does to a frame or two: flips
    // must not find a signal that happens to go along with them.
    r.col(t) = fit.frames[t].residual *
               (std::sqrt(std::min(1.0, kClip / d2)) * std::min(1.0, 20 * kClip / d2));
  }
  const bool tensor = k == 1 && n >= 12;
  const int num_features = tensor ? 3 : 1;
  Eigen::MatrixXd F(n, num_features);
  const double threshold =
      chi_square_quantile(6 * num_features,
                          (options.lenient ? 1e-6 : 1.35e-3) / std::max(others, 1)) *
          std::max(1.0, result.mean_inlier / 6) / share +
      // What is far below the noise of every single frame is no joint but a bias; and all of the
      // model error may go along with one signal: its variance is ⅓ that of the ends of its range.
      0.05 * n + bias / 3;
  for (const int g : actions.moving()) {
    if (fit.model.uses(g)) continue;
    double mean = 0;
    for (int t = 0; t < n; ++t) mean += actions(pair.frames[t].sample, g) / n;
    for (int t = 0; t < n; ++t) {
      const int sample = pair.frames[t].sample;
      F(t, 0) = actions(sample, g) - mean;
      if (tensor) {
        const double q = actions(sample, fit.model.signal[0]);
        const double theta = std::max(std::abs(fit.model.turn[0]), 0.1) * q;
        F(t, 1) = F(t, 0) * std::cos(theta);
        F(t, 2) = F(t, 0) * std::sin(theta);
      }
    }
    if (!(F.col(0).squaredNorm() > 0)) continue;
    result.explained = std::max(result.explained, explained_sum(F, r) / threshold);
  }
  if (result.explained > 1) return result;

  // Improbable by chance? Spread of the readings about their own robust centre, per axis, against
  // their noise: log λ averaged over the six axes.
  std::vector<double> spread;
  const Pose centre = pair.hypotheses[fit.frames[n / 2].hypothesis].z;
  for (int t = 0; t < n; ++t) {
    const PairHypothesis& h = pair.hypotheses[fit.frames[t].hypothesis];
    spread.push_back((h.whitening * log(centre.inverse() * h.z)).squaredNorm() / 6);
  }
  std::nth_element(spread.begin(), spread.begin() + n / 2, spread.end());
  const double log_lambda = 0.5 * std::log(std::max(spread[n / 2] / 2, 1.0));
  const double num_candidates = 1.0 + std::pow(std::max(others + k, 1), k);
  result.verdict = Verdict::kValid;
  if (suspicious) result.verdict = Verdict::kNotEnoughData;
  // Few readings of a joint that happened to move little look rigid, the more so with some set
  // aside.
  if (k == 0 && independent_inliers < 4 + share * result.num_outliers)
    result.verdict = Verdict::kNotEnoughData;
  const bool improbable_by_chance = dof * log_lambda > std::log(num_candidates) + 7;
  if (k > 0 && dof < 2 * p && !improbable_by_chance) result.verdict = Verdict::kNotEnoughData;
  return result;
}

}  // namespace bodyschema
