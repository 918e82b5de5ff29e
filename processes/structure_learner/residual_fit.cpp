#include "processes/structure_learner/residual_fit.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

#include "processes/structure_learner/residual_fitter.h"
#include "processes/structure_learner/wrong_commands.h"

namespace bodyschema {
namespace {

using Fitter = ResidualFitter;
using Gain = Fitter::Gain;
using Shape = Fitter::Shape;

constexpr int kMaxInputs = 12;
constexpr int kIterations = 15, kDropIterations = 8;  // of the marginal likelihood
// Signals tried for a step. Chosen: of eleven signals three take about half of the fits of all.
constexpr std::size_t kDropCandidates = 3;
// A signal stays if the blocks left out miss it by this [nats] and by so many of its standard
// errors: what few blocks say may be noise. Measured with the assumed noise, not with the one that
// fits, and with samples chosen anew, which doubles the errors: of 150 chains with a signal without
// effect two kept it by 17 and 12 nats, 1.6 and 0.8 errors; signals with an effect have 2.3 and
// more.
constexpr double kMissed = 10, kMissedErrors = 2;
// Below so many errors it is told that the signal may have no effect. Measured as the errors above,
// in `soft_bodies --poses 50 100 --arms 3`: signals with an effect have 4.2 and more, those without
// that stay 2.0 to 3.8.
constexpr double kSureErrors = 4;
// A line that explains what is left as well as this by chance is one in the signal. Motion of about
// the noise is told so, by all frames, where kShapeSamples tell nothing. Measured: signals with an
// effect that arms of 3 to 7 joints with a range of 4° have at their ends, 3e-5 and less, but for
// two that are missed anyway; those that `soft_bodies` and `trunk_c11` drop for good, 3e-3 and
// more. Chosen: from a hundredth of it on it is sure.
const double kLogChance = std::log(1e-4), kSureLogChance = std::log(1e-6);
// Trace of the whitened covariance of a prediction: 6 is that of a measurement.
constexpr double kLargestUncertainty = 6;

bool is_missed(const Gain& gain) {
  return gain.sum > kMissed && gain.sum > kMissedErrors * gain.error;
}
bool is_sure(const Gain& gain) { return gain.sum > kSureErrors * gain.error; }

// Backwards: of those with the longest length scales the signal that is missed least goes first, of
// the others only where these are missed. Returns those that stay though it is not sure that they
// are missed.
std::vector<int> drop_signals(Fitter* fitter) {
  while (fitter->signals().size() > 1) {
    std::vector<int> places(fitter->signals().size());
    std::iota(places.begin(), places.end(), 0);
    const Eigen::VectorXd& lengths = fitter->shape().log_lengths;
    std::stable_sort(places.begin(), places.end(),
                     [&](int x, int y) { return lengths(x) > lengths(y); });
    std::optional<Fitter> best;
    bool is_best_missed = false;
    std::vector<int> doubtful;
    for (std::size_t n = 0; n < places.size(); ++n) {
      if (n >= kDropCandidates && best && !is_best_missed) break;
      const int signal = fitter->signals()[places[n]];
      Fitter fewer = fitter->without(places[n], kDropIterations);
      const Gain gain = fitter->gain_over(fewer);
      const double chance = fewer.log_chance_of_line(signal);
      if (!is_sure(gain) && chance > kSureLogChance) doubtful.push_back(signal);
      if (chance < kLogChance) continue;
      if (best && fewer.judged().log_density <= best->judged().log_density) continue;
      is_best_missed = is_missed(gain) && !fitter->is_straight(places[n]);
      best = std::move(fewer);
    }
    if (!best || is_best_missed) return doubtful;
    *fitter = std::move(*best);
  }
  return {};
}

// As V1 judges screws, and by how much of the prediction is known.
Verdict verdict_of(const Fitter& fitter, const PairData& pair, const NormalizedActions& actions,
                   const ValidityOptions& options) {
  const SoftFit& fit = fitter.judged();
  const int num_independent = fitter.num_blocks();
  const auto num_frames = static_cast<double>(fit.frames.size());
  const double share = num_independent / num_frames;
  const double inliers = num_frames - fit.num_outliers;
  const double max_outliers =
      std::min(binomial_quantile(num_independent, pair_outlier_rate(options), 0.9997) / share,
               0.35 * num_frames);
  if (fit.num_outliers > max_outliers ||
      fit.mean_inlier > largest_inlier_mean(std::max(1.0, share * inliers), 3))
    return Verdict::kRefuted;
  if (is_wrong_at_some_commands(pair, fit.squared_distance, actions)) return Verdict::kRefuted;
  return fit.mean_uncertainty > kLargestUncertainty ? Verdict::kNotEnoughData : Verdict::kValid;
}

}  // namespace

double log_density_of_screws(const Fit& fit, const PairData& pair,
                             const NormalizedActions& actions) {
  const std::vector<double> distances = leave_one_out(fit, pair, actions).squared_distance;
  const int num_blocks =
      actions.blocks().count(pair.frames, [](const PairFrame& frame) { return frame.sample; });
  const double share = static_cast<double>(num_blocks) / std::max(pair.size(), 1);
  double best = -std::numeric_limits<double>::infinity();
  // Between two steps of 10 % lies a best factor that costs 0.003 nats a frame less at most.
  for (double noise = Fitter::kLeastNoise; noise <= Fitter::kMostNoise; noise *= 1.1) {
    double sum = 0;
    for (const double d2 : distances) sum += bounded_log_density(d2 / noise, 6 * std::log(noise));
    best = std::max(best, share * sum);
  }
  return best;
}

std::optional<SoftFit> fit_soft_model(const LocalModel& screws, const PairData& pair,
                                      const NormalizedActions& actions,
                                      const ValidityOptions& options,
                                      const std::vector<int>& signals) {
  if (actions.moving().empty() || pair.size() == 0) return std::nullopt;
  Fitter fitter(screws, pair, actions);
  if (fitter.num_blocks() < kFewestSoftFrames) return std::nullopt;
  std::vector<int> chosen = signals;
  if (chosen.empty()) {
    chosen = fitter.ranked_signals();
    if (chosen.size() > kMaxInputs) chosen.resize(kMaxInputs);
    std::sort(chosen.begin(), chosen.end());
  }
  if (!fitter.fit(chosen, nullptr, kIterations)) return std::nullopt;
  const bool is_too_straight = fitter.reweigh();
  const Shape shape = fitter.shape();
  if (!fitter.fit(chosen, is_too_straight ? nullptr : &shape, kIterations)) return std::nullopt;
  const std::vector<int> doubtful = signals.empty() ? drop_signals(&fitter) : std::vector<int>{};
  if (fitter.signals().size() < chosen.size()) {
    chosen = fitter.signals();
    const Shape of_kept = fitter.shape();
    fitter.fit(chosen, &of_kept, kDropIterations);
  }

  SoftFit result = fitter.judged();
  result.verdict = verdict_of(fitter, pair, actions, options);
  // Errors that last longer than from one sample to the next make more samples worse.
  Fitter more = fitter;
  more.use_all_samples();
  const Verdict verdict_of_more = verdict_of(more, pair, actions, options);
  if (more.judged().log_density > result.log_density &&
      (verdict_of_more == Verdict::kValid || result.verdict != Verdict::kValid)) {
    result = more.judged();
    result.verdict = verdict_of_more;
    fitter = std::move(more);
  }
  result.doubtful_signals = doubtful;
  result.model.screws = screws;
  result.model.residual_gp = fitter.residual_gp();
  for (int d = 0; d < screws.num_joints(); ++d)
    result.model.signals.push_back(screws.joints[d].signal);
  for (const int s : chosen)
    if (!screws.uses(s)) result.model.signals.push_back(s);
  return result;
}

}  // namespace bodyschema
