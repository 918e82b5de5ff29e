#include "processes/model_monitor/hypothesis_tracker.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "common/statistics/median.h"
#include "processes/model_monitor/schema_difference.h"

namespace bodyschema {
namespace {

using Kind = AdaptationEvent::Kind;

constexpr std::size_t kRing = 96;
constexpr std::size_t kBeam = 12;
constexpr int kRefits[] = {1, 2, 3, 4, 5, 7, 11, 19, 30};
constexpr int kUnsure = 5;
/// From so many samples on a form must lead another clearly.
constexpr int kManySamples = 8;
constexpr double kMedianChiSquare6 = 5.348;
constexpr double kLargestScale = 5;
constexpr std::size_t kFewestDistances = 20;
constexpr int kQuietSamples = 32;
constexpr double kClearLead = 1;
constexpr std::int64_t kLongestUnclear = 3;
/// What the settled body is off by from the start, a share of what a change explains.
constexpr double kSystematicShare = 0.03;
/// Newest samples that must be explained no worse.
constexpr std::int64_t kNewest = 5;
/// Samples without an explanation after which an edge is learned.
constexpr std::int64_t kUnexplained = 8;
constexpr int kWorkPerSample = 4;
constexpr int kMostWork = 1000;

bool is_in(int value, const auto& values) {
  return std::find(std::begin(values), std::end(values), value) != std::end(values);
}

bool is_worth_a_fit(std::int64_t age) {
  constexpr std::int64_t kAges[] = {10, 12, 15, 19, 24};
  return age <= 8 || age % 30 == 0 ||
         std::find(std::begin(kAges), std::end(kAges), age) != std::end(kAges);
}

bool is_worth_learning(std::int64_t age) {
  constexpr std::int64_t kAges[] = {8, 10, 13, 16, 20, 25, 32};
  return age % 40 == 0 || std::find(std::begin(kAges), std::end(kAges), age) != std::end(kAges);
}

bool is_same_explanation(const Replacement& a, const Replacement& b) {
  return a.place == b.place && a.fitted.change == b.fitted.change && a.also == b.also;
}

}  // namespace

const HypothesisTracker::Change* HypothesisTracker::last_at(const std::vector<Change>& changes,
                                                            const Place& place) {
  for (auto c = changes.rbegin(); c != changes.rend(); ++c)
    if (c->what.place == place) return &*c;
  return nullptr;
}

HypothesisTracker::HypothesisTracker(BodySchema schema, AdaptationOptions options)
    : options_(options),
      measurement_(options.measurement),
      settled_(std::move(schema)),
      credit_(kMostWork) {
  history_.push_back(settled_);
  settled_filter_ = std::make_shared<TreeFilter>(settled_, measurement_);
  beam_ = {{{}, settled_, settled_filter_, 0}};
  begin_tests(std::numeric_limits<std::int64_t>::max());
}

double HypothesisTracker::edge_statistic(int part) const {
  const int node = standing().filter->node_of(part);
  return node < 0 ? 0 : tests_->edge(node).value;
}

double HypothesisTracker::marker_statistic(int part) const {
  const int node = standing().filter->node_of(part);
  return node < 0 ? 0 : tests_->marker(node).value;
}

EdgeState HypothesisTracker::state_of(const Place& place) const {
  if (detected_ == place) return EdgeState::kInvalid;
  for (const Change& c : standing().changes)
    if (c.what.place == place ||
        std::find(c.what.also.begin(), c.what.also.end(), place) != c.what.also.end())
      return EdgeState::kProvisional;
  const double statistic = place.marker ? marker_statistic(place.part) : edge_statistic(place.part);
  return statistic > options_.suspicion ? EdgeState::kSuspect : EdgeState::kOk;
}

void HypothesisTracker::begin_tests(std::int64_t since) {
  tests_.emplace(*standing().filter, options_.false_alarm_rate,
                 std::numeric_limits<double>::infinity());
  for (const Seen& seen : recent_)
    if (seen.sample.sample_index >= since)
      tests_->update(*standing().filter, standing().filter->prepare(seen.sample),
                     seen.sample.sample_index);
}

std::vector<const ActionPoseSample*> HypothesisTracker::segment(std::int64_t since,
                                                                int longest) const {
  std::vector<const ActionPoseSample*> result;
  for (const Seen& seen : recent_)
    if (seen.sample.sample_index >= since) result.push_back(&seen.sample);
  if (result.size() > static_cast<std::size_t>(longest))
    result.erase(result.begin(), result.end() - longest);
  return result;
}

FoundChanges HypothesisTracker::search(const BodySchema& base, const std::vector<Place>& places,
                                       const std::vector<const ActionPoseSample*>& samples,
                                       const BodyChange* standing_form) {
  ChangeSearch search{measurement_, options_.ambiguity};
  if (standing_form) {
    search.standing_form = *standing_form;
    search.learn = standing_form->is_learned();
  }
  FoundChanges found = find_changes(base, history_, places, samples, search);
  credit_ -= found.work;
  return found;
}

BodySchema HypothesisTracker::composed(const std::vector<Change>& changes,
                                       std::size_t without) const {
  BodySchema schema = settled_;
  for (std::size_t n = 0; n < changes.size(); ++n)
    if (n != without && is_possible(changes[n].what.fitted, schema))
      schema = with_change(schema, changes[n].what.fitted);
  return schema;
}

HypothesisTracker::Hypothesis HypothesisTracker::made_of(std::vector<Change> changes) const {
  Hypothesis result;
  BodySchema schema = settled_;
  std::erase_if(changes, [&](const Change& c) {
    if (!is_possible(c.what.fitted, schema)) return true;
    schema = with_change(schema, c.what.fitted);
    return false;
  });
  result.changes = std::move(changes);
  result.body = std::move(schema);
  result.filter = std::make_shared<TreeFilter>(result.body, measurement_);
  return result;
}

double HypothesisTracker::log_odds_of(const std::vector<Change>& changes) const {
  double odds = 0;
  BodySchema body = settled_;
  for (std::size_t n = 0; n < changes.size(); ++n) {
    odds += changes[n].what.fitted.log_prior;
    if (is_possible(changes[n].what.fitted, body))
      body = with_certain_change(body, changes[n].what.fitted);
    const std::int64_t until = n + 1 < changes.size() ? changes[n + 1].since
                                                      : std::numeric_limits<std::int64_t>::max();
    const TreeFilter filter(body, measurement_);
    for (const Seen& seen : recent_)
      if (seen.sample.sample_index >= changes[n].since && seen.sample.sample_index < until)
        odds += filter.judge(filter.prepare(seen.sample)).log_likelihood - seen.settled;
  }
  return odds;
}

void HypothesisTracker::offer(Hypothesis hypothesis) {
  const auto is_it = [&](const Hypothesis& other) {
    return other.changes.size() == hypothesis.changes.size() &&
           std::equal(other.changes.begin(), other.changes.end(), hypothesis.changes.begin(),
                      [](const Change& a, const Change& b) {
                        return is_same_explanation(a.what, b.what) && a.since == b.since;
                      });
  };
  if (is_it(standing())) return;
  std::erase_if(beam_, is_it);
  beam_.push_back(std::move(hypothesis));
  if (beam_.size() <= kBeam) return;
  const auto least = std::min_element(
      beam_.begin() + 1, beam_.end(),
      [](const Hypothesis& a, const Hypothesis& b) {
        if (a.changes.empty() != b.changes.empty()) return b.changes.empty();
        return a.log_odds < b.log_odds;
      });
  beam_.erase(least);
}

void HypothesisTracker::propose_more(std::int64_t now) {
  const std::vector<Place> places = tests_->suspects(*standing().filter, options_.suspicion);
  if (places.empty() || credit_ <= 0) return;
  const std::int64_t since = tests_->highest().cusum.since;
  if (!is_worth_a_fit(now - since + 1)) return;
  const FoundChanges found =
      search(standing().body, places, segment(since, options_.longest_segment), nullptr);
  for (const auto* one : {&found.best, &found.runner_up}) {
    if (!*one) continue;
    std::vector<Change> changes = standing().changes;
    Change change{**one, since, now};
    // It takes the place of an earlier one there, which holds until then.
    const bool is_again = !change.what.place.marker && last_at(changes, change.what.place);
    if (is_again && !change.what.fitted.origin) change.what.fitted.origin = standing().body;
    changes.push_back(std::move(change));
    Hypothesis more = made_of(std::move(changes));
    more.log_odds = standing().log_odds + (*one)->fitted.log_evidence - found.null;
    if (more.log_odds < standing().log_odds - options_.ambiguity) continue;
    offer(std::move(more));
  }
}

void HypothesisTracker::propose_learned(std::int64_t now) {
  const std::vector<Place> places = tests_->suspects(*standing().filter, options_.suspicion);
  if (places.empty() || !(detected_ || now - last_mismatch_ < kUnexplained)) return;
  std::int64_t since = tests_->highest().cusum.since;
  for (const Change& c : standing().changes) since = std::min(since, c.since);
  if (!is_worth_learning(now - since + 1)) return;
  std::vector<int> parts;
  const auto add = [&](const Place& place) {
    const bool is_new = std::find(parts.begin(), parts.end(), place.part) == parts.end();
    if (!place.marker && edge_to(settled_, place.part) && is_new) parts.push_back(place.part);
  };
  for (const Change& c : standing().changes) add(c.what.place);
  add(places.front());
  const auto samples = segment(since, options_.longest_segment);
  for (const int part : parts) {
    std::vector<Change> others = standing().changes;
    std::erase_if(others, [part](const Change& c) { return c.what.place.part == part; });
    for (const bool alone : {true, false}) {
      if (!alone && others.empty()) continue;
      const std::vector<Change>& rest = alone ? std::vector<Change>{} : others;
      const BodySchema base = composed(rest, rest.size());
      const double before = log_odds_of(rest), null = log_likelihood(base, measurement_, samples);
      const PlaceEvidence evidence(base, measurement_, part, false, samples);
      for (FittedChange& learned : evidence.learn()) {
        const double odds = before + learned.log_evidence - null;
        std::vector<Change> changes = rest;
        changes.push_back({{{part, false}, std::move(learned)}, since, now});
        Hypothesis hypothesis = made_of(std::move(changes));
        hypothesis.log_odds = odds;
        const auto newest = segment(now - kNewest + 1, kNewest);
        if (log_likelihood(hypothesis.body, measurement_, newest) <
            log_likelihood(standing().body, measurement_, newest))
          continue;
        offer(std::move(hypothesis));
      }
    }
  }
}

HypothesisTracker::Hypothesis HypothesisTracker::fitted_again(Hypothesis hypothesis,
                                                              bool all_forms, int rounds,
                                                              std::int64_t now) {
  std::vector<Change> changes = hypothesis.changes;
  for (int round = 0; round < rounds; ++round) {
    bool is_changed = false;
    for (std::size_t n = 0; n < changes.size();) {
      Change& c = changes[n];
      if (now - c.adopted > options_.settled_after || last_at(changes, c.what.place) != &c) {
        ++n;
        continue;
      }
      const BodySchema others = composed(changes, n);
      const auto samples = segment(c.since, options_.longest_segment);
      FittedChange& fitted = c.what.fitted;
      if (!all_forms) {
        if (fitted.change.size() > 0 && is_possible(fitted, others)) {
          const BodySchema base =
              fitted.origin ? with_edge_of(others, *fitted.origin, c.what.place.part) : others;
          const PlaceEvidence evidence(base, measurement_, c.what.place.part, c.what.place.marker,
                                       samples);
          if (auto again = evidence.fit(fitted.change)) {
            again->origin = fitted.origin;
            again->certain = fitted.certain;
            fitted = *again;
          }
        }
        ++n;
        continue;
      }
      const bool is_young = now - c.adopted <= kUnsure && c.what.also.empty() &&
                            !fitted.everywhere && !fitted.change.is_learned();
      FoundChanges found = search(others, {c.what.place}, samples, &fitted.change);
      if (is_young && changes.size() == 1) {
        std::vector<Place> around = places_around(*hypothesis.filter, c.what.place.part);
        std::erase(around, c.what.place);
        FoundChanges there = search(others, around, samples, nullptr);
        if (there.best &&
            (!found.best || there.best->fitted.log_evidence >
                                found.best->fitted.log_evidence + options_.acceptance))
          found = std::move(there);
      }
      if (!found.best || found.margin() < 0) {
        changes.erase(changes.begin() + static_cast<std::ptrdiff_t>(n));
        is_changed = true;
        continue;
      }
      is_changed |= !is_same_explanation(*found.best, c.what);
      if (found.runner_up && changes.size() == 1) {
        Hypothesis rival = made_of({{*found.runner_up, c.since, c.adopted}});
        rival.log_odds = found.runner_up->fitted.log_evidence - found.null;
        offer(std::move(rival));
      }
      c.what = *found.best;
      ++n;
    }
    if (!is_changed) break;
  }
  Hypothesis result = made_of(std::move(changes));
  result.log_odds = log_odds_of(result.changes);
  return result;
}

double HypothesisTracker::needed_lead(const Hypothesis& other) const {
  const auto has_place = [](const Hypothesis& h, const Place& place) {
    return std::any_of(h.changes.begin(), h.changes.end(),
                       [&](const Change& c) { return c.what.place == place; });
  };
  const double systematic = kSystematicShare * std::max(0.0, standing().log_odds);
  if (other.changes.size() > standing().changes.size()) return options_.acceptance;
  for (const Change& c : other.changes) {
    const bool is_learned_anew =
        c.what.fitted.change.is_learned() &&
        std::none_of(standing().changes.begin(), standing().changes.end(),
                     [](const Change& s) { return s.what.fitted.change.is_learned(); });
    if (is_learned_anew || !has_place(standing(), c.what.place))
      return options_.acceptance + systematic;
  }
  if (other.changes.size() < standing().changes.size()) return 0;
  return options_.ambiguity + systematic;
}

void HypothesisTracker::choose(std::int64_t now, std::vector<AdaptationEvent>* events) {
  // Whoever seems to lead is fitted to all its samples before it stands.
  std::optional<Hypothesis> next;
  for (Hypothesis rival : std::vector<Hypothesis>(beam_.begin() + 1, beam_.end())) {
    if (rival.log_odds - standing().log_odds <= needed_lead(rival)) continue;
    if (next && rival.log_odds <= next->log_odds) continue;
    if (!rival.changes.empty())
      rival = fitted_again(rival, rival.changes.size() > 1, rival.changes.size() > 1 ? 3 : 1, now);
    const bool is_leading = rival.log_odds - standing().log_odds > needed_lead(rival);
    if (is_leading && (!next || rival.log_odds > next->log_odds))
      next = std::move(rival);
    else
      offer(std::move(rival));
  }
  if (next) stand(std::move(*next), now, events);
}

AdaptationEvent HypothesisTracker::event(Kind kind, std::int64_t sample, const Place& place) const {
  AdaptationEvent result;
  result.kind = kind;
  result.sample_index = sample;
  const Edge* edge = edge_to(settled_, place.part);
  if (place.marker || !edge) {
    result.part = place.part;
  } else {
    result.from = edge->from;
    result.to = edge->to;
  }
  return result;
}

void HypothesisTracker::tell(Kind kind, std::int64_t sample, const Change& change, double margin,
                             std::vector<AdaptationEvent>* events) const {
  std::vector<Place> places{change.what.place};
  places.insert(places.end(), change.what.also.begin(), change.what.also.end());
  for (const Place& place : places) {
    AdaptationEvent told = event(kind, sample, place);
    BodyChange there = change.what.fitted.change;
    there.part = place.part;
    told.cause = there.cause(settled_);
    told.margin = margin;
    told.since = change.since;
    events->push_back(std::move(told));
  }
}

void HypothesisTracker::tell_difference(const Hypothesis& before, const Hypothesis& after,
                                        std::int64_t sample,
                                        std::vector<AdaptationEvent>* events) const {
  const auto at = [](const Hypothesis& h, const Place& place) {
    return last_at(h.changes, place);
  };
  const double margin = after.log_odds - before.log_odds;
  bool is_moved = false;
  for (const Change& c : before.changes)
    if (at(before, c.what.place) == &c && !at(after, c.what.place)) {
      tell(Kind::kReverted, sample, c, margin, events);
      is_moved = true;
    }
  for (const Change& c : after.changes) {
    if (at(after, c.what.place) != &c) continue;
    const Change* old = at(before, c.what.place);
    if (old && is_same_explanation(old->what, c.what)) continue;
    const bool is_stored = c.what.fitted.change.form == BodyChange::Form::kStored;
    tell(old || is_moved ? Kind::kRefined : is_stored ? Kind::kRestored : Kind::kCandidate, sample,
         c, margin, events);
  }
}

void HypothesisTracker::stand(Hypothesis next, std::int64_t now,
                              std::vector<AdaptationEvent>* events) {
  if (next.changes.size() > standing().changes.size() && !(detected_ && is_told_)) {
    AdaptationEvent mismatch = event(Kind::kMismatch, now, next.changes.back().what.place);
    mismatch.since = next.changes.back().since;
    last_mismatch_ = now;
    events->push_back(mismatch);
  }
  tell_difference(standing(), next, now, events);
  std::int64_t since = std::numeric_limits<std::int64_t>::max();
  for (const Change& c : next.changes) since = std::min(since, c.since);
  for (const Change& c : standing().changes) since = std::min(since, c.since);
  const Hypothesis old = standing();
  beam_.front() = std::move(next);
  offer(old);
  detected_.reset();
  begin_tests(since);
}

void HypothesisTracker::propose_again(std::int64_t now, std::vector<AdaptationEvent>* events) {
  if (standing().changes.empty()) return;
  std::int64_t newest = 0;
  for (const Change& c : standing().changes) newest = std::max(newest, c.adopted);
  const int age = static_cast<int>(now - newest);
  if (age == 0) return;
  beam_.front() = fitted_again(standing(), false, 1, now);
  if (credit_ <= 0 || !is_in(age, kRefits)) return;
  Hypothesis again =
      fitted_again(standing(), true, standing().changes.size() > 1 ? 3 : 1, now);
  const double lead = again.log_odds - standing().log_odds;
  if (lead <= (age < kManySamples ? 0 : needed_lead(again)))
    offer(std::move(again));
  else
    stand(std::move(again), now, events);
}

void HypothesisTracker::detect(std::int64_t now, std::vector<AdaptationEvent>* events) {
  const std::vector<Place> places = tests_->suspects(*standing().filter, options_.suspicion);
  if (detected_ && places.empty()) {
    if (is_told_) {
      events->push_back(event(Kind::kRecovered, now, *detected_));
      events->back().cause = "unexplained";
    }
    detected_.reset();
    return;
  }
  if (places.empty()) return;
  const auto [cusum, second] = tests_->highest();
  if (cusum.value <= tests_->alarm() || (detected_ && is_told_)) return;
  const bool is_rising = !detected_ || cusum.value > std::min(untold_, tests_->ceiling());
  const bool is_clear = is_rising && (cusum.value - second > kClearLead ||
                                      now - cusum.since >= kLongestUnclear);
  detected_ = places.front();
  is_told_ = is_clear;
  untold_ = cusum.value;
  if (!is_clear) return;
  AdaptationEvent mismatch = event(Kind::kMismatch, now, *detected_);
  mismatch.since = cusum.since;
  mismatch.margin = cusum.value;
  last_mismatch_ = now;
  events->push_back(mismatch);
}

void HypothesisTracker::settle(std::int64_t now, std::vector<AdaptationEvent>* events) {
  // A change more is pursued while something is suspected: what a model is off by from the start
  // adds up to evidence of a change, too.
  if (tests_->suspects(*standing().filter, options_.suspicion).empty()) {
    const std::size_t most = standing().changes.size();
    std::erase_if(beam_, [most](const Hypothesis& h) { return h.changes.size() > most; });
  }
  if (standing().changes.empty()) return;
  std::int64_t newest = 0;
  for (const Change& c : standing().changes) newest = std::max(newest, c.adopted);
  if (now - newest < options_.settled_after) return;
  for (const Change& c : standing().changes)
    if (last_at(standing().changes, c.what.place) == &c)
      tell(Kind::kRecovered, now, c, 0, events);
  settled_ = standing().body;
  settled_filter_ = standing().filter;
  remember(settled_);
  beam_ = {{{}, settled_, settled_filter_, 0}};
  for (Seen& seen : recent_)
    seen.settled = settled_filter_->judge(settled_filter_->prepare(seen.sample)).log_likelihood;
}

void HypothesisTracker::remember(const BodySchema& schema) {
  const auto alike = std::find_if(history_.begin(), history_.end(), [&](const BodySchema& stored) {
    return is_alike(stored, schema);
  });
  if (alike != history_.end()) {
    if (alike == history_.begin()) return;
    history_.erase(alike);
  }
  if (history_.size() > options_.history) history_.erase(history_.begin() + 1);
  history_.push_back(schema);
}

void HypothesisTracker::calibrate() {
  for (int round = 0; round < 4; ++round) {
    std::vector<double> distances;
    const TreeFilter filter(settled_, measurement_);
    for (const Seen& seen : recent_) {
      const TreeFilter::Judgement judgement = filter.judge(filter.prepare(seen.sample));
      for (const double d2 : judgement.squared_distance)
        if (d2 >= 0) distances.push_back(d2);
    }
    if (distances.size() < kFewestDistances) return;
    const double scale = std::sqrt(upper_median(distances) / kMedianChiSquare6);
    measurement_.scale =
        std::clamp(measurement_.scale * scale, options_.least_noise_scale, kLargestScale);
  }
  if (std::abs(std::log(measurement_.scale)) < 0.15)
    measurement_.scale = options_.measurement.scale;
}

void HypothesisTracker::watch_noise(const TreeFilter::Judgement& judgement) {
  for (std::size_t n = 0; n < judgement.believed.size(); ++n)
    if (judgement.believed[n] == 1) quiet_distances_.push_back(judgement.squared_distance[n]);
  if (++num_quiet_ < kQuietSamples || quiet_distances_.size() < kFewestDistances) return;
  const double scale = std::sqrt(upper_median(quiet_distances_) / kMedianChiSquare6);
  quiet_distances_.clear();
  num_quiet_ = 0;
  if (std::abs(std::log(scale)) < 0.05) return;
  measurement_.scale =
      std::clamp(measurement_.scale * std::sqrt(scale), options_.least_noise_scale, kLargestScale);
  settled_filter_ = std::make_shared<TreeFilter>(settled_, measurement_);
  beam_ = {{{}, settled_, settled_filter_, 0}};
  begin_tests(std::numeric_limits<std::int64_t>::max());
}

std::vector<AdaptationEvent> HypothesisTracker::on_sample(const ActionPoseSample& sample) {
  std::vector<AdaptationEvent> events;
  credit_ = std::min(credit_ + kWorkPerSample, kMostWork);
  const std::int64_t now = sample.sample_index;
  const auto judge = [&](const TreeFilter& filter) {
    return filter.judge(filter.prepare(sample)).log_likelihood;
  };
  recent_.push_back({sample, judge(*settled_filter_)});
  if (recent_.size() > kRing) recent_.pop_front();
  if (++num_samples_ <= options_.calibration_samples) {
    if (num_samples_ == options_.calibration_samples) {
      calibrate();
      settled_filter_ = std::make_shared<TreeFilter>(settled_, measurement_);
      for (Seen& seen : recent_)
        seen.settled = settled_filter_->judge(settled_filter_->prepare(seen.sample)).log_likelihood;
      beam_ = {{{}, settled_, settled_filter_, 0}};
      begin_tests(std::numeric_limits<std::int64_t>::max());
    }
    return events;
  }
  for (Hypothesis& h : beam_)
    if (!h.changes.empty()) h.log_odds += judge(*h.filter) - recent_.back().settled;
  const TreeFilter::Judgement judgement =
      tests_->update(*standing().filter, standing().filter->prepare(sample), now);
  propose_again(now, &events);
  propose_more(now);
  propose_learned(now);
  choose(now, &events);
  detect(now, &events);
  settle(now, &events);
  if (standing().changes.empty() && !detected_ &&
      tests_->suspects(*standing().filter, options_.suspicion).empty())
    watch_noise(judgement);
  return events;
}

}  // namespace bodyschema
