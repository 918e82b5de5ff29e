#pragma once

#include <algorithm>

#include "common/estimation/cholesky.h"

namespace bodyschema {

/// Levenberg–Marquardt (Marquardt's scaling: the damping is relative to the diagonal, so that
/// metres and radians need no common unit). The normal equations, which each problem builds by its
/// own structure, and the criteria that end the iterations stay with the caller.
class LevenbergMarquardt {
 public:
  LevenbergMarquardt(double damping, double least_damping, int max_attempts)
      : damping_(damping), least_damping_(least_damping), max_attempts_(max_attempts) {}

  double damping() const { return damping_; }

  /// One step of min ½ δᵀHδ + gᵀδ: `accept(δ)` moves the model and returns true if its cost shrinks
  /// by δ, else leaves it alone. The damping grows tenfold with each attempt that fails. False if
  /// all do.
  template <class Matrix, class Vector, class Accept>
  bool step(const Matrix& H, const Vector& g, Accept&& accept) {
    for (int attempt = 0; attempt < max_attempts_; ++attempt) {
      Matrix damped = H;
      damped.diagonal() += damping_ * H.diagonal();
      // A parameter without information stays at rest.
      damped.diagonal().array() += 1e-14 * H.diagonal().maxCoeff();
      const Cholesky<Matrix> cholesky(damped);
      if (cholesky.is_positive()) {
        const Vector delta = -cholesky.solve(g);
        if (delta.allFinite() && accept(delta)) {
          damping_ = std::max(damping_ / 10, least_damping_);
          return true;
        }
      }
      damping_ *= 10;
    }
    return false;
  }

 private:
  double damping_;
  double least_damping_;
  int max_attempts_;
};

}  // namespace bodyschema
