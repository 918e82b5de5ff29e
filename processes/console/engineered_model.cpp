#include "processes/console/engineered_model.h"

#include <urdf_model/model.h>
#include <urdf_parser/urdf_parser.h>

#include <algorithm>
#include <fstream>
#include <map>
#include <set>
#include <sstream>
#include <stdexcept>
#include <utility>
#include <vector>

#include "common/config/yaml.h"
#include "common/estimation/measurement_model.h"
#include "common/geometry/angle.h"

namespace bodyschema {
namespace {

Pose from_urdf(const urdf::Pose& X) {
  return make_pose({X.rotation.w, X.rotation.x, X.rotation.y, X.rotation.z},
                   {X.position.x, X.position.y, X.position.z});
}

urdf::ModelInterfaceSharedPtr read_urdf(const std::filesystem::path& file) {
  std::ifstream stream(file);
  if (!stream) throw std::runtime_error(file.string() + ": cannot be read");
  std::stringstream text;
  text << stream.rdbuf();
  const auto model = urdf::parseURDF(text.str());
  if (!model) throw std::runtime_error(file.string() + ": expected a URDF, see the lines above");
  return model;
}

/// An action signal and the joint that it moves.
struct Drive {
  int signal = 0;
  double gain = 1;    ///< [rad or m per command unit]
  double offset = 0;  ///< [rad or m]
};

/// The joints between the last part and the place where a walk over the links stands.
struct Way {
  Pose left = Pose::Identity();
  std::vector<ScrewJoint> joints;

  void move(const Pose& X) {
    Pose& last = joints.empty() ? left : joints.back().X_after;
    last = last * X;
  }
};

class Walk {
 public:
  Walk(const urdf::ModelInterface& model, const std::filesystem::path& urdf, const Yaml& yaml)
      : model_(model), urdf_(urdf) {
    for (const Yaml& entry : yaml.list("signals")) read_signal(entry);
    std::set<int> parts;
    for (const Yaml& entry : yaml.list("parts")) {
      const int part = static_cast<int>(entry.integer("part", 0, 1'000'000));
      const std::string link = entry.text("link");
      if (!model.getLink(link)) throw entry.error("link", "the URDF has no link " + link);
      if (!parts.insert(part).second)
        throw entry.error("part", "part " + std::to_string(part) + " stands twice");
      parts_on_[link].emplace_back(part, entry.pose("X_LB"));
    }
    schema_.parts.assign(parts.begin(), parts.end());
    schema_.root = static_cast<int>(yaml.integer("root"));
    if (!parts.count(schema_.root)) throw yaml.error("root", "expected one of the parts");
    const Yaml uncertainty = yaml.section("uncertainty");
    uncertainty_.position_m = uncertainty.number("position_m", 0, 1);
    uncertainty_.rotation_rad = uncertainty.number("rotation_deg", 0, 180) * kDegree;
  }

  BodySchema run() {
    for (const auto& [link, parts] : parts_on_) {
      for (const auto& [part, X_LB] : parts) {
        if (part != schema_.root) continue;
        Way way;
        way.move(X_LB.inverse());
        visit(*model_.getLink(link), nullptr, schema_.root, std::move(way));
      }
    }
    schema_.complete = schema_.edges.size() + 1 == schema_.parts.size();
    return schema_;
  }

 private:
  void read_signal(const Yaml& entry) {
    Signal signal;
    signal.name = entry.text("name");
    signal.lower = entry.number("lower");
    signal.upper = entry.number("upper", signal.lower);
    if (entry.has("joint")) read_drive(entry);
    schema_.signals.push_back(std::move(signal));
  }

  void read_drive(const Yaml& entry) {
    const std::string joint = entry.text("joint");
    const auto known = model_.getJoint(joint);
    if (!known) throw entry.error("joint", "the URDF has no joint " + joint);
    if (known->type == urdf::Joint::FIXED)
      throw entry.error("joint", "joint " + joint + " is fixed");
    Drive drive;
    drive.signal = static_cast<int>(schema_.signals.size());
    drive.gain = entry.number("gain");
    if (drive.gain == 0) throw entry.error("gain", "expected another number than 0");
    drive.offset = entry.number("offset");
    if (!drives_.emplace(joint, drive).second)
      throw entry.error("joint", "joint " + joint + " has a signal already");
  }

  /// From `link` to all its neighbours but the one that the walk came by. `from` is the last part.
  void visit(const urdf::Link& link, const urdf::Joint* came_by, int from, Way way) {
    if (const auto on = parts_on_.find(link.name); on != parts_on_.end()) {
      // The first part that the walk meets carries what follows; others on its link hang on it.
      bool is_first = came_by != nullptr;
      for (const auto& [part, X_LB] : on->second) {
        if (part == schema_.root) continue;
        Way there = way;
        there.move(X_LB);
        add_edge(from, part, there);
        if (!std::exchange(is_first, false)) continue;
        from = part;
        way = Way();
        way.move(X_LB.inverse());
      }
    }
    if (link.parent_joint && link.parent_joint.get() != came_by) {
      const urdf::Joint& joint = *link.parent_joint;
      Way there = way;
      cross(joint, -1, &there);
      there.move(from_urdf(joint.parent_to_joint_origin_transform).inverse());
      visit(*model_.getLink(joint.parent_link_name), &joint, from, std::move(there));
    }
    for (const auto& joint : link.child_joints) {
      if (joint.get() == came_by) continue;
      Way there = way;
      there.move(from_urdf(joint->parent_to_joint_origin_transform));
      cross(*joint, 1, &there);
      visit(*model_.getLink(joint->child_link_name), joint.get(), from, std::move(there));
    }
  }

  void cross(const urdf::Joint& joint, double sense, Way* way) const {
    if (joint.type == urdf::Joint::FIXED) return;
    const bool slides = joint.type == urdf::Joint::PRISMATIC;
    const auto refuse = [&](const std::string& why) {
      throw std::runtime_error(urdf_.string() + ": joint " + joint.name + ": " + why);
    };
    if (!slides && joint.type != urdf::Joint::REVOLUTE && joint.type != urdf::Joint::CONTINUOUS)
      refuse("expected revolute, continuous, prismatic or fixed");
    const Eigen::Vector3d axis(joint.axis.x, joint.axis.y, joint.axis.z);
    if (!(axis.norm() > 1e-9)) refuse("its axis is 0");
    // The joint that a mimic follows, and how.
    const urdf::Joint* leader = &joint;
    double gain = 1, offset = 0;
    for (int hops = 0; leader->mimic; ++hops) {
      const auto next = model_.getJoint(leader->mimic->joint_name);
      if (!next || hops > 100) refuse("mimics nothing");
      offset += gain * leader->mimic->offset;
      gain *= leader->mimic->multiplier;
      leader = next.get();
    }
    Pose X_JZ = Pose::Identity();  // z along the axis
    X_JZ.linear() = rotation_of_z_to(axis);
    const auto drive = drives_.find(leader->name);
    if (drive != drives_.end()) {
      offset += gain * drive->second.offset;
      gain *= drive->second.gain;
    }
    way->move(X_JZ);
    if (drive == drives_.end() || gain == 0) {  // stands still
      Vector6d twist = Vector6d::Zero();
      twist(slides ? 2 : 5) = sense * offset;
      way->move(exp(twist) * X_JZ.inverse());
      return;
    }
    ScrewJoint screw;
    screw.signal = drive->second.signal;
    screw.offset = offset / gain;
    (slides ? screw.slide : screw.turn) = sense * gain;
    screw.X_after = X_JZ.inverse();
    way->joints.push_back(screw);
  }

  void add_edge(int from, int to, const Way& way) {
    Edge edge;
    edge.from = from;
    edge.to = to;
    edge.left = way.left;
    edge.joints = way.joints;
    const Eigen::Index size = edge.num_parameters();
    edge.parameter_covariance = Eigen::MatrixXd::Zero(size, size);
    edge.parameter_covariance.bottomRightCorner<6, 6>() = isotropic(uncertainty_);
    schema_.edges.push_back(std::move(edge));
  }

  const urdf::ModelInterface& model_;
  const std::filesystem::path urdf_;
  BodySchema schema_;
  std::map<std::string, Drive> drives_;                                // by joint
  std::map<std::string, std::vector<std::pair<int, Pose>>> parts_on_;  // by link
  Noise uncertainty_;                                                  // of an edge, per axis
};

}  // namespace

BodySchema engineered_model(const std::filesystem::path& urdf,
                            const std::filesystem::path& placement) {
  const auto model = read_urdf(urdf);
  const Yaml yaml = Yaml::load(placement);
  Walk walk(*model, urdf, yaml);
  yaml.finish();
  return walk.run();
}

}  // namespace bodyschema
