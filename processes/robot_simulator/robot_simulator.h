#pragma once

#include <cstdint>
#include <deque>
#include <filesystem>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "bodyschema/action_command_t.hpp"
#include "bodyschema/motion_status_t.hpp"
#include "bodyschema/sim_state_t.hpp"
#include "common/scene/scene.h"

namespace bodyschema {

/// robot_simulator.yaml.
struct RobotSimulatorConfig {
  std::filesystem::path rig_folder;
  double speed_share = 1;    ///< of the joints' max_speed, for the servo set points
  double settled_speed = 0;  ///< [rad/s], prismatic [m/s]: slower is at rest …
  double settled_for_s = 0;  ///< … if it lasts this long
  double settle_timeout_s = 0;
  std::int64_t repeat_us = 1'000'000;  ///< of MOTION_STATUS and SIM_STATE
  /// Parts whose plates are invisible.
  std::set<int> hidden_parts;
  std::int64_t seed = 1;  ///< of the image noise; goes into SIM_STATE

  /// @throws ConfigError.
  static RobotSimulatorConfig load(const std::filesystem::path& file);
};

/// The stand-in for a robot: physics with position servos, in lock step. A command that is accepted
/// is simulated at once until the arm rests, so between two calls the arm is always at rest; time
/// is simulated time, from 1 000 000 µs on, and stands still between commands. A motion is tried on
/// a copy first: one that would touch what it must not is rejected and changes nothing.
///
/// Before the first command it is idle at the start pose; when commands stop it stays where it is.
/// The same seed and the same commands give the same answers, bit by bit.
class RobotSimulator {
 public:
  /// What a command leads to, in the order in which it is to be sent.
  struct Answer {
    std::vector<motion_status_t> statuses;
    std::optional<sim_state_t> state;  ///< only where the arm moved
  };

  /// @throws ConfigError, std::invalid_argument (a hidden part that the rig has not).
  explicit RobotSimulator(RobotSimulatorConfig config);

  /// Answers every command: MOVE with ACCEPTED, MOVING, SETTLED, or REJECTED (with the reason), or
  /// EXPIRED; HOLD with HOLDING; STOP with STOPPED, and from then on every MOVE is rejected until
  /// RESUME, which is answered with IDLE. A command that was answered before (source, epoch and
  /// action id) gets its last answer again and moves nothing.
  Answer on_command(const action_command_t& command);

  /// Status and state once each repeat_s, by the caller's clock [µs].
  Answer on_tick(std::int64_t now_us);

  /// The answer to the last command.
  const motion_status_t& status() const { return status_; }
  const sim_state_t& state() const { return state_; }
  const Scene& scene() const { return scene_; }
  /// True positions of the joints [rad or m]; for tests.
  Eigen::VectorXd joint_positions() const { return scene_.joint_positions(*data_); }

  /// Everything that a restart needs: pose, time, seed, the last answer. Numbers are exact.
  void save(const std::filesystem::path& file) const;
  /// Continues from a saved file; the seed becomes the saved one. @throws ConfigError if it is not
  /// of this rig.
  void restore(const std::filesystem::path& file);

 private:
  struct Served {
    std::string source;
    std::int64_t epoch;
    std::int64_t action_id;
    motion_status_t status;
  };

  std::string refusal(const action_command_t& command) const;
  /// Simulates on `trial` until rest; a reason if it must not be. `trial` is then worthless.
  std::optional<std::string> move(mjData& trial, const Eigen::VectorXd& target) const;
  motion_status_t answer_to(const action_command_t& command, std::int8_t state,
                            const std::string& reason) const;
  void finish(const motion_status_t& status);
  void update_state(std::int64_t action_id);

  RobotSimulatorConfig config_;
  Scene scene_;
  MjDataPtr data_;   // at rest
  MjDataPtr trial_;  // scratch
  motion_status_t status_{};
  sim_state_t state_{};
  std::int64_t rest_since_utime_ = 0;
  bool stop_latched_ = false;
  std::deque<Served> served_;  // the newest, for commands that are sent again
  std::int64_t last_repeat_us_ = 0;
};

}  // namespace bodyschema
