#include "tests/support/long_arm.h"

#include <algorithm>
#include <cmath>

#include "common/geometry/angle.h"
#include "common/kinematics/screw_chain.h"
#include "tests/support/broken_arm.h"

namespace bodyschema::test {
namespace {

constexpr int kTestActions = 60, kFirstHidden = 11;
constexpr Noise kFine{0.001, 0.3 * kDegree};

/// Links in the order of the chain; the last one is the hand.
SyntheticRobot chain(const LongArmOptions& options, Rng& rng) {
  SyntheticRobot robot;
  robot.X_CR.linear() = random_rotation(rng);
  robot.X_CR.translation() << 0, 0, 2;
  robot.links.push_back({.part = LongArm::kRoot});
  for (int d = 0; d < options.num_joints; ++d) {
    TrueLink link;
    link.parent = robot.links.back().part;
    link.part = d + 1 == options.num_joints ? LongArm::kHand : kFirstHidden + d;
    link.hidden = link.part != LongArm::kHand;
    link.X_before = random_pose(rng, 0.06, 0.16);
    link.X_after = random_pose(rng, 0.06, 0.16);
    link.signal = d;
    const double gain = uniform(rng, 0.5, 2) * (uniform(rng, 0, 1) < 0.5 ? -1 : 1);
    const double half = uniform(rng, 30, 120) * kDegree / std::abs(gain);
    const double middle = uniform(rng, -0.3, 0.3);
    (d == options.slides ? link.slide : link.turn) = d == options.slides ? 0.12 / half : gain;
    robot.signals.push_back({"q" + std::to_string(d + 1), middle - half, middle + half});
    robot.links.push_back(link);
  }
  return robot;
}

BodySchema schema_of(const SyntheticRobot& robot, Rng& rng) {
  Vector6d sigma;
  sigma << Eigen::Vector3d::Constant(0.0005), Eigen::Vector3d::Constant(0.1 * kDegree);
  const auto about = [&](const Pose& X) { return X * exp(sigma.cwiseProduct(gaussian6(rng))); };
  Edge edge;
  edge.from = LongArm::kRoot;
  edge.to = LongArm::kHand;
  const std::size_t k = robot.links.size() - 1;
  const int size = ScrewChainLayout::size(static_cast<int>(k));
  edge.parameter_covariance = Eigen::MatrixXd::Zero(size, size);
  const auto tell = [&](std::size_t d) {
    const int at = ScrewChainLayout::transform(static_cast<int>(d));
    edge.parameter_covariance.block<6, 6>(at, at) = sigma.cwiseAbs2().asDiagonal();
  };
  edge.left = about(robot.links[1].X_before);
  tell(0);
  for (std::size_t d = 1; d <= k; ++d) {
    const TrueLink& link = robot.links[d];
    ScrewJoint joint;
    joint.signal = link.signal;
    joint.slide = link.slide;
    joint.turn = link.turn;
    joint.X_after = about(d < k ? link.X_after * robot.links[d + 1].X_before : link.X_after);
    edge.joints.push_back(joint);
    tell(d);
  }
  BodySchema schema;
  schema.parts = {LongArm::kRoot, LongArm::kHand};
  schema.root = LongArm::kRoot;
  schema.X_CR = robot.X_CR;
  schema.signals = robot.signals;
  schema.edges = {edge};
  schema.complete = true;
  return schema;
}

}  // namespace

const char* name_of(LongFault fault) {
  constexpr const char* kNames[] = {"none", "stuck", "offset", "gain", "bend",
                                    "base", "tool",  "drift",  "worn"};
  return kNames[static_cast<std::size_t>(fault)];
}

LongArm::LongArm(const LongArmOptions& options, LongFault fault, int at, int seed)
    : options_(options),
      fault_(fault),
      at_(at),
      rng_(static_cast<Rng::result_type>(seed)),
      healthy_(chain(options, rng_)),
      broken_(healthy_) {
  TrueLink& link = broken_.links.at(static_cast<std::size_t>(at) + 1);
  const Signal& signal = healthy_.signals.at(static_cast<std::size_t>(at));
  const bool does_slide = link.slide != 0;
  switch (fault_) {
    case LongFault::kNone:
    case LongFault::kDrift:
      break;
    case LongFault::kStuck: {
      const double q =
          signal.lower + uniform(rng_, 0.2, 0.8) * (signal.upper - signal.lower) - link.zero;
      Vector6d along = Vector6d::Zero();
      along(2) = link.slide * q;
      along(5) = link.turn * q;
      link.X_before = link.X_before * exp(along);
      link.signal = -1;
      break;
    }
    case LongFault::kOffset:
      link.zero = does_slide ? 0.05 / link.slide : 20 * kDegree / link.turn;
      break;
    case LongFault::kGain:
      (does_slide ? link.slide : link.turn) *= 0.7;
      break;
    case LongFault::kBend:
      link.X_after = link.X_after * displacement(rng_, 0.03, 45 * kDegree);
      break;
    case LongFault::kBase:
      broken_.links[1].X_before = displacement(rng_, 0.05, 30 * kDegree) * link.X_before;
      break;
    case LongFault::kTool:
      broken_.links.back().X_after =
          broken_.links.back().X_after * displacement(rng_, 0.25, 80 * kDegree);
      break;
    case LongFault::kWorn:
      link.wear = 0.3;
      break;
  }
  drift_axis_ = random_rotation(rng_).col(0);
  engineered_ = schema_of(healthy_, rng_);
  for (int n = 0; n < kTestActions; ++n) test_actions_.push_back(healthy_.random_action(rng_));
}

SyntheticRobot LongArm::robot_at(int index) const {
  if (fault_ == LongFault::kDrift) {
    SyntheticRobot robot = healthy_;
    const double bend = 0.05 * kDegree * std::max(0, index - options_.block_length);
    robot.links.at(static_cast<std::size_t>(at_) + 1).X_after.rotate(exp_so3(bend * drift_axis_));
    return robot;
  }
  return index / options_.block_length % 2 == 1 ? broken_ : healthy_;
}

ActionPoseSample LongArm::observe(int index) {
  const SyntheticRobot robot = robot_at(index);
  ObservationOptions how;
  how.regime = options_.is_fine ? Regime::kFree : Regime::kTagIso;
  how.with_covariances = true;
  const Eigen::VectorXd action = healthy_.random_action(rng_);
  ActionPoseSample sample = test::observe(robot, action, how, index, rng_);
  for (PartObservation& o : sample.parts) {
    if (!options_.is_fine) break;
    Vector6d sigma;
    sigma << Eigen::Vector3d::Constant(kFine.position_m),
        Eigen::Vector3d::Constant(kFine.rotation_rad);
    o.X_CB = o.X_CB * exp(sigma.cwiseProduct(gaussian6(rng_)));
    o.covariance = sigma.cwiseAbs2().asDiagonal();
  }
  std::erase_if(sample.parts,
                [this](const auto&) { return uniform(rng_, 0, 1) > options_.visible; });
  return sample;
}

double LongArm::error(const BodySchema& schema, int index) const {
  const SyntheticRobot robot = robot_at(index);
  double sum = 0;
  for (const Eigen::VectorXd& action : test_actions_) {
    const auto truth = robot.poses_in_camera(action);
    const Pose X_RH = truth.at(kRoot).inverse() * truth.at(kHand);
    sum += (schema.predict_all(action).at(kHand).translation() - X_RH.translation()).norm();
  }
  return sum / kTestActions;
}

bool LongArm::is_named_by(const AdaptationEvent& event) const {
  const auto is = [&event](const char* cause, int signal) {
    return event.cause == cause && event.size.signal == signal;
  };
  switch (fault_) {
    case LongFault::kStuck:
      return is("joint_stuck", at_);
    case LongFault::kOffset:
      return is("joint_offset", at_);
    case LongFault::kGain:
      return is("joint_gain", at_);
    case LongFault::kBend:
      return is("geometry", at_);
    case LongFault::kBase:
      return is("geometry", -1);
    case LongFault::kTool:
      return is("geometry", options_.num_joints - 1) || event.cause == "marker_moved";
    case LongFault::kDrift:
      return event.cause == "drift";
    default:
      return false;
  }
}

AdaptationOptions LongArm::adaptation_options() const {
  AdaptationOptions options = test::adaptation_options(Regime::kTagIso);
  if (!options_.is_fine) return options;
  options.measurement.noise = kFine;
  options.measurement.outlier_rate = 0.013;
  return options;
}

int LongLife::samples_until_right(int block, int block_length, double most) const {
  int until = block_length;
  while (until > 0 && error.at(static_cast<std::size_t>(block * block_length + until - 1)) < most)
    --until;
  return until;
}

LongLife live(LongArm* arm, int num_samples) {
  Adaptation adaptation(arm->engineered(), arm->adaptation_options());
  LongLife life;
  for (int t = 0; t < num_samples; ++t) {
    const ActionPoseSample sample = arm->observe(t);
    const double begin = thread_seconds();
    for (AdaptationEvent& event : adaptation.on_sample(sample))
      life.events.push_back(std::move(event));
    const double seconds = thread_seconds() - begin;
    life.most_seconds = std::max(life.most_seconds, seconds);
    life.mean_seconds += seconds / num_samples;
    life.error.push_back(arm->error(adaptation.schema(), t));
  }
  return life;
}

}  // namespace bodyschema::test
