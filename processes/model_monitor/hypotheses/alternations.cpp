#include "processes/model_monitor/hypotheses/alternations.h"

namespace bodyschema {

std::optional<Alternations::Found> Alternations::look(const std::vector<AdaptationEvent>& events) {
  using Kind = AdaptationEvent::Kind;
  for (const AdaptationEvent& event : events) {
    const bool is_change = event.kind == Kind::kCandidate || event.kind == Kind::kRestored ||
                           event.kind == Kind::kReverted;
    if (!is_change || event.from < 0) continue;
    std::deque<std::int64_t>& changes = changes_[event.to];
    // One form instead of another is no change of the body.
    if (!changes.empty() && changes.back() == event.sample_index) continue;
    changes.push_back(event.sample_index);
    while (changes.front() <= event.sample_index - kWithin) changes.pop_front();
    if (changes.size() < kChanges) continue;
    const Found found{event.to, changes.front()};
    changes_.clear();
    return found;
  }
  return std::nullopt;
}

}  // namespace bodyschema
