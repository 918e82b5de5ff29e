#include "tests/experiments/figures/statistics.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

namespace bodyschema::experiments {
namespace {

/// Centre and half width of Wilson's interval.
std::pair<double, double> wilson(int successes, int trials, double z) {
  if (trials <= 0 || successes < 0 || successes > trials)
    throw std::invalid_argument("Wilson bound: 0 <= successes <= trials, trials > 0");
  const double n = trials, p = successes / n, z2n = z * z / n;
  return {(p + z2n / 2) / (1 + z2n), z / (1 + z2n) * std::sqrt(p * (1 - p) / n + z2n / (4 * n))};
}

}  // namespace

double Spread::standard_error() const {
  return count > 0 ? standard_deviation / std::sqrt(count)
                   : std::numeric_limits<double>::quiet_NaN();
}

Spread spread_of(const std::vector<double>& values) {
  Spread result;
  result.count = static_cast<int>(values.size());
  for (const double v : values) result.mean += v;
  result.mean /= result.count;  // 0/0 is the NaN of nothing
  if (result.count < 2) return result;
  double sum = 0;
  for (const double v : values) sum += (v - result.mean) * (v - result.mean);
  result.standard_deviation = std::sqrt(sum / (result.count - 1));
  return result;
}

double wilson_lower_bound(int successes, int trials, double z) {
  const auto [centre, half] = wilson(successes, trials, z);
  return successes == 0 ? 0 : std::max(0.0, centre - half);
}

double wilson_upper_bound(int successes, int trials, double z) {
  const auto [centre, half] = wilson(successes, trials, z);
  return successes == trials ? 1 : std::min(1.0, centre + half);
}

std::string percentage(int successes, int trials) {
  return fmt::format("{:.1f} % (≥ {:.1f})", 100.0 * successes / trials,
                     100 * wilson_lower_bound(successes, trials));
}

std::string short_number(double value) {
  if (!std::isfinite(value)) return "–";
  const double size = std::abs(value);
  if (size == 0) return "0";
  if (size < 1e-3) return fmt::format("{:.1e}", value);
  return fmt::format("{:.{}f}", value, std::clamp(2 - int(std::floor(std::log10(size))), 0, 5));
}

std::string mean_and_error(const Spread& spread, double unit) {
  if (spread.count == 0) return "–";
  if (spread.count == 1) return short_number(spread.mean / unit);
  return short_number(spread.mean / unit) + " ± " + short_number(spread.standard_error() / unit);
}

}  // namespace bodyschema::experiments
