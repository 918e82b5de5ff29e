#include "processes/structure_learner/validity.h"

#include <algorithm>
#include <cmath>

#include "common/estimation/quantile.h"
#include "processes/structure_learner/serial_correlation.h"
#include "processes/structure_learner/wrong_commands.h"

namespace bodyschema {
namespace {

// Squared distance beyond which V2 trusts a frame no further.
constexpr double kClip = 20;
// Below this number of frames an excess of outliers may be bad luck.
constexpr int kFewFrames = 60;
// Outliers beyond this multiple of outlier_threshold() are wild readings: 16 standard deviations.
// Flips are by twice the tilt of a tag, of which one in twenty is nearer.
constexpr double kFar = 10;
// How much noise that lasts explains is known to such a factor at best (chosen).
constexpr double kLargestLasting = 2;
// Fewer independent frames do not tell wild readings from a wrong model.
constexpr int kFewestFarFrames = 20;
// Share of the frames. At 20 % of wild readings a marker 64 % of a pair's frames are without one;
// of 60 frames fewer than 24 are once in 10 000 pairs.
constexpr double kFewestInliers = 0.4;
// Of as many outliers in a row by chance.
constexpr double kLeastChanceOfRun = 1e-3;

// Sum of squares that regressors F_t (rows of F) explain of the whitened residuals, all six
// outputs.
double explained_sum(const Eigen::MatrixXd& F, const Eigen::Matrix<double, 6, Eigen::Dynamic>& r) {
  Eigen::MatrixXd gram = F.transpose() * F;
  gram.diagonal().array() += 1e-9 * std::max(gram.trace(), 1e-300);
  const Eigen::MatrixXd projected = r * F;
  return (projected * gram.ldlt().solve(projected.transpose())).trace();
}

// Columns of mean 0 and norm 1, but those that do not vary.
void standardise(Eigen::MatrixXd* F) {
  F->rowwise() -= F->colwise().mean().eval();
  for (auto column : F->colwise())
    if (const double norm = column.norm(); norm > 0) column /= norm;
}

// Outliers, mean distances and score.
void tally(const Fit& fit, const LeaveOneOut& loo, const PairData& pair, Validity* result) {
  const int n = pair.size();
  double inlier_sum = 0;
  const double outlying = outlier_threshold(pair.num_residuals());
  int run = 0;
  for (int t = 0; t < n; ++t) {
    const double d2 = loo.squared_distance[t];
    const double log_det = pair.hypotheses[fit.frames[t].hypothesis].log_det;
    result->mean_capped += std::min(d2, 2 * outlying) / n;
    result->score -= 0.5 * (std::min(d2, 2 * outlying) + log_det) / n;
    if (d2 > outlying) {
      ++result->num_outliers;
      result->num_near += d2 < kFar * outlying;
      result->longest_run = std::max(result->longest_run, ++run);
    } else {
      run = 0;
      inlier_sum += d2;
    }
  }
  if (n > result->num_outliers) result->mean_inlier = inlier_sum / (n - result->num_outliers);
}

// Whitened residuals, 6×n, clipped, and fading where they are far beyond what a missed joint does
// to a frame or two: flips must not find a signal that happens to go along with them.
Eigen::Matrix<double, 6, Eigen::Dynamic> clipped_residuals(const Fit& fit) {
  const auto n = static_cast<Eigen::Index>(fit.frames.size());
  Eigen::Matrix<double, 6, Eigen::Dynamic> r(6, n);
  for (Eigen::Index t = 0; t < n; ++t) {
    const FrameFit& frame = fit.frames[static_cast<std::size_t>(t)];
    const double d2 = frame.squared_distance;
    r.col(t) =
        frame.residual * (std::sqrt(std::min(1.0, kClip / d2)) * std::min(1.0, 20 * kClip / d2));
  }
  return r;
}

// Of the noise, from one sample to the next; 0 in a stream, whose blocks have it already.
double serial_correlation(const Fit& fit, const PairData& pair, const NormalizedActions& actions) {
  if (actions.blocks().is_stream()) return 0;
  SerialCorrelation series;
  for (int t = 1; t < pair.size(); ++t)
    if (pair.frames[t].sample == pair.frames[t - 1].sample + 1)
      series.add(fit.frames[t - 1], fit.frames[t]);
  return series.coefficient(pair.size());
}

// The largest share of the residuals that a signal outside Q explains, over the threshold of V2.
double explained_excess(const Fit& fit, const PairData& pair, const NormalizedActions& actions,
                        const ValidityOptions& options, double mean_inlier, double share,
                        double correlation) {
  const int n = pair.size(), k = fit.model.num_joints();
  const int others = static_cast<int>(actions.moving().size()) - k;
  const Eigen::Matrix<double, 6, Eigen::Dynamic> r = clipped_residuals(fit);
  double bias = 0;
  for (const FrameFit& frame : fit.frames) bias += pair.hypotheses[frame.hypothesis].systematic;
  std::vector<int> samples;
  for (const PairFrame& frame : pair.frames) samples.push_back(frame.sample);
  std::vector<double> q_g(n);
  const int num_residuals = pair.num_residuals();
  const bool of_positions = num_residuals == 3;
  const bool tensor = !of_positions && k == 1 && n >= 12;
  const int num_features = of_positions ? 5 : tensor ? 3 : 1;
  Eigen::MatrixXd F(n, num_features);
  const double noise =
      chi_square_quantile(num_residuals * num_features,
                          (options.lenient ? 1e-6 : 1.35e-3) / std::max(others, 1)) *
      std::max(1.0, mean_inlier / num_residuals) / share;
  // A motion far below the noise of every single frame is no joint but a bias; and all of the
  // model error may go along with one signal: its variance is ⅓ that of the ends of its range.
  const double no_joint = 0.05 * n + bias / 3;
  Eigen::Vector3d middle = Eigen::Vector3d::Zero();
  if (of_positions)
    for (const PairFrame& frame : pair.frames)
      middle += fit.model.predict(actions, frame.sample).translation() / n;
  double largest = 0;
  for (const int g : actions.moving()) {
    if (fit.model.uses(g)) continue;
    double mean = 0;
    for (int t = 0; t < n; ++t) mean += actions(pair.frames[t].sample, g) / n;
    for (int t = 0; t < n; ++t) {
      const int sample = pair.frames[t].sample;
      F(t, 0) = actions(sample, g) - mean;
      if (of_positions) {
        F.row(t).segment<3>(1) =
            F(t, 0) * (fit.model.predict(actions, sample).translation() - middle).transpose();
        F(t, 4) = F(t, 0) * F(t, 0);
      }
      if (tensor) {
        const double q = actions(sample, fit.model.joints[0].signal);
        const double theta = std::max(std::abs(fit.model.joints[0].turn), 0.1) * q;
        F(t, 1) = F(t, 0) * std::cos(theta);
        F(t, 2) = F(t, 0) * std::sin(theta);
      }
    }
    if (!(F.col(0).squaredNorm() > 0)) continue;
    if (of_positions) standardise(&F);
    Eigen::VectorXd::Map(q_g.data(), n) = F.col(0);
    const double threshold = noise * variance_inflation(q_g, samples, correlation) + no_joint;
    largest = std::max(largest, explained_sum(F, r) / threshold);
  }
  return largest;
}

// log λ, averaged over the axes: spread of the readings about their own robust centre against
// their noise.
double log_spread(const Fit& fit, const PairData& pair) {
  std::vector<double> spread;
  const int n = pair.size();
  const Pose centre = pair.hypotheses[fit.frames[n / 2].hypothesis].z;
  for (int t = 0; t < n; ++t) {
    const PairHypothesis& h = pair.hypotheses[fit.frames[t].hypothesis];
    spread.push_back(h.whitened(h.error(centre.inverse()), centre).squaredNorm() / h.num_residuals);
  }
  return 0.5 * std::log(std::max(upper_median(std::move(spread)) / 2, 1.0));
}

// Wild readings come at any time; those since the body changed come one after the other.
bool are_scattered(const Validity& validity, int num_frames) {
  const double share = static_cast<double>(validity.num_outliers) / num_frames;
  return num_frames * std::pow(share, validity.longest_run) > kLeastChanceOfRun;
}

struct Outliers {
  int most = 0;                 // that a true model has
  bool are_far = false;         // wild readings, few of them near
  bool are_suspicious = false;  // too many, and not allowed
};

// Sets whether the model is doubtful, too.
Outliers judge_outliers(int num_independent, int num_frames, const ValidityOptions& options,
                        Validity* validity) {
  const double share = static_cast<double>(num_independent) / num_frames;
  const double rate = pair_outlier_rate(options);
  Outliers result;
  result.most = std::min(
      static_cast<int>(
          binomial_quantile(num_independent, rate, options.lenient ? 0.99999 : 0.9997) / share),
      static_cast<int>(0.35 * num_frames));
  // With few frames a true model may meet more outliers than the bound by bad luck: then it is not
  // refuted, only not to be trusted yet.
  const int inliers = num_frames - validity->num_outliers;
  result.are_far = num_independent >= kFewestFarFrames && validity->num_near <= result.most &&
                   inliers >= kFewestInliers * num_frames && are_scattered(*validity, num_frames);
  const bool are_allowed = options.allows_far_outliers && result.are_far;
  result.are_suspicious = validity->num_outliers > result.most && !are_allowed;
  validity->doubtful =
      num_independent < kFewFrames && (are_allowed ? validity->num_near : validity->num_outliers) >
                                          binomial_quantile(num_independent, rate, 0.8) / share;
  return result;
}

// Of the inliers' d², with so many degrees of freedom left.
double largest_mean_of(double dof, int num_residuals, double correlation,
                       const ValidityOptions& options) {
  // Squares of noise that lasts: the sum of ρ^2k over all lags either way.
  const double lasts = (1 + correlation * correlation) / (1 - correlation * correlation);
  const double max_mean =
      largest_inlier_mean(dof / num_residuals / lasts, options.lenient ? 5 : 3, num_residuals);
  return std::min(max_mean, 0.75 * outlier_threshold(num_residuals));
}

// Of one of all candidates with so many joints.
bool is_improbable_by_chance(const Fit& fit, const PairData& pair, const NormalizedActions& actions,
                             double dof) {
  const double num_candidates =
      1.0 +
      std::pow(std::max(static_cast<int>(actions.moving().size()), 1), fit.model.num_joints());
  return dof * log_spread(fit, pair) > std::log(num_candidates) + 7;
}

}  // namespace

double largest_inlier_mean(double num_inliers, double sigmas, int num_residuals) {
  static const ChiSquareMoments of_pose = chi_square_below(outlier_threshold(6), 6),
                                of_position = chi_square_below(outlier_threshold(3), 3);
  const ChiSquareMoments& inlier = num_residuals == 3 ? of_position : of_pose;
  // A fifth of slack: the noise is known to some ten per cent at best.
  return 1.2 * inlier.mean + sigmas * std::sqrt(inlier.variance / num_inliers);
}

double pair_outlier_rate(const ValidityOptions& options) {
  return std::min(2 * options.outlier_rate + 0.01, 0.35);
}

Validity check_validity(const Fit& fit, const LeaveOneOut& loo, const PairData& pair,
                        const NormalizedActions& actions, const ValidityOptions& options) {
  Validity result;
  const int n = pair.size();
  if (n < 2) {
    result.verdict = Verdict::kNotEnoughData;
    return result;
  }
  tally(fit, loo, pair, &result);
  const int inliers = n - result.num_outliers;
  const int p = loo.rank;
  // A block of time of a stream counts as one frame. `share`: independent frames per frame.
  const int num_independent =
      actions.blocks().count(pair.frames, [](const PairFrame& f) { return f.sample; });
  const double share = static_cast<double>(num_independent) / n;

  // V1
  const Outliers outliers = judge_outliers(num_independent, n, options, &result);
  const bool suspicious = outliers.are_suspicious;
  const double independent_inliers = share * inliers;
  const int num_residuals = pair.num_residuals();
  const double dof = num_residuals * independent_inliers - p;
  if (dof < 6) {
    // So few frames fit that nothing is left over to test with.
    result.verdict = suspicious ? Verdict::kRefuted : Verdict::kNotEnoughData;
    return result;
  }
  const double correlation = serial_correlation(fit, pair, actions);
  const double largest_mean = largest_mean_of(dof, num_residuals, correlation, options);
  if (result.mean_inlier > largest_mean) return result;
  if (!options.lenient && is_wrong_at_some_commands(pair, loo.squared_distance, actions))
    return result;
  result.has_far_outliers = suspicious && outliers.are_far;
  if (suspicious && (n >= kFewFrames || 2 * result.num_outliers > n)) {
    // So many wild readings say nothing against it, nor for it. (By chance a wrong model has fewer
    // inliers without more that are near.)
    if (options.allows_far_outliers && result.num_near <= outliers.most && 4 * inliers > n)
      result.verdict = Verdict::kNotEnoughData;
    return result;
  }

  // V2
  result.explained =
      explained_excess(fit, pair, actions, options, result.mean_inlier, share, correlation);
  if (result.explained > 1) {
    result.is_noise_lasting = correlation > 0 && result.explained < kLargestLasting;
    if (result.is_noise_lasting) result.verdict = Verdict::kNotEnoughData;
    return result;
  }

  const int k = fit.model.num_joints();
  result.verdict = Verdict::kValid;
  if (suspicious) result.verdict = Verdict::kNotEnoughData;
  // Few readings of a joint that happened to move little look rigid, the more so with some set
  // aside.
  if (k == 0 && independent_inliers < 4 + share * result.num_outliers)
    result.verdict = Verdict::kNotEnoughData;
  const bool improbable_by_chance = is_improbable_by_chance(fit, pair, actions, dof);
  if (k > 0 && dof < 2 * p && !improbable_by_chance) result.verdict = Verdict::kNotEnoughData;
  return result;
}

}  // namespace bodyschema
