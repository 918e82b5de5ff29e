#include "processes/model_monitor/adaptation.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <stdexcept>

#include "common/estimation/chi_square.h"
#include "common/estimation/quantile.h"
#include "common/geometry/angle.h"
#include "processes/model_monitor/hypotheses/schema_difference.h"
#include "processes/model_monitor/likelihood/reading_distance.h"

namespace bodyschema {
namespace {

/// In a stream a marker that is read farther than this from where it should be is turned over.
constexpr double kTurnedOver_rad = 120 * kDegree;
/// Outliers are counted over about 500 readings of markers; the told rate weighs like 100 of them.
/// A little more are expected than were counted, as those that look like inliers were not. Chosen.
constexpr double kFading = 0.998;
constexpr double kPriorReadings = 100, kMostReadings = 500;
constexpr double kMoreOutliers = 1.2, kMostOutliers = 0.35;
/// Rates and worths nearer than this are the same [log], since the CUSUMs begin anew with another.
constexpr double kSameNoise = 0.15;
/// Samples from one look at them to the next.
constexpr int kUpdateEach = 8;
/// Newest samples of an earlier time that the noise is estimated from.
constexpr std::size_t kMostPast = 96;
constexpr double kLargestScale = 5;
/// Chosen: with 1 noise of correlation 0.9 has 1.8 false events in 1000 samples, with 0 it has 0.6,
/// and of noise told twice too large 96 samples do not show it.
constexpr double kShareDown = 2.0 / 3;
constexpr std::size_t kFewestDistances = 20;
/// Quiet samples after which the noise is looked at again.
constexpr int kQuietSamples = 32;
/// Share of the distances that is the tail of the noise: 8 of the 160 of five parts (chosen).
constexpr double kTail = 0.05;

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
  std::ranges::sort(sample->parts, {}, &PartObservation::part);
}

}  // namespace

Adaptation::Adaptation(BodySchema schema, AdaptationOptions options)
    : is_soft_(std::ranges::any_of(schema.edges,
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
      drift_watch_(options.false_alarm_rate) {
  // What was learned from had outliers as well: of an edge one of two markers is wild.
  for (const Edge& edge : schema_.edges) {
    num_read_ += 2 * edge.num_samples;
    num_outliers_ += edge.num_outliers;
  }
  const double share = std::min(1.0, kMostReadings / std::max(num_read_, 1.0));
  num_read_ *= share;
  num_outliers_ *= share;
}

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
  if (tests.size() > kMostPast)
    tests.erase(tests.begin(), tests.end() - static_cast<std::ptrdiff_t>(kMostPast));
  visibility_.tell_tags_again();  // news of them is for the next sample
  calibrate(tests);
  if (!history.empty()) tracker_.set_history(std::move(history));
}

EdgeState Adaptation::state_of(const ElementId& element) const {
  if (tracker_.detected() == element) return EdgeState::kInvalid;
  for (const HypothesisTracker::Change& c : tracker_.changes()) {
    const std::vector<ElementId>& also = c.what.also;
    if (c.what.element == element || std::ranges::find(also, element) != also.end())
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
  const double before = measurement_.scale;
  measurement_.scale = std::clamp(scale, options_.least_noise_scale, kLargestScale);
  drift_watch_.rescale_noise(measurement_.scale / before);
}

void Adaptation::calibrate(const std::vector<ActionPoseSample>& samples) {
  measurement_.outlier_rate = outlier_rate();
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
    // Of noise that lasts they show a part: a part of the way down, the rest by watch_noise().
    const double less = measurement_.scale / options_.measurement.scale;
    if (round == 3 && less < 1) measurement_.scale *= std::pow(less, kShareDown - 1);
  }
  tracker_.begin(BodySchema(tracker_.settled()), measurement_);
}

void Adaptation::watch_noise(const TreeFilter::Judgement& judgement) {
  for (std::size_t n = 0; n < judgement.believed.size(); ++n)
    if (judgement.believed[n] == 1) quiet_distances_.push_back(judgement.squared_distance[n]);
  if (++num_quiet_ < kQuietSamples || quiet_distances_.size() < kFewestDistances) return;
  // What a view biases has more of large distances than a Gaussian.
  const double scale =
      std::sqrt(std::max(upper_median(quiet_distances_) / chi_square_median(6),
                         exceeded_by(kTail, quiet_distances_) / chi_square_quantile(6, kTail)));
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

double Adaptation::outlier_rate() const {
  const double told = options_.measurement.outlier_rate;
  const double seen = (kPriorReadings * told + num_outliers_) / (kPriorReadings + num_read_);
  return std::clamp(kMoreOutliers * seen, told, kMostOutliers);
}

void Adaptation::update_measurement() {
  const double rate = outlier_rate();
  const double worth = drift_watch_.worth().value_or(1);
  if (std::abs(std::log(rate / measurement_.outlier_rate)) < kSameNoise &&
      std::abs(std::log(worth / measurement_.worth)) < kSameNoise)
    return;
  measurement_.outlier_rate = rate;
  measurement_.worth = worth;
  tracker_.begin(BodySchema(tracker_.settled()), measurement_);
}

void Adaptation::watch_misreadings(const ActionPoseSample& sample,
                                   const std::vector<AdaptationEvent>& events) {
  if (has_kind(events, AdaptationEvent::Kind::kRecovered)) misreadings_.forget_open();
  if (!is_settled() || !misreadings_.look(sample, tracker_.settled(), measurement_)) return;
  measurement_.misread = misreadings_.places();
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
                   schema_.displacements(sample.action), sample.sample_index,
                   stream_.is_dense() || drifting_);
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
  if (std::ranges::any_of(events, is_change)) visibility_.forget_tags();
  if (tracker_.changes().empty()) {
    const auto has_settled = [](const AdaptationEvent& e) {
      return e.kind == AdaptationEvent::Kind::kRecovered && e.tag < 0 &&
             e.cause != "marker_missing" && e.cause != "unexplained";
    };
    if (std::ranges::any_of(events, has_settled)) tags_.begin_anew();
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
  watch_misreadings(sample, events);
  if (has_kind(events, AdaptationEvent::Kind::kReverted)) drift_watch_.forget_all();
  schema_ = tracker_.schema();
  schema_.moved_tags = moved_tags_;
  return events;
}

}  // namespace bodyschema
