#include "processes/structure_learner/long_chain/chain_rotations.h"

#include <algorithm>
#include <cmath>

#include "common/estimation/levenberg_marquardt.h"
#include "common/estimation/quantile.h"
#include "processes/structure_learner/long_chain/long_chain.h"

namespace bodyschema {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

// Scale of the heavy-tailed loss: wide enough to be drawn into the global minimum from tens of
// degrees, narrow enough for one frame in five that is anything. research/long_chains.md.
constexpr double kLossScale = 0.3;

// One free start in ten succeeds.
constexpr ChainSearch::Effort kEffort{60, 3, kMaxChainJoints, 2};

// Of R̂ᵀ R: sin ϑ about its axis; 4 sin²(ϑ/2).
Vector3d sine_axis(const Matrix3d& error) {
  return 0.5 *
         Vector3d(error(2, 1) - error(1, 2), error(0, 2) - error(2, 0), error(1, 0) - error(0, 1));
}
double squared_chord(const Matrix3d& error) { return std::max(0.0, 3 - error.trace()); }

double loss(double chord2) {
  return 0.5 * kLossScale * kLossScale * std::log1p(chord2 / (kLossScale * kLossScale));
}
double weight(double chord2) { return 1 / (1 + chord2 / (kLossScale * kLossScale)); }

}  // namespace

RotationSearch::RotationSearch(const PairData& pair, const NormalizedActions& actions,
                               int max_frames)
    : ChainSearch(pair, actions, max_frames, kEffort) {
  for (const int frame : frames_) rotations_.push_back(pair.primary(frame).z.linear());
}

// steps[j] = Exp(w_j q_j); suffixes[j] = ∏_{i ≥ j} steps[i] · R_end.
void RotationSearch::predict(const ChainAxes& chain, int frame, std::vector<Matrix3d>* steps,
                             std::vector<Matrix3d>* suffixes) const {
  const int m = static_cast<int>(chain.axes.size());
  steps->resize(m);
  suffixes->resize(m + 1);
  (*suffixes)[m] = chain.R_end;
  for (int j = m; j-- > 0;) {
    (*steps)[j] = exp_so3(chain.axes[j] * q_(chain.signals[j], frame));
    (*suffixes)[j].noalias() = (*steps)[j] * (*suffixes)[j + 1];
  }
}

double RotationSearch::evaluate(ChainAxes* chain) const {
  chain->cost = 0;
  for (int t = 0; t < num_frames(); ++t) {
    Matrix3d R = chain->R_end;
    for (std::size_t j = chain->axes.size(); j-- > 0;)
      R = exp_so3(chain->axes[j] * q_(chain->signals[j], t)) * R;
    chain->cost += loss(squared_chord(R.transpose() * rotations_[t]));
  }
  return chain->cost;
}

void RotationSearch::set_end(ChainAxes* chain) const {
  Matrix3d sum = Matrix3d::Zero();
  for (int t = 0; t < num_frames(); ++t) {
    Matrix3d P = Matrix3d::Identity();
    for (std::size_t j = 0; j < chain->axes.size(); ++j)
      P = P * exp_so3(chain->axes[j] * q_(chain->signals[j], t));
    sum += P.transpose() * rotations_[t];
  }
  const Eigen::JacobiSVD<Matrix3d> svd(sum, Eigen::ComputeFullU | Eigen::ComputeFullV);
  Matrix3d U = svd.matrixU();
  if ((U * svd.matrixV().transpose()).determinant() < 0) U.col(2) *= -1;
  chain->R_end = U * svd.matrixV().transpose();
}

ChainAxes RotationSearch::fit(ChainAxes chain, bool holds_lengths, int max_iterations) const {
  const int m = static_cast<int>(chain.axes.size());
  const int width = holds_lengths ? 2 : 3;
  const int size = width * m + 3;
  std::vector<Matrix3d> steps, suffixes;
  Eigen::MatrixXd H(size, size), J(3, size);
  Eigen::VectorXd g(size);
  LevenbergMarquardt optimizer(1e-3, 1e-9, 6);
  evaluate(&chain);
  for (int iteration = 0; iteration < max_iterations; ++iteration) {
    const std::vector<Eigen::MatrixXd> bases = axis_bases(chain, holds_lengths);
    H.setZero();
    g.setZero();
    for (int t = 0; t < num_frames(); ++t) {
      predict(chain, t, &steps, &suffixes);
      const Matrix3d error = suffixes[0].transpose() * rotations_[t];
      for (int j = 0; j < m; ++j) {
        const double q = q_(chain.signals[j], t);
        J.middleCols(width * j, width).noalias() =
            suffixes[j + 1].transpose() * (q * right_jacobian_so3(chain.axes[j] * q)) * bases[j];
      }
      J.rightCols<3>().setIdentity();
      const double w = weight(squared_chord(error));
      H.selfadjointView<Eigen::Lower>().rankUpdate(J.transpose(), w);
      g.noalias() -= w * (J.transpose() * sine_axis(error));
    }
    H = Eigen::MatrixXd(H.selfadjointView<Eigen::Lower>());
    double decrease = 0;
    const bool improved = optimizer.step(H, g, [&](const Eigen::VectorXd& step) {
      ChainAxes moved = with_axes_moved(chain, bases, step, holds_lengths);
      moved.R_end = chain.R_end * exp_so3(step.tail<3>());
      if (!(evaluate(&moved) < chain.cost)) return false;
      decrease = chain.cost - moved.cost;
      chain = std::move(moved);
      return true;
    });
    if (!improved || decrease < 1e-6 * chain.cost + 1e-12) break;
    // Stuck far from a minimum that explains anything.
    if (iteration >= 12 && decrease < 1e-3 * chain.cost) break;
  }
  std::vector<double> angles;
  for (int t = 0; t < num_frames(); ++t) {
    predict(chain, t, &steps, &suffixes);
    const double chord = std::sqrt(squared_chord(suffixes[0].transpose() * rotations_[t]));
    angles.push_back(2 * std::asin(std::min(1.0, chord / 2)));
  }
  chain.median_left = angles.empty() ? 0 : upper_median(std::move(angles));
  return chain;
}

}  // namespace bodyschema
