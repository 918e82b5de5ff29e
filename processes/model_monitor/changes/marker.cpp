#include "processes/model_monitor/changes/change_family.h"

namespace bodyschema {
namespace {

/// A part's marker, elsewhere on it. The part's frame goes with the marker; what hangs on the part
/// stays where it is.
class Marker : public Geometry {
 public:
  void apply(const BodyChange& change, const Eigen::VectorXd& theta,
             const Eigen::MatrixXd& covariance, BodySchema* schema) const override {
    if (change.part == schema->root)
      camera_family().apply(change, theta, covariance, schema);
    else
      Geometry::apply(change, theta, covariance, schema);
    for (Edge& out : schema->edges)
      if (out.from == change.part) out.left = transform(theta).inverse() * out.left;
  }
  ChangeSize size(const BodySchema&, const BodyChange&, const Eigen::VectorXd& theta,
                  const Eigen::MatrixXd& covariance) const override {
    const auto amounts = [](const Eigen::VectorXd& t) { return distance_and_angle(transform(t)); };
    return sized(ChangeSize::Kind::kPose, -1, amounts, theta, covariance);
  }
};

}  // namespace

const ChangeFamily& marker_family() {
  static const Marker family;
  return family;
}

}  // namespace bodyschema
