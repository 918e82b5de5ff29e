#include "processes/console/evaluation.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <stdexcept>
#include <string>

#include "common/statistics/median.h"

namespace bodyschema {
namespace {

struct Errors {
  std::vector<double> position_m;
  std::vector<double> rotation_rad;
};

double rms(const std::vector<double>& values) {
  double sum = 0;
  for (const double value : values) sum += value * value;
  return std::sqrt(sum / static_cast<double>(values.size()));
}

}  // namespace

std::vector<PartErrors> evaluate(const BodySchema& schema,
                                 const std::vector<ActionPoseSample>& samples) {
  std::map<int, Errors> errors;
  for (const int part : schema.parts) {
    const Eigen::VectorXd zero = Eigen::VectorXd::Zero(schema.signals.size());
    if (part != schema.root && schema.predict(schema.root, part, zero)) errors[part];
  }
  for (const ActionPoseSample& sample : samples) {
    if (sample.action.size() != static_cast<int>(schema.signals.size())) {
      throw std::invalid_argument("the samples have " + std::to_string(sample.action.size()) +
                                  " action signals, the schema " +
                                  std::to_string(schema.signals.size()));
    }
    const PartObservation* root = sample.find(schema.root);
    if (!root) continue;
    const std::map<int, Pose> predicted = schema.predict_all(sample.action);
    for (auto& [part, of_part] : errors) {
      const PartObservation* seen = sample.find(part);
      if (!seen) continue;
      const Pose error = predicted.at(part).inverse() * root->X_CB.inverse() * seen->X_CB;
      of_part.position_m.push_back(error.translation().norm());
      of_part.rotation_rad.push_back(rotation_angle(error));
    }
  }
  std::vector<PartErrors> result;
  for (const auto& [part, of_part] : errors) {
    PartErrors summary;
    summary.part = part;
    summary.count = static_cast<int>(of_part.position_m.size());
    if (summary.count > 0) {
      summary.position_median_m = median(of_part.position_m);
      summary.position_rms_m = rms(of_part.position_m);
      summary.position_max_m =
          *std::max_element(of_part.position_m.begin(), of_part.position_m.end());
      summary.rotation_median_rad = median(of_part.rotation_rad);
      summary.rotation_rms_rad = rms(of_part.rotation_rad);
    }
    result.push_back(summary);
  }
  return result;
}

}  // namespace bodyschema
