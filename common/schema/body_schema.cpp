#include "common/schema/body_schema.h"

#include <algorithm>
#include <set>
#include <stdexcept>
#include <utility>

#include "common/kinematics/kinematic_path.h"
#include "common/kinematics/kinematic_tree.h"
#include "common/kinematics/screw_chain.h"
#include "common/schema/standard_deviations.h"

namespace bodyschema {
namespace {

/// Those that show a part on either side of an edge.
std::vector<const ActionPoseSample*> samples_across(const Edge& edge,
                                                    const std::vector<Edge>& edges,
                                                    const std::vector<ActionPoseSample>& samples) {
  std::vector<std::pair<int, int>> others;
  for (const Edge& e : edges)
    if (&e != &edge) others.emplace_back(e.from, e.to);
  const auto parts_beside = [&](int end) {
    const KinematicTree side(others, end);
    std::set<int> parts;
    for (const KinematicTree::Node& node : side.nodes()) parts.insert(node.part);
    return parts;
  };
  const std::set<int> before = parts_beside(edge.from), beyond = parts_beside(edge.to);
  const auto shows = [](const ActionPoseSample& sample, const std::set<int>& side) {
    return std::ranges::any_of(sample.parts,
                               [&](const auto& seen) { return side.contains(seen.part); });
  };
  std::vector<const ActionPoseSample*> result;
  for (const ActionPoseSample& sample : samples)
    if (shows(sample, before) && shows(sample, beyond)) result.push_back(&sample);
  return result;
}

/// What two edges saw of one signal; what one of them never saw does not count.
std::optional<Signal::Range> by_both(const std::optional<Signal::Range>& a,
                                     const std::optional<Signal::Range>& b) {
  if (!a || !b) return a ? a : b;
  const double lower = std::max(a->lower, b->lower);
  return Signal::Range{lower, std::max(lower, std::min(a->upper, b->upper))};
}

// The chain left · ∏ Exp(ŝ ϑ) X_after of an edge at an action.
auto chain_of(const Edge& edge, const Eigen::VectorXd& theta) {
  return ScrewChain(edge.left, static_cast<int>(edge.joints.size()), [&edge, &theta](int d) {
    const ScrewJoint& joint = edge.joints[static_cast<std::size_t>(d)];
    if (joint.signal < 0 || joint.signal >= theta.size())
      throw std::invalid_argument("action has no signal " + std::to_string(joint.signal));
    return ScrewLink{
        {joint.slide, joint.turn}, joint.gain * theta(joint.signal) + joint.offset, joint.X_after};
  });
}

void check_size(const BodySchema& schema, const Eigen::VectorXd& action) {
  if (action.size() != static_cast<Eigen::Index>(schema.signals.size()))
    throw std::invalid_argument("action has " + std::to_string(action.size()) + " values, not " +
                                std::to_string(schema.signals.size()));
}

// Exp(ρ(θ)) · right, and how the pose moves with ρ: Exp(ρ + δ) = Exp(ρ) · Exp(J_r(ρ) δ).
struct Residual {
  Residual(const ResidualGp& gp, const Eigen::VectorXd& theta, const Pose& right) {
    const Vector6d rho = gp.mean(theta);
    suffix = exp(rho) * right;
    by_mean = adjoint(right.inverse()) * right_jacobian_inverse(rho).inverse();
  }
  Pose suffix;
  Matrix6d by_mean;
};

}  // namespace

bool Edge::has_process_of(const Edge& other) const {
  const auto is_same = [](const auto& a, const auto& b) { return a == b || (a && b && *a == *b); };
  return is_same(matrix_gp, other.matrix_gp) && is_same(residual_gp, other.residual_gp);
}

const char* Edge::kind() const {
  if (matrix_gp) return "matrix_gp";
  if (residual_gp) return "screw_gp";
  return joints.empty() ? "rigid" : "screw";
}

std::vector<int> Edge::signals() const {
  if (matrix_gp) return matrix_gp->signals();
  std::vector<int> result;
  for (const ScrewJoint& joint : joints)
    if (std::find(result.begin(), result.end(), joint.signal) == result.end())
      result.push_back(joint.signal);
  if (residual_gp)
    for (const int signal : residual_gp->signals())
      if (std::find(result.begin(), result.end(), signal) == result.end()) result.push_back(signal);
  return result;
}

Eigen::Index Edge::num_parameters() const {
  return ScrewChainLayout::size(static_cast<int>(joints.size()));
}

Pose Edge::predict(const Eigen::VectorXd& theta) const {
  if (matrix_gp) return left * matrix_gp->predict(theta) * right;
  Pose X = chain_of(*this, theta).predict();
  if (residual_gp) X = X * exp(residual_gp->mean(theta));
  return X * right;
}

Eigen::MatrixXd Edge::jacobian(const Eigen::VectorXd& theta) const {
  if (matrix_gp) return adjoint(right.inverse()) * matrix_gp->jacobian(theta);
  Eigen::MatrixXd J = Eigen::MatrixXd::Zero(6, theta.size());
  Pose suffix = right;
  if (residual_gp) {
    const Residual residual(*residual_gp, theta, right);
    J = residual.by_mean * residual_gp->mean_gradient(theta);
    suffix = residual.suffix;
  }
  Eigen::MatrixXd by_displacements;
  chain_of(*this, theta).predict_by_displacements(&by_displacements, suffix);
  for (std::size_t d = joints.size(); d-- > 0;)
    J.col(joints[d].signal) += joints[d].gain * by_displacements.col(static_cast<Eigen::Index>(d));
  return J;
}

Eigen::MatrixXd Edge::parameter_jacobian(const Eigen::VectorXd& theta) const {
  Eigen::MatrixXd G;
  chain_of(*this, theta)
      .predict_by_parameters(&G, residual_gp ? Residual(*residual_gp, theta, right).suffix : right);
  return G;
}

Matrix6d Edge::prediction_covariance(const Eigen::VectorXd& theta) const {
  if (matrix_gp) {
    const Matrix6d A = adjoint(right.inverse());
    return A * matrix_gp->prediction_covariance(theta) * A.transpose();
  }
  const Eigen::MatrixXd G = parameter_jacobian(theta);
  Matrix6d covariance = Matrix6d::Zero();
  if (parameter_covariance.rows() == G.cols() && parameter_covariance.cols() == G.cols())
    covariance = G * parameter_covariance * G.transpose();
  if (residual_gp) {
    const Matrix6d by_mean = Residual(*residual_gp, theta, right).by_mean;
    covariance += by_mean * residual_gp->variance(theta).asDiagonal() * by_mean.transpose();
  }
  return covariance;
}

Matrix6d Edge::scatter_covariance(const Eigen::VectorXd& theta) const {
  Eigen::VectorXd variances(std::ssize(joints));
  for (std::size_t d = 0; d < joints.size(); ++d)
    variances(static_cast<Eigen::Index>(d)) =
        joints[d].gain != 0 ? joints[d].scatter * joints[d].scatter : 0;
  if (variances.isZero(0)) return Matrix6d::Zero();
  Eigen::MatrixXd twists;
  chain_of(*this, theta)
      .predict_by_displacements(&twists,
                                residual_gp ? Residual(*residual_gp, theta, right).suffix : right);
  return twists * variances.asDiagonal() * twists.transpose();
}

Matrix6d Edge::unexplained_covariance(const Pose& X, const Noise& noise) const {
  if (!residual_gp) return Matrix6d::Zero();
  const Vector6d whole = empirical_covariance().diagonal();
  return (whole - noise_of_pair(X, noise)).cwiseMax(0).asDiagonal();
}

Matrix6d Edge::empirical_covariance() const {
  Vector6d variances;
  variances.head<3>().setConstant(position_rms_m * position_rms_m / 3);
  variances.tail<3>().setConstant(rotation_rms_rad * rotation_rms_rad / 3);
  return variances.asDiagonal();
}

std::int64_t BodySchema::body_since(std::int64_t sample_index) const {
  std::int64_t since = 0;
  for (const KnownChange& change : changes)
    if (change.found <= sample_index) since = change.since;
  return since;
}

std::vector<MovedTag> BodySchema::moved_tags_known(std::int64_t sample_index) const {
  std::vector<MovedTag> known;
  for (MovedTag tag : moved_tags) {
    if (tag.found > sample_index) continue;
    if (tag.until > sample_index) tag.until = -1;
    known.push_back(tag);
  }
  return known;
}

bool has_moved(const std::vector<MovedTag>& moved, int tag, std::int64_t sample_index) {
  return std::any_of(moved.begin(), moved.end(), [&](const MovedTag& m) {
    return m.tag == tag && m.since <= sample_index && (m.until < 0 || sample_index < m.until);
  });
}

void forget_when_it_changed(BodySchema* schema) {
  for (Edge& edge : schema->edges) edge.valid_since_sample = 0;
  schema->changes.clear();
  std::erase_if(schema->moved_tags, [](const MovedTag& tag) { return tag.until >= 0; });
  for (MovedTag& tag : schema->moved_tags) tag.found = tag.since = 0;
}

void drop_moved_tags(const std::vector<MovedTag>& moved, ActionPoseSample* sample) {
  if (moved.empty()) return;
  sample->leave_out([&](int tag) { return has_moved(moved, tag, sample->sample_index); });
}

bool BodySchema::has_rotation(int part) const {
  return !std::binary_search(position_parts.begin(), position_parts.end(), part);
}

bool BodySchema::has_part(int part) const {
  return std::find(parts.begin(), parts.end(), part) != parts.end();
}

std::vector<int> BodySchema::unused_signals() const {
  std::vector<bool> used(signals.size(), false);
  for (const int signal : undecided_signals) used.at(static_cast<std::size_t>(signal)) = true;
  for (const Edge& edge : edges)
    for (const int signal : edge.signals())
      if (signal >= 0 && signal < static_cast<int>(used.size())) used[signal] = true;
  std::vector<int> result;
  for (std::size_t s = 0; s < used.size(); ++s)
    if (!used[s]) result.push_back(static_cast<int>(s));
  return result;
}

void BodySchema::set_covered(const std::vector<ActionPoseSample>& samples) {
  for (Signal& signal : signals) signal.covered.reset();
  for (const Edge& edge : edges) {
    const auto across = samples_across(edge, edges, samples);
    for (const int s : edge.signals()) {
      Signal by_edge = signals[static_cast<std::size_t>(s)];
      by_edge.covered.reset();
      for (const ActionPoseSample* sample : across) by_edge.cover(sample->action[s]);
      auto& covered = signals[static_cast<std::size_t>(s)].covered;
      covered = by_both(covered, by_edge.covered);
    }
  }
  for (std::size_t s = 0; s < signals.size(); ++s) {
    if (signals[s].covered) continue;
    for (const ActionPoseSample& sample : samples)
      signals[s].cover(sample.action[static_cast<Eigen::Index>(s)]);
  }
}

Eigen::VectorXd BodySchema::displacements(const Eigen::VectorXd& action) const {
  check_size(*this, action);
  Eigen::VectorXd theta = action;
  for (std::size_t s = 0; s < signals.size(); ++s) {
    theta(static_cast<Eigen::Index>(s)) =
        signals[s].displacement(action(static_cast<Eigen::Index>(s)));
  }
  return theta;
}

std::optional<PosePrediction> BodySchema::predict(int from, int to, const Eigen::VectorXd& action,
                                                  Variance variance) const {
  check_size(*this, action);
  const auto path = KinematicPath::between(*this, from, to);
  if (!path) return std::nullopt;
  return PosePrediction{path->predict(action), path->covariance(action, variance)};
}

std::map<int, Pose> BodySchema::predict_all(const Eigen::VectorXd& action) const {
  const Eigen::VectorXd theta = displacements(action);
  std::map<int, Pose> X_RB;
  if (root < 0) return X_RB;
  X_RB.emplace(root, Pose::Identity());
  const KinematicTree tree(edges, root);
  for (const KinematicTree::Node& node : tree.nodes()) {
    if (node.parent < 0) continue;
    const Pose X = edges[static_cast<std::size_t>(node.edge)].predict(theta);
    X_RB.emplace(node.part, X_RB.at(tree.nodes()[static_cast<std::size_t>(node.parent)].part) *
                                (node.is_forward ? X : X.inverse()));
  }
  return X_RB;
}

std::optional<Eigen::MatrixXd> BodySchema::jacobian(int from, int to,
                                                    const Eigen::VectorXd& action) const {
  check_size(*this, action);
  const auto path = KinematicPath::between(*this, from, to);
  if (!path) return std::nullopt;
  PoseJacobian J;
  path->predict(action, &J);
  return J;
}

}  // namespace bodyschema
