#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <cstdint>
#include <string>
#include <vector>

#include "common/estimation/measurement_model.h"
#include "processes/model_monitor/changes/change_size.h"

namespace bodyschema {

struct AdaptationOptions {
  MeasurementModel measurement;
  /// Wished false alarms a sample, over all tests together.
  double false_alarm_rate = 1e-5;
  /// Below it noise_scale() does not go. 1 where the assumed noise has room for rare errors that a
  /// median does not see, as the view-dependent bias of real markers.
  double least_noise_scale = 0.2;
  double suspicion = 1.5;  ///< CUSUM above which candidates are tried [nats]
  double acceptance = 12;  ///< evidence over the schema that stands [nats]
  double ambiguity = 6;    ///< a runner-up nearer than this asks for a probe [nats]
  /// Disagreement of two explanations, anywhere in reach, that is worth a motion.
  Noise tolerance{0.02, 0.1};
  /// Samples at the start from which the noise is estimated before anything is judged.
  int calibration_samples = 8;
  int longest_segment = 40;  ///< samples since a change that are looked at
  int settled_after = 40;    ///< samples until a replacement is kept for good
  /// Samples of the changed body from which its parameters are estimated in the end: what has
  /// settled is still fitted anew now and then. (96 samples are remembered.)
  int matured_after = 90;
  std::size_t history = 8;  ///< schemas kept beside the first
};

/// Something that the adaptation decided at one sample.
struct AdaptationEvent {
  /// The values are those of health_event_t.
  enum class Kind : std::int8_t {
    kMismatch = 2,
    kCandidate,
    kRefined,
    kRestored,
    kReverted,
    kRecovered,
    kDrift,
    kMissing,
    kProbeWanted
  };
  Kind kind = Kind::kMismatch;
  std::int64_t sample_index = 0;
  int from = -1;  ///< parts of an edge; −1 for a part alone or the camera
  int to = -1;
  int part = -1;            ///< of a marker; −1 for an edge
  int tag = -1;             ///< the one of the part's tags that it is about; −1: all
  std::string cause;        ///< as in common/bus/cause_names.h
  std::string other_cause;  ///< kProbeWanted: the other explanation, if it has another name
  ChangeSize size;
  std::int64_t since = -1;  ///< first sample that shows it; −1: not told
  bool is_normal = false;   ///< of what was stored: the place is as in the first schema again
  /// Evidence over the schema that stood before; kProbeWanted: between the explanations [nats].
  double margin = 0;
  int num_samples = 0;
  /// kProbeWanted: the action at which the two likeliest explanations disagree most; else empty.
  Eigen::VectorXd probe;
};
inline bool has_kind(const std::vector<AdaptationEvent>& events, AdaptationEvent::Kind kind) {
  return std::ranges::find(events, kind, &AdaptationEvent::kind) != events.end();
}
inline const char* name_of(AdaptationEvent::Kind kind) {
  constexpr const char* kNames[] = {"mismatch",  "candidate", "refined", "restored",    "reverted",
                                    "recovered", "drift",     "missing", "probe_wanted"};
  return kNames[static_cast<int>(kind) - static_cast<int>(AdaptationEvent::Kind::kMismatch)];
}

}  // namespace bodyschema
