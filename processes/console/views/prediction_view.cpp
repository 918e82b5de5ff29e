#include "processes/console/views/prediction_view.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <ostream>

#include "common/geometry/angle.h"
#include "common/kinematics/kinematic_tree.h"
#include "common/schema/standard_deviations.h"
#include "common/text/text.h"
#include "processes/console/views/structure_view.h"

namespace bodyschema {
namespace {

// What is lost when a command is written as text.
constexpr double kRounding = 1e-6;

std::string pose_sd_text(const Noise& sd) {
  if (!(sd.position_m > 0)) return "    not known";
  if (!(sd.rotation_rad > 0)) return fmt::format("{:7.2f} mm      –", sd.position_m * 1e3);
  return fmt::format("{:7.2f} mm {:6.3f}°", sd.position_m * 1e3, sd.rotation_rad / kDegree);
}

}  // namespace

std::set<int> moving_signals(const BodySchema& schema, int part) {
  std::set<int> moving;
  const KinematicTree tree(schema.edges, schema.root);
  for (const int node : tree.path_to(tree.node_of(part)))
    for (const int s : schema.edges[tree.nodes()[node].edge].signals()) moving.insert(s);
  return moving;
}

std::string no_way_text(const BodySchema& schema, int part) {
  return part == schema.root
             ? fmt::format("part {} is the root, in whose frame the others move", part)
             : fmt::format("the schema connects no part {} with its root {}", part, schema.root);
}

std::vector<int> signals_outside(const BodySchema& schema, const Eigen::VectorXd& action,
                                 std::optional<int> part) {
  const std::set<int> moving = part ? moving_signals(schema, *part) : std::set<int>();
  std::vector<int> result;
  for (int s = 0; s < action.size(); ++s) {
    const auto [lower, upper] = schema.signals[static_cast<std::size_t>(s)].known_range();
    const double margin = kRounding * std::max(std::abs(lower), std::abs(upper));
    const bool is_outside = action(s) < lower - margin || action(s) > upper + margin;
    if (is_outside && (!part || moving.contains(s))) result.push_back(s);
  }
  return result;
}

std::vector<PartPrediction> predict_parts(const BodySchema& schema, const Eigen::VectorXd& action) {
  std::vector<PartPrediction> result;
  for (const int part : schema.parts) {
    if (part == schema.root) continue;
    const auto predicted = schema.predict(schema.root, part, action, Variance::kOneAction);
    if (!predicted) continue;
    Noise sd = deviations_of(predicted->covariance);
    if (!schema.has_rotation(part)) sd.rotation_rad = 0;
    result.push_back({part, predicted->X_AB, sd, signals_outside(schema, action, part)});
  }
  return result;
}

Json part_json(const BodySchema& schema, const PartPrediction& prediction) {
  return {{"part", prediction.part},
          {"X_RB", pose_json(prediction.X_RB)},
          {"position_sd_m", deviation_json(prediction.sd.position_m)},
          {"rotation_sd_deg", deviation_json(prediction.sd.rotation_rad, kDegree)},
          {"outside_training", signal_names(schema, prediction.outside)}};
}

Json prediction_json(const BodySchema& schema, const Eigen::VectorXd& action) {
  return {{"action", action_json(schema, action)},
          {"outside_training", signal_names(schema, signals_outside(schema, action))},
          {"parts", array_of(predict_parts(schema, action),
                             [&](const PartPrediction& p) { return part_json(schema, p); })}};
}

std::string prediction_text(const BodySchema& schema, const Eigen::VectorXd& action) {
  std::string text = fmt::format("  part  position in part {:<12} rotation w x y z{:<12} sd\n",
                                 fmt::format("{} [m]", schema.root), "");
  for (const PartPrediction& p : predict_parts(schema, action)) {
    const Eigen::Vector3d x = p.X_RB.translation();
    const Eigen::Quaterniond q(p.X_RB.linear());
    text +=
        fmt::format("  {:>4} {:8.4f} {:8.4f} {:8.4f}  {:7.4f} {:7.4f} {:7.4f} {:7.4f} {}", p.part,
                    x.x(), x.y(), x.z(), q.w(), q.x(), q.y(), q.z(), pose_sd_text(p.sd));
    if (!p.outside.empty())
      text += ", outside training: " + listed(signal_names(schema, p.outside));
    text += "\n";
  }
  return text;
}

PredictionSummary summary_of(const BodySchema& schema,
                             const std::vector<ActionPoseSample>& samples) {
  PredictionSummary result;
  std::set<int> outside;
  const double share = samples.empty() ? 0 : 1 / static_cast<double>(samples.size());
  for (const ActionPoseSample& sample : samples) {
    const std::vector<int> here = signals_outside(schema, sample.action);
    outside.insert(here.begin(), here.end());
    result.num_outside += !here.empty();
    const std::vector<PartPrediction> parts = predict_parts(schema, sample.action);
    result.parts.resize(parts.size());
    for (std::size_t k = 0; k < parts.size(); ++k) {
      PredictionSummary::Part& part = result.parts[k];
      part.part = parts[k].part;
      part.num_outside += !parts[k].outside.empty();
      // Mean squares, until all are added.
      part.sd.position_m += share * std::pow(parts[k].sd.position_m, 2);
      part.sd.rotation_rad += share * std::pow(parts[k].sd.rotation_rad, 2);
    }
  }
  for (PredictionSummary::Part& part : result.parts)
    part.sd = {std::sqrt(part.sd.position_m), std::sqrt(part.sd.rotation_rad)};
  result.outside.assign(outside.begin(), outside.end());
  return result;
}

void add_summary(const BodySchema& schema, const PredictionSummary& summary, Json* errors) {
  (*errors)["outside_training"] = {{"samples", summary.num_outside},
                                   {"signals", signal_names(schema, summary.outside)}};
  for (Json& json : (*errors)["parts"])
    for (const PredictionSummary::Part& part : summary.parts) {
      if (json["part"] != part.part) continue;
      json["position_sd_m"] = deviation_json(part.sd.position_m);
      json["rotation_sd_deg"] = deviation_json(part.sd.rotation_rad, kDegree);
      json["outside_training"] = part.num_outside;
    }
}

std::string summary_text(const BodySchema& schema, const PredictionSummary& summary) {
  std::string text = "  part  predicted sd\n";
  for (const PredictionSummary::Part& part : summary.parts)
    text += fmt::format("  {:>4} {}\n", part.part, pose_sd_text(part.sd));
  if (summary.num_outside > 0)
    text += fmt::format("  outside training in {}: {}\n", counted(summary.num_outside, "sample"),
                        listed(signal_names(schema, summary.outside)));
  return text;
}

void write_predictions(const BodySchema& schema, const std::vector<ActionPoseSample>& samples,
                       std::ostream& out) {
  out << "t," << fmt::format("{}", fmt::join(signal_names(schema), ","))
      << (schema.signals.empty() ? "" : ",")
      << "part,x,y,z,qw,qx,qy,qz,position_sd_m,rotation_sd_deg,outside_training\n";
  for (const ActionPoseSample& sample : samples)
    for (const PartPrediction& p : predict_parts(schema, sample.action)) {
      const Eigen::Vector3d x = p.X_RB.translation();
      const Eigen::Quaterniond q(p.X_RB.linear());
      std::string row = fmt::format("{}", static_cast<double>(sample.utime) * 1e-6);
      for (const double value : sample.action) row += fmt::format(",{}", value);
      row += fmt::format(",{}", p.part);
      for (const double value : {x.x(), x.y(), x.z(), q.w(), q.x(), q.y(), q.z()})
        row += fmt::format(",{}", value);
      for (const double sd : {p.sd.position_m, p.sd.rotation_rad / kDegree})
        row += sd > 0 ? fmt::format(",{}", sd) : ",";
      out << row << "," << fmt::format("{}", fmt::join(signal_names(schema, p.outside), " "))
          << "\n";
    }
}

}  // namespace bodyschema
