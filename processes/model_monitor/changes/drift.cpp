#include "processes/model_monitor/changes/drift.h"

#include "processes/model_monitor/changes/change_family.h"

namespace bodyschema {

BodyChange drift_step(const BodySchema& schema, int part, int link) {
  using Form = BodyChange::Form;
  return {part == schema.root ? Form::kCamera : Form::kBent, part, link};
}

ChangeSize size_of_rate(const BodySchema& schema, int part, int link, const Vector6d& rate,
                        const Matrix6d& covariance) {
  const Edge* edge = edge_to(schema, part);
  const Pose X = pose_at(schema, part);
  const Eigen::VectorXd middle = schema.displacements(mid_range(schema.signals));
  const Pose at = link_poses(edge, middle, X).at(static_cast<std::size_t>(link));
  const Matrix6d A = adjoint(X.inverse() * at);
  const auto amounts = [](const Eigen::VectorXd& r) {
    return std::vector<double>{r.head<3>().norm(), r.tail<3>().norm()};
  };
  return sized(ChangeSize::Kind::kRate, carrying_signal(edge, link), amounts, A * rate,
               A * covariance * A.transpose());
}

}  // namespace bodyschema
