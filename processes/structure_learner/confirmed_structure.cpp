#include "processes/structure_learner/confirmed_structure.h"

#include <algorithm>
#include <cmath>
#include <optional>
#include <set>
#include <tuple>
#include <utility>
#include <vector>

namespace bodyschema {
namespace {

// Above it the residuals refute the noise that is told. Of right structures in white noise they
// have 0.84 to 0.98 of the variance assumed (heavy tails are weighted down).
constexpr double kLargestResidual = 1;
// Below a quarter of that, half the noise explains them as well: it is not the noise of all parts.
constexpr double kSmallestResidual = 0.84 / 4;
constexpr double kMostNoise = 4;  // of the told one; it is confirmed at twice that
// How much noise a model of a stream leaves is known to about that factor.
constexpr double kStep = 1.2;
constexpr int kSteps = 2;
// Chosen: of 12 robots with a view bias of 4 mm and 2°, told 12 mm and 4°, 50 samples, none is
// right with 0, all with 0.5, 1 and 2.
constexpr double kUnknownBias = 0.5;

// Two bodies, signals with their multiplicity, and those of a Gaussian process.
using EdgeSignature = std::tuple<int, int, std::multiset<int>, std::vector<int>>;

bool is_rigid(const AcceptedModel& edge) {
  return edge.model.joints.empty() && edge.soft_signals.empty();
}

// What a structure says of bodies. Parts that are fixed to each other are one body: by which of
// these a joint hangs on it is left to how noisy they are.
class Bodies {
 public:
  explicit Bodies(const LearnedStructure& structure) : components_(structure.parts) {
    for (const AcceptedModel& edge : structure.search.models)
      if (is_rigid(edge)) components_.join(edge.part_i, edge.part_j);
    for (const AcceptedModel& edge : structure.search.models)
      if (!is_rigid(edge)) edges_.insert(signature_of(edge));
  }
  bool have(const AcceptedModel& edge) const {
    return is_rigid(edge) ? components_.of(edge.part_i) == components_.of(edge.part_j)
                          : edges_.contains(signature_of(edge));
  }
  bool have_all(const LearnedStructure& structure) const {
    return std::ranges::all_of(structure.search.models,
                               [this](const AcceptedModel& edge) { return have(edge); });
  }

 private:
  EdgeSignature signature_of(const AcceptedModel& edge) const {
    const auto [a, b] = std::minmax({components_.of(edge.part_i), components_.of(edge.part_j)});
    return {a, b, signals_of_joints(edge.model), edge.soft_signals};
  }

  Components components_;
  std::set<EdgeSignature> edges_;
};

bool are_same(const LearnedStructure& a, const LearnedStructure& b) {
  return Bodies(a).have_all(b) && Bodies(b).have_all(a);
}

// Edges between the same parts, by the same signals, be they those of joints or of processes.
bool has_same_signals(const LearnedStructure& a, const LearnedStructure& b) {
  const auto edges_of = [](const LearnedStructure& structure) {
    std::set<std::tuple<int, int, std::set<int>>> result;
    for (const AcceptedModel& edge : structure.search.models) {
      std::set<int> signals = signal_set(edge.model);
      signals.insert(edge.soft_signals.begin(), edge.soft_signals.end());
      result.emplace(edge.part_i, edge.part_j, std::move(signals));
    }
    return result;
  };
  return edges_of(a) == edges_of(b);
}

bool is_soft(const LearnedStructure& structure) {
  return std::any_of(structure.search.models.begin(), structure.search.models.end(),
                     [](const AcceptedModel& edge) { return !edge.soft_signals.empty(); });
}

std::set<int> signals_of(const LearnedStructure& structure) {
  std::set<int> result;
  for (const AcceptedModel& edge : structure.search.models) result.merge(signal_set(edge.model));
  return result;
}

// Noise that is guessed from what models leave has room for whatever they leave.
bool is_noise_known(const LearnedStructure& structure) {
  return structure.noise_source != NoiseSource::kResiduals &&
         structure.noise_source != NoiseSource::kAssumed;
}

bool has_doubtful_joints(const LearnedStructure& structure) {
  return !structure.search.redundant.empty() || !structure.search.couplings.empty();
}

// A structure that does not span for want of data: more noise does not help.
bool lacks_data(const LearnedStructure& structure) {
  return !structure.spans() &&
         std::any_of(structure.search.records.begin(), structure.search.records.end(),
                     [](const auto& record) { return !record.second.undecided.empty(); });
}

// Valid models were taken back, because their data could not have refuted them: nothing else is
// there to be found.
bool has_untold_edges(const LearnedStructure& structure) {
  return std::any_of(structure.search.records.begin(), structure.search.records.end(),
                     [](const auto& record) { return !record.second.untold_signals.empty(); });
}

// A part that rests is always seen from the same side: no bias makes it stray, nor what is fixed to
// it.
bool fixes_what_strays(const LearnedStructure& louder, const std::set<int>& resting) {
  return std::any_of(
      louder.search.models.begin(), louder.search.models.end(), [&](const AcceptedModel& edge) {
        return is_rigid(edge) && resting.contains(edge.part_i) != resting.contains(edge.part_j);
      });
}

LearnedStructure contested(LearnedStructure structure, const LearnedStructure& rival) {
  const Bodies of_rival(rival);
  const auto removed = std::erase_if(
      structure.search.models, [&](const AcceptedModel& edge) { return !of_rival.have(edge); });
  structure.is_contested = removed > 0;
  return structure;
}

// A guess of the noise that leaves room for more: what is above any marker's is motion.
bool may_be_louder(const LearnedStructure& structure) {
  const MeasurementModel& measurement = structure.options.measurement;
  return structure.noise_source == NoiseSource::kResiduals && measurement.noise &&
         !is_above_any_marker({measurement.scale * measurement.noise->position_m,
                               measurement.scale * measurement.noise->rotation_rad});
}

// A structure with bent commands that needs less than `factor` times the noise once these are
// known.
std::optional<LearnedStructure> with_less_noise(const LearnedStructure& louder, double factor,
                                                const FindStructure& find) {
  if (std::ranges::all_of(louder.signals, [](const Signal& s) { return s.warp.empty(); }))
    return std::nullopt;
  for (double less = 1; less < factor; less *= 2) {
    LearnedStructure found = find({less, less > 1 ? kUnknownBias : 0, louder.signals});
    if (!found.spans() || has_doubtful_joints(found) || !are_same(found, louder)) continue;
    if (less > 1) found.noise_source = NoiseSource::kResiduals;
    return found;
  }
  return std::nullopt;
}

// The structure at the least noise that explains it; edges with needless joints are still in it.
LearnedStructure least_noise(LearnedStructure told, const FindStructure& find,
                             const ConnectSoftParts& connect_soft_parts) {
  // With more noise the screws would be back.
  if (lacks_data(told) || told.search.gave_way) return told;
  const bool is_explained = told.spans() && !is_soft(told);
  // Couplings alone are no reason to lose other joints.
  const bool is_in_doubt = !told.search.redundant.empty() ||
                           (told.search.residual_scale > kLargestResidual && is_noise_known(told));
  if (is_explained && !is_in_doubt && told.search.couplings.empty()) return told;
  const bool is_guess = !is_noise_known(told);
  if (is_guess && (told.actions.blocks().is_stream() ||
                   (told.spans() ? !has_doubtful_joints(told) : !may_be_louder(told))))
    return told;
  LearnedStructure quieter = told;
  for (double factor = 2; factor <= 2 * kMostNoise; factor *= 2) {
    LearnedStructure louder = find({factor, kUnknownBias});
    const bool is_first = factor == 2;
    if (is_first && is_explained && !louder.spans()) return told;
    // What more noise does not help to connect has another reason.
    if (!louder.spans() && louder.search.models.size() <= quieter.search.models.size()) break;
    if (fixes_what_strays(louder, told.search.resting)) break;
    if (quieter.spans() && !is_soft(quieter) && !has_doubtful_joints(quieter) &&
        are_same(quieter, louder)) {
      if (is_first) return quieter;
      if (!is_explained && !is_guess && quieter.search.residual_scale < kSmallestResidual) {
        if (auto with_bends = with_less_noise(quieter, factor, find)) return *std::move(with_bends);
        // Nor is it too small for all: what the screws leave may be a function of their signals.
        LearnedStructure soft = told;
        connect_soft_parts(&soft);
        if (soft.spans() && has_same_signals(soft, quieter)) return soft;
        told.is_contested = true;
        return told;
      }
      quieter.noise_source = NoiseSource::kResiduals;
      return quieter;
    }
    const std::set<int> used = signals_of(louder);
    for (const int s : signals_of(quieter))
      if (is_explained && !used.contains(s))
        return is_in_doubt ? contested(std::move(told), louder) : told;
    quieter = std::move(louder);
    if (is_guess && !is_explained && !may_be_louder(quieter)) break;
  }
  const bool is_rival = is_explained || (is_guess && quieter.spans());
  return is_rival ? contested(std::move(told), quieter) : told;
}

// At the least noise of the steps that spans, if one does.
LearnedStructure of_stream(LearnedStructure told, const FindStructure& find,
                           const ConnectSoftParts& connect_soft_parts) {
  connect_soft_parts(&told);
  if (told.noise_source != NoiseSource::kResiduals || told.search.models.empty()) return told;
  for (int step = 1; step <= kSteps && !told.spans() && !lacks_data(told); ++step) {
    LearnedStructure louder = find({.factor = std::pow(kStep, step)});
    connect_soft_parts(&louder);
    if (louder.spans()) told = std::move(louder);
  }
  return told;
}

// Edges with joints that are not needed: without them no model is valid. And chains whose gains
// more samples would tell.
void withdraw_doubtful(LearnedStructure* structure) {
  std::vector<std::pair<int, int>> needless = structure->search.redundant;
  for (const Coupling& coupling : structure->search.couplings)
    if (coupling.is_needless) needless.emplace_back(coupling.part_i, coupling.part_j);
  for (const auto& [part_i, part_j] : needless)
    std::erase_if(structure->search.models,
                  [&](const AcceptedModel& edge) { return edge.joins(part_i, part_j); });
  for (const auto& ends : structure->search.unknown_gains)
    std::erase_if(structure->search.models, [&](const AcceptedModel& edge) {
      if (!edge.joins(ends.first, ends.second)) return false;
      structure->search.records.at(ends).note_undecided(edge.model.num_joints(), 0);
      return true;
    });
}

}  // namespace

LearnedStructure confirmed_structure(const FindStructure& find,
                                     const ConnectSoftParts& connect_soft_parts) {
  LearnedStructure structure = find({});
  const bool is_stream = structure.actions.blocks().is_stream();
  if (is_stream) structure = of_stream(std::move(structure), find, connect_soft_parts);
  const auto is_soft_open = [is_stream](const LearnedStructure& found) {
    return !is_stream && !found.spans() && !found.is_contested && !has_untold_edges(found);
  };
  // Where the noise is a guess, more noise may be the answer only if no process is.
  std::optional<LearnedStructure> soft;
  if (is_soft_open(structure) && structure.noise_source == NoiseSource::kResiduals) {
    soft = structure;
    connect_soft_parts(&*soft);
  }
  if (!soft || !soft->spans()) {
    structure = least_noise(std::move(structure), find, connect_soft_parts);
    if (!is_soft_open(structure))
      soft.reset();
    else if (!soft)
      connect_soft_parts(&structure);
  }
  if (soft) structure = std::move(*soft);
  withdraw_doubtful(&structure);
  return structure;
}

}  // namespace bodyschema
