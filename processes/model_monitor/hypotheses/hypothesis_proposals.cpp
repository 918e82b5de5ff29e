// What HypothesisTracker proposes: changes more, changes in another form or element, edges learned
// anew; and which action would tell two explanations apart.

#include <algorithm>
#include <cmath>
#include <span>
#include <utility>
#include <vector>

#include "processes/model_monitor/hypotheses/hypothesis_tracker.h"
#include "processes/model_monitor/hypotheses/schema_difference.h"

namespace bodyschema {
namespace {

using Kind = AdaptationEvent::Kind;

/// Samples after a replacement at which all forms are tried again.
constexpr int kRefits[] = {1, 2, 3, 4, 5, 7, 11, 19, 30};
/// Samples up to which a change may turn out to be one elsewhere.
constexpr int kUnsure = 5;
/// From so many samples on a form must lead another clearly.
constexpr int kManySamples = 8;
/// Newest samples that an edge learned anew must explain no worse.
constexpr std::int64_t kNewest = 5;

bool is_in(std::int64_t value, const auto& values) {
  return std::ranges::find(values, value) != std::end(values);
}

bool is_worth_learning(std::int64_t age) {
  constexpr std::int64_t kAges[] = {8, 10, 13, 16, 20, 25, 32};
  return age % 40 == 0 || is_in(age, kAges);
}

}  // namespace

FoundChanges HypothesisTracker::search(const BodySchema& base,
                                       const std::vector<ElementId>& elements,
                                       const std::vector<const ActionPoseSample*>& samples,
                                       const BodyChange* standing_form) {
  ChangeSearch search{measurement_, options_.ambiguity};
  if (standing_form) {
    search.standing_form = *standing_form;
    search.learn = standing_form->is_learned();
  }
  FoundChanges found = find_changes(base, history_, elements, samples, search);
  work_budget_ -= found.work;
  return found;
}

std::optional<HypothesisTracker::Explanation> HypothesisTracker::explain(
    const std::vector<ElementId>& elements, std::int64_t since) {
  FoundChanges found =
      search(schema(), elements, segment(since, options_.longest_segment), nullptr);
  if (!found.best) return std::nullopt;
  return Explanation{std::move(*found.best), since, found.margin()};
}

void HypothesisTracker::adopt(Explanation explanation, std::int64_t now,
                              std::vector<AdaptationEvent>* events) {
  std::vector<Change> changes = this->changes();
  changes.push_back({std::move(explanation.what), explanation.since, now});
  Hypothesis more = made_of(std::move(changes));
  more.log_odds = log_odds() + explanation.lead;
  stand(std::move(more), now, events);
}

void HypothesisTracker::propose_more(std::int64_t now) {
  const std::vector<ElementId> elements = suspects();
  if (elements.empty() || work_budget_ <= 0) return;
  const std::int64_t since = tests_->highest().cusum.since;
  if (!is_worth_a_fit(now - since + 1)) return;
  const FoundChanges found =
      search(schema(), elements, segment(since, options_.longest_segment), nullptr);
  for (const auto* one : {&found.best, &found.runner_up}) {
    if (!*one) continue;
    std::vector<Change> changes = this->changes();
    Change change{**one, since, now};
    // It takes the element of an earlier one there, which holds until then.
    const bool is_again = !change.what.element.is_tag() && last_at(changes, change.what.element);
    if (is_again && !change.what.fitted.origin) change.what.fitted.origin = schema();
    changes.push_back(std::move(change));
    Hypothesis more = made_of(std::move(changes));
    more.log_odds = log_odds() + (*one)->fitted.log_evidence - found.null;
    // Where the standing explanation leaves something wrong it may have taken the other's part.
    if (one == &found.best && detected_ && !standing().changes.empty() &&
        is_in(now - since + 1, kRefits))
      more = fitted_again(more, true, options_.settled_after, now);
    if (more.log_odds > log_odds() - options_.ambiguity) offer(std::move(more));
  }
}

void HypothesisTracker::propose_learned(std::int64_t now) {
  const std::vector<ElementId> elements = suspects();
  const std::int64_t since = trouble_since();
  if (elements.empty() || !(detected_ || now - last_mismatch_ < kUnexplained) ||
      !is_worth_learning(now - since + 1))
    return;
  std::vector<int> parts;
  const auto add = [&](const ElementId& element) {
    const bool is_new = std::ranges::find(parts, element.id) == parts.end();
    if (!element.is_tag() && edge_to(settled_, element.id) && is_new) parts.push_back(element.id);
  };
  for (const Change& c : changes()) add(c.what.element);
  for (const auto& [element, last] : mismatched_)
    if (last >= since) add(element);
  add(elements.front());
  const auto samples = segment(since, options_.longest_segment);
  const auto newest = segment(now - kNewest + 1, kNewest);
  const double of_newest = log_likelihood(schema(), measurement_, newest);
  for (const int part : parts) {
    // The other edges as they were, or as they are now.
    std::vector<std::vector<Change>> rests{{}};
    std::vector<Change> others = changes();
    std::erase_if(others, [part](const Change& c) { return c.what.element.id == part; });
    if (!others.empty()) rests.push_back(std::move(others));
    for (const std::vector<Change>& rest : rests) {
      const BodySchema base = composed(rest, rest.size());
      const double before = log_odds_of(rest) - log_likelihood(base, measurement_, samples);
      const PlaceEvidence evidence(base, measurement_, edge_element(part, settled_.root), samples);
      for (FittedChange& learned : evidence.learn()) {
        const double odds = before + learned.log_evidence;
        std::vector<Change> changes = rest;
        changes.push_back({{edge_element(part, settled_.root), std::move(learned)}, since, now});
        Hypothesis hypothesis = made_of(std::move(changes));
        hypothesis.log_odds = odds;
        // What the body has changed back from meanwhile explains many samples, too.
        if (log_likelihood(hypothesis.body, measurement_, newest) >= of_newest)
          offer(std::move(hypothesis));
      }
    }
  }
}

void HypothesisTracker::refit(const BodySchema& others, int longest, Change* change) const {
  FittedChange& fitted = change->what.fitted;
  if (fitted.change.size() == 0 || !is_possible(fitted, others)) return;
  const ElementId& element = change->what.element;
  const BodySchema base = fitted.origin ? with_edge_of(others, *fitted.origin, element.id) : others;
  const PlaceEvidence evidence(base, measurement_, element, segment(change->since, longest));
  auto again = evidence.fit(fitted.change);
  if (!again) return;
  again->origin = fitted.origin;
  again->certain = fitted.certain;
  fitted = std::move(*again);
}

std::optional<Replacement> HypothesisTracker::best_form(const Hypothesis& of, const Change& change,
                                                        const BodySchema& others,
                                                        std::int64_t now) {
  const auto samples = segment(change.since, options_.longest_segment);
  const FittedChange& fitted = change.what.fitted;
  FoundChanges found = search(others, {change.what.element}, samples, &fitted.change);
  const bool is_young = now - change.adopted <= kUnsure && change.what.also.empty() &&
                        !fitted.everywhere && !fitted.change.is_learned();
  if (is_young && of.changes.size() == 1) {
    std::vector<ElementId> around = elements_around(*of.filter, change.what.element.id);
    for (const ElementId& element : suspects_of_settled(change.since))
      if (std::ranges::find(around, element) == around.end()) around.push_back(element);
    std::erase(around, change.what.element);
    FoundChanges there = search(others, around, samples, nullptr);
    if (there.best && (!found.best || there.best->fitted.log_evidence >
                                          found.best->fitted.log_evidence + options_.acceptance))
      found = std::move(there);
  }
  if (!found.best || found.margin() < 0) return std::nullopt;
  if (found.runner_up && of.changes.size() == 1) {
    Hypothesis rival = made_of({{*found.runner_up, change.since, change.adopted}});
    rival.log_odds = found.runner_up->fitted.log_evidence - found.null;
    offer(std::move(rival));
  }
  return found.best;
}

HypothesisTracker::Hypothesis HypothesisTracker::fitted_again(Hypothesis hypothesis, bool all_forms,
                                                              int longest, std::int64_t now) {
  std::vector<Change> changes = hypothesis.changes;
  const int rounds = all_forms && changes.size() > 1 ? 3 : 1;
  for (int round = 0; round < rounds; ++round) {
    bool is_changed = false;
    for (std::size_t n = 0; n < changes.size();) {
      Change& c = changes[n];
      if (now - c.adopted > longest || last_at(changes, c.what.element) != &c) {
        ++n;
        continue;
      }
      const BodySchema others = composed(changes, n);
      if (!all_forms) {
        refit(others, longest, &c);
        ++n;
        continue;
      }
      auto best = best_form(hypothesis, c, others, now);
      is_changed |= !best || !is_same_explanation(*best, c.what);
      if (best) {
        c.what = std::move(*best);
        ++n;
      } else {
        changes.erase(changes.begin() + static_cast<std::ptrdiff_t>(n));
      }
    }
    if (!is_changed) break;
  }
  Hypothesis result = made_of(std::move(changes));
  result.log_odds = log_odds_of(result.changes);
  return result;
}

void HypothesisTracker::propose_again(std::int64_t now, std::vector<AdaptationEvent>* events) {
  if (changes().empty()) return;
  const std::int64_t age = now - newest_adopted();
  if (age == 0) return;
  beam_.front() = fitted_again(standing(), false, options_.settled_after, now);
  if (work_budget_ <= 0 || !is_in(age, kRefits)) return;
  Hypothesis again = fitted_again(standing(), true, options_.settled_after, now);
  // The same, learned from more samples, needs no lead.
  const double lead = again.log_odds - log_odds();
  if (is_standing(again.changes) || lead > (age < kManySamples ? 0 : needed_lead(again, now)))
    stand(std::move(again), now, events);
  else
    offer(std::move(again));
}

void HypothesisTracker::want_probe(std::int64_t now, std::vector<AdaptationEvent>* events) {
  const auto is_asked = [this](const Replacement& a, const Replacement& b) {
    return std::ranges::any_of(asked_, [&](const auto& pair) {
      return (is_same_explanation(pair.first, a) && is_same_explanation(pair.second, b)) ||
             (is_same_explanation(pair.first, b) && is_same_explanation(pair.second, a));
    });
  };
  if (changes().empty()) {
    asked_.clear();
    return;
  }
  const std::int64_t age = now - newest_adopted();
  if (age != 0 && !is_in(age, kRefits)) return;
  const Replacement& one = changes().back().what;
  // Of two functions the samples to come decide.
  if (one.fitted.change.is_learned()) return;
  const auto lead_of = [this](const Hypothesis* h) { return std::abs(log_odds() - h->log_odds); };
  std::vector<const Hypothesis*> rivals;
  for (const Hypothesis& h : std::span(beam_).subspan(1))
    if (h.changes.size() == changes().size() && lead_of(&h) <= options_.ambiguity &&
        !is_same_explanation(one, h.changes.back().what) && !is_asked(one, h.changes.back().what))
      rivals.push_back(&h);
  std::ranges::stable_sort(rivals, {}, lead_of);
  // One at a time, about the nearest.
  for (const Hypothesis* rival : rivals) {
    const Replacement& other = rival->changes.back().what;
    const Eigen::VectorXd probe = most_telling_action(schema(), rival->body, options_.tolerance);
    if (probe.size() == 0) continue;
    AdaptationEvent wanted = event(Kind::kProbeWanted, now, one.element);
    wanted.cause = one.fitted.change.cause(settled_);
    wanted.other_cause = other.fitted.change.cause(settled_);
    if (wanted.other_cause == wanted.cause && other.element == one.element)
      wanted.other_cause.clear();
    wanted.margin = lead_of(rival);
    wanted.probe = probe;
    asked_.emplace_back(one, other);
    events->push_back(std::move(wanted));
    return;
  }
}

}  // namespace bodyschema
