#include "common/kinematics/screw_chain.h"
#include "processes/model_monitor/changes/change_family.h"

namespace bodyschema {
namespace {

using Form = BodyChange::Form;

constexpr std::size_t kNewest = 3;

/// The one transform, or the first of two, stands behind this pose; the second one behind them all.
Pose place_of(const BodyChange& change, const PlaceMeasurement& m) {
  if (change.form == Form::kBent) return m.links.at(static_cast<std::size_t>(change.at));
  return change.form == Form::kBoth ? Pose::Identity() : m.X;
}

/// The link of a change of the edge that has one transform, or of the first of two.
int link_of(const BodyChange& change, const Edge& edge) {
  if (change.form == Form::kBent) return change.at;
  return change.form == Form::kBoth ? 0 : static_cast<int>(edge.joints.size());
}

/// T(θ) into a link, and its uncertainty into the edge's; before the first joint it stands before
/// all, else behind what the link is.
void bend(int link, const Vector6d& theta, const Eigen::MatrixXd& covariance, Edge* edge) {
  const Pose T = transform(theta);
  Matrix6d J = transform_jacobian(theta);
  if (link == std::ssize(edge->joints)) {
    edge->right = edge->right * T;
    J = adjoint(edge->right) * J;
  } else if (link == 0) {
    J = adjoint(edge->left.inverse()) * J;
    edge->left = T * edge->left;
  } else {
    Pose& X = edge->joints.at(static_cast<std::size_t>(link) - 1).X_after;
    X = X * T;
  }
  if (covariance.size() > 0)
    add_covariance(J * covariance * J.transpose(), ScrewChainLayout::transform(link), edge);
}

}  // namespace

bool Geometry::is_possible(const BodySchema& schema, const BodyChange& change) const {
  const Edge* edge = edge_to(schema, change.part);
  return change.form != Form::kBent || (edge && change.at <= std::ssize(edge->joints));
}

ChangePrior Geometry::prior(const BodySchema&, const BodyChange& change) const {
  const auto& [position, rotation] = form_of(change).sigma;
  Vector6d sigma;
  sigma << Eigen::Vector3d::Constant(position), Eigen::Vector3d::Constant(rotation);
  return {Eigen::VectorXd::Zero(change.size()), sigma.replicate(change.size() / 6, 1)};
}

std::vector<Eigen::VectorXd> Geometry::starts(
    const BodySchema& schema, const BodyChange& change,
    const std::vector<PlaceMeasurement>& measurements) const {
  const Eigen::VectorXd zero = Eigen::VectorXd::Zero(change.size());
  const PlacePrediction before = prediction(schema, change, zero);
  std::vector<Eigen::VectorXd> result;
  const std::size_t count = measurements.size();
  for (std::size_t n = count > kNewest ? count - kNewest : 0; n < count; ++n) {
    const PlaceMeasurement& m = measurements[n];
    const Pose X = before(m, nullptr), at = change.form == Form::kRigid ? X : place_of(change, m);
    const Vector6d first = coordinates(at.inverse() * m.z * X.inverse() * at),
                   last = coordinates(X.inverse() * m.z);
    result.emplace_back(zero).head<6>() = first;
    if (change.size() != 12) continue;
    result.emplace_back(zero).tail<6>() = last;
    result.emplace_back(zero) << 0.5 * first, 0.5 * last;
  }
  return result;
}

void Geometry::apply(const BodyChange& change, const Eigen::VectorXd& theta,
                     const Eigen::MatrixXd& covariance, BodySchema* schema) const {
  Edge& edge = edge_at(schema, change.part);
  if (change.form == Form::kRigid) make_constant(pose_at(*schema, change.part), &edge);
  const auto block = [&](Eigen::Index at) -> Eigen::MatrixXd {
    return covariance.size() > 0 ? covariance.block(at, at, 6, 6) : covariance;
  };
  bend(link_of(change, edge), theta.head<6>(), block(0), &edge);
  if (change.size() == 12)
    bend(static_cast<int>(edge.joints.size()), theta.tail<6>(), block(6), &edge);
}

PlacePrediction Geometry::prediction(const BodySchema& schema, const BodyChange& change,
                                     const Eigen::VectorXd& theta) const {
  const Vector6d first = theta.head<6>(), last = theta.tail<6>();
  std::optional<Pose> rigid;
  if (change.form == Form::kRigid) rigid = pose_at(schema, change.part);
  const bool are_two = change.size() == 12;
  return [change, rigid, T = transform(first), J = transform_jacobian(first),
          end = are_two ? transform(last) : Pose::Identity(), J_end = transform_jacobian(last)](
             const PlaceMeasurement& m, ChangeJacobian* jacobian) -> Pose {
    const Pose at = rigid ? *rigid : place_of(change, m);
    const Pose rest = (rigid ? Pose::Identity() : at.inverse() * m.X) * end;
    if (jacobian && jacobian->cols() == 12) jacobian->rightCols<6>() = J_end;
    if (jacobian) jacobian->leftCols<6>() = adjoint(rest.inverse()) * J;
    return at * T * rest;
  };
}

ChangeSize Geometry::size(const BodySchema& schema, const BodyChange& change,
                          const Eigen::VectorXd& theta, const Eigen::MatrixXd& covariance) const {
  const Edge* edge = edge_to(schema, change.part);
  if (!edge && change.part != schema.root) return {};
  const Pose before = pose_at(schema, change.part);
  const auto amounts = [&](const Eigen::VectorXd& t) {
    return distance_and_angle(before.inverse() * pose_at(changed(schema, change, t), change.part));
  };
  const int signal = change.form == Form::kBent ? carrying_signal(edge, change.at) : -1;
  return sized(ChangeSize::Kind::kPose, signal, amounts, theta, covariance);
}

const ChangeFamily& geometry_family() {
  static const Geometry family;
  return family;
}

int carrying_signal(const Edge* edge, int link) {
  const bool is_told = edge && edge->joints.size() > 1 && link > 0;
  return is_told ? edge->joints.at(static_cast<std::size_t>(link) - 1).signal : -1;
}

std::optional<int> link_difference(const Edge& old, const Edge& now) {
  const std::size_t num_joints = old.joints.size();
  if (now.joints.size() != num_joints) return std::nullopt;
  const auto is_other = [](const Pose& X, const Pose& Y) { return X.matrix() != Y.matrix(); };
  std::vector<int> links;
  if (is_other(old.left, now.left)) links.push_back(0);
  for (std::size_t d = 0; d < num_joints; ++d)
    if (is_other(old.joints[d].X_after, now.joints[d].X_after) ||
        (d + 1 == num_joints && is_other(old.right, now.right)))
      links.push_back(static_cast<int>(d) + 1);
  return links.size() == 1 ? std::optional(links.front()) : std::nullopt;
}

}  // namespace bodyschema
