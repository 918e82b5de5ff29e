#include "processes/model_monitor/hypotheses/change_search.h"

#include <algorithm>
#include <utility>

#include "processes/model_monitor/hypotheses/schema_difference.h"

namespace bodyschema {
namespace {

/// From so many samples on a change keeps its form unless another explains clearly more of the
/// evidence.
constexpr int kManySamples = 8;
constexpr double kSystematicShare = 0.03;

bool is_better(const Replacement& candidate, const std::optional<Replacement>& other) {
  return !other || candidate.fitted.log_evidence > other->fitted.log_evidence;
}

/// The best, the best but one, and the best of the form that stands.
struct Ranking {
  std::optional<BodyChange> standing_form;
  std::optional<Replacement> best = std::nullopt, second = std::nullopt, same_form = std::nullopt;

  void offer(Replacement candidate) {
    if (candidate.fitted.change == standing_form && is_better(candidate, same_form))
      same_form = candidate;
    std::optional<Replacement> other = std::move(candidate);
    if (is_better(*other, best)) std::swap(other, best);
    if (other && is_better(*other, second)) second = std::move(other);
  }
};

/// What a change of the edge to `part` may start from.
struct Base {
  BodySchema schema;
  const BodySchema* origin = nullptr;  ///< of the history; nullptr: the model that stands
};

std::vector<Base> bases_of(const ElementId& element, const BodySchema& standing,
                           const std::vector<BodySchema>& history) {
  std::vector<Base> bases{{standing}};
  if (element.is_tag()) return bases;
  for (const BodySchema& stored : history) {
    BodySchema with = with_edge_of(standing, stored, element.id);
    const bool is_known = std::ranges::any_of(
        bases, [&](const Base& base) { return !differ_at(base.schema, with, element.id); });
    if (!is_known) bases.push_back({std::move(with), &stored});
  }
  return bases;
}

/// All that differs from a stored schema by more than is uncertain at once, where that is more than
/// one edge and the samples speak for it: first where that was suspected; an outlier elsewhere may
/// be the greatest suspicion.
std::optional<Replacement> whole(const BodySchema& stored, const BodySchema& standing,
                                 const std::vector<ElementId>& elements,
                                 const std::vector<const ActionPoseSample*>& samples,
                                 const MeasurementModel& measurement, double null) {
  Replacement all;
  FittedChange& fitted = all.fitted;
  fitted.change.form = BodyChange::Form::kStored;
  fitted.origin = stored;
  fitted.everywhere = true;
  fitted.log_prior = fitted.change.log_odds();
  const auto judge = [&] {
    const BodySchema with = with_change(standing, fitted);
    fitted.log_evidence = fitted.log_prior + log_likelihood(with, measurement, samples);
    return with;
  };
  const auto num_different = std::ranges::count_if(
      standing.parts, [&](int part) { return differ_at(standing, stored, part); });
  if (num_different < 2) return std::nullopt;
  judge();
  if (fitted.log_evidence <= null) return std::nullopt;
  BodySchema different = standing;
  int num_clear = 0;
  for (const int part : standing.parts) {
    if (is_alike_at(standing, stored, part)) continue;
    different = with_edge_of(different, stored, part);
    ++num_clear;
  }
  if (num_clear < 2) return std::nullopt;
  fitted.origin = std::move(different);
  std::vector<ElementId> at = differences(standing, judge());
  std::ranges::stable_sort(at, {},
                           [&](const ElementId& p) { return std::ranges::find(elements, p); });
  all.element = at.front();
  all.also = {at.begin() + 1, at.end()};
  fitted.change.part = all.element.id;
  return all;
}

}  // namespace

bool is_same_explanation(const Replacement& a, const Replacement& b) {
  return a.element == b.element && a.fitted.change == b.fitted.change && a.also == b.also;
}

bool is_worth_a_fit(std::int64_t age) {
  constexpr std::int64_t kAges[] = {10, 12, 15, 19, 24};
  return age <= 8 || age % 30 == 0 || std::ranges::find(kAges, age) != std::end(kAges);
}

FoundChanges find_changes(const BodySchema& standing, const std::vector<BodySchema>& history,
                          const std::vector<ElementId>& elements,
                          const std::vector<const ActionPoseSample*>& samples,
                          const ChangeSearch& search) {
  FoundChanges found;
  found.null = log_likelihood(standing, search.measurement, samples);
  Ranking ranking{search.standing_form};
  const bool are_many = static_cast<int>(samples.size()) >= kManySamples;
  // What could not be explained for so long is not explained by a change of a body of the past.
  const bool is_old = !search.standing_form && static_cast<int>(samples.size()) > kManySamples;
  for (const ElementId& element : elements) {
    for (const Base& base : bases_of(element, standing, history)) {
      const PlaceEvidence evidence(base.schema, search.measurement, element, samples);
      const auto offer = [&](FittedChange fitted) {
        if (base.origin) fitted.origin = *base.origin;
        ranking.offer({element, std::move(fitted)});
      };
      if (base.origin && evidence.num_usable() > 0) offer(evidence.judge_stored(base.schema));
      if (base.origin && is_old) continue;
      found.work += static_cast<int>(samples.size());
      for (FittedChange& fitted : evidence.fit_likely(possible_changes(base.schema, element)))
        offer(std::move(fitted));
      if (!search.learn || base.origin) continue;
      for (FittedChange& learned : evidence.learn()) offer(std::move(learned));
    }
  }
  for (const BodySchema& stored : history)
    if (auto all = whole(stored, standing, elements, samples, search.measurement, found.null))
      ranking.offer(std::move(*all));
  found.best = std::move(ranking.best);
  found.runner_up = std::move(ranking.second);
  // With many samples what the schema was wrong about before the change is found out too, and
  // dressed up as a richer form of it.
  if (ranking.same_form && are_many && found.best->fitted.change != *search.standing_form &&
      found.best->fitted.log_evidence - ranking.same_form->fitted.log_evidence <
          search.ambiguity + kSystematicShare * found.margin()) {
    found.runner_up = std::move(found.best);
    found.best = std::move(ranking.same_form);
  }
  return found;
}

}  // namespace bodyschema
