#include "processes/console/pure_joints.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <utility>

#include "common/geometry/angle.h"
#include "common/schema/standard_deviations.h"
#include "processes/structure_learner/placed_screw.h"

namespace bodyschema {
namespace {

/// Chosen: of 1000 revolute joints three are refused.
constexpr double kMostDeviations = 3;
/// Weights alone, as `engineer` has them.
constexpr Noise kAssumedNoise{0.001, 0.2 * kDegree};
constexpr int kNumLinePoints = 101;
/// A motion over the whole range below this is rounding [m, rad].
constexpr double kRounding = 1e-13;
/// Of a covariance matrix that is inverted; what is below has no digits left.
constexpr double kLeastCondition = 1e-12;

Pose motion(const ScrewJoint& joint, double displacement) {
  Pose X = Pose::Identity();
  Screw{joint.slide, joint.turn}.append_motion(displacement, X.linear(), X.translation());
  return X;
}

/// θ ≈ first + second · q, of least squares between the limits.
std::pair<double, double> line_through(const Signal& signal) {
  const double middle = 0.5 * (signal.lower + signal.upper);
  double sum = 0, product = 0, square = 0;
  for (int n = 0; n < kNumLinePoints; ++n) {
    const double x = (signal.upper - signal.lower) * (n / (kNumLinePoints - 1.0) - 0.5);
    const double theta = signal.displacement(middle + x);
    sum += theta;
    product += x * theta;
    square += x * x;
  }
  const double slope = square > 0 ? product / square : 1;
  return {sum / kNumLinePoints - slope * middle, slope};
}

class Purification {
 public:
  Purification(const BodySchema& schema, bool nominal)
      : nominal_(nominal), theta_(schema.displacements(mid_range(schema.signals))) {
    pure_.schema = schema;
    if (schema.noise.position_m > 0 && schema.noise.rotation_rad > 0) noise_ = schema.noise;
  }

  PureJoints run() {
    for (std::size_t e = 0; e < pure_.schema.edges.size(); ++e) {
      edge_ = e;
      remove_process();
      make_pure();
    }
    for (std::size_t s = 0; s < pure_.schema.signals.size(); ++s) straighten(static_cast<int>(s));
    if (!refusals_.empty())
      throw std::invalid_argument(
          fmt::format("a URDF has no such joints: {}; --nominal writes the nearest that it has",
                      fmt::join(refusals_, "; ")));
    return std::move(pure_);
  }

 private:
  Edge& edge() { return pure_.schema.edges[edge_]; }
  std::string ends() { return fmt::format("{}→{}", edge().from, edge().to); }

  void replace(std::vector<std::string>* about, const std::string& what, const std::string& by) {
    if (!nominal_) refusals_.push_back(what);
    about->push_back(what + "; " + by);
  }

  void remove_process() {
    Edge& edge = this->edge();
    std::vector<std::string>& about = pure_.about_edges[edge_];
    if (edge.residual_gp) {
      replace(&about, ends() + ": screws with a Gaussian process behind them",
              "written: the screws, and its value at mid-range");
      const Pose X_residual = exp(edge.residual_gp->mean(theta_));
      edge.right = X_residual * edge.right;
      edge.residual_gp.reset();
    }
    if (edge.matrix_gp) {
      replace(&about, ends() + ": a matrix of Gaussian processes",
              "written: its derivative at mid-range");
      take_tangents();
    }
  }

  /// A screw for each signal of the matrix process: Δ(θ_mid) ∏ Exp(∂Δ/∂θ_s (θ_s − θ_mid,s)).
  void take_tangents() {
    Edge& edge = this->edge();
    const Eigen::MatrixXd J = edge.jacobian(theta_);
    const std::vector<int> signals = edge.signals();
    edge.left = edge.predict(theta_);
    edge.right = Pose::Identity();
    edge.matrix_gp.reset();
    edge.parameter_covariance.resize(0, 0);
    for (const int s : signals) {
      const Vector6d twist = J.col(s);
      const PlacedScrew placed = PlacedScrew::of(twist, twist.tail<3>().norm() <= kRounding);
      Pose& before = edge.joints.empty() ? edge.left : edge.joints.back().X_after;
      before = before * placed.X;
      ScrewJoint joint;
      joint.signal = s;
      joint.offset = -theta_(s);
      joint.slide = placed.screw.slide;
      joint.turn = placed.screw.turn;
      joint.X_after = placed.X.inverse();
      edge.joints.push_back(joint);
    }
  }

  /// Takes slide or turn from each joint that has both.
  void make_pure() {
    std::vector<bool> keeps_turn;
    for (std::size_t d = 0; d < edge().joints.size(); ++d) {
      keeps_turn.push_back(turn_moves_more(d));
      if (is_helical(edge().joints[d])) tell_of_loss(d, keeps_turn[d]);
    }
    restrict(keeps_turn);
    for (std::size_t d = 0; d < edge().joints.size(); ++d) {
      ScrewJoint& joint = edge().joints[d];
      if (!is_helical(joint)) continue;
      const double middle = joint.gain * theta_(joint.signal) + joint.offset;
      ScrewJoint constant = joint;  // commutes with what is kept
      (keeps_turn[d] ? constant.turn : constant.slide) = 0;
      joint.X_after = motion(constant, middle) * joint.X_after;
      (keeps_turn[d] ? joint.slide : joint.turn) = 0;
    }
  }

  static bool is_helical(const ScrewJoint& joint) {
    return joint.gain != 0 && joint.slide != 0 && joint.turn != 0;
  }

  /// The part, in units of the noise: with the joints behind in the middle of their ranges.
  bool turn_moves_more(std::size_t d) {
    const ScrewJoint& joint = edge().joints[d];
    Edge behind = edge();
    behind.left = joint.X_after;
    behind.joints.erase(behind.joints.begin(), behind.joints.begin() + static_cast<long>(d) + 1);
    const double lever = behind.predict(theta_).translation().head<2>().norm();
    return std::abs(joint.turn) * std::hypot(1 / noise_.rotation_rad, lever / noise_.position_m) >=
           std::abs(joint.slide) / noise_.position_m;
  }

  /// Moves all parameters to what the samples tell of them where the joints are pure: with x = 0
  /// for the rest, E p|x = p − P_px P_xx⁻¹ x, P their covariance.
  void restrict(const std::vector<bool>& keeps_turn) {
    Edge& edge = this->edge();
    const Eigen::MatrixXd& P = edge.parameter_covariance;
    if (P.rows() != edge.num_parameters() || P.cols() != edge.num_parameters()) return;
    std::vector<int> at;  // of x among the parameters
    std::vector<double> values;
    for (std::size_t d = 0; d < edge.joints.size(); ++d) {
      const int joint = static_cast<int>(d);
      const int index =
          keeps_turn[d] ? ScrewChainLayout::slide(joint) : ScrewChainLayout::turn(joint);
      if (edge.joints[d].gain == 0 || !(P(index, index) > 0)) continue;
      at.push_back(index);
      values.push_back(keeps_turn[d] ? edge.joints[d].slide : edge.joints[d].turn);
    }
    const Eigen::Map<const Eigen::VectorXd> x(values.data(), std::ssize(values));
    if (x.isZero(0)) return;
    const Eigen::LLT<Eigen::MatrixXd> P_xx(P(at, at));
    if (P_xx.info() != Eigen::Success || P_xx.rcond() < kLeastCondition) return;
    const Eigen::VectorXd step = -P(Eigen::all, at) * P_xx.solve(x);
    edge.left = edge.left * exp(step.head<6>());
    for (std::size_t d = 0; d < edge.joints.size(); ++d) {
      const int joint = static_cast<int>(d);
      edge.joints[d].slide += step(ScrewChainLayout::slide(joint));
      edge.joints[d].turn += step(ScrewChainLayout::turn(joint));
      edge.joints[d].X_after =
          edge.joints[d].X_after * exp(step.segment<6>(ScrewChainLayout::transform(joint + 1)));
    }
  }

  void tell_of_loss(std::size_t d, bool keeps_turn) {
    const ScrewJoint& joint = edge().joints[d];
    const Signal& signal = pure_.schema.signals[static_cast<std::size_t>(joint.signal)];
    const double range = std::abs(
        joint.gain * (signal.displacement(signal.upper) - signal.displacement(signal.lower)));
    const double loss = keeps_turn ? joint.slide : joint.turn;
    if (std::abs(loss) * range <= kRounding) return;
    const std::vector<JointDeviation> deviations = joint_deviations(edge(), theta_);
    double sd = 0;
    if (!deviations.empty()) sd = keeps_turn ? deviations[d].slide : deviations[d].turn;
    const double unit = keeps_turn ? 1e-3 : kDegree;
    const std::string deviation =
        sd > 0 ? fmt::format(" ± {:.2g}", std::abs(joint.gain) * sd / unit) : "";
    const std::string what =
        fmt::format("{} {:.2g}{} {} per unit, {:.2g} over the range",
                    keeps_turn ? "slides" : "turns", joint.gain * loss / unit, deviation,
                    keeps_turn ? "mm" : "deg", std::abs(loss) * range / unit);
    std::vector<std::string>& about = pure_.about_edges[edge_];
    if (std::abs(loss) <= kMostDeviations * sd)
      about.push_back(fmt::format("{} {}: {}; left out", ends(), signal.name, what));
    else
      replace(&about, fmt::format("{} {}: helical, {}", ends(), signal.name, what), "left out");
  }

  void straighten(int index) {
    Signal& signal = pure_.schema.signals[static_cast<std::size_t>(index)];
    if (signal.warp.empty()) return;
    const auto [constant, slope] = line_through(signal);
    double most = 0;
    for (int n = 0; n < kNumLinePoints; ++n) {
      const double q = signal.lower + (signal.upper - signal.lower) * n / (kNumLinePoints - 1.0);
      most = std::max(most, std::abs(signal.displacement(q) - constant - slope * q));
    }
    replace(&pure_.about_signals,
            fmt::format("{}: its command is bent, by up to {:.2g} units", signal.name, most),
            "written: the straight line");
    signal.warp.clear();
    for (Edge& edge : pure_.schema.edges) {
      for (ScrewJoint& joint : edge.joints) {
        if (joint.signal != index) continue;
        joint.offset += joint.gain * constant;
        joint.gain *= slope;
      }
    }
  }

  const bool nominal_;
  const Eigen::VectorXd theta_;  // θ_mid
  Noise noise_ = kAssumedNoise;
  std::size_t edge_ = 0;
  PureJoints pure_;
  std::vector<std::string> refusals_;
};

}  // namespace

PureJoints pure_joints(const BodySchema& schema, bool nominal) {
  return Purification(schema, nominal).run();
}

}  // namespace bodyschema
