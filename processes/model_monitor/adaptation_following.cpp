// What Adaptation follows over many samples: drifts, changes too small for the CUSUMs, and edges
// that come and go.

#include <algorithm>
#include <cmath>
#include <limits>
#include <set>
#include <utility>

#include "common/estimation/chi_square.h"
#include "processes/model_monitor/adaptation.h"
#include "processes/model_monitor/changes/change_family.h"
#include "processes/model_monitor/changes/drift.h"

namespace bodyschema {
namespace {

/// Where an edge comes and goes no more, at most one reading in so many is an outlier.
constexpr std::size_t kEachOutlier = 10;
/// Samples before a mismatch that are looked at for the begin of a drift, and all of them.
constexpr std::int64_t kBeforeDrift = 30;
constexpr int kLongestDrift = 96;
/// Small changes nearer than this are one, and nearer than that a drift [samples].
constexpr std::int64_t kTogether = 12;
constexpr std::int64_t kSoon = 150;
/// What has not surely moved is looked at each so many samples, to bound the work.
constexpr std::int64_t kUnsureEach = 4;
/// Below it a rate is none.
const double kSignificantRate = chi_square_quantile(6, 0.01);
/// A drift has ended: so probable, and so many samples ago.
constexpr double kSurelyEnded = 0.999;
constexpr std::int64_t kEndedFor = 6;

}  // namespace

void Adaptation::watch_small_changes(std::int64_t sample_index,
                                     std::vector<AdaptationEvent>* events) {
  if (drifting_ || intermittent_ || !tracker_.was_adopted_at(sample_index)) return;
  const HypothesisTracker::Change& newest = tracker_.changes().back();
  if (!newest.what.fitted.change.small || newest.what.element.is_tag()) return;
  const int part = newest.what.element.id;
  const auto is_next = [this](int a, int b) {
    const Edge* edge = edge_to(schema_, a);
    return edge && edge->from == b;
  };
  // What is next to it may have been held to be the place.
  const bool again = last_small_ && sample_index - last_small_->second < kSoon &&
                     sample_index - last_small_->second > kTogether &&
                     (last_small_->first == part || is_next(part, last_small_->first) ||
                      is_next(last_small_->first, part));
  last_small_ = {part, sample_index};
  if (!again) return;
  // Small changes that have not settled were this drift as well.
  const std::vector<HypothesisTracker::Change>& changes = tracker_.changes();
  if (std::ranges::all_of(changes, [](const auto& c) { return c.what.fitted.change.small; }))
    tracker_.take_back_all(sample_index, events);
  else
    tracker_.keep_all();
  begin_drift(part, sample_index, sample_index, events);
}

void Adaptation::begin_drift(int part, std::int64_t since, std::int64_t sample_index,
                             std::vector<AdaptationEvent>* events) {
  drifting_ = part;
  tracker_.stop_fitting();
  before_ = tracker_.settled();
  num_still_ = 0;
  AdaptationEvent drift =
      tracker_.event(AdaptationEvent::Kind::kDrift, sample_index, edge_element(part, schema_.root));
  drift.cause = "drift";
  drift.since = since;
  events->push_back(drift);
}

void Adaptation::try_drift(std::int64_t sample_index, std::vector<AdaptationEvent>* events) {
  const std::vector<ElementId> elements = tracker_.suspects();
  if (drifting_ || intermittent_ || (tracker_.changes().empty() && !tracker_.detected()) ||
      elements.empty() || tracker_.was_adopted_at(sample_index))
    return;
  if (!is_worth_a_fit(sample_index - tracker_.tests().highest().cusum.since + 1)) return;
  const std::int64_t since = tracker_.trouble_since();
  const auto samples = tracker_.segment(since - kBeforeDrift, kLongestDrift);
  // When it began is no longer known.
  if (samples.empty() || samples.front()->sample_index > since) return;
  std::set<int> parts;
  const auto add_around = [&](int part) {
    for (const ElementId& element : elements_around(tracker_.filter(), part))
      if (!element.is_tag()) parts.insert(element.id);
  };
  for (const HypothesisTracker::Change& c : tracker_.changes()) add_around(c.what.element.id);
  add_around(elements.front().id);
  // Edges beside each other explain a bend nearly alike: until one leads, nothing is told.
  const BodySchema& before = tracker_.settled();
  std::optional<BegunDrift> best;
  double most = -std::numeric_limits<double>::infinity(), second = most;
  for (BegunDrift& drift :
       begun_drifts(before, measurement_, {parts.begin(), parts.end()}, samples, since)) {
    if (drift.gain < options_.acceptance) continue;
    const double evidence = drift.log_prior + drift.log_likelihood(before, measurement_, samples);
    second = std::max(second, std::min(most, evidence));
    if (evidence <= most) continue;
    most = evidence;
    best = std::move(drift);
  }
  if (!best || !best->is_good || most - second < options_.ambiguity) return;
  const double odds = most - log_likelihood(before, measurement_, samples);
  if (odds - tracker_.most_log_odds() < options_.acceptance) return;
  // All that was adopted since the trouble began was this drift.
  tracker_.take_back_all(sample_index, events);
  begin_drift(best->drift.part, best->begin + 1, sample_index, events);
  drift_watch_.look_again(before_, measurement_, *drifting_,
                          tracker_.segment(best->begin, kLongestDrift));
  tracker_.begin(best->drift.applied_to(before_), measurement_);
}

void Adaptation::watch_small_means(std::int64_t sample_index,
                                   std::vector<AdaptationEvent>* events) {
  if (tracker_.detected()) return;
  const auto moved = drift_watch_.moved(tracker_.schema());
  if (!moved) return;
  if (!moved->is_sure && sample_index % kUnsureEach != 0) return;
  const std::vector<ElementId> elements = elements_around(tracker_.filter(), moved->element.id);
  const auto step = tracker_.explain(elements, moved->since);
  // Steps and drifts are weighed on the same samples.
  const BodySchema& before = tracker_.settled();
  const auto samples = tracker_.segment(moved->since - kBeforeDrift, kLongestDrift);
  std::set<int> parts;
  for (const ElementId& element : elements)
    if (!element.is_tag()) parts.insert(element.id);
  std::optional<BegunDrift> drift;
  double drift_lead = -std::numeric_limits<double>::infinity();
  const double unchanged = log_likelihood(before, measurement_, samples);
  for (BegunDrift& begun :
       begun_drifts(before, measurement_, {parts.begin(), parts.end()}, samples, moved->since)) {
    const double lead =
        begun.log_prior + begun.log_likelihood(before, measurement_, samples) - unchanged;
    if (lead <= drift_lead) continue;
    drift_lead = lead;
    drift = std::move(begun);
  }
  const double step_lead = step ? step->lead : -std::numeric_limits<double>::infinity();
  // That the means moved speaks for a change already.
  const double needed = moved->is_sure ? 0 : options_.acceptance;
  const double over_drift = moved->is_sure ? 0 : options_.ambiguity;
  if (step_lead > needed && step_lead > drift_lead + over_drift) {
    tracker_.adopt(*step, sample_index, events);
  } else if (moved->is_sure && drift_lead >= step_lead) {
    // Likelihoods take the models' own errors for noise, means leave them out (before_): an edge
    // drifts where both say so, else more samples tell.
    if (drift && !moved->element.is_tag() && drift->drift.part != moved->element.id) return;
    if (drift)
      begin_drift(drift->drift.part, drift->begin + 1, sample_index, events);
    else
      begin_drift(moved->element.id, sample_index, sample_index, events);
  }
}

void Adaptation::begin_intermittence(const Alternations::Found& found, std::int64_t sample_index,
                                     std::vector<AdaptationEvent>* events) {
  tracker_.take_back_all(sample_index, events);
  tracker_.stop_fitting();
  before_ = tracker_.settled();
  intermittent_ = found.part;
  intermittent_since_ = sample_index;
  drift_watch_.look_again(before_, measurement_, found.part,
                          tracker_.segment(found.since, kLongestDrift));
  const Matrix6d spread = drift_watch_.spread(before_, found.part).second_moment;
  AdaptationEvent told = tracker_.event(AdaptationEvent::Kind::kDrift, sample_index,
                                        edge_element(found.part, schema_.root));
  told.cause = "intermittent";
  told.since = found.since;
  told.size = {.kind = ChangeSize::Kind::kPose,
               .amounts = {std::sqrt(spread.topLeftCorner<3, 3>().trace()),
                           std::sqrt(spread.bottomRightCorner<3, 3>().trace())},
               .sds = {-1, -1}};
  events->push_back(told);
}

void Adaptation::watch_alternations(std::int64_t sample_index,
                                    std::vector<AdaptationEvent>* events) {
  if (!intermittent_) {
    const auto found = alternations_.look(*events);
    if (!found || drifting_ || !edge_to(schema_, found->part)) return;
    begin_intermittence(*found, sample_index, events);
  }
  const auto is_at_it = [this](const HypothesisTracker::Change& c) {
    return !c.what.element.is_tag() && c.what.element.id == *intermittent_;
  };
  if (std::ranges::any_of(tracker_.changes(), is_at_it)) {
    intermittent_.reset();
    return;
  }
  if (!tracker_.changes().empty()) return;
  before_ = with_edge_of(tracker_.settled(), before_, *intermittent_);
  const DriftWatch::Spread spread = drift_watch_.spread(before_, *intermittent_);
  const std::size_t num_outliers = spread.size / kEachOutlier;
  const bool is_one =
      spread.num_off <= num_outliers || spread.num_off + num_outliers >= spread.size;
  if (is_one && sample_index - intermittent_since_ >= options_.settled_after) {
    AdaptationEvent over = tracker_.event(AdaptationEvent::Kind::kRecovered, sample_index,
                                          edge_element(*intermittent_, schema_.root));
    over.cause = "intermittent";
    over.num_samples = static_cast<int>(sample_index - intermittent_since_);
    events->push_back(over);
    intermittent_.reset();
    drift_watch_.forget_all();
    tracker_.begin(before_, measurement_);
    return;
  }
  const int link = static_cast<int>(edge_to(before_, *intermittent_)->joints.size());
  BodySchema loose = changed(before_, drift_step(before_, *intermittent_, link),
                             coordinates(Pose::Identity()), spread.second_moment);
  // Cut: neither of its states is evidence against the other.
  edge_at(&loose, *intermittent_).state = EdgeState::kInvalid;
  tracker_.follow(loose, *intermittent_);
}

void Adaptation::watch_drift(std::int64_t sample_index, std::vector<AdaptationEvent>* events) {
  if (intermittent_) return;
  if (!drifting_) watch_small_means(sample_index, events);
  if (!drifting_) return;
  const auto drift = drift_watch_.follow(before_, *drifting_);
  if (!drift) return;
  for (AdaptationEvent& event : *events)
    if (event.kind == AdaptationEvent::Kind::kDrift)
      event.size =
          size_of_rate(before_, *drifting_, drift->link, drift->rate, drift->rate_covariance);
  // What is suspected elsewhere meanwhile stays so.
  tracker_.follow(drift->applied_to(before_), *drifting_);
  num_still_ = drift->significance > kSignificantRate ? 0 : num_still_ + 1;
  if (num_still_ >= options_.settled_after) {
    end_drift(sample_index, *drift, sample_index, events);
  } else if (drift->has_ended > kSurelyEnded && sample_index - drift->last_moved >= kEndedFor) {
    // What goes on, only slower, is no end.
    DriftWatch since_then = drift_watch_;
    since_then.forget(*drifting_, drift->last_moved);
    const auto rest = since_then.follow(before_, *drifting_);
    if (rest && rest->significance < kSignificantRate)
      end_drift(drift->last_moved, *drift, sample_index, events);
  }
}

/// `since`: the first sample with the body as it is now; `sample_index` where that is not known.
void Adaptation::end_drift(std::int64_t since, const Drift& drift, std::int64_t sample_index,
                           std::vector<AdaptationEvent>* events) {
  AdaptationEvent recovered = tracker_.event(AdaptationEvent::Kind::kRecovered, sample_index,
                                             edge_element(*drifting_, schema_.root));
  recovered.cause = "drift";
  if (since < sample_index) recovered.since = since;
  recovered.num_samples =
      since < sample_index ? static_cast<int>(sample_index - since) : num_still_;
  events->push_back(recovered);
  // While it moved, the other elements were measured by a body that lagged behind.
  drift_watch_.forget_all();
  tags_.begin_anew();
  HypothesisTracker::Change there;
  there.what.element = edge_element(*drifting_, before_.root);
  there.what.fitted.change = drift_step(before_, *drifting_, drift.link);
  there.what.fitted.theta = coordinates(drift.T);
  there.what.fitted.covariance = drift.covariance;
  there.since = there.adopted = since;
  tracker_.remember(tracker_.settled());
  // What it is now is estimated from more samples as they come.
  if (since < sample_index) tracker_.go_on_fitting(before_, std::move(there));
  drifting_.reset();
}

}  // namespace bodyschema
