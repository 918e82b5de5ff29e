#pragma once

#include <cmath>
#include <deque>
#include <filesystem>
#include <functional>
#include <map>
#include <optional>
#include <set>
#include <utility>

#include "tests/processes/controller/controller_inputs.h"

namespace bodyschema::test {

/// Plays driver, eyes, observer and monitor, and watches that what the controller sends is lawful.
class Bench {
 public:
  explicit Bench(ControllerConfig config = test_config());

  /// Lets the clock run in ticks. Every second driver and monitor repeat themselves, as the
  /// simulator does, whose time stands still at rest.
  void run(double seconds);
  /// Ticks until `holds`, 30 s at most.
  bool run_until(const std::function<bool()>& holds);
  bool run_until_state(std::int8_t state);
  void give(const Target& target);
  void say(const motion_status_t& message);
  void show_schema();
  void show_frame();
  /// The frames of a rest, with the target tags that are in sight.
  void show_tags();
  /// As the simulator does: the time goes on by a second, so that new frames come.
  void put_tag(int id, std::optional<Eigen::Vector3d> p_RM);
  void repeat();
  /// Everything heard, arm at rest at the start.
  void start();
  /// A settled move of somebody; the arm is then at `action`.
  void settle(const std::string& source, std::int64_t epoch, std::int64_t id,
              const std::vector<double>& action, std::int8_t purpose = 0);
  void show_sample();
  void answer_last_move(std::int8_t state, const std::string& reason = "");
  void answer_move(action_command_t command, std::int8_t state, const std::string& reason);
  void stop(bool latched = true);
  /// Somebody pushes the arm by hand, or lets it rest: nobody tells where.
  void push(bool is_moving);
  /// From now on events are `met`.
  void note_events();
  /// Somebody else tells the driver to hold.
  void hold(std::int64_t id);
  /// The driver begins anew: its time goes back.
  void set_back();
  /// The controller is killed and begins anew with what it kept.
  void restart(const std::filesystem::path& file);
  /// Where the schema says that the part is now.
  Eigen::Vector3d part_position() const;
  bool has_why(const std::string& text) const { return status.why.find(text) != std::string::npos; }

  const ControllerConfig config_;
  Controller controller;
  control_status_t status{};
  motion_status_t motion{};
  BodySchema schema = planar();
  std::optional<model_health_t> health;
  bool driver_speaks = true, eyes_open = true, monitor_speaks = true, observer_works = true;
  bool driver_serves = true;
  bool driver_rounds = false;  ///< it counts in floats
  int num_holds_refused = 0;   ///< of the next HOLDs
  std::function<std::string(const action_command_t&)> rejects = [](const auto&) { return ""; };
  std::set<int> hidden;
  Eigen::Vector3d bend_m = Eigen::Vector3d::Zero();
  double turn_rad = 0;  ///< of part 4, too
  double observation_sd_m = 0.001;
  bool is_ambiguous = false;
  int tag = -1;  ///< by which part 4 is seen
  Pose X_CC_moved = Pose::Identity();
  int num_frames = 0;  ///< of a rest that show the target tags; 0: one without tags
  std::map<int, Eigen::Vector3d> p_RM_of_tag;  ///< those in sight
  bool covers_tags = false;                    ///< the part, where it comes to them
  double tag_jitter_m = 0;                     ///< of every second frame
  std::int64_t now = 1000 * kSecond;
  std::int64_t num_samples = 0;
  std::vector<action_command_t> moves;  ///< as served, each once
  int num_holds = 0, num_repeats = 0;
  std::vector<double> arm = {-30, 0.2, 1};
  std::set<std::pair<Phase, Event>> met;  ///< events, and the phases in which they came

 private:
  void take(const Controller::Answer& answer);
  /// All inputs of the present rest were heard, and what moved the arm before has its SAMPLE or
  /// was waited for.
  void expect_is_guarded() const;
  /// Small steps where an edge on the way is not OK.
  void expect_is_slow_in_doubt(const action_command_t& command) const;
  /// On the way no part leaves the workspace or comes into a keep-out box, by more than its origin
  /// moves between two looks.
  void expect_stays_inside(const action_command_t& command);
  /// The driver answers one command a tick.
  void serve();

  /// Whoever falls silent while a target is served, the arm is held within the limit.
  void expect_no_service_in_silence();

  std::deque<action_command_t> commands_;
  // An answered command is answered again.
  std::set<std::int64_t> refused_holds_;
  std::map<std::int64_t, std::int8_t> refused_moves_;
  std::int64_t last_ended_id_ = -1, left_path_id_ = -1;
  std::int8_t last_kind_ = -1;
  Target given_{};
  std::int64_t given_at_ = 0;
  bool driver_was_heard_ = false, schema_was_heard_ = false;
  std::optional<model_health_t> heard_health_;
  std::set<int> tags_seen_;  // in the newest frame
  std::int64_t last_sampled_id_ = -1, settled_at_ = 0;
  std::int64_t driver_since_ = now, monitor_since_ = now, eyes_since_ = now;
  std::int64_t last_sight_utime_ = -1;
};

/// At rest, with tag 40 in sight.
inline Bench bench_with_tag(const Eigen::Vector3d& p_RM, ControllerConfig config = test_config()) {
  Bench bench(std::move(config));
  bench.num_frames = TagTrack::kFrames;
  bench.p_RM_of_tag[40] = p_RM;
  bench.start();
  return bench;
}

}  // namespace bodyschema::test
