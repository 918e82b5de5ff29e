#include "processes/console/views/structure_view.h"

#include <fmt/format.h>

#include <cmath>

#include "common/geometry/angle.h"
#include "common/schema/standard_deviations.h"
#include "processes/console/hint.h"
#include "processes/console/names.h"
#include "processes/structure_learner/noise_estimate.h"

namespace bodyschema {
namespace {

using nlohmann::ordered_json;

std::string reason_text(const UnconnectedPart& part) {
  const std::string name = name_in(kUnconnectedReasons, part.reason);
  return part.detail.empty() || part.detail == name ? name : name + ": " + part.detail;
}

/// Its key in JSON, and for people.
std::pair<const char*, const char*> name_of(NoiseSource source) {
  switch (source) {
    case NoiseSource::kGiven:
      return {"given", "given"};
    case NoiseSource::kCovariances:
      return {"covariances", "mean of the observations' covariances"};
    case NoiseSource::kRepeats:
      return {"repeats", "estimated from repeated actions"};
    case NoiseSource::kFrames:
      return {"frames", "estimated from what jumps between frames"};
    case NoiseSource::kResiduals:
      return {"residuals", "estimated from what the best models leave"};
    case NoiseSource::kAssumed:
      return {"assumed", "assumed: too few samples to estimate it"};
  }
  return {"unknown", "unknown"};
}

std::vector<std::string> signal_names(const BodySchema& schema, const std::vector<int>& indices) {
  std::vector<std::string> names;
  for (const int index : indices) names.push_back(schema.signals.at(index).name);
  return names;
}

ordered_json edge_json(const BodySchema& schema, const Edge& edge) {
  return {{"from", edge.from},
          {"to", edge.to},
          {"signals", signal_names(schema, edge.signals())},
          {"kind", edge.kind()},
          {"position_rms_m", edge.position_rms_m},
          {"rotation_rms_deg", edge.rotation_rms_rad / kDegree},
          {"samples", edge.num_samples},
          {"outliers", edge.num_outliers}};
}

std::vector<double> list(const Eigen::VectorXd& values) { return {values.begin(), values.end()}; }

/// The hyper-parameters; the samples stay in the file.
ordered_json residual_gp_json(const BodySchema& schema, const ResidualGp& gp) {
  const ResidualGp::Prior& prior = gp.prior();
  return {{"signals", signal_names(schema, gp.signals())},
          {"samples", gp.num_samples()},
          {"length_scales", list(prior.length_scales)},
          {"variances", list(prior.variances)},
          {"noise_variances", list(prior.noise_variances)}};
}

ordered_json matrix_gp_json(const BodySchema& schema, const MatrixGp& gp) {
  ordered_json json = {{"signals", signal_names(schema, gp.signals())},
                       {"samples", gp.num_samples()},
                       {"entries", ordered_json::array()}};
  for (int e = 0; e < MatrixGp::kNumEntries; ++e) {
    const GpPrior& prior = gp.prior(e);
    json["entries"].push_back({{"length_scales", list(prior.kernel.terms().front().length_scales)},
                               {"variance", prior.kernel.variance()},
                               {"noise_variance", prior.noise_variance}});
  }
  return json;
}

ordered_json pose_json(const Pose& X) {
  const Eigen::Quaterniond q(X.linear());
  return {{"position_m", {X.translation().x(), X.translation().y(), X.translation().z()}},
          {"rotation_wxyz", {q.w(), q.x(), q.y(), q.z()}}};
}

/// One standard deviation; null where it is not known.
ordered_json deviation(double value, double unit = 1) {
  return std::isfinite(value) && value > 0 ? ordered_json(value / unit) : ordered_json();
}

ordered_json axes_json(const Eigen::Vector3d& variances, double unit) {
  ordered_json json = ordered_json::array();
  for (const double variance : variances) json.push_back(deviation(std::sqrt(variance), unit));
  return json;
}

ordered_json joint_sd_json(const ScrewJoint& joint, const JointDeviation& sd) {
  return {{"axis_position_m", joint.turn == 0 ? ordered_json() : deviation(sd.axis_position_m)},
          {"axis_tilt_deg", deviation(sd.axis_tilt_rad, kDegree)},
          {"displacement_m", deviation(sd.displacement_m)},
          {"displacement_deg", deviation(sd.displacement_rad, kDegree)},
          {"slide_m", deviation(sd.slide)},
          {"turn_rad", deviation(sd.turn)}};
}

}  // namespace

ordered_json structure_json(const BodySchema& schema, const std::vector<Outlier>& outliers,
                            std::optional<NoiseSource> source) {
  ordered_json json = {{"complete", schema.complete},
                       {"samples", schema.num_samples},
                       {"parts", schema.parts},
                       {"root", schema.root < 0 ? ordered_json() : ordered_json(schema.root)},
                       {"edges", ordered_json::array()},
                       {"unconnected", ordered_json::array()},
                       {"unused_signals", signal_names(schema, schema.unused_signals())},
                       {"undecided_signals", signal_names(schema, schema.undecided_signals)},
                       {"outliers", ordered_json::array()},
                       {"noise",
                        {{"position_m", schema.noise.position_m},
                         {"rotation_deg", schema.noise.rotation_rad / kDegree}}}};
  if (source) json["noise"]["from"] = name_of(*source).first;
  for (const Edge& edge : schema.edges) json["edges"].push_back(edge_json(schema, edge));
  for (const UnconnectedPart& part : schema.unconnected) {
    json["unconnected"].push_back({{"part", part.part}, {"reason", reason_text(part)}});
  }
  for (const Outlier& outlier : outliers) {
    json["outliers"].push_back({{"sample", outlier.sample_index}, {"part", outlier.part}});
  }
  return json;
}

ordered_json errors_json(int num_samples, const std::vector<PartErrors>& errors) {
  ordered_json json = {{"samples", num_samples}, {"parts", ordered_json::array()}};
  for (const PartErrors& part : errors) {
    ordered_json item = {{"part", part.part}, {"count", part.count}};
    // No number where nothing was measured.
    const auto value = [&](double x) { return part.count > 0 ? ordered_json(x) : ordered_json(); };
    item["position_median_m"] = value(part.position_median_m);
    item["position_rms_m"] = value(part.position_rms_m);
    item["position_max_m"] = value(part.position_max_m);
    item["rotation_median_deg"] = value(part.rotation_median_rad / kDegree);
    item["rotation_rms_deg"] = value(part.rotation_rms_rad / kDegree);
    json["parts"].push_back(std::move(item));
  }
  return json;
}

ordered_json errors_json(int num_samples, const JudgedErrors& errors) {
  ordered_json json = errors_json(num_samples, errors.parts);
  json["scale"] = errors.alignment ? ordered_json(errors.alignment->scale) : nullptr;
  for (std::size_t i = 0; i < errors.parts.size(); ++i) {
    ordered_json& part = json["parts"][i];
    const bool is_known = errors.alignment && errors.parts[i].count > 0;
    const auto value = [&](double PartErrors::*x, double unit) {
      return is_known ? ordered_json(errors.aligned_parts[i].*x / unit) : ordered_json();
    };
    part["aligned_position_median_m"] = value(&PartErrors::position_median_m, 1);
    part["aligned_rotation_median_deg"] = value(&PartErrors::rotation_median_rad, kDegree);
  }
  return json;
}

ordered_json schema_json(const BodySchema& schema) {
  ordered_json json = structure_json(schema, {});
  json.erase("outliers");
  json["version"] = schema.version;
  json["base_version"] = schema.base_version;
  json["last_sample"] = schema.last_sample_index;
  json["X_CR"] = pose_json(schema.X_CR);
  const auto& variances = schema.X_CR_covariance.diagonal();
  json["X_CR"]["position_sd_m"] = axes_json(variances.head<3>(), 1);
  json["X_CR"]["rotation_sd_deg"] = axes_json(variances.tail<3>(), kDegree);
  json["signals"] = ordered_json::array();
  for (const Signal& signal : schema.signals) {
    json["signals"].push_back({{"name", signal.name},
                               {"lower", signal.lower},
                               {"upper", signal.upper},
                               {"warp", signal.warp}});
  }
  const Eigen::VectorXd middle = schema.displacements(mid_range(schema.signals));
  for (std::size_t i = 0; i < schema.edges.size(); ++i) {
    const Edge& edge = schema.edges[i];
    ordered_json& item = json["edges"][i];
    item["state"] = name_in(kEdgeStates, edge.state);
    item["confidence"] = edge.confidence;
    item["valid_since_sample"] = edge.valid_since_sample;
    item["left"] = pose_json(edge.left);
    const Noise sd = deviations_of(edge.prediction_covariance(middle));
    item["position_sd_m"] = deviation(sd.position_m);
    item["rotation_sd_deg"] = deviation(sd.rotation_rad, kDegree);
    const std::vector<JointDeviation> deviations = joint_deviations(edge, middle);
    item["joints"] = ordered_json::array();
    for (std::size_t d = 0; d < edge.joints.size(); ++d) {
      const ScrewJoint& joint = edge.joints[d];
      item["joints"].push_back(
          {{"signal", schema.signals.at(joint.signal).name},
           {"gain", joint.gain},
           {"offset", joint.offset},
           {"slide_m", joint.slide},
           {"turn_rad", joint.turn},
           {"order_group",
            joint.order_group < 0 ? ordered_json() : ordered_json(joint.order_group)},
           {"X_after", pose_json(joint.X_after)},
           {"sd", deviations.empty() ? ordered_json() : joint_sd_json(joint, deviations[d])}});
    }
    if (edge.residual_gp) item["residual_gp"] = residual_gp_json(schema, *edge.residual_gp);
    if (edge.matrix_gp) item["matrix_gp"] = matrix_gp_json(schema, *edge.matrix_gp);
    item["right"] = pose_json(edge.right);
  }
  return json;
}

std::string structure_text(const BodySchema& schema, std::optional<NoiseSource> source) {
  std::string text =
      fmt::format("{} structure of {} from {}\n", schema.complete ? "Complete" : "Incomplete",
                  counted(std::ssize(schema.parts), "part"), counted(schema.num_samples, "sample"));
  if (!schema.edges.empty())
    text += fmt::format("  {:<9} {:<9} {:<12} {:>10} {:>7}\n", "edge", "kind", "signals",
                        "residual", "(rms)");
  for (const Edge& edge : schema.edges) {
    text += fmt::format("  {:>3} → {:<3} {:<9} {:<12} {:7.2f} mm {:6.2f}°\n", edge.from, edge.to,
                        edge.kind(),
                        fmt::format("{{{}}}", fmt::join(signal_names(schema, edge.signals()), ",")),
                        edge.position_rms_m * 1e3, edge.rotation_rms_rad / kDegree);
  }
  for (const UnconnectedPart& part : schema.unconnected) {
    text += fmt::format("  {:>3}   not connected: {}\n", part.part, reason_text(part));
  }
  const auto unused = signal_names(schema, schema.unused_signals());
  if (!unused.empty())
    text += fmt::format("  signals without effect: {}\n", fmt::join(unused, ", "));
  if (schema.noise.position_m > 0) {
    const bool is_least = source &&
                          (source == NoiseSource::kRepeats || source == NoiseSource::kFrames ||
                           source == NoiseSource::kResiduals) &&
                          schema.noise.position_m <= kNoiseFloor.position_m &&
                          schema.noise.rotation_rad <= kNoiseFloor.rotation_rad;
    text += fmt::format("  noise per axis and marker: {:.2f} mm {:.2f}°{}{}\n",
                        schema.noise.position_m * 1e3, schema.noise.rotation_rad / kDegree,
                        source ? std::string(", ") + name_of(*source).second : "",
                        is_least ? "; it is less, this is the least that is taken" : "");
  }
  const auto undecided = signal_names(schema, schema.undecided_signals);
  if (!undecided.empty())
    text += fmt::format("  signals whose effect is not told yet: {}\n", fmt::join(undecided, ", "));
  return text;
}

namespace {

std::string errors_line(const PartErrors& part) {
  if (part.count == 0)
    return fmt::format("  {:>4}      0   never seen together with the root", part.part);
  return fmt::format("  {:>4} {:>6} {:7.2f} mm {:5.2f}° {:7.2f} mm {:5.2f}° {:7.2f} mm", part.part,
                     part.count, part.position_median_m * 1e3, part.rotation_median_rad / kDegree,
                     part.position_rms_m * 1e3, part.rotation_rms_rad / kDegree,
                     part.position_max_m * 1e3);
}

constexpr char kErrorsHead[] = "  part  count   median            rms               max";

}  // namespace

std::string errors_text(const std::vector<PartErrors>& errors) {
  std::string text = fmt::format("{}\n", kErrorsHead);
  for (const PartErrors& part : errors) text += errors_line(part) + "\n";
  return text;
}

std::string errors_text(const JudgedErrors& errors) {
  if (!errors.alignment) return errors_text(errors.parts);
  std::string text = fmt::format("{}        aligned median\n", kErrorsHead);
  for (std::size_t i = 0; i < errors.parts.size(); ++i) {
    const PartErrors& aligned = errors.aligned_parts[i];
    text += errors_line(errors.parts[i]);
    if (aligned.count > 0) {
      text += fmt::format(" {:7.2f} mm {:5.2f}°", aligned.position_median_m * 1e3,
                          aligned.rotation_median_rad / kDegree);
    }
    text += "\n";
  }
  return text +
         fmt::format(
             "(Aligned to these samples: with the parts' frames and the unit of length of the "
             "truth; scale {:.4f}.)\n",
             errors.alignment->scale);
}

}  // namespace bodyschema
