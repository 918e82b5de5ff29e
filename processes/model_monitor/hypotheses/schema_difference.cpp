#include "processes/model_monitor/hypotheses/schema_difference.h"

#include <algorithm>
#include <cmath>
#include <set>

namespace bodyschema {
namespace {

constexpr int kAlikeActions = 16;
constexpr int kProbeCandidates = 200;
/// χ²₆(0.99).
constexpr double kAlike = 16.8;

bool differ(const Edge& a, const Edge& b) {
  const auto is_same_joint = [](const ScrewJoint& x, const ScrewJoint& y) {
    return x.signal == y.signal && x.gain == y.gain && x.offset == y.offset && x.turn == y.turn &&
           x.slide == y.slide && x.X_after.isApprox(y.X_after, 1e-9);
  };
  return !a.left.isApprox(b.left, 1e-9) || !a.right.isApprox(b.right, 1e-9) ||
         !a.has_process_of(b) || !std::ranges::equal(a.joints, b.joints, is_same_joint);
}

/// The n-th of actions that lie evenly in the box of the limits: the additive recurrence of the
/// golden ratio's generalisation to m dimensions (M. Roberts, 2018).
Eigen::VectorXd spread_action(const std::vector<Signal>& signals, int n) {
  const auto m = static_cast<Eigen::Index>(signals.size());
  double phi = 2;
  for (int k = 0; k < 30; ++k) phi = std::pow(1 + phi, 1.0 / static_cast<double>(m + 1));
  Eigen::VectorXd action(m);
  for (Eigen::Index s = 0; s < m; ++s) {
    const double u = std::fmod(0.5 + n * std::pow(phi, -static_cast<double>(s + 1)), 1.0);
    const Signal& signal = signals[static_cast<std::size_t>(s)];
    action(s) = signal.lower + u * (signal.upper - signal.lower);
  }
  return action;
}

bool is_near(const Pose& x, const Matrix6d& of_x, const Pose& y, const Matrix6d& of_y) {
  const Vector6d difference = log(x.inverse() * y);
  const Matrix6d S = of_x + of_y + 1e-12 * Matrix6d::Identity();
  return squared_mahalanobis(difference, S) < kAlike;
}

}  // namespace

bool differ_at(const BodySchema& a, const BodySchema& b, int part) {
  if (part == a.root) return !a.X_CR.isApprox(b.X_CR, 1e-9);
  const Edge *x = edge_to(a, part), *y = edge_to(b, part);
  return x && y && differ(*x, *y);
}

bool is_same(const BodySchema& a, const BodySchema& b) {
  return a.X_CR.isApprox(b.X_CR, 1e-9) &&
         std::ranges::equal(a.edges, b.edges,
                            [](const Edge& x, const Edge& y) { return !differ(x, y); });
}

bool is_alike_at(const BodySchema& a, const BodySchema& b, int part) {
  if (part == a.root) return is_near(a.X_CR, a.X_CR_covariance, b.X_CR, b.X_CR_covariance);
  const Edge *x = edge_to(a, part), *y = edge_to(b, part);
  if (!x || !y) return !x && !y;
  if (x->from != y->from) return false;
  for (int n = 1; n <= kAlikeActions; ++n) {
    const Eigen::VectorXd theta = a.displacements(spread_action(a.signals, n));
    if (!is_near(x->predict(theta), x->prediction_covariance(theta), y->predict(theta),
                 y->prediction_covariance(theta)))
      return false;
  }
  return true;
}

bool is_close_at(const BodySchema& a, const BodySchema& b, int part, const Noise& tolerance) {
  const auto is_close = [&](const Pose& X, const Pose& Y) {
    const Pose difference = X.inverse() * Y;
    return difference.translation().norm() < tolerance.position_m &&
           rotation_angle(difference) < tolerance.rotation_rad;
  };
  if (part == a.root) return is_close(a.X_CR, b.X_CR);
  const Edge *x = edge_to(a, part), *y = edge_to(b, part);
  if (!x || !y || x->from != y->from) return false;
  for (int n = 1; n <= kAlikeActions; ++n) {
    const Eigen::VectorXd action = spread_action(a.signals, n);
    if (!is_close(x->predict(a.displacements(action)), y->predict(b.displacements(action))))
      return false;
  }
  return true;
}

bool is_alike(const BodySchema& a, const BodySchema& b) {
  return std::ranges::all_of(a.parts, [&](int part) { return is_alike_at(a, b, part); });
}

std::vector<ElementId> differences(const BodySchema& a, const BodySchema& b) {
  Eigen::VectorXd action(static_cast<Eigen::Index>(a.signals.size()));
  for (Eigen::Index s = 0; s < action.size(); ++s) {
    const Signal& signal = a.signals[static_cast<std::size_t>(s)];
    action(s) = 0.25 * signal.lower + 0.75 * signal.upper;  // nothing special about it
  }
  const auto pose_in_parent = [&action](const BodySchema& schema, int part) {
    const Edge* edge = edge_to(schema, part);
    return edge ? edge->predict(schema.displacements(action)) : schema.X_CR;
  };
  std::set<int> edges;
  for (const int part : a.parts)
    if (differ_at(a, b, part)) edges.insert(part);
  std::vector<ElementId> elements;
  for (const int part : a.parts) {
    std::vector<int> children;
    for (const Edge& edge : a.edges)
      if (edge.from == part) children.push_back(edge.to);
    if (!edges.contains(part) || children.empty()) continue;
    const Pose X_a = pose_in_parent(a, part), X_b = pose_in_parent(b, part);
    const bool only_the_marker = std::ranges::all_of(children, [&](int child) {
      return edges.contains(child) &&
             (X_a * pose_in_parent(a, child)).isApprox(X_b * pose_in_parent(b, child), 1e-6);
    });
    if (!only_the_marker) continue;
    elements.push_back(tag_element(part));
    edges.erase(part);
    for (const int child : children) edges.erase(child);
  }
  for (const int part : edges) elements.push_back(edge_element(part, a.root));
  return elements;
}

Eigen::VectorXd most_telling_action(const BodySchema& a, const BodySchema& b,
                                    const Noise& tolerance) {
  double most = 1;
  Eigen::VectorXd telling;
  for (int n = 1; n <= kProbeCandidates; ++n) {
    const Eigen::VectorXd action = spread_action(a.signals, n);
    const auto X = a.predict_all(action), Y = b.predict_all(action);
    for (const auto& [part, X_RB] : X) {
      const auto it = Y.find(part);
      if (it == Y.end() || part == a.root)
        continue;  // the root is where it is, whatever the action
      const Pose difference = (a.X_CR * X_RB).inverse() * (b.X_CR * it->second);
      const double size = difference.translation().norm() / tolerance.position_m +
                          rotation_angle(difference) / tolerance.rotation_rad;
      if (size <= most) continue;
      most = size;
      telling = action;
    }
  }
  return telling;
}

}  // namespace bodyschema
