#pragma once

#include <string>
#include <vector>

namespace bodyschema::experiments {

/// Mean and standard deviation of a sample (of robots, mostly).
struct Spread {
  int count = 0;
  double mean = 0;                ///< NaN of nothing
  double standard_deviation = 0;  ///< with count − 1; 0 of a single value
  /// Standard error of the mean: standard_deviation / √count.
  double standard_error() const;
};
Spread spread_of(const std::vector<double>& values);

/// Lower end of Wilson's score interval for a binomial proportion, in [0, 1] (Wilson 1927): the
/// share that is at least so large with 97.5 % confidence (`z` = 1.96).
/// @throws std::invalid_argument unless 0 ≤ successes ≤ trials and trials > 0.
double wilson_lower_bound(int successes, int trials, double z = 1.959964);
/// Its upper end.
double wilson_upper_bound(int successes, int trials, double z = 1.959964);

/// "99.5 % (≥ 97.2)": share and Wilson lower bound.
std::string percentage(int successes, int trials);
/// "12.3 ± 0.4": mean and standard error, in units of `unit`, with three significant digits;
/// of a single value the value alone.
std::string mean_and_error(const Spread& spread, double unit);
/// Three significant digits; "–" for NaN.
std::string short_number(double value);

}  // namespace bodyschema::experiments
