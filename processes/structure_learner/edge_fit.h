#pragma once

#include <map>
#include <utility>
#include <vector>

#include "processes/structure_learner/search/model_forest.h"
#include "processes/structure_learner/serial_correlation.h"
#include "processes/structure_learner/validity.h"

namespace bodyschema {

/// The data that edges are fitted to. Actions are displacements.
struct EdgeData {
  const std::vector<ActionPoseSample>& samples;
  const NormalizedActions& actions;
  const MeasurementModel& measurement;  ///< that the structure was found with
  const MeasurementModel& told;         ///< the same without the factor that the search put on it
  const ValidityOptions& validity;
};

struct FittedEdge {
  Edge edge;
  std::vector<int> frames;  ///< samples at which it was judged
  std::vector<bool> outlying;
  bool is_valid = true;      ///< as far as that was asked
  LocalModel model;          ///< what of the edge is screws
  SerialCorrelation series;  ///< of what these leave; empty for a stream
};

/// Why an edge that the search accepted is none.
enum class Refusal {
  kNotValid,             ///< on all of its data
  kWrongAtSomeCommands,  ///< is_wrong_at_some_commands()
  kWrongAtAnEnd,         ///< is_wrong_at_an_end()
  kSecondPlace,          ///< keeps_to_second_place()
  kContradicted,         ///< by all other parts, at most instants
};
/// By the edge's parts, the lower first.
using Refusals = std::map<std::pair<int, int>, Refusal>;

/// The same model over actions that are scaled otherwise.
LocalModel rescaled(LocalModel model, const NormalizedActions& from, const NormalizedActions& to);

/// The final fit of an edge in its direction, on all data, with everything the schema says about
/// it. Without `must_be_valid` an edge of screws that is not valid stays.
FittedEdge fit_edge(const AcceptedModel& accepted, int from, int to, const EdgeData& data,
                    bool must_be_valid);

/// Where an edge has outliers one after the other, in the order of one of its signals, that chance
/// does not explain, its model is wrong and not its poses. False in a stream, where outliers last.
bool is_wrong_at_some_commands(const FittedEdge& fitted, const NormalizedActions& actions);

/// Where the first or the last samples of an edge are outliers in a row that chance, at the rate of
/// the others, does not explain: one of its markers, or what bears it, was moved meanwhile. Of a
/// stream a block of time counts as one sample.
bool is_wrong_at_an_end(const FittedEdge& fitted, const TimeBlocks& blocks);

/// The edges of the root's component fitted to all of its markers at once: a root that rests and
/// everything on the way from it are witnesses too, beside the two markers that each edge was
/// fitted to before. X_CR with them, and the scatter of the joints. An edge whose part is elsewhere
/// than all of them say, at most instants or at some of its commands, goes, and so does a joint
/// that by its own deviation may be none. Left alone where the root moves or an edge is no chain of
/// screws. Returns TreeFit::serial_correlation(); where it left them alone that of the edges.
double fit_jointly(const EdgeData& data, std::vector<FittedEdge>* fitted, BodySchema* schema,
                   Refusals* refused);

}  // namespace bodyschema
