// What class Controller knows of the arm, of what is seen of it and of the schema.

#include <Eigen/Cholesky>
#include <utility>

#include "common/bus/convert.h"
#include "common/bus/rest_position.h"
#include "common/estimation/chi_square.h"
#include "common/text/text.h"
#include "processes/controller/controller.h"
#include "processes/controller/controller_words.h"

namespace bodyschema {
namespace {

/// Beyond this squared distance the camera is not where the schema says.
const double kMovedCamera = chi_square_quantile(6, 1e-5);
/// Beyond this one what is seen refutes the schema.
const double kSurprise = chi_square_quantile(3, 0.0027);

Eigen::VectorXd vector_of(const std::vector<double>& values) {
  return Eigen::Map<const Eigen::VectorXd>(values.data(), static_cast<Eigen::Index>(values.size()));
}

}  // namespace

std::string Controller::unheard() const {
  if (!motion_) return "MOTION_STATUS: does the driver run?";
  if (!schema_) return "BODY_SCHEMA: nothing was learned yet, or does model_monitor run?";
  const bool needs_tags = target_.target_kind == pose_target_t::KIND_TAG;
  const std::int64_t known_until_utime = needs_tags ? tracked_until_utime_ : seen_until_utime_;
  if (is_at_rest() && known_until_utime < motion_->rest_since_utime) {
    return "MARKER_POSES of the arm at rest: do camera and marker_estimator run?";
  }
  return "";
}

std::string Controller::silence(std::int64_t now_us) {
  // Every stopwatch is looked at on every tick: it starts when it is first seen.
  const std::int64_t motion_us = motion_silence_.elapsed_us(now_us);
  const std::int64_t schema_us = schema_silence_.elapsed_us(now_us);
  const bool is_image_due = motion_ && seen_until_utime_ < motion_->utime;
  if (!is_image_due) eyes_silence_.restart();
  const std::int64_t eyes_us = eyes_silence_.elapsed_us(now_us);
  if (motion_us > config_.max_motion_status_silence_us) {
    return "no MOTION_STATUS for " + seconds(config_.max_motion_status_silence_us) +
           ": is the driver alive?";
  }
  if (eyes_us > config_.max_marker_poses_silence_us) {
    return "no MARKER_POSES for " + seconds(config_.max_marker_poses_silence_us) +
           ": are camera and marker_estimator alive?";
  }
  if (schema_us > config_.max_body_schema_silence_us) {
    return "no BODY_SCHEMA for " + seconds(config_.max_body_schema_silence_us) +
           ": is model_monitor alive?";
  }
  return "";
}

bool Controller::is_from_far_ahead(std::int64_t frame_utime) const {
  return frame_utime > motion_->utime + config_.max_motion_status_silence_us +
                           config_.max_marker_poses_silence_us;
}

void Controller::see(std::int64_t frame_utime) {
  // A frame from far ahead would make the eyes look open for ever.
  if (!motion_ || is_from_far_ahead(frame_utime)) return;
  if (frame_utime <= seen_until_utime_) return;
  seen_until_utime_ = frame_utime;
  if (motion_->utime - frame_utime <= config_.max_marker_poses_silence_us) {
    eyes_silence_.restart();
  }
}

void Controller::track(const marker_poses_t& poses) {
  if (!motion_ || !is_at_rest() || poses.utime < motion_->rest_since_utime ||
      poses.utime <= tracked_until_utime_ || is_from_far_ahead(poses.utime))
    return;
  tracked_until_utime_ = poses.utime;
  const bool is_new_rest =
      std::exchange(tracked_rest_utime_, motion_->rest_since_utime) != motion_->rest_since_utime;
  const bool is_serving = is_open(phase_) && tag_place_;
  for (auto& [id, track] : tags_) {
    if (is_new_rest && !(is_serving && id == target_.target_tag)) track = TagTrack();
    std::optional<TagTrack::Sight> sight;
    for (const marker_pose_t& marker : poses.markers) {
      if (marker.marker_id != id) continue;
      PartObservation tag;
      tag.X_CB = from_message(marker.X_CM[0]);
      tag.covariance = from_message(marker.covariance);
      const Eigen::Matrix3d R_CM = tag.X_CB.linear();
      const Matrix6d covariance = config_.measurement.covariance(tag);
      sight = {tag.X_CB.translation(), R_CM * covariance.topLeftCorner<3, 3>() * R_CM.transpose()};
    }
    track.see(sight);
  }
}

void Controller::locate() {
  if (!is_at_rest()) {
    position_.reset();
    return;
  }
  if (motion_->rest_since_utime != position_rest_utime_) position_.reset();
  if (const auto told = rest_position(*motion_, config_.signals.size())) {
    position_ = told;
  } else if (!position_ && sample_ && sample_->rest_begin_utime == motion_->rest_since_utime) {
    position_ = vector_of(sample_->action);
  }
  position_rest_utime_ = motion_->rest_since_utime;
}

double Controller::tolerance_m() const {
  return target_.tolerance_m > 0 ? target_.tolerance_m : config_.reached_m;
}

double Controller::tolerance_rad() const {
  return target_.tolerance_rad > 0 ? target_.tolerance_rad : config_.reached_rad;
}

std::optional<Eigen::Quaterniond> Controller::wanted_orientation() const {
  if (target_.target_kind != pose_target_t::KIND_POSE) return std::nullopt;
  const double* q = target_.orientation_wxyz;
  return Eigen::Quaterniond(q[0], q[1], q[2], q[3]).normalized();
}

void Controller::update_predicted_errors() {
  predicted_error_m_ = predicted_error_rad_ = -1;
  if (!schema_ || !position_ || target_.target_part < 0) return;
  const auto X_RB = schema_->predict(schema_->root, target_.target_part, *position_);
  if (!X_RB) return;
  predicted_error_m_ = (X_RB->X_AB.translation() - position_of(target_)).norm();
  if (const auto q_RT = wanted_orientation())
    predicted_error_rad_ = q_RT->angularDistance(Eigen::Quaterniond(X_RB->X_AB.linear()));
}

Controller::RootPose Controller::X_CR_at(const ActionPoseSample& sample) const {
  const RootPose by_schema{schema_->X_CR, schema_->X_CR_covariance};
  // One view of the root is worse than the schema's mean over all: half a degree is 9 mm at 1 m.
  const PartObservation* root = sample.find(schema_->root);
  if (root == nullptr || !root->has_rotation) return by_schema;
  const RootPose seen{root->X_CB, config_.measurement.covariance(*root)};
  const Vector6d off = log(by_schema.X_CR.inverse() * seen.X_CR);
  const bool was_moved =
      squared_mahalanobis(off, seen.covariance + by_schema.covariance) > kMovedCamera;
  return was_moved ? seen : by_schema;
}

Eigen::Vector3d Controller::aim() const {
  return position_of(target_) + (offset_ ? offset_->mean_m : Eigen::Vector3d::Zero());
}

std::optional<Controller::Offset> Controller::updated_offset(const Offset& seen) const {
  const Eigen::Vector3d before = offset_ ? offset_->mean_m : Eigen::Vector3d::Zero();
  const Eigen::Matrix3d P = offset_ ? offset_->covariance : Eigen::Matrix3d::Zero();
  const Eigen::Vector3d surprise = seen.mean_m - before;
  const Eigen::LDLT<Eigen::Matrix3d> S(P + seen.covariance);
  if (surprise.dot(S.solve(surprise)) <= kSurprise) return std::nullopt;
  // Before anything refuted the schema, nothing was known of the offset.
  if (!offset_) return seen;
  const Eigen::Matrix3d K = S.solve(P).transpose();
  return Offset{before + K * surprise, P - K * P};
}

void Controller::forget_sight() {
  observed_error_m_ = observed_error_rad_ = -1;
  observed_offset_.reset();
}

void Controller::observe(const sample_t& message) {
  forget_sight();
  if (!schema_) return;
  ActionPoseSample sample = from_message(message);
  drop_moved_tags(schema_->moved_tags, &sample);
  const PartObservation* part = sample.find(target_.target_part);
  if (part == nullptr) return;
  const auto [X_CR, root_covariance] = X_CR_at(sample);
  const Pose X_RB_seen = X_CR.inverse() * part->X_CB;
  const Eigen::Vector3d p_RB = X_RB_seen.translation();
  observed_error_m_ = (position_of(target_) - p_RB).norm();
  if (const auto q_RT = wanted_orientation(); q_RT && part->has_rotation)
    observed_error_rad_ = q_RT->angularDistance(Eigen::Quaterniond(X_RB_seen.linear()));
  const auto X_RB = schema_->predict(schema_->root, part->part, sample.action);
  const auto seen = config_.measurement.reading(*part, X_RB ? X_CR * X_RB->X_AB : part->X_CB);
  const Eigen::Matrix3d R_RB = (X_CR.inverse() * seen.X_CB).linear();
  Eigen::Matrix3d covariance = seen.covariance.topLeftCorner<3, 3>();
  if (X_RB) covariance += X_RB->covariance.topLeftCorner<3, 3>();
  covariance = (R_RB * covariance * R_RB.transpose()).eval();
  // p_RB by a pose of the root that is off by exp(ξ), ξ = (translation, rotation).
  Eigen::Matrix<double, 3, 6> J;
  J << -Eigen::Matrix3d::Identity(), skew(p_RB);
  covariance += J * root_covariance * J.transpose();
  if (X_RB && !part->X_CB_other)
    observed_offset_ = updated_offset({X_RB->X_AB.translation() - p_RB, covariance});
}

EdgeState Controller::worst_edge(std::string* name) const {
  EdgeState worst = EdgeState::kOk;
  const auto severity = [](EdgeState state) {
    return state == EdgeState::kOk ? 0 : state == EdgeState::kInvalid ? 2 : 1;
  };
  const auto chain = chain_to(*schema_, target_.target_part);
  if (!chain) return worst;
  for (const Edge& edge : chain->edges) {
    EdgeState state = edge.state;
    // The monitor's judgement is newer than the schema that it judges.
    if (health_ && health_->schema_version == schema_->version) {
      for (const edge_health_t& health : health_->edge_health) {
        if (health.health_from != edge.from || health.health_to != edge.to) continue;
        const auto judged = static_cast<EdgeState>(health.edge_state);
        if (severity(judged) > severity(state)) state = judged;
      }
    }
    if (severity(state) <= severity(worst)) continue;
    worst = state;
    if (name) *name = "edge " + std::to_string(edge.from) + "–" + std::to_string(edge.to);
  }
  // The marker by which the part is seen, and that of the root or the camera.
  if (health_ && health_->schema_version == schema_->version && worst != EdgeState::kInvalid) {
    for (const part_health_t& health : health_->part_health) {
      if (health.part_state != schema_edge_t::EDGE_INVALID ||
          (health.health_part != target_.target_part && health.health_part != schema_->root))
        continue;
      worst = EdgeState::kInvalid;
      if (name) *name = "the marker of part " + std::to_string(health.health_part);
      break;
    }
  }
  return worst;
}

std::optional<Eigen::VectorXd> Controller::wanted_probe() const {
  if (!health_ || health_->schema_version != schema_->version || health_->probe_sample <= probed_ ||
      worst_edge() == EdgeState::kOk || health_->probe_action.size() != config_.signals.size())
    return std::nullopt;
  for (std::size_t i = 0; i < config_.signals.size(); ++i) {
    const Signal& signal = config_.signals[i];
    const double value = health_->probe_action[i];
    if (value < signal.lower || value > signal.upper) return std::nullopt;
  }
  return vector_of(health_->probe_action);
}

std::string Controller::objection() const {
  const int part = target_.target_part;
  if (!schema_->has_part(part)) {
    return "the body schema has no part " + std::to_string(part) + "; see: ./run status";
  }
  if (part == schema_->root) {
    return "part " + std::to_string(part) + " is the root, which nothing moves";
  }
  if (!chain_to(*schema_, part)) {
    return "part " + std::to_string(part) + " is not connected to the root " +
           std::to_string(schema_->root) + " in body schema version " +
           std::to_string(schema_->version) + "; let the babbler go on learning";
  }
  if (target_.target_kind == pose_target_t::KIND_POSE && !schema_->has_rotation(part)) {
    return "of part " + std::to_string(part) +
           " positions alone are known, no orientation: give a position";
  }
  if (target_.target_kind == pose_target_t::KIND_TAG && !tags_.contains(target_.target_tag)) {
    return "tag " + std::to_string(target_.target_tag) + " is not in target_tags of markers.yaml" +
           (tags_.empty() ? ", which has none" : ": " + listed(tags_, [](const auto& tag) {
                                                   return std::to_string(tag.first);
                                                 }));
  }
  const bool is_placed = target_.target_kind != pose_target_t::KIND_TAG || tag_place_;
  return is_placed ? config_.workspace.objection(position_of(target_)) : "";
}

}  // namespace bodyschema
