// What HypothesisTracker tells: how the explanation that stands differs from the one before.

#include <algorithm>
#include <utility>

#include "processes/model_monitor/hypotheses/hypothesis_tracker.h"

namespace bodyschema {

using Kind = AdaptationEvent::Kind;

AdaptationEvent HypothesisTracker::event(Kind kind, std::int64_t sample,
                                         const ElementId& element) const {
  AdaptationEvent result;
  result.kind = kind;
  result.sample_index = sample;
  const Edge* edge = edge_to(settled_, element.id);
  if (element.is_tag() || !edge) {
    result.part = element.id;
  } else {
    result.from = edge->from;
    result.to = edge->to;
  }
  return result;
}

void HypothesisTracker::tell(Kind kind, std::int64_t sample, const Hypothesis& of,
                             const Change& change, double margin,
                             std::vector<AdaptationEvent>* events) const {
  const Replacement& what = change.what;
  const FittedChange& fitted = what.fitted;
  BodySchema base = composed(of.changes, static_cast<std::size_t>(&change - of.changes.data()));
  if (fitted.origin) base = with_edge_of(base, *fitted.origin, what.element.id);
  std::vector<ElementId> elements{what.element};
  elements.insert(elements.end(), what.also.begin(), what.also.end());
  for (const ElementId& element : elements) {
    AdaptationEvent told = event(kind, sample, element);
    BodyChange there = fitted.change;
    there.part = element.id;
    told.cause = there.cause(settled_);
    if (element == what.element)
      told.size = size_of(base, fitted.change, fitted.theta, fitted.covariance);
    told.margin = margin;
    told.since = change.since;
    told.num_samples = static_cast<int>(sample - change.since + 1);
    events->push_back(std::move(told));
  }
}

void HypothesisTracker::tell_difference(const Hypothesis& before, const Hypothesis& after,
                                        std::int64_t sample,
                                        std::vector<AdaptationEvent>* events) const {
  const double margin = after.log_odds - before.log_odds;
  for (const Change& c : before.changes)
    if (last_at(before.changes, c.what.element) == &c && !last_at(after.changes, c.what.element))
      tell(Kind::kReverted, sample, before, c, margin, events);
  for (const Change& c : after.changes) {
    if (last_at(after.changes, c.what.element) != &c) continue;
    const Change* old = last_at(before.changes, c.what.element);
    if (old && is_same_change(*old, c)) continue;
    const auto is_old = [old](const Change& other) { return is_same_change(other, *old); };
    const bool is_superseded = old && std::ranges::any_of(after.changes, is_old);
    const bool is_learned_anew =
        old && c.what.fitted.change.is_learned() && !old->what.fitted.change.is_learned();
    const bool is_refined = old && !is_superseded && !is_learned_anew && c.since <= old->since;
    if (is_refined) {
      tell(Kind::kRefined, sample, after, c, margin, events);
      continue;
    }
    if (old && !is_superseded) tell(Kind::kReverted, sample, before, *old, margin, events);
    const bool is_stored = c.what.fitted.change.form == BodyChange::Form::kStored;
    tell(is_stored ? Kind::kRestored : Kind::kCandidate, sample, after, c, margin, events);
  }
}

}  // namespace bodyschema
