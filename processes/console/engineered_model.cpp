#include "processes/console/engineered_model.h"

#include <map>
#include <set>
#include <utility>

#include "common/config/yaml.h"
#include "common/estimation/measurement_model.h"
#include "common/geometry/angle.h"
#include "processes/console/urdf_drives.h"

namespace bodyschema {
namespace {

/// The joints between the last part and the place where a walk over the links stands.
struct Way {
  Pose left = Pose::Identity();
  std::vector<ScrewJoint> joints;
  std::vector<std::string> names;  ///< of the joints

  void move(const Pose& X) {
    Pose& last = joints.empty() ? left : joints.back().X_after;
    last = last * X;
  }
};

class Walk {
 public:
  Walk(const UrdfDrives& drives, const Yaml& yaml) : drives_(drives), model_(drives.model()) {
    schema_.signals = drives.signals();
    std::set<int> parts;
    for (const Yaml& entry : yaml.list("parts")) {
      const int part = static_cast<int>(entry.integer("part", 0, 1'000'000));
      const std::string link = entry.text("link");
      if (!model_.getLink(link)) throw entry.error("link", "the URDF has no link " + link);
      if (!parts.insert(part).second)
        throw entry.error("part", "part " + std::to_string(part) + " stands twice");
      parts_on_[link].emplace_back(part, entry.pose("X_LB"));
    }
    schema_.parts.assign(parts.begin(), parts.end());
    schema_.root = static_cast<int>(yaml.integer("root"));
    if (!parts.contains(schema_.root)) throw yaml.error("root", "expected one of the parts");
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
  const std::vector<std::string>& joints() const { return joints_; }

 private:
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
    const Drive drive = drives_.drive_of(joint);
    Pose X_JZ = Pose::Identity();  // z along the axis
    X_JZ.linear() = rotation_of_z_to(drives_.axis_of(joint));
    way->move(X_JZ);
    if (drive.signal < 0) {  // stands still
      Vector6d twist = Vector6d::Zero();
      twist(slides ? 2 : 5) = sense * drive.offset;
      way->move(exp(twist) * X_JZ.inverse());
      return;
    }
    ScrewJoint screw;
    screw.signal = drive.signal;
    screw.offset = drive.offset / drive.gain;
    (slides ? screw.slide : screw.turn) = sense * drive.gain;
    screw.X_after = X_JZ.inverse();
    way->joints.push_back(screw);
    way->names.push_back(joint.name);
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
    joints_.insert(joints_.end(), way.names.begin(), way.names.end());
  }

  const UrdfDrives& drives_;
  const urdf::ModelInterface& model_;
  BodySchema schema_;
  std::vector<std::string> joints_;                                    // of all edges
  std::map<std::string, std::vector<std::pair<int, Pose>>> parts_on_;  // by link
  Noise uncertainty_;                                                  // of an edge, per axis
};

}  // namespace

BodySchema engineered_model(const std::filesystem::path& urdf,
                            const std::filesystem::path& placement,
                            std::vector<std::string>* joints) {
  const Yaml yaml = Yaml::load(placement);
  const UrdfDrives drives(urdf, yaml);
  Walk walk(drives, yaml);
  yaml.finish();
  BodySchema schema = walk.run();
  if (joints) *joints = walk.joints();
  return schema;
}

}  // namespace bodyschema
