#pragma once

#include <limits>
#include <vector>

#include "processes/structure_learner/pair_data.h"

namespace bodyschema {

/// An axis u in frame j whose direction R_t u depends on one joint alone.
struct AxisFit {
  Eigen::Vector3d axis = Eigen::Vector3d::UnitZ();
  double score = std::numeric_limits<double>::infinity();
};

/// R_t u = C (1, cos α_t, sin α_t)ᵀ: u is the smallest eigenvector of a 3×3 matrix, its residual
/// judges the signal of α.
class AxisScreen {
 public:
  /// Noise of R u seen from a rotation noise σ per axis: σ² in each of two directions.
  AxisScreen(std::vector<Eigen::Matrix3d> rotations, std::vector<int> samples, double sigma_rad,
             const NormalizedActions& actions)
      : rotations_(std::move(rotations)),
        samples_(std::move(samples)),
        inverse_variance_(1 / (sigma_rad * sigma_rad)),
        actions_(actions),
        phi_(rotations_.size()),
        weights_(rotations_.size()) {}

  /// The axis for `turn` [rad per half range] of a signal after so many re-weightings.
  AxisFit fit(int signal, double turn, int rounds);

 private:
  std::vector<Eigen::Matrix3d> rotations_;
  std::vector<int> samples_;
  double inverse_variance_;
  const NormalizedActions& actions_;
  std::vector<Eigen::Vector3d> phi_;
  std::vector<double> weights_;
};

}  // namespace bodyschema
