#include "processes/console/urdf_drives.h"

#include <fmt/format.h>
#include <urdf_parser/urdf_parser.h>

#include <algorithm>
#include <stdexcept>
#include <utility>

#include "common/text/text.h"

namespace bodyschema {
namespace {

std::shared_ptr<const urdf::ModelInterface> read_urdf(const std::filesystem::path& file) {
  const auto model = urdf::parseURDF(read_file(file));
  if (!model) throw std::runtime_error(file.string() + ": expected a URDF, see the lines above");
  for (const auto& [name, joint] : model->joints_)
    if (const auto& parent = model->getLink(joint->child_link_name)->parent_joint; parent != joint)
      throw std::runtime_error(fmt::format("{}: link {} is the child of two joints, {} and {}",
                                           file.string(), joint->child_link_name, parent->name,
                                           name));
  return model;
}

}  // namespace

Pose from_urdf(const urdf::Pose& X) {
  return make_pose({X.rotation.w, X.rotation.x, X.rotation.y, X.rotation.z},
                   {X.position.x, X.position.y, X.position.z});
}

UrdfDrives::UrdfDrives(const std::filesystem::path& urdf, const Yaml& placement)
    : urdf_(urdf), model_(read_urdf(urdf)) {
  for (const Yaml& entry : placement.list("signals")) {
    Signal signal;
    signal.name = entry.text("name");
    if (std::ranges::find(signals_, signal.name, &Signal::name) != signals_.end())
      throw entry.error("name", "another signal is called " + signal.name);
    signal.lower = entry.number("lower");
    signal.upper = entry.number("upper", signal.lower);
    if (entry.has("joint")) read_drive(entry);
    signals_.push_back(std::move(signal));
  }
}

void UrdfDrives::read_drive(const Yaml& entry) {
  const std::string joint = entry.text("joint");
  const auto known = model_->getJoint(joint);
  if (!known) throw entry.error("joint", "the URDF has no joint " + joint);
  if (known->type == urdf::Joint::FIXED) throw entry.error("joint", "joint " + joint + " is fixed");
  if (known->mimic)
    throw entry.error(
        "joint", fmt::format("joint {} mimics {} in the URDF: expected the signal there", joint,
                             known->mimic->joint_name));
  Drive drive;
  drive.signal = static_cast<int>(signals_.size());
  drive.gain = entry.number("gain");
  if (drive.gain == 0) throw entry.error("gain", "expected another number than 0");
  drive.offset = entry.number("offset");
  if (!drives_.emplace(joint, drive).second)
    throw entry.error("joint", "joint " + joint + " has a signal already");
}

void UrdfDrives::refuse(const urdf::Joint& joint, const std::string& why) const {
  throw std::runtime_error(urdf_.string() + ": joint " + joint.name + ": " + why);
}

Eigen::Vector3d UrdfDrives::axis_of(const urdf::Joint& joint) const {
  const Eigen::Vector3d axis(joint.axis.x, joint.axis.y, joint.axis.z);
  if (!(axis.norm() > 1e-9)) refuse(joint, "its axis is 0");
  return axis.normalized();
}

Drive UrdfDrives::drive_of(const urdf::Joint& joint) const {
  if (joint.type != urdf::Joint::PRISMATIC && joint.type != urdf::Joint::REVOLUTE &&
      joint.type != urdf::Joint::CONTINUOUS)
    refuse(joint, "expected revolute, continuous, prismatic or fixed");
  // The joint that a mimic follows, and how.
  const urdf::Joint* leader = &joint;
  Drive drive;
  for (int hops = 0; leader->mimic; ++hops) {
    const auto next = model_->getJoint(leader->mimic->joint_name);
    if (!next || hops > 100) refuse(joint, "mimics nothing");
    drive.offset += drive.gain * leader->mimic->offset;
    drive.gain *= leader->mimic->multiplier;
    leader = next.get();
  }
  const auto known = drives_.find(leader->name);
  if (known == drives_.end()) return drive;
  drive.offset += drive.gain * known->second.offset;
  drive.gain *= known->second.gain;
  if (drive.gain != 0) drive.signal = known->second.signal;
  return drive;
}

}  // namespace bodyschema
