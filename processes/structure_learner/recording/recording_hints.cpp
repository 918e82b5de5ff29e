#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <optional>
#include <utility>

#include "common/estimation/quantile.h"
#include "processes/structure_learner/pair_data.h"
#include "processes/structure_learner/recording/recording.h"

namespace bodyschema {
namespace {

/// No arm with markers on it moves farther [m].
constexpr double kLargestBody_m = 10;
/// Largest believable standard deviation of a marker [m], kNoiseCeiling of the learner.
constexpr double kLargestNoise_m = 0.1;

/// Positions of one part, or poses of one relative to another, in the order of the samples.
using Track = std::vector<Pose>;

std::map<int, Track> tracks_of(const std::vector<ActionPoseSample>& samples, bool posed_only) {
  std::map<int, Track> tracks;
  for (const ActionPoseSample& sample : samples)
    for (const PartObservation& o : sample.parts)
      if (o.has_rotation || !posed_only) tracks[o.part].push_back(o.X_CB);
  return tracks;
}

Eigen::Vector3d median_position(const Track& track) {
  Eigen::Vector3d result;
  for (int axis = 0; axis < 3; ++axis) {
    std::vector<double> values;
    for (const Pose& X : track) values.push_back(X.translation()[axis]);
    result[axis] = upper_median(values);
  }
  return result;
}

/// Median distance of a track from its middle [m].
double spread_m(const Track& track) {
  const Eigen::Vector3d middle = median_position(track);
  std::vector<double> distances;
  for (const Pose& X : track) distances.push_back((X.translation() - middle).norm());
  return upper_median(distances);
}

/// The pose whose x, y, z, w was read as w, x, y, z.
Pose reordered(const Pose& X) {
  const Eigen::Quaterniond read(X.linear());
  return make_pose(Eigen::Quaterniond(read.z(), read.w(), read.x(), read.y()), X.translation());
}

/// Median distance [m] of the best point c of one part from the best point d of another, whose
/// poses relative to the first are given: least squares of p_t + R_t d - c. 0: rigid, or turning
/// about a fixed point, as with any hinge.
double pivot_residual_m(const Track& relative) {
  // The smallest d, where the rotation does not tell it.
  constexpr double kRidge = 1e-6;
  using Vector6 = Eigen::Matrix<double, 6, 1>;
  Eigen::Matrix<double, 6, 6> normal = kRidge * Eigen::Matrix<double, 6, 6>::Identity();
  Vector6 right = Vector6::Zero();
  for (const Pose& X : relative) {
    Eigen::Matrix<double, 3, 6> row;
    row << X.linear(), -Eigen::Matrix3d::Identity();
    normal += row.transpose() * row;
    right -= row.transpose() * X.translation();
  }
  const Vector6 d_c = normal.ldlt().solve(right);
  std::vector<double> residuals;
  for (const Pose& X : relative) residuals.push_back((X * d_c.head<3>() - d_c.tail<3>()).norm());
  return upper_median(residuals);
}

/// How far the poses of a part relative to another are from those of one joint: the sum of what the
/// best common point moves, per distance, and of what the relative rotation turns beside its main
/// axis [rad]. 0: rigid, or turning about a fixed axis.
double disorder(const Track& relative) {
  const Pose first = relative[relative.size() / 2];
  std::vector<double> distances;
  Eigen::Matrix3d scatter = Eigen::Matrix3d::Zero();
  std::vector<Eigen::Vector3d> turns;
  for (const Pose& z : relative) {
    distances.push_back(z.translation().norm());
    turns.push_back(log_so3(first.linear().transpose() * z.linear()));
    scatter += turns.back() * turns.back().transpose();
  }
  const Eigen::Vector3d axis =
      Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d>(scatter).eigenvectors().col(2);
  std::vector<double> beside;
  for (const Eigen::Vector3d& turn : turns) beside.push_back((turn - axis * axis.dot(turn)).norm());
  return pivot_residual_m(relative) / std::max(upper_median(distances), 1e-9) +
         upper_median(beside);
}

/// Whether the rotations fit together as those of a body only when they are read in the other
/// order. Read in the wrong order rotations are inverted (and turned by constants), so that what is
/// rigid tumbles: each part's best partner tells.
bool is_order_x_y_z_w(const std::vector<ActionPoseSample>& samples,
                      const std::map<int, Track>& tracks) {
  // The reference frame's own pose is no rotation.
  for (const auto& [part, track] : tracks) {
    const bool is_reference = std::all_of(track.begin(), track.end(), [](const Pose& X) {
      return X.translation().isZero(0) &&
             (X.linear().diagonal() - Eigen::Vector3d(-1, -1, 1)).norm() < 1e-12;
    });
    if (is_reference) return true;
  }
  // Enough to tell by; few enough to be done at once.
  constexpr std::size_t kFewest = 8, kMost = 200;
  constexpr std::size_t kMostParts = 12;
  // Noise, and joints beside the origin, make disorder of about this size in either order.
  constexpr double kUnremarkable = 0.1;
  // Evidence of all parts, in nats of disorder. Measured by recording_hints_test.cpp: 1500
  // recordings that are right have at most 0.35.
  constexpr double kEvidence = 1;
  const std::size_t stride = std::max<std::size_t>(1, samples.size() / kMost);
  std::map<int, std::pair<double, double>> least;  // disorder of each part as read, reordered
  std::size_t num_parts = 0;
  for (auto i = tracks.begin(); i != tracks.end() && num_parts < kMostParts; ++i, ++num_parts) {
    for (auto j = tracks.begin(); j != tracks.end(); ++j) {
      if (i == j) continue;
      Track as_read, other;
      for (std::size_t t = 0; t < samples.size(); t += stride) {
        const PartObservation* a = samples[t].find(i->first);
        const PartObservation* b = samples[t].find(j->first);
        if (!a || !b || !a->has_rotation || !b->has_rotation) continue;
        as_read.push_back(a->X_CB.inverse() * b->X_CB);
        other.push_back(reordered(a->X_CB).inverse() * reordered(b->X_CB));
      }
      if (as_read.size() < kFewest) continue;
      const auto [known, is_new] =
          least.try_emplace(j->first, std::pair(disorder(as_read), disorder(other)));
      if (is_new) continue;
      known->second.first = std::min(known->second.first, disorder(as_read));
      known->second.second = std::min(known->second.second, disorder(other));
    }
  }
  double evidence = 0;
  for (const auto& [part, both] : least)
    evidence += std::log((both.first + kUnremarkable) / (both.second + kUnremarkable));
  return evidence > kEvidence;
}

/// Signals that vary, but too little to count as moving: joints held still, or another unit.
std::optional<std::string> jitter_hint(const Recording& recording) {
  const auto num_signals = static_cast<Eigen::Index>(recording.signals.size());
  if (recording.samples.empty() || num_signals == 0) return std::nullopt;
  Eigen::VectorXd lower = recording.samples.front().action, upper = lower;
  for (const ActionPoseSample& sample : recording.samples) {
    lower = lower.cwiseMin(sample.action);
    upper = upper.cwiseMax(sample.action);
  }
  const Eigen::VectorXd range = upper - lower;
  std::vector<std::string> held;
  double most = 0;
  for (Eigen::Index s = 0; s < num_signals; ++s)
    if (range(s) > 0 && is_jitter(lower(s), upper(s), range.maxCoeff())) {
      held.push_back(recording.signals[static_cast<std::size_t>(s)].name);
      most = std::max(most, range(s));
    }
  if (held.empty()) return std::nullopt;
  return fmt::format(
      "{} var{} by {:.2g} at most, where others move by {:.2g}: taken for joints held still; a "
      "column in another unit than the others needs to be scaled",
      fmt::join(held, ", "), held.size() == 1 ? "ies" : "y", most, range.maxCoeff());
}

}  // namespace

bool looks_like_radians(const Noise& noise) {
  constexpr double kLargestMarker_m = 4;
  return noise.rotation_rad < noise.position_m / (kLargestMarker_m / 2);
}

std::vector<std::string> hints_of(const Recording& recording) {
  std::vector<std::string> hints;
  const std::map<int, Track> tracks = tracks_of(recording.samples, false),
                             posed_tracks = tracks_of(recording.samples, true);
  double largest_m = 0;
  Track middles;
  for (const auto& [part, track] : tracks) {
    largest_m = std::max(largest_m, spread_m(track));
    middles.emplace_back(Eigen::Translation3d(median_position(track)));
  }
  if (std::max(largest_m, spread_m(middles)) > kLargestBody_m)
    hints.emplace_back("positions look like millimetres or centimetres; expected metres");
  if (recording.has_noise) {
    std::vector<double> noise_m, noise_rad;
    for (const ActionPoseSample& sample : recording.samples)
      for (const PartObservation& o : sample.parts) {
        noise_m.push_back(std::sqrt(o.covariance(0, 0)));
        if (o.has_rotation) noise_rad.push_back(std::sqrt(o.covariance(5, 5)));
      }
    if (upper_median(noise_m) > kLargestNoise_m)
      hints.emplace_back("sp_m looks like millimetres; expected metres");
    else if (!noise_rad.empty() &&
             looks_like_radians({upper_median(noise_m), upper_median(noise_rad)}))
      hints.emplace_back("sr_deg looks like radians; expected degrees");
  }
  if (auto jitter = jitter_hint(recording)) hints.push_back(*std::move(jitter));
  if (is_order_x_y_z_w(recording.samples, posed_tracks))
    hints.emplace_back("the quaternion column order looks like x y z w; expected qw,qx,qy,qz");
  return hints;
}

void add_mixture_hint(Recording& recording) {
  const std::vector<int> alone = parts_without_rotation(recording.samples);
  for (const int part : seen_parts(recording.samples)) {
    const bool is_alone = std::binary_search(alone.begin(), alone.end(), part);
    int num_left_out = 0, num_seen = 0;
    for (const ActionPoseSample& sample : recording.samples)
      if (const PartObservation* o = sample.find(part)) {
        ++num_seen;
        num_left_out += o->has_rotation == is_alone;
      }
    if (num_left_out > 0)
      recording.hints.push_back(fmt::format(
          "part {}: {} of {} observations are left out, which have {} orientation: a part is "
          "learned by the kind that it has more of",
          part, num_left_out, num_seen, is_alone ? "an" : "no"));
  }
}

}  // namespace bodyschema
