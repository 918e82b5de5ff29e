#pragma once

#include <iosfwd>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "common/schema/body_schema.h"
#include "common/schema/sample.h"
#include "processes/console/views/json.h"

namespace bodyschema {

/// Signals that move a part in the root (indices).
std::set<int> moving_signals(const BodySchema& schema, int part);

/// Why no signal moves the part in the root.
std::string no_way_text(const BodySchema& schema, int part);

/// Where a schema says that a part is, and how well it knows.
struct PartPrediction {
  int part = 0;
  Pose X_RB = Pose::Identity();
  Noise sd;                  ///< per axis, to first order; 0: not known
  std::vector<int> outside;  ///< signals that move the part, beyond what was seen in training
};

/// Signals beyond what the samples covered that the schema rests on (indices); with a `part` those
/// that move it.
std::vector<int> signals_outside(const BodySchema& schema, const Eigen::VectorXd& action,
                                 std::optional<int> part = std::nullopt);

/// All parts that hang on the root, ascending, without the root. @throws std::invalid_argument if
/// `action` does not have one value per signal.
/// `sd.rotation_rad` is 0, as where it is not known, of parts of which positions alone are known.
std::vector<PartPrediction> predict_parts(const BodySchema& schema, const Eigen::VectorXd& action);

Json part_json(const BodySchema& schema, const PartPrediction& prediction);

/// `predict --action`, for programs and for people.
Json prediction_json(const BodySchema& schema, const Eigen::VectorXd& action);
std::string prediction_text(const BodySchema& schema, const Eigen::VectorXd& action);

/// `predict SAMPLES`: what it says of the actions, beside the errors. Standard deviations are root
/// mean squares over the samples.
struct PredictionSummary {
  struct Part {
    int part = 0;
    Noise sd;
    int num_outside = 0;  ///< samples
  };
  std::vector<Part> parts;   ///< as predict_parts()
  std::vector<int> outside;  ///< signals that leave what was seen in training, ascending
  int num_outside = 0;       ///< samples in which one does
};
PredictionSummary summary_of(const BodySchema& schema,
                             const std::vector<ActionPoseSample>& samples);
/// Into the JSON of the errors.
void add_summary(const BodySchema& schema, const PredictionSummary& summary, Json* errors);
std::string summary_text(const BodySchema& schema, const PredictionSummary& summary);

/// A CSV with one row per sample and part: t, the action, part, its pose in the root,
/// position_sd_m, rotation_sd_deg, outside_training (names of signals, a space between them).
void write_predictions(const BodySchema& schema, const std::vector<ActionPoseSample>& samples,
                       std::ostream& out);

}  // namespace bodyschema
