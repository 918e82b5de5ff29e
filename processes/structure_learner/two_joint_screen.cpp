#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <Eigen/SVD>
#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <tuple>
#include <utility>

#include "common/estimation/quantile.h"
#include "processes/structure_learner/axis_screen.h"
#include "processes/structure_learner/placed_screw.h"
#include "processes/structure_learner/screen.h"
#include "processes/structure_learner/turn_scan.h"

namespace bodyschema {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

enum class JointType { kTurning, kSliding };

// A model with the joints a and b, R_t = R_0 R_z(α) R_1 R_z(β) R_2, before its translations are
// known.
struct RotationHypothesis {
  int a = 0, b = 0;
  JointType type_a = JointType::kTurning, type_b = JointType::kTurning;
  double turn_a = 0, turn_b = 0;        // [rad per half range]
  Vector3d axis_a = Vector3d::UnitZ();  // v, in frame i
  Vector3d axis_b = Vector3d::UnitZ();  // u, in frame j
  double score = 0;
};

// One side of a two-joint model: the best axis for each signal, and the turn it was found at.
struct Side {
  AxisFit fit;
  double turn = 0;
};

// By moving signal.
std::vector<Side> best_of_turns(AxisScreen screen, const NormalizedActions& actions,
                                const std::vector<std::vector<double>>& turns) {
  // Only the promising ones of many signals are worth more than two rounds of re-weighting.
  constexpr int kRounds = 4;
  constexpr std::size_t kMaxSignals = 8;
  const std::vector<int>& moving = actions.moving();
  const bool many = moving.size() > kMaxSignals;
  std::vector<Side> sides(moving.size());
  for (std::size_t s = 0; s < moving.size(); ++s) {
    for (const double turn : turns[moving[s]]) {
      const AxisFit fit = screen.fit(moving[s], turn, many ? 2 : kRounds);
      if (fit.score < sides[s].fit.score) sides[s] = {fit, turn};
    }
  }
  if (!many) return sides;
  std::vector<double> scores;
  for (const Side& side : sides) scores.push_back(side.fit.score);
  std::nth_element(scores.begin(), scores.begin() + kMaxSignals - 1, scores.end());
  for (std::size_t s = 0; s < moving.size(); ++s)
    if (sides[s].fit.score <= scores[kMaxSignals - 1])
      sides[s].fit = screen.fit(moving[s], sides[s].turn, kRounds);
  return sides;
}

struct TurnRegression {
  double turn_a = 0, turn_b = 0;
  double median = std::numeric_limits<double>::infinity();  // of the squared errors
};

// along = turn_a Δq_a + turn_b Δq_b by IRLS; both differences at most half the range, so that
// joints up to a full turn do not wrap. b = −1: a alone.
TurnRegression regress(const RelativeMotions& motions, const std::vector<double>& along,
                       const NormalizedActions& actions, int a, int b, double variance) {
  const auto& all = motions.motions;
  TurnRegression result;
  std::vector<double> squared(all.size());
  for (int round = 0; round < 6; ++round) {
    Eigen::Matrix2d H = Eigen::Matrix2d::Zero();
    Eigen::Vector2d g = Eigen::Vector2d::Zero();
    squared.clear();
    for (std::size_t n = 0; n < all.size(); ++n) {
      const double da = actions(all[n].sample_t, a) - actions(all[n].sample_s, a);
      const double db = b < 0 ? 0 : actions(all[n].sample_t, b) - actions(all[n].sample_s, b);
      if (std::abs(da) > 1 || std::abs(db) > 1) continue;
      const double e = along[n] - result.turn_a * da - result.turn_b * db;
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
    result.turn_a = x(0);
    result.turn_b = x(1);
  }
  if (squared.size() >= 3) result.median = upper_median(std::move(squared));
  return result;
}

void add_in_both_orders(RotationHypothesis h, std::vector<RotationHypothesis>* hypotheses) {
  hypotheses->push_back(h);
  std::swap(h.a, h.b);
  std::swap(h.turn_a, h.turn_b);
  std::swap(h.type_a, h.type_b);
  hypotheses->push_back(h);
}

// Two turning joints with general axes, best sums of the two one-sided scores first. Without the
// signs of the turns.
std::vector<RotationHypothesis> general_hypotheses(const StartFrames& frames,
                                                   const NormalizedActions& actions,
                                                   double sigma_rad,
                                                   const std::vector<std::vector<double>>& turns,
                                                   int max_hypotheses) {
  std::vector<Matrix3d> transposed;
  for (const Matrix3d& R : frames.R) transposed.push_back(R.transpose());
  const auto sides_a =
      best_of_turns(AxisScreen(frames.R, frames.sample, sigma_rad, actions), actions, turns);
  const auto sides_b =
      best_of_turns(AxisScreen(transposed, frames.sample, sigma_rad, actions), actions, turns);
  const std::vector<int>& moving = actions.moving();
  std::vector<RotationHypothesis> found;
  for (std::size_t s = 0; s < moving.size(); ++s) {
    for (std::size_t r = 0; r < moving.size(); ++r) {
      if (r == s) continue;
      RotationHypothesis& h = found.emplace_back();
      h.a = moving[s];
      h.b = moving[r];
      h.turn_a = sides_a[s].turn;
      h.turn_b = sides_b[r].turn;
      h.axis_a = sides_b[r].fit.axis;  // v is what R_tᵀ leaves to b alone
      h.axis_b = sides_a[s].fit.axis;
      h.score = sides_a[s].fit.score + sides_b[r].fit.score;
    }
  }
  const std::size_t keep = std::min<std::size_t>(found.size(), max_hypotheses);
  std::partial_sort(found.begin(), found.begin() + static_cast<std::ptrdiff_t>(keep), found.end(),
                    [](const auto& x, const auto& y) {
                      return std::tie(x.score, x.a, x.b) < std::tie(y.score, y.a, y.b);
                    });
  found.resize(keep);
  return found;
}

void add_sliding_pairs(const std::vector<int>& moving,
                       std::vector<RotationHypothesis>* hypotheses) {
  for (std::size_t s = 0; s < moving.size(); ++s)
    for (std::size_t r = s + 1; r < moving.size(); ++r)
      hypotheses->push_back({moving[s], moving[r], JointType::kSliding, JointType::kSliding});
}

bool hardly_turns(const PrincipalAxis& principal, double variance) {
  std::vector<double> squares;
  for (const double psi : principal.along) squares.push_back(psi * psi / variance);
  return upper_median(std::move(squares)) < kAxisGate;
}

// All rotation about one fixed axis: parallel turning joints, or a turning and a sliding one in
// either order. None at all: two sliding joints.
std::vector<RotationHypothesis> single_axis_hypotheses(const StartFrames& frames,
                                                       const NormalizedActions& actions,
                                                       const RelativeMotions& motions,
                                                       bool is_wide) {
  std::vector<RotationHypothesis> hypotheses;
  if (motions.motions.size() < 3) return hypotheses;
  const double variance = 2 * motions.sigma_rad * motions.sigma_rad;
  const PrincipalAxis principal = principal_axis(motions, variance);
  if (upper_median(principal.across) > kAxisGate) return hypotheses;
  const std::vector<int>& moving = actions.moving();

  RotationHypothesis h;
  if (hardly_turns(principal, variance)) {
    add_sliding_pairs(moving, &hypotheses);
    return hypotheses;
  }

  Vector3d v = Vector3d::Zero();
  for (const Matrix3d& R : frames.R) v += R * principal.axis;
  if (v.norm() < 1e-6) return hypotheses;
  h.axis_a = v.normalized();
  h.axis_b = principal.axis;
  // (turn of a, turn of b) that explain the angles, if any do.
  const AnglesAboutAxis angles(frames, principal.axis);
  const auto turns_of = [&](int a, int b) -> std::optional<std::pair<double, double>> {
    if (is_wide) {
      const AnglesAboutAxis::Turns turns = angles.scan(actions, a, b);
      if (turns.power < kLeastScanPower) return std::nullopt;
      return std::pair(turns.a, turns.b);
    }
    const TurnRegression turns = regress(motions, principal.along, actions, a, b, variance);
    if (turns.median > kAxisGate) return std::nullopt;
    return std::pair(turns.turn_a, turns.turn_b);
  };
  h.type_b = JointType::kSliding;
  for (const int a : moving) {
    const auto one = turns_of(a, -1);
    if (!one) continue;
    h.a = a;
    h.turn_a = one->first;
    for (const int b : moving) {
      h.b = b;
      if (b != a) add_in_both_orders(h, &hypotheses);
    }
  }
  h.type_b = JointType::kTurning;
  for (std::size_t s = 0; s < moving.size(); ++s) {
    for (std::size_t r = s + 1; r < moving.size(); ++r) {
      const auto two = turns_of(moving[s], moving[r]);
      if (!two || std::min(std::abs(two->first), std::abs(two->second)) < motions.sigma_rad / 4)
        continue;
      h.a = moving[s];
      h.b = moving[r];
      std::tie(h.turn_a, h.turn_b) = *two;
      add_in_both_orders(h, &hypotheses);
    }
  }
  return hypotheses;
}

Matrix3d rotation_z(double angle) {
  const double c = std::cos(angle), s = std::sin(angle);
  Matrix3d R;
  R << c, -s, 0, s, c, 0, 0, 0, 1;
  return R;
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

struct Rotations {
  Matrix3d R0 = Matrix3d::Identity(), R1 = Matrix3d::Identity(), R2 = Matrix3d::Identity();
  double turn_a = 0, turn_b = 0;
  std::vector<double> alpha, beta;  // by frame
};

// With the signs of the turns that leave least.
Rotations fit_rotations(const RotationHypothesis& h, bool try_signs, const StartFrames& frames,
                        const NormalizedActions& actions, double sigma_rad) {
  const std::size_t n = frames.R.size();
  const bool a_turns = h.type_a == JointType::kTurning;
  const bool b_turns = h.type_b == JointType::kTurning;
  Rotations best;
  if (a_turns) best.R0 = frame_with_z(h.axis_a);
  if (b_turns) best.R2 = frame_with_z(h.axis_b).transpose();
  double best_score = std::numeric_limits<double>::infinity();
  std::vector<double> alpha(n), beta(n);
  for (int sign = 0; sign < (try_signs ? 4 : 1); ++sign) {
    const double turn_a = a_turns ? (sign & 1 ? -h.turn_a : h.turn_a) : 0;
    const double turn_b = b_turns ? (sign & 2 ? -h.turn_b : h.turn_b) : 0;
    for (std::size_t t = 0; t < n; ++t) {
      alpha[t] = turn_a * actions(frames.sample[t], h.a);
      beta[t] = turn_b * actions(frames.sample[t], h.b);
    }
    const RotationAverage average =
        average_middle_rotation(frames, alpha, beta, best.R0, best.R2, sigma_rad);
    if (!(average.score < best_score)) continue;
    best_score = average.score;
    best = {best.R0, average.R1, best.R2, turn_a, turn_b, alpha, beta};
  }
  return best;
}

// Unknowns: t_0, t_1, t_2, slide of a (1 along its axis, or a free direction), slide of b.
constexpr int kMostUnknowns = 15;
using Design = Eigen::Matrix<double, 3, Eigen::Dynamic, 0, 3, kMostUnknowns>;
using Normal =
    Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, 0, kMostUnknowns, kMostUnknowns>;
using Unknowns = Eigen::Matrix<double, Eigen::Dynamic, 1, 0, kMostUnknowns, 1>;

int slide_size(JointType type) { return type == JointType::kTurning ? 1 : 3; }

std::vector<Design> make_design(const RotationHypothesis& h, const Rotations& rotations,
                                const StartFrames& frames, const NormalizedActions& actions) {
  const int slide_b = 9 + slide_size(h.type_a);
  std::vector<Design> design(frames.R.size());
  for (std::size_t t = 0; t < design.size(); ++t) {
    const Matrix3d Ra = rotations.R0 * rotation_z(rotations.alpha[t]);
    const Matrix3d Ra1 = Ra * rotations.R1;
    const double qa = actions(frames.sample[t], h.a), qb = actions(frames.sample[t], h.b);
    Design& D = design[t];
    D.resize(3, slide_b + slide_size(h.type_b));
    D.leftCols<3>().setIdentity();
    D.middleCols<3>(3) = Ra;
    D.middleCols<3>(6) = Ra1 * rotation_z(rotations.beta[t]);
    if (h.type_a == JointType::kTurning)
      D.col(9) = qa * rotations.R0.col(2);
    else
      D.middleCols<3>(9) = qa * Matrix3d::Identity();
    if (h.type_b == JointType::kTurning)
      D.col(slide_b) = qb * Ra1.col(2);
    else
      D.middleCols<3>(slide_b) = qb * Ra1;
  }
  return design;
}

Unknowns solve(const std::vector<Design>& design, const std::vector<Vector3d>& p, double sigma_m) {
  const auto size = design.front().cols();
  Unknowns x = Unknowns::Zero(size);
  std::vector<double> weights(design.size(), 1);
  for (int round = 0; round < 3; ++round) {
    Normal H = Normal::Zero(size, size);
    Unknowns g = Unknowns::Zero(size);
    for (std::size_t t = 0; t < design.size(); ++t) {
      H.noalias() += weights[t] * design[t].transpose() * design[t];
      g.noalias() += weights[t] * design[t].transpose() * p[t];
    }
    // The translations along the axes are interchangeable: the ridge picks the shortest.
    H.diagonal().array() += 1e-8 * H.trace();
    x = H.ldlt().solve(g);
    for (std::size_t t = 0; t < design.size(); ++t) {
      const double e2 = (p[t] - design[t] * x).squaredNorm() / (sigma_m * sigma_m);
      weights[t] = 1 / (1 + e2 / 3);
    }
  }
  return x;
}

// The signs of its turns if `try_signs`, R_1 by averaging, then p_t = t_0 + slide_a + R_a (t_1 +
// R_1 (slide_b + R_b t_2)), linear in the translations and slides.
LocalModel complete_start(const RotationHypothesis& hypothesis, bool try_signs,
                          const StartFrames& frames, const NormalizedActions& actions,
                          const RelativeMotions& motions) {
  const Rotations rotations =
      fit_rotations(hypothesis, try_signs, frames, actions, motions.sigma_rad);
  const Unknowns x =
      solve(make_design(hypothesis, rotations, frames, actions), frames.p, motions.sigma_m);
  LocalModel model;
  model.joints = {{.signal = hypothesis.a, .turn = rotations.turn_a},
                  {.signal = hypothesis.b, .turn = rotations.turn_b}};
  // A sliding joint's frame was arbitrary until now: its z axis turns into the direction found.
  const auto take_slide = [&](int d, JointType type, Eigen::Index at) -> Matrix3d {
    if (type == JointType::kTurning) {
      model.joints[d].slide = x(at);
      return Matrix3d::Identity();
    }
    const Vector3d direction = x.segment<3>(at);
    model.joints[d].slide = direction.norm();
    if (!(model.joints[d].slide > 0)) return Matrix3d::Identity();
    return frame_with_z(direction / model.joints[d].slide);
  };
  const Matrix3d Za = take_slide(0, hypothesis.type_a, 9);
  const Matrix3d Zb = take_slide(1, hypothesis.type_b, 9 + slide_size(hypothesis.type_a));
  model.first.linear() = rotations.R0 * Za;
  model.first.translation() = x.head<3>();
  model.joints[0].X_after.linear() = Za.transpose() * rotations.R1 * Zb;
  model.joints[0].X_after.translation() = Za.transpose() * x.segment<3>(3);
  model.joints[1].X_after.linear() = Zb.transpose() * rotations.R2;
  model.joints[1].X_after.translation() = Zb.transpose() * x.segment<3>(6);
  return model;
}

}  // namespace

std::vector<Start> screen_two_joints(const PairData& pair, const NormalizedActions& actions,
                                     const RelativeMotions& motions,
                                     const std::vector<std::vector<double>>& turns,
                                     int max_starts) {
  std::vector<Start> starts;
  if (pair.size() < 3 || actions.moving().size() < 2) return starts;
  const StartFrames frames = start_frames(pair);
  const bool is_wide = std::any_of(turns.begin(), turns.end(), [](const auto& of_signal) {
    return of_signal.size() > 1 && *std::max_element(of_signal.begin(), of_signal.end()) > M_PI;
  });
  const auto add = [&](const RotationHypothesis& h, bool try_signs) {
    starts.push_back(
        judged_start(complete_start(h, try_signs, frames, actions, motions), pair, actions));
  };
  for (const RotationHypothesis& h :
       general_hypotheses(frames, actions, motions.sigma_rad, turns, max_starts))
    add(h, true);
  for (const RotationHypothesis& h : single_axis_hypotheses(frames, actions, motions, is_wide))
    add(h, false);
  std::stable_sort(starts.begin(), starts.end(),
                   [](const Start& x, const Start& y) { return x.score < y.score; });
  if (static_cast<int>(starts.size()) > max_starts) starts.resize(max_starts);
  return starts;
}

}  // namespace bodyschema
