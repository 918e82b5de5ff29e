#include "processes/model_monitor/adaptation.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <set>
#include <stdexcept>

#include "common/statistics/median.h"

namespace bodyschema {
namespace {

constexpr std::size_t kRing = 96;
/// Squared distance of every marker below which a sample cannot raise a CUSUM that is at zero.
constexpr double kClear = 14;
constexpr double kInflations[] = {3, 10};
constexpr double kHighestOverAlarm = 2;
/// Of a CUSUM, from which on it is told which place is wrong, although nothing explains it [nats];
/// or after so many samples.
constexpr double kClearLead = 1;
constexpr std::size_t kLongestUnclear = 4;
/// Samples below which nothing is found out where an edge is soft.
constexpr int kFewestSoft = 3;
/// In a stream a marker that is read farther than this from where it should be is turned over.
constexpr double kTurnedOver_rad = 120 * M_PI / 180;
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

/// From so many samples on a change keeps its form unless another explains clearly more of the
/// evidence.
constexpr int kManySamples = 8;
constexpr double kSystematicShare = 0.03;

/// χ²₆(0.99): below it a rate is none.
constexpr double kSignificantRate = 16.8;
constexpr int kProbeCandidates = 200;
/// Two schemas of the history are one body where no local model differs at so many actions by more
/// than χ²₆(0.99) of what is uncertain about it.
constexpr int kAlikeActions = 16;
constexpr double kAlike = 16.8;
/// Sightings below which a part's visibility is not known.
constexpr int kFewestSightings = 10;
constexpr int kAnyTag = -1;
constexpr std::int64_t kSoon = 150;
constexpr double kMedianChiSquare6 = 5.348;
constexpr double kLargestScale = 5;
constexpr std::size_t kFewestDistances = 20;
/// Quiet samples after which the noise is looked at again.
constexpr int kQuietSamples = 32;

/// Of a suspicion so many samples old: growing steps bound the work of one that lasts.
bool is_worth_a_fit(std::int64_t age) {
  constexpr std::int64_t kAges[] = {10, 12, 15, 19, 24};
  return age <= 8 || age % 30 == 0 ||
         std::find(std::begin(kAges), std::end(kAges), age) != std::end(kAges);
}

/// Samples that all forms of change in one place are fitted to are counted: so many are free a
/// sample, and so many are saved up at most. Less would be done than a fault of two places needs.
constexpr int kWorkPerSample = 6;
constexpr int kMostWork = 2000;

/// Samples without an explanation, and explanations that did not hold, after which an edge is
/// learned.
constexpr std::int64_t kUnexplained = 8;
constexpr int kManyMismatches = 3;
/// Newest samples that must be explained no worse.
constexpr std::ptrdiff_t kNewest = 5;

bool is_worth_learning(std::int64_t age) {
  constexpr std::int64_t kAges[] = {8, 10, 13, 16, 20, 25, 32};
  return age % 40 == 0 || std::find(std::begin(kAges), std::end(kAges), age) != std::end(kAges);
}

bool differ(const Edge& a, const Edge& b) {
  if (!a.left.isApprox(b.left, 1e-9) || !a.right.isApprox(b.right, 1e-9) ||
      a.joints.size() != b.joints.size() || !a.has_process_of(b))
    return true;
  for (std::size_t d = 0; d < a.joints.size(); ++d) {
    const ScrewJoint &x = a.joints[d], &y = b.joints[d];
    if (x.signal != y.signal || x.gain != y.gain || x.offset != y.offset || x.turn != y.turn ||
        x.slide != y.slide || !x.X_after.isApprox(y.X_after, 1e-9))
      return true;
  }
  return false;
}

bool differ_at(const BodySchema& a, const BodySchema& b, int part) {
  if (part == a.root) return !a.X_CR.isApprox(b.X_CR, 1e-9);
  const Edge *x = edge_to(a, part), *y = edge_to(b, part);
  return x && y && differ(*x, *y);
}

bool is_same(const BodySchema& a, const BodySchema& b) {
  return a.X_CR.isApprox(b.X_CR, 1e-9) &&
         std::equal(a.edges.begin(), a.edges.end(), b.edges.begin(), b.edges.end(),
                    [](const Edge& x, const Edge& y) { return !differ(x, y); });
}

/// The n-th of actions that lie evenly in the box of the limits: the additive recurrence of the
/// golden ratio's generalisation to m dimensions (M. Roberts, 2018).
Eigen::VectorXd spread_action(const std::vector<Signal>& signals, int n) {
  const auto m = static_cast<Eigen::Index>(signals.size());
  double phi = 2;
  for (int k = 0; k < 30; ++k) phi = std::pow(1 + phi, 1.0 / static_cast<double>(m + 1));
  Eigen::VectorXd action(m);
  for (Eigen::Index s = 0; s < m; ++s) {
    const double u = std::fmod(0.5 + n * std::pow(phi, -static_cast<double>(s + 1)), 1.0);
    const Signal& signal = signals[static_cast<std::size_t>(s)];
    action(s) = signal.lower + u * (signal.upper - signal.lower);
  }
  return action;
}

bool is_alike(const BodySchema& a, const BodySchema& b) {
  const auto is_near = [](const Pose& x, const Matrix6d& of_x, const Pose& y,
                          const Matrix6d& of_y) {
    const Vector6d difference = log(x.inverse() * y);
    const Matrix6d S = of_x + of_y + 1e-12 * Matrix6d::Identity();
    return difference.dot(S.ldlt().solve(difference)) < kAlike;
  };
  if (!is_near(a.X_CR, a.X_CR_covariance, b.X_CR, b.X_CR_covariance)) return false;
  for (int n = 1; n <= kAlikeActions; ++n) {
    const Eigen::VectorXd theta = a.displacements(spread_action(a.signals, n));
    const bool is_alike_here =
        std::equal(a.edges.begin(), a.edges.end(), b.edges.begin(), b.edges.end(),
                   [&](const Edge& x, const Edge& y) {
                     return x.from == y.from && x.to == y.to &&
                            is_near(x.predict(theta), x.prediction_covariance(theta),
                                    y.predict(theta), y.prediction_covariance(theta));
                   });
    if (!is_alike_here) return false;
  }
  return true;
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
      noise_(options.noise),
      credit_(kMostWork),
      schema_(std::move(schema)),
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
  std::vector<AdaptationEvent> old_news;
  for (const ActionPoseSample& sample : past) {
    if (stream_.repeats(sample, schema_.signals)) continue;
    watch_visibility(sample, sample, &old_news);
    tags_.look_back(sample, schema_, noise_);
    if (sample.purpose != Purpose::kTest) continue;
    recent_.push_back(sample);
    drop_moved_tags(moved_tags_, &recent_.back());
  }
  // News of them is for the next sample.
  for (auto& [part, tags] : visibility_)
    for (auto& [tag, visibility] : tags)
      if (tag != kAnyTag) visibility.is_missing = false;
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
  filter_.emplace(schema_, noise_);
  restart_tests();
}

void Adaptation::restart_tests() {
  edges_.assign(static_cast<std::size_t>(filter_->num_nodes()), {});
  markers_ = edges_;
}

double Adaptation::alarm() const {
  return std::log(2.0 * filter_->num_nodes() / options_.false_alarm_rate);
}

double Adaptation::edge_statistic(int part) const {
  const int node = filter_->node_of(part);
  return node < 0 ? 0 : edges_[static_cast<std::size_t>(node)].value;
}

double Adaptation::marker_statistic(int part) const {
  const int node = filter_->node_of(part);
  return node < 0 ? 0 : markers_[static_cast<std::size_t>(node)].value;
}

TreeFilter::Judgement Adaptation::update_tests(const TreeFilter::Instant& instant,
                                               std::int64_t sample_index) {
  const TreeFilter::Judgement now = filter_->judge(instant);
  const auto is_zero = [](const Cusum& c) { return c.value == 0; };
  const bool clear = std::all_of(now.squared_distance.begin(), now.squared_distance.end(),
                                 [](double d2) { return d2 < kClear; });
  if (clear && std::all_of(edges_.begin(), edges_.end(), is_zero) &&
      std::all_of(markers_.begin(), markers_.end(), is_zero))
    return now;
  // What is not explained is not suspected for as long again once it is over: earlier samples count
  // up to a ceiling.
  const double highest = kHighestOverAlarm * alarm();
  const double loudest = is_soft_ ? alarm() / kFewestSoft : std::numeric_limits<double>::infinity();
  const auto add = [sample_index, highest](Cusum* cusum, double ratio) {
    if (cusum->value == 0) cusum->since = sample_index;
    cusum->value = std::max(0.0, std::min(cusum->value, highest) + ratio);
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
    wrong +=
        std::exp(std::min(filter_->judge(instant, cut).log_likelihood - now.log_likelihood, 600.0));
    add(&edges_[static_cast<std::size_t>(node)], std::min(std::log(wrong / 3), loudest));
    if (!instant.seen[static_cast<std::size_t>(node)]) continue;
    Alternative detached;
    detached.detached_node = node;
    add(&markers_[static_cast<std::size_t>(node)],
        filter_->judge(instant, detached).log_likelihood - now.log_likelihood);
  }
  return now;
}

void Adaptation::calibrate() {
  // The filter's own beliefs depend on the scale: a few rounds.
  for (int round = 0; round < 4; ++round) {
    std::vector<double> distances;
    const TreeFilter filter(schema_, noise_);
    for (const ActionPoseSample& sample : recent_) {
      const TreeFilter::Judgement judgement = filter.judge(filter.prepare(sample));
      for (const double d2 : judgement.squared_distance)
        if (d2 >= 0) distances.push_back(d2);
    }
    if (distances.size() < kFewestDistances) return;
    const double scale = std::sqrt(median(distances) / kMedianChiSquare6);
    noise_.scale = std::clamp(noise_.scale * scale, options_.least_noise_scale, kLargestScale);
  }
  // A few samples tell no better than this.
  if (std::abs(std::log(noise_.scale)) < 0.15) noise_.scale = options_.noise.scale;
}

void Adaptation::watch_noise(const TreeFilter::Judgement& judgement) {
  for (std::size_t n = 0; n < judgement.believed.size(); ++n)
    if (judgement.believed[n] == 1) quiet_distances_.push_back(judgement.squared_distance[n]);
  if (++num_quiet_ < kQuietSamples || quiet_distances_.size() < kFewestDistances) return;
  const double scale = std::sqrt(median(quiet_distances_) / kMedianChiSquare6);
  quiet_distances_.clear();
  num_quiet_ = 0;
  if (std::abs(std::log(scale)) < 0.05) return;
  noise_.scale =
      std::clamp(noise_.scale * std::sqrt(scale), options_.least_noise_scale, kLargestScale);
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
  if (!scored.empty() && scored[0].value > options_.suspicion)
    for (const Place& place : around(scored[0].place.part)) add(place);
  return places;
}

std::vector<Adaptation::Place> Adaptation::around(int part) const {
  std::vector<Place> places{{part, false}, {part, true}};
  const int node = filter_->node_of(part);
  if (const int parent = filter_->parent(node); parent >= 0) {
    places.push_back({filter_->part(parent), false});
    places.push_back({filter_->part(parent), true});
  }
  for (const int child : filter_->children(node)) places.push_back({filter_->part(child), false});
  return places;
}

Adaptation::Choice Adaptation::choose(const BodySchema& standing, const std::vector<Place>& places,
                                      const std::vector<const ActionPoseSample*>& samples,
                                      const BodyChange* standing_form, bool learn) const {
  Choice choice;
  std::optional<Replacement> same_form;
  choice.null = log_likelihood(standing, noise_, samples);
  const auto second = [&](Replacement candidate) {
    if (!choice.runner_up || candidate.fitted.log_evidence > choice.runner_up->fitted.log_evidence)
      choice.runner_up = std::move(candidate);
  };
  const auto offer = [&](Replacement candidate) {
    const FittedChange& fitted = candidate.fitted;
    if (standing_form && fitted.change == *standing_form &&
        (!same_form || fitted.log_evidence > same_form->fitted.log_evidence))
      same_form = candidate;
    if (choice.best && fitted.log_evidence <= choice.best->fitted.log_evidence) {
      second(std::move(candidate));
      return;
    }
    if (choice.best) second(std::move(*choice.best));
    choice.best = std::move(candidate);
  };
  // What could not be explained for so long is not explained by a change of a body of the past.
  const bool is_old = !standing_form && static_cast<int>(samples.size()) > kManySamples;
  for (const Place& at : places) {
    // Bases: the model that stands, and what is stored of this place.
    std::vector<const BodySchema*> origins{nullptr};
    std::vector<BodySchema> bases{standing};
    if (!at.marker) {
      for (const BodySchema& stored : history_) {
        BodySchema with = with_edge_of(standing, stored, at.part);
        const bool known = std::any_of(bases.begin(), bases.end(), [&](const BodySchema& base) {
          return !differ_at(base, with, at.part);
        });
        if (known) continue;
        bases.push_back(std::move(with));
        origins.push_back(&stored);
      }
    }
    for (std::size_t b = 0; b < bases.size(); ++b) {
      const PlaceEvidence evidence(bases[b], noise_, at.part, at.marker, samples);
      const auto offer_from = [&](FittedChange candidate) {
        if (origins[b]) candidate.origin = *origins[b];
        offer({at, std::move(candidate)});
      };
      if (b > 0 && evidence.num_usable() > 0) offer_from(evidence.judge_stored(bases[b]));
      if (b > 0 && is_old) continue;
      choice.work += static_cast<int>(samples.size());
      for (FittedChange& fitted :
           evidence.fit_likely(possible_changes(bases[b], at.part, at.marker)))
        offer_from(std::move(fitted));
      if (!learn || b > 0) continue;
      for (FittedChange& learned : evidence.learn()) offer({at, std::move(learned)});
    }
  }
  // All that differs from a stored schema at once.
  for (const BodySchema& stored : history_) {
    FittedChange all;
    all.change = {BodyChange::Form::kStored, places.front().part};
    all.origin = stored;
    all.everywhere = true;
    const BodySchema with = with_change(standing, all);
    int num_different = differ_at(standing, with, standing.root);
    for (const Edge& edge : with.edges) num_different += differ_at(standing, with, edge.to);
    if (num_different < 2) continue;
    all.log_prior = all.change.log_odds();
    all.log_evidence = all.log_prior + log_likelihood(with, noise_, samples);
    all.num_usable = 1;
    // It is wherever it makes a difference, first where that was suspected: an outlier elsewhere
    // may be the greatest suspicion.
    std::vector<Place> at = differences(standing, with);
    std::stable_sort(at.begin(), at.end(), [&places](const Place& a, const Place& b) {
      return std::find(places.begin(), places.end(), a) <
             std::find(places.begin(), places.end(), b);
    });
    all.change.part = at.front().part;
    offer({at.front(), std::move(all), {at.begin() + 1, at.end()}});
  }
  // With many samples what the schema was wrong about before the change is found out too, and
  // dressed up as a richer form of it.
  if (same_form && choice.best->fitted.change != *standing_form &&
      static_cast<int>(samples.size()) >= kManySamples &&
      choice.best->fitted.log_evidence - same_form->fitted.log_evidence <
          options_.ambiguity + kSystematicShare * choice.margin()) {
    choice.runner_up = std::move(choice.best);
    choice.best = std::move(same_form);
  }
  return choice;
}

BodySchema Adaptation::composed(int without) const {
  BodySchema schema = before_;
  for (int n = 0; n < static_cast<int>(replacements_.size()); ++n)
    if (n != without) schema = with_change(schema, replacements_[n].fitted);
  return schema;
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
    told.margin = margin;
    told.num_samples = num_samples;
    events->push_back(std::move(told));
  }
}

/// The places in which two schemas of the same tree differ: markers first, of parts that lie
/// elsewhere between edges which together lead to where they led, then edges.
std::vector<Adaptation::Place> Adaptation::differences(const BodySchema& a, const BodySchema& b) {
  Eigen::VectorXd action(static_cast<Eigen::Index>(a.signals.size()));
  for (Eigen::Index s = 0; s < action.size(); ++s) {
    const Signal& signal = a.signals[static_cast<std::size_t>(s)];
    action(s) = 0.25 * signal.lower + 0.75 * signal.upper;  // nothing special about it
  }
  const auto pose_in_parent = [&action](const BodySchema& schema, int part) {
    const Edge* edge = edge_to(schema, part);
    return edge ? edge->predict(schema.displacements(action)) : schema.X_CR;
  };
  std::set<int> edges;
  for (const int part : a.parts)
    if (differ_at(a, b, part)) edges.insert(part);
  std::vector<Place> places;
  for (const int part : a.parts) {
    std::vector<int> children;
    for (const Edge& edge : a.edges)
      if (edge.from == part) children.push_back(edge.to);
    if (!edges.contains(part) || children.empty()) continue;
    const Pose X_a = pose_in_parent(a, part), X_b = pose_in_parent(b, part);
    const bool only_the_marker = std::all_of(children.begin(), children.end(), [&](int child) {
      return edges.contains(child) &&
             (X_a * pose_in_parent(a, child)).isApprox(X_b * pose_in_parent(b, child), 1e-6);
    });
    if (!only_the_marker) continue;
    places.push_back({part, true});
    edges.erase(part);
    for (const int child : children) edges.erase(child);
  }
  for (const int part : edges) places.push_back({part, false});
  return places;
}

double Adaptation::required_margin(const Place& place, std::int64_t sample_index) const {
  const auto it = reversions_.find(place);
  const bool is_recent = it != reversions_.end() && it->second.last + kSoon >= sample_index;
  return options_.acceptance * (is_recent ? 1 + it->second.num : 1);
}

void Adaptation::try_changes(std::int64_t sample_index, std::vector<AdaptationEvent>* events) {
  const std::vector<Place> places = suspects();
  if (places.empty()) return;
  std::int64_t since = sample_index;
  double highest = 0, second = 0;
  for (std::size_t n = 0; n < edges_.size(); ++n) {
    for (const Cusum* c : {&edges_[n], &markers_[n]}) {
      second = std::max(second, std::min(c->value, highest));
      if (c->value > highest) {
        highest = c->value;
        since = c->since;
      }
    }
  }
  // What nothing explained so far is looked at again when there is clearly more of it.
  if (detected_ && !is_worth_a_fit(sample_index - since + 1)) return;
  const auto samples = segment(since, options_.longest_segment);
  Choice choice;
  if (credit_ > 0) choice = choose(schema_, places, samples);
  credit_ -= choice.work;
  const bool accepted = choice.best &&
                        choice.margin() > required_margin(choice.best->place, sample_index) &&
                        (!is_soft_ || static_cast<int>(samples.size()) >= kFewestSoft);
  // Edges between which nothing was seen are suspected alike: which one it is is told later, if
  // there is more evidence of it. (A lead may also come from evidence against all of them.)
  const bool is_rising = !detected_ || highest > std::min(untold_, kHighestOverAlarm * alarm());
  const bool is_clear =
      accepted || (is_rising && highest > alarm() &&
                   (highest - second > kClearLead || samples.size() >= kLongestUnclear));
  if (detected_ ? !is_told_ : accepted || highest > alarm()) {
    detected_ = accepted ? choice.best->place : places.front();
    is_told_ = is_clear;
    untold_ = highest;
    if (!is_clear) return;
    AdaptationEvent mismatch = event(AdaptationEvent::Kind::kMismatch, sample_index, *detected_);
    if (!detected_->marker && detected_->part == schema_.root) mismatch.cause = "camera_moved";
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
      begin_drift(part, sample_index, events);
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
  const bool began_later = !replacements_.empty() && earlier.size() >= kStoodAlone &&
                           log_likelihood(with_change(schema_, fitted), noise_, earlier) <
                               log_likelihood(schema_, noise_, earlier) - 4 * options_.acceptance;
  if (replacements_.empty() || since - since_ > kTogether || fitted.everywhere || ends ||
      began_later) {
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
    trouble_.emplace();
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
  const double standing = log_likelihood(schema_, noise_, samples);
  std::optional<Replacement> best;
  BodySchema before;
  // This edge as it was, the others too or as they are now.
  std::vector<BodySchema> bases{trouble_->before};
  if (std::any_of(schema_.parts.begin(), schema_.parts.end(), [&](int other) {
        return other != part && differ_at(schema_, trouble_->before, other);
      }))
    bases.push_back(with_edge_of(schema_, trouble_->before, part));
  for (const BodySchema& base : bases) {
    const PlaceEvidence evidence(base, noise_, part, false, samples);
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
      log_likelihood(with, noise_, newest) < log_likelihood(schema_, noise_, newest))
    return;
  AdaptationEvent candidate = event(AdaptationEvent::Kind::kCandidate, sample_index, best->place);
  candidate.cause = best->fitted.change.cause(schema_);
  candidate.margin = margin;
  candidate.num_samples = static_cast<int>(samples.size());
  events->push_back(candidate);
  for (const Replacement& r : replacements_)
    tell(AdaptationEvent::Kind::kReverted, sample_index, r, 0, 0, events);
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
  std::vector<Place> places = around(here.place.part);
  std::erase(places, here.place);
  Choice there = choose(before_, places, samples);
  credit_ -= there.work;
  const double standing = log_likelihood(composed(), noise_, samples) + here.fitted.log_prior;
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
  for (int round = 0; round < rounds; ++round) {
    bool is_changed = false;
    for (int n = 0; n < static_cast<int>(replacements_.size());) {
      Replacement& r = replacements_[static_cast<std::size_t>(n)];
      const BodySchema others = composed(n);
      if (!all_forms) {
        if (r.fitted.change.size() > 0) {
          const BodySchema base =
              r.fitted.origin ? with_edge_of(others, *r.fitted.origin, r.place.part) : others;
          const PlaceEvidence evidence(base, noise_, r.place.part, r.place.marker, samples);
          if (auto again = evidence.fit(r.fitted.change)) {
            again->origin = r.fitted.origin;
            r.fitted = *again;
          }
        }
        ++n;
        continue;
      }
      Choice choice =
          choose(others, {r.place}, samples, &r.fitted.change, r.fitted.change.is_learned());
      credit_ -= choice.work;
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
    if (!is_changed) break;
  }
  const bool is_another = all_forms && reconsider_place(samples, sample_index, events);
  const std::vector<Cusum> edges = edges_, markers = markers_;
  install(composed());
  if (age_ > 0 && !is_another) {
    edges_ = edges;
    markers_ = markers;
  }
}

void Adaptation::want_probe(const BodySchema& standing, const Choice& choice,
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
  double most = 1;
  Eigen::VectorXd probe;
  for (int n = 1; n <= kProbeCandidates; ++n) {
    const Eigen::VectorXd action = spread_action(standing.signals, n);
    const auto X = one.predict_all(action), Y = other.predict_all(action);
    for (const auto& [part, X_RB] : X) {
      const auto it = Y.find(part);
      if (it == Y.end()) continue;
      const Pose difference = X_RB.inverse() * it->second;
      const double size = difference.translation().norm() / options_.tolerance.position_m +
                          rotation_angle(difference) / options_.tolerance.rotation_rad;
      if (size > most) {
        most = size;
        probe = action;
      }
    }
  }
  if (probe.size() == 0) return;
  AdaptationEvent wanted =
      event(AdaptationEvent::Kind::kProbeWanted, sample_index, choice.best->place);
  wanted.cause = choice.best->fitted.change.cause(standing) + " or " +
                 choice.runner_up->fitted.change.cause(standing);
  wanted.margin = lead;
  wanted.probe = probe;
  asked_.push_back(ambiguity);
  events->push_back(wanted);
}

std::vector<int> Adaptation::missing_parts() const {
  std::vector<int> parts;
  for (const auto& [part, tags] : visibility_)
    if (tags.at(kAnyTag).is_missing) parts.push_back(part);
  return parts;
}

void Adaptation::watch_visibility(const ActionPoseSample& sample, const ActionPoseSample& used,
                                  std::vector<AdaptationEvent>* events) {
  for (const int part : schema_.parts) {
    const PartObservation* seen = sample.find(part);
    // A marker that lies somewhere is none; a tag that moved is still one.
    if (seen && !used.find(part) && !rests_on_moved_tag(*seen)) seen = nullptr;
    watch_visibility_of(part, kAnyTag, seen, sample.sample_index, events);
    // An arm that holds still or is led shows one side of its parts for as long.
    if (!seen || sample.purpose == Purpose::kControl) continue;
    for (const int tag : seen->tags) visibility_[part][tag];
    if (visibility_[part].size() < 3) continue;  // its only tag is the part's marker
    for (const auto& [tag, visibility] : visibility_[part]) {
      if (tag == kAnyTag || tags_.has_moved(tag)) continue;
      const bool is_seen = std::find(seen->tags.begin(), seen->tags.end(), tag) != seen->tags.end();
      watch_visibility_of(part, tag, is_seen, sample.sample_index, events);
    }
  }
}

/// From sample `since` on, as is known at sample `found`.
void Adaptation::set_aside(int tag, std::int64_t since, std::int64_t found) {
  if (moved_tags_.size() == BodySchema::kMaxMovedTags) moved_tags_.erase(moved_tags_.begin());
  moved_tags_.push_back({tag, stream_.sample_index_of(found), stream_.sample_index_of(since)});
}

void Adaptation::watch_visibility_of(int part, int tag, bool is_seen, std::int64_t sample_index,
                                     std::vector<AdaptationEvent>* events) {
  Visibility& v = visibility_[part][tag];
  const auto tell = [&](AdaptationEvent::Kind kind) {
    AdaptationEvent told = event(kind, sample_index, {part, true});
    told.tag = tag;
    told.cause = "marker_missing";
    told.num_samples = v.num_missed;
    events->push_back(std::move(told));
  };
  if (is_seen) {
    // What is seen again need not be seen as often as before.
    if (v.is_missing) {
      tell(AdaptationEvent::Kind::kRecovered);
      v = {};
    }
    v.num_asked += v.num_missed + 1;
    v.num_missed = 0;
    ++v.num_seen;
    return;
  }
  ++v.num_missed;
  if (v.is_missing || v.num_seen < kFewestSightings) return;
  // A run of m misses begins at any sample with probability v (1 − v)^m; n parts and tags may.
  const auto num = std::accumulate(
      visibility_.begin(), visibility_.end(), std::size_t{0},
      [](std::size_t sum, const auto& of_part) { return sum + of_part.second.size(); });
  const double share = (v.num_seen + 0.5) / (v.num_asked + 1.0);
  const double chance = share * std::pow(1 - share, v.num_missed) * static_cast<double>(num);
  if (chance > options_.false_alarm_rate) return;
  v.is_missing = true;
  tell(AdaptationEvent::Kind::kMissing);
}

void Adaptation::watch_tags(ActionPoseSample* sample, std::vector<AdaptationEvent>* events) {
  if (num_samples_ >= options_.calibration_samples) {
    for (const MovedTags::Finding& finding : tags_.look(*sample, trusted_, noise_)) {
      using Kind = AdaptationEvent::Kind;
      const Kind kind = finding.is_back ? (finding.is_on_part ? Kind::kRestored : Kind::kRecovered)
                                        : (finding.is_on_part ? Kind::kCandidate : Kind::kMissing);
      AdaptationEvent told = event(kind, sample->sample_index, {finding.part, true});
      told.tag = finding.tag;
      told.cause = finding.is_on_part ? "marker_moved" : "marker_missing";
      told.num_samples = finding.num_sightings;
      events->push_back(std::move(told));
      if (finding.is_back) {
        for (MovedTag& moved : moved_tags_)
          if (moved.tag == finding.tag && moved.until < 0)
            moved.until = stream_.sample_index_of(sample->sample_index);
        visibility_[finding.part][finding.tag] = {};
      } else {
        set_aside(finding.tag, finding.since, sample->sample_index);
        take_back(finding, sample->sample_index, events);
      }
    }
  }
  std::erase_if(sample->parts, [this](const PartObservation& o) { return rests_on_moved_tag(o); });
}

bool Adaptation::rests_on_moved_tag(const PartObservation& observation) const {
  return std::any_of(observation.tags.begin(), observation.tags.end(),
                     [this](int tag) { return tags_.has_moved(tag); });
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
    const auto since = fallen_.look(*sample, part, schema_.X_CR * X_RB, noise_);
    if (!since) continue;
    drop(part, sample);
    Visibility& v = visibility_[part][kAnyTag];
    if (v.is_missing) continue;
    v.is_missing = true;
    for (ActionPoseSample& earlier : recent_) {
      if (earlier.sample_index < *since) continue;
      drop(part, &earlier);
      ++v.num_missed;
    }
    AdaptationEvent missing =
        event(AdaptationEvent::Kind::kMissing, sample->sample_index, {part, true});
    missing.cause = "marker_missing";
    missing.num_samples = v.num_missed + 1;
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

void Adaptation::mature(std::int64_t sample_index) {
  if (++age_ > options_.matured_after) {
    maturing_.clear();
    return;
  }
  if (age_ % kMaturing != 0 || !suspects().empty()) return;
  const BodySchema settled = schema_;
  std::swap(replacements_, maturing_);
  reconsider(sample_index, false, nullptr);  // the forms stay: nothing to tell
  std::swap(replacements_, maturing_);
  trusted_ = schema_;
  for (BodySchema& stored : history_)
    if (is_same(stored, settled)) stored = schema_;
}

void Adaptation::begin_drift(int part, std::int64_t sample_index,
                             std::vector<AdaptationEvent>* events) {
  drifting_ = part;
  maturing_.clear();
  trouble_.reset();
  before_ = schema_;
  num_still_ = 0;
  detected_.reset();
  AdaptationEvent drift = event(AdaptationEvent::Kind::kDrift, sample_index, {part, false});
  drift.cause = "drift";
  events->push_back(drift);
}

void Adaptation::watch_drift(std::int64_t sample_index, std::vector<AdaptationEvent>* events) {
  if (!drifting_) {
    if (!replacements_.empty() || detected_) return;
    const auto moved = drift_watch_.moved_part(schema_);
    if (!moved) return;
    begin_drift(*moved, sample_index, events);
  }
  const auto drift = drift_watch_.follow(before_, *drifting_);
  if (!drift) return;
  const BodyChange change{drift->left ? BodyChange::Form::kLeft : BodyChange::Form::kRight,
                          *drifting_};
  Eigen::VectorXd theta(6);
  theta << drift->T.translation(), log_so3(drift->T.linear());
  // `covariance` is that of a right perturbation of T: near enough to that of θ. What is suspected
  // elsewhere meanwhile stays so.
  std::vector<Cusum> edges = edges_, markers = markers_;
  install(changed(before_, change, theta, drift->covariance));
  const auto node = static_cast<std::size_t>(filter_->node_of(*drifting_));
  edges[node] = markers[node] = {};
  edges_ = std::move(edges);
  markers_ = std::move(markers);
  num_still_ = drift->significance > kSignificantRate ? 0 : num_still_ + 1;
  if (num_still_ < options_.settled_after) return;
  AdaptationEvent recovered =
      event(AdaptationEvent::Kind::kRecovered, sample_index, {*drifting_, false});
  recovered.cause = "drift";
  events->push_back(recovered);
  drift_watch_.forget(*drifting_, sample_index);
  remember(schema_);
  trusted_ = schema_;
  tags_.begin_anew();
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
  for (AdaptationEvent& event : events) event.sample_index = seen.sample_index;
  return events;
}

std::vector<AdaptationEvent> Adaptation::on_new_sample(ActionPoseSample sample) {
  std::vector<AdaptationEvent> events;
  const ActionPoseSample seen = sample;
  watch_tags(&sample, &events);
  if (num_samples_ >= options_.calibration_samples) drop_fallen(&sample, &events);
  watch_visibility(seen, sample, &events);
  for (const AdaptationEvent& event : events) {
    if (event.kind != AdaptationEvent::Kind::kMissing || event.tag < 0 ||
        tags_.has_moved(event.tag))
      continue;
    tags_.lose(event.tag);
    set_aside(event.tag, event.sample_index - event.num_samples + 1, event.sample_index);
  }
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
  const TreeFilter::Judgement judgement = update_tests(instant, sample.sample_index);
  drift_watch_.add(*filter_, instant, schema_.displacements(sample.action), sample.sample_index);
  if (!replacements_.empty())
    follow(sample.sample_index, &events);
  else if (!maturing_.empty())
    mature(sample.sample_index);
  try_changes(sample.sample_index, &events);
  try_learning(sample.sample_index, &events);
  // A body that moves otherwise shows other sides of its parts.
  const auto is_change = [](const AdaptationEvent& e) {
    return e.tag < 0 && (e.kind == AdaptationEvent::Kind::kCandidate ||
                         e.kind == AdaptationEvent::Kind::kRestored);
  };
  if (std::any_of(events.begin(), events.end(), is_change))
    for (auto& [part, tags] : visibility_)
      std::erase_if(tags, [](const auto& of_tag) { return of_tag.first != kAnyTag; });
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
