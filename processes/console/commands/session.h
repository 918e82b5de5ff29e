#pragma once

#include <cstdint>
#include <functional>
#include <optional>
#include <string>

#include "common/bus/bus.h"
#include "common/schema/body_schema.h"
#include "processes/console/target_follower.h"

namespace bodyschema {

inline constexpr std::int64_t kPatience_us = 5'000'000;  ///< for what is answered at once
/// Nobody waits longer; microseconds of it are far from overflow [s].
inline constexpr double kLongest_s = 1e7;

/// A target outlives the timeout of the command that gave it by this, where that was killed.
inline constexpr double kExpiryAfterTimeout_s = 5;

/// A check of an option; CLI::Range lets "nan" pass.
std::function<std::string(const std::string&)> within(double lowest, double highest);

/// Exit code 1; the result is on stdout.
[[noreturn]] void fail();

/// Of the console, as of now, without a part.
pose_target_t make_target(std::int8_t kind);

/// The newest that was heard of a group.
struct Heard {
  std::optional<BodySchema> schema;
  std::optional<motion_status_t> motion;

  /// Hears what comes on the bus, as long as both live.
  void listen(Bus& bus);
  /// Where the arm rests, once that is known.
  std::optional<Eigen::VectorXd> position() const;
};

/// The bus of a command that somebody must answer: whoever lives there says so once a second.
class Session {
 public:
  explicit Session(const std::string& url);

  /// Turns the bus until `is_done` or Ctrl-C, at most for so long; `on_turn` gets the clock.
  void turn(std::int64_t most_us, const std::function<bool()>& is_done,
            const std::function<void(std::int64_t)>& on_turn = nullptr);

  /// Shows the follower's progress, after `prefix`, until it has come to an end; `on_turn` on every
  /// turn.
  void follow(TargetFollower& follower, const std::function<void(std::int64_t)>& on_turn = nullptr,
              const std::string& prefix = "");

  /// The same of a target that has `timeout_s`. Where it was interrupted or timed out it is
  /// withdrawn. Returns its last status, with why it ended.
  control_status_t follow_to_end(TargetFollower& follower, double timeout_s,
                                 const std::string& prefix = "");

  /// @throws std::runtime_error with what to type once nobody can be there, or no longer.
  void expect_company() const;
  /// Somebody was heard, and not long ago.
  bool is_in_company() const;

  Bus bus;

 private:
  /// Makes the controller drop what `follower` follows no longer; says what became of it.
  std::string withdraw(const TargetFollower& follower);

  const std::string url_;
  const std::int64_t start_us_;
  std::int64_t heard_us_ = -1;  ///< anybody, last; the clock
  TargetFollower* follower_ = nullptr;
};

/// How a target ended, before the controller's own words, which begin with "reached".
const char* ending(TargetFollower::End end, const control_status_t& status);

}  // namespace bodyschema
