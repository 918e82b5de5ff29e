#include "processes/model_monitor/model_monitor.h"

#include <algorithm>
#include <utility>

#include "common/bus/convert.h"
#include "common/camera/calibrated_lens.h"
#include "common/config/calibration_id.h"
#include "common/config/yaml.h"
#include "common/estimation/quantile.h"
#include "common/kinematics/kinematic_path.h"

namespace bodyschema {
namespace {

/// TEST samples that judge an edge and a part: the newest. Twice as many are kept, for proposals
/// that come late.
constexpr std::size_t kTests = 200;
/// Samples before a base that tell its noise and how often parts are seen.
constexpr std::size_t kPast = 64;
/// States kept for proposals that did not come yet; what is between them is gone through again.
constexpr std::size_t kMaxKept = 12;

/// −1 if there is no value.
double median_or_none(std::vector<double> values) {
  return values.empty() ? -1 : median(std::move(values));
}

}  // namespace

TagView TagView::load(const std::filesystem::path& rig_folder) {
  const RigCalibration calibration = load_calibration(rig_folder);
  const RigNoise noise = load_noise(rig_folder);
  return {calibration.markers,
          lens_of(calibration.camera),
          {noise.corner_noise_px, noise.small_tag_noise_px}};
}

ModelMonitorConfig ModelMonitorConfig::load(const std::filesystem::path& file) {
  const Yaml yaml = Yaml::load(file);
  ModelMonitorConfig config;
  config.max_mahalanobis2 = yaml.number("max_mahalanobis2", 1, 1e6);
  config.max_outlier_share = yaml.number("max_outlier_share", 0, 1);
  config.false_alarm_rate = yaml.number("false_alarm_rate", 0, 0.01);
  yaml.finish();
  config.measurement = load_noise(file.parent_path()).measurement;
  return config;
}

ModelMonitor::ModelMonitor(ModelMonitorConfig config)
    : config_(config),
      schedule_(config.refine_every),
      refinements_(config.refine_every > 0, kRefinerTimeout_us) {
  options_.measurement = config_.measurement;
  options_.least_noise_scale = 1;
  if (config_.false_alarm_rate > 0) options_.false_alarm_rate = config_.false_alarm_rate;
  for (model_health_t* health : {&health_, &memory_.at_base, &memory_.verdicts}) {
    health->judged_sample = -1;
    health->worst_position_m = health->worst_rotation_rad = -1;
    health->noise_scale = -1;
    health->probe_sample = health->awaited_refinement = health->wanted_sample = -1;
  }
}

std::int64_t ModelMonitor::Tally::up_to(std::int64_t judged_sample) {
  while (!later.empty() && later.front() <= judged_sample) {
    later.pop_front();
    ++num_judged;
  }
  return num_judged;
}

void ModelMonitor::Standing::add(health_event_t event) {
  event.event_number = num_events++;
  // A healthy body's schema is replaced again and again: of those the newest says it all.
  const auto is_acceptance = [](const health_event_t& e) {
    return e.event_kind == health_event_t::EVENT_SCHEMA_ACCEPTED;
  };
  if (!events.empty() && is_acceptance(events.back()) && is_acceptance(event)) events.pop_back();
  if (events.size() == kMaxEvents) events.erase(events.begin());
  events.push_back(std::move(event));
}

void ModelMonitor::Standing::tell(std::int64_t utime) {
  const auto told = std::make_shared<LiveSchema>(*live);
  told->tell(sample_index, utime);
  live = told;
  for (health_event_t& event : youth.end()) add(std::move(event));
}

void ModelMonitor::start_from(const body_schema_t& schema) {
  MonitorMemory memory = memory_;
  memory.schemas = {schema};
  memory.at_base.num_test_samples = MonitorMemory::kOld;
  if (schema.last_sample_index < 0) {
    BodySchema base = from_message(schema);
    forget_when_it_changed(&base);
    memory.schemas.back() = to_message(base);
  }
  memory.at_base.utime = memory.verdicts.utime = schema.utime;
  memory.at_base.judged_sample = memory.verdicts.judged_sample = schema.last_sample_index;
  restore(memory);
}

void ModelMonitor::restore(const MonitorMemory& memory) {
  memory_ = memory;
  judged_sample_ = memory.verdicts.judged_sample;
  judged_utime_ = memory.verdicts.utime;
  restored_sample_ = memory.at_base.judged_sample;
  now_ = Standing();
  kept_.clear();
  now_.sample_index = restored_sample_;
  now_.events = memory.at_base.events;
  if (!now_.events.empty()) now_.num_events = now_.events.back().event_number + 1;
  // Verdicts since that were too many to remember.
  if (!memory.verdicts.events.empty())
    now_.num_events += memory.verdicts.events.front().event_number;
  if (!memory.schemas.empty()) {
    BodySchema base = from_message(memory.schemas.back());
    if (base.complete && config_.false_alarm_rate > 0) {
      std::vector<BodySchema> history;
      for (const body_schema_t& schema : memory.schemas) history.push_back(from_message(schema));
      history.pop_back();
      now_.live = begin(std::move(base), std::move(history), restored_sample_);
      now_.youth = BaselineYouth(memory.at_base.num_test_samples);
    } else {
      now_.proposed = std::move(base);
    }
  }
  kept_.emplace(now_.sample_index, now_);
  publish();
}

bool ModelMonitor::on_sample(const sample_t& message) {
  if (message.sample_index <= last_sample_index_) return false;
  last_sample_index_ = message.sample_index;
  for (const auto& part : message.parts)
    seen_in_[part.part_id].later.push_back(message.sample_index);
  ActionPoseSample sample = from_message(message);
  if (sample.purpose == Purpose::kTest) {
    test_indices_.later.push_back(sample.sample_index);
    if (schedule_.is_due(sample.sample_index)) due_.insert(sample.sample_index);
    tests_.push_back(sample);
    if (config_.view) sights_.emplace(sample.sample_index, tag_sights(message));
    if (tests_.size() > 2 * kTests) {
      sights_.erase(tests_.front().sample_index);
      tests_.pop_front();
    }
  }
  samples_.push_back(std::move(sample));
  is_assessed_ = false;
  take_answers();
  if (last_sample_index_ < restored_sample_) {
    if (samples_.size() > kPast) samples_.pop_front();
    return false;
  }
  if (last_sample_index_ == restored_sample_) {
    // What came before it is there now.
    restore(MonitorMemory(memory_));
    return true;
  }
  const std::int64_t version = schema_message_ ? schema_message_->schema_version : 0;
  const std::int64_t num_events = now_.num_events;
  advance(&now_, samples_.back());
  if (samples_.back().purpose == Purpose::kTest) keep(now_);
  publish();

  const bool is_judged = judge_waiting();
  return is_judged || now_.num_events != num_events ||
         (schema_message_ && schema_message_->schema_version != version);
}

bool ModelMonitor::on_learned_schema(const body_schema_t& proposal) {
  if (proposal.last_sample_index <= judged_sample_) return false;
  waiting_.insert_or_assign(proposal.last_sample_index, proposal);
  // Those that will be judged first are kept: a proposal from nowhere cannot displace them.
  if (waiting_.size() > kMaxWaiting) waiting_.erase(std::prev(waiting_.end()));
  return judge_waiting();
}

bool ModelMonitor::judge_waiting() {
  bool is_judged = false;
  while (!waiting_.empty() && waiting_.begin()->first <= last_sample_index_ &&
         !waits_for_refiner(waiting_.begin()->second)) {
    const body_schema_t proposal = waiting_.extract(waiting_.begin()).mapped();
    if (proposal.last_sample_index <= judged_sample_ || !is_test(proposal.last_sample_index))
      continue;
    judge(proposal);
    due_.erase(due_.begin(), due_.upper_bound(judged_sample_));
    is_judged = true;
  }
  return is_judged;
}

std::int64_t ModelMonitor::num_tests(std::int64_t last) const { return test_indices_.up_to(last); }

bool ModelMonitor::is_test(std::int64_t sample_index) const {
  return std::ranges::binary_search(test_indices_.later, sample_index);
}

std::vector<const ActionPoseSample*> ModelMonitor::tests_between(std::int64_t first,
                                                                 std::int64_t last) const {
  std::vector<const ActionPoseSample*> result;
  for (const ActionPoseSample& sample : tests_)
    if (sample.sample_index >= first && sample.sample_index <= last) result.push_back(&sample);
  if (result.size() > kTests)
    result.erase(result.begin(), result.end() - static_cast<std::ptrdiff_t>(kTests));
  return result;
}

bool ModelMonitor::fits(const BodySchema& schema, const ActionPoseSample& sample) {
  return sample.action.size() == static_cast<Eigen::Index>(schema.signals.size());
}

void ModelMonitor::keep(const Standing& standing) {
  kept_.insert_or_assign(standing.sample_index, standing);
  // The first is where all others can be found again from.
  if (kept_.size() > kMaxKept) kept_.erase(std::next(kept_.begin()));
}

void ModelMonitor::advance(Standing* standing, const ActionPoseSample& sample) const {
  standing->sample_index = sample.sample_index;
  if (standing->live && fits(standing->live->schema(), sample)) {
    const auto live = std::make_shared<LiveSchema>(*standing->live);
    const std::vector<AdaptationEvent> decided = live->on_sample(sample);
    std::vector<health_event_t> events;
    for (const AdaptationEvent& event : decided)
      events.push_back(to_message(event, live->schema().signals, sample.utime));
    const bool is_confirming =
        live->num_judged() > standing->live->num_judged() && sample.parts.size() > 1;
    for (health_event_t& event : standing->youth.on_sample(std::move(events), is_confirming))
      standing->add(std::move(event));
    standing->live = live;
  }
  for (const health_event_t& verdict : memory_.verdicts.events)
    if (verdict.event_sample == sample.sample_index) standing->add(verdict);
  if (memory_.verdicts.schema_version == sample.sample_index + 1) standing->tell(sample.utime);
}

ModelMonitor::Standing ModelMonitor::standing_after(std::int64_t sample_index) const {
  Standing standing;
  if (const auto after = kept_.upper_bound(sample_index); after != kept_.begin())
    standing = std::prev(after)->second;
  for (const ActionPoseSample& sample : samples_)
    if (sample.sample_index > standing.sample_index && sample.sample_index <= sample_index)
      advance(&standing, sample);
  return standing;
}

void ModelMonitor::go_on_from(Standing standing, bool is_changed) {
  if (is_changed)
    kept_.clear();
  else
    kept_.erase(kept_.begin(), kept_.upper_bound(standing.sample_index));
  kept_.emplace(standing.sample_index, standing);
  // Nothing begins before it any more.
  const auto later = std::ranges::find_if(
      samples_, [&](const auto& sample) { return sample.sample_index > standing.sample_index; });
  const auto num_before = static_cast<std::size_t>(later - samples_.begin());
  if (num_before > kPast)
    samples_.erase(samples_.begin(),
                   samples_.begin() + static_cast<std::ptrdiff_t>(num_before - kPast));
  if (is_changed) now_ = std::move(standing);
  for (const ActionPoseSample& sample : samples_) {
    if (!is_changed || sample.sample_index <= now_.sample_index) continue;
    advance(&now_, sample);
    if (sample.purpose == Purpose::kTest) keep(now_);
  }
  publish();
}

void ModelMonitor::publish() {
  is_assessed_ = false;
  const BodySchema* schema = now_.schema();
  if (!schema)
    schema_message_.reset();
  else if (!schema_message_ || is_rewound_ || schema_message_->schema_version != schema->version)
    // The base as it was accepted: what goes to and fro is not the same to the last bit.
    schema_message_ = schema->version == memory_.schemas.back().schema_version
                          ? memory_.schemas.back()
                          : to_message(*schema);
}

std::shared_ptr<const LiveSchema> ModelMonitor::begin(BodySchema base,
                                                      std::vector<BodySchema> history,
                                                      std::int64_t up_to_sample) const {
  std::vector<ActionPoseSample> past;
  for (const ActionPoseSample& sample : samples_)
    if (sample.sample_index <= up_to_sample && fits(base, sample)) past.push_back(sample);
  if (past.size() > kPast)
    past.erase(past.begin(), past.end() - static_cast<std::ptrdiff_t>(kPast));
  return std::make_shared<LiveSchema>(std::move(base), options_, std::move(history), past,
                                      memory_.at_base.findings);
}

void ModelMonitor::set_base(Standing* standing, BodySchema base) {
  std::vector<BodySchema> history;
  // As long as the body was one, earlier schemas are only worse.
  if (standing->live && !standing->schema()->changes.empty()) history = standing->live->history();
  memory_.schemas.clear();
  // As it will be restored.
  for (BodySchema& schema : history) {
    memory_.schemas.push_back(to_message(schema));
    schema = from_message(memory_.schemas.back());
  }
  memory_.schemas.push_back(to_message(base));
  base = from_message(memory_.schemas.back());
  memory_.at_base.utime = base.utime;
  memory_.at_base.judged_sample = standing->sample_index;
  // What confirmed a tree confirms it still.
  if (!standing->live || standing->is_holding_back() ||
      !has_same_tree(base, standing->live->base()))
    standing->youth = BaselineYouth(num_tests(standing->sample_index));
  memory_.at_base.num_test_samples =
      standing->youth.is_over() ? MonitorMemory::kOld
                                : static_cast<std::int32_t>(standing->youth.num_confirming());
  memory_.verdicts.schema_version = 0;
  set_array(memory_.at_base.num_events, memory_.at_base.events, standing->events);
  set_array(memory_.at_base.num_findings, memory_.at_base.findings,
            standing->live ? standing->live->findings() : std::vector<finding_t>());
  set_array(memory_.verdicts.num_events, memory_.verdicts.events, {});
  standing->proposed.reset();
  standing->live.reset();
  if (base.complete && config_.false_alarm_rate > 0)
    standing->live = begin(std::move(base), std::move(history), standing->sample_index);
  else
    standing->proposed = std::move(base);
}

const PartObservation* ModelMonitor::sighting(const ActionPoseSample& sample, int part,
                                              const std::vector<MovedTag>& moved) {
  return sample.find_without([&](int tag) { return has_moved(moved, tag, sample.sample_index); },
                             part);
}

const model_health_t& ModelMonitor::health() const {
  if (is_assessed_) return health_;
  is_assessed_ = true;
  set_array(health_.num_events, health_.events, now_.events);
  set_array(health_.num_findings, health_.findings, {});
  const BodySchema* schema = now_.schema();
  health_.utime = judged_utime_;
  health_.judged_sample = judged_sample_;
  health_.awaited_refinement = awaited_refinement();
  const bool are_wanted = schema && are_wanted_for(*schema);
  health_.wanted_sample = are_wanted ? refined_->last_sample_index : -1;
  set_array(health_.num_wanted, health_.wanted_actions,
            are_wanted ? wanted_ : std::vector<wanted_action_t>());
  if (judged_sample_ < 0 && !now_.live) return health_;
  assess(schema ? *schema : BodySchema());
  if (!now_.live) return health_;
  now_.live->describe(&health_);
  if (!now_.is_holding_back()) return health_;
  // Nothing is decided yet.
  for (std::size_t e = 0; e < schema->edges.size(); ++e) {
    std::int8_t& state = health_.edge_health[e].edge_state;
    if (state != static_cast<std::int8_t>(schema->edges[e].state))
      state = schema_edge_t::EDGE_SUSPECT;
  }
  for (part_health_t& part : health_.part_health)
    if (part.part_state != schema_edge_t::EDGE_OK) part.part_state = schema_edge_t::EDGE_SUSPECT;
  health_.probe_sample = -1;
  set_array(health_.num_probe, health_.probe_action, {});
  return health_;
}

void ModelMonitor::assess(const BodySchema& schema) const {
  health_.schema_version = schema.version;
  health_.schema_complete = schema.complete;
  health_.worst_position_m = health_.worst_rotation_rad = -1;
  health_.num_test_samples = static_cast<std::int32_t>(num_tests(judged_sample_));

  std::vector<edge_health_t> edges;
  for (const Edge& edge : schema.edges) {
    const EdgeTest edge_test = test(schema, edge, edge.valid_since_sample, judged_sample_);
    edge_health_t health{};
    health.health_from = edge.from;
    health.health_to = edge.to;
    health.edge_state = static_cast<std::int8_t>(edge.state);
    health.edge_cusum = -1;
    health.num_tests = edge_test.num_tests;
    health.median_mahalanobis2 = edge_test.median_mahalanobis2;
    edges.push_back(health);
  }
  set_array(health_.num_edges, health_.edge_health, std::move(edges));

  const auto tests = tests_between(0, judged_sample_);
  std::vector<part_health_t> parts;
  for (auto& [part, indices] : seen_in_) {
    const std::int64_t num_seen = indices.up_to(judged_sample_);
    std::vector<double> position_errors, rotation_errors;
    const auto path = KinematicPath::between(schema, schema.root, part);
    const std::int64_t since =
        now_.live && !now_.is_holding_back() ? now_.live->holds_since(part) : 0;
    for (const ActionPoseSample* sample : tests) {
      const PartObservation* seen = sighting(*sample, part, schema.moved_tags);
      if (!seen || !path || schema.root < 0 || sample->sample_index < since ||
          !fits(schema, *sample))
        continue;
      // The camera and the root stand still, so the root's mean pose serves: its orientation noise
      // would otherwise be read as an error of every part far away.
      const Pose error =
          path->predict(sample->action).inverse() * schema.X_CR.inverse() * seen->X_CB;
      position_errors.push_back(error.translation().norm());
      if (seen->has_rotation) rotation_errors.push_back(rotation_angle(error));
    }
    part_health_t health{};
    health.health_part = part;
    health.marker_cusum = health.camera_cusum = -1;
    health.num_predicted = static_cast<std::int32_t>(position_errors.size());
    health.visibility = double(num_seen) / double(std::max<std::int64_t>(judged_sample_ + 1, 1));
    health.position_median_m = median_or_none(position_errors);
    health.rotation_median_rad = median_or_none(rotation_errors);
    health_.worst_position_m = std::max(health_.worst_position_m, health.position_median_m);
    health_.worst_rotation_rad = std::max(health_.worst_rotation_rad, health.rotation_median_rad);
    parts.push_back(health);
  }
  set_array(health_.num_parts, health_.part_health, std::move(parts));
}

}  // namespace bodyschema
