#include "tests/support/imperfect_robot.h"

#include <algorithm>
#include <cmath>
#include <random>

#include "common/geometry/angle.h"

namespace bodyschema::test {
namespace {

using Eigen::AngleAxisd;
using Eigen::Isometry3d;
using Eigen::Vector3d;
using Vector9d = Eigen::Matrix<double, 9, 1>;

constexpr double kNoise_m = 0.003, kNoise_rad = 1 * kDegree;
constexpr int kNumTags = 4;  // a part, around it

Vector3d gaussian3(Rng& rng) {
  const double x = gaussian(rng), y = gaussian(rng);
  return {x, y, gaussian(rng)};
}

Isometry3d turned(const Vector3d& rotation_vector) {
  const double angle = rotation_vector.norm();
  if (angle == 0) return Isometry3d::Identity();
  return Isometry3d(AngleAxisd(angle, rotation_vector / angle));
}

/// Moved by `by`, in the frame's own axes: translation [m], rotation vector [rad].
Isometry3d moved(const Isometry3d& X, const Eigen::Matrix<double, 6, 1>& by) {
  Isometry3d step = turned(by.tail<3>());
  step.translation() = by.head<3>();
  return X * step;
}

Isometry3d random_side(Rng& rng) {
  Isometry3d X(random_rotation(rng));
  X.translation() = random_vector(rng, 0.05, 0.15);
  return X;
}

/// All monomials of the first and second degree of a view's direction.
Vector9d monomials(const Vector3d& v) {
  Vector9d m;
  m << v, v.cwiseProduct(v), v.x() * v.y(), v.y() * v.z(), v.z() * v.x();
  return m;
}

}  // namespace

const std::vector<Imperfection>& imperfections() {
  static const std::vector<Imperfection> all = {
      {.name = "none"},
      {.name = "backlash 0.2°", .backlash_deg = 0.2},
      {.name = "backlash 1°", .backlash_deg = 1},
      {.name = "backlash 3°", .backlash_deg = 3},
      {.name = "commands in steps of 1°", .command_step_deg = 1},
      {.name = "commands in steps of 5°", .command_step_deg = 5},
      {.name = "droop 0.5°", .droop_deg = 0.5},
      {.name = "droop 2°", .droop_deg = 2},
      {.name = "droop 3°", .droop_deg = 3},
      {.name = "view bias 1 mm, 0.5°", .view_bias_m = 0.001, .view_bias_deg = 0.5},
      {.name = "view bias 3 mm, 1.5°", .view_bias_m = 0.003, .view_bias_deg = 1.5},
      {.name = "view bias 4 mm, 2°", .view_bias_m = 0.004, .view_bias_deg = 2},
      {.name = "correlation 0.5", .correlation = 0.5},
      {.name = "correlation 0.9", .correlation = 0.9},
      {.name = "Student t, ν = 3", .student_nu = 3},
      {.name = "Student t, ν = 2.2", .student_nu = 2.2},
      {.name = "outliers 10 %", .outlier_share = 0.1},
      {.name = "outliers 20 %", .outlier_share = 0.2},
      {.name = "flips 10 %", .flip_share = 0.1},
      {.name = "flips 20 %", .flip_share = 0.2},
      {.name = "missing 30 %", .missing_share = 0.3},
      {.name = "missing 60 %", .missing_share = 0.6},
      {.name = "range 4°", .range_deg = 4},
      {.name = "range 10°", .range_deg = 10},
      {.name = "range 30°", .range_deg = 30},
      {.name = "sweep ±2 rad", .range_deg = 4 / kDegree},
      {.name = "range 480°", .range_deg = 480},
      {.name = "sweep ±6 rad", .range_deg = 12 / kDegree},
      {.name = "range 1080°", .range_deg = 1080},
      {.name = "sweep ±12 rad", .range_deg = 24 / kDegree},
      {.name = "placements 1 mm, 0.5°", .placement_m = 0.001, .placement_deg = 0.5},
      {.name = "placements 4 mm, 2°", .placement_m = 0.004, .placement_deg = 2},
      {.name = "tag sizes 1 %", .tag_size = 0.01},
      {.name = "focal length 2 %", .focal_length = 0.02},
      {.name = "distortion 2 %", .distortion = 0.02},
      {.name = "poses 1.5 samples late", .lag = 1.5},
      {.name = "poses 8 samples late", .lag = 8},
      {.name = "drives that follow in 4 samples", .drive = 4},
  };
  return all;
}

ImperfectRobot::ImperfectRobot(int num_joints, bool is_chain, const Imperfection& imperfection,
                               std::uint64_t seed)
    : is_(imperfection), rng_(seed), X_CR_(random_rotation(rng_)) {
  structure_.name = is_chain ? "chain" : "tree";
  X_CR_.translation() << 0, 0, 2;
  down_ = random_rotation(rng_).col(0);
  for (int n = 0; n <= num_joints; ++n) {
    Link link{.before = random_side(rng_), .after = random_side(rng_)};
    link.parent = n == 0 ? -1
                  : is_chain || n == 1 || uniform(rng_, 0, 1) < 0.6
                      ? n - 1
                      : static_cast<int>(uniform(rng_, 0, n - 1));
    for (int k = 0; k < kNumTags; ++k) {
      Tag tag;
      // Its normal, z, away from the part's axis.
      tag.X_BT =
          AngleAxisd(2 * M_PI * k / kNumTags, Vector3d::UnitX()) * Eigen::Translation3d(0, 0, 0.03);
      Eigen::Matrix<double, 6, 1> off;
      off << is_.placement_m * gaussian3(rng_), is_.placement_deg * kDegree * gaussian3(rng_);
      tag.placement = moved(Isometry3d::Identity(), off);
      tag.size = 1 + is_.tag_size * gaussian(rng_);
      // Each monomial has an rms near 1/2 over the sphere.
      for (double& entry : tag.bias.reshaped()) entry = gaussian(rng_) / 1.5;
      tag.bias.topRows<3>() *= is_.view_bias_m;
      tag.bias.bottomRows<3>() *= is_.view_bias_deg * kDegree;
      link.tags.push_back(tag);
    }
    links_.push_back(link);
    structure_.links.push_back({.part = n + 1,
                                .parent = link.parent < 0 ? -1 : link.parent + 1,
                                .X_before = link.before,
                                .X_after = link.after});
    if (n == 0) continue;
    structure_.links.back().signal = n - 1;
    structure_.links.back().turn = 1;
    const double range = is_.range_deg > 0 ? is_.range_deg : uniform(rng_, 120, 240);
    std::string name = "q";
    name += std::to_string(n);
    structure_.signals.push_back({name, -range / 2 * kDegree, range / 2 * kDegree});
  }
}

Eigen::VectorXd ImperfectRobot::random_action() { return structure_.random_action(rng_); }

std::vector<Isometry3d> ImperfectRobot::poses_at(const std::vector<double>& angles) const {
  std::vector<Isometry3d> X_RB(links_.size(), Isometry3d::Identity());
  for (std::size_t n = 1; n < links_.size(); ++n)
    X_RB[n] = X_RB[static_cast<std::size_t>(links_[n].parent)] * links_[n].before *
              AngleAxisd(angles[n], Vector3d::UnitZ()) * links_[n].after;
  return X_RB;
}

void ImperfectRobot::move(const Eigen::VectorXd& action) {
  std::vector<double> angles(links_.size(), 0);
  for (std::size_t n = 1; n < links_.size(); ++n) {
    double motor = action(static_cast<Eigen::Index>(n) - 1);
    if (is_.command_step_deg > 0) {
      const double step = is_.command_step_deg * kDegree;
      motor = step * std::round(motor / step);
    }
    const double play = is_.backlash_deg / 2 * kDegree;
    links_[n].angle = std::clamp(links_[n].angle, motor - play, motor + play);
    angles[n] = links_[n].angle;
  }
  if (is_.droop_deg > 0) {
    // Every link weighs as much; a joint's greatest torque is that of all links that it carries,
    // each stretched out sideways.
    const auto X_RB = poses_at(angles);
    for (std::size_t n = 1; n < links_.size(); ++n) {
      const Isometry3d X_RJ = X_RB[static_cast<std::size_t>(links_[n].parent)] * links_[n].before;
      double torque = 0, greatest = 0;
      for (std::size_t m = n; m < links_.size(); ++m) {
        double length = 0;
        std::size_t k = m;
        for (; k > n; k = static_cast<std::size_t>(std::max(links_[k].parent, 0)))
          length += links_[k].before.translation().norm() + links_[k].after.translation().norm();
        if (k != n) continue;  // not carried by it
        greatest += length + links_[n].after.translation().norm();
        torque +=
            (X_RB[m].translation() - X_RJ.translation()).cross(down_).dot(X_RJ.linear().col(2));
      }
      angles[n] += is_.droop_deg * kDegree * torque / greatest;
    }
  }
  poses_ = poses_at(angles);
  for (Isometry3d& X : poses_) X = X_CR_ * X;
}

const ImperfectRobot::Tag& ImperfectRobot::facing(const Link& link, const Isometry3d& X_CB) const {
  const auto cosine = [&](const Tag& tag) {
    const Isometry3d X_CT = X_CB * tag.X_BT;
    return -X_CT.linear().col(2).dot(X_CT.translation().normalized());
  };
  return *std::max_element(link.tags.begin(), link.tags.end(),
                           [&](const Tag& a, const Tag& b) { return cosine(a) < cosine(b); });
}

ActionPoseSample ImperfectRobot::go(const Eigen::VectorXd& action) {
  move(action);
  ActionPoseSample sample;
  sample.sample_index = num_samples_++;
  sample.utime = 1'000'000 * sample.sample_index;
  sample.action = action;
  for (std::size_t n = 0; n < links_.size(); ++n) {
    Link& link = links_[n];
    // Noise goes on whether or not the marker is seen.
    Eigen::Matrix<double, 6, 1> white;
    white << kNoise_m * gaussian3(rng_), kNoise_rad * gaussian3(rng_);
    if (is_.student_nu > 0) {
      // t = z / √(χ²/ν), its variance as the Gaussian's.
      double chi2 = 0;
      for (int k = 1; k <= is_.student_nu; ++k) chi2 += std::pow(gaussian(rng_), 2);
      const double rest = is_.student_nu - std::floor(is_.student_nu);
      if (rest > 0) chi2 += std::chi_squared_distribution<>(rest)(rng_);
      white *= std::sqrt((is_.student_nu - 2) / chi2);
    }
    const double rho = is_.correlation;
    link.noise =
        sample.sample_index == 0 ? white : rho * link.noise + std::sqrt(1 - rho * rho) * white;
    const double luck = uniform(rng_, 0, 1);
    if (luck < is_.missing_share) continue;

    const Tag& tag = facing(link, poses_[n]);
    Isometry3d X_CT = poses_[n] * tag.X_BT * tag.placement;
    const Vector3d view = -(X_CT.linear().transpose() * X_CT.translation()).normalized();
    X_CT = moved(X_CT, tag.bias * monomials(view) + link.noise);
    // A tag that is larger, or seen through a longer lens, seems nearer.
    X_CT.translation() /= tag.size;
    X_CT.translation().z() /= 1 + is_.focal_length;
    const Eigen::Vector2d ray = X_CT.translation().head<2>() / X_CT.translation().z();
    X_CT.translation().head<2>() *= 1 + is_.distortion * ray.squaredNorm();
    if (uniform(rng_, 0, 1) < is_.flip_share) {
      const Vector3d normal = X_CT.linear().col(2), sight = X_CT.translation().normalized();
      const Vector3d axis = normal.cross(-sight);
      if (axis.norm() > 1e-9)
        X_CT.linear() =
            AngleAxisd(2 * std::atan2(axis.norm(), normal.dot(-sight)), axis.normalized()) *
            X_CT.linear();
    }
    if (uniform(rng_, 0, 1) < is_.outlier_share) {
      X_CT.linear() = random_rotation(rng_);
      X_CT.translation() += random_vector(rng_, 0, 1);
    }
    PartObservation& o = sample.parts.emplace_back();
    o.part = static_cast<int>(n) + 1;
    o.X_CB = Pose((X_CT * tag.X_BT.inverse()).matrix());
  }
  return sample;
}

std::vector<ActionPoseSample> ImperfectRobot::wander(int num_samples, double period) {
  // Three sines a signal, of half to twice the period.
  constexpr int kSines = 3;
  const auto num_signals = static_cast<Eigen::Index>(signals().size());
  Eigen::MatrixXd rate(num_signals, kSines), phase(num_signals, kSines), share(num_signals, kSines);
  for (Eigen::Index s = 0; s < num_signals; ++s)
    for (int k = 0; k < kSines; ++k) {
      rate(s, k) = 2 * M_PI / period * std::exp2(uniform(rng_, -1, 1));
      phase(s, k) = uniform(rng_, 0, 2 * M_PI);
      share(s, k) = uniform(rng_, 0.5, 1);
    }
  const auto action_at = [&](double n) {
    Eigen::VectorXd action(num_signals);
    for (Eigen::Index s = 0; s < num_signals; ++s) {
      const Signal& signal = signals()[static_cast<std::size_t>(s)];
      double swing = 0;
      for (int k = 0; k < kSines; ++k)
        swing += share(s, k) / share.row(s).sum() * std::sin(rate(s, k) * n + phase(s, k));
      action[s] = 0.5 * (signal.lower + signal.upper) + 0.5 * swing * (signal.upper - signal.lower);
    }
    return action;
  };
  // Where the drives are; they have been on the way for long.
  constexpr int kSteps = 10, kBefore = 200;
  Eigen::VectorXd reached = action_at(-kBefore);
  const double gone = is_.drive > 0 ? -std::expm1(-1 / (kSteps * is_.drive)) : 1;
  std::vector<ActionPoseSample> samples;
  for (int step = -kSteps * kBefore; step <= kSteps * (num_samples - 1); ++step) {
    const double n = static_cast<double>(step) / kSteps;
    reached += gone * (action_at(n) - reached);
    if (step < 0 || step % kSteps != 0) continue;
    samples.push_back(go(reached));
    samples.back().action = action_at(n + is_.lag);
  }
  return samples;
}

std::vector<ActionPoseSample> ImperfectRobot::babble(int num_samples) {
  std::vector<ActionPoseSample> samples;
  for (int n = 0; n < num_samples; ++n) samples.push_back(go(random_action()));
  return samples;
}

void ImperfectRobot::bend(int part, double position_m, double rotation_rad) {
  Isometry3d step = turned(rotation_rad * gaussian3(rng_).normalized());
  step.translation() = position_m * gaussian3(rng_).normalized();
  Isometry3d& after = links_[static_cast<std::size_t>(part) - 1].after;
  after = after * step;
}

}  // namespace bodyschema::test
