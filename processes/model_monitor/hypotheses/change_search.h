#pragma once

#include <optional>
#include <vector>

#include "processes/model_monitor/changes/body_change.h"
#include "processes/model_monitor/hypotheses/change_fit.h"

namespace bodyschema {

/// A change that takes the place of what the schema says there.
struct Replacement {
  ElementId element;
  FittedChange fitted;
  std::vector<ElementId> also = {};  ///< what else a whole schema of the history changes
};

/// The same form of change of the same elements, whatever its parameters.
bool is_same_explanation(const Replacement& a, const Replacement& b);

/// Of a suspicion so many samples old: growing steps bound the work of one that lasts.
bool is_worth_a_fit(std::int64_t age);

struct ChangeSearch {
  MeasurementModel measurement;
  double ambiguity = 6;  ///< lead that another form than the standing one needs [nats]
  /// What explains the samples so far.
  std::optional<BodyChange> standing_form = std::nullopt;
  bool learn = false;  ///< also what is none of the families
};

struct FoundChanges {
  std::optional<Replacement> best;
  std::optional<Replacement> runner_up;  ///< the best that is another form or place
  double null = 0;                       ///< log-likelihood of the schema as it stands
  int work = 0;                          ///< samples looked at, over all elements and bases
  double margin() const { return best ? best->fitted.log_evidence - null : 0; }
};

/// The changes of `standing` in one of `elements` that the samples speak for most: what the history
/// has for a place, all forms of change of the model that stands and of those, and what differs
/// from a schema of the history in several elements at once. O(elements · schemas of the history ·
/// forms · samples).
FoundChanges find_changes(const BodySchema& standing, const std::vector<BodySchema>& history,
                          const std::vector<ElementId>& elements,
                          const std::vector<const ActionPoseSample*>& samples,
                          const ChangeSearch& search);

}  // namespace bodyschema
