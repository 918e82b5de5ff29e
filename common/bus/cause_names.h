#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <string_view>

#include "bodyschema/health_event_t.hpp"

namespace bodyschema {

/// Names of health_event_t::CAUSE_*, in their order, as in docs/glossary.md; "": CAUSE_NONE.
inline constexpr std::array<std::string_view, health_event_t::CAUSE_INTERMITTENT + 1> kCauseNames =
    {"",
     "joint_stuck",
     "joint_offset",
     "joint_gain",
     "joint_nonlinear",
     "geometry",
     "new_model",
     "marker_moved",
     "marker_missing",
     "camera_moved",
     "drift",
     "rigid",
     "other_signal",
     "stored",
     "unexplained",
     "intermittent"};

/// @throws std::logic_error if there is no cause of that name.
inline std::int8_t cause_named(std::string_view name) {
  const auto place = std::ranges::find(kCauseNames, name);
  if (place == kCauseNames.end()) throw std::logic_error("no cause is " + std::string(name));
  return static_cast<std::int8_t>(place - kCauseNames.begin());
}

/// "joint_stuck", "joint_stuck or geometry". @throws std::out_of_range.
inline std::string cause_text(std::int8_t cause, std::int8_t other = health_event_t::CAUSE_NONE) {
  std::string text(kCauseNames.at(static_cast<std::size_t>(cause)));
  return other == health_event_t::CAUSE_NONE ? text : text + " or " + cause_text(other);
}

}  // namespace bodyschema
