#include "processes/controller/controller_states.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <fstream>
#include <map>
#include <set>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

#include "bodyschema/control_status_t.hpp"

namespace bodyschema {
namespace {

using S = control_status_t;
using Kind = Reaction::Kind;
using Phases = std::set<Phase>;

std::vector<Phase> all_phases() {
  std::vector<Phase> phases;
  for (int i = 0; i < kNumPhases; ++i) phases.push_back(static_cast<Phase>(i));
  return phases;
}

std::vector<Event> all_events() {
  std::vector<Event> events;
  for (int i = 0; i < kNumEvents; ++i) events.push_back(static_cast<Event>(i));
  return events;
}

/// Those of one CONTROL_STATUS.
Phases phases_of(std::int8_t control_state) {
  Phases phases;
  for (const Phase phase : all_phases())
    if (info(phase).control_state == control_state) phases.insert(phase);
  return phases;
}

/// From `phases` by all events but some, with themselves.
Phases reachable_from(Phases phases, const std::set<Event>& without = {}) {
  std::vector<Phase> open(phases.begin(), phases.end());
  while (!open.empty()) {
    const Phase phase = open.back();
    open.pop_back();
    for (const Event event : all_events()) {
      const Reaction& r = reaction(phase, event);
      if (r.kind == Kind::kGoes && !without.contains(event) && phases.insert(r.next).second)
        open.push_back(r.next);
    }
  }
  return phases;
}

std::string named(Phase phase, Event event) {
  return std::string(info(event).name) + " in " + std::string(info(phase).name);
}

/// Where the driver must be told to hold: the arm is the controller's and a target is open.
Phases served() {
  Phases phases = phases_of(S::CONTROL_MOVING);
  phases.merge(phases_of(S::CONTROL_WAITING));
  std::erase_if(phases, [](Phase phase) { return !owns_arm(phase); });
  return phases;
}

// That each pair has one rule is a static_assert beside the table.
TEST(ControllerStatesTest, OnlyATransitionHasANextPhaseAndSends) {
  for (const Phase phase : all_phases()) {
    EXPECT_EQ(info(phase).phase, phase);
    for (const Event event : all_events()) {
      const Reaction& r = reaction(phase, event);
      if (r.kind == Kind::kGoes) continue;
      EXPECT_EQ(r, Reaction{.kind = r.kind}) << named(phase, event);
    }
  }
}

TEST(ControllerStatesTest, EveryPhaseIsReachedAndEveryEventGoesSomewhereOrIsToldOfAtLeast) {
  EXPECT_EQ(reachable_from({Phase::kIdle}).size(), static_cast<std::size_t>(kNumPhases));
  for (const Event event : all_events()) {
    bool matters = false;
    for (const Phase phase : all_phases()) {
      const Kind kind = reaction(phase, event).kind;
      matters |= kind == Kind::kGoes || kind == Kind::kStays;
    }
    EXPECT_TRUE(matters) << info(event).name;
  }
}

TEST(ControllerStatesTest, EveryStateOfControlStatusHasAPhase) {
  for (std::int8_t state = S::CONTROL_IDLE; state <= S::CONTROL_RELEASED; ++state)
    EXPECT_FALSE(phases_of(state).empty()) << int{state};
}

TEST(ControllerStatesTest, AMoveIsSentWhereItIsDecidedAloneAndSentAgainOnlyWhileUnanswered) {
  for (const Phase phase : all_phases()) {
    for (const Event event : all_events()) {
      const Reaction& r = reaction(phase, event);
      const bool is_step = phase == Phase::kDeciding && event == Event::kStep;
      EXPECT_EQ(r.sends == Sends::kMove, is_step) << named(phase, event);
      EXPECT_EQ(r.kind == Kind::kGoes && r.next == Phase::kMoving && phase != Phase::kMoving,
                is_step)
          << named(phase, event);
      if (r.sends == Sends::kNothing) continue;
      EXPECT_TRUE(owns_arm(r.next)) << named(phase, event);
      if (r.sends == Sends::kAgain) {
        EXPECT_EQ(r.next, phase);
        EXPECT_TRUE(phase == Phase::kHoldSent ||
                    reaction(phase, Event::kSettled).kind == Kind::kGoes);
      }
    }
  }
}

TEST(ControllerStatesTest, WhereATargetIsOverNothingMovesUntilAnother) {
  const Phases over = {Phase::kIdle,     Phase::kRefused, Phase::kRefusedHalted, Phase::kHoldDue,
                       Phase::kHoldSent, Phase::kHeld,    Phase::kReleased};
  for (const Phase phase : reachable_from(over, {Event::kTarget}))
    EXPECT_TRUE(over.contains(phase)) << info(phase).name;
  // Nor does `resume` take it up.
  for (const Phase phase : all_phases()) {
    const Reaction& r = reaction(phase, Event::kResumed);
    if (r.kind == Kind::kGoes) {
      EXPECT_EQ(r.next, Phase::kRefused);
    }
  }
}

TEST(ControllerStatesTest, WhatMustHoldTheArmSendsHoldAsSoonAsTheDriverIsHeard) {
  std::map<Event, Phases> holding;
  const Phases moving{Phase::kMoving, Phase::kMovingPreempted};
  const Phases observing{Phase::kObserving, Phase::kObservingPreempted};
  Phases owned = served();
  holding[Event::kInputSilent] = holding[Event::kTargetExpired] = owned;
  owned.insert(Phase::kKeeping);
  holding[Event::kDriverRestarted] = owned;
  holding[Event::kNoSample] = observing;
  holding[Event::kEndless] = moving;
  holding[Event::kRestored] = {Phase::kIdle};
  holding[Event::kFailed] = {Phase::kTaking, Phase::kDeciding, Phase::kTagAwaited};
  for (const Phase phase : all_phases()) holding[Event::kHoldAsked].insert(phase);
  for (const Phase phase : all_phases()) {
    for (const Event event : all_events()) {
      const Reaction& r = reaction(phase, event);
      EXPECT_EQ(r.kind == Kind::kGoes && r.next == Phase::kHoldDue, holding[event].contains(phase))
          << named(phase, event);
    }
  }
  const Reaction sends_hold{Kind::kGoes, Phase::kHoldSent, Sends::kHold};
  EXPECT_EQ(reaction(Phase::kHoldDue, Event::kDriverHeard), sends_hold);
  EXPECT_EQ(reaction(Phase::kHoldSent, Event::kUnanswered), sends_hold);
  const Reaction waits_for_tag{Kind::kGoes, Phase::kTagAwaited, Sends::kHold};
  EXPECT_EQ(reaction(Phase::kDeciding, Event::kTagLost), waits_for_tag);
}

TEST(ControllerStatesTest, WhatOthersStopIsOverAndTheDriverIsToldNothing) {
  Phases owned = served();
  owned.insert(Phase::kKeeping);
  const Reaction held{Kind::kGoes, Phase::kHeld, Sends::kNothing};
  owned.insert(Phase::kLent);
  for (const Phase phase : owned)
    for (const Event event : {Event::kStopped, Event::kForeignHold})
      EXPECT_EQ(reaction(phase, event), held) << named(phase, event);
  EXPECT_EQ(reaction(Phase::kListening, Event::kForeignHold), held);
  EXPECT_EQ(reaction(Phase::kListening, Event::kStopped).next, Phase::kRefusedHalted);
  EXPECT_EQ(reaction(Phase::kKeeping, Event::kForeignMove), held);
}

TEST(ControllerStatesTest, AnArmThatIsHeldIsGivenBackWhereThatIsAskedForAlone) {
  for (const Phase phase : phases_of(S::CONTROL_HOLDING)) {
    for (const Event event : all_events()) {
      const Reaction& r = reaction(phase, event);
      if (r.kind != Kind::kGoes || event == Event::kReleaseAsked) continue;
      EXPECT_TRUE(owns_arm(r.next)) << named(phase, event);
    }
  }
}

TEST(ControllerStatesTest, WhoOwnsTheArmAndWhatIsOpenFollowsFromTheStateThatIsTold) {
  for (const Phase phase : all_phases()) {
    const std::int8_t state = info(phase).control_state;
    const bool is_over = state == S::CONTROL_IDLE || state == S::CONTROL_REFUSED ||
                         state == S::CONTROL_HOLDING || state == S::CONTROL_RELEASED;
    EXPECT_EQ(is_active(phase), !is_over) << info(phase).name;
    EXPECT_EQ(is_open(phase), !is_over && state != S::CONTROL_REACHED) << info(phase).name;
    EXPECT_EQ(decides(phase), is_open(phase) && state != S::CONTROL_MOVING) << info(phase).name;
    if (is_over || state == S::CONTROL_LENT)
      EXPECT_EQ(owns_arm(phase), state == S::CONTROL_HOLDING) << info(phase).name;
    else if (phase != Phase::kListening)
      EXPECT_TRUE(owns_arm(phase)) << info(phase).name;
  }
}

TEST(ControllerStatesTest, NoAnswerIsImpossibleHoweverLate) {
  for (const Phase phase : all_phases())
    for (const Event event :
         {Event::kHoldAsked, Event::kReleaseAsked, Event::kDriverHeard, Event::kStopped,
          Event::kResumed, Event::kDriverRestarted, Event::kForeignHold, Event::kForeignMove,
          Event::kUnderWay, Event::kSettled, Event::kRejected, Event::kExpired, Event::kEnded,
          Event::kHoldAnswered, Event::kSampleCame, Event::kNewSample})
      EXPECT_NE(reaction(phase, event).kind, Kind::kImpossible) << named(phase, event);
}

std::string listed(const std::vector<Phase>& phases) {
  if (phases.size() == kNumPhases) return "every phase";
  std::string text;
  for (const Phase phase : phases) (text += text.empty() ? "" : "; ") += info(phase).name;
  return text;
}

/// The table for people.
std::string markdown() {
  const char* kStates[] = {"IDLE",    "WAITING", "MOVING", "REACHED",
                           "REFUSED", "HOLDING", "LENT",   "RELEASED"};
  const char* kSends[] = {"", "MOVE", "HOLD", "the same again"};
  std::ostringstream text;
  text << "# What the controller does when\nThe transition table of [controller_states.cpp]"
          "(controller_states.cpp), as controller_states_test writes it.\n\n"
          "| phase | CONTROL_STATUS | owns the arm | meaning |\n| --- | --- | --- | --- |\n";
  for (const Phase phase : all_phases())
    text << "| " << info(phase).name << " | " << kStates[info(phase).control_state] << " | "
         << (owns_arm(phase) ? "yes" : "no") << " | " << info(phase).meaning << " |\n";
  text << "\n| event | meaning | in | goes to | sends |\n| --- | --- | --- | --- | --- |\n";
  for (const Event event : all_events()) {
    std::vector<std::pair<Reaction, std::vector<Phase>>> groups;
    for (const Phase phase : all_phases()) {
      const Reaction& r = reaction(phase, event);
      auto group = std::find_if(groups.begin(), groups.end(),
                                [&](const auto& other) { return other.first == r; });
      if (group == groups.end()) group = groups.insert(group, {r, {}});
      group->second.push_back(phase);
    }
    std::stable_sort(groups.begin(), groups.end(),
                     [](const auto& a, const auto& b) { return a.first.kind > b.first.kind; });
    std::string label =
        "| **" + std::string(info(event).name) + "** | " + std::string(info(event).meaning);
    for (const auto& [r, phases] : groups) {
      const bool is_last = &r == &groups.back().first;
      const bool is_rest = is_last && groups.size() > 1 && r.kind < Kind::kStays;
      text << std::exchange(label, "| |") << " | " << (is_rest ? "else" : listed(phases)) << " | "
           << (r.kind == Kind::kGoes      ? info(r.next).name
               : r.kind == Kind::kStays   ? "stays, told anew"
               : r.kind == Kind::kIgnored ? "ignored"
                                          : "impossible")
           << " | " << kSends[static_cast<int>(r.sends)] << " |\n";
    }
  }
  return text.str();
}

TEST(ControllerStatesTest, TheTableForPeopleIsThatOfTheCode) {
  std::ifstream file(CONTROLLER_STATES_MD);
  std::stringstream kept;
  kept << file.rdbuf();
  const std::string written = testing::TempDir() + "states.md";
  std::ofstream(written) << markdown();
  EXPECT_TRUE(kept.str() == markdown())
      << "see what changed: git diff --no-index " << CONTROLLER_STATES_MD << " " << written
      << "\nand copy the new one there";
}

}  // namespace
}  // namespace bodyschema
