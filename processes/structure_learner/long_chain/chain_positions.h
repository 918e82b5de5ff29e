#pragma once

#include <vector>

#include "processes/structure_learner/long_chain/chain_search.h"

namespace bodyschema {

/// Links are shorter than that [m]: what the poses do not tell of them stays small.
inline constexpr double kLongestLink = 1;

/// Given what turns the positions are linear in the links l_0 … l_m and, for joints that slide,
/// s_j:
///   x(q) = l_0 + Σ_j (P_(j−1) s_j q_j + P_j l_j),  P_j = ∏_(i ≤ j) Exp(w_i q_i).
/// The columns of that, three rows for every column of `q` (signals × frames): the links', then
/// those of the s_j, three each. Joints that slide do not turn.
Eigen::MatrixXd links_design(const ChainAxes& chain, const std::vector<bool>& slides,
                             const Eigen::MatrixXd& q);

/// Finds the axes from positions alone: the links are eliminated (variable projection, Golub and
/// Pereyra 1973, with the Jacobian of Kaufman 1975). Of random arms of six joints that are seen at
/// 60 positions four starts in ten lead to the global minimum where the lengths are held right, two
/// in ten from random ones.
class PositionSearch : public ChainSearch {
 public:
  /// `sigma_m`: of a position, per axis.
  PositionSearch(const PairData& pair, const NormalizedActions& actions, int max_frames,
                 double sigma_m);

  /// A joint whose axis is zero slides.
  ChainAxes fit(ChainAxes start, bool holds_lengths, int max_iterations) const override;
  /// A fiftieth of the distances from the middle.
  double nearly_nothing() const override { return 0.02 * spread_; }

 private:
  struct Projected;
  Projected projected(const ChainAxes& chain, Eigen::VectorXd weights) const;
  Eigen::MatrixXd jacobian(const ChainAxes& chain, const std::vector<Eigen::MatrixXd>& bases,
                           const Eigen::VectorXd& links) const;

  Eigen::VectorXd positions_;  ///< three rows a frame
  double ridge_;
  double spread_ = 0;      ///< distance that a position usually has from the middle of all [m]
  double loss_scale_ = 1;  ///< [m]
};

}  // namespace bodyschema
