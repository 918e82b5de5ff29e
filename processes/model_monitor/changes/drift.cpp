#include "processes/model_monitor/changes/drift.h"

namespace bodyschema {

BodyChange drift_step(const BodySchema& schema, int part, bool left) {
  using Form = BodyChange::Form;
  return {part == schema.root ? Form::kCamera : left ? Form::kLeft : Form::kRight, part};
}

ChangeSize size_of_rate(const BodySchema& schema, int part, bool left, const Vector6d& rate,
                        const Matrix6d& covariance) {
  const Matrix6d A = left && edge_to(schema, part) ? adjoint(pose_at(schema, part).inverse())
                                                   : Matrix6d::Identity();
  const auto amounts = [](const Eigen::VectorXd& r) {
    return std::vector<double>{r.head<3>().norm(), r.tail<3>().norm()};
  };
  return sized(ChangeSize::Kind::kRate, -1, amounts, A * rate, A * covariance * A.transpose());
}

}  // namespace bodyschema
