#pragma once

#include <map>
#include <optional>
#include <set>
#include <utility>
#include <vector>

#include "common/geometry/angle.h"
#include "common/schema/body_schema.h"
#include "common/schema/sample.h"
#include "processes/structure_learner/command_lag.h"
#include "processes/structure_learner/edge_fit.h"
#include "processes/structure_learner/noise_estimate.h"
#include "processes/structure_learner/outlier_attribution.h"
#include "processes/structure_learner/positions/position_leaves.h"
#include "processes/structure_learner/structure_search.h"

namespace bodyschema {

/// MeasurementModel::systematic of tags, where no rig's noise.yaml says it: that of the shipped
/// rigs, of a lab's robot. d² of pairs of parts is below χ²₆ with it (`./run experiment pose_error
/// --honest`); with 0.7 mm, 0.25° one of six structures is wrong (docs/results.md).
inline constexpr Noise kTagSystematic{.position_m = 0.001, .rotation_rad = 0.3 * kDegree};

struct LearnOptions {
  /// The root part; else the lowest part id seen.
  std::optional<int> root;
  /// Parts that should be there: reported where they were never seen.
  std::vector<int> expected_parts;
  /// Without `noise`, and with all covariances of the observations zero, the noise is estimated
  /// (see noise_estimate.h).
  MeasurementModel measurement;
  /// Largest number of joints in one local model.
  int max_signals = kMaxChainJoints;
  /// A monitor tells what changed, and since when. Else an edge whose first or last samples are
  /// elsewhere is not valid: is_wrong_at_an_end().
  bool is_monitored = false;
  /// Two parts between which no edge is looked for, the lower first.
  std::set<std::pair<int, int>> unconnectable = {};
};

struct LearnResult {
  BodySchema schema;
  std::vector<Outlier> outliers;  ///< ascending by sample, then part
  Refusals refused;               ///< what the search accepted, and the fit to all parts did not
  NoiseSource noise_source = NoiseSource::kAssumed;
  bool is_one_cluster = false;  ///< see one_cluster.h
  /// Of poses at rest: what the joint fit leaves, or where there is none the edges', has this
  /// correlation from one sample to the next.
  double serial_correlation = 0;
  CommandDelay command_delay;  ///< of a stream's poses, taken into account
  int num_screens = 0;         ///< closed-form hypotheses looked at
  int num_fits = 0;            ///< Levenberg–Marquardt fits of the search
};

/// Learns the body schema from scratch: structure and local models (Sections 3.1 and 3.2). Where
/// the root rests, the models are in the end fitted to all poses of its tree at once, and X_CR with
/// them: that comes near the Cramér–Rao bound, which models fitted to two parts each miss by 1.6.
/// Their covariances are those of that fit. A pure function of its arguments. Poses must be finite
/// rigid transforms (callers check what comes in from outside). `utime`, `version` and
/// `base_version` of the schema are left to the caller.
/// @throws std::invalid_argument if an action does not have one value per signal, or max_signals is
/// out of range.
LearnResult learn(const std::vector<Signal>& signals, const std::vector<ActionPoseSample>& samples,
                  const LearnOptions& options = {});

/// The samples without exact repetitions (numbers_of()).
std::vector<ActionPoseSample> without_repetitions(const std::vector<ActionPoseSample>& samples);

/// Noise per axis of one marker that learn() goes by: `options.measurement.noise`; else the mean of
/// the observations' covariances; where these are zero, the estimate of noise_estimate.h.
SourcedNoise marker_noise(const std::vector<ActionPoseSample>& samples, int num_signals,
                          const LearnOptions& options = {});

/// The first half of learn(), slow: which part hangs on which by which signals. Everything that
/// relearn() takes over.
struct LearnedStructure {
  std::vector<Signal> signals;  ///< with what bends their commands
  std::vector<int> parts;       ///< seen, ascending
  SearchOptions options;        ///< by which it was found
  NormalizedActions actions;    ///< that the models are over
  SearchResult search;
  NoiseSource noise_source = NoiseSource::kAssumed;
  /// Another structure stands where the noise is larger than told: edges that the two do not share
  /// were taken out.
  bool is_contested = false;
  std::vector<int> position_parts = {};      ///< parts_without_rotation()
  std::map<int, OpenLeaf> open_leaves = {};  ///< those of them without an edge
  CommandDelay command_delay = {};           ///< of a stream's poses; `actions` are without it
  std::vector<int> rates = {};               ///< signals that were left out (signal_rates.h)

  /// The edges span all parts seen.
  bool spans() const { return search.models.size() + 1 >= parts.size(); }
  /// What the best models leave is above any marker's noise. Not so of covariances that a factor
  /// makes larger: these are no guess.
  bool is_noise_guessed_too_large() const {
    return noise_source == NoiseSource::kResiduals && options.measurement.noise &&
           is_above_any_marker(*options.measurement.noise);
  }
};
/// Where the residuals refute the noise told, a larger one (see confirmed_structure.h); of poses at
/// rest where no multiple of it stands, the estimate of noise_estimate.h if that is much more.
/// Parts that have positions alone are put in when the parts that have poses are
/// (position_leaves.h). Where the poses of a stream come after their commands (command_lag.h), each
/// counts with the command that brought it there. Signals that are the rates of others are left out
/// where the structure spans without them, or has more edges.
///
/// From outside in: rates left out, the delay of the poses (find_delayed), soft parts, chance and
/// positions alone (find_in_step), how large the noise is (confirmed_structure()), which commands
/// are bent (find_with_bias), search_structure().
/// @throws std::invalid_argument as learn().
LearnedStructure find_structure(const std::vector<Signal>& signals,
                                const std::vector<ActionPoseSample>& samples,
                                const LearnOptions& options = {});

/// The second half of learn(): the edges of `structure` fitted to `samples`, which need not be
/// those that it was found from, and all else that is in a schema. learn() =
/// fit_structure(find_structure).
LearnResult fit_structure(const LearnedStructure& structure,
                          const std::vector<ActionPoseSample>& samples,
                          const LearnOptions& options = {});

/// fit_structure() without the edges that are not valid any more (check_validity()) when fitted to
/// `samples`. Parts that the structure does not know are unconnected.
LearnResult relearn(const LearnedStructure& structure, const std::vector<ActionPoseSample>& samples,
                    const LearnOptions& options = {});

}  // namespace bodyschema
