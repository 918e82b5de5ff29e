#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "bodyschema/model_health_t.hpp"
#include "common/config/yaml.h"
#include "common/schema/signal.h"

namespace bodyschema {

/// One value per signal, within its limits.
bool is_within_limits(const std::vector<double>& action, const std::vector<Signal>& signals);

/// The actions that the refiner wants, as MODEL_HEALTH passes them on: each is taken once, that of
/// most help first, whatever the driver says to it. A newer list replaces what is left of the one
/// before.
class WantedActions {
 public:
  explicit WantedActions(std::vector<Signal> signals) : signals_(std::move(signals)) {}

  /// The first one that was not taken and is within the limits; it is taken now.
  std::optional<Eigen::VectorXd> take(const model_health_t& health);

  std::int64_t num_taken() const { return num_taken_; }
  /// A line of YAML. @throws ConfigError.
  std::string state_text() const;
  void restore(const Yaml& section);

 private:
  std::vector<Signal> signals_;
  std::int64_t sample_ = -1;   ///< wanted_sample of the list
  std::int64_t num_over_ = 0;  ///< of the list: taken, or left out
  std::int64_t num_taken_ = 0;
};

}  // namespace bodyschema
