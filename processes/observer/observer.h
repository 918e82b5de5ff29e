#pragma once

#include <cstdint>
#include <deque>
#include <filesystem>
#include <map>
#include <optional>
#include <set>
#include <string>
#include <tuple>
#include <vector>

#include "bodyschema/camera_info_t.hpp"
#include "bodyschema/marker_poses_t.hpp"
#include "bodyschema/motion_status_t.hpp"
#include "bodyschema/sample_t.hpp"
#include "common/camera/lens.h"
#include "common/config/rig.h"
#include "processes/observer/part_pose.h"

namespace bodyschema {

struct ObserverConfig {
  int frames_per_sample = 0;
  std::int64_t settle_margin_us = 0;  ///< frames earlier than this after the arm came to rest wait
  std::size_t max_buffered_frames = 0;
  double max_motion_px = 0;  ///< a tag whose corners move more between the frames is not used
  PartPoseOptions part_pose;

  /// Reads observer.yaml. @throws ConfigError.
  static ObserverConfig load(const std::filesystem::path& file);
};

/// Joins each settled action with the frames taken while the arm was at rest: one SAMPLE for every
/// (source, epoch, action_id) of kind MOVE, from the first frames_per_sample frames whose utime
/// lies in the rest interval. Tags become body parts here: one pose a part, over all its visible
/// tags.
///
/// Times of frames and of MOTION_STATUS must come from one clock. Messages may arrive in either
/// order: frames and rest intervals wait for each other in bounded buffers. A repeated frame (same
/// utime) is ignored. A frame 10 s before the newest one means that the camera's clock was set
/// back: earlier frames are forgotten. One 10 s ahead of the driver is dropped. A rest interval
/// ends when a later motion begins, or when the driver reports a new rest; without enough frames by
/// then it never becomes a sample. Nothing is invented: without frames, status or calibration it
/// waits, and activity() says for which. The same messages give the same samples, byte by byte.
class Observer {
 public:
  /// `calibration_id`: of the rig; 0: unknown.
  Observer(const ObserverConfig& config, Markers markers, std::int64_t calibration_id = 0);

  /// Continues after a sample of an earlier run; called for each, in the order of their indices.
  void restore(const sample_t& sample);

  std::optional<sample_t> on_marker_poses(const marker_poses_t& poses);
  std::optional<sample_t> on_motion_status(const motion_status_t& status);
  std::optional<sample_t> on_camera_info(const camera_info_t& info);

  /// A sentence when it has waited for the frames of one action for 5 s, once per action.
  /// `now_us`: the clock.
  std::optional<std::string> on_tick(std::int64_t now_us);

  /// Activity for people.
  std::string activity() const;
  /// No lens, no sample yet, or on_tick() has told of the action that it waits for.
  bool is_waiting() const;
  /// Reason → number of rejected tags, parts and frames since the start.
  const std::map<std::string, std::int64_t>& counters() const { return counters_; }

 private:
  using ActionKey = std::tuple<std::string, std::int64_t, std::int64_t>;  // source, epoch, id

  /// A settled action that waits for its frames.
  struct Rest {
    motion_status_t status;
    std::int64_t end_utime;          ///< frames at or after it are not at rest
    std::int64_t known_until_utime;  ///< newest status that saw this rest
  };

  static ActionKey key_of(const motion_status_t& status);
  void end_rests(const motion_status_t& status);
  std::vector<const marker_poses_t*> frames_of(const Rest& rest) const;
  std::optional<sample_t> make_sample();
  /// A tag of markers.yaml over the frames of a rest: the mean of its corners, with their
  /// covariance; nothing, and counted, if it moved or is outside of the lens model.
  std::optional<std::pair<SeenTag, tag_corners_t>> mean_of(
      int id, const std::vector<const marker_pose_t*>& seen);
  sample_t sample_from(const Rest& rest, const std::vector<const marker_poses_t*>& frames);

  const ObserverConfig config_;
  const Markers markers_;
  const std::int64_t calibration_id_;
  std::optional<Lens> lens_;
  std::map<std::int64_t, marker_poses_t> frames_;  // by utime
  std::deque<Rest> rests_;                         // oldest first
  void remember(ActionKey done);

  std::deque<ActionKey> done_;  ///< the newest: a driver repeats its last action
  std::int64_t next_index_ = 0;
  std::int64_t driver_utime_ = -1;
  std::map<std::string, std::int64_t> counters_;
  std::int64_t num_samples_ = 0;
  int num_parts_ = 0;  // in the newest sample
  std::optional<ActionKey> waited_for_;
  std::int64_t waiting_since_us_ = -1;
  bool has_warned_ = false;
};

}  // namespace bodyschema
