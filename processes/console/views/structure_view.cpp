#include "processes/console/views/structure_view.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

#include "common/geometry/angle.h"
#include "common/schema/standard_deviations.h"
#include "processes/console/hint.h"
#include "processes/console/names.h"
#include "processes/structure_learner/noise_estimate.h"

namespace bodyschema {
namespace {

std::string reason_text(const UnconnectedPart& part) {
  const std::string name = name_in(kUnconnectedReasons, part.reason);
  return part.detail.empty() || part.detail == name ? name : name + ": " + part.detail;
}

Json edge_json(const BodySchema& schema, const Edge& edge) {
  return {{"from", edge.from},
          {"to", edge.to},
          {"signals", signal_names(schema, edge.signals())},
          {"kind", edge.kind()},
          {"position_rms_m", edge.position_rms_m},
          {"rotation_rms_deg",
           schema.has_rotation(edge.to) ? Json(edge.rotation_rms_rad / kDegree) : Json()},
          {"samples", edge.num_samples},
          {"outliers", edge.num_outliers}};
}

std::vector<double> list(const Eigen::VectorXd& values) { return {values.begin(), values.end()}; }

/// The hyper-parameters; the samples stay in the file.
Json residual_gp_json(const BodySchema& schema, const ResidualGp& gp) {
  const ResidualGp::Prior& prior = gp.prior();
  return {{"signals", signal_names(schema, gp.signals())},
          {"samples", gp.num_samples()},
          {"length_scales", list(prior.length_scales)},
          {"variances", list(prior.variances)},
          {"noise_variances", list(prior.noise_variances)}};
}

Json matrix_gp_json(const BodySchema& schema, const MatrixGp& gp) {
  Json entries = Json::array();
  for (int e = 0; e < MatrixGp::kNumEntries; ++e) {
    const GpPrior& prior = gp.prior(e);
    entries.push_back({{"length_scales", list(prior.kernel.terms().front().length_scales)},
                       {"variance", prior.kernel.variance()},
                       {"noise_variance", prior.noise_variance}});
  }
  return {{"signals", signal_names(schema, gp.signals())},
          {"samples", gp.num_samples()},
          {"entries", entries}};
}

Json axes_json(const Eigen::Vector3d& variances, double unit) {
  return array_of(variances,
                  [&](double variance) { return deviation_json(std::sqrt(variance), unit); });
}

Json joint_json(const BodySchema& schema, const ScrewJoint& joint, const JointDeviation* sd) {
  Json json = {{"signal", schema.signals.at(joint.signal).name},
               {"gain", joint.gain},
               {"offset", joint.offset},
               {"slide_m", joint.slide},
               {"turn_rad", joint.turn},
               {"order_group", known(joint.order_group)},
               {"scatter", joint.scatter},
               {"X_after", pose_json(joint.X_after)},
               {"sd", nullptr}};
  if (sd)
    json["sd"] = {
        {"axis_position_m", joint.turn == 0 ? Json() : deviation_json(sd->axis_position_m)},
        {"axis_tilt_deg", deviation_json(sd->axis_tilt_rad, kDegree)},
        {"displacement_m", deviation_json(sd->displacement_m)},
        {"displacement_deg", deviation_json(sd->displacement_rad, kDegree)},
        {"slide_m", deviation_json(sd->slide)},
        {"turn_rad", deviation_json(sd->turn)}};
  return json;
}

/// `middle`: displacements of the joints in mid-range.
void add_parameters(const BodySchema& schema, const Edge& edge, const Eigen::VectorXd& middle,
                    Json* json) {
  const Noise sd = deviations_of(edge.prediction_covariance(middle));
  const std::vector<JointDeviation> deviations = joint_deviations(edge, middle);
  Json joints = Json::array();
  for (std::size_t d = 0; d < edge.joints.size(); ++d)
    joints.push_back(
        joint_json(schema, edge.joints[d], deviations.empty() ? nullptr : &deviations[d]));
  json->update({{"state", name_in(kEdgeStates, edge.state)},
                {"confidence", edge.confidence},
                {"valid_since_sample", edge.valid_since_sample},
                {"left", pose_json(edge.left)},
                {"position_sd_m", deviation_json(sd.position_m)},
                {"rotation_sd_deg",
                 schema.has_rotation(edge.to) ? deviation_json(sd.rotation_rad, kDegree) : Json()},
                {"joints", joints}});
  if (edge.residual_gp) (*json)["residual_gp"] = residual_gp_json(schema, *edge.residual_gp);
  if (edge.matrix_gp) (*json)["matrix_gp"] = matrix_gp_json(schema, *edge.matrix_gp);
  (*json)["right"] = pose_json(edge.right);
}

std::string noise_text(const Noise& noise, std::optional<NoiseSource> source) {
  const bool is_estimated = source == NoiseSource::kRepeats || source == NoiseSource::kFrames ||
                            source == NoiseSource::kResiduals;
  const bool is_least = is_estimated && noise.position_m <= kNoiseFloor.position_m &&
                        noise.rotation_rad <= kNoiseFloor.rotation_rad;
  return fmt::format("  noise per axis and marker: {}{}{}\n",
                     pose_text(noise.position_m, noise.rotation_rad),
                     source ? std::string(", ") + name_in(kNoiseSourceWords, *source) : "",
                     is_least ? "; it is less, this is the least that is taken" : "");
}

// From as many joints on an edge tells its joints one by one: nothing was seen in between.
constexpr std::size_t kLongEdge = 3;
constexpr double kLeastShown = 1e-3;  // of a joint, over its signal's range: 1 µm, 0.001°

/// The joints of a long edge in their order, with what each does per unit of its command.
std::string joints_text(const BodySchema& schema, const Edge& edge, const Eigen::VectorXd& middle) {
  if (edge.joints.size() < kLongEdge) return "";
  const std::vector<JointDeviation> deviations = joint_deviations(edge, middle);
  std::string text;
  for (std::size_t d = 0; d < edge.joints.size(); ++d) {
    const ScrewJoint& joint = edge.joints[d];
    const Signal& signal = schema.signals.at(joint.signal);
    // What does not show over the whole range is 0, and untold where its deviation is 0 too.
    const auto rate = [&](double value, const char* unit, double sd) -> std::string {
      const double per_unit = joint.gain * value;
      const bool shows = std::abs(per_unit) * (signal.upper - signal.lower) >= kLeastShown;
      if (!shows && !(sd > 0)) return "";
      return fmt::format(" {:10.4g}{}", shows ? per_unit : 0.0, unit) +
             (sd > 0 ? fmt::format(" ± {:.2g}{}", sd, unit) : "");
    };
    text += fmt::format("{:>13} ", signal.name);
    const JointDeviation sd = deviations.empty() ? JointDeviation() : deviations[d];
    if (joint.turn != 0) text += rate(joint.turn / kDegree, "°", sd.turn / kDegree);
    if (joint.slide != 0) text += rate(joint.slide * 1e3, " mm", sd.slide * 1e3);
    text += " per unit";
    if (joint.scatter > 0) text += fmt::format(", scatters by {:.2g}", joint.scatter);
    if (joint.order_group >= 0) text += fmt::format(", order open (group {})", joint.order_group);
    text += "\n";
  }
  return text;
}

std::string errors_line(const PartErrors& part) {
  if (part.count == 0)
    return fmt::format("  {:>4}      0   never seen together with the root", part.part);
  const auto pair_text = [&](double position_m, double rotation_rad) {
    return fmt::format("{:7.2f} mm ", position_m * 1e3) +
           (part.has_rotation ? fmt::format("{:5.2f}°", rotation_rad / kDegree) : "     –");
  };
  return fmt::format("  {:>4} {:>6} {} {} {:7.2f} mm", part.part, part.count,
                     pair_text(part.position_median_m, part.rotation_median_rad),
                     pair_text(part.position_rms_m, part.rotation_rms_rad),
                     part.position_max_m * 1e3);
}

}  // namespace

Json pose_json(const Pose& X) {
  const Eigen::Quaterniond q(X.linear());
  return {{"position_m", {X.translation().x(), X.translation().y(), X.translation().z()}},
          {"rotation_wxyz", {q.w(), q.x(), q.y(), q.z()}}};
}

Json action_json(const BodySchema& schema, const Eigen::VectorXd& action) {
  Json json = Json::object();
  for (std::size_t s = 0; s < schema.signals.size(); ++s)
    json[schema.signals[s].name] = action(static_cast<Eigen::Index>(s));
  return json;
}

Json deviation_json(double value, double unit) {
  return std::isfinite(value) && value > 0 ? Json(value / unit) : Json();
}

std::vector<std::string> signal_names(const BodySchema& schema) {
  std::vector<std::string> names;
  for (const Signal& signal : schema.signals) names.push_back(signal.name);
  return names;
}

std::vector<std::string> signal_names(const BodySchema& schema, const std::vector<int>& indices) {
  std::vector<std::string> names;
  for (const int index : indices) names.push_back(schema.signals.at(index).name);
  return names;
}

Json structure_json(const BodySchema& schema, const std::vector<Outlier>& outliers,
                    std::optional<NoiseSource> source) {
  Json json = {
      {"complete", schema.complete},
      {"samples", schema.num_samples},
      {"parts", schema.parts},
      {"position_parts", schema.position_parts},
      {"root", known(schema.root)},
      {"edges", array_of(schema.edges, [&](const Edge& e) { return edge_json(schema, e); })},
      {"unconnected", array_of(schema.unconnected,
                               [](const UnconnectedPart& part) -> Json {
                                 return {{"part", part.part}, {"reason", reason_text(part)}};
                               })},
      {"unused_signals", signal_names(schema, schema.unused_signals())},
      {"undecided_signals", signal_names(schema, schema.undecided_signals)},
      {"outliers", array_of(outliers,
                            [](const Outlier& outlier) -> Json {
                              return {{"sample", outlier.sample_index}, {"part", outlier.part}};
                            })},
      {"noise",
       {{"position_m", schema.noise.position_m},
        {"rotation_deg", schema.noise.rotation_rad / kDegree}}}};
  if (source) json["noise"]["from"] = name_in(kNoiseSources, *source);
  return json;
}

Json errors_json(int num_samples, const std::vector<PartErrors>& errors) {
  return {{"samples", num_samples},
          {"parts", array_of(errors, [](const PartErrors& part) -> Json {
             // No number where nothing was measured.
             const auto value = [&](double x) { return part.count > 0 ? Json(x) : Json(); };
             const auto turned = [&](double rad) {
               return part.has_rotation ? value(rad / kDegree) : Json();
             };
             return {{"part", part.part},
                     {"count", part.count},
                     {"position_median_m", value(part.position_median_m)},
                     {"position_rms_m", value(part.position_rms_m)},
                     {"position_max_m", value(part.position_max_m)},
                     {"rotation_median_deg", turned(part.rotation_median_rad)},
                     {"rotation_rms_deg", turned(part.rotation_rms_rad)}};
           })}};
}

Json errors_json(int num_samples, const JudgedErrors& errors) {
  Json json = errors_json(num_samples, errors.parts);
  json["scale"] = errors.alignment ? Json(errors.alignment->scale) : Json();
  for (std::size_t i = 0; i < errors.parts.size(); ++i) {
    const bool is_known = errors.alignment && errors.parts[i].count > 0;
    const PartErrors aligned = is_known ? errors.aligned_parts[i] : PartErrors();
    Json& part = json["parts"][i];
    part["aligned_position_median_m"] = is_known ? Json(aligned.position_median_m) : Json();
    part["aligned_rotation_median_deg"] =
        is_known && aligned.has_rotation ? Json(aligned.rotation_median_rad / kDegree) : Json();
  }
  return json;
}

Json schema_json(const BodySchema& schema) {
  Json json = structure_json(schema, {});
  json.erase("outliers");
  json["refined"] = schema.refined;
  json["version"] = schema.version;
  json["base_version"] = schema.base_version;
  json["last_sample"] = schema.last_sample_index;
  json["X_CR"] = pose_json(schema.X_CR);
  const auto& variances = schema.X_CR_covariance.diagonal();
  json["X_CR"]["position_sd_m"] = axes_json(variances.head<3>(), 1);
  json["X_CR"]["rotation_sd_deg"] = axes_json(variances.tail<3>(), kDegree);
  json["signals"] = array_of(schema.signals, [](const Signal& signal) -> Json {
    const auto [from, to] = signal.known_range();
    return {{"name", signal.name},
            {"lower", signal.lower},
            {"upper", signal.upper},
            {"covered", {from, to}},
            {"warp", signal.warp}};
  });
  const Eigen::VectorXd middle = schema.displacements(mid_range(schema.signals));
  for (std::size_t i = 0; i < schema.edges.size(); ++i)
    add_parameters(schema, schema.edges[i], middle, &json["edges"][i]);
  return json;
}

std::string structure_text(const BodySchema& schema, std::optional<NoiseSource> source) {
  std::string text =
      fmt::format("{} structure of {} from {}\n", schema.complete ? "Complete" : "Incomplete",
                  counted(std::ssize(schema.parts), "part"), counted(schema.num_samples, "sample"));
  std::vector<std::string> signals;
  std::size_t width = 12;
  for (const Edge& edge : schema.edges) {
    signals.push_back(in_braces(signal_names(schema, edge.signals())));
    width = std::max(width, signals.back().size());
  }
  if (!schema.edges.empty())
    text += fmt::format("  {:<9} {:<9} {:<{}} {:>10} {:>7}\n", "edge", "kind", "signals", width,
                        "residual", "(rms)");
  const Eigen::VectorXd middle = schema.displacements(mid_range(schema.signals));
  for (std::size_t e = 0; e < schema.edges.size(); ++e) {
    const Edge& edge = schema.edges[e];
    text += fmt::format("  {:>3} → {:<3} {:<9} {:<{}} {:7.2f} mm ", edge.from, edge.to, edge.kind(),
                        signals[e], width, edge.position_rms_m * 1e3);
    text += schema.has_rotation(edge.to)
                ? fmt::format("{:6.2f}°\n", edge.rotation_rms_rad / kDegree)
                : std::string(" position alone\n");
    text += joints_text(schema, edge, middle);
  }
  for (const UnconnectedPart& part : schema.unconnected)
    text += fmt::format("  {:>3}   not connected: {}\n", part.part, reason_text(part));
  const std::string unused = listed(signal_names(schema, schema.unused_signals()));
  const std::string undecided = listed(signal_names(schema, schema.undecided_signals));
  if (!unused.empty()) text += "  signals without effect: " + unused + "\n";
  if (schema.noise.position_m > 0) text += noise_text(schema.noise, source);
  if (!undecided.empty()) text += "  signals whose effect is not told yet: " + undecided + "\n";
  return text;
}

std::string errors_text(const JudgedErrors& errors) {
  std::string text = "  part  count   median            rms               max";
  if (errors.alignment) text += "        aligned median";
  for (std::size_t i = 0; i < errors.parts.size(); ++i) {
    text += "\n" + errors_line(errors.parts[i]);
    if (!errors.alignment || errors.aligned_parts[i].count == 0) continue;
    const PartErrors& aligned = errors.aligned_parts[i];
    text += fmt::format(" {:7.2f} mm", aligned.position_median_m * 1e3);
    if (aligned.has_rotation)
      text += fmt::format(" {:5.2f}°", aligned.rotation_median_rad / kDegree);
  }
  text += "\n";
  if (errors.alignment)
    text += fmt::format(
        "(Aligned to these samples: with the parts' frames and the unit of length of the truth; "
        "scale {:.4f}.)\n",
        errors.alignment->scale);
  return text;
}

}  // namespace bodyschema
