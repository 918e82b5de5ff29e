#pragma once

#include <cstdint>
#include <deque>
#include <map>
#include <optional>
#include <vector>

#include "processes/model_monitor/health/adaptation_event.h"

namespace bodyschema {

/// Finds an edge that changes to and fro: a loose screw, a cable that catches now and then, or a
/// transmission with more play than its model has room for.
class Alternations {
 public:
  struct Found {
    int part = 0;            ///< the edge that leads to it
    std::int64_t since = 0;  ///< its first change
  };
  /// Events of one sample, samples in their order. Finds an edge at its kChanges-th change, away
  /// and back in turn, within kWithin samples, and forgets all others then. A guess that is taken
  /// back is no change.
  std::optional<Found> look(const std::vector<AdaptationEvent>& events);

  /// Chosen: a fault is found and repaired, or explained otherwise once, in fewer.
  static constexpr std::size_t kChanges = 4;
  static constexpr std::int64_t kWithin = 60;

 private:
  struct Change {
    std::int64_t sample = 0;
    bool is_away = false;  ///< a changed model was adopted; else one from before
  };
  std::map<int, std::deque<Change>> changes_;  ///< by part; away and back in turn
};

}  // namespace bodyschema
