// Whether ModelMonitor takes a schema that the learner proposes.

#include <spdlog/fmt/fmt.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "common/bus/convert.h"
#include "common/estimation/chi_square.h"
#include "common/estimation/quantile.h"
#include "common/kinematics/kinematic_path.h"
#include "processes/model_monitor/model_monitor.h"

namespace bodyschema {
namespace {

/// Samples after which a schema that stands undoubted is the base itself, so that a restart has few
/// to go through again.
constexpr std::int64_t kRenewal = 500;

/// What the observer saw of `part`: the likelier pose and, of a planar marker, the other one.
std::vector<PartObservation> hypotheses(const PartObservation& part) {
  std::vector<PartObservation> readings{part};
  if (part.X_CB_other) readings.emplace_back(part).X_CB = *part.X_CB_other;
  return readings;
}

}  // namespace

ModelMonitor::EdgeTest ModelMonitor::test(const BodySchema& schema, const Edge& edge,
                                          std::int64_t first, std::int64_t last) const {
  EdgeTest result;
  std::vector<double> distances;
  for (const ActionPoseSample* sample : tests_between(first, last)) {
    const PartObservation* from = sighting(*sample, edge.from, schema.moved_tags);
    const PartObservation* to = sighting(*sample, edge.to, schema.moved_tags);
    if (!from || !from->has_rotation || !to || !fits(schema, *sample)) continue;
    const Eigen::VectorXd theta = schema.displacements(sample->action);
    const Pose predicted = edge.predict(theta);
    const Matrix6d model = edge.prediction_covariance(theta);
    // A planar marker has two poses; the likelier one under the model speaks.
    double smallest = std::numeric_limits<double>::infinity();
    for (const PartObservation& seen_from : hypotheses(*from)) {
      for (const PartObservation& seen_to : hypotheses(*to)) {
        const Pose& X_CF = seen_from.X_CB;
        const auto seen = config_.measurement.reading(seen_to, X_CF * predicted);
        const Pose z = X_CF.inverse() * seen.X_CB;
        const Matrix6d S =
            relative_covariance(z, config_.measurement.covariance(*from), seen.covariance) + model;
        const Vector6d residual = log(predicted.inverse() * z);
        smallest =
            std::min(smallest, as_of_six(squared_mahalanobis(residual, S), seen.num_residuals));
      }
    }
    if (!std::isfinite(smallest)) continue;
    ++result.num_tests;
    result.num_refuting += smallest > config_.max_mahalanobis2;
    distances.push_back(smallest);
  }
  result.median_mahalanobis2 = distances.empty() ? -1 : median(std::move(distances));
  return result;
}

bool ModelMonitor::has_same_tree(const BodySchema& a, const BodySchema& b) {
  return a.edges.size() == b.edges.size() && std::ranges::all_of(a.edges, [&b](const Edge& edge) {
           return std::ranges::any_of(b.edges, [&edge](const Edge& other) {
             return edge.from == other.from && edge.to == other.to &&
                    edge.signals() == other.signals();
           });
         });
}

std::int64_t ModelMonitor::body_since(const BodySchema& proposal) {
  std::int64_t since = 0;
  for (const Edge& edge : proposal.edges) since = std::max(since, edge.valid_since_sample);
  return since;
}

std::string ModelMonitor::objection(BodySchema* proposal, const Standing& standing,
                                    bool* was_tested) const {
  const std::int64_t index = proposal->last_sample_index;
  std::string objection;
  for (Edge& edge : proposal->edges) {
    const EdgeTest edge_test = test(*proposal, edge, edge.valid_since_sample, index);
    *was_tested |= edge_test.num_tests > 0;
    edge.state = edge_test.num_tests > 0 ? EdgeState::kOk : EdgeState::kProvisional;
    // One refuting test may be an outlier however small the share that is tolerated.
    const double tolerated = std::max(1.0, config_.max_outlier_share * edge_test.num_tests);
    if (edge_test.num_refuting > tolerated)
      objection = fmt::format("edge {}-{} refuted by {} of {} tests", edge.from, edge.to,
                              edge_test.num_refuting, edge_test.num_tests);
  }
  const BodySchema* previous = standing.schema();
  if (objection.empty() && !*was_tested) objection = "no test sample yet";
  if (objection.empty() && previous && previous->complete && !proposal->complete)
    objection = fmt::format("incomplete, where version {} is complete", previous->version);
  return objection;
}

bool ModelMonitor::is_passed_over(const BodySchema& proposal, const Standing& standing) const {
  const LiveSchema* live = standing.live.get();
  const std::int64_t index = proposal.last_sample_index;
  const BodySchema* stands = standing.schema();
  if (stands && !standing.is_holding_back() && is_defended(*stands, proposal)) return true;
  if (!live) return false;
  const BodySchema& known = *stands;
  const std::int64_t body_since = known.changes.empty() ? 0 : known.changes.back().since;
  const std::int64_t since = ModelMonitor::body_since(proposal);
  if (body_since != since || known.moved_tags != proposal.moved_tags) return true;
  const auto gain_since = [&](std::int64_t first, std::int64_t story_since) {
    auto tests = tests_between(first, index);
    std::erase_if(tests, [&](const auto* sample) { return !fits(proposal, *sample); });
    return live->log_likelihood_ratio(proposal, tests, story_since);
  };
  if (!standing.youth.is_over())
    return standing.is_holding_back() &&
           gain_since(0, standing.youth.story_since()) + standing.youth.log_odds_wrong() <= 0;
  if (live->is_in_doubt() || known.version > index) return true;
  // A body that changed keeps its tree, or what is stored of it could not be put back: that of a
  // stuck joint lacks the signal by which it will move again.
  if (!known.changes.empty() && !has_same_tree(proposal, known)) return true;
  // What the body was like before it changed is in the schema too, as far as that stayed so.
  return since > 0 && gain_since(since, 0) <= 0;
}

void ModelMonitor::remember_refusal(const health_event_t& event) {
  std::vector<health_event_t> verdicts = std::move(memory_.verdicts.events);
  if (verdicts.size() == kMaxEvents) verdicts.erase(verdicts.begin());
  verdicts.push_back(event);
  verdicts.back().event_number =
      verdicts.size() > 1 ? verdicts[verdicts.size() - 2].event_number + 1 : 0;
  set_array(memory_.verdicts.num_events, memory_.verdicts.events, std::move(verdicts));
}

void ModelMonitor::judge(const body_schema_t& message) {
  const BodySchema learned = from_message(message);
  BodySchema proposal = better_one(learned);
  const std::int64_t index = proposal.last_sample_index;
  Standing standing = standing_after(index);
  judged_sample_ = index;
  judged_utime_ = proposal.utime;

  health_event_t event{};
  event.utime = proposal.utime;
  event.event_sample = index;
  event.event_from = event.event_to = event.event_part = event.event_tag = -1;
  event.event_since = event.event_size.size_signal = -1;
  bool is_new_base = false, is_changed = false;
  const LiveSchema* live = standing.live.get();
  if (!is_passed_over(proposal, standing)) {
    bool was_tested = false;
    std::string why_not = objection(&proposal, standing, &was_tested);
    // Poses may refute what corners prefer: the learned schema may stand all the same.
    if (!why_not.empty() && proposal.refined && !is_passed_over(learned, standing)) {
      proposal = learned;
      why_not = objection(&proposal, standing, &was_tested);
    }
    if (why_not.empty()) {
      // base_version stays the proposal's: which version stood here before depends on the speed of
      // the learner.
      proposal.version = index + 1;
      if (live) proposal.changes = standing.schema()->changes;
      event.event_kind = health_event_t::EVENT_SCHEMA_ACCEPTED;
      event.event_text = fmt::format("version {}: {} edges, {}{}", proposal.version,
                                     proposal.edges.size(), proposal.refined ? "refined, " : "",
                                     proposal.complete ? "complete" : "incomplete");
      standing.add(event);
      set_base(&standing, std::move(proposal));
      is_new_base = is_changed = true;
    } else if (was_tested) {
      event.event_kind = health_event_t::EVENT_SCHEMA_REFUSED;
      event.event_text = why_not;
      standing.add(event);
      is_changed = true;
      remember_refusal(event);
    }
  }
  if (!is_new_base && standing.is_holding_back() && standing.youth.is_story_believed()) {
    standing.tell(judged_utime_);
    memory_.verdicts.schema_version = index + 1;
    is_changed = true;
  }
  if (!is_new_base && standing.live && standing.youth.is_over() && !standing.live->is_in_doubt() &&
      index - standing.live->base().last_sample_index >= kRenewal) {
    BodySchema renewed = standing.live->schema();
    renewed.last_sample_index = index;
    set_base(&standing, std::move(renewed));
    is_changed = true;
  }
  memory_.verdicts.utime = judged_utime_;
  memory_.verdicts.judged_sample = judged_sample_;
  is_rewound_ = true;
  go_on_from(std::move(standing), is_changed);
  is_rewound_ = false;
}

}  // namespace bodyschema
