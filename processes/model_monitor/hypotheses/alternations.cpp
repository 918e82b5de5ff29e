#include "processes/model_monitor/hypotheses/alternations.h"

namespace bodyschema {

std::optional<Alternations::Found> Alternations::look(const std::vector<AdaptationEvent>& events) {
  using Kind = AdaptationEvent::Kind;
  struct Seen {
    std::int64_t sample = 0;
    bool is_away = false, is_back = false;
  };
  std::map<int, Seen> seen;
  for (const AdaptationEvent& event : events) {
    if (event.from < 0) continue;
    Seen& there = seen[event.to];
    there.sample = event.sample_index;
    there.is_away |= event.kind == Kind::kCandidate;
    there.is_back |= event.kind == Kind::kRestored || event.kind == Kind::kReverted;
  }
  for (const auto& [part, now] : seen) {
    // One form instead of another is no change of the body.
    if (now.is_away == now.is_back) continue;
    std::deque<Change>& changes = changes_[part];
    if (!changes.empty() && changes.back().is_away == now.is_away) continue;
    changes.push_back({now.sample, now.is_away});
    while (changes.front().sample <= now.sample - kWithin) changes.pop_front();
    if (changes.size() < kChanges) continue;
    const Found found{part, changes.front().sample};
    changes_.clear();
    return found;
  }
  return std::nullopt;
}

}  // namespace bodyschema
