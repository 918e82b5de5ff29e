#pragma once

#include <Eigen/Core>
#include <filesystem>
#include <map>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "common/config/camera_calibration.h"
#include "common/config/rig.h"
#include "common/geometry/pose.h"
#include "common/scene/calibration_error.h"

namespace bodyschema {

// robot.yaml: the simulated robot as it truly is. GROUND TRUTH: simulator, simulated camera and
// tests read it; nothing that learns does. Frames: W world (z up, the floor is z = 0), L a link
// (its joint's axis passes through the origin), S a shape, B a body part.

/// A solid piece of a link.
struct Shape {
  enum class Kind { kBox, kCylinder, kCapsule, kSphere };
  Kind kind = Kind::kBox;
  /// Box: half sides. Cylinder, capsule: radius, half length along S's z. Sphere: radius. [m]
  Eigen::Vector3d half_size_m = Eigen::Vector3d::Zero();
  Pose X_LS = Pose::Identity();
  double mass_kg = 0;
  double grey = 0.5;     ///< colour, 0.05 … 1 white
  bool collides = true;  ///< false: seen, but passes through everything
};

struct Servo {
  double stiffness = 0;  ///< [N m/rad], prismatic [N/m]
  double damping = 0;    ///< [N m s/rad], prismatic [N s/m]
  double armature = 0;   ///< inertia of the drive seen at the joint [kg m²], prismatic [kg]
};

/// Position q of a joint is its turn [rad] or slide [m] along `axis`; its command is
/// q = gain · action[signal] + offset. Gain and offset are what the learners have to find out.
struct RobotJoint {
  enum class Kind { kRevolute, kPrismatic };
  std::string name;
  Kind kind = Kind::kRevolute;
  Eigen::Vector3d axis = Eigen::Vector3d::UnitZ();  ///< in L, unit
  double lower = 0;                                 ///< [rad] or [m]
  double upper = 0;                                 ///< [rad] or [m]
  double max_speed = 0;                             ///< [rad/s] or [m/s]
  Servo servo;
  int signal = 0;     ///< index into Signals::signals; joints may share a signal
  double gain = 1;    ///< [rad or m per command unit]
  double offset = 0;  ///< [rad] or [m]
  /// Jammed at this position [rad or m], whatever is commanded; none: it moves.
  std::optional<double> stuck_at;
};

struct Link {
  std::string name;
  std::string parent;            ///< an earlier link, or "world"
  Pose X_PL = Pose::Identity();  ///< in the parent's frame, at joint position 0
  std::optional<int> joint;      ///< index into Robot::joints; none: fixed to the parent
  std::vector<Shape> shapes;
};

/// Frame of a body part on its link.
struct PartPlacement {
  int part = 0;
  int link = 0;  ///< index into Robot::links
  Pose X_LB = Pose::Identity();
};

/// A tool that a link can carry beyond its flange. It displaces everything that the description
/// puts there (solids, parts, further links) and adds solids of its own.
struct Tool {
  std::string name;
  Pose X_FT = Pose::Identity();  ///< where the flange's frame F, and all beyond it, goes
  std::vector<Shape> shapes;     ///< in L; there only while the tool is mounted
};

struct ToolChanger {
  int link = 0;                  ///< index into Robot::links
  Pose X_LF = Pose::Identity();  ///< the flange; beyond it is what has z > 0 in F
  std::vector<Tool> tools;       ///< the first displaces nothing and has no shapes
  int mounted = 0;               ///< index into tools
};

struct Robot {
  std::string name;
  Pose X_WC = Pose::Identity();      ///< camera, optical frame
  CameraCalibration lens;            ///< without a name
  std::vector<RobotJoint> joints;    ///< in the order of their links
  std::vector<Link> links;           ///< parents before children
  std::vector<PartPlacement> parts;  ///< ascending part id
  Markers markers;                   ///< as they truly are
  std::map<int, Pose> X_WM_targets;  ///< by id: where the target tags float
  /// Links that may touch beside parent and child, which always may.
  std::vector<std::pair<std::string, std::string>> may_touch;
  Eigen::VectorXd home;  ///< action of the start pose, command units
  std::optional<ToolChanger> tool_changer;
  CalibrationError calibration_error;

  /// Joint positions that `action` leads to: gain · command + offset, stuck joints where they are.
  /// @throws std::invalid_argument on a wrong size.
  Eigen::VectorXd joint_positions(const Eigen::VectorXd& action) const;
  /// Why these positions cannot be: "joint 3 would turn to 101.2 deg, beyond -95 … 95".
  std::optional<std::string> beyond_range(const Eigen::VectorXd& joint_positions) const;
};

/// Reads robot.yaml, its tables as they stand there. Signals are named as in signals.yaml; the
/// parts must be those of markers.yaml.
/// @throws ConfigError.
Robot load_robot(const std::filesystem::path& rig_folder, const Signals& signals,
                 const Markers& markers);

}  // namespace bodyschema
