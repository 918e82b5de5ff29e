#include "processes/model_monitor/changes/change_size.h"

#include <algorithm>
#include <cmath>

#include "processes/model_monitor/changes/change_family.h"

namespace bodyschema {

Pose pose_at(const BodySchema& schema, int part) {
  const Edge* edge = edge_to(schema, part);
  return edge ? edge->predict(schema.displacements(mid_range(schema.signals)))
              : schema.X_CR.inverse();
}

std::vector<double> distance_and_angle(const Pose& T) {
  return {T.translation().norm(), rotation_angle(T)};
}

ChangeSize sized(ChangeSize::Kind kind, int signal,
                 const std::function<std::vector<double>(const Eigen::VectorXd&)>& amounts,
                 const Eigen::VectorXd& theta, const Eigen::MatrixXd& covariance) {
  ChangeSize result{kind, signal, amounts(theta), {}};
  const std::size_t size = result.amounts.size();
  result.sds.assign(size, -1);
  if (covariance.rows() != theta.size() || theta.size() == 0) return result;
  Eigen::MatrixXd J(static_cast<Eigen::Index>(size), theta.size());
  for (Eigen::Index i = 0; i < theta.size(); ++i) {
    const double step = std::max(1e-7, 0.1 * std::sqrt(std::max(0.0, covariance(i, i))));
    Eigen::VectorXd up = theta, down = theta;
    up(i) += step;
    down(i) -= step;
    const std::vector<double> more = amounts(up), less = amounts(down);
    for (std::size_t n = 0; n < size; ++n)
      J(static_cast<Eigen::Index>(n), i) = (more[n] - less[n]) / (2 * step);
  }
  const Eigen::VectorXd variances = (J * covariance * J.transpose()).diagonal();
  for (std::size_t n = 0; n < size; ++n)
    result.sds[n] = std::sqrt(std::max(0.0, variances(static_cast<Eigen::Index>(n))));
  return result;
}

ChangeSize size_of(const BodySchema& schema, const BodyChange& change, const Eigen::VectorXd& theta,
                   const Eigen::MatrixXd& covariance) {
  const ChangeFamily& family = form_of(change).family;
  if (theta.size() != change.size() || !family.is_possible(schema, change)) return {};
  return family.size(schema, change, theta, covariance);
}

FoundDifference difference_at(const BodySchema& before, const BodySchema& now,
                              const ElementId& element) {
  const Edge *old = edge_to(before, element.id), *edge = edge_to(now, element.id);
  if (old && edge && !element.is_tag()) {
    if (!edge->has_process_of(*old)) return {"new_model", {}};
    if (auto joint = joint_difference(before, *old, *edge)) return *joint;
  }
  const auto link =
      old && edge && !element.is_tag() ? link_difference(*old, *edge) : std::optional<int>();
  return {element.id == now.root ? "camera_moved"
          : element.is_tag()     ? "marker_moved"
                                 : "geometry",
          {ChangeSize::Kind::kPose,
           link ? carrying_signal(edge, *link) : -1,
           distance_and_angle(pose_at(before, element.id).inverse() * pose_at(now, element.id)),
           {-1, -1}}};
}

}  // namespace bodyschema
