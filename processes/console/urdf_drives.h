#pragma once

#include <urdf_model/model.h>

#include <filesystem>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "common/config/yaml.h"
#include "common/geometry/pose.h"
#include "common/schema/signal.h"

namespace bodyschema {

Pose from_urdf(const urdf::Pose& X);

/// How a joint follows from an action: position = gain·command + offset [rad, m].
struct Drive {
  int signal = -1;  ///< −1: none, the joint stands at `offset`
  double gain = 1;  ///< [rad or m per command unit], not 0 where there is a signal
  double offset = 0;
};

/// A URDF, and the action signals that move its joints by the `signals` of a placement file
/// (engineered_model.h).
class UrdfDrives {
 public:
  /// @throws ConfigError, std::runtime_error if the URDF cannot be read.
  UrdfDrives(const std::filesystem::path& urdf, const Yaml& placement);

  const urdf::ModelInterface& model() const { return *model_; }
  const std::vector<Signal>& signals() const { return signals_; }
  /// Of a joint that turns or slides; mimics follow their leader.
  /// @throws std::runtime_error of another joint.
  Drive drive_of(const urdf::Joint& joint) const;
  /// Unit vector in the joint's frame. @throws std::runtime_error if it is 0.
  Eigen::Vector3d axis_of(const urdf::Joint& joint) const;

 private:
  void read_drive(const Yaml& entry);
  [[noreturn]] void refuse(const urdf::Joint& joint, const std::string& why) const;

  const std::filesystem::path urdf_;
  const std::shared_ptr<const urdf::ModelInterface> model_;
  std::vector<Signal> signals_;
  std::map<std::string, Drive> drives_;  // by joint
};

}  // namespace bodyschema
