#pragma once

#include <cstdint>
#include <deque>
#include <map>
#include <optional>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "common/bus/channels.h"
#include "common/schema/body_schema.h"
#include "common/schema/retained_samples.h"

namespace bodyschema {

/// Why a process ended, by its log (stderr): what its last line says after "NAME: "; "" where that
/// is no such line, as in a process that runs.
std::string last_words(const std::string& log, const std::string& process);

/// How long what is counted will take, by the last minute of it.
class Pace {
 public:
  void note(double now_s, std::int64_t count);
  /// For `more` of it [s]; std::nullopt before anything can be told.
  std::optional<double> seconds_for(std::int64_t more) const;

 private:
  std::deque<std::pair<double, std::int64_t>> points_;
};

/// The samples that a run is to have: so many, or fewer where the errors are small before.
struct SampleGoal {
  std::int64_t most = 0;
  bool is_exact = false;
};

/// Follows a learning run from outside and sums it up. It alone compares the schema with the
/// simulator's truth. Memory is bounded: it keeps the retained samples, as the learner does.
class RunWatch {
 public:
  void on_sample(const sample_t& sample);
  void on_body_schema(const body_schema_t& schema);
  void on_learned_schema(const body_schema_t& schema);
  void on_model_health(const model_health_t& health);
  void on_sim_state(const sim_state_t& state);
  /// `now_us`: the clock, for diagnosis().
  void on_process_info(const process_info_t& info, std::int64_t now_us);

  /// True when the babbler is done and the monitor has judged the last sample.
  bool is_finished() const;
  /// The same for a replay that gives no further sample: all of them are learned from and judged.
  bool is_caught_up() const;
  std::int64_t num_samples() const { return num_samples_; }
  /// sample_index up to which the newest proposal goes; -1 before the first.
  std::int64_t learned_sample() const { return learned_sample_; }

  /// One line: samples of how many, time that is left, visibility, what is not connected yet, the
  /// held-out error as the camera sees it.
  std::string progress(const std::optional<SampleGoal>& goal = std::nullopt,
                       std::optional<double> remaining_s = std::nullopt) const;
  /// Those of `expected` that have not been heard of for 3 s.
  std::set<std::string> silent(const std::set<std::string>& expected, std::int64_t now_us) const;
  /// Whether all of `expected` are heard and listen: one that is starting has not subscribed yet.
  bool are_listening(const std::set<std::string>& expected, std::int64_t now_us) const;
  /// The newest count of the process's counter; 0 if it did not.
  std::int64_t counter(const std::string& process, const std::string& counter) const;
  /// The activity of every process, and which one is silent.
  std::string diagnosis(const std::set<std::string>& expected, std::int64_t now_us) const;

  const std::optional<BodySchema>& schema() const { return schema_; }
  const std::optional<model_health_t>& health() const { return health_; }
  /// The retained samples, TEST included.
  std::vector<ActionPoseSample> samples() const;
  /// Of the retained TEST samples those from `since` on: with the simulator's noise-free poses
  /// where there is one, else as the camera saw them.
  std::vector<ActionPoseSample> held_out(std::int64_t since = 0) const;
  /// First sample of the body as it is now, as far as the monitor knows; 0: it never changed.
  std::int64_t body_since() const;
  bool has_truth() const { return !truth_.empty(); }
  /// Share of all samples in which each part was seen.
  std::map<int, double> visibility() const;

 private:
  /// The monitor judges at TEST samples; there need not have been one.
  bool is_judged() const;

  struct Truth {
    std::int64_t action_id = 0;
    std::vector<std::pair<int, Pose>> parts;  ///< noise-free poses in the camera's frame
  };
  struct Heard {
    process_info_t info;
    std::int64_t at_us = 0;
  };

  SharedSamples retained_since(std::int64_t first) const;
  /// The truth of a TEST sample; nullptr where it was not heard.
  const Truth* truth_of(const ActionPoseSample& sample) const;
  void forget_truths();

  RetainedSamples samples_;
  std::int64_t num_samples_ = 0;
  std::int64_t first_index_ = 0, last_index_ = -1;
  std::int64_t last_test_index_ = -1;
  std::map<int, std::int64_t> num_seen_;             ///< part → samples that show it
  std::map<std::int64_t, std::int64_t> action_ids_;  ///< of TEST samples, by index
  std::optional<BodySchema> schema_;
  std::int64_t learned_sample_ = -1;
  std::vector<unconnected_part_t> unconnected_;  ///< of the newest proposal
  std::optional<model_health_t> health_;
  std::map<std::int64_t, Truth> truth_;  ///< by the time at which the arm came to rest
  std::size_t most_truths_ = 4000;       ///< then those that nothing needs any more go
  std::map<std::string, Heard> processes_;
};

}  // namespace bodyschema
