#include "processes/structure_learner/signal_rates.h"

#include <Eigen/Core>

#include "processes/structure_learner/command_track.h"
#include "processes/structure_learner/pair_data.h"

namespace bodyschema {
namespace {

/// Samples over which a rate is summed: at 30 Hz a quarter of a second, over which what encoders
/// round averages out.
constexpr std::size_t kWindow = 8;
/// Correlation from which on one is the rate of the other. Chosen: of a rate that has noise of a
/// tenth of itself and comes 50 ms late, 0.99; of joints that swing at random in rhythms of their
/// own, at most 0.5 within a minute.
constexpr double kIsRate = 0.97;

}  // namespace

std::vector<int> rates_of_others(const std::vector<ActionPoseSample>& samples, int num_signals) {
  if (samples.size() <= kWindow || !NormalizedActions(samples, num_signals).blocks().is_stream())
    return {};
  const CommandTrack track(samples);
  // Over every window without a gap: by what each signal moves, and what it sums up to.
  std::vector<Eigen::VectorXd> steps, sums;
  std::size_t num_in_row = 0;
  Eigen::MatrixXd area =
      Eigen::MatrixXd::Zero(num_signals, std::ssize(samples));  // since the start
  for (std::size_t n = 1; n < samples.size(); ++n) {
    const auto column = static_cast<Eigen::Index>(n);
    const double apart_s = 1e-6 * (time_of(samples[n]) - time_of(samples[n - 1]));
    area.col(column) =
        area.col(column - 1) + 0.5 * apart_s * (samples[n].action + samples[n - 1].action);
    num_in_row = track.is_behind_gap(n) ? 0 : num_in_row + 1;
    if (num_in_row < kWindow) continue;
    steps.emplace_back(samples[n].action - samples[n - kWindow].action);
    sums.emplace_back(area.col(column) - area.col(column - static_cast<Eigen::Index>(kWindow)));
  }
  if (steps.empty()) return {};
  Eigen::MatrixXd S(num_signals, std::ssize(steps)), A = S;
  for (std::size_t n = 0; n < steps.size(); ++n) {
    S.col(static_cast<Eigen::Index>(n)) = steps[n];
    A.col(static_cast<Eigen::Index>(n)) = sums[n];
  }
  // A rate has no offset of its own, but windows may be of various lengths.
  const Eigen::VectorXd of_steps = S.rowwise().norm(), of_sums = A.rowwise().norm();
  std::vector<int> rates;
  for (int rate = 0; rate < num_signals; ++rate)
    for (int signal = 0; signal < num_signals; ++signal)
      if (signal != rate && of_steps(signal) > 0 && of_sums(rate) > 0 &&
          A.row(rate).dot(S.row(signal)) > kIsRate * of_sums(rate) * of_steps(signal)) {
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
