#include "processes/model_monitor/adaptation.h"

#include <algorithm>
#include <cmath>
#include <set>

namespace bodyschema {
namespace {

constexpr std::size_t kRing = 64;
/// Squared distance of every marker below which a sample cannot raise a CUSUM that is at zero.
constexpr double kClear = 14;
constexpr double kInflations[] = {3, 10};
constexpr double kSettledRefits[] = {2, 3, 4, 5, 6, 8, 12, 20};

bool differ(const Edge& a, const Edge& b) {
  if (!a.left.isApprox(b.left, 1e-9) || !a.right.isApprox(b.right, 1e-9) ||
      a.joints.size() != b.joints.size())
    return true;
  for (std::size_t d = 0; d < a.joints.size(); ++d) {
    const ScrewJoint &x = a.joints[d], &y = b.joints[d];
    if (x.signal != y.signal || x.gain != y.gain || x.offset != y.offset || x.turn != y.turn ||
        x.slide != y.slide || !x.X_after.isApprox(y.X_after, 1e-9))
      return true;
  }
  return false;
}

}  // namespace

const char* name_of(AdaptationEvent::Kind kind) {
  using Kind = AdaptationEvent::Kind;
  switch (kind) {
    case Kind::kMismatch: return "mismatch";
    case Kind::kCandidate: return "candidate";
    case Kind::kRefined: return "refined";
    case Kind::kRestored: return "restored";
    case Kind::kReverted: return "reverted";
    case Kind::kRecovered: return "recovered";
    case Kind::kDrift: return "drift";
    case Kind::kMissing: return "missing";
    case Kind::kProbeWanted: return "probe_wanted";
  }
  return "";
}

Adaptation::Adaptation(BodySchema schema, AdaptationOptions options)
    : options_(options), schema_(std::move(schema)) {
  history_.push_back(schema_);
  install(schema_);
}

void Adaptation::install(const BodySchema& schema) {
  schema_ = schema;
  filter_.emplace(schema_, options_.noise);
  restart_tests();
}

void Adaptation::restart_tests() {
  edges_.assign(static_cast<std::size_t>(filter_->num_nodes()), {});
  markers_ = edges_;
}

double Adaptation::edge_statistic(int part) const {
  const int node = filter_->node_of(part);
  return node < 0 ? 0 : edges_[static_cast<std::size_t>(node)].value;
}

double Adaptation::marker_statistic(int part) const {
  const int node = filter_->node_of(part);
  return node < 0 ? 0 : markers_[static_cast<std::size_t>(node)].value;
}

void Adaptation::update_tests(const TreeFilter::Instant& instant, std::int64_t sample_index) {
  const TreeFilter::Judgement now = filter_->judge(instant);
  const auto is_zero = [](const Cusum& c) { return c.value == 0; };
  const bool clear = std::all_of(now.squared_distance.begin(), now.squared_distance.end(),
                                 [](double d2) { return d2 < kClear; });
  if (clear && std::all_of(edges_.begin(), edges_.end(), is_zero) &&
      std::all_of(markers_.begin(), markers_.end(), is_zero))
    return;
  const auto add = [sample_index](Cusum* cusum, double ratio) {
    if (cusum->value == 0) cusum->since = sample_index;
    cusum->value = std::max(0.0, cusum->value + ratio);
  };
  for (int node = 0; node < filter_->num_nodes(); ++node) {
    double wrong = 0;
    for (const double inflation : kInflations) {
      Alternative alternative;
      alternative.inflated_edge = node;
      alternative.inflation = inflation;
      wrong += std::exp(std::min(
          filter_->judge(instant, alternative).log_likelihood - now.log_likelihood, 600.0));
    }
    Alternative cut;
    cut.cut_edges = {node};
    wrong += std::exp(
        std::min(filter_->judge(instant, cut).log_likelihood - now.log_likelihood, 600.0));
    add(&edges_[static_cast<std::size_t>(node)], std::log(wrong / 3));
    if (!instant.seen[static_cast<std::size_t>(node)]) continue;
    Alternative detached;
    detached.detached_node = node;
    add(&markers_[static_cast<std::size_t>(node)],
        filter_->judge(instant, detached).log_likelihood - now.log_likelihood);
  }
}

std::vector<const ActionPoseSample*> Adaptation::segment(std::int64_t since) const {
  std::vector<const ActionPoseSample*> result;
  for (const ActionPoseSample& sample : recent_)
    if (sample.sample_index >= since) result.push_back(&sample);
  const auto longest = static_cast<std::size_t>(options_.longest_segment);
  if (result.size() > longest) result.erase(result.begin(), result.end() - options_.longest_segment);
  return result;
}

std::vector<Adaptation::Place> Adaptation::suspects() const {
  // The most suspicious elements and what is next to them.
  struct Scored {
    double value;
    Place place;
  };
  std::vector<Scored> scored;
  for (int node = 0; node < filter_->num_nodes(); ++node) {
    scored.push_back({edges_[static_cast<std::size_t>(node)].value, {filter_->part(node), false}});
    scored.push_back({markers_[static_cast<std::size_t>(node)].value, {filter_->part(node), true}});
  }
  std::stable_sort(scored.begin(), scored.end(),
                   [](const Scored& a, const Scored& b) { return a.value > b.value; });
  std::vector<Place> places;
  const auto add = [&places](const Place& place) {
    if (std::find(places.begin(), places.end(), place) == places.end()) places.push_back(place);
  };
  for (std::size_t n = 0; n < scored.size() && n < 4; ++n)
    if (scored[n].value > options_.suspicion) add(scored[n].place);
  if (!scored.empty() && scored[0].value > options_.suspicion) {
    const int node = filter_->node_of(scored[0].place.part);
    add({scored[0].place.part, false});
    add({scored[0].place.part, true});
    if (filter_->parent(node) >= 0) {
      add({filter_->part(filter_->parent(node)), false});
      add({filter_->part(filter_->parent(node)), true});
    }
    for (const int child : filter_->children(node)) add({filter_->part(child), false});
  }
  return places;
}

std::optional<FittedChange> Adaptation::best_change(const BodySchema& standing,
                                                    const std::vector<Place>& places,
                                                    std::int64_t since, double* null,
                                                    double* runner_up, Place* place) const {
  const auto samples = segment(since);
  *null = log_likelihood(standing, options_.noise, samples);
  *runner_up = -std::numeric_limits<double>::infinity();
  std::optional<FittedChange> best;
  const auto offer = [&](FittedChange candidate, const Place& at) {
    if (best && candidate.log_evidence <= best->log_evidence) {
      *runner_up = std::max(*runner_up, candidate.log_evidence);
      return;
    }
    if (best) *runner_up = std::max(*runner_up, best->log_evidence);
    best = std::move(candidate);
    *place = at;
  };
  for (const Place& at : places) {
    // Bases: the model that stands, and what is stored of this place.
    std::vector<BodySchema> bases{standing};
    if (!at.marker) {
      for (const BodySchema& stored : history_) {
        BodySchema with = standing;
        if (at.part == standing.root) {
          with.X_CR = stored.X_CR;
          with.X_CR_covariance = stored.X_CR_covariance;
          if (with.X_CR.isApprox(standing.X_CR, 1e-9)) continue;
        } else {
          const Edge* edge = edge_to(stored, at.part);
          const Edge* now = edge_to(standing, at.part);
          if (!edge || !now || edge->from != now->from || !differ(*edge, *now)) continue;
          for (Edge& e : with.edges)
            if (e.to == at.part) e = *edge;
        }
        bool known = false;
        for (const BodySchema& base : bases) {
          const Edge *a = edge_to(base, at.part), *b = edge_to(with, at.part);
          known |= a && b ? !differ(*a, *b) : base.X_CR.isApprox(with.X_CR, 1e-9);
        }
        if (!known) bases.push_back(std::move(with));
      }
    }
    for (std::size_t b = 0; b < bases.size(); ++b) {
      const PlaceEvidence evidence(bases[b], options_.noise, at.part, at.marker, samples);
      if (b > 0 && evidence.num_usable() > 0) offer(evidence.judge_stored(bases[b]), at);
      for (const BodyChange& change : possible_changes(bases[b], at.part, at.marker))
        if (auto fitted = evidence.fit(change)) offer(std::move(*fitted), at);
    }
  }
  // All that differs from a stored schema at once.
  for (const BodySchema& stored : history_) {
    BodySchema with = standing;
    int num_different = !with.X_CR.isApprox(stored.X_CR, 1e-9);
    with.X_CR = stored.X_CR;
    with.X_CR_covariance = stored.X_CR_covariance;
    for (Edge& e : with.edges) {
      const Edge* edge = edge_to(stored, e.to);
      if (!edge || edge->from != e.from || !differ(*edge, e)) continue;
      e = *edge;
      ++num_different;
    }
    if (num_different < 2 || places.empty()) continue;
    const PlaceEvidence evidence(standing, options_.noise, places.front().part,
                                 places.front().marker, samples);
    offer(evidence.judge_stored(with), places.front());
  }
  return best;
}

AdaptationEvent Adaptation::event(AdaptationEvent::Kind kind, std::int64_t sample_index,
                                  const Place& place) const {
  AdaptationEvent result;
  result.kind = kind;
  result.sample_index = sample_index;
  const Edge* edge = edge_to(schema_, place.part);
  if (place.marker || !edge) {
    result.part = place.part;
  } else {
    result.from = edge->from;
    result.to = edge->to;
  }
  return result;
}

void Adaptation::try_changes(std::int64_t sample_index, std::vector<AdaptationEvent>* events) {
  const std::vector<Place> places = suspects();
  if (places.empty()) return;
  std::int64_t since = sample_index;
  double highest = 0;
  for (std::size_t n = 0; n < edges_.size(); ++n) {
    for (const Cusum* c : {&edges_[n], &markers_[n]}) {
      if (c->value > highest) {
        highest = c->value;
        since = c->since;
      }
    }
  }
  const double alarm = std::log(2.0 * filter_->num_nodes() / options_.false_alarm_rate);
  double null = 0, runner_up = 0;
  Place place;
  const auto best = best_change(schema_, places, since, &null, &runner_up, &place);
  const bool accepted = best && best->log_evidence - null > options_.acceptance &&
                        best->num_usable >= best->change.fewest_samples();
  if ((accepted || highest > alarm) && !detected_) {
    detected_ = accepted ? place : places.front();
    AdaptationEvent mismatch = event(AdaptationEvent::Kind::kMismatch, sample_index, *detected_);
    mismatch.margin = highest;
    mismatch.num_samples = static_cast<int>(segment(since).size());
    events->push_back(mismatch);
  }
  if (!accepted) return;
  AdaptationEvent candidate =
      event(best->change.form == BodyChange::Form::kStored ? AdaptationEvent::Kind::kRestored
                                                           : AdaptationEvent::Kind::kCandidate,
            sample_index, place);
  candidate.cause = best->change.cause(schema_);
  candidate.margin = best->log_evidence - null;
  candidate.num_samples = static_cast<int>(segment(since).size());
  events->push_back(candidate);
  Provisional provisional;
  provisional.before = schema_;
  provisional.fitted = *best;
  provisional.place = place;
  provisional.since = since;
  provisional.num_samples = candidate.num_samples;
  // A second change on top of one that has not settled: the first is taken as it is.
  provisional_ = std::move(provisional);
  detected_.reset();
  install(provisional_->fitted.schema);
}

void Adaptation::refit(std::int64_t sample_index, std::vector<AdaptationEvent>* events) {
  Provisional& p = *provisional_;
  ++p.num_samples;
  if (p.num_samples >= options_.settled_after) {
    AdaptationEvent recovered = event(AdaptationEvent::Kind::kRecovered, sample_index, p.place);
    recovered.cause = p.fitted.change.cause(schema_);
    recovered.num_samples = p.num_samples;
    events->push_back(recovered);
    remember(schema_);
    provisional_.reset();
    return;
  }
  const bool all_forms =
      std::find(std::begin(kSettledRefits), std::end(kSettledRefits), p.num_samples) !=
      std::end(kSettledRefits);
  double null = 0, runner_up = 0;
  Place place = p.place;
  if (all_forms) {
    std::vector<Place> places{p.place};
    const auto best = best_change(p.before, places, p.since, &null, &runner_up, &place);
    if (!best) return;
    if (best->log_evidence < null) {
      events->push_back(event(AdaptationEvent::Kind::kReverted, sample_index, p.place));
      const BodySchema before = p.before;
      provisional_.reset();
      install(before);
      return;
    }
    if (best->change != p.fitted.change) {
      AdaptationEvent refined = event(AdaptationEvent::Kind::kRefined, sample_index, place);
      refined.cause = best->change.cause(p.before);
      refined.margin = best->log_evidence - null;
      refined.num_samples = p.num_samples;
      events->push_back(refined);
    }
    p.fitted = *best;
  } else if (p.fitted.change.form != BodyChange::Form::kStored) {
    const PlaceEvidence evidence(p.before, options_.noise, p.place.part, p.place.marker,
                                 segment(p.since));
    if (auto again = evidence.fit(p.fitted.change)) p.fitted = *again;
  }
  const std::vector<Cusum> edges = edges_, markers = markers_;
  install(p.fitted.schema);
  edges_ = edges;
  markers_ = markers;
}

void Adaptation::remember(const BodySchema& schema) {
  for (const BodySchema& stored : history_) {
    bool same = stored.X_CR.isApprox(schema.X_CR, 1e-9) && stored.edges.size() == schema.edges.size();
    for (std::size_t e = 0; same && e < schema.edges.size(); ++e)
      same = !differ(stored.edges[e], schema.edges[e]);
    if (same) return;
  }
  if (history_.size() > options_.history) history_.erase(history_.begin() + 1);
  history_.push_back(schema);
}

std::vector<AdaptationEvent> Adaptation::on_sample(const ActionPoseSample& sample) {
  std::vector<AdaptationEvent> events;
  recent_.push_back(sample);
  if (recent_.size() > kRing) recent_.pop_front();
  update_tests(filter_->prepare(sample), sample.sample_index);
  if (provisional_) refit(sample.sample_index, &events);
  try_changes(sample.sample_index, &events);
  if (detected_ && suspects().empty()) detected_.reset();
  return events;
}

}  // namespace bodyschema
