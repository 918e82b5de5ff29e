#include "processes/model_monitor/adaptation.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <set>
#include <stdexcept>
#include <utility>

#include "common/estimation/chi_square.h"
#include "common/estimation/quantile.h"
#include "common/geometry/angle.h"
#include "processes/model_monitor/changes/change_family.h"
#include "processes/model_monitor/changes/drift.h"
#include "processes/model_monitor/hypotheses/schema_difference.h"
#include "processes/model_monitor/likelihood/reading_distance.h"

namespace bodyschema {
namespace {

/// Where an edge comes and goes no more, at most one reading in so many is an outlier.
constexpr std::size_t kEachOutlier = 10;
/// In a stream a marker that is read farther than this from where it should be is turned over.
constexpr double kTurnedOver_rad = 120 * kDegree;
/// Samples before a mismatch that are looked at for the begin of a drift, and all of them.
constexpr std::int64_t kBeforeDrift = 30;
constexpr int kLongestDrift = 96;
/// Small changes nearer than this are one, and nearer than that a drift [samples].
constexpr std::int64_t kTogether = 12;
constexpr std::int64_t kSoon = 150;
/// Outliers are counted over about so many readings, and expected a little more often; a told rate
/// weighs like so many of them.
constexpr double kFading = 0.998;
constexpr double kPriorReadings = 100;
constexpr double kMoreOutliers = 1.2, kMostOutliers = 0.35;
/// Rates and worths nearer than this are the same [log].
constexpr double kSameNoise = 0.15;
constexpr int kUpdateEach = 8;
/// What may have moved and has not surely is looked at each so many samples.
constexpr std::int64_t kUnsureEach = 4;
/// Below it a rate is none.
const double kSignificantRate = chi_square_quantile(6, 0.01);
/// A drift has ended: so probable, and so many samples ago.
constexpr double kSurelyEnded = 0.999;
constexpr std::int64_t kEndedFor = 6;
constexpr double kLargestScale = 5;
constexpr std::size_t kFewestDistances = 20;
/// Quiet samples after which the noise is looked at again.
constexpr int kQuietSamples = 32;

/// What two fits of one edge to tags may differ by, anywhere in its range: a body of the history
/// that is as near to the first is the first, learned again. Chosen: an order of magnitude above
/// the residuals of rendered tags (0.3 mm, 0.1°), below any fault of the experiments.
constexpr Noise kSameBody{0.005, 1 * kDegree};

void check(const ActionPoseSample& sample, const BodySchema& schema) {
  if (!schema.displacements(sample.action).allFinite())
    throw std::invalid_argument("sample " + std::to_string(sample.sample_index) +
                                ": the action is not finite");
  for (const auto* observations : {&sample.parts, &sample.contradictions})
    for (const PartObservation& o : *observations)
      if (!o.X_CB.matrix().allFinite() || !o.covariance.allFinite() ||
          (o.X_CB_other && !o.X_CB_other->matrix().allFinite()))
        throw std::invalid_argument("sample " + std::to_string(sample.sample_index) + ", part " +
                                    std::to_string(o.part) + ": the pose is not finite");
}

/// Of the tags of a part that contradict each other it believes the one that is nearest to where
/// the schema has the part, if no two agree.
void believe_nearest(const BodySchema& schema, const MeasurementModel& measurement,
                     ActionPoseSample* sample) {
  if (sample->contradictions.empty()) return;
  const auto X_RB = schema.predict_all(sample->action);
  std::map<int, std::pair<double, const PartObservation*>> nearest;
  for (const PartObservation& o : sample->contradictions) {
    const auto expected = X_RB.find(o.part);
    if (sample->find(o.part) || expected == X_RB.end()) continue;
    const Pose X_CB = schema.X_CR * expected->second;
    const auto seen = measurement.reading(o, X_CB);
    const double d2 = ReadingDistance(seen.covariance)(X_CB, seen.X_CB);
    const auto [known, is_new] = nearest.try_emplace(o.part, d2, &o);
    if (!is_new && d2 < known->second.first) known->second = {d2, &o};
  }
  for (const auto& [part, of_part] : nearest) sample->parts.push_back(*of_part.second);
  std::sort(sample->parts.begin(), sample->parts.end(),
            [](const PartObservation& a, const PartObservation& b) { return a.part < b.part; });
}

}  // namespace

Adaptation::Adaptation(BodySchema schema, AdaptationOptions options)
    : is_soft_(std::any_of(schema.edges.begin(), schema.edges.end(),
                           [](const Edge& edge) { return edge.residual_gp != nullptr; })),
      options_([&] {
        if (is_soft_) options.least_noise_scale = std::max(options.least_noise_scale, 1.0);
        return options;
      }()),
      measurement_(options.measurement),
      tracker_(schema, measurement_, options_, is_soft_),
      visibility_(options.false_alarm_rate),
      tags_(schema.moved_tags),
      moved_tags_(schema.moved_tags),
      schema_(std::move(schema)),
      drift_watch_(options.false_alarm_rate) {}

Adaptation::Adaptation(BodySchema schema, AdaptationOptions options,
                       std::vector<BodySchema> history, const std::vector<ActionPoseSample>& past)
    : Adaptation(std::move(schema), options) {
  num_samples_ = options_.calibration_samples;
  std::vector<ActionPoseSample> tests;
  for (const ActionPoseSample& sample : past) {
    if (stream_.repeats(sample, schema_.signals)) continue;
    visibility_.look(schema_.parts, sample, sample, tags_);
    tags_.look_back(sample, schema_, measurement_);
    if (sample.purpose != Purpose::kTest) continue;
    tests.push_back(sample);
    drop_moved_tags(moved_tags_, &tests.back());
  }
  if (tests.size() > kLongestDrift) tests.erase(tests.begin(), tests.end() - kLongestDrift);
  visibility_.tell_tags_again();  // news of them is for the next sample
  calibrate(tests);
  if (!history.empty()) tracker_.set_history(std::move(history));
}

EdgeState Adaptation::state_of(const ElementId& element) const {
  if (tracker_.detected() == element) return EdgeState::kInvalid;
  for (const HypothesisTracker::Change& c : tracker_.changes()) {
    const std::vector<ElementId>& also = c.what.also;
    if (c.what.element == element || std::find(also.begin(), also.end(), element) != also.end())
      return EdgeState::kProvisional;
  }
  if (!element.is_tag() && is_followed(element.id)) return EdgeState::kProvisional;
  const double statistic =
      element.is_tag() ? marker_statistic(element.id) : edge_statistic(element.id);
  return statistic > options_.suspicion ? EdgeState::kSuspect : EdgeState::kOk;
}

double Adaptation::edge_statistic(int part) const {
  const int node = tracker_.filter().node_of(part);
  return node < 0 ? 0 : tracker_.tests().edge(node).value;
}

double Adaptation::marker_statistic(int part) const {
  const int node = tracker_.filter().node_of(part);
  return node < 0 ? 0 : tracker_.tests().marker(node).value;
}

std::int64_t Adaptation::since() const {
  std::int64_t newest = 0;
  for (const HypothesisTracker::Change& c : tracker_.changes()) newest = std::max(newest, c.since);
  return stream_.sample_index_of(newest);
}

void Adaptation::set_noise_scale(double scale) {
  measurement_.scale = std::clamp(scale, options_.least_noise_scale, kLargestScale);
}

void Adaptation::calibrate(const std::vector<ActionPoseSample>& samples) {
  // The filter's own beliefs depend on the scale: a few rounds.
  for (int round = 0; round < 4; ++round) {
    std::vector<double> distances;
    const TreeFilter filter(schema_, measurement_);
    for (const ActionPoseSample& sample : samples) {
      const TreeFilter::Judgement judgement = filter.judge(filter.prepare(sample));
      for (const double d2 : judgement.squared_distance)
        if (d2 >= 0) distances.push_back(d2);
    }
    if (distances.size() < kFewestDistances) break;
    set_noise_scale(measurement_.scale * std::sqrt(upper_median(distances) / chi_square_median(6)));
    // A few samples tell no better than this.
    if (round == 3 && std::abs(std::log(measurement_.scale)) < 0.15)
      measurement_.scale = options_.measurement.scale;
  }
  tracker_.begin(BodySchema(tracker_.settled()), measurement_);
}

void Adaptation::watch_noise(const TreeFilter::Judgement& judgement) {
  for (std::size_t n = 0; n < judgement.believed.size(); ++n)
    if (judgement.believed[n] == 1) quiet_distances_.push_back(judgement.squared_distance[n]);
  if (++num_quiet_ < kQuietSamples || quiet_distances_.size() < kFewestDistances) return;
  const double scale = std::sqrt(upper_median(quiet_distances_) / chi_square_median(6));
  quiet_distances_.clear();
  num_quiet_ = 0;
  if (std::abs(std::log(scale)) < 0.05) return;
  set_noise_scale(measurement_.scale * std::sqrt(scale));
  tracker_.begin(BodySchema(tracker_.settled()), measurement_);
}

void Adaptation::count_outliers(const TreeFilter::Judgement& judgement) {
  for (const int believed : judgement.believed) {
    if (believed < 0) continue;
    num_read_ = kFading * num_read_ + 1;
    num_outliers_ = kFading * num_outliers_ + (believed == 0);
  }
}

void Adaptation::update_measurement() {
  const double told = options_.measurement.outlier_rate;
  const double seen = (kPriorReadings * told + num_outliers_) / (kPriorReadings + num_read_);
  const double rate = std::clamp(kMoreOutliers * seen, told, kMostOutliers);
  const double worth = drift_watch_.worth().value_or(1);
  if (std::abs(std::log(rate / measurement_.outlier_rate)) < kSameNoise &&
      std::abs(std::log(worth / measurement_.worth)) < kSameNoise)
    return;
  measurement_.outlier_rate = rate;
  measurement_.worth = worth;
  tracker_.begin(BodySchema(tracker_.settled()), measurement_);
}

void Adaptation::complete(std::int64_t sample_index, AdaptationEvent* event) const {
  using Kind = AdaptationEvent::Kind;
  event->sample_index = sample_index;
  if (event->since >= 0) event->since = stream_.sample_index_of(event->since);
  const bool may_be_normal = event->kind == Kind::kRestored || event->kind == Kind::kRefined ||
                             (event->kind == Kind::kRecovered &&
                              (event->cause == "stored" || event->cause == "camera_moved"));
  if (!may_be_normal) return;
  const int part = event->to >= 0 ? event->to : event->part;
  const BodySchema& first = history().front();
  event->is_normal =
      event->tag >= 0 || is_alike_at(schema_, first, part) ||
      (event->kind != Kind::kRefined && is_close_at(schema_, first, part, kSameBody));
}

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
  if (std::all_of(changes.begin(), changes.end(),
                  [](const auto& c) { return c.what.fitted.change.small; }))
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
  for (BegunDrift& begun :
       begun_drifts(before, measurement_, {parts.begin(), parts.end()}, samples, moved->since)) {
    const double lead = begun.log_prior + begun.log_likelihood(before, measurement_, samples) -
                        log_likelihood(before, measurement_, samples);
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
    begin_drift(drift ? drift->drift.part : moved->element.id, sample_index, sample_index, events);
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
  if (std::any_of(tracker_.changes().begin(), tracker_.changes().end(), is_at_it)) {
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

void Adaptation::watch_visibility(const ActionPoseSample& sample, const ActionPoseSample& used,
                                  std::vector<AdaptationEvent>* events) {
  for (const auto& finding : visibility_.look(schema_.parts, sample, used, tags_)) {
    const auto [part, tag, is_missing, num_missed] = finding;
    AdaptationEvent told = tracker_.event(
        is_missing ? AdaptationEvent::Kind::kMissing : AdaptationEvent::Kind::kRecovered,
        sample.sample_index, tag_element(part));
    told.tag = tag;
    told.cause = "marker_missing";
    told.num_samples = num_missed;
    if (is_missing) told.since = std::max<std::int64_t>(0, sample.sample_index - num_missed + 1);
    events->push_back(std::move(told));
    if (!is_missing || tag == VisibilityWatch::kAnyTag) continue;
    tags_.lose(tag);
    set_aside(tag, sample.sample_index - num_missed + 1, sample.sample_index);
  }
}

/// From sample `since` on, as is known at sample `found`.
void Adaptation::set_aside(int tag, std::int64_t since, std::int64_t found) {
  if (moved_tags_.size() == BodySchema::kMaxMovedTags) moved_tags_.erase(moved_tags_.begin());
  moved_tags_.push_back({tag, stream_.sample_index_of(found), stream_.sample_index_of(since)});
}

void Adaptation::watch_tags(ActionPoseSample* sample, std::vector<AdaptationEvent>* events) {
  if (num_samples_ >= options_.calibration_samples) {
    for (const MovedTags::Finding& finding :
         tags_.look(*sample, tracker_.settled(), schema_, measurement_)) {
      using Kind = AdaptationEvent::Kind;
      const Kind kind = finding.is_back ? (finding.is_on_part ? Kind::kRestored : Kind::kRecovered)
                                        : (finding.is_on_part ? Kind::kCandidate : Kind::kMissing);
      AdaptationEvent told = tracker_.event(kind, sample->sample_index, tag_element(finding.part));
      told.tag = finding.tag;
      told.cause = finding.is_on_part ? "marker_moved" : "marker_missing";
      told.num_samples = finding.num_sightings;
      if (!finding.is_back) told.since = finding.since;
      events->push_back(std::move(told));
      if (finding.is_back) {
        for (MovedTag& moved : moved_tags_)
          if (moved.tag == finding.tag && moved.until < 0)
            moved.until = stream_.sample_index_of(sample->sample_index);
        visibility_.forget(finding.part, finding.tag);
      } else {
        set_aside(finding.tag, finding.since, sample->sample_index);
        take_back(finding, sample->sample_index, events);
      }
    }
  }
  sample->leave_out([this](int tag) { return tags_.has_moved(tag); });
  believe_nearest(schema_, measurement_, sample);
}

/// What a moved tag was taken for meanwhile.
void Adaptation::take_back(const MovedTags::Finding& moved, std::int64_t sample_index,
                           std::vector<AdaptationEvent>* events) {
  const auto is_at_it = [&](const ElementId& element) {
    if (element.id == moved.part) return true;
    const Edge* edge = edge_to(schema_, element.id);
    return !element.is_tag() && edge && edge->from == moved.part;
  };
  const auto clean = [&](ActionPoseSample* sample) {
    sample->leave_out([&](int tag) { return tag == moved.tag; });
  };
  tracker_.take_back(is_at_it, moved.since, clean, sample_index, events);
}

// A flip stays for many frames, longer than a block. It says nothing of where the part is.
void Adaptation::drop_turned_over(ActionPoseSample* sample) const {
  const auto X_RB = schema_.predict_all(sample->action);
  std::erase_if(sample->parts, [&](const PartObservation& o) {
    const auto expected = X_RB.find(o.part);
    return o.has_rotation && expected != X_RB.end() &&
           rotation_angle((schema_.X_CR * expected->second).inverse() * o.X_CB) > kTurnedOver_rad;
  });
}

void Adaptation::drop_fallen(ActionPoseSample* sample, std::vector<AdaptationEvent>* events) {
  for (const auto& [part, X_RB] : schema_.predict_all(sample->action)) {
    const auto since = fallen_.look(*sample, part, schema_.X_CR * X_RB, measurement_);
    if (!since) continue;
    int num_missed = 0;
    const auto drop = [&, part = part](ActionPoseSample* from) {
      const auto is_of_it = [part](const PartObservation& o) { return o.part == part; };
      std::erase_if(from->parts, is_of_it);
      std::erase_if(from->contradictions, is_of_it);
      ++num_missed;
    };
    drop(sample);
    if (visibility_.is_missing(part)) continue;
    num_missed = 0;
    AdaptationEvent missing =
        tracker_.event(AdaptationEvent::Kind::kMissing, sample->sample_index, tag_element(part));
    missing.cause = "marker_missing";
    missing.since = *since;
    // What it was taken for meanwhile is taken back.
    const auto is_at_it = [this, part = part](const ElementId& element) {
      return element.id == part && (element.is_tag() || part != schema_.root);
    };
    std::vector<AdaptationEvent> taken_back;
    tracker_.take_back(is_at_it, *since, drop, sample->sample_index, &taken_back);
    missing.num_samples = visibility_.lose(part, num_missed) + 1;
    events->push_back(missing);
    events->insert(events->end(), taken_back.begin(), taken_back.end());
  }
}

std::vector<AdaptationEvent> Adaptation::on_sample(const ActionPoseSample& seen) {
  check(seen, schema_);
  if (stream_.repeats(seen, schema_.signals)) return {};
  ActionPoseSample sample = seen;
  sample.sample_index = stream_.count();
  if (stream_.is_dense()) drop_turned_over(&sample);
  std::vector<AdaptationEvent> events = on_new_sample(std::move(sample));
  for (AdaptationEvent& event : events) complete(seen.sample_index, &event);
  return events;
}

std::vector<AdaptationEvent> Adaptation::on_new_sample(ActionPoseSample sample) {
  std::vector<AdaptationEvent> events;
  const ActionPoseSample seen = sample;
  watch_tags(&sample, &events);
  if (num_samples_ >= options_.calibration_samples) drop_fallen(&sample, &events);
  watch_visibility(seen, sample, &events);
  const TreeFilter::Instant instant = tracker_.filter().prepare(sample);
  drift_watch_.add(tracker_.filter(), instant, tracker_.schema(),
                   schema_.displacements(sample.action), sample.sample_index);
  if (++num_samples_ <= options_.calibration_samples) {
    tracker_.add_silently(sample);
    if (num_samples_ == options_.calibration_samples) calibrate(tracker_.recent());
    schema_.moved_tags = moved_tags_;
    return events;
  }
  const TreeFilter::Judgement judgement = tracker_.on_sample(sample, &events);
  watch_alternations(sample.sample_index, &events);
  watch_small_changes(sample.sample_index, &events);
  try_drift(sample.sample_index, &events);
  // A body that moves otherwise shows other sides of its parts.
  const auto is_change = [](const AdaptationEvent& e) {
    return e.tag < 0 && (e.kind == AdaptationEvent::Kind::kCandidate ||
                         e.kind == AdaptationEvent::Kind::kRestored);
  };
  if (std::any_of(events.begin(), events.end(), is_change)) visibility_.forget_tags();
  if (tracker_.changes().empty()) {
    const auto has_settled = [](const AdaptationEvent& e) {
      return e.kind == AdaptationEvent::Kind::kRecovered && e.tag < 0 &&
             e.cause != "marker_missing" && e.cause != "unexplained";
    };
    if (std::any_of(events.begin(), events.end(), has_settled)) tags_.begin_anew();
    watch_drift(sample.sample_index, &events);
  } else {
    drifting_.reset();
    for (const HypothesisTracker::Change& c : tracker_.changes())
      if (!c.what.fitted.change.small) drift_watch_.forget_all();
  }
  if (is_settled()) {
    count_outliers(judgement);
    if (tracker_.suspects().empty()) watch_noise(judgement);
    if (num_samples_ % kUpdateEach == 0) update_measurement();
  }
  const auto is_reverted = [](const AdaptationEvent& e) {
    return e.kind == AdaptationEvent::Kind::kReverted;
  };
  if (std::any_of(events.begin(), events.end(), is_reverted)) drift_watch_.forget_all();
  schema_ = tracker_.schema();
  schema_.moved_tags = moved_tags_;
  return events;
}

}  // namespace bodyschema
