#include "tests/support/broken_arm.h"

#include <algorithm>
#include <cmath>
#include <ctime>

#include "common/geometry/angle.h"

namespace bodyschema::test {
namespace {

constexpr int kTestActions = 60;

SyntheticRobot chain(Rng& rng, double range_rad) {
  SyntheticRobot robot;
  robot.X_CR.linear() = random_rotation(rng);
  robot.X_CR.translation() << 0, 0, 2;
  robot.links.push_back({.part = 1});
  for (int part = 2; part <= BrokenArm::kEndEffector; ++part) {
    TrueLink link;
    link.part = part;
    link.parent = part - 1;
    link.X_before = random_pose(rng, 0.06, 0.16);
    link.X_after = random_pose(rng, 0.06, 0.16);
    link.signal = part - 2;
    link.turn = 1;
    robot.links.push_back(link);
  }
  for (int s = 1; s <= 7; ++s)
    robot.signals.push_back({"q" + std::to_string(s), -range_rad, range_rad});
  return robot;
}

/// The truth except 1 mm and 0.2° per axis and edge, which its covariances state.
BodySchema engineered_model(const SyntheticRobot& robot, Rng& rng) {
  Vector6d sigma;
  sigma << Eigen::Vector3d::Constant(0.001), Eigen::Vector3d::Constant(0.2 * kDegree);
  BodySchema schema;
  schema.root = BrokenArm::kRoot;
  schema.signals = robot.signals;
  schema.X_CR = robot.X_CR;
  for (const TrueLink& link : robot.links) {
    schema.parts.push_back(link.part);
    if (link.parent < 0) continue;
    Edge edge;
    edge.from = link.parent;
    edge.to = link.part;
    edge.left = link.X_before;
    ScrewJoint joint;
    joint.signal = link.signal;
    joint.turn = link.turn;
    joint.X_after = link.X_after * exp(sigma.cwiseProduct(gaussian6(rng)));
    edge.joints.push_back(joint);
    edge.parameter_covariance = Eigen::MatrixXd::Zero(14, 14);
    edge.parameter_covariance.block<6, 6>(8, 8) = sigma.cwiseAbs2().asDiagonal();
    schema.edges.push_back(edge);
  }
  schema.complete = true;
  return schema;
}

}  // namespace

Pose displacement(Rng& rng, double position_m, double rotation_rad) {
  Pose T = Pose::Identity();
  T.linear() = exp_so3(random_rotation(rng).col(0) * rotation_rad);
  T.translation() = random_rotation(rng).col(0) * position_m;
  return T;
}

BrokenArm::BrokenArm(const Scenario& scenario, Regime regime, int block_length, int seed)
    : scenario_(scenario),
      regime_(regime),
      block_length_(block_length),
      rng_(static_cast<Rng::result_type>(seed)),
      healthy_(chain(rng_, scenario.range_rad)),
      broken_(healthy_) {
  break_as_told();
  drift_axis_ = random_rotation(rng_).col(0);
  engineered_ = engineered_model(healthy_, rng_);
  for (int n = 0; n < kTestActions; ++n) test_actions_.push_back(healthy_.random_action(rng_));
  if (scenario_.fault == Fault::kIntermittent)
    for (int at = block_length_; at < num_samples(); at += static_cast<int>(uniform(rng_, 3, 13)))
      turns_.push_back(at);
}

// One switch, though long: each fault in a few lines.
void BrokenArm::break_as_told() {
  const auto link = [this](int part) -> TrueLink& { return broken_.links[part - 1]; };
  const auto stick = [&](int part) {
    Vector6d at = Vector6d::Zero();
    at(5) = uniform(rng_, -0.8, 0.8);
    link(part).X_before = link(part).X_before * exp(at);
    link(part).signal = -1;
    changes_.push_back({part, true, false, {"joint_stuck"}});
  };
  const auto of_size = [&](double position_m, double rotation_rad) {
    return displacement(rng_, scenario_.size * position_m, scenario_.size * rotation_rad);
  };
  const auto exchange_tool = [&] {
    link(7).X_after = link(7).X_after * of_size(0.25, 80 * kDegree);
    changes_.push_back({7, true, true, {"geometry", "marker_moved"}});
  };
  switch (scenario_.fault) {
    case Fault::kNone:
      break;
    case Fault::kStuck:
      stick(5);
      break;
    case Fault::kTool:
      exchange_tool();
      break;
    case Fault::kBend:
    case Fault::kIntermittent:
      link(5).X_before = of_size(0.03, 45 * kDegree) * link(5).X_before;
      changes_.push_back({5, true, false, {"geometry"}});
      break;
    case Fault::kOffset:
      link(scenario_.joint).zero = scenario_.size * 20 * kDegree;
      changes_.push_back({scenario_.joint, true, false, {"joint_offset"}});
      break;
    case Fault::kGain:
    case Fault::kReversed:
      link(scenario_.joint).turn = scenario_.fault == Fault::kGain ? 0.7 : -1;
      changes_.push_back({scenario_.joint, true, false, {"joint_gain"}});
      break;
    case Fault::kTwo:
      stick(3);
      exchange_tool();
      break;
    case Fault::kAdjacent:
      stick(5);
      link(6).X_after = link(6).X_after * displacement(rng_, 0.1, 40 * kDegree);
      changes_.push_back({6, true, false, {"geometry"}});
      break;
    case Fault::kMarker: {
      const Pose T = of_size(0.05, 1);
      link(3).X_after = link(3).X_after * T;
      link(4).X_before = T.inverse() * link(4).X_before;
      changes_.push_back({3, false, true, {"marker_moved"}});
      break;
    }
    case Fault::kCamera:
      broken_.X_CR = of_size(0.1, 15 * kDegree) * broken_.X_CR;
      changes_.push_back({kRoot, true, true, {"camera_moved"}});
      break;
    case Fault::kDrift:
      changes_.push_back({4, true, false, {"drift"}});
      break;
    case Fault::kWorn:
      link(4).wear = 0.6;
      changes_.push_back({4, true, false, {"joint_nonlinear"}});
      break;
    case Fault::kCoupled:
      link(4).also = 5;
      link(4).also_gain = 0.5;
      changes_.push_back({4, true, false, {"joint_nonlinear"}});
      break;
    case Fault::kElastic:
      link(4).sag << 0.04 * random_rotation(rng_).col(0), 0.3 * random_rotation(rng_).col(0);
      changes_.push_back({4, true, false, {"new_model"}});
      break;
  }
}

bool BrokenArm::is_broken(int index) const {
  if (scenario_.fault != Fault::kIntermittent) return index / block_length_ % 2 == 1;
  return (std::upper_bound(turns_.begin(), turns_.end(), index) - turns_.begin()) % 2 == 1;
}

SyntheticRobot BrokenArm::robot_at(int index) const {
  if (scenario_.fault == Fault::kDrift) {
    SyntheticRobot robot = healthy_;
    Pose T = Pose::Identity();
    const double bend_deg = std::min(scenario_.drift_deg * std::max(0, index - block_length_),
                                     scenario_.most_drift_deg);
    T.linear() = exp_so3(drift_axis_ * bend_deg * kDegree);
    robot.links[3].X_before = robot.links[3].X_before * T;
    return robot;
  }
  return is_broken(index) ? broken_ : healthy_;
}

BodySchema BrokenArm::engineered_but_exact(int part, int index) const {
  BodySchema schema = engineered_;
  const SyntheticRobot robot = robot_at(index);
  const TrueLink& link = robot.links.at(static_cast<std::size_t>(part - kRoot));
  for (Edge& edge : schema.edges) {
    if (edge.to != part) continue;
    edge.left = link.X_before;
    edge.joints.front().X_after = link.X_after;
  }
  return schema;
}

ActionPoseSample BrokenArm::observe(int index) {
  const SyntheticRobot robot = robot_at(index);
  ObservationOptions options;
  options.regime = regime_;
  options.with_covariances = true;
  const Eigen::VectorXd action = healthy_.random_action(rng_);
  ActionPoseSample sample = test::observe(robot, action, options, index, rng_);
  std::erase_if(sample.parts,
                [this](const auto&) { return uniform(rng_, 0, 1) > scenario_.visible; });
  return sample;
}

double BrokenArm::error(const BodySchema& schema, int index) const {
  const SyntheticRobot robot = robot_at(index);
  const bool in_camera = scenario_.fault == Fault::kCamera;
  const int judged = scenario_.fault == Fault::kMarker ? changes_.front().part : kEndEffector;
  double sum = 0;
  for (const Eigen::VectorXd& action : test_actions_) {
    const auto truth = robot.poses_in_camera(action);
    const Pose X_RB = truth.at(kRoot).inverse() * truth.at(judged);
    const Pose believed = schema.predict_all(action).at(judged);
    sum += in_camera
               ? ((schema.X_CR * believed).translation() - truth.at(judged).translation()).norm()
               : (believed.translation() - X_RB.translation()).norm();
  }
  return sum / static_cast<double>(test_actions_.size());
}

bool BrokenArm::is_near(int part) const {
  return std::any_of(changes_.begin(), changes_.end(),
                     [part](const TrueChange& c) { return std::abs(c.part - part) <= 1; });
}

AdaptationOptions adaptation_options(Regime regime, double noise_factor) {
  AdaptationOptions options;
  if (regime != Regime::kTag) {
    options.measurement.noise = nominal_noise(regime);
    options.measurement.noise->position_m *= noise_factor;
    options.measurement.noise->rotation_rad *= noise_factor;
  }
  // A third more than there are; never none.
  const bool has_outliers = regime == Regime::kTag || regime == Regime::kTagIso;
  options.measurement.outlier_rate = has_outliers ? 0.04 : 0.013;
  return options;
}

double thread_seconds() {
  timespec time{};
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &time);
  return static_cast<double>(time.tv_sec) + 1e-9 * static_cast<double>(time.tv_nsec);
}

}  // namespace bodyschema::test
