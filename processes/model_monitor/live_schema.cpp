#include "processes/model_monitor/live_schema.h"

#include <algorithm>
#include <cmath>
#include <ranges>

#include "common/bus/cause_names.h"
#include "common/bus/codec.h"
#include "common/bus/convert.h"
#include "processes/model_monitor/health/health_words.h"

namespace bodyschema {
namespace {

/// Of so many newest sightings so many are flips where a part is said to be flipping.
constexpr std::size_t kFlipWindow = 20;
constexpr std::ptrdiff_t kManyFlips = 5;

using Kind = AdaptationEvent::Kind;

static_assert(static_cast<int>(Kind::kMismatch) == health_event_t::EVENT_MISMATCH);
static_assert(static_cast<int>(Kind::kProbeWanted) == health_event_t::EVENT_PROBE_WANTED);

change_size_t to_message(const ChangeSize& size) {
  change_size_t message{};
  message.size_kind = static_cast<std::int8_t>(size.kind);
  message.size_signal = size.signal;
  message.num_amounts = static_cast<std::int32_t>(size.amounts.size());
  message.amount = size.amounts;
  message.amount_sd = size.sds;
  return message;
}

finding_t to_message(const Finding& finding, const std::vector<Signal>& signals) {
  finding_t message{};
  message.finding_state = static_cast<std::int8_t>(finding.state);
  message.finding_from = finding.from;
  message.finding_to = finding.to;
  message.finding_part = finding.part;
  message.finding_tag = finding.tag;
  message.finding_cause = cause_named(finding.cause);
  message.finding_size = to_message(finding.size);
  message.finding_since = finding.since;
  message.finding_found = finding.found;
  message.finding_adopted = finding.adopted;
  message.num_confirming = finding.num_confirming;
  message.finding_text = text_of(finding, signals);
  return message;
}

Findings from_message(const std::vector<finding_t>& messages) {
  std::vector<Finding> findings;
  for (const finding_t& message : messages) {
    const change_size_t& size = message.finding_size;
    findings.push_back({.state = static_cast<Finding::State>(message.finding_state),
                        .from = message.finding_from,
                        .to = message.finding_to,
                        .part = message.finding_part,
                        .tag = message.finding_tag,
                        .cause = cause_text(message.finding_cause),
                        .size = {static_cast<ChangeSize::Kind>(size.size_kind), size.size_signal,
                                 size.amount, size.amount_sd},
                        .since = message.finding_since,
                        .found = message.finding_found,
                        .adopted = message.finding_adopted,
                        .num_confirming = message.num_confirming});
  }
  return Findings(std::move(findings));
}

/// Whether two local models say the same, bit by bit.
bool is_same_model(const Edge& a, const Edge& b) {
  const auto is_same = [](const Pose& x, const Pose& y) { return x.matrix() == y.matrix(); };
  const auto is_same_joint = [&](const ScrewJoint& x, const ScrewJoint& y) {
    return x.signal == y.signal && x.gain == y.gain && x.offset == y.offset && x.slide == y.slide &&
           x.turn == y.turn && x.order_group == y.order_group && x.scatter == y.scatter &&
           is_same(x.X_after, y.X_after);
  };
  return is_same(a.left, b.left) && is_same(a.right, b.right) && a.has_process_of(b) &&
         std::ranges::equal(a.joints, b.joints, is_same_joint);
}

/// What a receiver sees, its stamps apart.
std::vector<std::uint8_t> contents_of(BodySchema schema) {
  schema.utime = schema.version = schema.base_version = schema.last_sample_index = 0;
  return encode(kBodySchema, to_message(schema));
}

}  // namespace

health_event_t to_message(const AdaptationEvent& event, const std::vector<Signal>& signals,
                          std::int64_t utime) {
  health_event_t message{};
  message.utime = utime;
  message.event_sample = event.sample_index;
  message.event_kind = static_cast<std::int8_t>(event.kind);
  message.event_from = event.from;
  message.event_to = event.to;
  message.event_part = event.part;
  message.event_tag = event.tag;
  message.event_cause = cause_named(event.cause);
  message.event_other_cause = cause_named(event.other_cause);
  message.event_since = event.since;
  message.event_size = to_message(event.size);
  message.event_margin = std::isfinite(event.margin) ? event.margin : 0;
  message.samples_used = event.num_samples;
  message.event_text = text_of(event, signals);
  return message;
}

LiveSchema::LiveSchema(BodySchema base, AdaptationOptions options, std::vector<BodySchema> history,
                       const std::vector<ActionPoseSample>& past,
                       const std::vector<finding_t>& findings)
    : base_(std::move(base)),
      adaptation_(base_, options, std::move(history), past),
      findings_(from_message(findings)),
      schema_(base_),
      camera_since_(body_since()) {}

std::int64_t LiveSchema::body_since() const {
  return schema_.changes.empty() ? 0 : schema_.changes.back().since;
}

std::int64_t LiveSchema::holds_since(int part) const {
  std::int64_t since = camera_since_;
  for (const Edge* edge = edge_to(schema_, part); edge; edge = edge_to(schema_, edge->from))
    since = std::max(since, edge->valid_since_sample);
  return since;
}

double LiveSchema::log_likelihood_ratio(const BodySchema& other,
                                        const std::vector<const ActionPoseSample*>& samples,
                                        std::int64_t since) const {
  std::vector<ActionPoseSample> usable;
  for (const ActionPoseSample* sample : samples)
    drop_moved_tags(schema_.moved_tags, &usable.emplace_back(*sample));
  std::vector<const ActionPoseSample*> all, before, after;
  for (const ActionPoseSample& sample : usable) {
    all.push_back(&sample);
    (sample.sample_index < since ? before : after).push_back(&sample);
  }
  return log_likelihood(other, adaptation_.measurement(), all) -
         log_likelihood(base_, adaptation_.measurement(), before) -
         log_likelihood(schema_, adaptation_.measurement(), after);
}

void LiveSchema::tell(std::int64_t sample_index, std::int64_t utime) {
  known_from_ = sample_index + 1;
  stamp(&schema_);
  schema_.utime = utime;
  schema_.version = sample_index + 1;
  schema_.base_version = base_.version;
  schema_.last_sample_index = sample_index;
}

void LiveSchema::stamp(BodySchema* schema) const {
  std::vector<KnownChange>& changes = schema->changes;
  for (KnownChange& change : changes) change.found = std::max(change.found, known_from_);
  // Of those that became known together the last says since when the body is as it is.
  const auto together = std::ranges::unique(changes | std::views::reverse, {}, &KnownChange::found);
  changes.erase(changes.begin(), together.begin().base());
  for (MovedTag& tag : schema->moved_tags) {
    tag.found = std::max(tag.found, known_from_);
    if (tag.until >= 0) tag.until = std::max(tag.until, tag.found + 1);
  }
}

bool LiveSchema::is_in_doubt() const {
  return !adaptation_.is_settled() || !adaptation_.missing_parts().empty() ||
         std::ranges::any_of(schema_.parts, [&](int part) {
           return adaptation_.edge_state(part) != EdgeState::kOk ||
                  adaptation_.marker_state(part) != EdgeState::kOk;
         });
}

std::vector<AdaptationEvent> LiveSchema::on_sample(const ActionPoseSample& sample) {
  std::optional<std::int64_t> changed_since;
  std::optional<int> unchanged_part, drifting_part;
  std::vector<AdaptationEvent> events = adaptation_.on_sample(sample);
  for (const AdaptationEvent& event : events) {
    if ((event.kind == Kind::kCandidate || event.kind == Kind::kRestored) && event.tag < 0)
      changed_since = adaptation_.since();
    // What the tag was taken for was no change.
    if ((event.kind == Kind::kCandidate || event.kind == Kind::kMissing) && event.tag >= 0)
      unchanged_part = event.part;
    if (event.kind == Kind::kDrift) {
      changed_since = sample.sample_index;
      drifting_part = event.to;
    }
    // It moved until then, each sample another body.
    if (event.kind == Kind::kRecovered && event.cause == "drift" && event.since >= 0)
      changed_since = event.since;
    if (event.kind == Kind::kProbeWanted) {
      probe_sample_ = event.sample_index;
      probe_ = event.probe;
    }
  }
  findings_.update(adaptation_, events, sample.sample_index);
  if (adaptation_.is_settled()) probe_sample_ = -1;
  watch_flips(sample);
  update(sample, changed_since, unchanged_part, drifting_part);
  return events;
}

void LiveSchema::watch_flips(const ActionPoseSample& sample) {
  const auto X_RB = schema_.predict_all(sample.action);
  for (const PartObservation& seen : sample.parts) {
    const auto predicted = X_RB.find(seen.part);
    if (predicted == X_RB.end() || !seen.has_rotation) continue;
    const auto error = [&](const Pose& X_CB) {
      return rotation_angle((schema_.X_CR * predicted->second).inverse() * X_CB);
    };
    std::deque<bool>& flipped = flipped_[seen.part];
    flipped.push_back(seen.X_CB_other && error(*seen.X_CB_other) < error(seen.X_CB));
    if (flipped.size() > kFlipWindow) flipped.pop_front();
  }
}

void LiveSchema::rate(std::int64_t sample_index, Edge* edge) const {
  const EdgeState state = state_of(*edge);
  if (state == EdgeState::kInvalid) {
    edge->state = state;
    edge->confidence = 0;
  } else if (state == EdgeState::kProvisional) {
    // As sure as it is old.
    edge->state = state;
    const double age = static_cast<double>(sample_index - edge->valid_since_sample + 1);
    edge->confidence = std::clamp(age / adaptation_.options().settled_after, 0.0, 1.0);
  }
}

void LiveSchema::update(const ActionPoseSample& sample, std::optional<std::int64_t> changed_since,
                        std::optional<int> unchanged_part, std::optional<int> drifting_part) {
  BodySchema next = adaptation_.schema();
  for (std::size_t e = 0; e < next.edges.size(); ++e) {
    Edge& edge = next.edges[e];
    const Edge &before = schema_.edges[e], &original = base_.edges[e];
    edge.valid_since_sample = before.valid_since_sample;
    const bool is_other = !is_same_model(edge, before);
    const bool is_taken_back = unchanged_part == edge.from || unchanged_part == edge.to;
    // Of what a drift was taken for, nothing changed.
    const bool is_drift_elsewhere = drifting_part && *drifting_part != edge.to;
    // Without a new change: the same one fitted better, or taken back.
    if (is_other && is_drift_elsewhere && is_same_model(edge, original))
      edge.valid_since_sample = original.valid_since_sample;
    else if (is_other && changed_since)
      edge.valid_since_sample = *changed_since;
    else if ((is_other || is_taken_back) && is_same_model(edge, original))
      edge.valid_since_sample = original.valid_since_sample;
    edge.state = original.state;
    edge.confidence = original.confidence;
    rate(sample.sample_index, &edge);
  }
  const bool is_camera_as_in_base = next.X_CR.matrix() == base_.X_CR.matrix();
  if (next.X_CR.matrix() != schema_.X_CR.matrix()) {
    const bool is_drift_elsewhere = drifting_part && *drifting_part != next.root;
    if (changed_since && !(is_drift_elsewhere && is_camera_as_in_base))
      camera_since_ = *changed_since;
    else if (is_camera_as_in_base)
      camera_since_ = base_.changes.empty() ? 0 : base_.changes.back().since;
  }
  // What edges have in common holds of those that were fitted together.
  next.frame_covariances = base_.frame_covariances;
  next.refined = base_.refined && is_camera_as_in_base;
  if (!is_camera_as_in_base) next.frame_covariances.erase(next.root);
  for (std::size_t e = 0; e < next.edges.size(); ++e) {
    if (is_same_model(next.edges[e], base_.edges[e])) continue;
    next.refined = false;
    next.frame_covariances.erase(next.edges[e].from);
    next.frame_covariances.erase(next.edges[e].to);
  }
  std::int64_t since = camera_since_;
  for (const Edge& edge : next.edges) since = std::max(since, edge.valid_since_sample);
  next.changes = schema_.changes;
  if (since != body_since()) {
    if (next.changes.size() == BodySchema::kMaxChanges) next.changes.erase(next.changes.begin());
    next.changes.push_back({sample.sample_index, since});
  }
  stamp(&next);
  next.utime = schema_.utime;
  next.version = schema_.version;
  next.base_version = schema_.base_version;
  next.last_sample_index = schema_.last_sample_index;
  if (contents_of(next) != contents_of(schema_)) {
    next.utime = sample.utime;
    next.version = sample.sample_index + 1;
    next.base_version = base_.version;
    next.last_sample_index = sample.sample_index;
  }
  schema_ = std::move(next);
}

EdgeState LiveSchema::state_of(const Edge& edge) const {
  // A part's frame is that of its marker: while that is not where it was, neither is the part.
  const EdgeState states[] = {adaptation_.edge_state(edge.to), adaptation_.marker_state(edge.to),
                              adaptation_.marker_state(edge.from)};
  for (const EdgeState worst : {EdgeState::kInvalid, EdgeState::kProvisional})
    if (std::ranges::find(states, worst) != std::end(states)) return worst;
  return adaptation_.edge_state(edge.to);
}

std::vector<finding_t> LiveSchema::findings() const {
  std::vector<finding_t> messages;
  for (const Finding& finding : findings_.all())
    messages.push_back(to_message(finding, schema_.signals));
  return messages;
}

void LiveSchema::describe(model_health_t* health) const {
  set_array(health->num_findings, health->findings, findings());
  health->noise_scale = adaptation_.noise_scale();
  health->probe_sample = probe_sample_;
  std::vector<double> probe;
  if (probe_sample_ >= 0) probe.assign(probe_.begin(), probe_.end());
  set_array(health->num_probe, health->probe_action, std::move(probe));
  for (edge_health_t& item : health->edge_health) {
    const Edge* edge = edge_to(schema_, item.health_to);
    if (!edge) continue;
    const EdgeState state = state_of(*edge);
    item.edge_state = static_cast<std::int8_t>(state == EdgeState::kOk ? edge->state : state);
    item.edge_is_drifting = adaptation_.is_drifting(item.health_to);
    item.edge_cusum = adaptation_.edge_statistic(item.health_to);
  }
  const std::vector<int> missing = adaptation_.missing_parts();
  for (part_health_t& item : health->part_health) {
    const int part = item.health_part;
    EdgeState state = adaptation_.marker_state(part);
    if (part == schema_.root && state != EdgeState::kInvalid) {
      const EdgeState camera = adaptation_.edge_state(part);
      if (camera != EdgeState::kOk) state = camera;
      item.camera_cusum = adaptation_.edge_statistic(part);
    }
    item.part_state = static_cast<std::int8_t>(state);
    item.marker_cusum = adaptation_.marker_statistic(part);
    item.is_unseen = std::ranges::find(missing, part) != missing.end();
    const auto flipped = flipped_.find(part);
    item.is_flipping =
        flipped != flipped_.end() && std::ranges::count(flipped->second, true) >= kManyFlips;
  }
}

}  // namespace bodyschema
