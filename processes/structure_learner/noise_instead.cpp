#include "processes/structure_learner/noise_instead.h"

#include <algorithm>

#include "processes/structure_learner/edge_fit.h"
#include "processes/structure_learner/noise_estimate.h"

namespace bodyschema {
namespace {

// Above so many times the told noise an estimate refutes it. Where it is told right,
// `imperfect_robots --samples 60` has 1.0 to 1.35 (the estimate is 1.2 times too large), where tags
// are not as told 1.3 to 4.
constexpr double kRefutes = 1.4;
// Chosen: as many times the told noise is tried before (confirmed_structure.cpp).
constexpr double kFarMore = 4;
// Samples of a part together with another that tell its noise (chosen).
constexpr int kFewestTelling = 20;

// Every part was seen together with some other so often that what models leave tells the noise.
bool tells_noise(const LearnedStructure& structure) {
  return std::all_of(structure.parts.begin(), structure.parts.end(), [&](int part) {
    const auto& records = structure.search.records;
    return std::any_of(records.begin(), records.end(), [&](const auto& of) {
      return (of.first.first == part || of.first.second == part) &&
             of.second.num_common >= kFewestTelling;
    });
  });
}

}  // namespace

bool has_soft_edge(const SearchResult& search) {
  return std::any_of(search.models.begin(), search.models.end(),
                     [](const AcceptedModel& m) { return !m.soft_signals.empty(); });
}

std::optional<Noise> noise_instead(const LearnedStructure& by_told,
                                   const std::vector<ActionPoseSample>& samples,
                                   const LearnOptions& options) {
  const std::optional<Noise>& told = options.measurement.noise;
  const SearchResult& search = by_told.search;
  const bool is_refuted = by_told.noise_source == NoiseSource::kGiven && search.residual_scale > 1;
  const bool stands = by_told.spans() && !by_told.is_contested && search.redundant.empty() &&
                      search.couplings.empty() && !has_soft_edge(search) && !is_refuted;
  if (!told || stands || !tells_noise(by_told)) return std::nullopt;
  // Where bodies are soft, the order of longer chains would be searched for in vain; of a stream
  // none is searched for.
  const bool is_vain = has_soft_edge(search) && !by_told.actions.blocks().is_stream();
  const int max_signals =
      is_vain ? std::min(options.max_signals, kMaxScreenedJoints) : options.max_signals;
  const auto shown = estimate_noise(samples, static_cast<int>(by_told.signals.size()), max_signals);
  if (!shown || shown->source != NoiseSource::kResiduals || is_above_any_marker(*shown) ||
      (shown->position_m < kRefutes * told->position_m &&
       shown->rotation_rad < kRefutes * told->rotation_rad))
    return std::nullopt;
  // Joints that a second signal moves are hidden by so much noise, where the told one has room for
  // them.
  const bool is_explained = by_told.spans() && search.redundant.empty() && !is_refuted;
  if (is_explained && (shown->position_m > kFarMore * told->position_m ||
                       shown->rotation_rad > kFarMore * told->rotation_rad))
    return std::nullopt;
  return Noise{std::max(told->position_m, shown->position_m),
               std::max(told->rotation_rad, shown->rotation_rad)};
}

}  // namespace bodyschema
