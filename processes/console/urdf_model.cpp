#include "processes/console/urdf_model.h"

#include <fmt/format.h>
#include <tinyxml2.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <optional>
#include <set>
#include <stdexcept>
#include <utility>

#include "common/config/yaml.h"
#include "common/geometry/angle.h"
#include "common/kinematics/screw_chain.h"
#include "common/schema/standard_deviations.h"
#include "common/text/text.h"
#include "processes/console/names.h"
#include "processes/console/pure_joints.h"

namespace bodyschema {
namespace {

using tinyxml2::XMLElement;

/// What the samples do not tell. Limits of 0 mean "not known" to planners; engines of dynamics
/// refuse a moving link without a mass.
constexpr const char* kEffort = "0";
constexpr const char* kMass = "1";        // [kg]
constexpr const char* kInertia = "0.01";  // [kg m²], about each axis
/// Of lengths [m], angles [rad] and axes: what is less is rounding.
constexpr double kRounding = 1e-16;

std::string number(double value) {
  return fmt::format("{}", std::abs(value) < kRounding ? 0.0 : value);
}

std::string text(const Eigen::Vector3d& v) {
  return number(v.x()) + " " + number(v.y()) + " " + number(v.z());
}

/// R = Rz(y) Ry(p) Rx(r). Whatever the yaw, roll and pitch make up for it, also where the pitch is
/// a right angle and the yaw is anything.
Eigen::Vector3d rpy_of(const Eigen::Matrix3d& R) {
  const double yaw = std::atan2(R(1, 0), R(0, 0));
  const Eigen::Matrix3d rest =
      Eigen::AngleAxisd(-yaw, Eigen::Vector3d::UnitZ()).toRotationMatrix() * R;
  return {std::atan2(-rest(1, 2), rest(1, 1)), std::atan2(-rest(2, 0), rest(0, 0)), yaw};
}

/// Names that stand once.
class Names {
 public:
  void reserve(const std::string& name) { taken_.insert(name); }
  /// `wanted`, or with a number behind it.
  std::string unique(const std::string& wanted) {
    std::string name = wanted;
    for (int n = 2; !taken_.insert(name).second; ++n) name = fmt::format("{}_{}", wanted, n);
    return name;
  }

 private:
  std::set<std::string> taken_;
};

/// A link on the way to a part, and the joint that carries it.
struct Hop {
  const ScrewJoint* joint = nullptr;  ///< null: fixed by construction
  Pose X_before = Pose::Identity();   ///< the link in the one before, at joint position 0
  Eigen::Vector3d axis = Eigen::Vector3d::UnitZ();  ///< in the link's frame
  double gain = 0;                                  ///< [rad or m per command unit]; 0: fixed
  double offset = 0;                                ///< [rad or m]

  bool is_moving() const { return gain != 0; }
  bool is_turning() const { return is_moving() && joint->turn != 0; }
};

/// The joint with its axis along that of its frame, in which the next link's frame is X_JN.
Hop hop_over(const ScrewJoint& joint, const Pose& X_JN) {
  const double rate = joint.turn != 0 ? joint.turn : joint.slide;
  Hop hop;
  hop.joint = &joint;
  hop.axis = X_JN.linear().row(2).transpose();
  hop.gain = joint.gain * rate;
  hop.offset = joint.offset * rate;
  return hop;
}

/// From the end to the start, because where a link's frame is depends on the next.
std::vector<Hop> hops_of(const Edge& edge) {
  std::vector<Hop> hops;
  Pose X_JN = edge.right;  // the next link, at joint position 0, in the frame before it
  for (std::size_t d = edge.joints.size(); d-- > 0;) {
    const ScrewJoint& joint = edge.joints[d];
    X_JN = joint.X_after * X_JN;
    const Hop hop = hop_over(joint, X_JN);
    Pose X_tail = Pose::Identity();  // from this link's frame to the next
    if (hop.is_turning()) {
      const Eigen::Vector3d lever(X_JN.translation().x(), X_JN.translation().y(), 0);
      X_tail.translation() = X_JN.linear().transpose() * lever;
      X_JN.translation() -= lever;
      if (hops.empty()) hops.emplace_back();  // the part's own link
    }
    if (!hops.empty()) hops.back().X_before = X_tail;
    hops.push_back(hop);
    if (!hop.is_moving()) {  // stands where its offset holds it
      Screw{joint.slide, joint.turn}.prepend_motion(joint.offset, X_JN.linear(),
                                                    X_JN.translation());
    }
  }
  if (hops.empty()) hops.emplace_back();
  hops.back().X_before = edge.left * X_JN;
  std::ranges::reverse(hops);
  return hops;
}

/// The first joint that a signal moves; the others mimic it.
struct Leader {
  std::string joint;
  double gain = 1;
  double offset = 0;
};

class Writer {
 public:
  Writer(const BodySchema& original, const PureJoints& pure)
      : original_(original),
        pure_(pure),
        schema_(pure.schema),
        middle_(original.displacements(mid_range(original.signals))),
        leaders_(schema_.signals.size()) {
    for (const Signal& signal : schema_.signals) joint_names_.reserve(signal.name);
  }

  UrdfModel run() {
    robot_ = document_.NewElement("robot");
    robot_->SetAttribute("name", "body_schema");
    document_.InsertEndChild(document_.NewDeclaration());
    document_.InsertEndChild(robot_);
    add_head();
    add_link(link_of(schema_.root), false);
    for (const std::size_t edge : order_of_edges()) add_edge(edge);
    add_idle_signals();
    tinyxml2::XMLPrinter printer;
    document_.Print(&printer);
    result_.urdf = printer.CStr();
    result_.placement = placement();
    return std::move(result_);
  }

 private:
  static std::string link_of(int part) { return fmt::format("part_{}", part); }
  const Signal& signal_of(const ScrewJoint& joint) const {
    return schema_.signals[static_cast<std::size_t>(joint.signal)];
  }

  /// XML has no "--" in a comment.
  void comment(std::string text) {
    for (std::size_t at; (at = text.find("--")) != std::string::npos;) text.insert(at + 1, " ");
    robot_->InsertEndChild(document_.NewComment((" " + text + " ").c_str()));
  }
  /// In the comments and in the result.
  void remark(const std::string& text) {
    comment(text);
    result_.remarks.push_back(text);
  }

  void add_head() {
    comment(fmt::format(
        "A body schema, version {}, learned from {}. Link part_N is the frame of part N. "
        "Joint position [rad, m] = gain * command + offset, as the placement file says. "
        "± is one standard deviation, of an axis per direction across it.",
        schema_.version, counted(schema_.num_samples, "sample")));
    comment(
        fmt::format("Not known: efforts and velocities, which are 0 here; masses and inertias: "
                    "{} kg and {} kg m2 on links that move, for programs that refuse none.",
                    kMass, kInertia));
    for (const std::string& about : pure_.about_signals) remark(about);
  }

  /// By their depth in the tree, then by part, whatever order the schema has them in.
  std::vector<std::size_t> order_of_edges() const {
    std::map<int, int> depths = {{schema_.root, 0}};  // by part
    std::vector<std::size_t> order;
    for (std::size_t e = 0; e < schema_.edges.size(); ++e) {
      depths[schema_.edges[e].to] = depths.at(schema_.edges[e].from) + 1;
      order.push_back(e);
    }
    std::ranges::sort(order, {}, [&](std::size_t e) {
      const int part = schema_.edges[e].to;
      return std::pair(depths.at(part), part);
    });
    return order;
  }

  void add_edge(std::size_t index) {
    const Edge& edge = schema_.edges[index];
    describe(index);
    const std::vector<Hop> hops = hops_of(edge);
    std::string parent = link_of(edge.from);
    for (std::size_t h = 0; h < hops.size(); ++h) {
      const bool is_last = h + 1 == hops.size();
      const std::string link =
          is_last ? link_of(edge.to) : fmt::format("{}_link_{}", link_of(edge.to), h + 1);
      if (hops[h].joint != nullptr) describe(index, *hops[h].joint);
      add_link(link, hops[h].is_moving());
      add_joint(hops[h], parent, link);
      parent = link;
    }
  }

  /// What is to be known of an edge.
  void describe(std::size_t index) {
    const Edge& edge = schema_.edges[index];
    const Noise sd = deviations_of(original_.edges[index].prediction_covariance(middle_));
    const std::string rotation =
        schema_.has_rotation(edge.to) ? fmt::format(", {:.2g} deg", sd.rotation_rad / kDegree) : "";
    comment(fmt::format("part {} in part {}, commands at mid-range: ± {:.2g} mm{} per axis",
                        edge.to, edge.from, sd.position_m * 1e3, rotation));
    if (edge.state != EdgeState::kOk)
      remark(fmt::format("{}→{}: {}", edge.from, edge.to, name_in(kEdgeStateWords, edge.state)));
    if (!schema_.has_rotation(edge.to))
      remark(
          fmt::format("part {}: its position alone is known; link {} is turned as its last joint",
                      edge.to, link_of(edge.to)));
    std::map<int, std::vector<std::string>> open;
    for (const ScrewJoint& joint : edge.joints)
      if (joint.order_group >= 0) open[joint.order_group].push_back(signal_of(joint).name);
    for (const auto& [group, names] : open)
      remark(fmt::format("{}→{}: the samples leave the order of {} open", edge.from, edge.to,
                         listed(names)));
    if (const auto about = pure_.about_edges.find(index); about != pure_.about_edges.end())
      for (const std::string& text : about->second) remark(text);
  }

  /// What is to be known of a joint of an edge.
  void describe(std::size_t edge_index, const ScrewJoint& joint) {
    const Edge& edge = schema_.edges[edge_index];
    const std::string& name = signal_of(joint).name;
    if (joint.gain == 0) {
      comment(
          fmt::format("{}: stuck at {:.4g} {}", name,
                      joint.offset * (joint.turn != 0 ? joint.turn / kDegree : joint.slide * 1e3),
                      joint.turn != 0 ? "deg" : "mm"));
      return;
    }
    const std::vector<JointDeviation> deviations =
        joint_deviations(original_.edges[edge_index], middle_);
    const auto d = static_cast<std::size_t>(&joint - edge.joints.data());
    if (d >= deviations.size()) return;
    const JointDeviation& sd = deviations[d];
    std::string text = name + ":";
    if (joint.turn != 0) text += fmt::format(" axis ± {:.2g} mm,", sd.axis_position_m * 1e3);
    text += fmt::format(" axis ± {:.2g} deg, position ± ", sd.axis_tilt_rad / kDegree);
    if (joint.turn != 0)
      text += fmt::format("{:.2g} deg, gain ± {:.2g} rad per unit", sd.displacement_rad / kDegree,
                          std::abs(joint.gain) * sd.turn);
    else
      text += fmt::format("{:.2g} mm, gain ± {:.2g} m per unit", sd.displacement_m * 1e3,
                          std::abs(joint.gain) * sd.slide);
    comment(text);
  }

  void add_link(const std::string& name, bool is_moving) {
    ++result_.num_links;
    XMLElement* link = robot_->InsertNewChildElement("link");
    link->SetAttribute("name", name.c_str());
    if (!is_moving) return;
    XMLElement* inertial = link->InsertNewChildElement("inertial");
    inertial->InsertNewChildElement("mass")->SetAttribute("value", kMass);
    XMLElement* inertia = inertial->InsertNewChildElement("inertia");
    for (const char* axis : {"ixx", "iyy", "izz"}) inertia->SetAttribute(axis, kInertia);
    for (const char* axes : {"ixy", "ixz", "iyz"}) inertia->SetAttribute(axes, "0");
  }

  void add_joint(const Hop& hop, const std::string& parent, const std::string& child) {
    XMLElement* joint = robot_->InsertNewChildElement("joint");
    const std::string fixed = hop.joint ? signal_of(*hop.joint).name + "_stuck" : child + "_fixed";
    const std::string name = hop.is_moving() ? moving_name(hop) : joint_names_.unique(fixed);
    joint->SetAttribute("name", name.c_str());
    joint->SetAttribute("type", type_of(hop));
    joint->InsertNewChildElement("parent")->SetAttribute("link", parent.c_str());
    joint->InsertNewChildElement("child")->SetAttribute("link", child.c_str());
    XMLElement* origin = joint->InsertNewChildElement("origin");
    origin->SetAttribute("xyz", text(hop.X_before.translation()).c_str());
    origin->SetAttribute("rpy", text(rpy_of(hop.X_before.linear())).c_str());
    if (hop.is_moving()) add_motion(hop, name, joint);
  }

  std::string moving_name(const Hop& hop) {
    const std::optional<Leader>& leader = leaders_[static_cast<std::size_t>(hop.joint->signal)];
    const std::string& name = signal_of(*hop.joint).name;
    // The signal's name is reserved; of two signals of one name the second has none.
    if (!leader && given_.insert(name).second) return name;
    return joint_names_.unique(name);
  }

  const char* type_of(const Hop& hop) const {
    if (!hop.is_moving()) return "fixed";
    if (!hop.is_turning()) return "prismatic";
    const Signal& signal = signal_of(*hop.joint);
    return signal.lower < signal.upper ? "revolute" : "continuous";
  }

  void add_motion(const Hop& hop, const std::string& name, XMLElement* joint) {
    ++result_.num_moving_joints;
    const Signal& signal = signal_of(*hop.joint);
    joint->InsertNewChildElement("axis")->SetAttribute("xyz", text(hop.axis).c_str());
    XMLElement* limit = joint->InsertNewChildElement("limit");
    if (!hop.is_turning() || signal.lower < signal.upper) {
      const double ends[] = {hop.gain * signal.lower + hop.offset,
                             hop.gain * signal.upper + hop.offset};
      limit->SetAttribute("lower", number(std::min(ends[0], ends[1])).c_str());
      limit->SetAttribute("upper", number(std::max(ends[0], ends[1])).c_str());
    }
    limit->SetAttribute("effort", kEffort);
    limit->SetAttribute("velocity", kEffort);
    std::optional<Leader>& leader = leaders_[static_cast<std::size_t>(hop.joint->signal)];
    if (!leader) {
      leader = Leader{name, hop.gain, hop.offset};
      return;
    }
    const double multiplier = hop.gain / leader->gain;
    XMLElement* mimic = joint->InsertNewChildElement("mimic");
    mimic->SetAttribute("joint", leader->joint.c_str());
    mimic->SetAttribute("multiplier", fmt::format("{}", multiplier).c_str());
    mimic->SetAttribute("offset", number(hop.offset - multiplier * leader->offset).c_str());
  }

  void add_idle_signals() {
    for (std::size_t s = 0; s < leaders_.size(); ++s) {
      const auto& open = schema_.undecided_signals;
      const bool is_open = std::ranges::count(open, static_cast<int>(s)) > 0;
      if (!leaders_[s])
        remark(fmt::format("{}: moves nothing{}", schema_.signals[s].name,
                           is_open ? ", as far as the samples tell" : ""));
    }
  }

  std::string placement() const {
    double position = 0, rotation = 0;  // mean squares
    for (const Edge& edge : schema_.edges) {
      position +=
          std::pow(edge.position_rms_m, 2) / (3.0 * static_cast<double>(schema_.edges.size()));
      rotation +=
          std::pow(edge.rotation_rms_rad, 2) / (3.0 * static_cast<double>(schema_.edges.size()));
    }
    std::string text = fmt::format(
        "root: {}\nuncertainty: {{position_m: {:.3g}, rotation_deg: {:.3g}}}\nsignals:{}\n",
        schema_.root, std::sqrt(position), std::sqrt(rotation) / kDegree,
        leaders_.empty() ? " []" : "");
    for (std::size_t s = 0; s < leaders_.size(); ++s) {
      const Signal& signal = schema_.signals[s];
      text += fmt::format("  - {{name: {}, ", yaml_quoted(signal.name));
      if (leaders_[s])
        text += fmt::format("joint: {}, gain: {}, offset: {}, ", yaml_quoted(leaders_[s]->joint),
                            leaders_[s]->gain, leaders_[s]->offset);
      text += fmt::format("lower: {}, upper: {}}}\n", signal.lower, signal.upper);
    }
    text += "parts:\n";
    for (const int part : schema_.parts)
      text += fmt::format("  - {{part: {}, link: {}, X_LB: {{position_m: [0, 0, 0]}}}}\n", part,
                          link_of(part));
    return text;
  }

  const BodySchema& original_;
  const PureJoints& pure_;
  const BodySchema& schema_;  // with pure joints
  const Eigen::VectorXd middle_;
  tinyxml2::XMLDocument document_;
  XMLElement* robot_ = nullptr;
  Names joint_names_;
  std::set<std::string> given_;                 // names of signals that a joint has
  std::vector<std::optional<Leader>> leaders_;  // by signal
  UrdfModel result_;
};

void check_complete(const BodySchema& schema) {
  if (schema.complete) return;
  std::string why = "its edges do not span its parts";
  if (!schema.unconnected.empty())
    why = listed(schema.unconnected, [](const UnconnectedPart& part) {
      const std::string reason = name_in(kUnconnectedReasons, part.reason);
      return fmt::format("part {}: {}", part.part, part.detail.empty() ? reason : part.detail);
    });
  throw std::invalid_argument("the schema is incomplete: " + why);
}

}  // namespace

UrdfModel urdf_model(const BodySchema& schema, bool nominal) {
  check_complete(schema);
  return Writer(schema, pure_joints(schema, nominal)).run();
}

}  // namespace bodyschema
