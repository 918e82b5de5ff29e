#pragma once

#include <cstdint>
#include <deque>
#include <filesystem>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "bodyschema/action_command_t.hpp"
#include "bodyschema/fault_command_t.hpp"
#include "bodyschema/motion_status_t.hpp"
#include "bodyschema/sim_state_t.hpp"
#include "common/config/yaml.h"
#include "common/scene/faults.h"
#include "common/scene/scene.h"

namespace bodyschema {

/// robot_simulator.yaml.
struct RobotSimulatorConfig {
  std::filesystem::path rig_folder;
  double speed_share = 1;  ///< of the joints' max_speed, for the servo set points
  // At rest is who is slower than this, each joint by its own unit, all together …
  double settled_speed_rad_per_s = 0;  ///< of a revolute joint that moves alone
  double settled_speed_m_per_s = 0;    ///< of a prismatic joint that moves alone
  double settled_for_s = 0;            ///< … if it lasts this long
  double settle_timeout_s = 0;
  std::int64_t repeat_us = 1'000'000;  ///< of MOTION_STATUS and SIM_STATE
  /// Parts whose plates are invisible.
  std::set<int> hidden_parts;
  std::int64_t seed = 1;  ///< of image noise and calibration errors; goes into SIM_STATE
  /// Without robot.yaml's calibration errors.
  bool is_ideal = false;

  /// @throws ConfigError.
  static RobotSimulatorConfig load(const std::filesystem::path& file);
};

/// The stand-in for a robot: physics with position servos, in lock step. A command that is accepted
/// is simulated at once until the arm rests, so between two calls the arm is always at rest; time
/// is simulated time, from 1 000 000 µs on, and stands still between commands. A motion is tried on
/// a copy first: one with a forbidden contact is rejected and changes nothing.
///
/// Before the first command it is idle at the start pose; when commands stop it stays where it is.
/// The same seed, the same commands and faults give the same answers, bit by bit.
///
/// The visible pose (SIM_STATE's X_WG) has the joints' backlash, which the direction of approach
/// decides; the true pose of a part (X_WB) is in the middle of it. Both have droop.
class RobotSimulator {
 public:
  /// The messages after a command, in the order in which they are to be sent.
  struct Answer {
    std::vector<motion_status_t> statuses;
    std::optional<sim_state_t> state;  ///< only where the arm moved
  };

  /// @throws ConfigError, std::invalid_argument (a hidden part that the rig has not).
  explicit RobotSimulator(RobotSimulatorConfig config);

  /// Answers every command as lcmtypes/DRIVER.md says: MOVE with ACCEPTED, MOVING, SETTLED, or
  /// REJECTED, or EXPIRED; HOLD with HOLDING; STOP with STOPPED, and from then on every MOVE is
  /// rejected until RESUME, which is answered with IDLE. A command that was answered before
  /// (source, epoch and action id) moves nothing: it gets its answer again, STOPPED if it had
  /// settled and the arm has moved on since.
  Answer on_command(const action_command_t& command);

  /// Breaks the arm, or says in the state's fault_answer why not; each (sender, epoch, fault_id)
  /// once. It takes a second of simulated time, so that frames before and after lie in two
  /// intervals of rest.
  Answer on_fault(const fault_command_t& command);

  /// Status and state once each repeat_s, by the caller's clock [µs].
  Answer on_tick(std::int64_t now_us);

  /// The repeated status: that of the newest command that was not refused.
  const motion_status_t& status() const { return status_; }
  const sim_state_t& state() const { return state_; }
  /// The arm as it is now; another one after a fault.
  const Scene& scene() const { return body_.scene; }
  /// True positions of the joints in the middle of their backlash [rad or m]; for tests.
  Eigen::VectorXd joint_positions() const { return body_.scene.joint_positions(*body_.data); }

  /// Everything that a restart needs: pose, play, time, seed, whether it is ideal, faults, the
  /// newest answers. Numbers are exact. @throws std::runtime_error if the file cannot be written.
  void save(const std::filesystem::path& file) const;
  /// Continues from a saved file; seed and is_ideal become the saved ones. @throws ConfigError,
  /// which says what to do, if it is damaged or not of this rig.
  void restore(const std::filesystem::path& file);

 private:
  /// An arm, whole or broken, and its physics.
  struct Body {
    explicit Body(SceneDescription description);
    Scene scene;
    MjDataPtr data;   // at rest, each joint in the middle of its backlash
    MjDataPtr trial;  // scratch
  };
  struct FaultKey {
    std::string sender;
    std::int64_t epoch;
    std::int64_t fault_id;
    bool operator==(const FaultKey&) const = default;
  };

  std::string refusal(const action_command_t& command) const;
  /// Simulates body.trial until rest; a reason if it must not be. The trial is then worthless.
  std::optional<std::string> move(Body& body, const Eigen::VectorXd& target) const;
  /// Moves the arm as commanded. Why not, or "".
  std::string carry_out(const action_command_t& command, Answer* answer);
  /// The arm with these faults where it stands now, or why it cannot be.
  std::optional<Body> body_with(const std::vector<Fault>& faults, std::string* problem) const;
  motion_status_t answer_to(const action_command_t& command, std::int8_t state,
                            const std::string& reason) const;
  motion_status_t answer_again(const motion_status_t& served) const;
  void remember(const motion_status_t& status);
  /// The joints' far side follows into its play.
  void follow(const Eigen::VectorXd& before);
  void update_state(std::int64_t action_id);
  void restore_from(const Yaml& yaml);

  RobotSimulatorConfig config_;
  SceneDescription as_built_;
  Body body_;
  Eigen::VectorXd play_;    // of each joint's far side, from the middle of its backlash [rad]
  std::vector<double> at_;  // the action that led here, or the start pose
  motion_status_t status_{};
  sim_state_t state_{};
  std::int64_t rest_since_utime_ = 0;
  std::int64_t start_utime_ = 0;  // of this process, driver's time
  bool stop_latched_ = false;
  std::deque<motion_status_t> served_;  // the newest answers, for commands that are sent again
  std::vector<Fault> faults_;
  std::deque<FaultKey> served_faults_;
  std::string fault_answer_;
  std::int64_t last_repeat_us_ = 0;
};

}  // namespace bodyschema
