#include "processes/structure_learner/unconnected.h"

#include <algorithm>
#include <optional>
#include <set>
#include <string>
#include <utility>

#include "processes/structure_learner/command_lag.h"
#include "processes/structure_learner/search/withdrawal.h"

namespace bodyschema {
namespace {

// What would tell how a part hangs on the others: more of the same is not always enough.
std::string wanted_samples(int num_common, const std::set<int>& untold, int num_actions,
                           int max_signals, const LearnedStructure& structure) {
  if (num_common == 0) return "samples are needed in which it is seen together with another part";
  if (structure.actions.moving().empty())
    return "no signal moved: samples at other actions are needed to trust a model";
  // So many poses determine a joint on every signal; two more test it.
  if (num_actions < max_signals + 3)
    return "samples at other actions are needed to trust a model: there are " +
           std::to_string(num_actions);
  std::string result = "more samples are needed to trust a model";
  for (const int s : untold) {
    result +=
        s == *untold.begin()
            ? ", or such in which these signals move farther; not told yet is what moves with "
            : ", ";
    result += structure.signals[static_cast<std::size_t>(s)].name;
  }
  return result;
}

template <typename Signals>
std::string names_of(const Signals& signals, const LearnedStructure& structure) {
  std::string result;
  for (const int s : signals)
    result += (result.empty() ? "" : ", ") + structure.signals[static_cast<std::size_t>(s)].name;
  return result.empty() ? "nothing" : result;
}

int count_actions(const std::vector<ActionPoseSample>& samples) {
  std::set<std::vector<double>> actions;
  for (const ActionPoseSample& sample : samples)
    actions.emplace(sample.action.begin(), sample.action.end());
  return static_cast<int>(actions.size());
}

/// What became of the models between a part and those that are connected to the root.
struct TriedModels {
  int num_common = 0, partner = -1;  ///< most instants with one of them
  bool undecided = false, was_soft_tried = false;
  bool is_redundant = false, moves_little = false, is_by_chance = false, is_too_short = false,
       has_one_rhythm = false;
  std::set<int> untold;
  std::set<std::pair<int, int>> look_alikes;
  std::set<int> open_order;
  std::optional<ContestedSignals> contested;
};

TriedModels tried_models(int part, const std::set<int>& connected, const SearchResult& search) {
  TriedModels tried;
  for (const auto& [pair, record] : search.records) {
    if (pair.first != part && pair.second != part) continue;
    // What is by chance may have connected both.
    tried.look_alikes.insert(record.look_alikes.begin(), record.look_alikes.end());
    tried.open_order.insert(record.open_order.begin(), record.open_order.end());
    tried.is_by_chance |= record.is_by_chance;
    tried.is_too_short |= record.is_too_short;
    tried.has_one_rhythm |= record.has_one_rhythm;
    const int other = pair.first == part ? pair.second : pair.first;
    if (!connected.contains(other)) continue;
    tried.undecided |= !record.undecided.empty();
    tried.untold.insert(record.untold_signals.begin(), record.untold_signals.end());
    tried.was_soft_tried |= record.was_soft_tried;
    tried.moves_little |= record.moves_little;
    tried.is_redundant |= record.is_redundant;
    if (record.contested) tried.contested = record.contested;
    if (record.num_common > tried.num_common) {
      tried.num_common = record.num_common;
      tried.partner = other;
    }
  }
  return tried;
}

UnconnectedPart explain_leaf(int part, int num_seen, const LearnedStructure& structure) {
  const auto leaf = structure.open_leaves.find(part);
  const OpenLeaf why =
      leaf != structure.open_leaves.end()
          ? leaf->second
          : OpenLeaf{true,
                     "the part that it hangs on is not connected, or its model is not valid any "
                     "more"};
  return {part, why.is_data_missing ? Unconnected::kNotEnoughData : Unconnected::kNoValidModel,
          "seen " + std::to_string(num_seen) + " times without orientation; " + why.reason};
}

/// Where a valid model was taken back, or another explanation contends with it: that. Empty if none
/// was.
std::string why_taken_back(const TriedModels& tried, const LearnedStructure& structure) {
  std::string alike;
  for (const auto& [one, other] : tried.look_alikes)
    alike += (alike.empty() ? "" : "; ") + names_of(std::vector{one, other}, structure);
  if (!alike.empty())
    return alike +
           " move alike at all samples, or nearly so, and which of them moves it cannot be told: "
           "move them apart, or leave one of them out";
  if (!tried.open_order.empty())
    return "the order of the joints of " + names_of(tried.open_order, structure) +
           " is not told by these poses: move them together, and farther";
  if (structure.is_contested)
    return "another structure fits if the noise is larger than it is said to be: tell the true "
           "noise, or give more samples";
  if (tried.is_redundant)
    return "a model is valid, but has a joint that the others make needless, and without it none "
           "is: more of the poses are wrong, or further off, than is told, its marker is of "
           "another size, or something moves it that is no signal";
  if (tried.is_by_chance)
    return "commands of other times explain its motion nearly as well: record for longer, and "
           "check that each action is of the time of its poses";
  if (tried.has_one_rhythm) return kOneRhythm;
  if (tried.is_too_short)
    return "no joints explain its motion, and the recording is too short to tell whether anything "
           "else does: record for longer";
  if (tried.contested)
    return "either " + names_of(tried.contested->of_screws, structure) +
           " moves it and poses are noisier than assumed, or " +
           names_of(tried.contested->of_process, structure) +
           " in a way that no joints have: tell the true noise (--noise)";
  if (tried.moves_little)
    return "it moves too little beside its noise to tell the joints that move it: move all signals "
           "farther";
  return "";
}

/// Where the edge by which a part hangs on the others was refused: why. Empty if none was.
std::string why_refused(int part, const LearnedStructure& structure, const Refusals& refused) {
  if (refused.empty()) return "";
  Components components(structure.parts);
  for (const AcceptedModel& m : structure.search.models)
    if (!refused.contains(std::minmax(m.part_i, m.part_j))) components.join(m.part_i, m.part_j);
  for (const AcceptedModel& m : structure.search.models) {
    const auto refusal = refused.find(std::minmax(m.part_i, m.part_j));
    if (refusal == refused.end()) continue;
    if (!m.joins_part(part)) {
      for (const int end : {m.part_i, m.part_j})
        if (components.of(end) == components.of(part))
          return "it hangs on part " + std::to_string(end) + ", which is not connected";
      continue;
    }
    std::set<int> signals = signal_set(m.model);
    signals.insert(m.soft_signals.begin(), m.soft_signals.end());
    const std::string model =
        (signals.empty() ? "a rigid edge" : "a model with " + names_of(signals, structure)) +
        " to part " + std::to_string(m.part_i + m.part_j - part);
    switch (refusal->second) {
      case Refusal::kNotValid:
        return model + " is not valid any more";
      case Refusal::kWrongAtSomeCommands:
        return model +
               " is right at most commands and wrong at others that lie together: the body meets a "
               "stop there, or the command is bent more steeply than its samples tell: give more "
               "of them there, or leave those out";
      case Refusal::kWrongAtAnEnd:
        return model +
               " is right but for the first or the last samples, one after the other: a marker, or "
               "what bears it, was moved meanwhile: learn from samples of before or of after it";
      case Refusal::kSecondPlace:
        return model +
               " is right but at samples at which the part keeps to one other place: it is held "
               "there, another marker is read for its own, or a joint that is not recorded is "
               "elsewhere: leave those samples out";
      case Refusal::kContradicted:
        return model +
               " is contradicted by what the other parts tell of it at most samples: show the two "
               "together more often";
    }
  }
  return "";
}

/// Where only the frame is connected that the others are given in: they may move against it.
std::string doubt_of_frame(const std::set<int>& connected, const LearnedStructure& structure) {
  const std::set<int>& fixed = structure.options.measurement.fixed_parts;
  if (connected.empty() || !std::ranges::includes(fixed, connected)) return "";
  return "; what is connected keeps its pose at all samples, to the last digit: if the others "
         "moved "
         "against it meanwhile, leave it out";
}

std::string why_none_is_valid(const TriedModels& tried, const std::set<int>& connected,
                              const LearnedStructure& structure, int max_signals) {
  if (structure.actions.moving().empty())
    return "no signal moved, and it is not rigid with any connected part: tell the signals that "
           "move it";
  return "no model with up to " + std::to_string(max_signals) +
         " signals is valid to any connected part" +
         (tried.was_soft_tried ? ", nor any with a Gaussian process beside its joints" : "") +
         (structure.is_noise_guessed_too_large()
              ? "; their noise is guessed from what these models leave: tell it (--noise)"
          : structure.noise_source == NoiseSource::kAssumed
              ? "; how noisy poses are is not known: tell it (--noise)"
              : "") +
         doubt_of_frame(connected, structure);
}

}  // namespace

UnconnectedPart explain_unconnected(int part, const std::vector<ActionPoseSample>& samples,
                                    const std::set<int>& connected,
                                    const LearnedStructure& structure, const Refusals& refused,
                                    int max_signals) {
  if (!structure.position_parts.empty() && connected.empty())
    return {part, Unconnected::kNotEnoughData,
            "the root has positions alone: give its orientations, or choose another root"};
  const int num_seen = count_common(samples, part, part);
  if (std::binary_search(structure.position_parts.begin(), structure.position_parts.end(), part))
    return explain_leaf(part, num_seen, structure);
  const TriedModels tried = tried_models(part, connected, structure.search);
  const std::string seen =
      "seen " + (num_seen == 1 ? "once" : std::to_string(num_seen) + " times") + ", at most " +
      std::to_string(tried.num_common) + " of them together with one connected part" +
      (tried.partner >= 0 ? " (" + std::to_string(tried.partner) + ")" : "") + "; ";
  if (const std::string why = why_refused(part, structure, refused); !why.empty())
    return {part, Unconnected::kNoValidModel, seen + why};
  const std::string taken_back = why_taken_back(tried, structure);
  if (!taken_back.empty()) {
    const bool is_refused = tried.is_redundant && !structure.is_contested;
    return {part, is_refused ? Unconnected::kNoValidModel : Unconnected::kNotEnoughData,
            seen + taken_back};
  }
  // With fewer numbers than five a parameter of the largest model, its refusal says little.
  const int parameters = 6 + 6 * max_signals;
  if (!tried.undecided && 6 * tried.num_common >= 5 * parameters)
    return {part, Unconnected::kNoValidModel,
            seen + why_none_is_valid(tried, connected, structure, max_signals)};
  return {part, Unconnected::kNotEnoughData,
          seen + wanted_samples(tried.num_common, tried.untold, count_actions(samples), max_signals,
                                structure)};
}

std::vector<int> undecided_signals(const BodySchema& schema, const LearnedStructure& structure,
                                   bool is_body_left) {
  std::set<int> result;
  for (const AcceptedModel& model : structure.search.models)
    result.insert(model.doubtful_signals.begin(), model.doubtful_signals.end());
  for (const int s : schema.unused_signals()) {
    // The structure is complete without the rates.
    if (schema.complete && std::ranges::count(structure.rates, s) > 0) continue;
    const auto information = structure.search.joint_information.find(s);
    if (schema.complete && !is_body_left &&
        information != structure.search.joint_information.end()) {
      const Signal& signal = schema.signals[static_cast<std::size_t>(s)];
      const double range = signal.upper - signal.lower;
      const double share =
          range > 0 ? std::min(1.0, 2 * structure.actions.half_range(s) / range) : 1;
      const double turn = share * kLeastTurn;
      if (turn * turn * information->second >= kNoticed) continue;
    }
    result.insert(s);
  }
  return {result.begin(), result.end()};
}

}  // namespace bodyschema
