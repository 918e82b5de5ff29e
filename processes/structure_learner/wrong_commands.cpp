#include "processes/structure_learner/wrong_commands.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

#include "common/estimation/chi_square.h"

namespace bodyschema {
namespace {

double log_choose(int n, int k) {
  return k < 0 || k > n ? -std::numeric_limits<double>::infinity()
                        : std::lgamma(n + 1) - std::lgamma(k + 1) - std::lgamma(n - k + 1);
}

// How far a signal is from the value that it usually has, and whether that is an outlier; of a
// stream by motions and, while it rests, blocks of time, which are outliers if most of their
// samples are.
struct Excursion {
  double away = 0;
  bool is_outlier = false;
};
std::vector<Excursion> excursions(const std::vector<int>& samples,
                                  const std::vector<bool>& outlying,
                                  const std::vector<double>& values, double usual,
                                  const TimeBlocks& blocks) {
  std::vector<Excursion> result;
  const auto away = [&](std::size_t t) { return std::abs(values[t] - usual); };
  for (std::size_t t = 0; t < samples.size();) {
    const std::size_t first = t;
    const bool moves = away(first) > kResting;
    const auto is_of_this = [&](std::size_t other) {
      if (blocks.block_of(samples[other]) == blocks.block_of(samples[first]))
        return (away(other) > kResting) == moves;
      return blocks.is_stream() && moves && away(other) > kResting;
    };
    Excursion excursion;
    int balance = 0;
    for (; t < samples.size() && is_of_this(t); ++t) {
      excursion.away = std::max(excursion.away, away(t));
      balance += outlying[t] ? 1 : -1;
    }
    excursion.is_outlier = balance > 0;
    result.push_back(excursion);
  }
  return result;
}

// Outliers where a signal is farthest from the value that it usually has; or at all poses where it
// is away from that, so that no pose tells what it does; `fewest` of them.
bool are_outliers_where_it_moved(std::vector<Excursion> all, double log_trials, int fewest) {
  constexpr double kLogLeastChance = -6.9;  // 1e-3
  std::ranges::stable_sort(all, std::ranges::greater(), &Excursion::away);
  const auto inlier = std::ranges::find(all, false, &Excursion::is_outlier);
  const auto num = static_cast<int>(inlier - all.begin());
  if (num < fewest || all.front().away <= kResting) return false;
  const auto num_outliers = static_cast<int>(std::ranges::count(all, true, &Excursion::is_outlier));
  return inlier == all.end() || inlier->away <= kResting ||
         log_trials + log_hypergeometric(num, num, num_outliers, static_cast<int>(all.size())) <
             kLogLeastChance;
}

// Visits of a stream to the bins first … last of a signal's range: apart where it was outside of
// these and of the next ones.
struct Visits {
  int num = 0, num_wrong = 0;  // mostly outliers
  int num_matched = 0;         // hardly anything else, and hardly any before or after it
  int num_outliers = 0;
};
Visits visits_to(int first, int last, const std::vector<int>& bins,
                 const std::vector<bool>& outlying) {
  constexpr double kTenth = 0.1;
  Visits visits;
  int length = 0, inside = 0, beside = 0;
  const auto end_visit = [&] {
    visits.num += length > 0;
    visits.num_wrong += 2 * inside > length;
    visits.num_matched +=
        length > 0 && inside >= (1 - kTenth) * length && beside <= kTenth * length;
    visits.num_outliers += inside;
    length = inside = beside = 0;
  };
  for (std::size_t t = 0; t < bins.size(); ++t) {
    if (bins[t] < first - 1 || bins[t] > last + 1) {
      end_visit();
      continue;
    }
    if (bins[t] < first || bins[t] > last) {
      beside += outlying[t];
      continue;
    }
    ++length;
    inside += outlying[t];
  }
  end_visit();
  return visits;
}

// Whether a stream is wrong at nearly all visits to some stretch of a signal's range: however long
// they last, outliers that have other reasons than the command are there at one visit and not at
// the next; and do not begin and end with them.
bool is_wrong_at_visits(const std::vector<bool>& outlying, const std::vector<double>& values,
                        double log_signals) {
  constexpr int kBins = 32;  // chosen: with 16 a boundary within one blurs visits of half a second
  constexpr double kLogLeastChance = -9.2;  // 1e-4
  // Of the visits; of all samples, and of all outliers, that are outliers there. All chosen.
  constexpr double kLeastInside = 0.7, kLeastShare = 0.05, kLeastOfOutliers = 0.3;
  // Of an episode to begin and to end with a visit, each to a tenth of it: about 1 in 20.
  constexpr double kLogMatches = -3;
  const auto n = static_cast<double>(values.size());
  const auto num_outliers = static_cast<double>(std::ranges::count(outlying, true));
  if (num_outliers < kLeastShare * n) return false;
  std::vector<int> bins;
  for (const double value : values)
    bins.push_back(std::clamp(static_cast<int>(0.5 * (value + 1) * kBins), 0, kBins - 1));
  const double log_share = std::log(num_outliers / n);
  const double log_trials = log_signals + std::log(kBins * (kBins + 1) / 2);
  for (int first = 0; first < kBins; ++first)
    for (int last = first; last < kBins; ++last) {
      const Visits visits = visits_to(first, last, bins, outlying);
      if (visits.num_outliers < std::max(kLeastShare * n, kLeastOfOutliers * num_outliers) ||
          visits.num_wrong < kLeastInside * visits.num)
        continue;
      if (log_trials + log_choose(visits.num, visits.num_wrong) + visits.num_wrong * log_share +
              visits.num_matched * kLogMatches <
          kLogLeastChance)
        return true;
    }
  return false;
}

}  // namespace

double log_hypergeometric(int drawn_marked, int drawn, int marked, int total) {
  return log_choose(marked, drawn_marked) + log_choose(total - marked, drawn - drawn_marked) -
         log_choose(total, drawn);
}

bool is_wrong_at_some_commands(const std::vector<int>& samples, const std::vector<bool>& outlying,
                               const NormalizedActions& actions) {
  constexpr double kLogLeastChance = -9.2;  // 1e-4
  // Of a stretch with some poses right; chosen: of views from which a tag is read badly fewer are
  // wrong, and where a command is bent steeply fewer lie together.
  constexpr double kLeastInside = 0.7, kLeastShare = 0.1;
  constexpr int kFewestInside = 8;
  const int n = static_cast<int>(samples.size());
  const auto num_outliers = static_cast<int>(std::count(outlying.begin(), outlying.end(), true));
  if (num_outliers == 0) return false;
  const double log_trials = std::log(n * static_cast<double>(actions.moving().size()));
  const double log_share = std::log(num_outliers / static_cast<double>(n));
  const int fewest = std::max(kFewestInside, static_cast<int>(kLeastShare * n));
  std::vector<int> order(samples.size()), places;  // of the outliers in that order
  const double log_signals = std::log(static_cast<double>(actions.moving().size()));
  for (const int signal : actions.moving()) {
    std::vector<double> values;
    for (const int sample : samples) values.push_back(actions(sample, signal));
    const auto usual = usual_value(values);
    // What hides a tag of a stream lasts, and may do so while a signal moves once.
    if (usual &&
        are_outliers_where_it_moved(excursions(samples, outlying, values, *usual, actions.blocks()),
                                    log_signals, actions.blocks().is_stream() ? 2 : 1))
      return true;
    if (actions.blocks().is_stream()) {
      if (is_wrong_at_visits(outlying, values, log_signals)) return true;
      continue;
    }
    std::iota(order.begin(), order.end(), 0);
    std::stable_sort(order.begin(), order.end(), [&](int a, int b) {
      return actions(samples[static_cast<std::size_t>(a)], signal) <
             actions(samples[static_cast<std::size_t>(b)], signal);
    });
    places.clear();
    for (int t = 0; t < n; ++t)
      if (outlying[static_cast<std::size_t>(order[static_cast<std::size_t>(t)])])
        places.push_back(t);
    for (int first = 0; first < num_outliers; ++first)
      for (int last = first; last < num_outliers; ++last) {
        const int inside = last - first + 1;
        const int length =
            places[static_cast<std::size_t>(last)] - places[static_cast<std::size_t>(first)] + 1;
        const bool is_run = inside == length;
        if (is_run && log_trials + inside * log_share < kLogLeastChance) return true;
        if (inside >= fewest && inside >= kLeastInside * length &&
            log_trials + std::log(length) + log_hypergeometric(inside, length, num_outliers, n) <
                kLogLeastChance)
          return true;
      }
  }
  return false;
}

bool is_wrong_at_some_commands(const PairData& pair, const std::vector<double>& squared_distance,
                               const NormalizedActions& actions) {
  std::vector<int> samples;
  std::vector<bool> outlying;
  for (int t = 0; t < pair.size(); ++t) {
    samples.push_back(pair.frames[t].sample);
    outlying.push_back(squared_distance[t] > outlier_threshold(pair.num_residuals()));
  }
  return is_wrong_at_some_commands(samples, outlying, actions);
}

}  // namespace bodyschema
