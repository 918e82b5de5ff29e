#include "processes/model_monitor/health/adaptation_event.h"

namespace bodyschema {

const char* name_of(AdaptationEvent::Kind kind) {
  using Kind = AdaptationEvent::Kind;
  switch (kind) {
    case Kind::kMismatch:
      return "mismatch";
    case Kind::kCandidate:
      return "candidate";
    case Kind::kRefined:
      return "refined";
    case Kind::kRestored:
      return "restored";
    case Kind::kReverted:
      return "reverted";
    case Kind::kRecovered:
      return "recovered";
    case Kind::kDrift:
      return "drift";
    case Kind::kMissing:
      return "missing";
    case Kind::kProbeWanted:
      return "probe_wanted";
  }
  return "";
}

}  // namespace bodyschema
