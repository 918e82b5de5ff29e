#include "processes/model_monitor/change_size.h"

#include <algorithm>
#include <cmath>
#include <functional>

namespace bodyschema {
namespace {

using Form = BodyChange::Form;
using Kind = ChangeSize::Kind;

/// The pose that a change of the edge to `part` moves: the part in its parent; of the root, which
/// hangs on nothing, the camera in the root.
Pose pose_at(const BodySchema& schema, int part) {
  const Edge* edge = edge_to(schema, part);
  return edge ? edge->predict(schema.displacements(mid_range(schema.signals)))
              : schema.X_CR.inverse();
}

std::vector<double> distance_and_angle(const Pose& T) {
  return {T.translation().norm(), rotation_angle(T)};
}

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

/// One that stands still is taken for what it was learned as: gain 1, offset 0.
ScrewJoint moving(ScrewJoint joint) {
  if (joint.gain == 0) joint.gain = 1, joint.offset = 0;
  return joint;
}

double stuck_at(const BodySchema& schema, const ScrewJoint& joint, double displacement) {
  const ScrewJoint before = moving(joint);
  return command_of(schema.signals.at(static_cast<std::size_t>(joint.signal)),
                    (displacement - before.offset) / before.gain);
}

/// Standard deviations of f(θ), to first order.
std::vector<double> standard_deviations(
    const std::function<std::vector<double>(const Eigen::VectorXd&)>& f,
    const Eigen::VectorXd& theta, const Eigen::MatrixXd& covariance, std::size_t size) {
  if (covariance.rows() != theta.size() || theta.size() == 0) return std::vector<double>(size, -1);
  Eigen::MatrixXd J(static_cast<Eigen::Index>(size), theta.size());
  for (Eigen::Index i = 0; i < theta.size(); ++i) {
    const double step = std::max(1e-7, 0.1 * std::sqrt(std::max(0.0, covariance(i, i))));
    Eigen::VectorXd up = theta, down = theta;
    up(i) += step;
    down(i) -= step;
    const std::vector<double> more = f(up), less = f(down);
    for (std::size_t n = 0; n < size; ++n)
      J(static_cast<Eigen::Index>(n), i) = (more[n] - less[n]) / (2 * step);
  }
  const Eigen::VectorXd variances = (J * covariance * J.transpose()).diagonal();
  std::vector<double> result;
  for (const double variance : variances) result.push_back(std::sqrt(std::max(0.0, variance)));
  return result;
}

}  // namespace

ChangeSize size_of(const BodySchema& schema, const BodyChange& change, const Eigen::VectorXd& theta,
                   const Eigen::MatrixXd& covariance) {
  ChangeSize size;
  const Edge* edge = edge_to(schema, change.part);
  const bool is_of_joint = change.form == Form::kStuck || change.form == Form::kOffset ||
                           change.form == Form::kGain || change.form == Form::kOtherSignal;
  if (theta.size() != change.size()) return size;
  std::function<std::vector<double>(const Eigen::VectorXd&)> amounts;
  if (is_of_joint) {
    if (!edge || change.joint >= std::ssize(edge->joints)) return size;
    const ScrewJoint& joint = edge->joints[static_cast<std::size_t>(change.joint)];
    size.signal = change.form == Form::kOtherSignal ? change.signal : joint.signal;
    if (change.form == Form::kOtherSignal) return size;
    size.kind = change.form == Form::kGain ? Kind::kFactor : Kind::kCommand;
    amounts = [&schema, joint, form = change.form](const Eigen::VectorXd& t) {
      if (form == Form::kStuck) return std::vector<double>{stuck_at(schema, joint, t(0))};
      return std::vector<double>{form == Form::kGain ? 1 + t(0) : t(0) / moving(joint).gain};
    };
  } else if (change.form == Form::kMarkerMoved) {
    size.kind = Kind::kPose;
    amounts = [](const Eigen::VectorXd& t) { return distance_and_angle(transform(t)); };
  } else if (change.size() >= 6 && (edge || change.part == schema.root)) {
    size.kind = Kind::kPose;
    const Pose before = pose_at(schema, change.part);
    amounts = [&schema, change, before](const Eigen::VectorXd& t) {
      return distance_and_angle(before.inverse() *
                                pose_at(changed(schema, change, t), change.part));
    };
  } else {
    return size;
  }
  size.amounts = amounts(theta);
  size.sds = standard_deviations(amounts, theta, covariance, size.amounts.size());
  return size;
}

ChangeSize size_of_rate(const BodySchema& schema, int part, bool left, const Vector6d& rate,
                        const Matrix6d& covariance) {
  const Edge* edge = edge_to(schema, part);
  const Matrix6d A = left && edge ? adjoint(pose_at(schema, part).inverse()) : Matrix6d::Identity();
  const auto amounts = [](const Eigen::VectorXd& r) {
    return std::vector<double>{r.head<3>().norm(), r.tail<3>().norm()};
  };
  const Vector6d there = A * rate;
  return {Kind::kRate, -1, amounts(there),
          standard_deviations(amounts, there, A * covariance * A.transpose(), 2)};
}

FoundDifference difference_at(const BodySchema& before, const BodySchema& now, const Place& place) {
  const Edge *old = edge_to(before, place.part), *edge = edge_to(now, place.part);
  FoundDifference difference;
  if (old && edge && !place.marker && !edge->has_process_of(*old)) {
    difference.cause = "new_model";
    return difference;
  }
  if (old && edge && !place.marker && old->joints.size() == edge->joints.size()) {
    // One joint, and nothing else, may be what differs.
    std::vector<std::size_t> others;
    for (std::size_t d = 0; d < edge->joints.size(); ++d)
      if (old->joints[d].gain != edge->joints[d].gain ||
          old->joints[d].offset != edge->joints[d].offset)
        others.push_back(d);
    if (others.size() == 1) {
      const ScrewJoint &x = old->joints[others[0]], &y = edge->joints[others[0]];
      difference.size.signal = x.signal;
      difference.size.sds = {-1};
      difference.size.kind = Kind::kCommand;
      if (y.gain == 0) {
        difference.cause = "joint_stuck";
        difference.size.amounts = {stuck_at(before, x, y.offset)};
      } else if (y.gain == x.gain) {
        difference.cause = "joint_offset";
        difference.size.amounts = {(y.offset - x.offset) / moving(x).gain};
      } else {
        difference.cause = "joint_gain";
        difference.size.kind = Kind::kFactor;
        difference.size.amounts = {y.gain / moving(x).gain};
      }
      return difference;
    }
  }
  difference.cause = place.part == now.root ? "camera_moved"
                     : place.marker         ? "marker_moved"
                                            : "geometry";
  difference.size = {
      Kind::kPose,
      -1,
      distance_and_angle(pose_at(before, place.part).inverse() * pose_at(now, place.part)),
      {-1, -1}};
  return difference;
}

}  // namespace bodyschema
