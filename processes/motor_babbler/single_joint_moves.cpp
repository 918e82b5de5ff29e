#include "processes/motor_babbler/single_joint_moves.h"

#include <fmt/format.h>

#include <cmath>
#include <utility>

#include "bodyschema/action_command_t.hpp"

namespace bodyschema {
namespace {

// Parts that can be seen with a long chain between them and nothing in its middle.
constexpr std::size_t kNumEnds = 2;

}  // namespace

SingleJointMoves::SingleJointMoves(std::vector<Signal> signals, double share)
    : signals_(std::move(signals)), share_(share) {}

bool SingleJointMoves::is_turn(std::int64_t num_train) const {
  const auto num_turns = [&](std::int64_t n) {
    return std::floor(share_ * static_cast<double>(n));
  };
  return last_verdict_ >= 0 && !is_complete_ && parts_.size() <= kNumEnds && !pose_.empty() &&
         num_turns(num_train + 1) > num_turns(num_train);
}

std::size_t SingleJointMoves::next_signal() const {
  return static_cast<std::size_t>(num_moves_) % signals_.size();
}

void SingleJointMoves::on_sample(const sample_t& sample, std::int64_t num_train) {
  const bool is_train = sample.purpose == action_command_t::PURPOSE_TRAIN;
  if (is_train && is_turn(num_train - 1)) ++num_moves_;
  for (const part_observation_t& part : sample.parts) parts_.insert(part.part_id);
  for (const part_observation_t& part : sample.contradictions) parts_.insert(part.part_id);
  if (is_train && next_signal() == 0 && sample.parts.size() >= kNumEnds) pose_ = sample.action;
}

void SingleJointMoves::on_verdict(std::int64_t test_sample, bool is_complete) {
  if (test_sample <= last_verdict_) return;
  last_verdict_ = test_sample;
  is_complete_ = is_complete;
}

std::optional<std::vector<double>> SingleJointMoves::action(std::int64_t num_train,
                                                            double u) const {
  if (!is_turn(num_train)) return std::nullopt;
  std::vector<double> action = pose_;
  const Signal& signal = signals_[next_signal()];
  double& value = action[next_signal()];
  // Around the range as if its ends met: 1/4 to 3/4 of it on.
  const double range = signal.upper - signal.lower;
  const double place = (value - signal.lower) / range + 0.25 + 0.5 * u;
  value = signal.lower + range * (place - std::floor(place));
  return action;
}

std::string SingleJointMoves::state_text() const {
  return fmt::format(
      "single_joint_moves: {{pose: {}, moves: {}, parts: {}, last_verdict: {}, complete: {}}}\n",
      yaml_list(pose_), num_moves_, yaml_list({parts_.begin(), parts_.end()}), last_verdict_,
      is_complete_);
}

void SingleJointMoves::restore(const Yaml& section) {
  pose_ = section.numbers("pose");
  if (!pose_.empty() && pose_.size() != signals_.size())
    throw section.error("pose", "expected one number per signal");
  num_moves_ = section.integer("moves", 0);
  parts_.clear();
  for (const double part : section.numbers("parts")) parts_.insert(static_cast<int>(part));
  last_verdict_ = section.integer("last_verdict", -1);
  is_complete_ = section.boolean("complete");
}

}  // namespace bodyschema
