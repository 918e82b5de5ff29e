#include "processes/refiner/refiner.h"

#include <algorithm>
#include <exception>
#include <iterator>

#include "bodyschema/action_command_t.hpp"
#include "common/bus/convert.h"
#include "processes/refiner/held_out.h"

namespace bodyschema {
namespace {

constexpr std::size_t kMostProposals = 64;

}  // namespace

Refiner::Refiner(RefinerSettings settings)
    : settings_(std::move(settings)), schedule_(settings_.options.config.refine_every) {}

bool RefinedProposal::is_better() const {
  return refinement && predicts_corners_better(refinement->after, refinement->before);
}

body_schema_t RefinedProposal::answer() const {
  body_schema_t answer = is_better() ? to_message(refinement->schema) : learned;
  std::vector<wanted_action_t> wanted;
  for (const WantedAction& action :
       refinement ? refinement->wanted_actions : std::vector<WantedAction>()) {
    wanted_action_t& message = wanted.emplace_back();
    set_array(message.num_signals, message.wanted_action,
              std::vector<double>(action.action.begin(), action.action.end()));
    message.fall = action.fall;
    message.reducible_fall = action.reducible_fall;
  }
  set_array(answer.num_wanted, answer.wanted_actions, std::move(wanted));
  return answer;
}

void Refiner::on_sample(const sample_t& sample) {
  if (sample.sample_index <= last_sample_index_) return;
  last_sample_index_ = sample.sample_index;
  samples_.add(std::make_shared<const RefinerSample>(refiner_sample(sample)));
  if (sample.purpose == action_command_t::PURPOSE_TEST && schedule_.is_due(sample.sample_index))
    due_.push_back(sample.sample_index);
  match();
}

void Refiner::on_learned_schema(const body_schema_t& proposal) {
  if (proposal.is_complete == 0 || proposal.last_sample_index <= taken_) return;
  proposals_.insert_or_assign(proposal.last_sample_index, proposal);
  // A proposal from nowhere cannot displace those that will be refined first.
  if (proposals_.size() > kMostProposals)
    proposals_.erase(proposals_.begin()->first < last_sample_index_ ? proposals_.begin()
                                                                    : std::prev(proposals_.end()));
  match();
}

void Refiner::match() {
  for (auto due = due_.begin(); due != due_.end();) {
    const auto proposal = proposals_.find(*due);
    if (*due > taken_ && proposal != proposals_.end()) {
      taken_ = *due;
      jobs_.push_back(std::move(proposal->second));
    }
    // Proposals come in order.
    due = *due <= taken_ ? due_.erase(due) : std::next(due);
  }
  proposals_.erase(proposals_.begin(), proposals_.upper_bound(taken_));
  while (!due_.empty() && due_.front() < last_sample_index_ - Retained<RefinerSample>::kMaxLag)
    due_.pop_front();
}

void Refiner::drop_older_jobs() {
  while (jobs_.size() > 1) jobs_.pop_front();
}

std::function<RefinedProposal()> Refiner::take_job() {
  body_schema_t message = std::move(jobs_.front());
  jobs_.pop_front();
  const BodySchema schema = from_message(message);
  std::int64_t since = 0;
  for (const Edge& edge : schema.edges) since = std::max(since, edge.valid_since_sample);
  std::vector<RefinerSample> samples;
  for (const auto& sample : samples_.between(since, message.last_sample_index))
    samples.push_back(*sample);
  return [schema, samples = std::move(samples), message = std::move(message), rig = settings_.rig,
          options = settings_.options] {
    RefinedProposal result;
    result.learned = message;
    try {
      result.refinement = refine(schema, samples, rig, options);
      result.refinement->schema.version = 0;
      result.refinement->schema.base_version = 0;
      result.refinement->schema.last_sample_index = message.last_sample_index;
      result.refinement->schema.utime = message.utime;
    } catch (const std::exception& error) {
      result.problem = error.what();
    }
    return result;
  };
}

}  // namespace bodyschema
