#include "processes/model_monitor/fallen_markers.h"

#include "processes/model_monitor/reading_distance.h"

namespace bodyschema {
namespace {

constexpr double kSame = ReadingDistance::kSame, kOther = ReadingDistance::kOther;
/// Two readings of a wrong pose may agree by chance or by a bias of the view.
constexpr int kRepetitions = 2;

}  // namespace

std::optional<std::int64_t> FallenMarkers::look(const ActionPoseSample& sample, int part,
                                                const Pose& X_CB, const MarkerNoise& noise) {
  const PartObservation* seen = sample.find(part);
  const auto known = far_off_.find(part);
  if (seen) {
    const ReadingDistance distance(covariance_of(*seen, noise));
    if (distance(X_CB, seen->X_CB) < kOther) {
      if (known != far_off_.end()) far_off_.erase(known);
      return std::nullopt;
    }
    if (known == far_off_.end() || distance(known->second.seen, seen->X_CB) > kSame) {
      far_off_[part] = {sample.sample_index, 0, seen->X_CB, X_CB};
      return std::nullopt;
    }
    if (distance(known->second.predicted, X_CB) > kOther) {
      ++known->second.num_repeated;
      known->second.predicted = X_CB;
    }
  }
  if (known == far_off_.end() || known->second.num_repeated < kRepetitions) return std::nullopt;
  return known->second.since;
}

}  // namespace bodyschema
