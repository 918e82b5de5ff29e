#include "processes/model_monitor/changes/change_family.h"

namespace bodyschema {
namespace {

/// The root in the camera, X_CR · T(θ).
class Camera : public Geometry {
 public:
  void apply(const BodyChange&, const Eigen::VectorXd& theta, const Eigen::MatrixXd& covariance,
             BodySchema* schema) const override {
    schema->X_CR = schema->X_CR * transform(theta);
    if (covariance.size() == 0) return;
    const Matrix6d J = transform_jacobian(theta), C = covariance;
    schema->X_CR_covariance += J * C * J.transpose();
  }
};

}  // namespace

const ChangeFamily& camera_family() {
  static const Camera family;
  return family;
}

}  // namespace bodyschema
