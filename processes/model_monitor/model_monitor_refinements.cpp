// What ModelMonitor makes of the refiner's answers.

#include <algorithm>

#include "common/bus/convert.h"
#include "common/camera/corner_likelihood.h"
#include "processes/model_monitor/model_monitor.h"

namespace bodyschema {

bool ModelMonitor::waits_for_refiner(const body_schema_t& proposal) {
  const std::int64_t index = proposal.last_sample_index;
  if (proposal.is_complete == 0 || !due_.contains(index)) return false;
  if (refinements_.question() != index) refinements_.ask(index);
  is_assessed_ = false;
  return refinements_.is_waiting();
}

bool ModelMonitor::on_refined_schema(const body_schema_t& refined) {
  if (refined_ && refined.last_sample_index <= refined_->last_sample_index) return false;
  answers_.insert_or_assign(refined.last_sample_index, refined);
  // Those of use first are kept, as of proposals.
  if (answers_.size() > kMaxWaiting) answers_.erase(std::prev(answers_.end()));
  if (!take_answers()) return false;
  judge_waiting();
  return true;
}

bool ModelMonitor::take_answers() {
  bool is_taken = false;
  while (!answers_.empty() && answers_.begin()->first <= last_sample_index_) {
    const body_schema_t answer = answers_.extract(answers_.begin()).mapped();
    const std::int64_t index = answer.last_sample_index;
    if (index > judged_sample_ && !due_.contains(index)) continue;
    refined_ = from_message(answer);
    wanted_ = answer.wanted_actions;
    refinements_.answer(index);
    is_taken = true;
  }
  if (is_taken) is_assessed_ = false;
  return is_taken;
}

bool ModelMonitor::on_tick(std::int64_t now_us) {
  if (!refinements_.on_tick(now_us)) return false;
  is_assessed_ = false;
  judge_waiting();
  return true;
}

bool ModelMonitor::are_wanted_for(const BodySchema& schema) const {
  if (wanted_.empty() || refined_->last_sample_index > judged_sample_) return false;
  const std::int64_t since = schema.changes.empty() ? 0 : schema.changes.back().since;
  return body_since(*refined_) == since && has_same_tree(*refined_, schema) &&
         std::ranges::none_of(schema.edges,
                              [](const Edge& edge) { return edge.state == EdgeState::kInvalid; });
}

std::vector<double> ModelMonitor::corner_costs(const BodySchema& schema, const BodySchema& other,
                                               std::int64_t first, std::int64_t last) const {
  const TagView& view = *config_.view;
  std::vector<double> costs;
  for (const ActionPoseSample* sample : tests_between(first, last)) {
    const auto seen = sights_.find(sample->sample_index);
    if (seen == sights_.end() || !fits(schema, *sample)) continue;
    std::vector<TagSight> tags = seen->second;
    std::erase_if(tags, [&](const TagSight& sight) {
      const TagPlacement* tag = view.markers.find(sight.tag);
      return !tag || !schema.has_part(tag->part) || !other.has_part(tag->part) ||
             has_moved(schema.moved_tags, sight.tag, sample->sample_index);
    });
    const CornerErrors errors =
        corner_errors(schema, sample->action, tags, view.markers, view.lens, view.corner_noise);
    if (errors.num_tags > 0) costs.push_back(errors.cost);
  }
  return costs;
}

bool ModelMonitor::predicts_corners_better(const BodySchema& schema, const BodySchema& other,
                                           std::int64_t last) const {
  const std::int64_t first = body_since(schema);
  return config_.view && is_likelier(corner_costs(schema, other, first, last),
                                     corner_costs(other, schema, first, last));
}

bool ModelMonitor::is_defended(const BodySchema& refined, const BodySchema& proposal) const {
  return refined.refined && std::ranges::includes(refined.parts, proposal.parts) &&
         !predicts_corners_better(proposal, refined, proposal.last_sample_index);
}

BodySchema ModelMonitor::better_one(BodySchema learned) const {
  const std::int64_t index = learned.last_sample_index;
  if (!refined_ || !refined_->refined || refined_->last_sample_index != index) return learned;
  BodySchema refined = *refined_;
  refined.calibration_id = learned.calibration_id;
  return predicts_corners_better(refined, learned, index) ? refined : learned;
}

}  // namespace bodyschema
