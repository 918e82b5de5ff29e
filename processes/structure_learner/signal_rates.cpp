#include "processes/structure_learner/signal_rates.h"

#include <Eigen/Core>
#include <algorithm>

#include "processes/structure_learner/command_track.h"
#include "processes/structure_learner/pair_data.h"

namespace bodyschema {
namespace {

/// Samples over which a rate is summed. Chosen: a quarter of a second at 30 Hz, over which what
/// encoders round averages out.
constexpr std::size_t kWindow = 8;
/// Chosen: rates with noise of a tenth of themselves have more, joints that swing in rhythms of
/// their own less (test SignalRates).
constexpr double kLeastCorrelation = 0.97;

/// Of the rows of x and y about 0, and about their means: the less of both.
double correlation(const Eigen::ArrayXd& x, const Eigen::ArrayXd& y) {
  const auto of = [](const Eigen::ArrayXd& a, const Eigen::ArrayXd& b) {
    const double squares = a.square().sum() * b.square().sum();
    return squares > 0 ? (a * b).sum() / std::sqrt(squares) : 0.0;
  };
  return std::min(of(x, y), of(x - x.mean(), y - y.mean()));
}

}  // namespace

std::vector<int> rates_of_others(const std::vector<ActionPoseSample>& samples, int num_signals) {
  if (samples.size() <= kWindow || !std::ranges::is_sorted(samples, {}, time_of) ||
      !NormalizedActions(samples, num_signals).blocks().is_stream())
    return {};
  const CommandTrack track(samples);
  // Of every window without a gap: what each signal sums up to, and by what it moves.
  Eigen::MatrixXd sums(num_signals, std::ssize(samples)), steps = sums;
  Eigen::MatrixXd areas = Eigen::MatrixXd::Zero(num_signals, std::ssize(samples));
  Eigen::Index num_windows = 0;
  std::size_t num_in_row = 0;
  for (std::size_t n = 1; n < samples.size(); ++n) {
    const auto now = static_cast<Eigen::Index>(n);
    const double apart_s = 1e-6 * (time_of(samples[n]) - time_of(samples[n - 1]));
    areas.col(now) =
        areas.col(now - 1) + 0.5 * apart_s * (samples[n].action + samples[n - 1].action);
    num_in_row = track.is_behind_gap(n) ? 0 : num_in_row + 1;
    if (num_in_row < kWindow) continue;
    steps.col(num_windows) = samples[n].action - samples[n - kWindow].action;
    sums.col(num_windows++) = areas.col(now) - areas.col(now - static_cast<Eigen::Index>(kWindow));
  }
  std::vector<int> rates;
  for (int rate = 0; rate < num_signals; ++rate)
    for (int signal = 0; signal < num_signals; ++signal)
      if (signal != rate && num_windows > 0 &&
          correlation(sums.row(rate).head(num_windows), steps.row(signal).head(num_windows)) >
              kLeastCorrelation) {
        rates.push_back(rate);
        break;
      }
  return rates;
}

std::vector<ActionPoseSample> held_still(std::vector<ActionPoseSample> samples,
                                         const std::vector<int>& signals) {
  for (ActionPoseSample& sample : samples)
    for (const int signal : signals) sample.action(signal) = samples.front().action(signal);
  return samples;
}

}  // namespace bodyschema
