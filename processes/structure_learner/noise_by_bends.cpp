#include "processes/structure_learner/noise_by_bends.h"

#include <utility>

namespace bodyschema {

const SourcedNoise& NoiseByBends::at(const std::vector<Signal>& signals,
                                     const std::vector<ActionPoseSample>& displaced_by_these,
                                     const LearnOptions& options) {
  std::vector<std::vector<double>> bends;
  for (const Signal& signal : signals) bends.push_back(signal.warp);
  const auto [known, is_new] = known_.try_emplace(std::move(bends));
  if (is_new)
    known->second = marker_noise(displaced_by_these, static_cast<int>(signals.size()), options);
  return known->second;
}

}  // namespace bodyschema
