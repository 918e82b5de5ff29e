#include "processes/model_monitor/hypotheses/hypothesis_tracker.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "processes/model_monitor/hypotheses/schema_difference.h"

namespace bodyschema {
namespace {

using Kind = AdaptationEvent::Kind;

constexpr std::size_t kRing = 96;
constexpr std::size_t kBeam = 12;
/// Of a CUSUM, from which on it is told which place is wrong, although nothing explains it [nats];
/// or after so many samples.
constexpr double kClearLead = 1;
constexpr std::int64_t kLongestUnclear = 3;
/// Samples below which nothing is found out where an edge is soft.
constexpr int kFewestSoft = 3;
/// Where outliers are more frequent by this factor than told, a change is not found from fewer of
/// them than come in a row by chance: some agree, as flips in like views do.
constexpr double kMoreOutliers = 2;
constexpr double kLeastChanceOfRow = 1e-4;  // chosen: a moved marker of the trunk needs 4 samples
/// What the settled body is off by from the start, as a share of what a change explains.
constexpr double kSystematicShare = 0.03;
/// Samples from one fit of what has settled to the next.
constexpr int kMaturing = 10;
/// Samples that all forms of change in one place are fitted to are counted: so many are free a
/// sample, and so many are saved up at most. Less would be done than a fault of two places needs.
constexpr int kWorkPerSample = 4;
constexpr int kMostWork = 1000;

bool is_in(const std::vector<ElementId>& elements, const ElementId& element) {
  return std::ranges::find(elements, element) != elements.end();
}

}  // namespace

HypothesisTracker::HypothesisTracker(BodySchema settled, const MeasurementModel& measurement,
                                     const AdaptationOptions& options, bool is_soft)
    : options_(options),
      is_soft_(is_soft),
      measurement_(measurement),
      settled_(std::move(settled)),
      work_budget_(kMostWork) {
  history_.push_back(settled_);
  begin(BodySchema(settled_), measurement);
}

void HypothesisTracker::set_settled(const BodySchema& settled, std::int64_t since) {
  settled_ = settled;
  settled_filter_ = std::make_shared<TreeFilter>(settled_, measurement_);
  for (Seen& seen : recent_)
    if (seen.sample.sample_index >= since)
      seen.settled = settled_filter_->log_likelihood(seen.sample);
  beam_.assign(1, {{}, settled_, settled_filter_, 0});
}

void HypothesisTracker::begin(const BodySchema& settled, const MeasurementModel& measurement) {
  measurement_ = measurement;
  set_settled(settled);
  detected_.reset();
  begin_tests(std::numeric_limits<std::int64_t>::max());
}

void HypothesisTracker::follow(const BodySchema& settled, int part) {
  // What is suspected elsewhere is judged by the body as it is now.
  const SequentialTests::Cusum cusum = tests_->highest().cusum;
  const std::int64_t newest = recent_.empty() ? 0 : recent_.back().sample.sample_index;
  set_settled(settled, cusum.value > 0 ? std::min(cusum.since, newest) : newest);
  tests_->clear(settled_filter_->node_of(part));
}

void HypothesisTracker::set_history(std::vector<BodySchema> history) {
  history_ = std::move(history);
  remember(settled_);
}

std::vector<ElementId> HypothesisTracker::suspects() const {
  return tests_->suspects(filter(), options_.suspicion);
}

std::int64_t HypothesisTracker::trouble_since() const {
  const SequentialTests::Cusum cusum = tests_->highest().cusum;
  std::int64_t since =
      cusum.value > options_.suspicion ? cusum.since : std::numeric_limits<std::int64_t>::max();
  for (const Change& c : changes()) since = std::min(since, c.since);
  return since;
}

bool HypothesisTracker::was_adopted_at(std::int64_t sample) const {
  return std::ranges::any_of(changes(), [sample](const Change& c) { return c.adopted == sample; });
}

double HypothesisTracker::most_log_odds() const {
  double most = 0;
  for (const Hypothesis& h : beam_) most = std::max(most, h.log_odds);
  return most;
}

void HypothesisTracker::go_on_fitting(BodySchema base, Change change) {
  const std::int64_t adopted = change.adopted;
  maturing_ = {std::move(base), {std::move(change)}, adopted};
}

std::int64_t HypothesisTracker::newest_adopted() const {
  std::int64_t newest = 0;
  for (const Change& c : changes()) newest = std::max(newest, c.adopted);
  return newest;
}

std::vector<ActionPoseSample> HypothesisTracker::recent() const {
  std::vector<ActionPoseSample> result;
  for (const Seen& seen : recent_) result.push_back(seen.sample);
  return result;
}

const HypothesisTracker::Change* HypothesisTracker::last_at(const std::vector<Change>& changes,
                                                            const ElementId& element) {
  for (auto c = changes.rbegin(); c != changes.rend(); ++c)
    if (c->what.element == element) return &*c;
  return nullptr;
}

SequentialTests HypothesisTracker::tests_of(const TreeFilter& filter, std::int64_t since) const {
  // However loud, one sample finds nothing out where a model is soft.
  const double loudest =
      is_soft_ ? alarm_threshold(filter.num_nodes(), options_.false_alarm_rate) / kFewestSoft
               : std::numeric_limits<double>::infinity();
  SequentialTests tests(filter, options_.false_alarm_rate, loudest);
  for (const Seen& seen : recent_)
    if (seen.sample.sample_index >= since)
      tests.update(filter, filter.prepare(seen.sample), seen.sample.sample_index);
  return tests;
}

void HypothesisTracker::begin_tests(std::int64_t since) { tests_ = tests_of(filter(), since); }

std::vector<ElementId> HypothesisTracker::suspects_of_settled(std::int64_t since) const {
  return tests_of(*settled_filter_, since).suspects(*settled_filter_, options_.suspicion);
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

BodySchema HypothesisTracker::composed(const std::vector<Change>& changes,
                                       std::size_t without) const {
  BodySchema schema = settled_;
  for (std::size_t n = 0; n < changes.size(); ++n)
    if (n != without && is_possible(changes[n].what.fitted, schema))
      schema = with_change(schema, changes[n].what.fitted);
  return schema;
}

bool HypothesisTracker::is_same_change(const Change& a, const Change& b) {
  return a.since == b.since && is_same_explanation(a.what, b.what);
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
    const std::int64_t until =
        n + 1 < changes.size() ? changes[n + 1].since : std::numeric_limits<std::int64_t>::max();
    const TreeFilter filter(body, measurement_);
    for (const Seen& seen : recent_)
      if (seen.sample.sample_index >= changes[n].since && seen.sample.sample_index < until)
        odds += filter.log_likelihood(seen.sample) - seen.settled;
  }
  return odds;
}

bool HypothesisTracker::is_standing(const std::vector<Change>& changes) const {
  return std::ranges::equal(changes, standing().changes, is_same_change);
}

void HypothesisTracker::offer(Hypothesis hypothesis) {
  const auto is_it = [&](const Hypothesis& other) {
    return std::ranges::equal(other.changes, hypothesis.changes, is_same_change);
  };
  beam_.erase(std::remove_if(beam_.begin() + 1, beam_.end(), is_it), beam_.end());
  if (is_standing(hypothesis.changes)) return;
  beam_.push_back(std::move(hypothesis));
  if (beam_.size() <= kBeam) return;
  const auto least = std::min_element(beam_.begin() + 1, beam_.end(),
                                      [](const Hypothesis& a, const Hypothesis& b) {
                                        if (a.changes.empty() != b.changes.empty())
                                          return b.changes.empty();
                                        return a.log_odds < b.log_odds;
                                      });
  beam_.erase(least);
}

bool HypothesisTracker::may_be_outliers(const ElementId& element, std::int64_t since) const {
  const double rate = measurement_.outlier_rate;
  if (rate < kMoreOutliers * options_.measurement.outlier_rate) return false;
  const auto is_concerned = [&](int node) {
    if (element.is_camera() || element.id == filter().part(node)) return true;
    if (element.is_tag()) return false;
    while (node > 0 && filter().part(node) != element.id) node = filter().parent(node);
    return node > 0;
  };
  int num_outliers = 0;
  for (const Seen& seen : recent_) {
    if (seen.sample.sample_index < since) continue;
    const auto believed = filter().judge(filter().prepare(seen.sample)).believed;
    for (int node = 0; node < filter().num_nodes(); ++node)
      num_outliers += believed[static_cast<std::size_t>(node)] == 0 && is_concerned(node);
  }
  return std::pow(rate, num_outliers) > kLeastChanceOfRow;
}

double HypothesisTracker::needed_lead(const Hypothesis& other, std::int64_t now) const {
  const double systematic = kSystematicShare * std::max(0.0, log_odds());
  const auto is_learned = [](const Change& c) { return c.what.fitted.change.is_learned(); };
  bool is_new = other.changes.size() > changes().size();
  for (const Change& c : other.changes) {
    const bool is_at_new_place = !last_at(changes(), c.what.element);
    is_new |= is_at_new_place;
    if (is_at_new_place && may_be_outliers(c.what.element, c.since))
      return std::numeric_limits<double>::infinity();
    is_new |= is_learned(c) && std::ranges::none_of(changes(), is_learned);
    if (is_soft_ && now - c.since + 1 < kFewestSoft) return std::numeric_limits<double>::infinity();
  }
  if (is_new) return options_.acceptance + systematic;
  return other.changes.size() < changes().size() ? 0 : options_.ambiguity + systematic;
}

void HypothesisTracker::choose(std::int64_t now, std::vector<AdaptationEvent>* events) {
  // Whoever seems to lead is fitted to all its samples before it stands.
  std::optional<Hypothesis> next;
  for (Hypothesis rival : std::vector<Hypothesis>(beam_.begin() + 1, beam_.end())) {
    if (rival.log_odds - log_odds() <= needed_lead(rival, now)) continue;
    if (next && rival.log_odds <= next->log_odds) continue;
    if (!rival.changes.empty())
      rival = fitted_again(rival, rival.changes.size() > 1, options_.settled_after, now);
    const bool is_leading = rival.log_odds - log_odds() > needed_lead(rival, now);
    if (is_leading && (!next || rival.log_odds > next->log_odds))
      next = std::move(rival);
    else
      offer(std::move(rival));
  }
  if (next) stand(std::move(*next), now, events);
}

void HypothesisTracker::stand(Hypothesis next, std::int64_t now,
                              std::vector<AdaptationEvent>* events) {
  bool is_another = next.changes.size() != changes().size();
  for (Change& c : next.changes) {
    const auto standing_one = std::ranges::find_if(changes(), [&](const Change& other) {
      return other.what.element == c.what.element && other.since == c.since;
    });
    c.adopted = standing_one == changes().end() ? now : standing_one->adopted;
    is_another |= standing_one == changes().end() || !is_same_change(*standing_one, c);
  }
  if (!is_another) {
    beam_.front() = std::move(next);
    return;
  }
  if (next.changes.size() > changes().size() && !(detected_ && is_told_)) {
    AdaptationEvent mismatch = event(Kind::kMismatch, now, next.changes.back().what.element);
    mismatch.since = next.changes.back().since;
    mismatch.num_samples = static_cast<int>(now - mismatch.since + 1);
    mismatch.margin = tests_->highest().cusum.value;
    if (next.changes.back().what.element.is_camera()) mismatch.cause = "camera_moved";
    events->push_back(mismatch);
    note_mismatch(next.changes.back().what.element, now);
  }
  tell_difference(standing(), next, now, events);
  std::int64_t since = std::numeric_limits<std::int64_t>::max();
  for (const Hypothesis* of : {&std::as_const(next), &standing()})
    for (const Change& c : of->changes) since = std::min(since, c.since);
  Hypothesis before = std::exchange(beam_.front(), std::move(next));
  offer(std::move(before));
  detected_.reset();
  maturing_.reset();
  // What the explanation that was taken back was wrong about is nobody's fault.
  begin_tests(since);
}

void HypothesisTracker::detect(std::int64_t now, std::vector<AdaptationEvent>* events) {
  const std::vector<ElementId> elements = suspects();
  if (elements.empty()) {
    if (detected_ && is_told_) {
      events->push_back(event(Kind::kRecovered, now, *detected_));
      events->back().cause = "unexplained";
    }
    detected_.reset();
    return;
  }
  const auto [cusum, second] = tests_->highest();
  if (cusum.value <= tests_->alarm() || (detected_ && is_told_) ||
      may_be_outliers(elements.front(), cusum.since))
    return;
  // What a young explanation leaves elsewhere may be its own fault.
  const auto is_beside = [&](const Change& c) {
    return is_in(elements_around(filter(), c.what.element.id), elements.front());
  };
  if (!changes().empty() && now - newest_adopted() <= kUnexplained &&
      std::ranges::none_of(changes(), is_beside))
    return;
  // Edges between which nothing was seen are suspected alike: which one it is is told later, if
  // there is more evidence of it. (A lead may also come from evidence against all of them.)
  const bool is_rising = !detected_ || cusum.value > std::min(unreported_, tests_->ceiling());
  is_told_ =
      is_rising && (cusum.value - second > kClearLead || now - cusum.since >= kLongestUnclear);
  detected_ = elements.front();
  unreported_ = cusum.value;
  if (!is_told_) return;
  AdaptationEvent mismatch = event(Kind::kMismatch, now, *detected_);
  if (detected_->is_camera()) mismatch.cause = "camera_moved";
  mismatch.since = cusum.since;
  mismatch.margin = cusum.value;
  mismatch.num_samples = static_cast<int>(now - cusum.since + 1);
  note_mismatch(*detected_, now);
  events->push_back(mismatch);
}

void HypothesisTracker::drop_stale() {
  // One change more is pursued while something is suspected, and since it began: what a model is
  // off by from the start adds up to evidence of a change, too. (An edge is learned from all
  // samples of the trouble, so its change is older.)
  const std::size_t most = changes().size();
  const bool is_quiet = suspects().empty();
  const std::int64_t since = tests_->highest().cusum.since;
  std::erase_if(beam_, [&](const Hypothesis& h) {
    if (h.changes.size() <= most) return false;
    const Change& newest = h.changes.back();
    return is_quiet || (newest.since < since && !newest.what.fitted.change.is_learned());
  });
  if (is_quiet && most == 0) mismatched_.clear();
}

void HypothesisTracker::note_mismatch(const ElementId& element, std::int64_t now) {
  mismatched_[element] = last_mismatch_ = now;
}

void HypothesisTracker::settle(std::int64_t now, std::vector<AdaptationEvent>* events) {
  if (changes().empty() || now - newest_adopted() < options_.settled_after) return;
  for (const Change& c : changes())
    if (last_at(changes(), c.what.element) == &c) {
      const std::size_t first = events->size();
      tell(Kind::kRecovered, now, standing(), c, 0, events);
      for (std::size_t n = first; n < events->size(); ++n)
        (*events)[n].num_samples = static_cast<int>(now - c.adopted);
    }
  // Of a drift, which may look like small changes, the mean of many samples is not what is now.
  const bool any_small =
      std::ranges::any_of(changes(), [](const Change& c) { return c.what.fitted.change.small; });
  maturing_.reset();
  if (!any_small) maturing_ = {settled_, changes(), newest_adopted()};
  set_settled(BodySchema(schema()));
  remember(settled_);
}

void HypothesisTracker::mature(std::int64_t now) {
  if (!maturing_) return;
  if (now - maturing_->adopted > options_.matured_after) {
    maturing_.reset();
    return;
  }
  if ((now - maturing_->adopted) % kMaturing != 0 || !suspects().empty()) return;
  const BodySchema before = settled_;
  settled_ = maturing_->base;
  for (std::size_t n = 0; n < maturing_->changes.size(); ++n) {
    Change& c = maturing_->changes[n];
    if (last_at(maturing_->changes, c.what.element) == &c)
      refit(composed(maturing_->changes, n), options_.matured_after, &c);
  }
  const SequentialTests tests = *tests_;
  set_settled(composed(maturing_->changes, maturing_->changes.size()));
  tests_ = tests;
  for (BodySchema& stored : history_)
    if (is_same(stored, before)) stored = settled_;
}

void HypothesisTracker::keep_all() {
  remember(schema());
  begin(BodySchema(schema()), measurement_);
}

void HypothesisTracker::take_back_all(std::int64_t sample, std::vector<AdaptationEvent>* events) {
  const Hypothesis nothing{{}, settled_, settled_filter_, 0};
  tell_difference(standing(), nothing, sample, events);
  begin(BodySchema(settled_), measurement_);
}

void HypothesisTracker::take_back(const std::function<bool(const ElementId&)>& is_at,
                                  std::int64_t since, const Filter& clean, std::int64_t sample,
                                  std::vector<AdaptationEvent>* events) {
  for (Seen& seen : recent_) {
    if (seen.sample.sample_index < since) continue;
    clean(&seen.sample);
    seen.settled = settled_filter_->log_likelihood(seen.sample);
  }
  const auto is_of_it = [&](const Change& c) { return c.since >= since && is_at(c.what.element); };
  std::vector<Change> rest = changes();
  std::erase_if(rest, is_of_it);
  Hypothesis next = made_of(std::move(rest));
  next.log_odds = log_odds_of(next.changes);
  tell_difference(standing(), next, sample, events);
  const bool is_nothing = next.changes.empty();
  beam_.assign(1, std::move(next));
  if (!is_nothing) offer({{}, settled_, settled_filter_, 0});
  if (detected_ && is_at(*detected_)) detected_.reset();
  begin_tests(std::numeric_limits<std::int64_t>::max());
}

void HypothesisTracker::remember(const BodySchema& schema) {
  const auto is_cut = [](const Edge& edge) { return edge.state == EdgeState::kInvalid; };
  if (std::ranges::any_of(schema.edges, is_cut)) return;
  const auto alike = std::ranges::find_if(
      history_, [&](const BodySchema& stored) { return is_alike(stored, schema); });
  if (alike != history_.end()) {
    if (alike == history_.begin()) return;
    history_.erase(alike);
  }
  if (history_.size() > options_.history) history_.erase(history_.begin() + 1);
  history_.push_back(schema);
}

void HypothesisTracker::add_silently(const ActionPoseSample& sample) {
  recent_.push_back({sample, 0});
  if (recent_.size() > kRing) recent_.pop_front();
}

TreeFilter::Judgement HypothesisTracker::on_sample(const ActionPoseSample& sample,
                                                   std::vector<AdaptationEvent>* events) {
  work_budget_ = std::min(work_budget_ + kWorkPerSample, kMostWork);
  const std::int64_t now = sample.sample_index;
  add_silently(sample);
  const double settled = recent_.back().settled = settled_filter_->log_likelihood(sample);
  for (Hypothesis& h : beam_)
    if (!h.changes.empty()) h.log_odds += h.filter->log_likelihood(sample) - settled;
  const TreeFilter::Judgement judgement = tests_->update(filter(), filter().prepare(sample), now);
  propose_again(now, events);
  propose_more(now);
  propose_learned(now);
  drop_stale();
  choose(now, events);
  want_probe(now, events);
  detect(now, events);
  settle(now, events);
  mature(now);
  return judgement;
}

}  // namespace bodyschema
