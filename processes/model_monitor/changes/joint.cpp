#include <algorithm>
#include <cmath>

#include "common/kinematics/screw_chain.h"
#include "processes/model_monitor/changes/change_family.h"

namespace bodyschema {
namespace {

using Form = BodyChange::Form;
using Kind = ChangeSize::Kind;

/// The command whose displacement is θ. Within the limits the displacement ascends (warps are small
/// against the range); outside them it goes on straight.
double command_of(const Signal& signal, double theta) {
  const double at_lower = signal.displacement(signal.lower),
               at_upper = signal.displacement(signal.upper);
  if (theta <= at_lower) return signal.lower + theta - at_lower;
  if (theta >= at_upper) return signal.upper + theta - at_upper;
  double low = signal.lower, high = signal.upper;
  for (int n = 0; n < 60; ++n) {
    const double middle = 0.5 * (low + high);
    (signal.displacement(middle) < theta ? low : high) = middle;
  }
  return 0.5 * (low + high);
}

const Signal& signal_of(const BodySchema& schema, const ScrewJoint& joint) {
  return schema.signals.at(static_cast<std::size_t>(joint.signal));
}

/// A joint that stands still is taken for what it was learned as: gain 1, offset 0.
ScrewJoint moving(ScrewJoint joint) {
  if (joint.gain == 0) joint.gain = 1, joint.offset = 0;
  return joint;
}

double stuck_at(const BodySchema& schema, const ScrewJoint& joint, double displacement) {
  const ScrewJoint before = moving(joint);
  return command_of(signal_of(schema, joint), (displacement - before.offset) / before.gain);
}

const ScrewJoint& joint_of(const Edge& edge, const BodyChange& change) {
  return edge.joints.at(static_cast<std::size_t>(change.at));
}

ScrewJoint with_change(ScrewJoint joint, const BodyChange& change, const Eigen::VectorXd& theta) {
  if (change.form == Form::kOtherSignal) {
    joint.signal = change.signal;
    return joint;
  }
  if (change.form == Form::kStuck) joint.gain = joint.offset = 0;
  if (change.form == Form::kGain) joint.gain *= 1 + theta(0);
  joint.offset += theta.tail<1>()(0);
  return joint;
}

double displacement_of(const ScrewJoint& joint, const Eigen::VectorXd& displacements) {
  return joint.gain * displacements(joint.signal) + joint.offset;
}

/// One joint of an edge. θ's last component is a displacement, that of a gain before it multiplies
/// one.
class Joint : public ChangeFamily {
 public:
  bool is_possible(const BodySchema& schema, const BodyChange& change) const override {
    const Edge* edge = edge_to(schema, change.part);
    return edge && change.at < std::ssize(edge->joints);
  }

  ChangePrior prior(const BodySchema& schema, const BodyChange& change) const override {
    if (change.form == Form::kOtherSignal) return {};
    const ScrewJoint& joint = joint_of(*edge_to(schema, change.part), change);
    const Signal& signal = signal_of(schema, joint);
    // Of the displacement a q + b; a stuck joint's a is not known.
    const double range =
        std::max(signal.upper - signal.lower, 1e-9) * (joint.gain != 0 ? std::abs(joint.gain) : 1);
    const auto& [share, gain] = form_of(change).sigma;
    if (change.form == Form::kStuck)
      return {Eigen::VectorXd::Constant(
                  1, joint.gain * 0.5 * (signal.lower + signal.upper) + joint.offset),
              Eigen::VectorXd::Constant(1, range / std::sqrt(12)), true};
    if (change.form == Form::kGain)
      return {Eigen::Vector2d::Zero(), Eigen::Vector2d(gain, share * range)};
    return {Eigen::VectorXd::Zero(1), Eigen::VectorXd::Constant(1, share * range)};
  }

  /// A grid over the prior.
  std::vector<Eigen::VectorXd> starts(const BodySchema& schema, const BodyChange& change,
                                      const std::vector<PlaceMeasurement>&) const override {
    const auto [mean, sigma, is_uniform] = prior_of(change, schema);
    std::vector<Eigen::VectorXd> result;
    if (change.form == Form::kGain) {
      for (const double a : {-2.0, -0.6, -0.25, 0.0, 0.4})  // −2: reversed
        for (const double b : {-0.5, 0.0, 0.5}) result.push_back(Eigen::Vector2d(a, b * sigma(1)));
      return result;
    }
    const int half = is_uniform ? 4 : 3;
    const double step = is_uniform ? std::sqrt(3.0) / 4 : 0.6;
    for (int k = -half; k <= half; ++k) result.push_back(mean + step * k * sigma);
    return result;
  }

  void apply(const BodyChange& change, const Eigen::VectorXd& theta,
             const Eigen::MatrixXd& covariance, BodySchema* schema) const override {
    Edge& edge = edge_at(schema, change.part);
    ScrewJoint& joint = edge.joints.at(static_cast<std::size_t>(change.at));
    joint = with_change(joint, change, theta);
    if (covariance.size() == 0) return;
    const Vector6d along = displacement_twist(joint);
    add_covariance(covariance.bottomRightCorner<1, 1>()(0) * along * along.transpose(),
                   ScrewChainLayout::transform(change.at + 1), &edge);
    if (change.form != Form::kGain) return;
    // The gain's, as an uncertainty of slide and turn.
    const Eigen::Vector2d screw(joint.slide, joint.turn);
    const double share = 1 / std::max(std::abs(1 + theta(0)), 0.1);
    add_covariance(share * share * covariance(0, 0) * screw * screw.transpose(),
                   ScrewChainLayout::slide(change.at), &edge);
  }

  PlacePrediction prediction(const BodySchema& schema, const BodyChange& change,
                             const Eigen::VectorXd& theta) const override {
    const Edge& edge = *edge_to(schema, change.part);
    const ScrewJoint old = joint_of(edge, change), now = with_change(old, change, theta);
    return
        [change, old, now, left = edge.left](const PlaceMeasurement& m, ChangeJacobian* jacobian) {
          Pose X = change.at == 0 ? left : m.links[static_cast<std::size_t>(change.at)];
          const Pose rest = X.inverse() * m.X;
          if (jacobian && jacobian->cols() > 0)
            jacobian->rightCols<1>() = adjoint(rest.inverse()) * screw_twist(old);
          if (jacobian && change.form == Form::kGain)
            jacobian->col(0) = old.gain * m.displacements(old.signal) * jacobian->col(1);
          // What it goes farther than before: motions along one screw commute.
          const double farther =
              displacement_of(now, m.displacements) - displacement_of(old, m.displacements);
          Screw{old.slide, old.turn}.append_motion(farther, X.linear(), X.translation());
          return X * rest;
        };
  }

  ChangeSize size(const BodySchema& schema, const BodyChange& change, const Eigen::VectorXd& theta,
                  const Eigen::MatrixXd& covariance) const override {
    if (change.form == Form::kOtherSignal) return {Kind::kUnknown, change.signal, {}, {}};
    const ScrewJoint& joint = joint_of(*edge_to(schema, change.part), change);
    const auto amounts = [&](const Eigen::VectorXd& t) -> std::vector<double> {
      if (change.form == Form::kStuck) return {stuck_at(schema, joint, t(0))};
      return {change.form == Form::kGain ? 1 + t(0) : t(0) / moving(joint).gain};
    };
    return sized(change.form == Form::kGain ? Kind::kFactor : Kind::kCommand, joint.signal, amounts,
                 theta, covariance);
  }
};

}  // namespace

const ChangeFamily& joint_family() {
  static const Joint family;
  return family;
}

std::optional<FoundDifference> joint_difference(const BodySchema& before, const Edge& old,
                                                const Edge& now) {
  if (old.joints.size() != now.joints.size()) return std::nullopt;
  std::vector<std::size_t> others;
  for (std::size_t d = 0; d < now.joints.size(); ++d)
    if (old.joints[d].gain != now.joints[d].gain || old.joints[d].offset != now.joints[d].offset)
      others.push_back(d);
  if (others.size() != 1) return std::nullopt;
  const ScrewJoint &x = old.joints[others[0]], &y = now.joints[others[0]];
  const auto found = [&x](const char* cause, Kind kind, double amount) {
    return FoundDifference{cause, {kind, x.signal, {amount}, {-1}}};
  };
  if (y.gain == 0) return found("joint_stuck", Kind::kCommand, stuck_at(before, x, y.offset));
  if (y.gain == x.gain)
    return found("joint_offset", Kind::kCommand, (y.offset - x.offset) / moving(x).gain);
  return found("joint_gain", Kind::kFactor, y.gain / moving(x).gain);
}

}  // namespace bodyschema
