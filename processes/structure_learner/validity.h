#pragma once

#include <vector>

#include "common/estimation/chi_square.h"
#include "processes/structure_learner/local_model.h"

namespace bodyschema {

enum class Verdict {
  kValid,
  kRefuted,       ///< the data contradict the model
  kNotEnoughData  ///< nothing contradicts it, but a wrong model could fit as well by chance
};

struct ValidityOptions {
  /// Expected share of outliers per marker; a pair sees about twice as many.
  double outlier_rate = 0.03;
  /// More outliers are allowed, up to 60 % of the frames, where these are far off and scattered:
  /// wild readings. A wrong model is wrong by a little, too, and that of a body that changed is
  /// wrong from then on.
  bool allows_far_outliers = false;
  /// Widens the tests for a preselection on a part of the data.
  bool lenient = false;
};

struct Validity {
  Verdict verdict = Verdict::kRefuted;
  int num_outliers = 0;  ///< frames beyond outlier_threshold(), leave-one-out
  int num_near = 0;      ///< of these, those within ten times that
  int longest_run = 0;   ///< of outliers one after the other
  /// Its outliers are too many, but would not be if ValidityOptions::allows_far_outliers.
  bool has_far_outliers = false;
  /// Valid, but with more outliers than most true models have at so few frames: to be believed only
  /// where nothing larger explains the data better.
  bool doubtful = false;
  /// Undecided because noise that lasts from sample to sample may have made what speaks against it.
  bool is_noise_lasting = false;
  double mean_capped = 0;  ///< mean of min(d², 2c): comparable between pairs
  double mean_inlier = 0;  ///< mean leave-one-out d² of the others; 6 (3) under a true model
  double explained = 0;    ///< worst excess of V2: explained sum of squares over its threshold
  double score = 0;        ///< mean of −½[min(d², 2c) + log|2πΣ_z|] a frame
};

/// Is a fitted local model valid? Two tests on the leave-one-out residuals (never on training
/// residuals, which any flexible model makes small):
///
/// V1, no more left than noise: the outliers' number is below the 99.97 % binomial bound for the
/// known outlier rate (a robot has many edges, all of which must pass) and below 35 %, they do not
/// stand together at some commands, the fit has degrees of freedom left, and the mean inlier d²
/// lies within its sampling error.
///
/// V2, nothing left to explain: for every moving signal g outside Q the whitened residuals are
/// regressed on q_g times a basis over Q; the explained sum of squares must stay within χ². This
/// finds a joint of a few degrees that V1 misses. For positions alone also on q_g times the
/// predicted position and on q_g², for a joint nearer to the root moves them so.
///
/// At few samples both tests have little power. So the fit must also be improbable by chance: with
/// ν degrees of freedom left and data that spread λ times wider than the noise, a wrong model fits
/// with odds of about λ^−ν. kNotEnoughData where that is not well below one over the number of
/// candidates and ν is below twice the number of parameters.
Validity check_validity(const Fit& fit, const LeaveOneOut& loo, const PairData& pair,
                        const NormalizedActions& actions, const ValidityOptions& options);

/// Expected share of frames of a pair with an outlier among its two markers.
double pair_outlier_rate(const ValidityOptions& options);
/// Bound on the mean d² of so many independent inliers of a true model, `sigmas` of its sampling
/// errors above what is expected.
double largest_inlier_mean(double num_inliers, double sigmas, int num_residuals = 6);

}  // namespace bodyschema
