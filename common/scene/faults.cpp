#include "common/scene/faults.h"

#include <algorithm>
#include <cmath>
#include <functional>
#include <random>
#include <sstream>

#include "common/geometry/angle.h"
#include "common/text/text.h"

namespace bodyschema {
namespace {

using Command = fault_command_t;

/// Radius at which a fallen marker lies, clear of the base [m].
constexpr double kFallenRadius_m = 0.3;
constexpr double kPlateThickness_m = 0.006;

std::string name_of(const std::string& text) { return text.empty() ? "''" : text; }

int link_index(const Robot& robot, const std::string& name) {
  const auto found = std::find_if(robot.links.begin(), robot.links.end(),
                                  [&](const Link& link) { return link.name == name; });
  return found == robot.links.end() ? -1 : static_cast<int>(found - robot.links.begin());
}

/// Moves by X, in the link's frame L, all that sits on the link at a point p_L with is_beyond(p_L).
void displace(Robot& robot, int link, const Pose& X,
              const std::function<bool(const Eigen::Vector3d&)>& is_beyond) {
  const auto move = [&](Pose& X_L) {
    if (is_beyond(X_L.translation())) X_L = X * X_L;
  };
  for (Shape& shape : robot.links[link].shapes) move(shape.X_LS);
  for (Link& child : robot.links) {
    if (child.parent == robot.links[link].name) move(child.X_PL);
  }
  for (PartPlacement& part : robot.parts) {
    if (part.link == link) move(part.X_LB);
  }
}

void mount_tool(Robot& robot, int number) {
  ToolChanger& changer = *robot.tool_changer;
  changer.mounted = number;
  const Pose X_FL = changer.X_LF.inverse();
  displace(robot, changer.link, changer.X_LF * changer.tools[number].X_FT * X_FL,
           [&](const Eigen::Vector3d& p_L) { return (X_FL * p_L).z() > 0; });
}

void bend(Robot& robot, int link, double angle_rad) {
  // The link leads from its own joint to those that it carries; a last link to its farthest solid.
  Eigen::Vector3d p_end = Eigen::Vector3d::Zero();
  int num_children = 0;
  for (const Link& child : robot.links) {
    if (child.parent != robot.links[link].name) continue;
    p_end += child.X_PL.translation();
    ++num_children;
  }
  if (num_children > 0) {
    p_end /= num_children;
  } else {
    for (const Shape& shape : robot.links[link].shapes) {
      if (shape.X_LS.translation().norm() > p_end.norm()) p_end = shape.X_LS.translation();
    }
  }
  const Eigen::Vector3d p_middle = p_end / 2;
  const Eigen::Vector3d along =
      p_end.norm() > 1e-9 ? Eigen::Vector3d(p_end.normalized()) : Eigen::Vector3d::UnitZ();
  // About an axis across the link, between its two transverse axes: seldom that of a joint.
  Eigen::Index least = 0;
  along.cwiseAbs().minCoeff(&least);
  const Eigen::Vector3d across = (Eigen::Vector3d::Unit(least) - along[least] * along).normalized();
  const Eigen::Vector3d axis = (across + along.cross(across)).normalized();
  const Pose X = Eigen::Translation3d(p_middle) * Eigen::AngleAxisd(angle_rad, axis) *
                 Eigen::Translation3d(-p_middle);
  displace(robot, link, X,
           [&](const Eigen::Vector3d& p_L) { return (p_L - p_middle).dot(along) > 0; });
}

Pose bump(std::int64_t seed, int count) {
  std::seed_seq sequence{static_cast<std::uint32_t>(seed), static_cast<std::uint32_t>(seed >> 32),
                         static_cast<std::uint32_t>(count), 0xca3e7aU};
  std::mt19937_64 engine(sequence);
  std::uniform_real_distribution<double> unit(0, 1);
  const auto direction = [&] {
    const double z = 2 * unit(engine) - 1, phi = 2 * M_PI * unit(engine);
    const double r = std::sqrt(1 - z * z);
    return Eigen::Vector3d(r * std::cos(phi), r * std::sin(phi), z);
  };
  const Eigen::Vector3d shift = (0.02 + 0.01 * unit(engine)) * direction();
  const double angle = (1.5 + unit(engine)) * kDegree;
  return Eigen::Translation3d(shift) * Eigen::AngleAxisd(angle, direction());
}

Pose fallen_pose(const Eigen::Vector3d& fallen) {
  Pose X_WM = Pose::Identity();
  X_WM.translation() = Eigen::Vector3d(fallen.x(), fallen.y(), kPlateThickness_m);
  // Face up: z, which points into the plate, down.
  X_WM.linear() = (Eigen::AngleAxisd(fallen.z(), Eigen::Vector3d::UnitZ()) *
                   Eigen::AngleAxisd(M_PI, Eigen::Vector3d::UnitX()))
                      .toRotationMatrix();
  return X_WM;
}

bool has(const std::vector<Fault>& faults, std::int8_t kind, const std::string& place, int number) {
  return std::any_of(faults.begin(), faults.end(), [&](const Fault& fault) {
    return fault.kind == kind && fault.place == place && fault.number == number;
  });
}

/// Why there is nothing by the name or number of a command in this scene, naming what there is.
std::string unknown_place(const fault_command_t& command, const Scene& scene) {
  const Robot& robot = scene.robot();
  const auto id_of = [](const auto& tag) { return std::to_string(tag.id); };
  const std::string number = std::to_string(command.number);
  switch (command.fault) {
    case Command::FAULT_STUCK: {
      const auto& signals = scene.signals().signals;
      if (std::any_of(signals.begin(), signals.end(),
                      [&](const Signal& signal) { return signal.name == command.place; }))
        return "";
      return "no signal " + name_of(command.place) + "; there are " +
             listed(signals, [](const Signal& signal) { return signal.name; });
    }
    case Command::FAULT_BEND:
    case Command::FAULT_DRIFT:
      if (link_index(robot, command.place) >= 0) return "";
      return "no link " + name_of(command.place) + "; there are " +
             listed(robot.links, [](const Link& link) { return link.name; });
    case Command::FAULT_TOOL: {
      if (!robot.tool_changer) return "the rig has no tools; robot.yaml may list some";
      const std::vector<Tool>& tools = robot.tool_changer->tools;
      if (command.number >= 0 && command.number < static_cast<int>(tools.size())) return "";
      int count = 0;
      return "no tool " + number + "; there are " + listed(tools, [&](const Tool& tool) {
               return std::to_string(count++) + " (" + tool.name + ")";
             });
    }
    case Command::FAULT_MARKER_LOST:
    case Command::FAULT_MARKER_MOVED:
      if (scene.markers().find(command.number)) return "";
      return "no tag " + number + "; there are " + listed(scene.markers().tags, id_of);
    case Command::FAULT_TARGET:
      if (scene.markers().is_target(command.number)) return "";
      return "no target tag " + number +
             "; target_tags in robot.yaml: " + listed(scene.markers().target_tags, id_of);
    default:
      return "";
  }
}

/// Fault::fallen of a marker that falls off at X_WM.
Eigen::Vector3d fallen_from(const Pose& X_WM) {
  Eigen::Vector2d p = X_WM.translation().head<2>();
  if (p.norm() < kFallenRadius_m) {
    p = p.norm() > 1e-6 ? Eigen::Vector2d(kFallenRadius_m * p.normalized())
                        : Eigen::Vector2d(kFallenRadius_m, 0);
  }
  const Eigen::Vector3d x = X_WM.linear().col(0);
  return {p.x(), p.y(), std::atan2(x.y(), x.x())};
}

}  // namespace

std::string describe(const Fault& fault, const SceneDescription& as_built) {
  std::ostringstream text;
  switch (fault.kind) {
    case Command::FAULT_STUCK:
      text << "stuck " << fault.place;
      break;
    case Command::FAULT_BEND:
      text << "bend " << fault.place << ' ' << fault.amount_deg << " deg";
      break;
    case Command::FAULT_TOOL:
      text << "tool " << fault.number << " ("
           << as_built.robot.tool_changer.value().tools.at(fault.number).name << ")";
      break;
    case Command::FAULT_MARKER_LOST:
      text << "marker-lost " << fault.number;
      break;
    case Command::FAULT_MARKER_MOVED:
      text << "marker-moved " << fault.number;
      break;
    case Command::FAULT_CAMERA_BUMP:
      text << "camera-bump";
      break;
    case Command::FAULT_TARGET:
      text << "target " << fault.number << " at " << fault.target_m.x() << ' ' << fault.target_m.y()
           << ' ' << fault.target_m.z() << " m";
      break;
    default:
      text << "drift " << fault.place << ' ' << fault.amount_deg << " deg per action, "
           << fault.bent_deg << " deg so far";
  }
  return text.str();
}

std::string add_fault(const fault_command_t& command, const Scene& scene, const mjData& data,
                      std::vector<Fault>& faults) {
  if (const std::string problem = unknown_place(command, scene); !problem.empty()) return problem;
  Fault fault;
  fault.kind = command.fault;
  fault.place = command.place;
  fault.number = command.number;
  fault.amount_deg = command.amount_deg;
  const auto is_same_place = [&](const Fault& other) {
    return other.kind == fault.kind && other.place == fault.place && other.number == fault.number;
  };
  switch (command.fault) {
    case Command::FAULT_STUCK:
      std::erase_if(faults, is_same_place);
      break;
    case Command::FAULT_BEND:
    case Command::FAULT_DRIFT:
      if (std::abs(fault.amount_deg) > 90) return "more than 90 deg is no bend";
      // A link has one bend: bends add up, and so does what a drift has done before.
      for (Fault& other : faults) {
        if (!is_same_place(other)) continue;
        if (fault.kind == Command::FAULT_BEND) {
          other.amount_deg += fault.amount_deg;
        } else {
          other.amount_deg = fault.amount_deg;
        }
        return "";
      }
      break;
    case Command::FAULT_TOOL:
      std::erase_if(faults, [&](const Fault& other) { return other.kind == fault.kind; });
      if (fault.number == 0) return "";
      break;
    case Command::FAULT_MARKER_LOST:
    case Command::FAULT_MARKER_MOVED:
      if (has(faults, Command::FAULT_MARKER_LOST, fault.place, fault.number))
        return "tag " + std::to_string(fault.number) + " has fallen off already";
      if (fault.kind == Command::FAULT_MARKER_LOST)
        fault.fallen = fallen_from(scene.marker_pose(data, fault.number));
      break;
    case Command::FAULT_CAMERA_BUMP:
      break;
    case Command::FAULT_TARGET:
      std::erase_if(faults, is_same_place);
      fault.target_m = Eigen::Vector3d(command.target_m);
      break;
    case Command::FAULT_REPAIR:
      faults.clear();
      return "";
    default:
      return "unknown fault " + std::to_string(int{command.fault});
  }
  faults.push_back(fault);
  return "";
}

bool drift(std::vector<Fault>& faults) {
  bool is_drifting = false;
  for (Fault& fault : faults) {
    if (fault.kind != Command::FAULT_DRIFT || fault.amount_deg == 0) continue;
    fault.bent_deg += fault.amount_deg;
    is_drifting = true;
  }
  return is_drifting;
}

SceneDescription broken(const SceneDescription& as_built, const std::vector<Fault>& faults,
                        const Eigen::VectorXd& joint_positions, std::int64_t seed) {
  SceneDescription result = as_built;
  Robot& robot = result.robot;
  // The tool first: where a link ends, and so its middle, depends on it.
  for (const Fault& fault : faults) {
    if (fault.kind == Command::FAULT_TOOL) mount_tool(robot, fault.number);
  }
  int num_bumps = 0;
  for (const Fault& fault : faults) {
    switch (fault.kind) {
      case Command::FAULT_STUCK:
        for (std::size_t i = 0; i < robot.joints.size(); ++i) {
          if (result.signals.signals[robot.joints[i].signal].name == fault.place) {
            robot.joints[i].stuck_at = joint_positions[i];
          }
        }
        break;
      case Command::FAULT_BEND:
        bend(robot, link_index(robot, fault.place), fault.amount_deg * kDegree);
        break;
      case Command::FAULT_DRIFT:
        bend(robot, link_index(robot, fault.place), fault.bent_deg * kDegree);
        break;
      case Command::FAULT_MARKER_LOST:
        result.fallen_tags[fault.number] = fallen_pose(fault.fallen);
        break;
      case Command::FAULT_MARKER_MOVED:
        for (TagPlacement& tag : robot.markers.tags) {
          if (tag.id != fault.number) continue;
          const Pose shift = Eigen::Translation3d(0.2 * tag.size_m, 0.15 * tag.size_m, 0) *
                             Eigen::AngleAxisd(15 * kDegree, Eigen::Vector3d::UnitZ());
          tag.X_BM = tag.X_BM.value_or(Pose::Identity()) * shift;
        }
        break;
      case Command::FAULT_CAMERA_BUMP:
        robot.X_WC = robot.X_WC * bump(seed, num_bumps++);
        break;
      case Command::FAULT_TARGET:
        robot.X_WM_targets.at(fault.number).translation() = as_built.robot.X_WC * fault.target_m;
        break;
      default:
        break;
    }
  }
  return result;
}

}  // namespace bodyschema
