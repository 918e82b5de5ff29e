#include "tests/experiments/figures/cramer_rao.h"

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <limits>

namespace bodyschema::experiments {
namespace {

using test::SyntheticRobot;
using test::TrueLink;

double displacement(const SyntheticRobot& robot, const TrueLink& link,
                    const Eigen::VectorXd& action) {
  return action(link.signal) - link.zero + robot.bend * std::sin(3 * action(link.signal));
}

Vector6d screw(double slide, double turn) {
  Vector6d xi = Vector6d::Zero();
  xi(2) = slide;
  xi(5) = turn;
  return xi;
}

}  // namespace

CramerRao::CramerRao(const SyntheticRobot& robot, bool knows_kinds)
    : robot_(robot), knows_kinds_(knows_kinds) {
  for (const TrueLink& link : robot.links) {
    first_parameter_.push_back(num_parameters_);
    num_parameters_ += link.parent >= 0 && link.signal >= 0 ? 14 : 6;  // of the base: X_CR
  }
  information_ = Eigen::MatrixXd::Zero(num_parameters_, num_parameters_);
}

Eigen::MatrixXd CramerRao::pose_jacobian(int part, const Eigen::VectorXd& action) const {
  Eigen::MatrixXd J = Eigen::MatrixXd::Zero(6, num_parameters_);
  Pose suffix = Pose::Identity();  // from behind the parameter to the part
  while (true) {
    const auto at = std::find_if(robot_.links.begin(), robot_.links.end(),
                                 [part](const TrueLink& l) { return l.part == part; });
    const TrueLink& link = *at;
    const int first = first_parameter_.at(at - robot_.links.begin());
    if (link.parent < 0) {
      J.middleCols<6>(first) = adjoint(suffix.inverse());
      return J;
    }
    if (link.signal < 0) {
      suffix = link.X_after * suffix;
    } else {
      J.middleCols<6>(first + 8) = adjoint(suffix.inverse());
      suffix = link.X_after * suffix;
      const double q = displacement(robot_, link, action);
      const Matrix6d Ad = adjoint(suffix.inverse());
      // What no pose depends on is taken as known.
      if (!knows_kinds_ || link.slide != 0) J.col(first + 6) = q * Ad.col(2);
      if (!knows_kinds_ || link.turn != 0) J.col(first + 7) = q * Ad.col(5);
      suffix = exp(screw(link.slide, link.turn) * q) * suffix;
    }
    J.middleCols<6>(first) = adjoint(suffix.inverse());
    suffix = link.X_before * suffix;
    part = link.parent;
  }
}

SyntheticRobot CramerRao::perturbed(const Eigen::VectorXd& step) const {
  SyntheticRobot result = robot_;
  for (std::size_t n = 0; n < result.links.size(); ++n) {
    TrueLink& link = result.links[n];
    const int first = first_parameter_[n];
    const auto tangent = [&](int offset) { return Vector6d(step.segment<6>(first + offset)); };
    if (link.parent < 0) {
      result.X_CR = result.X_CR * exp(tangent(0));
      continue;
    }
    link.X_before = link.X_before * exp(tangent(0));
    if (link.signal < 0) continue;
    link.slide += step(first + 6);
    link.turn += step(first + 7);
    link.X_after = link.X_after * exp(tangent(8));
  }
  return result;
}

void CramerRao::add(const ActionPoseSample& sample) {
  for (const PartObservation& o : sample.parts) {
    const Eigen::MatrixXd J = pose_jacobian(o.part, sample.action);
    information_ += J.transpose() * o.covariance.llt().solve(J);
  }
  is_factorized_ = false;
}

void CramerRao::factorize() const {
  if (is_factorized_) return;
  const Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd> eigen(information_);
  const Eigen::VectorXd& values = eigen.eigenvalues();  // ascending
  Eigen::Index rank = 0;
  for (const double v : values) rank += v > 1e-11 * values(values.size() - 1);
  gauge_ = eigen.eigenvectors().leftCols(values.size() - rank);
  root_ = eigen.eigenvectors().rightCols(rank) *
          values.tail(rank).cwiseSqrt().cwiseInverse().asDiagonal();
  is_factorized_ = true;
}

Matrix6d CramerRao::bound_of(const Eigen::MatrixXd& G) const {
  factorize();
  if ((G * gauge_).norm() > 1e-5 * G.norm())
    return Matrix6d::Constant(std::numeric_limits<double>::infinity());
  const Eigen::MatrixXd half = G * root_;
  return half * half.transpose();
}

Matrix6d CramerRao::bound(int from, int to, const Eigen::VectorXd& action) const {
  const auto X = robot_.poses_in_camera(action);
  const Pose X_FT = X.at(from).inverse() * X.at(to);
  return bound_of(pose_jacobian(to, action) -
                  adjoint(X_FT.inverse()) * pose_jacobian(from, action));
}

Matrix6d CramerRao::bound_in_camera(int part, const Eigen::VectorXd& action) const {
  return bound_of(pose_jacobian(part, action));
}

double position_bound_rms(const CramerRao& bound, int from, int to,
                          const std::vector<Eigen::VectorXd>& actions) {
  double sum = 0;
  for (const Eigen::VectorXd& q : actions)
    sum += bound.bound(from, to, q).topLeftCorner<3, 3>().trace();
  return std::sqrt(sum / static_cast<double>(actions.size()));
}

}  // namespace bodyschema::experiments
