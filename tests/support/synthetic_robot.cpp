#include "tests/support/synthetic_robot.h"

#include <algorithm>
#include <cmath>
#include <iomanip>
#include <numeric>
#include <sstream>

#include "common/geometry/angle.h"

namespace bodyschema::test {
namespace {

Pose screw_motion(double slide, double turn) {
  Pose X = Pose::Identity();
  X.linear() = Eigen::AngleAxisd(turn, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  X.translation().z() = slide;
  return X;
}

// A joint between two sides of 6 to 16 cm, all axes tilted at random.
TrueLink random_link(int part, int parent, Rng& rng) {
  TrueLink link;
  link.part = part;
  link.parent = parent;
  link.X_before = random_pose(rng, 0.06, 0.16);
  link.X_after = random_pose(rng, 0.06, 0.16);
  return link;
}

Signal symmetric_signal(int index, double limit) {
  std::string name = "q";  // g++ 12 warns falsely (-Wrestrict) of "q" + std::to_string(…)
  name += std::to_string(index + 1);
  return {name, -limit, limit};
}

// Scales the links so that the longest way from the base to a part has this length.
void stretch(SyntheticRobot* robot, double length_m) {
  std::map<int, double> reach;
  double longest = 0;
  for (const TrueLink& link : robot->links) {
    double& here = reach[link.part];
    if (link.parent >= 0)
      here = reach.at(link.parent) + link.X_before.translation().norm() +
             link.X_after.translation().norm();
    longest = std::max(longest, here);
  }
  for (TrueLink& link : robot->links) {
    link.X_before.translation() *= length_m / longest;
    link.X_after.translation() *= length_m / longest;
  }
}

void place_camera(SyntheticRobot* robot, Rng& rng) {
  robot->X_CR.linear() = random_rotation(rng);
  robot->X_CR.translation() << 0, 0, 2;
}

}  // namespace

double uniform(Rng& rng, double low, double high) {
  return low + (high - low) * (static_cast<double>(rng() >> 11) * 0x1.0p-53);
}

double gaussian(Rng& rng) {
  const double u = uniform(rng, 0, 1), v = uniform(rng, 0, 1);
  return std::sqrt(-2 * std::log(1 - u)) * std::cos(2 * M_PI * v);
}

Vector6d gaussian6(Rng& rng) {
  Vector6d x;
  for (int n = 0; n < 6; ++n) x(n) = gaussian(rng);
  return x;
}

Eigen::Matrix3d random_rotation(Rng& rng) {
  Eigen::Vector4d q;
  for (int n = 0; n < 4; ++n) q(n) = gaussian(rng);
  q.normalize();
  return Eigen::Quaterniond(q).toRotationMatrix();
}

Eigen::Vector3d random_vector(Rng& rng, double min_m, double max_m) {
  // One after the other: compilers differ in which factor of a product they draw first.
  const double length = uniform(rng, min_m, max_m);
  return length * random_rotation(rng).col(0);
}

Pose random_pose(Rng& rng, double min_m, double max_m) {
  Pose X = Pose::Identity();
  X.linear() = random_rotation(rng);
  X.translation() = random_vector(rng, min_m, max_m);
  return X;
}

Edge random_edge(int from, int to, const std::vector<int>& signals, Rng& rng) {
  Edge edge;
  edge.from = from;
  edge.to = to;
  edge.left = random_pose(rng, 0, 0.2);
  edge.right = random_pose(rng, 0, 0.2);
  for (const int signal : signals) {
    ScrewJoint joint;
    joint.signal = signal;
    joint.gain = uniform(rng, -2, 2);
    joint.offset = uniform(rng, -1, 1);
    joint.slide = uniform(rng, -0.1, 0.1);
    joint.turn = uniform(rng, -1, 1);
    joint.X_after = random_pose(rng, 0, 0.2);
    edge.joints.push_back(joint);
  }
  const Eigen::Index size = edge.num_parameters();
  const Eigen::MatrixXd root =
      Eigen::MatrixXd::NullaryExpr(size, size, [&] { return 1e-4 * gaussian(rng); });
  edge.parameter_covariance = root * root.transpose();
  edge.position_rms_m = uniform(rng, 1e-4, 1e-3);
  edge.rotation_rms_rad = uniform(rng, 1e-4, 1e-3);
  return edge;
}

std::map<int, Pose> SyntheticRobot::poses_in_camera(const Eigen::VectorXd& action) const {
  std::map<int, Pose> X_CB;
  for (const TrueLink& link : links) {
    if (link.parent < 0) {
      X_CB[link.part] = X_CR;
      continue;
    }
    double q = 0;
    if (link.signal >= 0) {
      q = action(link.signal) - link.zero + (bend + link.wear) * std::sin(3 * action(link.signal));
    }
    if (link.also >= 0) q += link.also_gain * action(link.also);
    X_CB[link.part] = X_CB.at(link.parent) * link.X_before *
                      screw_motion(link.slide * q, link.turn * q) * link.X_after *
                      exp(q * q * link.sag);
  }
  return X_CB;
}

Edge SyntheticRobot::true_edge(int from, int to) const {
  const auto to_base = [this](int part) {
    std::vector<const TrueLink*> path;
    while (part >= 0) {
      const auto it = std::find_if(links.begin(), links.end(),
                                   [part](const TrueLink& l) { return l.part == part; });
      path.push_back(&*it);
      part = it->parent;
    }
    return path;
  };
  std::vector<const TrueLink*> up = to_base(from), down = to_base(to);
  while (!up.empty() && !down.empty() && up.back() == down.back()) {
    up.pop_back();
    down.pop_back();
  }
  std::reverse(down.begin(), down.end());
  TrueChain chain(from, to);
  for (const TrueLink* link : up) {
    chain.move(link->X_after.inverse());
    if (link->signal >= 0) chain.add(link->signal, -link->slide, -link->turn, link->zero);
    chain.move(link->X_before.inverse());
  }
  for (const TrueLink* link : down) {
    chain.move(link->X_before);
    if (link->signal >= 0) chain.add(link->signal, link->slide, link->turn, link->zero);
    chain.move(link->X_after);
  }
  return chain.edge();
}

std::vector<int> SyntheticRobot::path_joints(int part_a, int part_b) const {
  std::vector<int> result;
  for (const ScrewJoint& joint : true_edge(part_a, part_b).joints) result.push_back(joint.signal);
  return result;
}

std::set<int> SyntheticRobot::path_signals(int part_a, int part_b) const {
  const std::vector<int> joints = path_joints(part_a, part_b);
  return {joints.begin(), joints.end()};
}

std::vector<int> SyntheticRobot::visible_parts() const {
  std::vector<int> result;
  for (const TrueLink& link : links)
    if (!link.hidden) result.push_back(link.part);
  std::sort(result.begin(), result.end());
  return result;
}

Eigen::VectorXd random_action(const std::vector<Signal>& signals, Rng& rng) {
  Eigen::VectorXd action(signals.size());
  for (std::size_t s = 0; s < signals.size(); ++s)
    action(s) = uniform(rng, signals[s].lower, signals[s].upper);
  return action;
}

SyntheticRobot chapter_robot(const std::string& name, Rng& rng) {
  SyntheticRobot robot;
  robot.name = name;
  place_camera(&robot, rng);
  // Signal of the link that carries part n + 1; −1 fixed.
  std::vector<int> chain;
  if (name == "a") chain = {-1, 0, 1, -1};
  if (name == "c" || name == "co") chain = {0, 1, 2, 3};
  const bool is_d = name == "d" || name == "dP";
  if (is_d) chain = {0, 1, 2, 3, 4, 5, -1};
  if (chain.empty() && name != "b")
    throw std::invalid_argument("no robot of the chapter is called " + name);
  robot.links.push_back({.part = 1});
  for (std::size_t n = 0; n < chain.size(); ++n) {
    TrueLink link = random_link(static_cast<int>(n) + 2, static_cast<int>(n) + 1, rng);
    link.signal = chain[n];
    if (link.signal >= 0) {
      link.turn = 1;
      robot.signals.push_back(symmetric_signal(link.signal, uniform(rng, 60, 120) * kDegree));
    }
    robot.links.push_back(link);
  }
  if (name == "b") {
    // The ring that carries the second axis across the first is no body part.
    TrueLink ring = random_link(3, 1, rng), end = random_link(2, 3, rng);
    ring.hidden = true;
    ring.X_after.linear() = Eigen::AngleAxisd(M_PI / 2, Eigen::Vector3d::UnitX()).matrix();
    ring.X_after.translation().setZero();
    end.X_before = Pose::Identity();
    for (TrueLink* link : {&ring, &end}) {
      link->signal = static_cast<int>(robot.signals.size());
      link->turn = 1;
      robot.signals.push_back(symmetric_signal(link->signal, uniform(rng, 60, 120) * kDegree));
      robot.links.push_back(*link);
    }
  }
  if (name == "co") robot.links[2].hidden = true;
  if (is_d) {
    robot.links[3].hidden = true;
    const Pose X_before = random_pose(rng, 0.06, 0.16);
    for (const int part : {9, 10}) {
      TrueLink finger = random_link(part, 8, rng);
      finger.signal = 6;
      finger.X_before = X_before;  // parallel axes
      finger.X_before.translation() += X_before.linear().col(0) * (part == 9 ? 0.03 : -0.03);
      const double sense = part == 9 ? 1 : -1;
      (name == "d" ? finger.turn : finger.slide) = sense * (name == "d" ? 1 : 0.04);
      robot.links.push_back(finger);
    }
    robot.signals.push_back(
        symmetric_signal(6, name == "d" ? uniform(rng, 40, 60) * kDegree : 1.0));
    stretch(&robot, 1.3);
  }
  return robot;
}

/// Hides inner parts, no two next to each other unless that is wanted.
static void hide_inner_parts(const RandomTreeOptions& options, const std::vector<int>& parents,
                             const std::vector<int>& num_children, SyntheticRobot* robot,
                             Rng& rng) {
  const int n = options.num_parts;
  std::vector<int> inner;
  for (int k = 1; k < n; ++k)
    if (num_children[k] > 0) inner.push_back(k);
  for (std::size_t k = inner.size(); k > 1; --k)
    std::swap(inner[k - 1], inner[static_cast<std::size_t>(uniform(rng, 0, k))]);
  int hidden = 0;
  for (const int k : inner) {
    if (hidden == options.num_hidden) break;
    bool free = !robot->links[parents[k]].hidden;
    // Two joints on one signal with nothing visible between them are no local model of ours.
    for (int c = 1; c < n; ++c)
      free &= !(parents[c] == k && robot->links[c].signal >= 0 &&
                robot->links[c].signal == robot->links[k].signal);
    for (int c = 1; c < n; ++c) free &= !(parents[c] == k && robot->links[c].hidden);
    // Siblings below a hidden parent are two joints apart already.
    if (!free) continue;
    robot->links[k].hidden = true;
    ++hidden;
    if (options.adjacent_hidden) {
      for (int c = 1; c < n; ++c)
        if (parents[c] == k && num_children[c] > 0) {
          robot->links[c].hidden = true;
          break;
        }
    }
  }
}

SyntheticRobot random_tree(const RandomTreeOptions& options, Rng& rng) {
  SyntheticRobot robot;
  robot.name = "tree";
  place_camera(&robot, rng);
  const int n = options.num_parts;
  std::vector<int> parents(n, -1), num_children(n, 0);
  for (int k = 1; k < n; ++k) {
    // Mostly a chain, with branches.
    parents[k] = uniform(rng, 0, 1) < 0.7 ? k - 1 : static_cast<int>(uniform(rng, 0, k));
    if (options.limb_length > 0) parents[k] = (k - 1) % options.limb_length == 0 ? 0 : k - 1;
    ++num_children[parents[k]];
  }
  robot.links.push_back({.part = 1});
  for (int k = 1; k < n; ++k) {
    TrueLink link = random_link(k + 1, parents[k] + 1, rng);
    const double kind = uniform(rng, 0, 1);
    const bool shared = options.shared_signal && k == n - 1 && !robot.signals.empty();
    if (kind < options.share_fixed && !shared && k > 1) {
      robot.links.push_back(link);
      continue;
    }
    const TrueLink& parent = robot.links[parents[k]];
    if (parent.signal >= 0 && uniform(rng, 0, 1) < options.share_parallel) {
      // Axis of this joint along the parent's: X_before undoes the parent's X_after.
      link.X_before.linear() = parent.X_after.linear().transpose();
    }
    if (shared) {
      link.signal = static_cast<int>(robot.signals.size()) - 1;
    } else {
      link.signal = static_cast<int>(robot.signals.size());
      const double limit = uniform(rng, 0.8, 1.6);
      robot.signals.push_back(symmetric_signal(link.signal, limit));
    }
    const double sign = uniform(rng, 0, 1) < 0.5 ? -1 : 1;
    const double gain = sign * uniform(rng, 0.5, 2);
    const double k2 = kind - options.share_fixed;
    if (k2 < options.share_prismatic && !shared) {
      link.slide = 0.08 * gain;
    } else {
      link.turn = gain;
      if (k2 < options.share_prismatic + options.share_helical) link.slide = 0.03 * gain;
    }
    link.zero = uniform(rng, -0.5, 0.5);
    robot.links.push_back(link);
  }
  hide_inner_parts(options, parents, num_children, &robot, rng);
  if (options.idle_signal) robot.signals.push_back({"idle", -1, 1});
  return robot;
}

Rightness judge(const BodySchema& schema, const SyntheticRobot& truth) {
  std::size_t total = 0;
  bool is_open = false;
  const std::vector<Signal>& told = schema.signals.empty() ? truth.signals : schema.signals;
  for (const Edge& edge : schema.edges) {
    const std::vector<int> signals = edge.signals();
    if (std::set<int>(signals.begin(), signals.end()) != truth.path_signals(edge.from, edge.to))
      return Rightness::kWrong;
    const Edge true_edge = truth.true_edge(edge.from, edge.to);
    const Rightness rightness = judge_chain(edge, true_edge, told).rightness;
    if (rightness == Rightness::kWrong) return rightness;
    is_open |= rightness == Rightness::kIncomplete;
    total += signals.size();
  }
  const std::vector<int> parts = truth.visible_parts();
  if (is_open || schema.edges.size() + 1 != parts.size() || !schema.complete)
    return Rightness::kIncomplete;
  // The least sum: a minimum spanning tree over the true numbers of joints. (Two joints on one
  // signal with nothing visible between them are in general no single screw.)
  std::vector<int> component(parts.size());
  std::iota(component.begin(), component.end(), 0);
  std::size_t minimum = 0;
  for (std::size_t k = 0; k <= truth.links.size(); ++k)
    for (std::size_t i = 0; i < parts.size(); ++i)
      for (std::size_t j = i + 1; j < parts.size(); ++j) {
        if (component[i] == component[j]) continue;
        if (truth.path_joints(parts[i], parts[j]).size() != k) continue;
        const int from = component[j], to = component[i];
        std::replace(component.begin(), component.end(), from, to);
        minimum += k;
      }
  return total <= minimum ? Rightness::kRight : Rightness::kWrong;
}

bool is_right(const BodySchema& schema, const SyntheticRobot& truth) {
  return judge(schema, truth) == Rightness::kRight;
}

void hide_all_but_ends(SyntheticRobot* robot, std::vector<ActionPoseSample>* samples) {
  const int first = robot->links.front().part, last = robot->links.back().part;
  const auto is_end = [&](int part) { return part == first || part == last; };
  for (TrueLink& link : robot->links) link.hidden = !is_end(link.part);
  for (ActionPoseSample& sample : *samples)
    std::erase_if(sample.parts, [&](const PartObservation& o) { return !is_end(o.part); });
}

void write_csv(const std::vector<ActionPoseSample>& samples, std::ostream& out) {
  out << "t";
  if (!samples.empty())
    for (Eigen::Index s = 0; s < samples[0].action.size(); ++s) out << ",q" << s + 1;
  out << ",part,x,y,z,qw,qx,qy,qz\n" << std::setprecision(12);
  for (const ActionPoseSample& sample : samples) {
    for (const PartObservation& o : sample.parts) {
      out << sample.sample_index;
      for (const double q : sample.action) out << ',' << q;
      const Eigen::Quaterniond q(o.X_CB.linear());
      const Eigen::Vector3d p = o.X_CB.translation();
      out << ',' << o.part << ',' << p.x() << ',' << p.y() << ',' << p.z();
      if (o.has_rotation)
        out << ',' << q.w() << ',' << q.x() << ',' << q.y() << ',' << q.z() << '\n';
      else
        out << ",,,,\n";
    }
  }
}

std::vector<ActionPoseSample> read_csv(std::istream& in, int* num_signals) {
  std::string line;
  std::getline(in, line);
  *num_signals = static_cast<int>(std::count(line.begin(), line.end(), ',')) - 8;
  std::vector<ActionPoseSample> samples;
  double last_t = 0;
  while (std::getline(in, line)) {
    std::istringstream fields(line);
    std::vector<double> values;
    for (std::string field; std::getline(fields, field, ',');) values.push_back(std::stod(field));
    if (static_cast<int>(values.size()) != *num_signals + 9) continue;
    if (samples.empty() || values[0] != last_t) {
      samples.emplace_back();
      samples.back().sample_index = static_cast<std::int64_t>(samples.size()) - 1;
      samples.back().action = Eigen::Map<Eigen::VectorXd>(values.data() + 1, *num_signals);
      last_t = values[0];
    }
    const double* v = values.data() + 1 + *num_signals;
    PartObservation o;
    o.part = static_cast<int>(v[0]);
    o.X_CB = make_pose(Eigen::Quaterniond(v[4], v[5], v[6], v[7]), {v[1], v[2], v[3]});
    samples.back().parts.push_back(o);
  }
  return samples;
}

BodySchema true_schema(const SyntheticRobot& robot) {
  BodySchema schema;
  schema.version = 1;
  schema.complete = true;
  schema.signals = robot.signals;
  schema.root = robot.links.front().part;
  schema.X_CR = robot.X_CR;
  for (const TrueLink& link : robot.links) {
    schema.parts.push_back(link.part);
    if (link.parent < 0) continue;
    Edge edge;
    edge.from = link.parent;
    edge.to = link.part;
    edge.left = link.X_before;
    if (link.signal >= 0) {
      ScrewJoint joint;
      joint.signal = link.signal;
      joint.gain = 0.5;
      joint.offset = -0.5 * link.zero;
      joint.turn = 2 * link.turn;
      joint.slide = 2 * link.slide;
      joint.X_after = link.X_after;
      edge.joints.push_back(joint);
    } else {
      edge.right = link.X_after;
    }
    schema.edges.push_back(edge);
  }
  return schema;
}

}  // namespace bodyschema::test
