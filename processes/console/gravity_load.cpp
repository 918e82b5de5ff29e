#include "processes/console/gravity_load.h"

#include <algorithm>
#include <stdexcept>

namespace bodyschema {
namespace {

constexpr double kGravity_m_s2 = 9.80665;  // standard gravity

}  // namespace

GravityLoad::GravityLoad(const std::filesystem::path& urdf, const std::filesystem::path& placement,
                         const std::vector<std::string>& joints)
    : drives_(urdf, Yaml::load(placement)), joints_(joints) {
  const auto& links = drives_.model().links_;
  if (std::ranges::none_of(links, [](const auto& entry) {
        return entry.second->inertial && entry.second->inertial->mass > 0;
      }))
    throw std::runtime_error(urdf.string() + ": no link has a mass");
}

GravityLoad::Mass GravityLoad::carried_by(const urdf::Link& link, const Pose& X_RL,
                                          const Eigen::VectorXd& action,
                                          std::map<std::string, double>* loads) const {
  Mass total;
  if (link.inertial) {
    total.m_kg = link.inertial->mass;
    total.moment = total.m_kg * (X_RL * from_urdf(link.inertial->origin).translation());
  }
  for (const auto& joint : link.child_joints) {
    Pose X_RJ = X_RL * from_urdf(joint->parent_to_joint_origin_transform);
    const Pose X_RZ = X_RJ;
    const bool slides = joint->type == urdf::Joint::PRISMATIC;
    Drive drive;
    Eigen::Vector3d axis = Eigen::Vector3d::UnitZ();
    if (joint->type != urdf::Joint::FIXED) {
      drive = drives_.drive_of(*joint);
      axis = drives_.axis_of(*joint);
      const double position =
          drive.offset + (drive.signal < 0 ? 0 : drive.gain * action(drive.signal));
      Vector6d twist = Vector6d::Zero();
      twist.segment<3>(slides ? 0 : 3) = position * axis;
      X_RJ = X_RJ * exp(twist);
    }
    const Mass carried =
        carried_by(*drives_.model().getLink(joint->child_link_name), X_RJ, action, loads);
    total.m_kg += carried.m_kg;
    total.moment += carried.moment;
    if (drive.signal < 0) continue;
    const Eigen::Vector3d g = -kGravity_m_s2 * Eigen::Vector3d::UnitZ();
    const Eigen::Vector3d lever = carried.moment - carried.m_kg * X_RZ.translation();
    const Eigen::Vector3d effect = slides ? Eigen::Vector3d(carried.m_kg * g) : lever.cross(g);
    (*loads)[joint->name] = (X_RZ.linear() * axis).dot(effect) / drive.gain;
  }
  return total;
}

Eigen::VectorXd GravityLoad::operator()(const Eigen::VectorXd& action) const {
  std::map<std::string, double> loads;
  carried_by(*drives_.model().getRoot(), Pose::Identity(), action, &loads);
  Eigen::VectorXd result(std::ssize(joints_));
  for (Eigen::Index n = 0; n < result.size(); ++n) result(n) = loads.at(joints_[n]);
  return result;
}

}  // namespace bodyschema
