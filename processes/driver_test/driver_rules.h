#pragma once

#include <cstdint>
#include <optional>
#include <vector>

#include "processes/driver_test/conformance.h"
#include "processes/driver_test/driver_probe.h"

namespace bodyschema {

class DriverRules;

struct DriverRule {
  int number;  ///< in lcmtypes/DRIVER.md
  const char* name;
  void (DriverRules::*test)();  ///< @throws RuleBroken, RuleSkipped
};

/// The tests of the rules of lcmtypes/DRIVER.md, each for an arm at rest that is not stopped. Some
/// build on what those before have done.
class DriverRules {
 public:
  /// `probe` has heard the driver.
  DriverRules(DriverProbe& probe, const ConformanceOptions& options, const ConformancePlan& plan,
              bool can_restart);

  /// Ascending; rule 3 (time never runs backwards) is watched throughout and none of them.
  static const std::vector<DriverRule>& all();

 private:
  using Command = action_command_t;
  using Status = motion_status_t;

  void every_command_is_answered();
  void a_move_settles();
  void status_is_repeated();
  void the_impossible_is_rejected();
  void one_motion_at_a_time();
  void the_expired_is_refused();
  void no_command_twice();
  void every_source_has_its_ids();
  void hold_at_rest();
  void hold_ends_a_motion();
  void stop_latches();
  void stop_ends_a_motion();
  void resume_clears_the_latch();
  void restart_ends_a_motion();
  void the_past_is_refused();
  void stop_outlives_the_driver();

  /// HOLD or STOP in the middle of a motion from `here_` to `there_`.
  void end_motion(std::int8_t kind);
  void require_restart() const;

  DriverProbe& probe_;
  const std::vector<Signal>& signals_;
  const std::vector<double> here_, there_;
  std::vector<double> ranges_, steps_;  ///< per signal: of the limits, from here_ to there_
  const bool can_restart_;
  const std::int64_t first_utime_;
  std::optional<Command> refused_move_;
};

}  // namespace bodyschema
