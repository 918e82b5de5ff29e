#include "processes/structure_learner/learn.h"

#include <algorithm>
#include <cmath>
#include <set>
#include <stdexcept>
#include <tuple>

#include "common/schema/warp_process.h"
#include "processes/structure_learner/command_lag.h"
#include "processes/structure_learner/command_warp.h"
#include "processes/structure_learner/confirmed_structure.h"
#include "processes/structure_learner/edge_fit.h"
#include "processes/structure_learner/learned_schema.h"
#include "processes/structure_learner/model_free_noise.h"
#include "processes/structure_learner/noise_by_bends.h"
#include "processes/structure_learner/noise_in_common.h"
#include "processes/structure_learner/noise_instead.h"
#include "processes/structure_learner/one_cluster.h"
#include "processes/structure_learner/positions/position_noise.h"
#include "processes/structure_learner/root_pose.h"
#include "processes/structure_learner/search/withdrawal.h"
#include "processes/structure_learner/second_place.h"
#include "processes/structure_learner/signal_rates.h"
#include "processes/structure_learner/soft_parts.h"
#include "processes/structure_learner/surrogate_commands.h"
#include "processes/structure_learner/told_noise.h"
#include "processes/structure_learner/unconnected.h"
#include "processes/structure_learner/wrong_commands.h"

namespace bodyschema {
namespace {

int check_actions(const std::vector<ActionPoseSample>& samples, std::size_t num_signals) {
  for (const auto& sample : samples)
    if (sample.action.size() != static_cast<Eigen::Index>(num_signals))
      throw std::invalid_argument("sample " + std::to_string(sample.sample_index) + " has " +
                                  std::to_string(sample.action.size()) + " action values, not " +
                                  std::to_string(num_signals));
  return static_cast<int>(num_signals);
}

SearchOptions search_options_of(const LearnOptions& options) {
  SearchOptions result;
  result.max_signals = options.max_signals;
  result.validity.outlier_rate = options.measurement.outlier_rate;
  result.measurement = options.measurement;
  result.unconnectable = options.unconnectable;
  return result;
}

// What processes leave in a stream beside its jitter lasts: a soft body remembers.
std::optional<Noise> noise_beside_soft_edges(const std::vector<ActionPoseSample>& displaced,
                                             const NormalizedActions& actions,
                                             const BodySchema& schema) {
  const bool all_soft =
      !schema.edges.empty() && std::ranges::all_of(schema.edges, [](const Edge& edge) {
        return edge.residual_gp != nullptr;
      });
  return all_soft ? noise_from_neighbours(displaced, actions) : std::nullopt;
}

// The told noise stands (tell_noise_from_body() keeps it as it is).
bool is_same(const Noise& noise, const std::optional<Noise>& told) {
  return told && noise.position_m == std::max(told->position_m, kNoiseFloor.position_m) &&
         noise.rotation_rad == std::max(told->rotation_rad, kNoiseFloor.rotation_rad);
}

// Noise of the markers, whatever the models leave: what edges that meet have in common, else what
// was told, else, of a stream, what its neighbours in time tell.
std::optional<Noise> noise_beside_models(const std::vector<ActionPoseSample>& displaced,
                                         const NormalizedActions& actions,
                                         const std::optional<Noise>& told,
                                         const BodySchema& schema) {
  if (const auto noise = noise_beside_soft_edges(displaced, actions, schema)) return noise;
  if (const auto common = noise_in_common(schema, displaced)) return common;
  return told || !actions.blocks().is_stream() ? told : noise_from_neighbours(displaced, actions);
}

LearnResult fit_tree(const LearnedStructure& structure,
                     const std::vector<ActionPoseSample>& samples, const LearnOptions& options,
                     bool must_be_valid) {
  const int num_signals = check_actions(samples, structure.signals.size());
  const SearchResult& search = structure.search;
  MeasurementModel measurement = structure.options.measurement;
  measurement.fixed_parts = fixed_parts(samples);

  LearnResult result;
  result.noise_source = structure.noise_source;
  result.command_delay = structure.command_delay;
  result.num_screens = search.num_screens;
  result.num_fits = search.num_fits;
  BodySchema& schema = result.schema;
  schema = start_schema(structure.signals, samples, options.root);
  schema.position_parts = structure.position_parts;
  schema.noise = measurement.noise ? *measurement.noise : typical_noise(samples);
  schema.noise.position_m *= measurement.scale;
  schema.noise.rotation_rad *= measurement.scale;

  // Everything that is fitted sees displacements.
  const std::vector<ActionPoseSample> moved =
      displaced(held_still(samples, structure.rates), structure.signals);
  const NormalizedActions actions(moved, num_signals);
  MeasurementModel told = measurement;
  if (options.measurement.noise || has_covariances(samples)) told.scale = options.measurement.scale;
  const EdgeData data{moved, actions, measurement, told, structure.options.validity};
  std::vector<FittedEdge> fitted;
  Refusals& refused = result.refused;
  visit_outwards(ends_of(search.models), schema, [&](int edge, int from, int to) {
    AcceptedModel start = search.models[static_cast<std::size_t>(edge)];
    start.model = rescaled(start.model, structure.actions, actions);
    FittedEdge fit = fit_edge(start, from, to, data, must_be_valid);
    std::optional<Refusal> why;
    if (!fit.is_valid)
      why = Refusal::kNotValid;
    else if (is_wrong_at_some_commands(fit, actions))
      why = Refusal::kWrongAtSomeCommands;
    else if (!options.is_monitored && is_wrong_at_an_end(fit, actions.blocks()))
      why = Refusal::kWrongAtAnEnd;
    else if (!options.is_monitored && keeps_to_second_place(fit, data, fitted))
      why = Refusal::kSecondPlace;
    if (why) {
      refused[std::minmax(from, to)] = *why;
      return false;
    }
    fitted.push_back(std::move(fit));
    return true;
  });
  estimate_root_pose(samples, measurement, &schema);
  if (schema.has_part(schema.root) && schema.has_rotation(schema.root))
    result.serial_correlation = fit_jointly(data, &fitted, &schema, &refused);
  for (const FittedEdge& f : fitted) schema.edges.push_back(f.edge);
  bool is_body_left = false;
  if (structure.noise_source == NoiseSource::kResiduals ||
      structure.noise_source == NoiseSource::kFrames)
    if (const auto noise = noise_beside_models(moved, actions, options.measurement.noise, schema)) {
      is_body_left = tell_noise_from_body(*noise, measurement.fixed_parts, &schema);
      if (is_same(schema.noise, options.measurement.noise))
        result.noise_source = NoiseSource::kGiven;
    }
  schema.set_covered(samples);

  const std::set<int> connected = connected_to_root(schema);
  report_unconnected(
      options.expected_parts,
      [&](int part) {
        const int num_moving = static_cast<int>(actions.moving().size());
        return explain_unconnected(part, samples, connected, structure, refused,
                                   std::min(options.max_signals, num_moving));
      },
      &schema);
  schema.undecided_signals = undecided_signals(schema, structure, is_body_left);
  result.is_one_cluster = is_one_cluster(schema, samples);
  result.outliers = attribute_outliers(schema, fitted, samples, measurement);
  return result;
}

}  // namespace

std::vector<ActionPoseSample> without_repetitions(const std::vector<ActionPoseSample>& samples) {
  std::set<std::vector<double>> met;
  std::vector<ActionPoseSample> result;
  for (const ActionPoseSample& sample : samples)
    if (met.insert(numbers_of(sample)).second) result.push_back(sample);
  return result;
}

SourcedNoise marker_noise(const std::vector<ActionPoseSample>& samples, int num_signals,
                          const LearnOptions& options) {
  if (const std::optional<Noise>& given = options.measurement.noise)
    return {{std::max(given->position_m, kNoiseFloor.position_m),
             std::max(given->rotation_rad, kNoiseFloor.rotation_rad)},
            NoiseSource::kGiven};
  if (has_covariances(samples)) return {typical_noise(samples), NoiseSource::kCovariances};
  return estimate_noise(samples, num_signals, options.max_signals)
      .value_or(SourcedNoise{kNoiseFloor, NoiseSource::kAssumed});
}

namespace {

// More readings are wild than assumed: models are refuted by these alone.
bool has_far_outliers(const SearchResult& search) {
  return std::any_of(search.records.begin(), search.records.end(),
                     [](const auto& record) { return record.second.has_far_outliers; });
}

// More edges, or as many with fewer joints.
bool connects_more_simply(const SearchResult& x, const SearchResult& y) {
  const auto num_joints = [](const SearchResult& search) {
    int sum = 0;
    for (const AcceptedModel& m : search.models) sum += m.model.num_joints();
    return sum;
  };
  return std::tuple(x.models.size(), -num_joints(x)) > std::tuple(y.models.size(), -num_joints(y));
}

enum class Commands { kStraight, kMayBeBent };

// Begins with the bends of `signals`.
LearnedStructure find_with_bias(const std::vector<Signal>& signals,
                                const std::vector<ActionPoseSample>& samples,
                                const LearnOptions& options, double unknown_bias, Commands commands,
                                NoiseByBends* noise_by_bends) {
  if (options.max_signals < 0) throw std::invalid_argument("max_signals must not be below 0");
  const int num_signals = check_actions(samples, signals.size());
  const std::vector<int> parts = seen_parts(samples);
  SearchOptions search_options = search_options_of(options);
  search_options.unknown_bias = unknown_bias;
  MeasurementModel& measurement = search_options.measurement;
  measurement.fixed_parts = fixed_parts(samples);
  NoiseSource noise_source = NoiseSource::kCovariances;
  const auto set_noise = [&](const std::vector<Signal>& bent,
                             const std::vector<ActionPoseSample>& of) {
    if (!options.measurement.noise && has_covariances(of)) return;
    const SourcedNoise& noise = noise_by_bends->at(bent, of, options);
    measurement.noise = noise;
    noise_source = noise.source;
  };
  const std::vector<ActionPoseSample> moved = displaced(samples, signals);
  set_noise(signals, moved);
  // What many joints leave by that much is no noise either.
  if (noise_source == NoiseSource::kResiduals && is_above_any_marker(*measurement.noise))
    search_options.max_signals = std::min(search_options.max_signals, kMaxScreenedJoints);
  NormalizedActions actions(moved, num_signals);
  SearchResult search = search_structure(moved, actions, parts, search_options);
  if (unknown_bias == 0 && has_far_outliers(search)) {
    search_options.validity.allows_far_outliers = true;
    SearchResult found = search_structure(moved, actions, parts, search_options);
    found.num_screens += search.num_screens;
    found.num_fits += search.num_fits;
    search_options.validity.allows_far_outliers = connects_more_simply(found, search);
    if (search_options.validity.allows_far_outliers) search = std::move(found);
  }
  LearnedStructure result{signals,           parts,       search_options, std::move(actions),
                          std::move(search), noise_source};
  // Everything that is fitted sees displacements; which commands are bent shows only by a model.
  const int max_warp_rounds = commands == Commands::kStraight ? 0 : 3;
  for (int round = 0; round < max_warp_rounds; ++round) {
    std::vector<Signal> bent = result.signals;
    if (!estimate_warps(samples, parts, result.search, search_options, &bent)) break;
    const std::vector<ActionPoseSample> again = displaced(samples, bent);
    set_noise(bent, again);
    NormalizedActions actions_again(again, num_signals);
    SearchResult found = search_structure(again, actions_again, parts, search_options);
    found.num_screens += result.search.num_screens;
    found.num_fits += result.search.num_fits;
    const bool was_spanning = result.spans();
    // What bends a command must be worth it to all markers together, not only to the models that
    // asked for it.
    const bool is_worth_it =
        found.models.size() >= result.search.models.size() &&
        (!was_spanning || found.log_likelihood >= result.search.log_likelihood + kWarpEvidence);
    if (!is_worth_it) {
      result.search.num_screens = found.num_screens;
      result.search.num_fits = found.num_fits;
      break;
    }
    result = {std::move(bent),  parts,       search_options, std::move(actions_again),
              std::move(found), noise_source};
    if (was_spanning) break;
  }
  return result;
}

// The leaves that have positions alone, beside the structure of all other parts.
void attach_leaves(const std::vector<ActionPoseSample>& samples, const LearnOptions& options,
                   LearnedStructure* structure) {
  const std::vector<ActionPoseSample> moved = displaced(samples, structure->signals);
  structure->parts = seen_parts(samples);
  const auto first_posed =
      std::find_if(structure->parts.begin(), structure->parts.end(), [&](int part) {
        return !std::binary_search(structure->position_parts.begin(),
                                   structure->position_parts.end(), part);
      });
  if (first_posed == structure->parts.end()) return;
  const int root = options.root.value_or(*first_posed);
  std::optional<Noise>& noise = structure->options.measurement.noise;
  if (noise && structure->noise_source != NoiseSource::kGiven) {
    const bool is_assumed = structure->noise_source == NoiseSource::kAssumed;
    if (is_assumed)
      if (const auto of_root =
              noise_at_rest(moved, root, structure->actions, structure->options.validity)) {
        noise = of_root;
        structure->search.resting.insert(root);
      }
    const auto of_positions =
        estimate_position_noise(moved, structure->actions, root, structure->search.resting);
    if (is_assumed && !of_positions) {
      for (const int part : structure->position_parts)
        structure->open_leaves[part] = {true,
                                        "how noisy the positions are is not known: tell it "
                                        "(--noise), or give orientations"};
      return;
    }
    if (of_positions) noise->position_m = std::max(noise->position_m, of_positions->position_m);
    if (is_assumed) structure->noise_source = of_positions->source;
  }
  PositionLeaves leaves = find_position_leaves(moved, structure->actions, root, structure->signals,
                                               structure->options, &structure->search);
  const bool has_one_rhythm = is_one_rhythm(moved, static_cast<int>(structure->signals.size()));
  for (AcceptedModel& model : leaves.models) {
    if (has_one_rhythm && model.model.num_joints() > 1)
      leaves.open[model.part_j] = {true, kOneRhythm};
    else
      structure->search.models.push_back(std::move(model));
  }
  structure->open_leaves = std::move(leaves.open);
}

// Takes back the edges that may be by chance, after the search: what they kept out is
// not tried.
void withdraw_what_is_by_chance(const std::vector<ActionPoseSample>& samples,
                                LearnedStructure* structure) {
  const std::vector<ActionPoseSample> moved = displaced(samples, structure->signals);
  const SurrogateCommands others(moved, static_cast<int>(structure->signals.size()),
                                 structure->options.measurement);
  // Poses at rest are independent: noise as markers have it is no motion.
  const bool is_doubtful =
      structure->noise_source == NoiseSource::kAssumed || structure->is_noise_guessed_too_large();
  if (!others.is_stream() && !is_doubtful) return;
  const bool has_one_rhythm = is_one_rhythm(moved, static_cast<int>(structure->signals.size()));
  std::erase_if(structure->search.models, [&](const AcceptedModel& model) {
    PairRecord& record = structure->search.records[std::minmax(model.part_i, model.part_j)];
    record.is_too_short |= others.is_short() && !model.soft_signals.empty();
    record.is_by_chance |= others.explain_as_well(model);
    record.has_one_rhythm |= has_one_rhythm && model.model.num_joints() > 1;
    // Nothing says that what a rigid one leaves is no motion.
    const bool is_rigid = model.model.joints.empty() && model.soft_signals.empty();
    return record.is_too_short || record.is_by_chance || record.has_one_rhythm ||
           (is_doubtful && is_rigid);
  });
}

// Of distinct samples of uniform parts, those in `alone` without rotation.
LearnedStructure find_in_step(const std::vector<Signal>& signals,
                              const std::vector<ActionPoseSample>& samples,
                              const std::vector<int>& alone, const LearnOptions& options) {
  std::vector<ActionPoseSample> poses = samples;
  for (ActionPoseSample& sample : poses)
    std::erase_if(sample.parts, [](const PartObservation& o) { return !o.has_rotation; });
  const auto confirmed = [&](const LearnOptions& by, NoiseByBends* noise,
                             Commands commands = Commands::kMayBeBent) {
    const auto find = [&](const StructureQuery& query) {
      LearnOptions louder = by;
      louder.measurement.scale *= query.factor;
      return find_with_bias(query.bent.empty() ? signals : query.bent, poses, louder,
                            query.unknown_bias, commands, noise);
    };
    return confirmed_structure(find, [&](LearnedStructure* found) {
      // With enough noise a screw passes for anything soft: nothing is tried beside it.
      if (!found->is_noise_guessed_too_large())
        connect_soft_parts(displaced(poses, found->signals), found->actions, found->parts,
                           found->options, found->noise_source == NoiseSource::kResiduals,
                           &found->search);
    });
  };
  NoiseByBends noise, louder_noise;
  LearnedStructure structure = confirmed(options, &noise);
  // All joints on a signal share its bend: one that a single joint has keeps out the others.
  const auto is_bent = [](const Signal& signal) { return !signal.warp.empty(); };
  if (!structure.spans() && std::ranges::any_of(structure.signals, is_bent)) {
    LearnedStructure straight = confirmed(options, &noise, Commands::kStraight);
    if (straight.search.models.size() > structure.search.models.size())
      structure = std::move(straight);
  }
  if (const std::optional<Noise> shown = noise_instead(structure, poses, options)) {
    LearnOptions louder = options;
    louder.measurement.noise = shown;
    LearnedStructure found = confirmed(louder, &louder_noise);
    found.noise_source = NoiseSource::kResiduals;
    if (!has_soft_edge(found.search)) structure = std::move(found);
  }
  withdraw_what_is_by_chance(poses, &structure);
  structure.position_parts = alone;
  if (!alone.empty()) attach_leaves(samples, options, &structure);
  return structure;
}

// What everything that is learned sees.
std::vector<ActionPoseSample> in_step(const std::vector<ActionPoseSample>& samples,
                                      const LearnedStructure& structure) {
  return with_commands_of_before(
      with_uniform_parts(without_repetitions(samples), structure.position_parts),
      structure.command_delay);
}

// Of distinct samples of uniform parts that may come after their commands.
LearnedStructure find_delayed(const std::vector<Signal>& signals,
                              const std::vector<ActionPoseSample>& samples,
                              const std::vector<int>& alone, const LearnOptions& options) {
  const auto find = [&](const CommandDelay& delay) {
    LearnedStructure found =
        find_in_step(signals, with_commands_of_before(samples, delay), alone, options);
    found.command_delay = delay;
    return found;
  };
  const CommandLag lag = command_lag(samples, static_cast<int>(signals.size()));
  const CommandDelay late{.lag_us = lag.us}, none;
  LearnedStructure structure = find(lag.is_significant ? late : none);
  if (!structure.spans() && lag.us != 0) {
    LearnedStructure other = find(lag.is_significant ? none : late);
    const std::size_t least = structure.search.models.size() + (lag.is_significant ? 0 : 1);
    if (other.search.models.size() >= least) structure = std::move(other);
  }
  const auto refined = [&](const LearnedStructure& by) {
    return refined_delay(samples, by.signals, by.actions, by.search.models, by.options.measurement,
                         by.command_delay);
  };
  const CommandDelay delay = refined(structure);
  if (delay == structure.command_delay) return structure;
  // Fewer edges too: what stood by a worse delay was not the body.
  LearnedStructure found = find(delay);
  found.command_delay = refined(found);
  return found;
}

}  // namespace

LearnedStructure find_structure(const std::vector<Signal>& signals,
                                const std::vector<ActionPoseSample>& samples,
                                const LearnOptions& options) {
  const int num_signals = check_actions(samples, signals.size());
  const std::vector<int> alone = parts_without_rotation(samples);
  const std::vector<ActionPoseSample> distinct =
      with_uniform_parts(without_repetitions(samples), alone);
  const std::vector<int> rates = rates_of_others(distinct, num_signals);
  if (rates.empty()) return find_delayed(signals, distinct, alone, options);
  LearnedStructure without_rates =
      find_delayed(signals, held_still(distinct, rates), alone, options);
  without_rates.rates = rates;
  if (without_rates.spans()) return without_rates;
  LearnedStructure structure = find_delayed(signals, distinct, alone, options);
  const bool is_worse = structure.search.models.size() < without_rates.search.models.size();
  return is_worse ? without_rates : structure;
}

LearnResult fit_structure(const LearnedStructure& structure,
                          const std::vector<ActionPoseSample>& samples,
                          const LearnOptions& options) {
  LearnResult result = fit_tree(structure, in_step(samples, structure), options, false);
  result.schema.num_samples = static_cast<int>(samples.size());
  return result;
}

LearnResult relearn(const LearnedStructure& structure, const std::vector<ActionPoseSample>& samples,
                    const LearnOptions& options) {
  LearnResult result = fit_tree(structure, in_step(samples, structure), options, true);
  result.schema.num_samples = static_cast<int>(samples.size());
  return result;
}

namespace {

// What the best models leave at most commands says too little of the others.
bool is_refused_by_guessed_noise(const LearnResult& result) {
  return result.noise_source == NoiseSource::kResiduals &&
         std::ranges::any_of(result.refused, [](const auto& refusal) {
           return refusal.second == Refusal::kWrongAtSomeCommands;
         });
}

}  // namespace

LearnResult learn(const std::vector<Signal>& signals, const std::vector<ActionPoseSample>& samples,
                  const LearnOptions& options) {
  LearnResult result = fit_structure(find_structure(signals, samples, options), samples, options);
  if (is_refused_by_guessed_noise(result)) {
    LearnOptions louder = options;
    louder.measurement.noise =
        Noise{2 * result.schema.noise.position_m, 2 * result.schema.noise.rotation_rad};
    LearnedStructure structure = find_structure(signals, samples, louder);
    structure.noise_source = NoiseSource::kResiduals;
    LearnResult found = fit_structure(structure, samples, louder);
    if (found.schema.edges.size() > result.schema.edges.size()) return found;
  }
  // An edge that all parts together refuse may have kept out a right one.
  LearnOptions others = options;
  for (const auto& [ends, why] : result.refused)
    if (why != Refusal::kWrongAtAnEnd && why != Refusal::kSecondPlace)
      others.unconnectable.insert(ends);
  if (others.unconnectable == options.unconnectable) return result;
  LearnResult other = fit_structure(find_structure(signals, samples, others), samples, others);
  return other.schema.edges.size() > result.schema.edges.size() ? other : result;
}

}  // namespace bodyschema
