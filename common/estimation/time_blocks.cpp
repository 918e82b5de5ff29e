#include "common/estimation/time_blocks.h"

#include <algorithm>
#include <utility>

#include "common/estimation/quantile.h"

namespace bodyschema {
namespace {

constexpr double kLongestInterval_us = 1e6;
constexpr Eigen::Index kLeastLag = 3;

}  // namespace

TimeBlocks::TimeBlocks(const std::vector<std::int64_t>& utimes, const Eigen::MatrixXd& actions,
                       Eigen::Index least_instants) {
  const Eigen::Index N = actions.cols();
  if (N < least_instants || static_cast<Eigen::Index>(utimes.size()) != N) return;
  std::vector<double> intervals;
  for (std::size_t t = 1; t < utimes.size(); ++t)
    intervals.push_back(static_cast<double>(utimes[t] - utimes[t - 1]));
  if (*std::min_element(intervals.begin(), intervals.end()) <= 0) return;
  if (upper_median(std::move(intervals)) > kLongestInterval_us) return;

  const double random =
      2 * (actions.colwise() - actions.rowwise().mean()).squaredNorm() / static_cast<double>(N);
  if (!(random > 0)) return;
  Eigen::Index lag = 1;
  const auto mean_square = [&](Eigen::Index l) {
    return (actions.rightCols(N - l) - actions.leftCols(N - l)).squaredNorm() /
           static_cast<double>(N - l);
  };
  while (lag < N / 4 && mean_square(lag) < 0.5 * random) ++lag;
  if (lag < kLeastLag) return;
  length_ = static_cast<int>(2 * lag);
}

}  // namespace bodyschema
