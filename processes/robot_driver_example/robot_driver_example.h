#pragma once

#include <cstdint>
#include <deque>
#include <filesystem>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "bodyschema/action_command_t.hpp"
#include "bodyschema/motion_status_t.hpp"
#include "common/config/rig.h"

namespace bodyschema {

/// robot_driver_example.yaml, and signals.yaml beside it.
struct RobotDriverConfig {
  Signals signals;
  std::string device;
  std::int64_t silent_us = 0;
  std::int64_t motion_timeout_us = 0;
  std::int64_t repeat_us = 0;

  /// @throws ConfigError.
  static RobotDriverConfig load(const std::filesystem::path& file);
};

/// A driver that keeps lcmtypes/DRIVER.md (its rules are cited as R1 …), for the robot that
/// imaginary_robot plays. To make it yours, replace the part under "The robot's protocol" and
/// convert command units if your robot has others.
///
/// Before its first report the robot is lost: nothing moves, `rest_since_utime` is −1. A robot that
/// was lost is halted before anything else, and no earlier motion is resumed. When commands stop,
/// the arm ends its motion and stays there: one MOVE is one motion, known to be safe as a whole, so
/// nothing needs watching between two commands.
class RobotDriver {
 public:
  /// The watchdogs use the steady clock, which nobody can set; `utime` uses the system clock, which
  /// stamps the camera's frames. Both [µs].
  struct Now {
    std::int64_t steady_us;
    std::int64_t clock_us;
  };
  /// Order of the work: lines to the robot, then save(), then statuses to the bus. A HALT must not
  /// wait for a disk, nor for the network.
  struct Answer {
    std::vector<std::string> lines;
    std::vector<motion_status_t> statuses;
    bool must_save = false;
  };
  /// Keeps the newest status over a restart; returns "" or the problem. The `utime` of the record
  /// is a time that this driver has not reached yet: the next one begins there, or later.
  using Save = std::function<std::string(const motion_status_t&)>;

  /// `record`: the last one that Save kept.
  RobotDriver(RobotDriverConfig config, std::optional<motion_status_t> record, Save save, Now now);

  Answer on_command(const action_command_t& command, Now now);
  /// The port was opened.
  Answer on_connect(Now now);
  /// A line from the robot.
  Answer on_line(const std::string& line, Now now);
  /// The port is gone.
  Answer on_disconnect(const std::string& problem, Now now);
  /// Every 0.1 s: asks the robot for its position, detects silence, repeats the status.
  Answer on_tick(Now now);
  /// The end of the process: halts the arm.
  Answer on_end(Now now);
  /// Keeps the record if `answer` wants that. If a STOP could not be kept the answer says so, and
  /// the ticks try again.
  void save(Answer& answer);

  const motion_status_t& status() const { return status_; }
  bool is_at_rest() const { return rest_since_utime_ >= 0; }
  bool is_lost() const { return is_lost_; }
  std::int64_t num_strange_lines() const { return num_strange_lines_; }

 private:
  struct Report {
    std::int64_t order;
    bool is_moving;
    std::vector<double> position;
  };

  std::optional<Report> parse(const std::string& line) const;
  std::string go(const std::vector<double>& action);
  std::string halt();

  /// Of a command that was answered already.
  std::optional<motion_status_t> answer_again(const action_command_t& command) const;
  std::string refusal(const action_command_t& command) const;
  motion_status_t make_status(const action_command_t& command, std::int8_t state,
                              const std::string& reason) const;
  void conclude(const action_command_t& command, std::int8_t state, const std::string& reason,
                Answer& answer);
  /// The motion in hand, if there is one, ends here.
  void interrupt(const std::string& reason, Answer& answer);
  void lose(const std::string& reason, Answer& answer);
  void refresh_status(Answer& answer);
  void advance_time(Now now);
  std::string save_record(motion_status_t status);

  const RobotDriverConfig config_;
  const Save save_;
  std::int64_t utime_ = 0;   // driver's time [µs]
  std::int64_t start_ = 0;   // driver's time of the start
  std::int64_t steady_ = 0;  // what is called …_at_ and …_since_ below is of this clock [µs]

  // The robot.
  bool is_open_ = false;  // its port
  bool is_lost_ = true;
  std::int64_t order_ = 0;     // N of the newest order
  std::string unheard_halt_;   // the newest order, if it is a HALT without an echo; or ""
  std::int64_t heard_at_ = 0;  // newest report
  std::int64_t rest_since_utime_ = -1;
  std::vector<double> position_;  // as reported, command units
  std::int64_t num_strange_lines_ = 0;

  // The commands.
  std::optional<action_command_t> motion_;  // under way
  std::int64_t motion_since_ = 0;
  bool is_stopped_ = false;
  motion_status_t status_{};            // what is repeated
  std::deque<motion_status_t> served_;  // the newest answers
  std::int64_t said_at_ = 0;

  // The record.
  std::int64_t record_utime_ = 0;  // its bound on driver's time
  std::int64_t tried_at_ = 0;
  std::string record_problem_;  // why what is on disk is old; ""
  bool is_stop_recorded_ = false;
};

}  // namespace bodyschema
