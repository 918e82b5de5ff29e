#pragma once

#include <cstdint>

namespace bodyschema {

class Yaml;

/// At which TEST samples the refiner refines and the monitor waits for it: the first one after
/// every so many samples.
class RefinementSchedule {
 public:
  /// `every` [samples] 0: never.
  explicit RefinementSchedule(std::int64_t every) : every_(every), next_(every) {}

  /// Is it due at this TEST sample? To be asked of each once, in order.
  bool is_due(std::int64_t sample_index) {
    if (every_ == 0 || sample_index + 1 < next_) return false;
    next_ = ((sample_index + 1) / every_ + 1) * every_;
    return true;
  }

 private:
  std::int64_t every_;
  std::int64_t next_;  ///< number of samples from which on a TEST sample is due
};

/// `refine_every` of refiner.yaml. @throws ConfigError.
std::int64_t refine_every(const Yaml& refiner);

}  // namespace bodyschema
