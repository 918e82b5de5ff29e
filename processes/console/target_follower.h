#pragma once

#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <utility>

#include "bodyschema/action_command_t.hpp"
#include "bodyschema/control_status_t.hpp"
#include "bodyschema/motion_status_t.hpp"
#include "bodyschema/pose_target_t.hpp"
#include "bodyschema/process_info_t.hpp"
#include "common/geometry/angle.h"
#include "processes/console/views/json.h"

namespace bodyschema {

inline constexpr double kSeenNear_m = 0.02, kSeenNear_deg = 5;

/// How near the part must be seen.
struct SeenTolerance {
  double m = kSeenNear_m, rad = kSeenNear_deg * kDegree;
};

/// Repeats one POSE_TARGET until CONTROL_STATUS acknowledges it, and follows it to its end.
class TargetFollower {
 public:
  enum class End {
    kOpen,
    kAsked,    ///< reached; for a hold: held; for a release: released
    kRefused,  ///< refused, held or given up for another target: see why()
    kMissed,   ///< reached by the schema, but seen beyond the tolerance
    kTimedOut,
    kInterrupted,  ///< by the user
  };

  /// `timeout_us`: of the clock, from the first tick.
  TargetFollower(pose_target_t target, std::int64_t timeout_us, SeenTolerance tolerance = {});

  void on_control_status(const control_status_t& status);
  /// Remembered for diagnosis().
  void on_process_info(const process_info_t& info);
  void on_motion_status(const motion_status_t& motion);
  /// The target when it is due: at 1 Hz until it is acknowledged. `now_us`: the clock.
  std::optional<pose_target_t> on_tick(std::int64_t now_us);
  /// Ends what is open.
  void interrupt();
  /// Makes the controller drop the target: a hold, or a release where the arm is the babbler's. It
  /// is newer than this target only, so that another sender's stays.
  pose_target_t withdrawal() const;

  End end() const { return end_; }
  bool is_acknowledged() const { return is_acknowledged_; }
  /// The newest status that answers this target; before that all fields are as in "unknown".
  const control_status_t& status() const { return status_; }
  /// One line for people.
  std::string progress() const;
  /// After a timeout: which process is silent, or what each one says.
  std::string diagnosis() const;

 private:
  const pose_target_t target_;
  const std::int64_t timeout_us_;
  const SeenTolerance tolerance_;
  std::int64_t now_us_ = -1;
  std::int64_t started_us_ = -1;
  std::int64_t sent_us_ = -1;
  bool is_acknowledged_ = false;
  bool had_arm_ = false;  ///< the controller, for this target
  End end_ = End::kOpen;
  control_status_t status_{};
  bool has_controller_ = false;
  std::map<std::string, std::int64_t> heard_at_us_;  ///< by name, when last
};

/// Repeats STOP or RESUME until MOTION_STATUS says that it is so.
class LatchFollower {
 public:
  /// `kind`: action_command_t::KIND_STOP or KIND_RESUME. `epoch`: start of the sender [us].
  LatchFollower(std::int8_t kind, std::int64_t epoch);

  void on_motion_status(const motion_status_t& motion);
  /// The command when it is due: at 5 Hz until done. `now_us`: the clock.
  std::optional<action_command_t> on_tick(std::int64_t now_us);
  bool is_done() const { return is_done_; }
  bool has_heard_driver() const { return has_heard_driver_; }

 private:
  action_command_t command_{};
  std::int64_t sent_us_ = -1;
  bool is_done_ = false;
  bool has_heard_driver_ = false;
};

inline constexpr char kConsole[] = "console";  ///< sender of POSE_TARGET, source of ACTION_COMMAND
inline constexpr std::int64_t kCommandPeriod_us = 200'000;  ///< of what is not answered yet

/// An ACTION_COMMAND of the console without an action: HOLD, STOP or RESUME.
action_command_t make_console_command(std::int8_t kind, std::int64_t epoch, std::int64_t action_id);

/// "2 moves, by the schema 0.1 mm and 0.01° away, as seen 1.2 mm and 0.20°": as far as it is known.
std::string course_text(const control_status_t& status);
/// The output of `target --json`.
Json target_json(const control_status_t& status, TargetFollower::End end);

}  // namespace bodyschema
