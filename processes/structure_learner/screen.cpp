#include "processes/structure_learner/screen.h"

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <limits>
#include <tuple>

#include "common/estimation/quantile.h"
#include "common/estimation/student_t.h"

namespace bodyschema {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

constexpr int kStartFrames = 48;     // frames on which a start is judged
constexpr int kCoarseFrames = 16;    // frames on which a start is chosen among a few alike
constexpr int kRotationFrames = 56;  // frames of the eigenvector screen

Matrix3d rotation_z(double angle) {
  const double c = std::cos(angle), s = std::sin(angle);
  Matrix3d R;
  R << c, -s, 0, s, c, 0, 0, 0, 1;
  return R;
}

// A rotation whose third column is the unit vector `axis`.
Matrix3d frame_with_z(const Vector3d& axis) {
  Matrix3d R;
  R.col(2) = axis;
  R.col(0) = axis.unitOrthogonal();
  R.col(1) = R.col(2).cross(R.col(0));
  return R;
}

double median_or_zero(std::vector<double> values) {
  return values.empty() ? 0 : upper_median(std::move(values));
}

// How well a start fits an even subset of the frames.
Start judged(const LocalModel& model, const PairData& pair, const NormalizedActions& actions,
             int max_frames = kStartFrames) {
  Start start;
  start.model = model;
  const int n = std::min(pair.size(), max_frames);
  if (n == 0) return start;
  std::vector<double> squared(n);
  for (int k = 0; k < n; ++k) {
    const int t = static_cast<int>(static_cast<long>(k) * pair.size() / n);
    squared[k] =
        best_reading(pair, t, model.predict(actions, pair.frames[t].sample)).squared_distance;
    start.score += robust_cost(squared[k]) / n;
  }
  start.median = median_or_zero(std::move(squared));
  return start;
}

// R_t u = C (1, cos α_t, sin α_t): smallest eigenvector and robust score.
struct AxisFit {
  Vector3d axis = Vector3d::UnitZ();
  double score = std::numeric_limits<double>::infinity();
};

class AxisScreen {
 public:
  AxisScreen(std::vector<Matrix3d> rotations, std::vector<int> samples,
             std::vector<double> inverse_variances, const NormalizedActions& actions)
      : rotations_(std::move(rotations)),
        samples_(std::move(samples)),
        inverse_variances_(std::move(inverse_variances)),
        actions_(actions),
        phi_(rotations_.size()),
        weights_(rotations_.size()) {}

  AxisFit fit(int signal, double turn, int rounds) {
    const std::size_t n = rotations_.size();
    for (std::size_t t = 0; t < n; ++t) {
      const double angle = turn * actions_(samples_[t], signal);
      phi_[t] << 1, std::cos(angle), std::sin(angle);
    }
    weights_ = inverse_variances_;
    AxisFit result;
    for (int round = 0; round < rounds; ++round) {
      Matrix3d gram = Matrix3d::Zero();
      Eigen::Matrix<double, 3, 9> G = Eigen::Matrix<double, 3, 9>::Zero();
      double total = 0;
      for (std::size_t t = 0; t < n; ++t) {
        const double w = weights_[t];
        const Vector3d wphi = w * phi_[t];
        gram.noalias() += wphi * phi_[t].transpose();
        const Eigen::Map<const Eigen::Matrix<double, 1, 9>> r(rotations_[t].data());
        G.noalias() += wphi * r;
        total += w;
      }
      gram.diagonal().array() += 1e-9 * total;
      const Eigen::LLT<Matrix3d> llt(gram);
      const Eigen::Matrix<double, 3, 9> solved = llt.solve(G);  // Gram⁻¹ Σ w φ ⊗ R
      // M = Σ w RᵀR − Σ_l G_lᵀ (Gram⁻¹ G)_l, and RᵀR = 1.
      Matrix3d M = total * Matrix3d::Identity();
      for (int l = 0; l < 3; ++l) {
        const Eigen::Matrix<double, 1, 9> g_row = G.row(l), s_row = solved.row(l);
        const Eigen::Map<const Matrix3d> G_l(g_row.data()), S_l(s_row.data());
        M.noalias() -= G_l.transpose() * S_l;
      }
      M = (0.5 * (M + M.transpose())).eval();
      Eigen::SelfAdjointEigenSolver<Matrix3d> eigen;
      eigen.computeDirect(M);
      result.axis = eigen.eigenvectors().col(0);
      // C = (Σ w R u φᵀ) Gram⁻¹, column l from the l-th block of `solved`.
      Matrix3d C;
      for (int l = 0; l < 3; ++l) {
        const Eigen::Matrix<double, 1, 9> s_row = solved.row(l);
        C.col(l) = Eigen::Map<const Matrix3d>(s_row.data()) * result.axis;
      }
      double score = 0;
      for (std::size_t t = 0; t < n; ++t) {
        const double e2 =
            (rotations_[t] * result.axis - C * phi_[t]).squaredNorm() * inverse_variances_[t];
        weights_[t] = inverse_variances_[t] / (1 + e2 / 2);
        score += std::log1p(e2 / 2);
      }
      result.score = score / n;
    }
    return result;
  }

 private:
  std::vector<Matrix3d> rotations_;
  std::vector<int> samples_;
  std::vector<double> inverse_variances_;
  const NormalizedActions& actions_;
  std::vector<Vector3d> phi_;
  std::vector<double> weights_;
};

enum class JointType { kTurning, kSliding };

// What is known of a two-joint model before its translations.
struct RotationHypothesis {
  int a = 0, b = 0;
  JointType type_a = JointType::kTurning, type_b = JointType::kTurning;
  double turn_a = 0, turn_b = 0;
  Vector3d axis_a = Vector3d::UnitZ();  // v, in frame i
  Vector3d axis_b = Vector3d::UnitZ();  // u, in frame j
  double score = 0;
};

// Frames prepared for the closed-form starts.
struct StartFrames {
  std::vector<int> index;  // into pair.frames
  std::vector<int> sample;
  std::vector<Matrix3d> R;
  std::vector<Vector3d> p;
};

StartFrames start_frames(const PairData& pair, int max_frames) {
  StartFrames result;
  const int n = std::min(pair.size(), max_frames);
  for (int k = 0; k < n; ++k) {
    const int t = static_cast<int>(static_cast<long>(k) * pair.size() / n);
    result.index.push_back(t);
    result.sample.push_back(pair.frames[t].sample);
    result.R.push_back(pair.primary(t).z.linear());
    result.p.push_back(pair.primary(t).z.translation());
  }
  return result;
}

struct RotationAverage {
  Matrix3d R1 = Matrix3d::Identity();
  double score = std::numeric_limits<double>::infinity();
};

// R_1 from R_z(−α) R_0ᵀ R_t R_2ᵀ R_z(−β), robustly.
RotationAverage average_middle_rotation(const StartFrames& frames, const std::vector<double>& alpha,
                                        const std::vector<double>& beta, const Matrix3d& R0,
                                        const Matrix3d& R2, double sigma_rad) {
  const std::size_t n = frames.R.size();
  std::vector<Matrix3d> readings(n);
  for (std::size_t t = 0; t < n; ++t)
    readings[t] = rotation_z(-alpha[t]) * (R0.transpose() * frames.R[t] * R2.transpose()) *
                  rotation_z(-beta[t]);
  std::vector<double> weights(n, 1);
  RotationAverage result;
  for (int round = 0; round < 3; ++round) {
    Matrix3d sum = Matrix3d::Zero();
    for (std::size_t t = 0; t < n; ++t) sum += weights[t] * readings[t];
    const Eigen::JacobiSVD<Matrix3d> svd(sum, Eigen::ComputeFullU | Eigen::ComputeFullV);
    Vector3d d(1, 1, (svd.matrixU() * svd.matrixV().transpose()).determinant() < 0 ? -1 : 1);
    result.R1 = svd.matrixU() * d.asDiagonal() * svd.matrixV().transpose();
    result.score = 0;
    for (std::size_t t = 0; t < n; ++t) {
      // |R − R_1|² = 2 · angle² for small angles
      const double e2 = (readings[t] - result.R1).squaredNorm() / (2 * sigma_rad * sigma_rad);
      weights[t] = 1 / (1 + e2 / 3);
      result.score += std::log1p(e2 / 3);
    }
    result.score /= n;
  }
  return result;
}

// Completes a rotation hypothesis: signs, R_1, then p_t = t_0 + slide_a + R_a (t_1 + R_1 (slide_b +
// R_b t_2)) linear in the translations and slides.
Start complete_start(RotationHypothesis h, bool try_signs, const StartFrames& frames,
                     const PairData& pair, const NormalizedActions& actions,
                     const RelativeMotions& motions) {
  const std::size_t n = frames.R.size();
  const bool a_turns = h.type_a == JointType::kTurning;
  const bool b_turns = h.type_b == JointType::kTurning;
  const Matrix3d R0 = a_turns ? frame_with_z(h.axis_a) : Matrix3d(Matrix3d::Identity());
  const Matrix3d R2 =
      b_turns ? Matrix3d(frame_with_z(h.axis_b).transpose()) : Matrix3d(Matrix3d::Identity());
  std::vector<double> alpha(n), beta(n), best_alpha, best_beta;
  RotationAverage average;
  double best_turn_a = 0, best_turn_b = 0;
  for (int sign = 0; sign < (try_signs ? 4 : 1); ++sign) {
    const double turn_a = a_turns ? (sign & 1 ? -h.turn_a : h.turn_a) : 0;
    const double turn_b = b_turns ? (sign & 2 ? -h.turn_b : h.turn_b) : 0;
    for (std::size_t t = 0; t < n; ++t) {
      alpha[t] = turn_a * actions(frames.sample[t], h.a);
      beta[t] = turn_b * actions(frames.sample[t], h.b);
    }
    const RotationAverage candidate =
        average_middle_rotation(frames, alpha, beta, R0, R2, motions.sigma_rad);
    if (candidate.score < average.score) {
      average = candidate;
      best_turn_a = turn_a;
      best_turn_b = turn_b;
      best_alpha = alpha;
      best_beta = beta;
    }
  }
  const Matrix3d& R1 = average.R1;

  // Unknowns: t_0, t_1, t_2, slide of a (1 along its axis, or a free direction), slide of b.
  const int size_a = a_turns ? 1 : 3, size_b = b_turns ? 1 : 3;
  const int p = 9 + size_a + size_b;
  using Design = Eigen::Matrix<double, 3, Eigen::Dynamic, 0, 3, 15>;
  using Normal = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, 0, 15, 15>;
  using Unknowns = Eigen::Matrix<double, Eigen::Dynamic, 1, 0, 15, 1>;
  std::vector<Design> design(n);
  for (std::size_t t = 0; t < n; ++t) {
    const Matrix3d Ra = R0 * rotation_z(best_alpha[t]);
    const Matrix3d Ra1 = Ra * R1;
    const double qa = actions(frames.sample[t], h.a), qb = actions(frames.sample[t], h.b);
    Design& D = design[t];
    D.resize(3, p);
    D.leftCols<3>().setIdentity();
    D.middleCols<3>(3) = Ra;
    D.middleCols<3>(6) = Ra1 * rotation_z(best_beta[t]);
    if (a_turns)
      D.col(9) = qa * R0.col(2);
    else
      D.middleCols<3>(9) = qa * Matrix3d::Identity();
    if (b_turns)
      D.col(9 + size_a) = qb * Ra1.col(2);
    else
      D.middleCols<3>(9 + size_a) = qb * Ra1;
  }
  Unknowns x = Unknowns::Zero(p);
  std::vector<double> weights(n, 1);
  for (int round = 0; round < 3; ++round) {
    Normal H = Normal::Zero(p, p);
    Unknowns g = Unknowns::Zero(p);
    for (std::size_t t = 0; t < n; ++t) {
      H.noalias() += weights[t] * design[t].transpose() * design[t];
      g.noalias() += weights[t] * design[t].transpose() * frames.p[t];
    }
    // The translations along the axes are interchangeable: the ridge picks the shortest.
    H.diagonal().array() += 1e-8 * H.trace();
    x = H.ldlt().solve(g);
    for (std::size_t t = 0; t < n; ++t) {
      const double e2 =
          (frames.p[t] - design[t] * x).squaredNorm() / (motions.sigma_m * motions.sigma_m);
      weights[t] = 1 / (1 + e2 / 3);
    }
  }

  LocalModel model;
  model.num_joints = 2;
  model.signal = {h.a, h.b};
  model.turn = {best_turn_a, best_turn_b};
  // A sliding joint's frame was arbitrary until now: turn its z axis into the direction found.
  Matrix3d Za = Matrix3d::Identity(), Zb = Matrix3d::Identity();
  if (a_turns) {
    model.slide[0] = x(9);
  } else {
    const Vector3d direction = x.segment<3>(9);
    model.slide[0] = direction.norm();
    if (model.slide[0] > 0) Za = frame_with_z(direction / model.slide[0]);
  }
  if (b_turns) {
    model.slide[1] = x(9 + size_a);
  } else {
    const Vector3d direction = x.segment<3>(9 + size_a);
    model.slide[1] = direction.norm();
    if (model.slide[1] > 0) Zb = frame_with_z(direction / model.slide[1]);
  }
  model.A[0].linear() = R0 * Za;
  model.A[0].translation() = x.head<3>();
  model.A[1].linear() = Za.transpose() * R1 * Zb;
  model.A[1].translation() = Za.transpose() * x.segment<3>(3);
  model.A[2].linear() = Zb.transpose() * R2;
  model.A[2].translation() = Zb.transpose() * x.segment<3>(6);
  return judged(model, pair, actions);
}

// Two turning joints with general axes, best sums of the two one-sided scores first.
void general_hypotheses(const StartFrames& frames, const NormalizedActions& actions,
                        const RelativeMotions& motions,
                        const std::vector<std::vector<double>>& turns, int max_hypotheses,
                        std::vector<RotationHypothesis>* hypotheses) {
  std::vector<Matrix3d> transposed;
  for (const Matrix3d& R : frames.R) transposed.push_back(R.transpose());
  // Noise of R u seen from a rotation noise σ per axis: σ² in each of two directions.
  const std::vector<double> inverse_variance(frames.R.size(),
                                             1 / (motions.sigma_rad * motions.sigma_rad));
  AxisScreen screen_a(frames.R, frames.sample, inverse_variance, actions);
  AxisScreen screen_b(transposed, frames.sample, inverse_variance, actions);
  struct Side {
    AxisFit fit;
    double turn = 0;
  };
  const auto& moving = actions.moving();
  std::vector<Side> sides_a(moving.size()), sides_b(moving.size());
  // Of many signals only the promising ones are worth more than two rounds of re-weighting.
  constexpr int kRounds = 4;
  constexpr std::size_t kMaxSignals = 8;
  const bool many = moving.size() > kMaxSignals;
  const auto best_of_turns = [&](AxisScreen* screen, std::vector<Side>* sides) {
    for (std::size_t s = 0; s < moving.size(); ++s) {
      for (const double turn : turns[moving[s]]) {
        const AxisFit fit = screen->fit(moving[s], turn, many ? 2 : kRounds);
        if (fit.score < (*sides)[s].fit.score) (*sides)[s] = {fit, turn};
      }
    }
    if (!many) return;
    std::vector<double> scores;
    for (const Side& side : *sides) scores.push_back(side.fit.score);
    std::nth_element(scores.begin(), scores.begin() + kMaxSignals - 1, scores.end());
    for (std::size_t s = 0; s < moving.size(); ++s)
      if ((*sides)[s].fit.score <= scores[kMaxSignals - 1])
        (*sides)[s].fit = screen->fit(moving[s], (*sides)[s].turn, kRounds);
  };
  best_of_turns(&screen_a, &sides_a);
  best_of_turns(&screen_b, &sides_b);
  std::vector<RotationHypothesis> found;
  for (std::size_t s = 0; s < moving.size(); ++s) {
    for (std::size_t r = 0; r < moving.size(); ++r) {
      if (r == s) continue;
      RotationHypothesis h;
      h.a = moving[s];
      h.b = moving[r];
      h.turn_a = sides_a[s].turn;
      h.turn_b = sides_b[r].turn;
      h.axis_a = sides_b[r].fit.axis;  // v is what R_tᵀ leaves to b alone
      h.axis_b = sides_a[s].fit.axis;
      h.score = sides_a[s].fit.score + sides_b[r].fit.score;
      found.push_back(h);
    }
  }
  const std::size_t keep = std::min<std::size_t>(found.size(), max_hypotheses);
  std::partial_sort(found.begin(), found.begin() + keep, found.end(),
                    [](const auto& x, const auto& y) {
                      return std::tie(x.score, x.a, x.b) < std::tie(y.score, y.a, y.b);
                    });
  hypotheses->insert(hypotheses->end(), found.begin(), found.begin() + keep);
}

// All rotation about one fixed axis, or none at all.
void single_axis_hypotheses(const StartFrames& frames, const NormalizedActions& actions,
                            const RelativeMotions& motions,
                            std::vector<RotationHypothesis>* hypotheses) {
  // In units of variance of a relative motion; the median of χ²₂ is 1.4, of χ²₁ 0.45.
  constexpr double kGate = 8;
  const double variance = 2 * motions.sigma_rad * motions.sigma_rad;
  const auto& all = motions.motions;
  if (all.size() < 3) return;
  // Principal axis of the rotations, frames beyond the gate down-weighted.
  Vector3d u = Vector3d::UnitZ();
  std::vector<double> across(all.size(), 0), along(all.size(), 0), weights(all.size(), 1);
  for (int round = 0; round < 4; ++round) {
    Matrix3d M = Matrix3d::Zero();
    for (std::size_t n = 0; n < all.size(); ++n) {
      const Vector3d w = all[n].log.tail<3>();
      M.noalias() += weights[n] * w * w.transpose();
    }
    Eigen::SelfAdjointEigenSolver<Matrix3d> eigen;
    eigen.computeDirect(M);
    u = eigen.eigenvectors().col(2);
    for (std::size_t n = 0; n < all.size(); ++n) {
      const Vector3d w = all[n].log.tail<3>();
      along[n] = u.dot(w);
      across[n] = (w - along[n] * u).squaredNorm() / variance;
      weights[n] = 1 / (1 + across[n] / 2);
    }
  }
  if (median_or_zero(across) > kGate) return;
  const auto& moving = actions.moving();

  std::vector<double> squares;
  for (const double psi : along) squares.push_back(psi * psi / variance);
  if (median_or_zero(squares) < kGate) {
    for (std::size_t s = 0; s < moving.size(); ++s)
      for (std::size_t r = s + 1; r < moving.size(); ++r) {
        RotationHypothesis h;
        h.a = moving[s];
        h.b = moving[r];
        h.type_a = h.type_b = JointType::kSliding;
        hypotheses->push_back(h);
      }
    return;
  }

  Vector3d v = Vector3d::Zero();
  for (const Matrix3d& R : frames.R) v += R * u;
  if (v.norm() < 1e-6) return;
  v.normalize();

  // ψ = turn_a Δq_a + turn_b Δq_b by IRLS; both differences at most half the range, so that joints
  // up to a full turn do not wrap.
  const auto regress = [&](int a, int b, double* turn_a, double* turn_b) {
    double wa = 0, wb = 0;
    std::vector<double> squared(all.size());
    for (int round = 0; round < 6; ++round) {
      Eigen::Matrix2d H = Eigen::Matrix2d::Zero();
      Eigen::Vector2d g = Eigen::Vector2d::Zero();
      squared.clear();
      for (std::size_t n = 0; n < all.size(); ++n) {
        const double da = actions(all[n].sample_t, a) - actions(all[n].sample_s, a);
        const double db = b < 0 ? 0 : actions(all[n].sample_t, b) - actions(all[n].sample_s, b);
        if (std::abs(da) > 1 || std::abs(db) > 1) continue;
        const double e = along[n] - wa * da - wb * db;
        const double e2 = e * e / variance;
        squared.push_back(e2);
        const double w = round == 0 ? 1 : 1 / std::sqrt(1 + e2);
        H(0, 0) += w * da * da;
        H(0, 1) += w * da * db;
        H(1, 1) += w * db * db;
        g += w * along[n] * Eigen::Vector2d(da, db);
      }
      H(1, 0) = H(0, 1);
      H.diagonal().array() += 1e-9 * H.trace() + 1e-300;
      const Eigen::Vector2d x = H.ldlt().solve(g);
      wa = x(0);
      wb = x(1);
    }
    *turn_a = wa;
    *turn_b = wb;
    return squared.size() < 3 ? std::numeric_limits<double>::infinity() : median_or_zero(squared);
  };

  for (const int a : moving) {
    double turn, none;
    if (regress(a, -1, &turn, &none) > kGate) continue;
    for (const int b : moving) {
      if (b == a) continue;
      RotationHypothesis h;
      h.axis_a = v;
      h.axis_b = u;
      h.a = a;
      h.b = b;
      h.turn_a = turn;
      h.type_b = JointType::kSliding;
      hypotheses->push_back(h);
      h = RotationHypothesis{};
      h.axis_a = v;
      h.axis_b = u;
      h.a = b;
      h.b = a;
      h.turn_b = turn;
      h.type_a = JointType::kSliding;
      hypotheses->push_back(h);
    }
  }
  for (std::size_t s = 0; s < moving.size(); ++s) {
    for (std::size_t r = s + 1; r < moving.size(); ++r) {
      double turn_a, turn_b;
      if (regress(moving[s], moving[r], &turn_a, &turn_b) > kGate) continue;
      if (std::min(std::abs(turn_a), std::abs(turn_b)) < motions.sigma_rad / 4) continue;
      RotationHypothesis h;
      h.axis_a = v;
      h.axis_b = u;
      h.a = moving[s];
      h.b = moving[r];
      h.turn_a = turn_a;
      h.turn_b = turn_b;
      hypotheses->push_back(h);
      std::swap(h.a, h.b);
      std::swap(h.turn_a, h.turn_b);
      hypotheses->push_back(h);
    }
  }
}

}  // namespace

RelativeMotions relative_motions(const PairData& pair, int max_motions) {
  constexpr double kMaxAngle = 2.4;
  RelativeMotions result;
  const long n = pair.size();
  std::vector<double> variance_m, variance_rad;
  for (int t = 0; t < pair.size(); ++t) {
    // Σ_z = (W ᵀW)⁻¹; its diagonal from the inverse of the triangular W.
    const Matrix6d L =
        pair.primary(t).whitening.triangularView<Eigen::Lower>().solve(Matrix6d::Identity());
    variance_m.push_back(L.topRows<3>().squaredNorm() / 3);
    variance_rad.push_back(L.bottomRows<3>().squaredNorm() / 3);
    if (t >= kStartFrames) break;
  }
  if (n > 0) {
    result.sigma_m = std::sqrt(median_or_zero(variance_m));
    result.sigma_rad = std::sqrt(median_or_zero(variance_rad));
  }
  const long total = n * (n - 1) / 2;
  const long count = std::min<long>(total, max_motions);
  result.motions.reserve(count);
  long row = 0, row_start = 0;  // the k-th pair (s, t), s < t, in row order
  for (long m = 0; m < count; ++m) {
    const long k = m * total / count;
    while (k >= row_start + (n - 1 - row)) row_start += n - 1 - row++;
    const int s = static_cast<int>(row), t = static_cast<int>(row + 1 + k - row_start);
    const Vector6d xi = log(pair.primary(s).z.inverse() * pair.primary(t).z);
    if (xi.tail<3>().norm() > kMaxAngle) continue;
    result.motions.push_back({pair.frames[s].sample, pair.frames[t].sample, xi});
  }
  return result;
}

Start screen_rigid(const PairData& pair, const NormalizedActions& actions) {
  constexpr int kCandidates = 8;
  Start best;
  best.score = std::numeric_limits<double>::infinity();
  const int n = std::min(pair.size(), kCandidates);
  for (int k = 0; k < n; ++k) {
    LocalModel model;
    model.A[0] = pair.primary(static_cast<int>(static_cast<long>(k) * pair.size() / n)).z;
    const Start start = judged(model, pair, actions, kCoarseFrames);
    if (start.score < best.score) best = start;
  }
  return n > 0 ? judged(best.model, pair, actions) : best;
}

std::vector<ScrewRegression> screen_one_joint(const RelativeMotions& motions,
                                              const NormalizedActions& actions) {
  Vector6d scale;
  scale.head<3>().setConstant(1 / (std::sqrt(2.0) * motions.sigma_m));
  scale.tail<3>().setConstant(1 / (std::sqrt(2.0) * motions.sigma_rad));
  std::vector<Vector6d> scaled;
  scaled.reserve(motions.motions.size());
  for (const auto& motion : motions.motions) scaled.push_back(scale.cwiseProduct(motion.log));
  constexpr int kRounds = 6;
  constexpr std::size_t kMaxSignals = 8;  // worth more than a least squares fit
  std::vector<double> dq;
  std::vector<int> used;
  // `rounds` re-weightings, the first without weights.
  const auto regress = [&](int signal, int rounds) {
    dq.clear();
    used.clear();
    for (std::size_t n = 0; n < scaled.size(); ++n) {
      const auto& motion = motions.motions[n];
      const double d = actions(motion.sample_t, signal) - actions(motion.sample_s, signal);
      if (std::abs(d) > 1) continue;  // more than half the range may wrap around
      dq.push_back(d);
      used.push_back(static_cast<int>(n));
    }
    ScrewRegression regression;
    regression.signal = signal;
    regression.score = std::numeric_limits<double>::infinity();
    Vector6d slope = Vector6d::Zero();
    for (int round = 0; round <= rounds; ++round) {
      double sxx = 1e-12, score = 0;
      Vector6d sxy = Vector6d::Zero();
      for (std::size_t n = 0; n < used.size(); ++n) {
        const Vector6d& y = scaled[used[n]];
        const double root = std::sqrt(1 + (y - slope * dq[n]).squaredNorm());
        const double w = round == 0 ? 1 : 1 / root;
        sxx += w * dq[n] * dq[n];
        sxy += w * dq[n] * y;
        score += root;
      }
      if (round == rounds) {
        if (!used.empty()) regression.score = score / static_cast<double>(used.size());
        break;
      }
      slope = sxy / sxx;
    }
    regression.xi = slope.cwiseQuotient(scale);
    return regression;
  };
  const auto best_first = [](const auto& x, const auto& y) { return x.score < y.score; };
  std::vector<ScrewRegression> result;
  const bool many = actions.moving().size() > kMaxSignals;
  for (const int signal : actions.moving()) result.push_back(regress(signal, many ? 2 : kRounds));
  std::stable_sort(result.begin(), result.end(), best_first);
  if (many) {
    result.resize(kMaxSignals);
    for (ScrewRegression& r : result) r = regress(r.signal, kRounds);
    std::stable_sort(result.begin(), result.end(), best_first);
  }
  return result;
}

Start one_joint_start(const ScrewRegression& regression, const PairData& pair,
                      const NormalizedActions& actions, double sigma_rad) {
  // ξ q = X (ŝ q) X⁻¹: z of X along the screw axis, through the axis point nearest to frame j.
  const Vector3d v = regression.xi.head<3>(), w = regression.xi.tail<3>();
  LocalModel model;
  model.num_joints = 1;
  model.signal[0] = regression.signal;
  Pose X = Pose::Identity();
  if (w.norm() > 0.5 * sigma_rad && w.norm() > 1e-6) {
    const Vector3d axis = w.normalized();
    X.linear() = frame_with_z(axis);
    X.translation() = w.cross(v) / w.squaredNorm();
    model.turn[0] = w.norm();
    model.slide[0] = axis.dot(v);
  } else {
    // A turn below the noise would place the axis anywhere: begin as a sliding joint.
    if (v.norm() > 1e-12) X.linear() = frame_with_z(v.normalized());
    model.slide[0] = v.norm();
  }
  model.A[1] = X.inverse();
  Start best;
  best.score = std::numeric_limits<double>::infinity();
  constexpr int kCandidates = 6;
  const int n = std::min(pair.size(), kCandidates);
  for (int k = 0; k < n; ++k) {
    const int t = static_cast<int>(static_cast<long>(k) * pair.size() / n);
    const Vector6d back = -regression.xi * actions(pair.frames[t].sample, regression.signal);
    model.A[0] = pair.primary(t).z * exp(back) * X;
    const Start start = judged(model, pair, actions, kCoarseFrames);
    if (start.score < best.score) best = start;
  }
  return n > 0 ? judged(best.model, pair, actions) : best;
}

std::vector<double> default_turns() { return {kLeastTurn, 0.55, 0.9, 1.4, 2.0, 2.8}; }

std::vector<Start> screen_two_joints(const PairData& pair, const NormalizedActions& actions,
                                     const RelativeMotions& motions,
                                     const std::vector<std::vector<double>>& turns,
                                     int max_starts) {
  std::vector<Start> starts;
  if (pair.size() < 3 || actions.moving().size() < 2) return starts;
  const StartFrames frames = start_frames(pair, kRotationFrames);
  std::vector<RotationHypothesis> hypotheses;
  general_hypotheses(frames, actions, motions, turns, max_starts, &hypotheses);
  const std::size_t num_general = hypotheses.size();
  single_axis_hypotheses(frames, actions, motions, &hypotheses);
  for (std::size_t n = 0; n < hypotheses.size(); ++n)
    starts.push_back(
        complete_start(hypotheses[n], n < num_general, frames, pair, actions, motions));
  std::stable_sort(starts.begin(), starts.end(),
                   [](const Start& x, const Start& y) { return x.score < y.score; });
  if (static_cast<int>(starts.size()) > max_starts) starts.resize(max_starts);
  return starts;
}

}  // namespace bodyschema
