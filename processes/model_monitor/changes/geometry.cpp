#include "common/kinematics/screw_chain.h"
#include "processes/model_monitor/changes/change_family.h"

namespace bodyschema {
namespace {

using Form = BodyChange::Form;

constexpr std::size_t kNewest = 3;

bool has_left(const BodyChange& change) {
  return change.form == Form::kLeft || change.form == Form::kBoth;
}
bool has_right(const BodyChange& change) { return change.form != Form::kLeft; }

}  // namespace

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
    const Pose X = before(measurements[n], nullptr), &z = measurements[n].z;
    const Vector6d left = coordinates(z * X.inverse()), right = coordinates(X.inverse() * z);
    if (has_left(change)) result.emplace_back(zero).head<6>() = left;
    if (has_right(change)) result.emplace_back(zero).tail<6>() = right;
    if (change.size() == 12) result.emplace_back(zero) << 0.5 * left, 0.5 * right;
  }
  return result;
}

void Geometry::apply(const BodyChange& change, const Eigen::VectorXd& theta,
                     const Eigen::MatrixXd& covariance, BodySchema* schema) const {
  Edge& edge = edge_at(schema, change.part);
  if (change.form == Form::kRigid) make_constant(pose_at(*schema, change.part), &edge);
  if (has_left(change)) {
    const Vector6d t = theta.head<6>();
    if (covariance.size() > 0) {
      const Matrix6d J = adjoint(edge.left.inverse()) * transform_jacobian(t),
                     C = covariance.topLeftCorner<6, 6>();
      add_covariance(J * C * J.transpose(), ScrewChainLayout::transform(0), &edge);
    }
    edge.left = transform(t) * edge.left;
  }
  if (has_right(change)) {
    const Vector6d t = theta.tail<6>();
    edge.right = edge.right * transform(t);
    if (covariance.size() == 0) return;
    const Matrix6d J = adjoint(edge.right) * transform_jacobian(t),
                   C = covariance.bottomRightCorner<6, 6>();
    add_covariance(J * C * J.transpose(),
                   ScrewChainLayout::transform(static_cast<int>(edge.joints.size())), &edge);
  }
}

PlacePrediction Geometry::prediction(const BodySchema& schema, const BodyChange& change,
                                     const Eigen::VectorXd& theta) const {
  const bool moves_left = has_left(change), moves_right = has_right(change);
  const Vector6d first = theta.head<6>(), last = theta.tail<6>();
  std::optional<Pose> rigid;
  if (change.form == Form::kRigid) rigid = pose_at(schema, change.part);
  return [moves_left, moves_right, rigid, left = moves_left ? transform(first) : Pose::Identity(),
          right = moves_right ? transform(last) : Pose::Identity(),
          J_left = transform_jacobian(first), J_right = transform_jacobian(last)](
             const PlaceMeasurement& m, ChangeJacobian* jacobian) -> Pose {
    const Pose& X = rigid ? *rigid : m.X;
    if (jacobian && moves_left) jacobian->leftCols<6>() = adjoint((X * right).inverse()) * J_left;
    if (jacobian && moves_right) jacobian->rightCols<6>() = J_right;
    return left * X * right;
  };
}

ChangeSize Geometry::size(const BodySchema& schema, const BodyChange& change,
                          const Eigen::VectorXd& theta, const Eigen::MatrixXd& covariance) const {
  if (!edge_to(schema, change.part) && change.part != schema.root) return {};
  const Pose before = pose_at(schema, change.part);
  const auto amounts = [&](const Eigen::VectorXd& t) {
    return distance_and_angle(before.inverse() * pose_at(changed(schema, change, t), change.part));
  };
  return sized(ChangeSize::Kind::kPose, -1, amounts, theta, covariance);
}

const ChangeFamily& geometry_family() {
  static const Geometry family;
  return family;
}

}  // namespace bodyschema
