#include "processes/model_monitor/health/fallen_markers.h"

#include <algorithm>

#include "processes/model_monitor/likelihood/reading_distance.h"

namespace bodyschema {
namespace {

constexpr double kSame = ReadingDistance::kSame, kOther = ReadingDistance::kOther;
/// Two readings of a wrong pose may agree by chance or by a bias of the view.
constexpr int kRepetitions = 2;

}  // namespace

std::optional<std::int64_t> FallenMarkers::look(const ActionPoseSample& sample, int part,
                                                const Pose& X_CB,
                                                const MeasurementModel& measurement) {
  if (const PartObservation* seen = sample.find(part)) {
    const auto reading = measurement.reading(*seen, X_CB);
    const ReadingDistance distance(reading.covariance);
    if (distance(X_CB, reading.X_CB) < kOther) {
      far_off_.erase(part);
      return std::nullopt;
    }
    const Sighting first{sample.sample_index, 0, reading.X_CB, X_CB};
    const int tag = seen->tags.empty() ? -1 : seen->tags.front();
    Sighting& sighting = far_off_[part].emplace(tag, first).first->second;
    if (distance(sighting.seen, reading.X_CB) > kSame) {
      sighting = first;
      return std::nullopt;
    }
    if (distance(sighting.predicted, X_CB) > kOther) {
      ++sighting.num_repeated;
      sighting.predicted = X_CB;
    }
  }
  const auto known = far_off_.find(part);
  if (known == far_off_.end()) return std::nullopt;
  // Where one of its tags lies, another is believed to as long as it does not move.
  std::optional<std::int64_t> since;
  for (const auto& [tag, sighting] : known->second)
    if (sighting.num_repeated >= kRepetitions)
      since = std::min(since.value_or(sighting.since), sighting.since);
  return since;
}

}  // namespace bodyschema
