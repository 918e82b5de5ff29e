#include "processes/structure_learner/turn_scan.h"

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>

#include "common/estimation/quantile.h"
#include "processes/structure_learner/placed_screw.h"

namespace bodyschema {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;
using Phasors = std::vector<std::complex<double>>;

constexpr int kRotationFrames = 56;
constexpr double kFineStep = 0.05;  // a scan's second pass

// e^{−iwq}, by frame.
Phasors phasors_of(const NormalizedActions& actions, const std::vector<int>& samples, int signal,
                   double turn) {
  Phasors result;
  result.reserve(samples.size());
  for (const int sample : samples)
    result.push_back(std::polar(1.0, -turn * actions(sample, signal)));
  return result;
}

std::vector<double> turns_around(double centre, double reach, double step) {
  std::vector<double> turns;
  const int n = static_cast<int>(std::lround(reach / step));
  for (int k = -n; k <= n; ++k) turns.push_back(centre + k * step);
  return turns;
}

// p_t = t_0 + R_t,a t_1 + slide · q_t · axis, robustly: the translations of a single joint.
void fit_translations(const StartFrames& frames, const NormalizedActions& actions, double sigma_m,
                      LocalModel* model) {
  using Unknowns = Eigen::Matrix<double, 7, 1>;
  LocalModel::Joint& joint = model->joints[0];
  const Matrix3d R0 = model->first.linear();
  std::vector<Eigen::Matrix<double, 3, 7>> design(frames.p.size());
  for (std::size_t t = 0; t < design.size(); ++t) {
    const double q = actions(frames.sample[t], joint.signal);
    design[t] << Matrix3d::Identity(),
        R0 * Eigen::AngleAxisd(joint.turn * q, Vector3d::UnitZ()).toRotationMatrix(), q * R0.col(2);
  }
  std::vector<double> weights(design.size(), 1);
  Unknowns x = Unknowns::Zero();
  for (int round = 0; round < 6; ++round) {
    Eigen::Matrix<double, 7, 7> H = Eigen::Matrix<double, 7, 7>::Zero();
    Unknowns g = Unknowns::Zero();
    for (std::size_t t = 0; t < design.size(); ++t) {
      H.noalias() += weights[t] * design[t].transpose() * design[t];
      g.noalias() += weights[t] * design[t].transpose() * frames.p[t];
    }
    // The translations along the axis are interchangeable: the ridge picks the shortest.
    H.diagonal().array() += 1e-8 * H.trace();
    x = H.ldlt().solve(g);
    for (std::size_t t = 0; t < design.size(); ++t)
      weights[t] =
          1 / std::sqrt(1 + (frames.p[t] - design[t] * x).squaredNorm() / (sigma_m * sigma_m));
  }
  model->first.translation() = x.head<3>();
  joint.X_after.translation() = x.segment<3>(3);
  joint.slide = x(6);
}

}  // namespace

StartFrames start_frames(const PairData& pair) {
  StartFrames result;
  const int n = std::min(pair.size(), kRotationFrames);
  for (int k = 0; k < n; ++k) {
    const int t = static_cast<int>(static_cast<long>(k) * pair.size() / n);
    result.sample.push_back(pair.frames[t].sample);
    result.R.push_back(pair.primary(t).z.linear());
    result.p.push_back(pair.primary(t).z.translation());
  }
  return result;
}

PrincipalAxis principal_axis(const RelativeMotions& motions, double variance) {
  const auto& all = motions.motions;
  PrincipalAxis result;
  result.along.resize(all.size());
  result.across.resize(all.size());
  std::vector<double> weights(all.size(), 1);
  for (int round = 0; round < 4; ++round) {
    Matrix3d M = Matrix3d::Zero();
    for (std::size_t n = 0; n < all.size(); ++n) {
      const Vector3d w = all[n].log.tail<3>();
      M.noalias() += weights[n] * w * w.transpose();
    }
    Eigen::SelfAdjointEigenSolver<Matrix3d> eigen;
    eigen.computeDirect(M);
    const Vector3d u = result.axis = eigen.eigenvectors().col(2);
    for (std::size_t n = 0; n < all.size(); ++n) {
      const Vector3d w = all[n].log.tail<3>();
      result.along[n] = u.dot(w);
      result.across[n] = (w - result.along[n] * u).squaredNorm() / variance;
      weights[n] = 1 / (1 + result.across[n] / 2);
    }
  }
  return result;
}

AnglesAboutAxis::AnglesAboutAxis(const StartFrames& frames, const Vector3d& axis)
    : samples_(frames.sample) {
  Vector3d seen = Vector3d::Zero();  // the axis in frame i
  for (const Matrix3d& R : frames.R) seen += R * axis;
  before_ = frame_with_z(seen.norm() > 1e-9 ? seen.normalized().eval() : Vector3d::UnitZ().eval());
  after_ = frame_with_z(axis).transpose();
  for (const Matrix3d& R : frames.R) {
    const Matrix3d about_z = before_.transpose() * R * after_.transpose();
    phasors_.emplace_back(0.5 * (about_z(0, 0) + about_z(1, 1)),
                          0.5 * (about_z(1, 0) - about_z(0, 1)));
  }
}

AnglesAboutAxis::Turns AnglesAboutAxis::scan(const NormalizedActions& actions, int a, int b) const {
  // Two maxima nearer than this are one: a phase of π over the range.
  constexpr double kResolution = 2;
  constexpr double kRivalShare = 0.95;
  const std::size_t n = samples_.size();
  Turns best;
  double rival = 0;
  const auto sweep = [&](const std::vector<double>& turns_a, const std::vector<double>& turns_b,
                         bool with_rivals) {
    std::vector<Phasors> of_b;
    for (const double turn : turns_b)
      of_b.push_back(b < 0 ? Phasors(n, 1.0) : phasors_of(actions, samples_, b, turn));
    std::vector<Turns> found;
    // The turns of a are evenly spaced: from one to the next is the same phase.
    Phasors rest = phasors_of(actions, samples_, a, turns_a.front());
    const Phasors next = phasors_of(actions, samples_, a, turns_a[1] - turns_a[0]);
    for (std::size_t t = 0; t < n; ++t) rest[t] *= phasors_[t];
    for (const double turn_a : turns_a) {
      if (turn_a != turns_a.front())
        for (std::size_t t = 0; t < n; ++t) rest[t] *= next[t];
      for (std::size_t k = 0; k < turns_b.size(); ++k) {
        std::complex<double> sum = 0;
        for (std::size_t t = 0; t < n; ++t) sum += rest[t] * of_b[k][t];
        sum /= static_cast<double>(n);
        found.push_back({turn_a, turns_b[k], std::arg(sum), std::abs(sum)});
      }
    }
    for (const Turns& turns : found)
      if (turns.power > best.power) best = turns;
    if (!with_rivals) return;
    for (const Turns& turns : found)
      if (std::hypot(turns.a - best.a, turns.b - best.b) > kResolution)
        rival = std::max(rival, turns.power);
  };
  if (n == 0) return best;
  const std::vector<double> none{0};
  const bool is_wide = b < 0 && n >= kFewestWideScanFrames;
  const std::vector<double> all = turns_around(0, is_wide ? kMostTurnOfOne : kMostTurn, kTurnStep);
  sweep(all, b < 0 ? none : all, true);
  const double coarse = best.power;
  for (const double step : {kTurnStep / 4, kFineStep})
    sweep(turns_around(best.a, 2 * step, step), b < 0 ? none : turns_around(best.b, 2 * step, step),
          false);
  if (rival > kRivalShare * coarse) best.power = 0;
  return best;
}

std::vector<Start> screen_wide_joint(const PairData& pair, const NormalizedActions& actions,
                                     const RelativeMotions& motions) {
  constexpr std::size_t kMaxStarts = 3;
  std::vector<Start> starts;
  if (pair.size() < kFewestScanFrames || motions.motions.size() < 3) return starts;
  const PrincipalAxis principal =
      principal_axis(motions, 2 * motions.sigma_rad * motions.sigma_rad);
  if (upper_median(principal.across) > kAxisGate) return starts;
  const StartFrames frames = start_frames(pair);
  const AnglesAboutAxis angles(frames, principal.axis);
  for (const int signal : actions.moving()) {
    const AnglesAboutAxis::Turns turns = angles.scan(actions, signal, -1);
    if (turns.power < kLeastScanPower) continue;
    LocalModel model;
    model.first.linear() = angles.before();
    model.joints = {{.signal = signal, .turn = turns.a}};
    model.joints[0].X_after.linear() =
        Eigen::AngleAxisd(turns.phase, Vector3d::UnitZ()).toRotationMatrix() * angles.after();
    fit_translations(frames, actions, motions.sigma_m, &model);
    starts.push_back(judged_start(model, pair, actions));
  }
  std::stable_sort(starts.begin(), starts.end(),
                   [](const Start& x, const Start& y) { return x.score < y.score; });
  if (starts.size() > kMaxStarts) starts.resize(kMaxStarts);
  return starts;
}

}  // namespace bodyschema
