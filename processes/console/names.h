#pragma once

#include <array>
#include <cstddef>
#include <string>

namespace bodyschema {

// The names in text, JSON and HTML of what messages carry as numbers, in the order of the numbers.

inline constexpr std::array kPhases = {"starting", "waiting", "working", "done", "ended"};
inline constexpr std::array kMotionStates = {"idle",     "accepted", "moving",  "settled",
                                             "rejected", "stopped",  "expired", "holding"};
inline constexpr std::array kControlStates = {"idle",    "waiting", "moving", "reached",
                                              "refused", "holding", "lent",   "released"};
inline constexpr std::array kEdgeStates = {"OK", "SUSPECT", "INVALID", "PROVISIONAL"};
/// The same in sentences, and as classes of the report's style sheet.
inline constexpr std::array kEdgeStateWords = {"OK", "suspect", "invalid", "provisional"};
inline constexpr std::array kEdgeStateClasses = {"ok", "suspect", "invalid", "provisional"};
inline constexpr std::array kEdgeKinds = {"rigid", "screw", "screw_gp", "matrix_gp"};
inline constexpr std::array kUnconnectedReasons = {"never seen", "not enough data yet",
                                                   "no valid model"};
inline constexpr std::array kHealthEvents = {"accepted", "refused",  "mismatch",    "candidate",
                                             "refined",  "restored", "reverted",    "recovered",
                                             "drift",    "missing",  "probe_wanted"};
inline constexpr std::array kFindingStates = {"found", "adopted", "confirmed", "followed", "aside"};

/// Of NoiseSource: in JSON, and for people.
inline constexpr std::array kNoiseSources = {"given",  "covariances", "repeats",
                                             "frames", "residuals",   "assumed"};
inline constexpr std::array kNoiseSourceWords = {"given",
                                                 "mean of the observations' covariances",
                                                 "estimated from repeated actions",
                                                 "estimated from what jumps between frames",
                                                 "estimated from what the best models leave",
                                                 "assumed: the samples do not tell it"};

/// Whether a counter of PROCESS_INFO tells of normal traffic.
inline bool is_traffic(const std::string& counter) {
  return counter.starts_with("received ") || counter.starts_with("published ");
}

/// `number`: an enumerator or what a message carries. @throws std::out_of_range.
template <std::size_t size, class Number>
const char* name_in(const std::array<const char*, size>& names, Number number) {
  return names.at(static_cast<std::size_t>(number));
}

}  // namespace bodyschema
