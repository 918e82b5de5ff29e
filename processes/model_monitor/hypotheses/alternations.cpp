#include "processes/model_monitor/hypotheses/alternations.h"

namespace bodyschema {

std::optional<Alternations::Found> Alternations::look(const std::vector<AdaptationEvent>& events) {
  using Kind = AdaptationEvent::Kind;
  struct Seen {
    std::int64_t sample = 0;
    bool is_away = false, is_back = false, is_undone = false;
  };
  std::map<int, Seen> seen;
  for (const AdaptationEvent& event : events) {
    if (event.from < 0) continue;
    Seen& there = seen[event.to];
    there.sample = event.sample_index;
    there.is_away |= event.kind == Kind::kCandidate;
    there.is_back |= event.kind == Kind::kRestored;
    there.is_undone |= event.kind == Kind::kReverted;
  }
  for (const auto& [part, now] : seen) {
    std::deque<Change>& changes = changes_[part];
    // A guess that is taken back was no change of the body, one form instead of another is none.
    if (now.is_undone && !now.is_away && !now.is_back && !changes.empty() && changes.back().is_away)
      changes.pop_back();
    if (now.is_away == now.is_back || (now.is_away && now.is_undone)) continue;
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
