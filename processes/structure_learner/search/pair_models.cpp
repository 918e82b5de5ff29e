#include "processes/structure_learner/search/pair_models.h"

#include <algorithm>
#include <iterator>
#include <limits>

#include "processes/structure_learner/tree_fit.h"

namespace bodyschema {
namespace {

// A refuted fit that costs less a frame may yet be right (a valid one costs 4 to 7).
constexpr double kMaxNearMissCost = 9;
constexpr double kMaxSmallNearMissCost = 14;  // with at most one joint

}  // namespace

void PairRecord::note_undecided(int num_signals, double mean_capped) {
  const auto [it, is_new] = undecided.emplace(num_signals, mean_capped);
  if (!is_new) it->second = std::min(it->second, mean_capped);
}

std::tuple<int, double> rank(const Candidate& candidate) {
  return {candidate.model.num_joints(), -candidate.score};
}

PairModels::PairModels(const std::vector<ActionPoseSample>& samples,
                       const NormalizedActions& actions, const std::vector<int>& parts,
                       const SearchOptions& options)
    : samples_(samples), actions_(actions), options_(options) {
  for (const int i : parts)
    for (const int j : parts)
      if (i < j)
        records_[{i, j}].num_common =
            options_.unconnectable.contains({i, j}) ? 0 : count_common(samples, i, j);
  const int num_pairs = std::max(1, static_cast<int>(records_.size()));
  max_frames_ = std::clamp(40000 / num_pairs, 60, 80);
  max_motions_ = num_pairs > 200 ? 150 : 300;
}

const PairData& PairModels::pair(int part_i, int part_j) {
  const auto [it, is_new] = pairs_.try_emplace({part_i, part_j});
  if (is_new) it->second = pair_data(part_i, part_j, max_frames_);
  return it->second;
}

const RelativeMotions& PairModels::motions(int part_i, int part_j) {
  const auto [it, is_new] = motions_.try_emplace({part_i, part_j});
  if (is_new) it->second = relative_motions(pair(part_i, part_j), max_motions_);
  return it->second;
}

PairData PairModels::part_data(int part) const {
  return make_part_data(samples_, part, options_.measurement, max_frames_);
}

PairData PairModels::pair_data(int part_i, int part_j, int max_frames) const {
  const bool may_be_edge = !options_.unconnectable.contains(std::minmax(part_i, part_j));
  return make_pair_data(samples_, part_i, part_j, options_.measurement,
                        may_be_edge ? max_frames : 0);
}

bool PairModels::rests(int part) {
  const auto [it, is_new] = rests_.try_emplace(part);
  if (is_new) it->second = is_at_rest(part_data(part), actions_, options_.validity);
  return it->second;
}

std::optional<Candidate> PairModels::try_start(int part_i, int part_j, const LocalModel& start) {
  if (is_refuted(part_i, part_j, start)) return std::nullopt;
  const PairData& data = pair(part_i, part_j);
  PairRecord& tried = record(part_i, part_j);
  const bool all = data.size() == tried.num_common;
  const Fit fit = fit_local_model(start, data, actions_, 40, 1e-2);
  last_cost_ = fit.cost / data.size();
  ++num_fits;
  ValidityOptions options = options_.validity;
  options.lenient = !all;
  const Validity validity =
      check_validity(fit, leave_one_out(fit, data, actions_), data, actions_, options);
  tried.has_far_outliers |= validity.has_far_outliers;
  if (validity.verdict == Verdict::kNotEnoughData)
    tried.note_undecided(start.num_joints(), validity.is_noise_lasting ? 0 : validity.mean_capped);
  if (validity.verdict == Verdict::kValid)
    return Candidate{{part_i, part_j, fit.model, validity.score},
                     data.size(),
                     validity.num_outliers,
                     validity.mean_capped,
                     validity.doubtful,
                     all};
  if (fit.cost < (start.num_joints() < 2 ? kMaxSmallNearMissCost : kMaxNearMissCost) * data.size())
    near_misses_.push_back({part_i, part_j, fit.model, last_cost_});
  return std::nullopt;
}

bool PairModels::confirm_on_all_data(Candidate* candidate) {
  if (candidate->on_all_data) return candidate->is_valid;
  const PairData data = make_pair_data(samples_, candidate->part_i, candidate->part_j,
                                       options_.measurement, std::numeric_limits<int>::max());
  const Fit fit = fit_local_model(candidate->model, data, actions_, 15, 1e-2);
  ++num_fits;
  const Validity validity =
      check_validity(fit, leave_one_out(fit, data, actions_), data, actions_, options_.validity);
  candidate->model = fit.model;
  candidate->on_all_data = true;
  candidate->is_valid = validity.verdict == Verdict::kValid;
  return candidate->is_valid;
}

std::optional<Candidate> PairModels::only_best(const std::vector<Candidate>& candidates) {
  if (candidates.empty()) return std::nullopt;
  const Candidate& best = *std::ranges::min_element(candidates, {}, rank);
  const auto is_rival = [&best](const Candidate& other) {
    return other.joins(best.part_i, best.part_j) &&
           other.model.num_joints() == best.model.num_joints() &&
           signals_of_joints(other.model) != signals_of_joints(best.model) &&
           (best.score - other.score) * best.num_frames < kAmbiguityMargin;
  };
  const auto rival = std::ranges::find_if(candidates, is_rival);
  if (rival == candidates.end()) return best;
  record(best.part_i, best.part_j).note_undecided(best.model.num_joints(), best.mean_capped);
  note_look_alikes(best, *rival);
  return std::nullopt;
}

void PairModels::note_look_alikes(const Candidate& best, const Candidate& other) {
  std::vector<int> differ;
  std::ranges::set_symmetric_difference(signal_set(best.model), signal_set(other.model),
                                        std::back_inserter(differ));
  if (differ.size() == 2 && actions_.are_alike(differ[0], differ[1]))
    record(best.part_i, best.part_j).look_alikes.emplace(differ[0], differ[1]);
}

std::vector<NearMiss> PairModels::near_misses() const {
  std::vector<NearMiss> result = near_misses_;
  std::stable_sort(result.begin(), result.end(), [](const NearMiss& x, const NearMiss& y) {
    return std::tuple(x.model.num_joints(), x.cost) < std::tuple(y.model.num_joints(), y.cost);
  });
  std::set<Key> met;
  std::erase_if(result, [&met](const NearMiss& m) {
    return !met.insert(key(m.part_i, m.part_j, m.model)).second;
  });
  return result;
}

}  // namespace bodyschema
