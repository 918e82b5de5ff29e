#pragma once

#include <optional>
#include <string>
#include <vector>

#include "common/estimation/evaluation.h"
#include "common/schema/body_schema.h"
#include "processes/console/views/json.h"
#include "processes/structure_learner/learn.h"

namespace bodyschema {

std::vector<std::string> signal_names(const BodySchema& schema);
std::vector<std::string> signal_names(const BodySchema& schema, const std::vector<int>& indices);

// The JSON that the console prints with --json. docs/json.md documents every key.

Json pose_json(const Pose& X);
/// A value by the name of each signal.
Json action_json(const BodySchema& schema, const Eigen::VectorXd& action);
/// One standard deviation in a unit; null where it is not known.
Json deviation_json(double value, double unit = 1);

/// `learn --json`, and `structure` in result.json.
Json structure_json(const BodySchema& schema, const std::vector<Outlier>& outliers,
                    std::optional<NoiseSource> source = {});

/// `predict --json`, and `held_out` in result.json.
Json errors_json(int num_samples, const std::vector<PartErrors>& errors);
/// With `aligned_…` beside the errors, and `scale`; null without an alignment.
Json errors_json(int num_samples, const JudgedErrors& errors);

/// `show --json`: structure_json without outliers, with every parameter of every edge.
Json schema_json(const BodySchema& schema);

// The same for people.

/// With the noise that it was learned with, and where that is known from.
std::string structure_text(const BodySchema& schema, std::optional<NoiseSource> source = {});
std::string errors_text(const JudgedErrors& errors);

}  // namespace bodyschema
