#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "processes/driver_test/conformance.h"

namespace bodyschema {

/// Ends the test of a rule: it is broken.
struct RuleBroken {
  std::string note;
};
/// Ends the test of a rule: it cannot be tested here.
struct RuleSkipped {
  std::string note;
};

const char* name_of_motion_state(std::int8_t state);
/// For notes: state, reason, command and rest; "nothing" of std::nullopt.
std::string text_of(const std::optional<motion_status_t>& status);
bool is_answer(const motion_status_t& status, const action_command_t& command);
/// @throws RuleBroken "expected …, came …" unless `is_so`.
void expect(bool is_so, const std::string& expected, const std::optional<motion_status_t>& came);

/// Asks a driver, remembers all that it says, and waits for what it must say.
class DriverProbe {
 public:
  using Command = action_command_t;
  using Status = motion_status_t;
  using Wanted = std::function<bool(const Status&)>;
  static constexpr char kSource[] = "driver-test";
  static constexpr char kOtherSource[] = "driver-test-2";

  DriverProbe(const DriverLink& link, const ConformanceOptions& options)
      : link_(link), options_(options) {}

  std::size_t num_heard() const { return heard_.size(); }
  const Status& newest() const { return heard_.back(); }
  const std::optional<std::string>& time_ran_backwards() const { return time_ran_backwards_; }

  /// The first status from index `from` on that is `wanted`; waits for it.
  std::optional<Status> await(std::size_t from, double seconds, const Wanted& wanted);
  /// All that comes within `seconds`.
  std::vector<Status> watch(double seconds);
  /// At rest, and `also`. @throws RuleBroken.
  Status await_rest(const Wanted& also = [](const Status&) { return true; });

  Command make(std::int8_t kind, const std::string& source = kSource,
               std::vector<double> action = {});
  Command move(const std::vector<double>& action, const std::string& source = kSource) {
    return make(Command::KIND_MOVE, source, action);
  }
  void send(const Command& command) { link_.send(command); }
  /// Sends and waits for the first answer. @throws RuleBroken.
  Status ask(const Command& command);
  /// Index of the first status after the last ask().
  std::size_t sent_at() const { return sent_at_; }
  /// Waits for the end of a MOVE; what was said of it from index `from` on. @throws RuleBroken.
  std::vector<Status> life(const Command& command, std::size_t from);
  std::vector<Status> life(const Command& command) { return life(command, sent_at_); }
  /// A MOVE that must succeed.
  Status settle(const std::vector<double>& action, const std::string& source = kSource);
  /// Begins a motion and returns while it goes on. @throws RuleSkipped where there is no such
  /// moment.
  Command begin_motion(const std::vector<double>& action);

  /// For `seconds` no status says that the arm left this rest.
  std::vector<Status> expect_unmoved(const Status& rest, double seconds);
  /// `command` is answered by `state` with a reason, and the arm stays at rest.
  void expect_refused(const Command& command, std::int8_t state);

  /// @throws RuleBroken if the driver is not heard again.
  void restart();
  /// Ready for the next rule, whatever the last one left behind. False if the arm will not rest.
  bool recover();

 private:
  void listen(double seconds);

  const DriverLink& link_;
  const ConformanceOptions& options_;
  std::vector<Status> heard_;
  std::int64_t next_id_ = 0, next_other_id_ = 0;
  std::size_t sent_at_ = 0;
  double sent_s_ = 0;
  std::optional<std::string> time_ran_backwards_;
};

}  // namespace bodyschema
