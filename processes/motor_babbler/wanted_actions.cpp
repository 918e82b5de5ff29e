#include "processes/motor_babbler/wanted_actions.h"

#include <fmt/format.h>

namespace bodyschema {

bool is_within_limits(const std::vector<double>& action, const std::vector<Signal>& signals) {
  if (action.size() != signals.size()) return false;
  for (std::size_t s = 0; s < signals.size(); ++s)
    if (!(action[s] >= signals[s].lower && action[s] <= signals[s].upper)) return false;
  return true;
}

std::optional<Eigen::VectorXd> WantedActions::take(const model_health_t& health) {
  if (health.wanted_sample != sample_) num_over_ = 0;
  sample_ = health.wanted_sample;
  while (num_over_ < std::ssize(health.wanted_actions)) {
    const auto& action = health.wanted_actions[static_cast<std::size_t>(num_over_++)].wanted_action;
    if (!is_within_limits(action, signals_)) continue;
    ++num_taken_;
    return Eigen::Map<const Eigen::VectorXd>(action.data(), std::ssize(action));
  }
  return std::nullopt;
}

std::string WantedActions::state_text() const {
  return fmt::format("wanted_actions: {{sample: {}, over: {}, taken: {}}}\n", sample_, num_over_,
                     num_taken_);
}

void WantedActions::restore(const Yaml& section) {
  sample_ = section.integer("sample", -1);
  num_over_ = section.integer("over", 0);
  num_taken_ = section.integer("taken", 0);
}

}  // namespace bodyschema
