#pragma once

#include <cstdint>
#include <functional>
#include <string>
#include <vector>

#include "bodyschema/action_command_t.hpp"
#include "bodyschema/motion_status_t.hpp"
#include "common/config/rig.h"

namespace bodyschema {

/// The way to a driver under test.
struct DriverLink {
  std::function<void(const action_command_t&)> send;
  /// Waits up to `seconds` for a message; what has come, in order.
  std::function<std::vector<motion_status_t>(double seconds)> receive;
  std::function<double()> now_s;  ///< a clock that never runs backwards
  /// Ends the driver hard and has it started again; what it had sent before is not received any
  /// more. Empty: not possible.
  std::function<void()> restart;
};

struct ConformanceOptions {
  Signals signals;
  double step_share = 0.05;  ///< size of the motions as a share of each signal's range
  double answer_s = 1;       ///< an answer takes no longer
  double motion_s = 60;      ///< a motion takes no longer
  double restart_s = 30;     ///< a restarted driver is heard again within
  std::int64_t epoch = 0;    ///< [us] of the commands; another one each time
};

/// One line of the result.
struct RuleResult {
  enum class Outcome { kOk, kFailed, kSkipped };
  int rule = 0;  ///< number in lcmtypes/DRIVER.md
  std::string name;
  Outcome outcome = Outcome::kOk;
  std::string note;  ///< what was expected and what came, or why it was skipped
};

/// The two places between which the test moves the arm, command units: about where the driver says
/// that it is, or the middle of the ranges where it does not say. @throws std::runtime_error if no
/// driver is heard, it is stopped, or does not rest.
struct ConformancePlan {
  std::vector<double> here, there;
  bool is_from_middle = false;
};
ConformancePlan plan_conformance(const DriverLink& link, const ConformanceOptions& options);

/// Tests every rule of lcmtypes/DRIVER.md, ascending. `progress` hears of each rule before it is
/// tested. @throws std::runtime_error if somebody else moves the arm meanwhile.
std::vector<RuleResult> test_conformance(
    const DriverLink& link, const ConformanceOptions& options, const ConformancePlan& plan,
    const std::function<void(const std::string&)>& progress = nullptr);

}  // namespace bodyschema
