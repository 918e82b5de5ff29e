#include "common/scene/robot.h"

#include <algorithm>
#include <cmath>
#include <set>
#include <sstream>

#include "common/config/yaml.h"
#include "common/geometry/angle.h"

namespace bodyschema {
namespace {

Pose pose_or_identity(const Yaml& yaml, const std::string& key) {
  return yaml.has(key) ? yaml.pose(key) : Pose::Identity();
}

Shape load_shape(const Yaml& yaml) {
  Shape shape;
  const std::string kind = yaml.choice("shape", {"box", "cylinder", "capsule", "sphere"});
  if (kind == "box") {
    shape.kind = Shape::Kind::kBox;
    shape.half_size_m = Eigen::Vector3d(yaml.numbers("size_m", 3, 1e-4, 10).data()) / 2;
  } else {
    shape.half_size_m.x() = yaml.number("radius_m", 1e-4, 10);
    if (kind != "sphere") shape.half_size_m.y() = yaml.number("length_m", 1e-4, 10) / 2;
    shape.kind = kind == "cylinder"  ? Shape::Kind::kCylinder
                 : kind == "capsule" ? Shape::Kind::kCapsule
                                     : Shape::Kind::kSphere;
  }
  shape.X_LS = pose_or_identity(yaml, "X_LS");
  shape.mass_kg = yaml.number("mass_kg", 0, 1000);
  shape.grey = yaml.number("grey", 0.05, 1);
  if (yaml.has("collides")) shape.collides = yaml.boolean("collides");
  return shape;
}

Servo load_servo(const Yaml& yaml) {
  return {yaml.number("stiffness_nm_per_rad", 1e-3, 1e6),
          yaml.number("damping_nms_per_rad", 1e-3, 1e6), yaml.number("armature_kgm2", 0, 100)};
}

int signal_index(const Signals& signals, const Yaml& yaml, const std::string& key) {
  std::vector<std::string> names;
  for (const Signal& signal : signals.signals) names.push_back(signal.name);
  const std::string name = yaml.choice(key, names);
  return static_cast<int>(std::find(names.begin(), names.end(), name) - names.begin());
}

RobotJoint load_joint(const Yaml& yaml, const Servo& servo, const Signals& signals) {
  RobotJoint joint;
  joint.name = yaml.text("name");
  const bool is_revolute = yaml.choice("type", {"revolute", "prismatic"}) == "revolute";
  joint.kind = is_revolute ? RobotJoint::Kind::kRevolute : RobotJoint::Kind::kPrismatic;
  joint.axis = Eigen::Vector3d(yaml.numbers("axis", 3, -1e6, 1e6).data());
  if (joint.axis.norm() < 1e-9) throw yaml.error("axis", "must not be zero");
  joint.axis.normalize();
  const std::string unit = is_revolute ? "_deg" : "_m";
  const double scale = is_revolute ? kDegree : 1;
  const std::vector<double> range = yaml.numbers("range" + unit, 2, -1e6, 1e6);
  if (range[0] >= range[1]) throw yaml.error("range" + unit, "must ascend");
  joint.lower = range[0] * scale;
  joint.upper = range[1] * scale;
  joint.max_speed = yaml.number("max_speed" + unit + "_per_s", 1e-3, 1e4) * scale;
  joint.servo = yaml.has("servo") ? load_servo(yaml.section("servo")) : servo;
  joint.signal = signal_index(signals, yaml, "signal");
  // A joint may need very small or large commands; what it does is bounded by its range.
  joint.gain = yaml.number("gain" + unit + "_per_unit", -1e9, 1e9) * scale;
  joint.offset = yaml.number("offset" + unit, -1e6, 1e6) * scale;
  return joint;
}

CameraCalibration load_lens(const Yaml& yaml) {
  CameraCalibration lens;
  const std::vector<double> size = yaml.numbers("size_px", 2, 32, 32768);
  const std::vector<double> focal_length = yaml.numbers("focal_length_px", 2, 1, 1e6);
  const std::vector<double> centre = yaml.numbers("centre_px", 2, 0, 32768);
  lens.width = static_cast<int>(size[0]);
  lens.height = static_cast<int>(size[1]);
  lens.fx = focal_length[0];
  lens.fy = focal_length[1];
  lens.cx = centre[0];
  lens.cy = centre[1];
  const std::string model =
      yaml.choice("model", {"plumb_bob", "rational_polynomial", "equidistant"});
  using Model = CameraCalibration::Model;
  lens.model = model == "plumb_bob"     ? Model::kPlumbBob
               : model == "equidistant" ? Model::kFisheye
                                        : Model::kRational;
  const int count = lens.model == Model::kPlumbBob ? 5 : lens.model == Model::kFisheye ? 4 : 8;
  lens.distortion = yaml.numbers("distortion", count, -1e4, 1e4);
  return lens;
}

ToolChanger load_tool_changer(const Yaml& yaml, const std::vector<std::string>& link_names) {
  ToolChanger changer;
  const std::string link = yaml.choice("link", link_names);
  changer.link =
      static_cast<int>(std::find(link_names.begin(), link_names.end(), link) - link_names.begin());
  changer.X_LF = yaml.pose("X_LF");
  changer.tools.push_back({yaml.text("mounted"), Pose::Identity(), {}});
  for (const Yaml& item : yaml.list("others")) {
    Tool tool;
    tool.name = item.text("name");
    tool.X_FT = item.pose("X_FT");
    for (const Yaml& shape : item.list("shapes")) tool.shapes.push_back(load_shape(shape));
    changer.tools.push_back(std::move(tool));
  }
  return changer;
}

/// All links and their joints. Returns the links' names.
std::vector<std::string> load_links(const Yaml& yaml, const Servo& servo, const Signals& signals,
                                    Robot* robot) {
  std::vector<std::string> names{"world"};
  std::set<std::string> joint_names;
  std::set<int> driving;
  for (const Yaml& item : yaml.list("links")) {
    Link link;
    link.name = item.text("name");
    link.parent = item.choice("parent", names);
    if (std::find(names.begin(), names.end(), link.name) != names.end()) {
      throw item.error("name", "this name stands twice");
    }
    names.push_back(link.name);
    link.X_PL = pose_or_identity(item, "X_PL");
    if (item.has("joint")) {
      const Yaml section = item.section("joint");
      robot->joints.push_back(load_joint(section, servo, signals));
      if (!joint_names.insert(robot->joints.back().name).second) {
        throw section.error("name", "this name stands twice");
      }
      driving.insert(robot->joints.back().signal);
      link.joint = static_cast<int>(robot->joints.size()) - 1;
    }
    double mass_kg = 0;
    for (const Yaml& shape : item.list("shapes")) {
      link.shapes.push_back(load_shape(shape));
      mass_kg += link.shapes.back().mass_kg;
    }
    if (link.joint && mass_kg <= 0) throw item.error("shapes", "a moving link needs a mass");
    robot->links.push_back(std::move(link));
  }
  for (std::size_t i = 0; i < signals.signals.size(); ++i) {
    if (!driving.contains(static_cast<int>(i))) {
      throw yaml.error("links", "no joint is driven by signal " + signals.signals[i].name);
    }
  }
  return {names.begin() + 1, names.end()};
}

/// Where the parts are. Returns their numbers, which ascend.
std::vector<int> load_parts(const Yaml& yaml, const Markers& markers,
                            const std::vector<std::string>& link_names, Robot* robot) {
  for (const Yaml& item : yaml.list("parts")) {
    PartPlacement part;
    part.part = static_cast<int>(item.integer("part", 0, 9999));
    const std::string link = item.choice("link", link_names);
    part.link = static_cast<int>(std::find(link_names.begin(), link_names.end(), link) -
                                 link_names.begin());
    part.X_LB = item.pose("X_LB");
    robot->parts.push_back(part);
  }
  std::stable_sort(robot->parts.begin(), robot->parts.end(),
                   [](const auto& a, const auto& b) { return a.part < b.part; });
  std::vector<int> parts;
  for (const PartPlacement& part : robot->parts) parts.push_back(part.part);
  if (parts != markers.parts()) {
    throw yaml.error("parts", "must be the parts of markers.yaml, each once");
  }
  return parts;
}

}  // namespace

Eigen::VectorXd Robot::joint_positions(const Eigen::VectorXd& action) const {
  if (action.size() != home.size()) {
    throw std::invalid_argument("an action of this robot has " + std::to_string(home.size()) +
                                " signals, not " + std::to_string(action.size()));
  }
  Eigen::VectorXd positions(joints.size());
  for (std::size_t i = 0; i < joints.size(); ++i) {
    const RobotJoint& joint = joints[i];
    positions[i] = joint.stuck_at.value_or(joint.gain * action[joint.signal] + joint.offset);
  }
  return positions;
}

std::optional<std::string> Robot::beyond_range(const Eigen::VectorXd& joint_positions) const {
  for (std::size_t i = 0; i < joints.size(); ++i) {
    const RobotJoint& joint = joints[i];
    const double position = joint_positions[i];
    // A nanometre of tolerance: limits that were converted from degrees must be reachable.
    if (joint.stuck_at) continue;
    if (position >= joint.lower - 1e-9 && position <= joint.upper + 1e-9) continue;
    const bool is_revolute = joint.kind == RobotJoint::Kind::kRevolute;
    const double scale = is_revolute ? 1 / kDegree : 1;
    std::ostringstream text;
    text << "joint " << joint.name << " would be at " << position * scale << ", beyond "
         << joint.lower * scale << " … " << joint.upper * scale << (is_revolute ? " deg" : " m");
    return text.str();
  }
  return std::nullopt;
}

Robot load_robot(const std::filesystem::path& rig_folder, const Signals& signals,
                 const Markers& markers) {
  const Yaml yaml = Yaml::load(rig_folder / "robot.yaml");
  Robot robot;
  robot.name = yaml.text("name");
  robot.X_WC = yaml.pose("X_WC");
  robot.lens = load_lens(yaml.section("lens"));
  if (yaml.has("calibration_error"))
    robot.calibration_error = CalibrationError::load(yaml.section("calibration_error"));
  const Servo servo = load_servo(yaml.section("servo"));

  const std::vector<double> home = yaml.numbers("home", static_cast<int>(signals.signals.size()));
  robot.home = Eigen::Map<const Eigen::VectorXd>(home.data(), home.size());
  for (std::size_t i = 0; i < home.size(); ++i) {
    if (home[i] < signals.signals[i].lower || home[i] > signals.signals[i].upper) {
      throw yaml.error("home", signals.signals[i].name + " is outside its limits");
    }
  }

  const std::vector<std::string> link_names = load_links(yaml, servo, signals, &robot);
  const std::vector<int> parts = load_parts(yaml, markers, link_names, &robot);

  robot.markers.family = markers.family;
  robot.markers.tags = load_tags(yaml);
  robot.markers.target_tags = load_target_tags(yaml, robot.markers.tags, &robot.X_WM_targets);
  for (auto& [id, X_M] : robot.X_WM_targets) X_M = robot.X_WC * X_M;
  for (const TagPlacement& tag : robot.markers.tags) {
    if (!std::binary_search(parts.begin(), parts.end(), tag.part))
      throw yaml.error("tags", "part " + std::to_string(tag.part) + " is not in parts");
  }

  for (const Yaml& item : yaml.list("may_touch")) {
    robot.may_touch.emplace_back(item.choice("link", link_names), item.choice("other", link_names));
  }
  if (yaml.has("tools")) {
    robot.tool_changer = load_tool_changer(yaml.section("tools"), link_names);
  }
  yaml.finish();
  if (const auto problem = robot.beyond_range(robot.joint_positions(robot.home))) {
    throw yaml.error("home", *problem);
  }
  return robot;
}

}  // namespace bodyschema
