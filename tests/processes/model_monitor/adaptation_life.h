#pragma once

#include <gtest/gtest.h>

#include <algorithm>

#include "processes/model_monitor/adaptation.h"
#include "tests/support/broken_arm.h"
#include "tests/support/synthetic_robot.h"

// What the adaptation's tests have in common: the life of an arm that breaks.

namespace bodyschema::test {

using Kind = AdaptationEvent::Kind;

inline constexpr int kBlock = 60;

inline int part_of(const AdaptationEvent& event) { return event.part >= 0 ? event.part : event.to; }

inline std::string text(const AdaptationEvent& e) {
  return std::to_string(e.sample_index) + " " + name_of(e.kind) + " " + std::to_string(e.from) +
         "-" + std::to_string(e.to) + " part " + std::to_string(e.part) + " " + e.cause + " " +
         std::to_string(e.margin);
}

struct Life {
  std::vector<AdaptationEvent> events;
  std::vector<double> error;
  bool has(Kind kind) const {
    return std::any_of(events.begin(), events.end(),
                       [kind](const AdaptationEvent& e) { return e.kind == kind; });
  }
  std::string log() const {
    std::string result;
    for (const AdaptationEvent& e : events) result += "  " + text(e) + "\n";
    return result;
  }
};

inline Life live(BrokenArm& arm, Adaptation& adaptation, int end) {
  Life life;
  for (int t = 0; t < end; ++t) {
    for (const AdaptationEvent& e : adaptation.on_sample(arm.observe(t))) life.events.push_back(e);
    life.error.push_back(arm.error(adaptation.schema(), t));
  }
  return life;
}

}  // namespace bodyschema::test
