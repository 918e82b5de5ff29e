#pragma once

#include <cstdint>
#include <string_view>

namespace bodyschema {

/// What class Controller does between two events. controller_states.cpp says of each what it means,
/// and which CONTROL_STATUS it is; states.md shows it.
enum class Phase : std::uint8_t {
  kIdle,
  kListening,
  kTaking,
  kDeciding,
  kTagAwaited,
  kMoving,
  kObserving,
  kMovingPreempted,
  kObservingPreempted,
  kKeeping,
  kLent,
  kRefused,
  kRefusedHalted,
  kHoldDue,
  kHoldSent,
  kHeld,
  kReleased,
};
inline constexpr int kNumPhases = static_cast<int>(Phase::kReleased) + 1;

enum class Event : std::uint8_t {
  // Asked for, by POSE_TARGET or by the kept state.
  kTarget,
  kTargetWhileHalted,
  kHoldAsked,
  kReleaseAsked,
  kRestored,
  // Of the driver.
  kDriverHeard,
  kStopped,
  kResumed,
  kDriverRestarted,
  kForeignHold,
  kForeignMove,
  // Its answers to the newest command.
  kUnderWay,
  kSettled,
  kRejected,
  kExpired,
  kEnded,
  kHoldAnswered,
  // Seen.
  kSampleCame,
  kNewSample,
  // Found out when the next action is decided.
  kInputMissing,
  kUnservable,
  kBroken,
  kServable,
  kArmFree,
  kPositionUnknown,
  kTagUnseen,
  kTagLost,
  kTagSeen,
  kStep,
  kReached,
  kUnreachable,
  kFailed,
  // Of the clock.
  kInputSilent,
  kUnanswered,
  kEndless,
  kNoSample,
  kTargetExpired,
  kGivenUp,
  kNotHeard,
  kLentInVain,
  kKept,
};
inline constexpr int kNumEvents = static_cast<int>(Event::kKept) + 1;

/// What is sent to the driver on a transition.
enum class Sends : std::uint8_t {
  kNothing,
  kMove,   ///< the action that was decided
  kHold,   ///< a new HOLD
  kAgain,  ///< the newest command, with its id
};

struct Reaction {
  enum class Kind : std::uint8_t {
    kImpossible,  ///< the event cannot come in this phase: a broken invariant
    kIgnored,     ///< does not concern it
    kStays,       ///< the phase goes on, but what it waits for is told anew
    kGoes,        ///< to `next`, which may be the same: its time begins again
  };
  Kind kind = Kind::kImpossible;
  Phase next = Phase::kIdle;
  Sends sends = Sends::kNothing;
  bool operator==(const Reaction&) const = default;
};

/// The transition table: what each event does in each phase.
const Reaction& reaction(Phase phase, Event event);

struct PhaseInfo {
  Phase phase;
  std::string_view name;
  std::int8_t control_state;  ///< CONTROL_STATUS.control_state
  std::string_view meaning;
};
const PhaseInfo& info(Phase phase);

bool owns_arm(Phase phase);
/// A target is served or kept.
bool is_active(Phase phase);
/// It was not reached yet.
bool is_open(Phase phase);
/// What the target needs next is decided as soon as the inputs allow it.
bool decides(Phase phase);

struct EventInfo {
  Event event;
  std::string_view name;
  std::string_view meaning;
};
const EventInfo& info(Event event);

}  // namespace bodyschema
