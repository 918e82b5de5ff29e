#include "processes/controller/controller_states.h"

#include <array>

#include "bodyschema/control_status_t.hpp"

namespace bodyschema {
namespace {

using S = control_status_t;
using P = Phase;
using E = Event;

constexpr std::array<PhaseInfo, kNumPhases> kPhases{{
    {P::kIdle, "idle", S::CONTROL_IDLE, "no target was served since the start"},
    {P::kListening, "listening", S::CONTROL_WAITING, "an input was not heard yet"},
    {P::kTaking, "taking", S::CONTROL_WAITING, "until the arm rests and is free"},
    {P::kDeciding, "deciding", S::CONTROL_WAITING,
     "the arm is taken; the next action is decided once it rests and all inputs speak"},
    {P::kTagAwaited, "tag awaited", S::CONTROL_WAITING,
     "as deciding, once the target tag is seen in one place"},
    {P::kMoving, "moving", S::CONTROL_MOVING, "a MOVE was sent and has not ended"},
    {P::kObserving, "observing", S::CONTROL_MOVING, "it settled; its SAMPLE is awaited"},
    {P::kMovingPreempted, "moving, preempted", S::CONTROL_MOVING,
     "as moving, but somebody else moved the arm: it is taken anew afterwards"},
    {P::kObservingPreempted, "observing, preempted", S::CONTROL_MOVING, "as observing, then so"},
    {P::kKeeping, "keeping", S::CONTROL_REACHED, "the target is reached and kept"},
    {P::kLent, "lent", S::CONTROL_LENT, "the babbler may probe an edge that is INVALID"},
    {P::kRefused, "refused", S::CONTROL_REFUSED, "the target is over, the arm given back"},
    {P::kRefusedHalted, "refused, halted", S::CONTROL_REFUSED,
     "as refused, because the driver is stopped"},
    {P::kHoldDue, "hold due", S::CONTROL_HOLDING,
     "the target is over; HOLD is sent once the driver was heard"},
    {P::kHoldSent, "hold sent", S::CONTROL_HOLDING, "HOLD is unanswered"},
    {P::kHeld, "held", S::CONTROL_HOLDING, "the target is over, the arm stays held"},
    {P::kReleased, "released", S::CONTROL_RELEASED, "the target is over, as was asked"},
}};

constexpr std::array<EventInfo, kNumEvents> kEvents{{
    {E::kTarget, "target", "a newer POSE_TARGET of a position, a pose or a tag"},
    {E::kTargetWhileHalted, "target while halted",
     "the same while the driver's STOP is latched, or the next step of a path on which the arm "
     "was held"},
    {E::kHoldAsked, "hold asked", "KIND_HOLD: the target is withdrawn"},
    {E::kReleaseAsked, "release asked", "KIND_RELEASE"},
    {E::kRestored, "restored", "a restart; the arm was its own before"},
    {E::kDriverHeard, "driver heard", "MOTION_STATUS was heard since the start"},
    {E::kStopped, "stopped", "STOP is latched"},
    {E::kResumed, "resumed", "no STOP is latched"},
    {E::kDriverRestarted, "driver restarted", "its time or its answers went back"},
    {E::kForeignHold, "foreign hold", "the driver answers somebody else's HOLD"},
    {E::kForeignMove, "foreign move", "the driver answers somebody else's MOVE"},
    {E::kUnderWay, "under way", "the MOVE is accepted or moving"},
    {E::kSettled, "settled", "the MOVE is done"},
    {E::kRejected, "rejected", "the driver does not make the MOVE"},
    {E::kExpired, "expired", "the MOVE came too late to the driver"},
    {E::kEnded, "ended", "the driver stopped or holds in the middle of the MOVE"},
    {E::kHoldAnswered, "hold answered", "the driver serves the HOLD"},
    {E::kSampleCame, "sample came", "the SAMPLE of the MOVE"},
    {E::kNewSample, "new sample", "the SAMPLE of any action"},
    {E::kInputMissing, "input missing", "MOTION_STATUS, BODY_SCHEMA or frames of this rest"},
    {E::kUnservable, "unservable",
     "not by this schema, whatever the arm does; or all MOVEs expire"},
    {E::kBroken, "broken", "an edge on the way is INVALID and max_searches did not mend it"},
    {E::kServable, "servable", "all is heard and nothing objects"},
    {E::kArmFree, "arm free",
     "it rests, its position is known, its last action has its SAMPLE and, of a TEST, its verdict"},
    {E::kPositionUnknown, "position unknown", "nobody tells the action that the arm rests at"},
    {E::kTagUnseen, "tag unseen", "the target tag, which was not aimed at, is not known"},
    {E::kTagLost, "tag lost", "the tag that was aimed at is not seen, or elsewhere"},
    {E::kTagSeen, "tag seen", "in one place"},
    {E::kStep, "step", "the next action is decided"},
    {E::kReached, "reached", "the arm is at the action that was planned"},
    {E::kUnreachable, "unreachable", "no way is left"},
    {E::kFailed, "failed",
     "unservable, position unknown, unreachable or given up, of an arm that is its own since "
     "before the target, or was moved for it"},
    {E::kInputSilent, "input silent", "MOTION_STATUS, MARKER_POSES or BODY_SCHEMA, too long"},
    {E::kUnanswered, "unanswered", "for resend_s"},
    {E::kEndless, "endless", "the MOVE has not ended for rest_timeout_s"},
    {E::kNoSample, "no sample", "for sample_timeout_s"},
    {E::kTargetExpired, "target expired", "not reached within its expiry_s"},
    {E::kGivenUp, "given up", "nothing to send for rest_timeout_s"},
    {E::kNotHeard, "not heard", "an input is missing for longer than it may be silent"},
    {E::kLentInVain, "lent in vain", "no new SAMPLE for lent_timeout_s"},
    {E::kKept, "kept", "for keep_s"},
}};

using PhaseSet = std::uint32_t;
constexpr PhaseSet only(P phase) { return PhaseSet{1} << static_cast<int>(phase); }

// Every phase is in one of six sets.
constexpr PhaseSet kOver =
    only(P::kIdle) | only(P::kRefused) | only(P::kRefusedHalted) | only(P::kReleased);
constexpr PhaseSet kHolds = only(P::kHoldDue) | only(P::kHoldSent) | only(P::kHeld);
constexpr PhaseSet kAsking = only(P::kListening) | only(P::kLent);
constexpr PhaseSet kChoosing = only(P::kTaking) | only(P::kDeciding) | only(P::kTagAwaited);
constexpr PhaseSet kAwaitsAnswer = only(P::kMoving) | only(P::kMovingPreempted);
constexpr PhaseSet kAwaitsSample = only(P::kObserving) | only(P::kObservingPreempted);
constexpr PhaseSet kActing = kAwaitsAnswer | kAwaitsSample;
constexpr PhaseSet kKeeping = only(P::kKeeping);
constexpr PhaseSet kAll = (PhaseSet{1} << kNumPhases) - 1;
static_assert((kOver | kHolds | kAsking | kChoosing | kActing | kKeeping) == kAll);
static_assert(kOver + kHolds + kAsking + kChoosing + kActing + kKeeping == kAll, "disjoint");

constexpr PhaseSet kDecides = kAsking | kChoosing;
constexpr PhaseSet kOpen = kDecides | kActing;
constexpr PhaseSet kActive = kOpen | kKeeping;
constexpr PhaseSet kOwnsArm = kHolds | kChoosing | kActing | kKeeping;

/// What an event does in some phases.
struct Rule {
  E event;
  PhaseSet in;
  Reaction reaction;
};

constexpr Rule to(E event, PhaseSet from, P next, Sends sends = Sends::kNothing) {
  return {event, from, {Reaction::Kind::kGoes, next, sends}};
}
constexpr Rule stay(E event, PhaseSet in) { return {event, in, {Reaction::Kind::kStays}}; }
constexpr Rule ignore(E event, PhaseSet in) { return {event, in, {Reaction::Kind::kIgnored}}; }
constexpr Rule never(E event, PhaseSet in) { return {event, in, {Reaction::Kind::kImpossible}}; }

// For each event all phases, each once.
constexpr Rule kRules[] = {
    to(E::kTarget, (kOver & ~only(P::kRefusedHalted)) | kAsking, P::kListening),
    to(E::kTarget, kHolds | only(P::kTaking), P::kTaking),
    to(E::kTarget, only(P::kDeciding) | only(P::kTagAwaited) | kKeeping, P::kDeciding),
    stay(E::kTarget, kActing),  // the action that is under way ends first
    never(E::kTarget, only(P::kRefusedHalted)),
    to(E::kTargetWhileHalted, kOver, P::kRefusedHalted),
    stay(E::kTargetWhileHalted, kHolds),  // refused, but held
    never(E::kTargetWhileHalted, kActive),
    to(E::kHoldAsked, kAll, P::kHoldDue),
    to(E::kReleaseAsked, kAll, P::kReleased),
    to(E::kRestored, only(P::kIdle), P::kHoldDue),
    never(E::kRestored, kAll & ~only(P::kIdle)),

    to(E::kDriverHeard, only(P::kHoldDue), P::kHoldSent, Sends::kHold),
    ignore(E::kDriverHeard, kAll & ~only(P::kHoldDue)),
    to(E::kStopped, only(P::kListening), P::kRefusedHalted),
    to(E::kStopped, kActive & ~only(P::kListening), P::kHeld),
    ignore(E::kStopped, kOver | kHolds),
    to(E::kResumed, only(P::kRefusedHalted), P::kRefused),
    ignore(E::kResumed, kAll & ~only(P::kRefusedHalted)),
    to(E::kDriverRestarted, kChoosing | kActing | kKeeping, P::kHoldDue),
    ignore(E::kDriverRestarted, kOver | kHolds | kAsking),
    to(E::kForeignHold, kActive, P::kHeld),
    ignore(E::kForeignHold, kOver | kHolds),
    to(E::kForeignMove, kChoosing, P::kTaking),  // what was planned no longer begins here
    to(E::kForeignMove, only(P::kMoving), P::kMovingPreempted),
    to(E::kForeignMove, only(P::kObserving), P::kObservingPreempted),
    ignore(E::kForeignMove, only(P::kMovingPreempted) | only(P::kObservingPreempted)),
    to(E::kForeignMove, kKeeping, P::kHeld),  // nobody drives it back unasked
    ignore(E::kForeignMove, kOver | kHolds | kAsking),

    // Answers are repeated, and may come late.
    to(E::kUnderWay, only(P::kMoving), P::kMoving),
    to(E::kUnderWay, only(P::kMovingPreempted), P::kMovingPreempted),
    ignore(E::kUnderWay, kAll & ~kAwaitsAnswer),
    to(E::kSettled, only(P::kMoving), P::kObserving),
    to(E::kSettled, only(P::kMovingPreempted), P::kObservingPreempted),
    ignore(E::kSettled, kAll & ~kAwaitsAnswer),
    to(E::kRejected, only(P::kMoving), P::kDeciding),
    to(E::kRejected, only(P::kMovingPreempted), P::kTaking),
    ignore(E::kRejected, kAll & ~kAwaitsAnswer),
    to(E::kExpired, only(P::kMoving), P::kDeciding),
    to(E::kExpired, only(P::kMovingPreempted), P::kTaking),
    ignore(E::kExpired, kAll & ~kAwaitsAnswer),
    to(E::kEnded, kAwaitsAnswer, P::kHeld),
    ignore(E::kEnded, kAll & ~kAwaitsAnswer),
    to(E::kHoldAnswered, only(P::kHoldSent), P::kHeld),
    ignore(E::kHoldAnswered, kAll & ~only(P::kHoldSent)),

    to(E::kSampleCame, only(P::kObserving), P::kDeciding),
    to(E::kSampleCame, only(P::kObservingPreempted), P::kTaking),
    ignore(E::kSampleCame, kAll & ~kAwaitsSample),
    to(E::kNewSample, only(P::kLent), P::kLent),
    ignore(E::kNewSample, kAll & ~only(P::kLent)),

    stay(E::kInputMissing, kDecides),
    never(E::kInputMissing, kAll & ~kDecides),
    to(E::kUnservable, kDecides, P::kRefused),
    never(E::kUnservable, kAll & ~kDecides),
    to(E::kBroken, only(P::kListening) | kChoosing, P::kLent),
    stay(E::kBroken, only(P::kLent)),
    never(E::kBroken, kAll & ~kDecides),
    to(E::kServable, kAsking, P::kTaking),
    ignore(E::kServable, kChoosing),
    never(E::kServable, kAll & ~kDecides),
    to(E::kArmFree, only(P::kTaking), P::kDeciding),
    never(E::kArmFree, kAll & ~only(P::kTaking)),
    to(E::kPositionUnknown, only(P::kTaking), P::kRefused),
    never(E::kPositionUnknown, kAll & ~only(P::kTaking)),
    to(E::kTagUnseen, only(P::kDeciding), P::kTagAwaited),
    stay(E::kTagUnseen, only(P::kTagAwaited)),
    never(E::kTagUnseen, kAll & ~only(P::kDeciding) & ~only(P::kTagAwaited)),
    to(E::kTagLost, only(P::kDeciding), P::kTagAwaited, Sends::kHold),
    never(E::kTagLost, kAll & ~only(P::kDeciding)),
    to(E::kTagSeen, only(P::kTagAwaited), P::kDeciding),
    ignore(E::kTagSeen, only(P::kDeciding)),
    never(E::kTagSeen, kAll & ~only(P::kDeciding) & ~only(P::kTagAwaited)),
    to(E::kStep, only(P::kDeciding), P::kMoving, Sends::kMove),
    never(E::kStep, kAll & ~only(P::kDeciding)),
    to(E::kReached, only(P::kDeciding), P::kKeeping),
    never(E::kReached, kAll & ~only(P::kDeciding)),
    to(E::kUnreachable, only(P::kDeciding), P::kRefused),
    never(E::kUnreachable, kAll & ~only(P::kDeciding)),
    to(E::kFailed, kChoosing, P::kHoldDue),  // nobody gets the arm unasked
    never(E::kFailed, kAll & ~kChoosing),

    to(E::kInputSilent, kChoosing | kActing, P::kHoldDue),
    ignore(E::kInputSilent, kOver | kHolds | kAsking | kKeeping),
    to(E::kUnanswered, only(P::kMoving), P::kMoving, Sends::kAgain),
    to(E::kUnanswered, only(P::kMovingPreempted), P::kTaking),  // planned from another place
    to(E::kUnanswered, only(P::kHoldSent), P::kHoldSent, Sends::kHold),  // a refused id stays so
    ignore(E::kUnanswered, kAll & ~kAwaitsAnswer & ~only(P::kHoldSent)),
    to(E::kEndless, kAwaitsAnswer, P::kHoldDue),
    ignore(E::kEndless, kAll & ~kAwaitsAnswer),
    to(E::kNoSample, kAwaitsSample, P::kHoldDue),
    ignore(E::kNoSample, kAll & ~kAwaitsSample),
    to(E::kTargetExpired, kChoosing | kActing, P::kHoldDue),
    to(E::kTargetExpired, kAsking, P::kRefused),
    ignore(E::kTargetExpired, kOver | kHolds | kKeeping),
    to(E::kGivenUp, kChoosing, P::kRefused),
    ignore(E::kGivenUp, kAll & ~kChoosing),
    to(E::kNotHeard, only(P::kListening), P::kRefused),
    ignore(E::kNotHeard, kAll & ~only(P::kListening)),
    to(E::kLentInVain, only(P::kLent), P::kRefused),
    ignore(E::kLentInVain, kAll & ~only(P::kLent)),
    to(E::kKept, kKeeping, P::kReleased),
    ignore(E::kKept, kAll & ~kKeeping),
};

constexpr std::size_t index(auto value) { return static_cast<std::size_t>(value); }

using Table = std::array<std::array<Reaction, kNumEvents>, kNumPhases>;

constexpr Table make_table() {
  Table table{};
  for (const Rule& rule : kRules)
    for (const PhaseInfo& phase : kPhases)
      if (rule.in & only(phase.phase)) table[index(phase.phase)][index(rule.event)] = rule.reaction;
  return table;
}

/// Each pair of phase and event has one rule.
constexpr bool is_total() {
  for (const EventInfo& event : kEvents) {
    PhaseSet decided = 0;
    for (const Rule& rule : kRules) {
      if (rule.event != event.event) continue;
      if (decided & rule.in) return false;
      decided |= rule.in;
    }
    if (decided != kAll) return false;
  }
  return true;
}

constexpr bool is_in_order() {
  for (std::size_t i = 0; i < kPhases.size(); ++i)
    if (index(kPhases[i].phase) != i) return false;
  for (std::size_t i = 0; i < kEvents.size(); ++i)
    if (index(kEvents[i].event) != i) return false;
  return true;
}

static_assert(is_in_order());
static_assert(is_total());

constexpr Table kTable = make_table();

}  // namespace

const Reaction& reaction(Phase phase, Event event) { return kTable[index(phase)][index(event)]; }
const PhaseInfo& info(Phase phase) { return kPhases[index(phase)]; }
const EventInfo& info(Event event) { return kEvents[index(event)]; }

bool owns_arm(Phase phase) { return kOwnsArm & only(phase); }
bool is_active(Phase phase) { return kActive & only(phase); }
bool is_open(Phase phase) { return kOpen & only(phase); }
bool decides(Phase phase) { return kDecides & only(phase); }

}  // namespace bodyschema
