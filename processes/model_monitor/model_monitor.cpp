#include "processes/model_monitor/model_monitor.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "common/bus/convert.h"
#include "common/config/yaml.h"
#include "common/schema/kinematic_path.h"

namespace bodyschema {
namespace {

constexpr std::size_t kMaxEvents = 32;
constexpr std::size_t kMaxWaiting = 32;

/// Mean of the two middle values where their number is even; −1 if there is none.
double median(std::vector<double> values) {
  if (values.empty()) return -1;
  std::sort(values.begin(), values.end());
  return 0.5 * (values[(values.size() - 1) / 2] + values[values.size() / 2]);
}

Matrix6d diagonal(const Noise& noise) {
  Vector6d variances;
  variances << Eigen::Vector3d::Constant(noise.position_m * noise.position_m),
      Eigen::Vector3d::Constant(noise.rotation_rad * noise.rotation_rad);
  return variances.asDiagonal();
}

/// What the observer saw of `part`: the likelier pose and, of a planar marker, the other one.
std::vector<Pose> hypotheses(const PartObservation& part) {
  std::vector<Pose> poses{part.X_CB};
  if (part.X_CB_other) poses.push_back(*part.X_CB_other);
  return poses;
}

}  // namespace

ModelMonitorConfig ModelMonitorConfig::load(const std::filesystem::path& file) {
  const Yaml yaml = Yaml::load(file);
  ModelMonitorConfig config;
  config.max_mahalanobis2 = yaml.number("max_mahalanobis2", 1, 1e6);
  config.max_outlier_share = yaml.number("max_outlier_share", 0, 1);
  config.model_error.position_m = yaml.number("model_error_position_m", 0, 1);
  config.model_error.rotation_rad = yaml.number("model_error_rotation_deg", 0, 90) * (M_PI / 180);
  yaml.finish();
  return config;
}

ModelMonitor::ModelMonitor(ModelMonitorConfig config) : config_(config) {
  health_.judged_sample = -1;
  health_.worst_position_m = -1;
  health_.worst_rotation_rad = -1;
}

void ModelMonitor::reload(const std::optional<body_schema_t>& schema,
                          const std::optional<model_health_t>& health) {
  std::int64_t judged = -1;
  if (health) {
    set_array(health_.num_events, health_.events, health->events);
    if (health->num_events > 0) num_events_ = health->events.back().event_number + 1;
  }
  if (schema) {
    schema_ = from_message(*schema);
    schema_message_ = schema;
    judged = schema_.last_sample_index;
  }
  // Whatever was judged after the schema was refused; if the health tells of a newer schema than
  // there is, that one was accepted but not saved.
  if (health && health->schema_version == schema_.version) {
    judged = std::max(judged, health->judged_sample);
  }
  if (schema) {
    add_event(health_event_t::EVENT_RELOADED, schema_.last_sample_index, schema_.utime,
              "version " + std::to_string(schema_.version) + " reloaded");
  }
  assess(judged);
}

bool ModelMonitor::on_sample(const sample_t& message) {
  if (message.sample_index <= last_sample_index_) return false;
  last_sample_index_ = message.sample_index;
  for (const auto& part : message.parts) seen_in_[part.part_id].push_back(message.sample_index);
  ActionPoseSample sample = from_message(message);
  if (sample.purpose == Purpose::kTest) tests_.push_back(std::move(sample));

  bool is_judged = false;
  while (!waiting_.empty() && waiting_.begin()->first <= last_sample_index_) {
    is_judged |= on_learned_schema(waiting_.extract(waiting_.begin()).mapped());
  }
  return is_judged;
}

bool ModelMonitor::on_learned_schema(const body_schema_t& proposal) {
  if (proposal.last_sample_index > last_sample_index_) {
    // Those that will be judged first are kept: a proposal from nowhere cannot displace them.
    waiting_.insert_or_assign(proposal.last_sample_index, proposal);
    if (waiting_.size() > kMaxWaiting) waiting_.erase(std::prev(waiting_.end()));
    return false;
  }
  if (proposal.last_sample_index <= health_.judged_sample) return false;
  if (!is_test(proposal.last_sample_index)) return false;
  judge(proposal);
  return true;
}

bool ModelMonitor::is_test(std::int64_t sample_index) const {
  return std::any_of(tests_.rbegin(), tests_.rend(), [&](const ActionPoseSample& sample) {
    return sample.sample_index == sample_index;
  });
}

bool ModelMonitor::fits(const ActionPoseSample& sample) const {
  return sample.action.size() == static_cast<Eigen::Index>(schema_.signals.size());
}

ModelMonitor::EdgeTest ModelMonitor::test(const Edge& edge, std::int64_t up_to_sample) const {
  const Matrix6d model_error = diagonal(config_.model_error);
  EdgeTest result;
  std::vector<double> distances;
  for (const ActionPoseSample& sample : tests_) {
    if (sample.sample_index > up_to_sample) break;
    const PartObservation* from = sample.find(edge.from);
    const PartObservation* to = sample.find(edge.to);
    if (!from || !to || !fits(sample)) continue;
    const Eigen::VectorXd theta = schema_.displacements(sample.action);
    const Pose predicted = edge.predict(theta);
    const Matrix6d model = edge.prediction_covariance(theta) + model_error;
    // A planar marker has two poses; the likelier one under the model speaks.
    double smallest = std::numeric_limits<double>::infinity();
    for (const Pose& X_CF : hypotheses(*from)) {
      for (const Pose& X_CT : hypotheses(*to)) {
        const Pose z = X_CF.inverse() * X_CT;
        const Matrix6d S = relative_covariance(z, from->covariance, to->covariance) + model;
        const Vector6d residual = log(predicted.inverse() * z);
        smallest = std::min(smallest, residual.dot(S.ldlt().solve(residual)));
      }
    }
    if (!std::isfinite(smallest)) continue;
    ++result.num_tests;
    result.num_refuting += smallest > config_.max_mahalanobis2;
    distances.push_back(smallest);
  }
  result.median_mahalanobis2 = median(distances);
  return result;
}

void ModelMonitor::judge(const body_schema_t& message) {
  BodySchema proposal = from_message(message);
  const std::int64_t index = proposal.last_sample_index;
  const BodySchema previous = std::exchange(schema_, proposal);

  std::string objection;
  bool was_tested = false;
  for (Edge& edge : schema_.edges) {
    const EdgeTest edge_test = test(edge, index);
    was_tested |= edge_test.num_tests > 0;
    edge.state = edge_test.num_tests > 0 ? EdgeState::kOk : EdgeState::kProvisional;
    // One refuting test may be an outlier however small the share that is tolerated.
    const double tolerated = std::max(1.0, config_.max_outlier_share * edge_test.num_tests);
    if (edge_test.num_refuting > tolerated) {
      objection = "edge " + std::to_string(edge.from) + "-" + std::to_string(edge.to) +
                  " refuted by " + std::to_string(edge_test.num_refuting) + " of " +
                  std::to_string(edge_test.num_tests) + " tests";
    }
  }
  if (objection.empty() && !was_tested) objection = "no test sample yet";
  if (objection.empty() && schema_message_ && previous.complete && !schema_.complete) {
    objection = "incomplete, where version " + std::to_string(previous.version) + " is complete";
  }

  if (!objection.empty()) {
    schema_ = previous;
    if (was_tested) {
      add_event(health_event_t::EVENT_SCHEMA_REFUSED, index, proposal.utime, objection);
    }
  } else {
    // base_version stays the proposal's: which version stood here before depends on the speed of
    // the learner.
    schema_.version = index + 1;
    schema_message_ = to_message(schema_);
    schema_ = from_message(*schema_message_);  // judged as published, and as it will be reloaded
    add_event(health_event_t::EVENT_SCHEMA_ACCEPTED, index, schema_.utime,
              "version " + std::to_string(schema_.version) + ": " +
                  std::to_string(schema_.edges.size()) + " edges, " +
                  (schema_.complete ? "complete" : "incomplete"));
  }
  assess(index);
  health_.utime = proposal.utime;
}

void ModelMonitor::assess(std::int64_t up_to_sample) {
  health_.utime = schema_.utime;
  health_.schema_version = schema_.version;
  health_.judged_sample = up_to_sample;
  health_.schema_complete = schema_.complete;
  health_.worst_position_m = -1;
  health_.worst_rotation_rad = -1;
  health_.num_test_samples = static_cast<std::int32_t>(
      std::count_if(tests_.begin(), tests_.end(),
                    [&](const auto& sample) { return sample.sample_index <= up_to_sample; }));

  std::vector<edge_health_t> edges;
  for (const Edge& edge : schema_.edges) {
    const EdgeTest edge_test = test(edge, up_to_sample);
    edge_health_t health;
    health.health_from = edge.from;
    health.health_to = edge.to;
    health.edge_state = static_cast<std::int8_t>(edge.state);
    health.num_tests = edge_test.num_tests;
    health.median_mahalanobis2 = edge_test.median_mahalanobis2;
    edges.push_back(health);
  }
  set_array(health_.num_edges, health_.edge_health, std::move(edges));

  std::vector<part_health_t> parts;
  for (const auto& [part, indices] : seen_in_) {
    const auto num_seen =
        std::upper_bound(indices.begin(), indices.end(), up_to_sample) - indices.begin();
    std::vector<double> position_errors, rotation_errors;
    const auto path = KinematicPath::between(schema_, schema_.root, part);
    for (const ActionPoseSample& sample : tests_) {
      if (sample.sample_index > up_to_sample) break;
      const PartObservation* seen = sample.find(part);
      if (!seen || !path || schema_.root < 0 || !fits(sample)) continue;
      // The camera and the root stand still, so the root's mean pose serves: its orientation noise
      // would otherwise be read as an error of every part far away.
      const Pose error =
          path->predict(sample.action).inverse() * schema_.X_CR.inverse() * seen->X_CB;
      position_errors.push_back(error.translation().norm());
      rotation_errors.push_back(rotation_angle(error));
    }
    part_health_t health;
    health.health_part = part;
    health.num_predicted = static_cast<std::int32_t>(position_errors.size());
    health.visibility = up_to_sample < 0 ? 0 : double(num_seen) / double(up_to_sample + 1);
    health.position_median_m = median(position_errors);
    health.rotation_median_rad = median(rotation_errors);
    health_.worst_position_m = std::max(health_.worst_position_m, health.position_median_m);
    health_.worst_rotation_rad = std::max(health_.worst_rotation_rad, health.rotation_median_rad);
    parts.push_back(health);
  }
  set_array(health_.num_parts, health_.part_health, std::move(parts));
}

void ModelMonitor::add_event(std::int8_t kind, std::int64_t sample_index, std::int64_t utime,
                             std::string text) {
  health_event_t event;
  event.event_number = num_events_++;
  event.utime = utime;
  event.event_sample = sample_index;
  event.event_kind = kind;
  event.event_text = std::move(text);
  std::vector<health_event_t> events = std::move(health_.events);
  if (events.size() == kMaxEvents) events.erase(events.begin());
  events.push_back(std::move(event));
  set_array(health_.num_events, health_.events, std::move(events));
}

}  // namespace bodyschema
