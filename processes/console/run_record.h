#pragma once

#include <cstdint>
#include <filesystem>
#include <map>
#include <optional>
#include <string>
#include <tuple>
#include <vector>

#include "common/bus/event_log.h"
#include "processes/console/run_watch.h"
#include "processes/console/thinned_map.h"

namespace bodyschema {

/// The contents of a run's logs, kept so that it can be told at any time. Memory is bounded: of
/// images only their places are kept, long series are thinned.
class RunRecord {
 public:
  /// One event of any log of the run, in any order of files; what cannot be decoded or is of
  /// another channel is passed over. `file`, `byte`: where it stands.
  void on_event(const LogEvent& event, const std::filesystem::path& file, std::int64_t byte);

  struct Load {
    double at_s = 0;  ///< since the first event
    double cpu_percent = 0;
    double memory_mb = 0;
  };
  struct Process {
    process_info_t newest;
    std::vector<Load> load;
  };
  struct Place {
    std::filesystem::path file;
    std::int64_t byte = 0;
  };
  /// Durations between messages by the stamps of a logger on the same machine.
  struct Latency {
    std::string name;
    std::vector<double> seconds;
  };
  struct FaultChange {
    double at_s = 0;
    std::int64_t utime = 0;  ///< samples from then on show it
    std::int64_t action_id = 0;
    std::vector<std::string> faults;  ///< what was broken from then on
  };

  /// Samples, newest body schema, truth.
  const RunWatch& watch() const { return watch_; }
  /// The newest proposal of the learner.
  const std::optional<BodySchema>& learned() const { return learned_; }
  /// Versions of the body schema, ascending: every one, or of many an even choice with the first
  /// and the last of each body.
  const std::map<std::int64_t, BodySchema>& versions() const { return versions_; }
  std::int64_t num_versions() const { return num_versions_; }
  const std::optional<model_health_t>& health() const { return health_; }
  /// Decisions of the monitor, in order; of acceptances in a row the newest.
  std::vector<health_event_t> events() const;
  /// Ordered by name, host, pid.
  std::vector<Process> processes() const;
  const std::vector<FaultChange>& faults() const { return faults_; }
  std::vector<Latency> latencies() const;
  /// The time at which the run began and how long it was recorded; nullopt without a logger's log.
  std::optional<std::int64_t> begin_utime() const { return begin_us_; }
  double duration_s() const;
  /// Whether anything was read that a report can tell of.
  bool is_empty() const { return watch_.num_samples() == 0 && !watch_.schema() && tracks_.empty(); }

  /// Markers of frames, the most first, and where their images stand in a log.
  struct Picture {
    marker_poses_t markers;
    Place image;
  };
  const std::vector<Picture>& pictures() const { return pictures_; }
  const std::optional<camera_info_t>& camera_info() const { return camera_info_; }

 private:
  using ActionKey = std::tuple<std::string, std::int64_t, std::int64_t>;
  /// Event times [us].
  struct Action {
    ActionKey key;
    std::int64_t sent = 0;
    std::optional<std::int64_t> answered = {}, settled = {}, sampled = {};
  };

  void on_faults(const sim_state_t& state, std::int64_t received_us);
  void on_version(const body_schema_t& schema);
  void on_health_event(const health_event_t& event);
  static std::int64_t hash_of(const ActionKey& key);
  Action* action_of(const ActionKey& key);
  void on_process_info(const process_info_t& info, std::int64_t received_us);
  void on_image(std::int64_t utime, const Place& place);
  void on_markers(const marker_poses_t& markers);
  double at_s(std::int64_t received_us) const;

  RunWatch watch_;
  std::optional<BodySchema> learned_;
  std::map<std::int64_t, BodySchema> versions_;
  std::int64_t num_versions_ = 0;
  std::optional<model_health_t> health_;
  std::map<std::tuple<std::int64_t, std::int64_t, std::string>, health_event_t> events_;
  struct Track {
    Process process;
    std::int64_t last_utime = 0, last_cpu_us = 0;  ///< of the newest point
    double period_s = 0.9;                         ///< least distance of two points
  };
  std::map<std::tuple<std::string, std::string, std::int32_t>, Track> tracks_;
  std::vector<FaultChange> faults_;
  ThinnedMap<Action> actions_;  ///< by a hash of the key
  ThinnedMap<std::int64_t> image_received_, markers_received_, sample_received_;
  ThinnedMap<Place> image_places_;
  std::vector<Picture> pictures_;
  std::vector<Picture> awaited_;  ///< the same of frames whose image was not read so far
  std::optional<camera_info_t> camera_info_;
  std::optional<std::int64_t> begin_us_;
  std::int64_t end_us_ = 0;
};

/// q-quantile of `values`, 0 ≤ q ≤ 1; they must not be empty.
double quantile(std::vector<double> values, double q);

}  // namespace bodyschema
