#include "processes/observer/observer.h"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <limits>
#include <stdexcept>

#include "bodyschema/action_command_t.hpp"
#include "common/bus/convert.h"
#include "common/config/yaml.h"
#include "common/geometry/angle.h"

namespace bodyschema {
namespace {

constexpr std::int64_t kNotEnded = std::numeric_limits<std::int64_t>::max();
constexpr std::size_t kMaxRests = 16;
/// Actions that are known to have their sample; MOTION_STATUS repeats the last one alone.
constexpr std::size_t kMaxDone = 64;
/// Frames and the driver's statuses of one clock are never so far apart.
constexpr std::int64_t kMaxApartUs = 10'000'000;

std::string name_of(const motion_status_t& status) {
  return "action " + std::to_string(status.action_id) + " of " + status.source;
}

}  // namespace

ObserverConfig ObserverConfig::load(const std::filesystem::path& file) {
  const Yaml yaml = Yaml::load(file);
  ObserverConfig config;
  config.frames_per_sample = static_cast<int>(yaml.integer("frames_per_sample", 1, 100));
  config.settle_margin_us = std::llround(yaml.number("settle_margin_s", 0, 60) * 1e6);
  config.max_buffered_frames =
      static_cast<std::size_t>(yaml.integer("max_buffered_frames", 1, 10000));
  if (config.max_buffered_frames < static_cast<std::size_t>(config.frames_per_sample)) {
    throw yaml.error("max_buffered_frames", "must not be below frames_per_sample");
  }
  config.max_motion_px = yaml.number("max_motion_px", 0, 100);
  config.part_pose.max_tag_error_px = yaml.number("max_tag_error_px", 1e-3, 100);
  config.part_pose.min_other_rotation_rad = yaml.number("min_other_rotation_deg", 0, 90) * kDegree;
  config.part_pose.max_error_ratio = yaml.number("max_error_ratio", 1, 1e6);
  yaml.finish();
  config.part_pose.calibration = load_noise(file.parent_path()).measurement.tags;
  return config;
}

Observer::Observer(const ObserverConfig& config, Markers markers, std::int64_t calibration_id)
    : config_(config), markers_(std::move(markers)), calibration_id_(calibration_id) {}

void Observer::restore(const sample_t& sample) {
  remember({sample.source, sample.epoch, sample.action_id});
  next_index_ = std::max(next_index_, sample.sample_index + 1);
}

void Observer::remember(ActionKey done) {
  done_.push_back(std::move(done));
  if (done_.size() > kMaxDone) done_.pop_front();
}

Observer::ActionKey Observer::key_of(const motion_status_t& status) {
  return {status.source, status.epoch, status.action_id};
}

std::optional<sample_t> Observer::on_camera_info(const camera_info_t& info) {
  try {
    lens_ = Lens(info);
  } catch (const std::invalid_argument&) {
    ++counters_["refused CAMERA_INFO"];
  }
  return make_sample();
}

std::optional<sample_t> Observer::on_marker_poses(const marker_poses_t& poses) {
  if (driver_utime_ >= 0 && poses.utime - driver_utime_ > kMaxApartUs) {
    ++counters_["frame far ahead of the driver"];
    return std::nullopt;
  }
  if (!frames_.empty() && frames_.rbegin()->first - poses.utime > kMaxApartUs) {
    // Otherwise each new frame would be the oldest and the first to leave the buffer.
    frames_.clear();
    ++counters_["camera time ran backwards"];
  }
  if (!frames_.try_emplace(poses.utime, poses).second) {
    ++counters_["frame seen before"];
    return std::nullopt;
  }
  auto sample = make_sample();
  if (frames_.size() > config_.max_buffered_frames) frames_.erase(frames_.begin());
  return sample;
}

void Observer::end_rests(const motion_status_t& status) {
  for (Rest& rest : rests_) {
    if (rest.end_utime != kNotEnded) continue;
    if (status.rest_since_utime == rest.status.rest_since_utime) {
      rest.known_until_utime = std::max(rest.known_until_utime, status.utime);
    } else if (status.rest_since_utime < 0) {
      rest.end_utime = status.utime;  // the motion has begun by then
    } else {
      // The arm moved in between without a status.
      rest.end_utime = rest.known_until_utime;
    }
  }
}

std::optional<sample_t> Observer::on_motion_status(const motion_status_t& status) {
  if (status.utime < driver_utime_) {
    // The driver began anew: frames of its earlier life may have times that come again.
    frames_.clear();
    rests_.clear();
    ++counters_["driver time ran backwards"];
  }
  driver_utime_ = status.utime;
  const auto ahead = frames_.upper_bound(driver_utime_ + kMaxApartUs);
  if (ahead != frames_.end()) {
    counters_["frame far ahead of the driver"] += std::distance(ahead, frames_.end());
    frames_.erase(ahead, frames_.end());
  }
  end_rests(status);
  const bool is_settled_move = status.state == motion_status_t::STATE_SETTLED &&
                               status.kind == action_command_t::KIND_MOVE &&
                               status.rest_since_utime >= 0 && !status.commanded.empty();
  if (is_settled_move && std::find(done_.begin(), done_.end(), key_of(status)) == done_.end()) {
    const auto same = std::find_if(rests_.begin(), rests_.end(), [&](const Rest& rest) {
      return key_of(rest.status) == key_of(status);
    });
    if (same == rests_.end()) {
      rests_.push_back({status, kNotEnded, status.utime});
    } else if (status.rest_since_utime > same->status.rest_since_utime) {
      // Disturbed before it was seen: the arm rests anew at the same action.
      *same = {status, kNotEnded, status.utime};
    }
    if (rests_.size() > kMaxRests) {
      rests_.pop_front();
      ++counters_["action never seen"];
    }
  }
  return make_sample();
}

std::vector<const marker_poses_t*> Observer::frames_of(const Rest& rest) const {
  std::vector<const marker_poses_t*> frames;
  const auto n = static_cast<std::size_t>(config_.frames_per_sample);
  auto frame = frames_.lower_bound(rest.status.rest_since_utime + config_.settle_margin_us);
  for (; frame != frames_.end() && frame->first < rest.end_utime && frames.size() < n; ++frame) {
    frames.push_back(&frame->second);
  }
  return frames;
}

std::optional<sample_t> Observer::make_sample() {
  if (!lens_) return std::nullopt;
  // Every message completes one rest at most, so one answer is enough.
  for (auto rest = rests_.begin(); rest != rests_.end(); ++rest) {
    const auto frames = frames_of(*rest);
    if (frames.size() < static_cast<std::size_t>(config_.frames_per_sample)) continue;
    const Rest complete = *rest;
    // Earlier rests were preempted and get no more frames.
    counters_["action never seen"] += rest - rests_.begin();
    rests_.erase(rests_.begin(), rest + 1);
    remember(key_of(complete.status));
    return sample_from(complete, frames);
  }
  return std::nullopt;
}

namespace {

part_observation_t observation_of(int part, const PartPose& pose,
                                  const std::map<int, tag_corners_t>& corners_of_tag,
                                  std::int32_t num_frames) {
  part_observation_t message{};
  message.part_id = part;
  message.X_CB = to_message(pose.X_CB);
  message.has_rotation = 1;
  to_message(pose.covariance, message.covariance);
  message.has_other = pose.X_CB_other ? 1 : 0;
  message.X_CB_other = to_message(pose.X_CB_other.value_or(pose.X_CB));
  message.error_ratio = pose.error_ratio;
  message.num_frames = num_frames;
  std::vector<tag_corners_t> corners;
  for (const int id : pose.tags) corners.push_back(corners_of_tag.at(id));
  set_array(message.num_tags, message.tags, std::move(corners));
  return message;
}

}  // namespace

std::optional<std::pair<SeenTag, tag_corners_t>> Observer::mean_of(
    int id, const std::vector<const marker_pose_t*>& seen) {
  tag_corners_t mean{};
  mean.tag_id = id;
  Matrix8d covariance_px2 = Matrix8d::Zero();
  double motion_px = 0;
  for (const marker_pose_t* marker : seen) {
    // Not divided by their number: a corner's error is mostly the same in all frames.
    covariance_px2 += from_message(marker->corner_covariance) / static_cast<double>(seen.size());
    for (int c = 0; c < 4; ++c) {
      for (int axis = 0; axis < 2; ++axis) {
        mean.mean_corner_px[c][axis] +=
            marker->corner_px[c][axis] / static_cast<double>(seen.size());
      }
      motion_px =
          std::max(motion_px, std::hypot(marker->corner_px[c][0] - seen[0]->corner_px[c][0],
                                         marker->corner_px[c][1] - seen[0]->corner_px[c][1]));
    }
  }
  if (motion_px > config_.max_motion_px) {
    ++counters_["tag moved between frames"];
    return std::nullopt;
  }
  const TagPlacement& placement = *markers_.find(id);
  SeenTag tag{id, placement.size_m, placement.X_BM.value_or(Pose::Identity()),
              {}, covariance_px2,   {}};
  for (const auto& corner : mean.mean_corner_px) {
    if (auto point = lens_->straighten({corner[0], corner[1]})) {
      point->sigma_px = sigma_px(covariance_px2);
      tag.corners.push_back(*point);
    }
  }
  if (tag.corners.size() < 4) {
    ++counters_["tag outside of the lens model"];
    return std::nullopt;
  }
  for (int h = 0; h < seen[0]->num_hypotheses; ++h) {
    tag.X_CM.push_back(from_message(seen[0]->X_CM[h]));
  }
  to_message(covariance_px2, mean.corner_covariance);
  return std::pair{std::move(tag), mean};
}

sample_t Observer::sample_from(const Rest& rest, const std::vector<const marker_poses_t*>& frames) {
  // The same tag in all frames.
  std::map<int, std::vector<const marker_pose_t*>> sightings;
  std::map<int, std::set<const marker_poses_t*>> frames_of_part;
  for (const marker_poses_t* frame : frames) {
    for (const marker_pose_t& marker : frame->markers) {
      if (markers_.is_target(marker.marker_id)) continue;  // the controller's
      const TagPlacement* tag = markers_.find(marker.marker_id);
      if (!tag) {
        ++counters_["tag not in markers.yaml"];
        continue;
      }
      sightings[marker.marker_id].push_back(&marker);
      frames_of_part[tag->part].insert(frame);
    }
  }
  std::map<int, std::vector<SeenTag>> tags_of_part;
  std::map<int, tag_corners_t> corners_of_tag;
  for (const auto& [id, seen] : sightings) {
    auto mean = mean_of(id, seen);
    if (!mean) continue;
    tags_of_part[markers_.find(id)->part].push_back(std::move(mean->first));
    corners_of_tag[id] = mean->second;
  }

  std::vector<part_observation_t> parts, contradictions;
  for (auto& [part, tags] : tags_of_part) {
    const PartPoses poses = solve_part_pose(std::move(tags), config_.part_pose);
    const auto num_frames = static_cast<std::int32_t>(frames_of_part[part].size());
    if (poses.agreed)
      parts.push_back(observation_of(part, *poses.agreed, corners_of_tag, num_frames));
    for (const PartPose& pose : poses.contradictions)
      contradictions.push_back(observation_of(part, pose, corners_of_tag, num_frames));
    counters_["tag disagrees with its part"] += std::ssize(poses.contradictions);
    if (!poses.agreed && poses.contradictions.empty()) ++counters_["part without a pose"];
  }

  const motion_status_t& status = rest.status;
  sample_t sample{};
  sample.utime = frames.back()->utime;
  sample.sample_index = next_index_++;
  sample.calibration_id = calibration_id_;
  sample.source = status.source;
  sample.epoch = status.epoch;
  sample.action_id = status.action_id;
  sample.purpose = status.purpose;
  sample.rest_begin_utime = status.rest_since_utime;
  sample.rest_end_utime = sample.utime;
  set_array(sample.num_signals, sample.action, status.commanded);
  num_parts_ = static_cast<int>(parts.size());
  set_array(sample.num_parts, sample.parts, std::move(parts));
  set_array(sample.num_contradictions, sample.contradictions, std::move(contradictions));
  ++num_samples_;
  return sample;
}

std::optional<std::string> Observer::on_tick(std::int64_t now_us) {
  constexpr std::int64_t kPatience_us = 5'000'000;
  const auto key = rests_.empty() ? std::nullopt : std::optional(key_of(rests_.back().status));
  if (key != waited_for_) {
    waited_for_ = key;
    waiting_since_us_ = now_us;
    has_warned_ = false;
  }
  if (!key || has_warned_ || now_us - waiting_since_us_ < kPatience_us) return std::nullopt;
  has_warned_ = true;
  return activity();
}

bool Observer::is_waiting() const {
  const bool is_late =
      has_warned_ && !rests_.empty() && key_of(rests_.back().status) == waited_for_;
  return !lens_ || num_samples_ == 0 || is_late;
}

std::string Observer::activity() const {
  if (!lens_) return "waits for CAMERA_INFO";
  if (!rests_.empty()) {
    const Rest& rest = rests_.back();
    const auto missing = config_.frames_per_sample - static_cast<int>(frames_of(rest).size());
    std::string newest = "; no MARKER_POSES at all";
    if (!frames_.empty()) {
      const std::int64_t after_us = frames_.rbegin()->first - rest.status.rest_since_utime;
      newest = "; newest MARKER_POSES " + std::to_string(std::abs(after_us) / 1000) + " ms " +
               (after_us < 0 ? "before" : "after") + " it came to rest";
    }
    return "waits for " + std::to_string(missing) + " of " +
           std::to_string(config_.frames_per_sample) + " frames of " + name_of(rest.status) +
           newest;
  }
  if (num_samples_ == 0) return "waits for a settled action";
  return "sample " + std::to_string(next_index_ - 1) + ": " + std::to_string(num_parts_) +
         " parts seen";
}

}  // namespace bodyschema
