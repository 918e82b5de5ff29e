#include "processes/model_monitor/hypotheses/action_discrepancy.h"

#include <algorithm>

namespace bodyschema {
namespace {

/// The newest 44 of DriftWatch's window, and 60 more that stand for all before (chosen).
constexpr std::size_t kMost = 104;
/// Of a signal's range −1 … 1: about a radian of a joint that turns by half a turn (chosen).
constexpr double kLength = 0.6;

}  // namespace

void ActionDiscrepancy::add(const Eigen::VectorXd& action, const std::vector<Signal>& signals,
                            std::int64_t sample_index) {
  if (!added_.empty() && added_.front().action.size() != action.size()) clear();
  added_.push_back({sample_index, normalized(signals, action) / kLength});
  if (added_.size() > kMost) {
    added_.pop_front();
    kernel_ = kernel_.bottomRightCorner(kernel_.rows() - 1, kernel_.cols() - 1).eval();
  }
  const auto size = static_cast<Eigen::Index>(added_.size()), last = size - 1;
  kernel_.conservativeResize(size, size);
  for (Eigen::Index n = 0; n < size; ++n) {
    const Eigen::ArrayXd apart = added_[static_cast<std::size_t>(n)].action - added_.back().action;
    kernel_(n, last) = kernel_(last, n) =
        apart.size() > 0 ? (-0.5 * apart.square()).exp().mean() : 1;
  }
  // Σ over pairs before the split, and over all that have one of the pair before it.
  squared_.assign(added_.size(), 1);
  const double all = kernel_.sum();
  double before = 0, with_before = 0;
  for (Eigen::Index n = 1; n < size; ++n) {
    before += 2 * kernel_.row(n - 1).head(n - 1).sum() + kernel_(n - 1, n - 1);
    with_before += kernel_.row(n - 1).sum();
    const double across = with_before - before, newest = all - before - 2 * across;
    const auto m = static_cast<double>(n), k = static_cast<double>(size - n);
    squared_[static_cast<std::size_t>(n)] =
        std::max(0.0, before / (m * m) + newest / (k * k) - 2 * across / (m * k));
  }
}

double ActionDiscrepancy::since(std::int64_t first) const {
  const auto at = std::ranges::lower_bound(added_, first, {}, &Added::sample_index);
  return at == added_.end() ? 1 : squared_[static_cast<std::size_t>(at - added_.begin())];
}

}  // namespace bodyschema
