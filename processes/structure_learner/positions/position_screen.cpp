#include "processes/structure_learner/positions/position_screen.h"

#include <Eigen/Cholesky>
#include <Eigen/SVD>
#include <algorithm>
#include <array>
#include <cmath>

#include "common/estimation/quantile.h"
#include "processes/structure_learner/placed_screw.h"

namespace bodyschema {
namespace {

constexpr int kScreenFrames = 80;
constexpr std::size_t kKeptOfSignals = 3;  // turns that are tried of two signals in one order

/// A joint by its signal and turn; a turn of 0 slides.
struct Driver {
  int signal = 0;
  double turn = 0;

  int size() const { return turn > 0 ? 3 : 2; }
  /// 1, cos, sin or 1, q.
  Eigen::Vector3d at(double q) const {
    return turn > 0 ? Eigen::Vector3d(1, std::cos(turn * q), std::sin(turn * q))
                    : Eigen::Vector3d(1, q, 0);
  }
};

struct Points {
  Eigen::Matrix<double, Eigen::Dynamic, 3> positions;
  std::vector<int> samples;
};

Points points_of(const PairData& pair) {
  const int n = std::min(pair.size(), kScreenFrames);
  Points points;
  points.positions.resize(n, 3);
  for (int k = 0; k < n; ++k) {
    const int t = static_cast<int>(static_cast<long>(k) * pair.size() / n);
    points.positions.row(k) = pair.primary(t).z.translation();
    points.samples.push_back(pair.frames[t].sample);
  }
  return points;
}

/// Least squares of y = F x with a little of a ridge; rows come in groups of `group`. Re-weighted
/// `rounds` times by 1/distance, so that outliers hardly count.
Eigen::MatrixXd regressed(const Eigen::MatrixXd& F, const Eigen::MatrixXd& y, int rounds,
                          int group = 1) {
  Eigen::VectorXd weights = Eigen::VectorXd::Ones(F.rows());
  Eigen::MatrixXd x;
  for (int round = 0;; ++round) {
    Eigen::MatrixXd H = F.transpose() * weights.asDiagonal() * F;
    H.diagonal().array() += 1e-9 * std::max(H.diagonal().maxCoeff(), 1e-300);
    x = H.ldlt().solve(F.transpose() * weights.asDiagonal() * y);
    if (round == rounds) return x;
    const Eigen::MatrixXd r = y - F * x;
    std::vector<double> distances;
    for (Eigen::Index n = 0; n < r.rows(); n += group)
      distances.push_back(r.middleRows(n, group).norm());
    const double typical = std::max(upper_median(distances), 1e-9);
    for (Eigen::Index n = 0; n < r.rows(); ++n)
      weights(n) = 1 / (1 + std::pow(distances[static_cast<std::size_t>(n / group)] / typical, 2));
  }
}

double median_residual(const Eigen::MatrixXd& F, const Points& points) {
  const Eigen::MatrixXd r = points.positions - F * regressed(F, points.positions, 1);
  std::vector<double> distances;
  for (Eigen::Index n = 0; n < r.rows(); ++n) distances.push_back(r.row(n).norm());
  // What degrees of freedom are spent is no evidence.
  const double left = std::max<double>(static_cast<double>(F.rows() - F.cols()), 0.5);
  return upper_median(std::move(distances)) * std::sqrt(static_cast<double>(F.rows()) / left);
}

/// The end of a joint at `origin` whose motion is origin + Σ_b g_b φ_b: its frame, its screw and
/// the position of part j in it.
struct LastJoint {
  Pose X = Pose::Identity();
  LocalModel::Joint joint;
};
LastJoint last_joint(const Driver& driver, const Eigen::Vector3d& origin,
                     const Eigen::Matrix3Xd& g) {
  LastJoint last;
  last.X.translation() = origin;
  last.joint.signal = driver.signal;
  if (driver.turn > 0) {
    const Eigen::Vector3d v = g.col(0), w = g.col(1);
    const Eigen::Vector3d normal = v.cross(w);
    const double radius = 0.5 * (v.norm() + w.norm());
    last.joint.turn = driver.turn;
    if (normal.norm() > 1e-12) {
      last.X.linear().col(2) = normal.normalized();
      last.X.linear().col(0) = v.normalized();
      last.X.linear().col(1) = last.X.linear().col(2).cross(last.X.linear().col(0));
    }
    last.joint.X_after.translation().x() = radius;
  } else {
    const double slide = g.col(0).norm();
    if (slide > 1e-12) last.X.linear() = frame_with_z(g.col(0) / slide);
    last.joint.slide = slide;
    last.joint.slides = true;
  }
  return last;
}

LocalModel one_joint(const Driver& driver, const Points& points, const NormalizedActions& actions) {
  Eigen::MatrixXd F(points.positions.rows(), driver.size());
  for (Eigen::Index n = 0; n < F.rows(); ++n)
    F.row(n) = driver.at(actions(points.samples[static_cast<std::size_t>(n)], driver.signal))
                   .head(driver.size());
  const Eigen::Matrix3Xd g = regressed(F, points.positions, 4).transpose();
  const LastJoint last = last_joint(driver, g.col(0), g.rightCols(g.cols() - 1));
  LocalModel model;
  model.first = last.X;
  model.joints = {last.joint};
  return model;
}

Eigen::MatrixXd products(const Driver& a, const Driver& b, const Points& points,
                         const NormalizedActions& actions) {
  // Two slides have no product.
  const bool is_sum = a.turn == 0 && b.turn == 0;
  Eigen::MatrixXd F(points.positions.rows(), is_sum ? 3 : a.size() * b.size());
  for (Eigen::Index n = 0; n < F.rows(); ++n) {
    const int sample = points.samples[static_cast<std::size_t>(n)];
    const Eigen::Vector3d f = a.at(actions(sample, a.signal)), g = b.at(actions(sample, b.signal));
    if (is_sum) {
      F.row(n) << 1, f(1), g(1);
      continue;
    }
    for (int i = 0; i < a.size(); ++i)
      for (int j = 0; j < b.size(); ++j) F(n, i * b.size() + j) = f(i) * g(j);
  }
  return F;
}

/// The axis of joint a, which is nearer to part i.
Eigen::Vector3d axis_of(const Driver& a, const Driver& b, const Points& points,
                        const NormalizedActions& actions) {
  const Eigen::Matrix3Xd M =
      regressed(products(a, b, points, actions), points.positions, 4).transpose();
  const Eigen::Matrix3Xd turning = M.rightCols(2 * b.size());
  const Eigen::JacobiSVD<Eigen::Matrix3Xd> svd(turning, Eigen::ComputeFullU);
  const Eigen::Vector3d axis = svd.matrixU().col(2);
  double sense = 0;
  for (int j = 0; j < b.size(); ++j)
    sense +=
        axis.dot(Eigen::Vector3d(turning.col(j)).cross(Eigen::Vector3d(turning.col(b.size() + j))));
  return sense < 0 ? Eigen::Vector3d(-axis) : axis;
}

LocalModel two_joints(const Driver& a, const Driver& b, const Points& points,
                      const NormalizedActions& actions) {
  const bool turns = a.turn > 0;
  const Eigen::Vector3d axis = turns ? axis_of(a, b, points, actions) : Eigen::Vector3d::Zero();
  // Of a joint that turns: o + R(q_a) (u + Σ g φ); of one that slides: o + d q_a + Σ g φ.
  Eigen::MatrixXd F(3 * points.positions.rows(), 3 * (1 + b.size()));
  Eigen::VectorXd y(F.rows());
  for (Eigen::Index n = 0; n < points.positions.rows(); ++n) {
    const int sample = points.samples[static_cast<std::size_t>(n)];
    const double q = actions(sample, a.signal);
    const Eigen::Matrix3d R =
        turns ? exp_so3(a.turn * q * axis) : Eigen::Matrix3d(Eigen::Matrix3d::Identity());
    const Eigen::Vector3d phi = b.at(actions(sample, b.signal));
    auto rows = F.middleRows<3>(3 * n);
    rows.leftCols<3>().setIdentity();
    rows.middleCols<3>(3) = turns ? R : Eigen::Matrix3d(q * R);
    for (int j = 1; j < b.size(); ++j) rows.middleCols<3>(3 + 3 * j) = phi(j) * R;
    y.segment<3>(3 * n) = points.positions.row(n);
  }
  const Eigen::MatrixXd solved = regressed(F, y, 4, 3);
  const Eigen::Map<const Eigen::Matrix3Xd> x(solved.data(), 3, 1 + b.size());
  const Eigen::Vector3d o = x.col(0), u = x.col(1);
  Pose X_a = Pose::Identity();
  X_a.translation() = o;
  const Eigen::Vector3d direction = turns ? axis : u;
  if (direction.norm() > 1e-12) X_a.linear() = frame_with_z(direction.normalized());
  const LastJoint last =
      last_joint(b, turns ? Eigen::Vector3d(o + u) : o, x.rightCols(b.size() - 1));
  LocalModel model;
  model.first = X_a;
  LocalModel::Joint first;
  first.signal = a.signal;
  first.turn = a.turn;
  first.slide = turns ? 0 : u.norm();
  first.slides = !turns;
  first.X_after = X_a.inverse() * last.X;
  model.joints = {first, last.joint};
  return model;
}

std::vector<double> with_slide(std::vector<double> turns) {
  turns.insert(turns.begin(), 0.0);
  return turns;
}

LocalModel no_joint(const Points& points) {
  LocalModel model;
  for (int axis = 0; axis < 3; ++axis) {
    std::vector<double> values;
    for (const double v : points.positions.col(axis)) values.push_back(v);
    model.first.translation()(axis) = upper_median(std::move(values));
  }
  return model;
}

}  // namespace

std::vector<Start> position_starts(const PairData& pair, const NormalizedActions& actions,
                                   int num_joints, int* num_screens) {
  std::vector<Start> starts;
  const Points points = points_of(pair);
  if (points.samples.empty()) return starts;
  const auto add = [&](LocalModel model) {
    model.is_position = true;
    Start start = judged_start(model, pair, actions);
    if (std::isfinite(start.score)) starts.push_back(std::move(start));
  };
  const std::vector<int>& moving = actions.moving();
  if (num_joints == 0) add(no_joint(points));
  if (num_joints == 1) {
    for (const int s : moving)
      for (const double turn : with_slide(wide_turns())) {
        ++*num_screens;
        add(one_joint({s, turn}, points, actions));
      }
  }
  for (std::size_t i = 0; num_joints == 2 && i < moving.size(); ++i)
    for (std::size_t j = i + 1; j < moving.size(); ++j) {
      struct Screened {
        double residual;
        Driver a, b;
      };
      std::vector<Screened> screened;
      for (const double turn_a : with_slide(default_turns()))
        for (const double turn_b : with_slide(default_turns())) {
          const Driver a{moving[i], turn_a}, b{moving[j], turn_b};
          ++*num_screens;
          screened.push_back({median_residual(products(a, b, points, actions), points), a, b});
        }
      std::stable_sort(screened.begin(), screened.end(), [](const Screened& x, const Screened& y) {
        return x.residual < y.residual;
      });
      screened.resize(std::min(screened.size(), kKeptOfSignals));
      for (const Screened& s : screened) {
        add(two_joints(s.a, s.b, points, actions));
        add(two_joints(s.b, s.a, points, actions));
      }
    }
  std::stable_sort(starts.begin(), starts.end(),
                   [](const Start& x, const Start& y) { return x.score < y.score; });
  return starts;
}

}  // namespace bodyschema
