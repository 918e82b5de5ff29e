#include "processes/model_monitor/adaptation.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <set>
#include <stdexcept>

#include "common/estimation/quantile.h"
#include "common/geometry/angle.h"
#include "processes/model_monitor/schema_difference.h"

namespace bodyschema {
namespace {

constexpr std::size_t kRing = 96;
/// Of a CUSUM, from which on it is told which place is wrong, although nothing explains it [nats];
/// or after so many samples.
constexpr double kClearLead = 1;
constexpr std::int64_t kLongestUnclear = 3;
/// Samples below which nothing is found out where an edge is soft.
constexpr int kFewestSoft = 3;
/// In a stream a marker that is read farther than this from where it should be is turned over.
constexpr double kTurnedOver_rad = 120 * kDegree;
/// Samples after a replacement at which all forms are tried again.
constexpr int kRefits[] = {1, 2, 3, 4, 5, 7, 11, 19, 30};
/// Samples up to which a change may turn out to be one of what is next to its place.
constexpr int kUnsure = 5;
/// Samples from one fit of what has settled to the next.
constexpr int kMaturing = 10;
/// Changes that begin within so many samples of each other are one event …
constexpr std::int64_t kTogether = 12;
/// … unless so many samples, which the first explains, speak against the second.
constexpr std::size_t kStoodAlone = 4;

/// χ²₆(0.99): below it a rate is none.
constexpr double kSignificantRate = 16.8;
constexpr std::int64_t kSoon = 150;
constexpr double kMedianChiSquare6 = 5.348;
constexpr double kLargestScale = 5;
constexpr std::size_t kFewestDistances = 20;
/// Quiet samples after which the noise is looked at again.
constexpr int kQuietSamples = 32;

/// What two fits of one edge to tags may differ by, anywhere in its range: a body of the history
/// that is as near to the first is the first, learned again. Chosen: an order of magnitude above
/// the residuals of rendered tags (0.3 mm, 0.1°), below any fault of the experiments.
constexpr Noise kSameBody{0.005, 1 * kDegree};

/// Of a suspicion so many samples old: growing steps bound the work of one that lasts.
bool is_worth_a_fit(std::int64_t age) {
  constexpr std::int64_t kAges[] = {10, 12, 15, 19, 24};
  return age <= 8 || age % 30 == 0 ||
         std::find(std::begin(kAges), std::end(kAges), age) != std::end(kAges);
}

/// Samples that all forms of change in one place are fitted to are counted: so many are free a
/// sample, and so many are saved up at most. Less would be done than a fault of two places needs.
constexpr int kWorkPerSample = 4;
constexpr int kMostWork = 1000;

/// Samples without an explanation, and explanations that did not hold, after which an edge is
/// learned.
constexpr std::int64_t kUnexplained = 8;
constexpr int kManyMismatches = 3;
/// Newest samples that must be explained no worse.
constexpr std::ptrdiff_t kNewest = 5;

/// Samples from before a mismatch that bound the begin of a drift.
constexpr std::int64_t kBeforeDrift = 30;
/// A drift has ended: so probable, and so many samples ago.
constexpr double kSurelyEnded = 0.999;
constexpr std::int64_t kEndedFor = 6;

bool is_worth_learning(std::int64_t age) {
  constexpr std::int64_t kAges[] = {8, 10, 13, 16, 20, 25, 32};
  return age % 40 == 0 || std::find(std::begin(kAges), std::end(kAges), age) != std::end(kAges);
}

void check(const ActionPoseSample& sample, const BodySchema& schema) {
  if (!schema.displacements(sample.action).allFinite())
    throw std::invalid_argument("sample " + std::to_string(sample.sample_index) +
                                ": the action is not finite");
  for (const PartObservation& o : sample.parts)
    if (!o.X_CB.matrix().allFinite() || !o.covariance.allFinite() ||
        (o.X_CB_other && !o.X_CB_other->matrix().allFinite()))
      throw std::invalid_argument("sample " + std::to_string(sample.sample_index) + ", part " +
                                  std::to_string(o.part) + ": the pose is not finite");
}

}  // namespace

const char* name_of(AdaptationEvent::Kind kind) {
  using Kind = AdaptationEvent::Kind;
  switch (kind) {
    case Kind::kMismatch:
      return "mismatch";
    case Kind::kCandidate:
      return "candidate";
    case Kind::kRefined:
      return "refined";
    case Kind::kRestored:
      return "restored";
    case Kind::kReverted:
      return "reverted";
    case Kind::kRecovered:
      return "recovered";
    case Kind::kDrift:
      return "drift";
    case Kind::kMissing:
      return "missing";
    case Kind::kProbeWanted:
      return "probe_wanted";
  }
  return "";
}

Adaptation::Adaptation(BodySchema schema, AdaptationOptions options)
    : is_soft_(std::any_of(schema.edges.begin(), schema.edges.end(),
                           [](const Edge& edge) { return edge.residual_gp != nullptr; })),
      options_([&] {
        if (is_soft_) options.least_noise_scale = std::max(options.least_noise_scale, 1.0);
        return options;
      }()),
      measurement_(options.measurement),
      credit_(kMostWork),
      schema_(std::move(schema)),
      visibility_(options.false_alarm_rate),
      tags_(schema_.moved_tags),
      moved_tags_(schema_.moved_tags),
      trusted_(schema_),
      drift_watch_(options.false_alarm_rate) {
  history_.push_back(schema_);
  install(schema_);
}

Adaptation::Adaptation(BodySchema schema, AdaptationOptions options,
                       std::vector<BodySchema> history, const std::vector<ActionPoseSample>& past)
    : Adaptation(std::move(schema), options) {
  num_samples_ = options_.calibration_samples;
  for (const ActionPoseSample& sample : past) {
    if (stream_.repeats(sample, schema_.signals)) continue;
    visibility_.look(schema_.parts, sample, sample, tags_);
    tags_.look_back(sample, schema_, measurement_);
    if (sample.purpose != Purpose::kTest) continue;
    recent_.push_back(sample);
    drop_moved_tags(moved_tags_, &recent_.back());
  }
  visibility_.tell_tags_again();  // news of them is for the next sample
  calibrate();
  recent_.clear();
  install(schema_);
  if (history.empty()) return;
  history_ = std::move(history);
  remember(schema_);
}

EdgeState Adaptation::state_of(const Place& place) const {
  if (detected_ == place) return EdgeState::kInvalid;
  for (const Replacement& r : replacements_)
    if (r.place == place || std::find(r.also.begin(), r.also.end(), place) != r.also.end())
      return EdgeState::kProvisional;
  if (!place.marker && drifting_ == place.part) return EdgeState::kProvisional;
  const double statistic = place.marker ? marker_statistic(place.part) : edge_statistic(place.part);
  return statistic > options_.suspicion ? EdgeState::kSuspect : EdgeState::kOk;
}

void Adaptation::install(const BodySchema& schema) {
  schema_ = schema;
  filter_.emplace(schema_, measurement_);
  // However loud, one sample finds nothing out where a model is soft.
  const double loudest =
      is_soft_ ? alarm_threshold(filter_->num_nodes(), options_.false_alarm_rate) / kFewestSoft
               : std::numeric_limits<double>::infinity();
  tests_.emplace(*filter_, options_.false_alarm_rate, loudest);
}

double Adaptation::edge_statistic(int part) const {
  const int node = filter_->node_of(part);
  return node < 0 ? 0 : tests_->edge(node).value;
}

double Adaptation::marker_statistic(int part) const {
  const int node = filter_->node_of(part);
  return node < 0 ? 0 : tests_->marker(node).value;
}

void Adaptation::calibrate() {
  // The filter's own beliefs depend on the scale: a few rounds.
  for (int round = 0; round < 4; ++round) {
    std::vector<double> distances;
    const TreeFilter filter(schema_, measurement_);
    for (const ActionPoseSample& sample : recent_) {
      const TreeFilter::Judgement judgement = filter.judge(filter.prepare(sample));
      for (const double d2 : judgement.squared_distance)
        if (d2 >= 0) distances.push_back(d2);
    }
    if (distances.size() < kFewestDistances) return;
    const double scale = std::sqrt(upper_median(distances) / kMedianChiSquare6);
    measurement_.scale =
        std::clamp(measurement_.scale * scale, options_.least_noise_scale, kLargestScale);
  }
  // A few samples tell no better than this.
  if (std::abs(std::log(measurement_.scale)) < 0.15)
    measurement_.scale = options_.measurement.scale;
}

void Adaptation::watch_noise(const TreeFilter::Judgement& judgement) {
  for (std::size_t n = 0; n < judgement.believed.size(); ++n)
    if (judgement.believed[n] == 1) quiet_distances_.push_back(judgement.squared_distance[n]);
  if (++num_quiet_ < kQuietSamples || quiet_distances_.size() < kFewestDistances) return;
  const double scale = std::sqrt(upper_median(quiet_distances_) / kMedianChiSquare6);
  quiet_distances_.clear();
  num_quiet_ = 0;
  if (std::abs(std::log(scale)) < 0.05) return;
  measurement_.scale =
      std::clamp(measurement_.scale * std::sqrt(scale), options_.least_noise_scale, kLargestScale);
  install(schema_);
}

std::vector<const ActionPoseSample*> Adaptation::segment(std::int64_t since, int longest) const {
  std::vector<const ActionPoseSample*> result;
  for (const ActionPoseSample& sample : recent_)
    if (sample.sample_index >= since) result.push_back(&sample);
  if (result.size() > static_cast<std::size_t>(longest))
    result.erase(result.begin(), result.end() - longest);
  return result;
}

FoundChanges Adaptation::search(const BodySchema& standing, const std::vector<Place>& places,
                                const std::vector<const ActionPoseSample*>& samples,
                                const BodyChange* standing_form) {
  ChangeSearch search{measurement_, options_.ambiguity};
  if (standing_form) {
    search.standing_form = *standing_form;
    search.learn = standing_form->is_learned();
  }
  FoundChanges found = find_changes(standing, history_, places, samples, search);
  credit_ -= found.work;
  return found;
}

BodySchema Adaptation::composed(int without) const {
  BodySchema schema = before_;
  for (int n = 0; n < static_cast<int>(replacements_.size()); ++n) {
    const FittedChange& fitted = replacements_[static_cast<std::size_t>(n)].fitted;
    if (n != without && is_possible(fitted, schema)) schema = with_change(schema, fitted);
  }
  return schema;
}

void Adaptation::drop_impossible(std::int64_t sample_index, std::vector<AdaptationEvent>* events) {
  BodySchema schema = before_;
  std::erase_if(replacements_, [&](const Replacement& r) {
    if (!is_possible(r.fitted, schema)) {
      tell(AdaptationEvent::Kind::kReverted, sample_index, r, 0, 0, events);
      return true;
    }
    schema = with_change(schema, r.fitted);
    return false;
  });
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

void Adaptation::tell(AdaptationEvent::Kind kind, std::int64_t sample_index,
                      const Replacement& replacement, double margin, int num_samples,
                      std::vector<AdaptationEvent>* events) const {
  std::vector<Place> places{replacement.place};
  places.insert(places.end(), replacement.also.begin(), replacement.also.end());
  for (const Place& place : places) {
    AdaptationEvent told = event(kind, sample_index, place);
    BodyChange there = replacement.fitted.change;
    there.part = place.part;
    told.cause = there.cause(schema_);
    if (place == replacement.place) told.size = size_of(replacement);
    told.margin = margin;
    told.num_samples = num_samples;
    events->push_back(std::move(told));
  }
}

ChangeSize Adaptation::size_of(const Replacement& replacement) const {
  BodySchema base = schema_;
  for (int n = 0; n < static_cast<int>(replacements_.size()); ++n)
    if (replacements_[static_cast<std::size_t>(n)].place == replacement.place) base = composed(n);
  const FittedChange& fitted = replacement.fitted;
  if (fitted.origin) base = with_edge_of(base, *fitted.origin, replacement.place.part);
  return bodyschema::size_of(base, fitted.change, fitted.theta, fitted.covariance);
}

void Adaptation::complete(std::int64_t sample_index, AdaptationEvent* event) const {
  using Kind = AdaptationEvent::Kind;
  event->sample_index = sample_index;
  const bool is_of_replacement = event->tag < 0 && event->cause != "marker_missing" &&
                                 event->cause != "drift" && event->cause != "unexplained" &&
                                 event->kind != Kind::kMismatch &&
                                 event->kind != Kind::kProbeWanted;
  if (is_of_replacement)
    event->since = since();
  else if (event->since >= 0)
    event->since = stream_.sample_index_of(event->since);
  const bool may_be_normal = event->kind == Kind::kRestored || event->kind == Kind::kRefined ||
                             (event->kind == Kind::kRecovered &&
                              (event->cause == "stored" || event->cause == "camera_moved"));
  if (!may_be_normal) return;
  const int part = event->to >= 0 ? event->to : event->part;
  const BodySchema& first = history_.front();
  event->is_normal =
      event->tag >= 0 || is_alike_at(schema_, first, part) ||
      (event->kind != Kind::kRefined && is_close_at(schema_, first, part, kSameBody));
}

double Adaptation::required_margin(const Place& place, std::int64_t sample_index) const {
  const auto it = reversions_.find(place);
  const bool is_recent = it != reversions_.end() && it->second.last + kSoon >= sample_index;
  return options_.acceptance * (is_recent ? 1 + it->second.num : 1);
}

void Adaptation::try_changes(std::int64_t sample_index, std::vector<AdaptationEvent>* events) {
  const std::vector<Place> places = suspects();
  if (places.empty()) return;
  const auto [cusum, second] = tests_->highest();
  const std::int64_t since = cusum.since;
  const double highest = cusum.value;
  // What nothing explained so far is looked at again when there is clearly more of it.
  if (detected_ && !is_worth_a_fit(sample_index - since + 1)) return;
  const auto samples = segment(since, options_.longest_segment);
  FoundChanges choice;
  if (credit_ > 0) choice = search(schema_, places, samples);
  const bool accepted = choice.best &&
                        choice.margin() > required_margin(choice.best->place, sample_index) &&
                        (!is_soft_ || static_cast<int>(samples.size()) >= kFewestSoft);
  // Edges between which nothing was seen are suspected alike: which one it is is told later, if
  // there is more evidence of it. (A lead may also come from evidence against all of them.)
  const bool is_rising = !detected_ || highest > std::min(untold_, tests_->ceiling());
  const bool is_clear =
      accepted || (is_rising && highest > tests_->alarm() &&
                   (highest - second > kClearLead ||
                    sample_index - std::max(since, reformed_at_) >= kLongestUnclear));
  // A form of its first samples may be another in the next: what it does not explain elsewhere may
  // be its own fault.
  const auto is_beside = [&](const Replacement& r) {
    const std::vector<Place> near = places_around(*filter_, r.place.part);
    return std::find(near.begin(), near.end(), places.front()) != near.end();
  };
  const bool may_be_its_own = reformed_at_ == sample_index ||
                              (age_ <= kUnsure && !replacements_.empty() &&
                               std::none_of(replacements_.begin(), replacements_.end(), is_beside));
  const bool is_wrong = detected_ ? !is_told_ : highest > tests_->alarm();
  if ((is_wrong && !may_be_its_own) || (accepted && !(detected_ && is_told_))) {
    detected_ = accepted ? choice.best->place : places.front();
    is_told_ = is_clear;
    untold_ = highest;
    if (!is_clear) return;
    AdaptationEvent mismatch = event(AdaptationEvent::Kind::kMismatch, sample_index, *detected_);
    if (!detected_->marker && detected_->part == schema_.root) mismatch.cause = "camera_moved";
    mismatch.since = since;
    mismatch.margin = highest;
    mismatch.num_samples = static_cast<int>(samples.size());
    events->push_back(mismatch);
    note_trouble(mismatch, since);
  }
  if (!accepted) return;
  const FittedChange& fitted = choice.best->fitted;
  tell(fitted.change.form == BodyChange::Form::kStored ? AdaptationEvent::Kind::kRestored
                                                       : AdaptationEvent::Kind::kCandidate,
       sample_index, *choice.best, choice.margin(), static_cast<int>(samples.size()), events);
  if (fitted.change.small && !choice.best->place.marker) {
    const int part = choice.best->place.part;
    // At once again is a change that was not understood yet. What is next to it may have been held
    // to be the place.
    const auto is_next = [this](int a, int b) {
      const Edge* edge = edge_to(schema_, a);
      return edge && edge->from == b;
    };
    const bool again = last_small_ && sample_index - last_small_->second < kSoon &&
                       sample_index - last_small_->second > kTogether &&
                       (last_small_->first == part || is_next(part, last_small_->first) ||
                        is_next(last_small_->first, part));
    last_small_ = {part, sample_index};
    if (again && !drifting_) {
      // Small changes that have not settled were this drift as well.
      const bool all_small =
          std::all_of(replacements_.begin(), replacements_.end(),
                      [](const Replacement& r) { return r.fitted.change.small; });
      if (!replacements_.empty() && all_small)
        install(before_);
      else if (!replacements_.empty())
        remember(schema_);
      replacements_.clear();
      begin_drift(part, sample_index, sample_index, events);
      return;
    }
  }
  // Changes that came together are reconsidered together; an older one is taken as it is, and so is
  // one that ends: what stood before it, again.
  const bool ends = fitted.change.form == BodyChange::Form::kStored && since > since_ &&
                    !differ_at(with_change(schema_, fitted), before_, choice.best->place.part);
  // So is one that stood alone for a while: samples from then speak against the new one.
  std::vector<const ActionPoseSample*> earlier = segment(since_, options_.longest_segment);
  std::erase_if(earlier, [&](const auto* sample) { return sample->sample_index >= since; });
  const bool began_later =
      !replacements_.empty() && earlier.size() >= kStoodAlone &&
      log_likelihood(with_change(schema_, fitted), measurement_, earlier) <
          log_likelihood(schema_, measurement_, earlier) - 4 * options_.acceptance;
  if (replacements_.empty() || since - since_ > kTogether || fitted.everywhere || ends ||
      began_later) {
    if (trouble_ && since_ >= trouble_->since && !replacements_.empty()) {
      trouble_->adopted.insert(trouble_->adopted.end(), replacements_.begin(), replacements_.end());
      trouble_->stages.push_back({before_, since_});
    }
    before_ = schema_;
    replacements_.clear();
    maturing_.clear();
    asked_.clear();
    since_ = since;
  }
  if (ends) trouble_.reset();
  want_probe(schema_, choice, sample_index, events);
  replacements_.push_back(std::move(*choice.best));
  age_ = 0;
  detected_.reset();
  if (replacements_.size() > 1)
    reconsider(sample_index, true, events);
  else
    install(composed());
}

void Adaptation::note_trouble(const AdaptationEvent& mismatch, std::int64_t since) {
  if (!trouble_ || mismatch.sample_index - trouble_->last > options_.settled_after) {
    trouble_ = Trouble{};
    trouble_->since = since;
    trouble_->before = schema_;
  }
  trouble_->last = mismatch.sample_index;
  const int part = mismatch.part >= 0 ? mismatch.part : mismatch.to;
  trouble_->last_part = part;
  if (!edge_to(schema_, part)) return;
  Trouble::Edge& edge = trouble_->edges[part];
  if (edge.num_mismatches++ == 0) edge.since = since;
}

void Adaptation::try_learning(std::int64_t sample_index, std::vector<AdaptationEvent>* events) {
  if (!trouble_ || !is_worth_learning(sample_index - trouble_->since + 1) ||
      !(detected_ || sample_index - trouble_->last < kUnexplained))
    return;
  // Where most mismatches were; what has just begun elsewhere is for the families first.
  int part = -1, most = 0;
  for (const auto& [to, edge] : trouble_->edges) {
    const bool is_ripe = edge.num_mismatches >= kManyMismatches ||
                         (detected_ && sample_index - edge.since + 1 >= kUnexplained);
    if (!is_ripe || edge.num_mismatches <= most) continue;
    part = to;
    most = edge.num_mismatches;
  }
  if (part < 0 || (trouble_->last_part != part && trouble_->last == sample_index)) return;
  const auto samples = segment(trouble_->since, options_.longest_segment);
  const double standing = log_likelihood(schema_, measurement_, samples);
  std::optional<Replacement> best;
  BodySchema before;
  // This edge as it was, the others too or as they are now.
  std::vector<BodySchema> bases{trouble_->before};
  if (std::any_of(schema_.parts.begin(), schema_.parts.end(), [&](int other) {
        return other != part && differ_at(schema_, trouble_->before, other);
      }))
    bases.push_back(with_edge_of(schema_, trouble_->before, part));
  for (const BodySchema& base : bases) {
    const PlaceEvidence evidence(base, measurement_, part, false, samples);
    for (FittedChange& learned : evidence.learn()) {
      if (best && learned.log_evidence <= best->fitted.log_evidence) continue;
      best = Replacement{{part, false}, std::move(learned)};
      before = base;
    }
  }
  if (!best) return;
  const double margin = best->fitted.log_evidence - standing;
  const BodySchema with = with_change(before, best->fitted);
  // What the body has changed back from meanwhile explains many samples, too.
  const std::vector<const ActionPoseSample*> newest(
      samples.end() - std::min<std::ptrdiff_t>(kNewest, std::ssize(samples)), samples.end());
  if (margin <= required_margin(best->place, sample_index) ||
      log_likelihood(with, measurement_, newest) < log_likelihood(schema_, measurement_, newest))
    return;
  AdaptationEvent candidate = event(AdaptationEvent::Kind::kCandidate, sample_index, best->place);
  candidate.cause = best->fitted.change.cause(schema_);
  candidate.margin = margin;
  candidate.num_samples = static_cast<int>(samples.size());
  for (const Replacement& r : replacements_)
    tell(AdaptationEvent::Kind::kReverted, sample_index, r, 0, 0, events);
  events->push_back(candidate);
  before_ = std::move(before);
  since_ = trouble_->since;
  replacements_ = {std::move(*best)};
  maturing_.clear();
  asked_.clear();
  age_ = 0;
  detected_.reset();
  install(composed());
}

bool Adaptation::reconsider_place(const std::vector<const ActionPoseSample*>& samples,
                                  std::int64_t sample_index, std::vector<AdaptationEvent>* events) {
  if (replacements_.size() != 1 || age_ > kUnsure) return false;
  const Replacement& here = replacements_.front();
  if (!here.also.empty() || here.fitted.everywhere || here.fitted.change.is_learned()) return false;
  std::vector<Place> places = places_around(*filter_, here.place.part);
  std::erase(places, here.place);
  FoundChanges there = search(before_, places, samples);
  const double standing = log_likelihood(composed(), measurement_, samples) + here.fitted.log_prior;
  if (!there.best || there.best->fitted.log_evidence < standing + 2 * options_.acceptance)
    return false;
  tell(AdaptationEvent::Kind::kReverted, sample_index, here, 0, 0, events);
  tell(AdaptationEvent::Kind::kRefined, sample_index, *there.best, there.margin(),
       static_cast<int>(samples.size()), events);
  replacements_ = {std::move(*there.best)};
  return true;
}

void Adaptation::reconsider(std::int64_t sample_index, bool all_forms,
                            std::vector<AdaptationEvent>* events) {
  const auto samples = segment(
      since_, age_ > options_.settled_after ? options_.matured_after : options_.longest_segment);
  const int rounds = replacements_.size() > 1 ? 3 : 1;
  bool has_changed = false;
  for (int round = 0; round < rounds; ++round) {
    bool is_changed = false;
    for (int n = 0; n < static_cast<int>(replacements_.size());) {
      Replacement& r = replacements_[static_cast<std::size_t>(n)];
      const BodySchema others = composed(n);
      if (!all_forms) {
        if (r.fitted.change.size() > 0 && is_possible(r.fitted, others)) {
          const BodySchema base =
              r.fitted.origin ? with_edge_of(others, *r.fitted.origin, r.place.part) : others;
          const PlaceEvidence evidence(base, measurement_, r.place.part, r.place.marker, samples);
          if (auto again = evidence.fit(r.fitted.change)) {
            again->origin = r.fitted.origin;
            r.fitted = *again;
          }
        }
        ++n;
        continue;
      }
      FoundChanges choice = search(others, {r.place}, samples, &r.fitted.change);
      if (!choice.best || choice.margin() < 0) {
        tell(AdaptationEvent::Kind::kReverted, sample_index, r, choice.margin(), 0, events);
        Reversions& reversions = reversions_[r.place];
        reversions.num = reversions.last + kSoon < sample_index ? 1 : reversions.num + 1;
        reversions.last = sample_index;
        replacements_.erase(replacements_.begin() + n);
        is_changed = true;
        continue;
      }
      if (choice.best->fitted.change != r.fitted.change || choice.best->also != r.also) {
        if (choice.best->place != r.place)
          tell(AdaptationEvent::Kind::kReverted, sample_index, r, choice.margin(), 0, events);
        tell(AdaptationEvent::Kind::kRefined, sample_index, *choice.best, choice.margin(),
             static_cast<int>(samples.size()), events);
        is_changed = true;
      }
      r = *choice.best;
      if (round == 0 && age_ > 0) want_probe(others, choice, sample_index, events);
      ++n;
    }
    has_changed |= is_changed;
    if (!is_changed) break;
  }
  drop_impossible(sample_index, events);
  const bool is_another = all_forms && reconsider_place(samples, sample_index, events);
  const SequentialTests tests = *tests_;
  install(composed());
  if (age_ == 0 || is_another) return;
  if (!has_changed) {
    tests_ = tests;
    return;
  }
  // What the form that was taken back was wrong about is nobody's fault.
  for (const ActionPoseSample* sample : samples)
    tests_->update(*filter_, filter_->prepare(*sample), sample->sample_index);
  reformed_at_ = sample_index;
}

void Adaptation::want_probe(const BodySchema& standing, const FoundChanges& choice,
                            std::int64_t sample_index, std::vector<AdaptationEvent>* events) {
  // Of two functions the samples to come decide.
  if (!choice.runner_up || choice.best->fitted.change.is_learned()) return;
  // The runner-up may be ahead of a form that is kept.
  const double lead =
      std::abs(choice.best->fitted.log_evidence - choice.runner_up->fitted.log_evidence);
  if (lead > options_.ambiguity) return;
  const Ambiguity ambiguity{choice.best->place, choice.best->fitted.change,
                            choice.runner_up->fitted.change};
  if (std::any_of(asked_.begin(), asked_.end(),
                  [&](const Ambiguity& asked) { return asked.is(ambiguity); }))
    return;
  const BodySchema one = with_change(standing, choice.best->fitted);
  const BodySchema other = with_change(standing, choice.runner_up->fitted);
  const Eigen::VectorXd probe = most_telling_action(one, other, options_.tolerance);
  if (probe.size() == 0) return;
  AdaptationEvent wanted =
      event(AdaptationEvent::Kind::kProbeWanted, sample_index, choice.best->place);
  const std::string cause = choice.best->fitted.change.cause(standing),
                    other_cause = choice.runner_up->fitted.change.cause(standing);
  wanted.cause = cause == other_cause ? cause : cause + " or " + other_cause;
  wanted.margin = lead;
  wanted.probe = probe;
  asked_.push_back(ambiguity);
  events->push_back(wanted);
}

void Adaptation::watch_visibility(const ActionPoseSample& sample, const ActionPoseSample& used,
                                  std::vector<AdaptationEvent>* events) {
  for (const auto& finding : visibility_.look(schema_.parts, sample, used, tags_)) {
    const auto [part, tag, is_missing, num_missed] = finding;
    AdaptationEvent told =
        event(is_missing ? AdaptationEvent::Kind::kMissing : AdaptationEvent::Kind::kRecovered,
              sample.sample_index, {part, true});
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
    for (const MovedTags::Finding& finding : tags_.look(*sample, trusted_, schema_, measurement_)) {
      using Kind = AdaptationEvent::Kind;
      const Kind kind = finding.is_back ? (finding.is_on_part ? Kind::kRestored : Kind::kRecovered)
                                        : (finding.is_on_part ? Kind::kCandidate : Kind::kMissing);
      AdaptationEvent told = event(kind, sample->sample_index, {finding.part, true});
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
  std::erase_if(sample->parts, [this](const PartObservation& o) { return tags_.affects(o); });
}

/// What a moved tag was taken for meanwhile.
void Adaptation::take_back(const MovedTags::Finding& moved, std::int64_t sample_index,
                           std::vector<AdaptationEvent>* events) {
  for (ActionPoseSample& earlier : recent_)
    if (earlier.sample_index >= moved.since)
      std::erase_if(earlier.parts, [&](const PartObservation& o) {
        return std::find(o.tags.begin(), o.tags.end(), moved.tag) != o.tags.end();
      });
  const auto is_at_it = [&](const Place& place) {
    if (place.part == moved.part) return true;
    const Edge* edge = edge_to(schema_, place.part);
    return !place.marker && edge && edge->from == moved.part;
  };
  if (detected_ && is_at_it(*detected_)) detected_.reset();
  if (since_ >= moved.since)
    for (auto r = replacements_.begin(); r != replacements_.end();) {
      if (is_at_it(r->place)) {
        tell(AdaptationEvent::Kind::kReverted, sample_index, *r, 0, 0, events);
        r = replacements_.erase(r);
      } else {
        ++r;
      }
    }
  // Of what went to and fro something may have been kept.
  BodySchema& standing = replacements_.empty() ? schema_ : before_;
  for (const int part : trusted_.parts)
    if (is_at_it({part, false})) standing = with_edge_of(standing, trusted_, part);
  trouble_.reset();
  install(replacements_.empty() ? BodySchema(schema_) : composed());
}

// A flip stays for many frames, longer than a block. It says nothing of where the part is.
void Adaptation::drop_turned_over(ActionPoseSample* sample) const {
  const auto X_RB = schema_.predict_all(sample->action);
  std::erase_if(sample->parts, [&](const PartObservation& o) {
    const auto expected = X_RB.find(o.part);
    return expected != X_RB.end() &&
           rotation_angle((schema_.X_CR * expected->second).inverse() * o.X_CB) > kTurnedOver_rad;
  });
}

void Adaptation::drop_fallen(ActionPoseSample* sample, std::vector<AdaptationEvent>* events) {
  const auto drop = [](int part, ActionPoseSample* from) {
    std::erase_if(from->parts, [part](const PartObservation& o) { return o.part == part; });
  };
  for (const auto& [part, X_RB] : schema_.predict_all(sample->action)) {
    const auto since = fallen_.look(*sample, part, schema_.X_CR * X_RB, measurement_);
    if (!since) continue;
    drop(part, sample);
    if (visibility_.is_missing(part)) continue;
    int num_missed = 0;
    for (ActionPoseSample& earlier : recent_) {
      if (earlier.sample_index < *since) continue;
      drop(part, &earlier);
      ++num_missed;
    }
    AdaptationEvent missing =
        event(AdaptationEvent::Kind::kMissing, sample->sample_index, {part, true});
    missing.cause = "marker_missing";
    missing.num_samples = visibility_.lose(part, num_missed) + 1;
    missing.since = *since;
    events->push_back(missing);
    // What it was taken for meanwhile is taken back.
    const auto is_at_it = [this, part](const Place& place) {
      return place.part == part && (place.marker || part != schema_.root);
    };
    if (detected_ && is_at_it(*detected_)) detected_.reset();
    const auto is_about_it = [&](const Replacement& r) { return is_at_it(r.place); };
    for (const Replacement& r : replacements_)
      if (is_about_it(r) && since_ >= *since)
        tell(AdaptationEvent::Kind::kReverted, sample->sample_index, r, 0, 0, events);
    if (since_ >= *since && std::erase_if(replacements_, is_about_it) > 0) schema_ = composed();
    install(schema_);
  }
}

void Adaptation::follow(std::int64_t sample_index, std::vector<AdaptationEvent>* events) {
  ++age_;
  if (age_ >= options_.settled_after) {
    for (const Replacement& r : replacements_)
      tell(AdaptationEvent::Kind::kRecovered, sample_index, r, 0, age_, events);
    drop_impossible(sample_index, events);
    remember(schema_);
    trusted_ = schema_;
    tags_.begin_anew();
    // Of a drift, which may look like small changes, the mean of many samples is not what is now.
    const bool any_small = std::any_of(replacements_.begin(), replacements_.end(),
                                       [](const Replacement& r) { return r.fitted.change.small; });
    if (!any_small) maturing_ = replacements_;
    replacements_.clear();
    trouble_.reset();
    return;
  }
  const bool all_forms =
      credit_ > 0 && std::find(std::begin(kRefits), std::end(kRefits), age_) != std::end(kRefits);
  reconsider(sample_index, all_forms, events);
}

void Adaptation::mature(std::int64_t sample_index, std::vector<AdaptationEvent>* events) {
  if (++age_ > options_.matured_after) {
    maturing_.clear();
    return;
  }
  if (age_ % kMaturing != 0 || !suspects().empty()) return;
  const BodySchema settled = schema_;
  std::swap(replacements_, maturing_);
  reconsider(sample_index, false, events);  // the forms stay
  std::swap(replacements_, maturing_);
  trusted_ = schema_;
  for (BodySchema& stored : history_)
    if (is_same(stored, settled)) stored = schema_;
}

void Adaptation::begin_drift(int part, std::int64_t since, std::int64_t sample_index,
                             std::vector<AdaptationEvent>* events) {
  drifting_ = part;
  maturing_.clear();
  trouble_.reset();
  before_ = schema_;
  num_still_ = 0;
  detected_.reset();
  AdaptationEvent drift = event(AdaptationEvent::Kind::kDrift, sample_index, {part, false});
  drift.cause = "drift";
  drift.since = since;
  events->push_back(drift);
}

double Adaptation::standing_evidence(const std::vector<const ActionPoseSample*>& samples) const {
  double evidence = 0;
  auto begin = samples.begin();
  const auto judge = [&](const BodySchema& schema, std::int64_t until) {
    const auto end = std::find_if(begin, samples.end(), [until](const auto* sample) {
      return sample->sample_index >= until;
    });
    evidence += log_likelihood(schema, measurement_, {begin, end});
    begin = end;
  };
  if (trouble_) {
    for (const Trouble::Stage& stage : trouble_->stages) judge(stage.schema, stage.until);
    for (const Replacement& r : trouble_->adopted) evidence += r.fitted.log_prior;
  }
  if (!replacements_.empty()) judge(before_, since_);
  for (const Replacement& r : replacements_) evidence += r.fitted.log_prior;
  judge(schema_, std::numeric_limits<std::int64_t>::max());
  return evidence;
}

void Adaptation::try_drift(std::int64_t sample_index, std::vector<AdaptationEvent>* events) {
  if (drifting_ || !trouble_ || credit_ <= 0) return;
  const std::vector<Place> places = suspects();
  const std::int64_t suspected = tests_->highest().cusum.since;
  if (places.empty() || !is_worth_a_fit(sample_index - suspected + 1)) return;
  const auto samples = segment(trouble_->since - kBeforeDrift, static_cast<int>(kRing));
  // When it began is no longer known.
  if (samples.empty() || samples.front()->sample_index > trouble_->since) {
    trouble_->adopted.clear();
    trouble_->stages.clear();
    return;
  }
  std::set<int> parts;
  const auto add_around = [&](int part) {
    for (const Place& place : places_around(*filter_, part))
      if (!place.marker) parts.insert(place.part);
  };
  for (const auto& [part, unused] : trouble_->edges) add_around(part);
  for (const Replacement& r : replacements_) add_around(r.place.part);
  // A step that is about to be accepted is as good as one that stands.
  const auto standing = [&] {
    const FoundChanges step = search(schema_, places, segment(suspected, options_.longest_segment));
    return standing_evidence(samples) + std::max(0.0, step.margin());
  };
  credit_ -= static_cast<int>(samples.size());
  // Edges beside each other explain a bend nearly alike: until one leads, nothing is told.
  std::optional<BegunDrift> best;
  double most = -std::numeric_limits<double>::infinity(), second = most;
  for (BegunDrift& drift : begun_drifts(trouble_->before, measurement_,
                                        {parts.begin(), parts.end()}, samples, trouble_->since)) {
    if (drift.gain < options_.acceptance) continue;
    const double evidence =
        drift.log_prior + drift.log_likelihood(trouble_->before, measurement_, samples);
    second = std::max(second, std::min(most, evidence));
    if (evidence <= most) continue;
    most = evidence;
    best = std::move(drift);
  }
  if (!best || !best->is_good || most - second < options_.ambiguity ||
      most - standing() < options_.acceptance)
    return;
  // All that was adopted since the trouble began was this drift.
  std::vector<Replacement> undone = std::move(trouble_->adopted);
  if (since_ >= trouble_->since)
    undone.insert(undone.end(), replacements_.begin(), replacements_.end());
  else if (!replacements_.empty())
    remember(trouble_->before);
  for (const Replacement& r : undone)
    tell(AdaptationEvent::Kind::kReverted, sample_index, r, 0, 0, events);
  replacements_.clear();
  install(BodySchema(trouble_->before));
  begin_drift(best->drift.part, best->begin + 1, sample_index, events);
  drift_watch_.look_again(before_, measurement_, *drifting_,
                          segment(best->begin, static_cast<int>(kRing)));
  install(best->drift.applied_to(before_));
}

void Adaptation::watch_drift(std::int64_t sample_index, std::vector<AdaptationEvent>* events) {
  if (!drifting_) {
    if (!replacements_.empty() || detected_) return;
    const auto moved = drift_watch_.moved_part(schema_);
    if (!moved) return;
    begin_drift(*moved, sample_index, sample_index, events);
  }
  const auto drift = drift_watch_.follow(before_, *drifting_);
  if (!drift) return;
  for (AdaptationEvent& event : *events)
    if (event.kind == AdaptationEvent::Kind::kDrift)
      event.size =
          size_of_rate(before_, *drifting_, drift->left, drift->rate, drift->rate_covariance);
  // What is suspected elsewhere meanwhile stays so.
  SequentialTests tests = *tests_;
  install(drift->applied_to(before_));
  tests.clear(filter_->node_of(*drifting_));
  tests_ = std::move(tests);
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
  AdaptationEvent recovered =
      event(AdaptationEvent::Kind::kRecovered, sample_index, {*drifting_, false});
  recovered.cause = "drift";
  if (since < sample_index) recovered.since = since;
  recovered.num_samples =
      since < sample_index ? static_cast<int>(sample_index - since) : num_still_;
  events->push_back(recovered);
  drift_watch_.forget(*drifting_, since);
  remember(schema_);
  trusted_ = schema_;
  tags_.begin_anew();
  // What it is now is estimated from more samples as they come.
  if (since < sample_index) {
    Replacement there{{*drifting_, false}, {}};
    there.fitted.change = {drift.left ? BodyChange::Form::kLeft : BodyChange::Form::kRight,
                           *drifting_};
    there.fitted.theta = coordinates(drift.T);
    there.fitted.covariance = drift.covariance;
    maturing_ = {std::move(there)};
    since_ = since;
    age_ = static_cast<int>(sample_index - since);
  }
  drifting_.reset();
}

void Adaptation::remember(const BodySchema& schema) {
  const auto alike = std::find_if(history_.begin(), history_.end(), [&](const BodySchema& stored) {
    return is_alike(stored, schema);
  });
  if (alike != history_.end()) {
    // One body: the newest of its schemas, unless it is the one to begin with.
    if (alike == history_.begin()) return;
    history_.erase(alike);
  }
  if (history_.size() > options_.history) history_.erase(history_.begin() + 1);
  history_.push_back(schema);
}

std::vector<AdaptationEvent> Adaptation::on_sample(const ActionPoseSample& seen) {
  check(seen, schema_);
  if (stream_.repeats(seen, schema_.signals)) return {};
  credit_ = std::min(credit_ + kWorkPerSample, kMostWork);
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
  recent_.push_back(sample);
  if (recent_.size() > kRing) recent_.pop_front();
  if (++num_samples_ <= options_.calibration_samples) {
    if (num_samples_ == options_.calibration_samples) {
      calibrate();
      install(schema_);
    }
    return events;
  }
  const TreeFilter::Instant instant = filter_->prepare(sample);
  const TreeFilter::Judgement judgement = tests_->update(*filter_, instant, sample.sample_index);
  drift_watch_.add(*filter_, instant, schema_.displacements(sample.action), sample.sample_index);
  if (!replacements_.empty())
    follow(sample.sample_index, &events);
  else if (!maturing_.empty())
    mature(sample.sample_index, &events);
  try_changes(sample.sample_index, &events);
  try_drift(sample.sample_index, &events);
  try_learning(sample.sample_index, &events);
  // A body that moves otherwise shows other sides of its parts.
  const auto is_change = [](const AdaptationEvent& e) {
    return e.tag < 0 && (e.kind == AdaptationEvent::Kind::kCandidate ||
                         e.kind == AdaptationEvent::Kind::kRestored);
  };
  if (std::any_of(events.begin(), events.end(), is_change)) visibility_.forget_tags();
  if (!replacements_.empty()) {
    drifting_.reset();
    for (const Replacement& r : replacements_)
      if (!r.fitted.change.small) drift_watch_.forget_all();
  } else {
    watch_drift(sample.sample_index, &events);
  }
  if (detected_ && suspects().empty()) {
    if (is_told_) {
      events.push_back(event(AdaptationEvent::Kind::kRecovered, sample.sample_index, *detected_));
      events.back().cause = "unexplained";
    }
    detected_.reset();
    trouble_.reset();
  }
  if (is_settled() && suspects().empty()) watch_noise(judgement);
  schema_.moved_tags = moved_tags_;
  return events;
}

}  // namespace bodyschema
