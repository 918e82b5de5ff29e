#pragma once

#include <Eigen/Core>
#include <filesystem>
#include <map>
#include <string>
#include <vector>

#include "processes/console/urdf_drives.h"

namespace bodyschema {

/// What gravity does to the joints of a URDF that is fixed to the world by its root link, whose z
/// points upwards: masses and their centres are those of the links' `<inertial>`.
class GravityLoad {
 public:
  /// `joints`: those of engineered_model() on the same files.
  /// @throws ConfigError, std::runtime_error of the files, or where no link has a mass.
  GravityLoad(const std::filesystem::path& urdf, const std::filesystem::path& placement,
              const std::vector<std::string>& joints);

  /// At an action, one number a joint: the torque [N m] about its axis, in the sense in which it
  /// turns with a growing command; of a joint that slides the force [N]. Over the joint's gain
  /// [rad or m per command unit], so that a compliance [rad/(N m), m/N] times it is in command
  /// units.
  Eigen::VectorXd operator()(const Eigen::VectorXd& action) const;

 private:
  struct Mass {
    double m_kg = 0;
    Eigen::Vector3d moment = Eigen::Vector3d::Zero();  ///< Σ m p [kg m], in the root link
  };
  /// Of a link at X_RL and all that it carries; on the way the loads of the joints.
  Mass carried_by(const urdf::Link& link, const Pose& X_RL, const Eigen::VectorXd& action,
                  std::map<std::string, double>* loads) const;

  const UrdfDrives drives_;
  const std::vector<std::string> joints_;
};

}  // namespace bodyschema
