#include "processes/console/views/refinement_view.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

#include "common/geometry/angle.h"
#include "common/text/text.h"
#include "processes/console/views/structure_view.h"

namespace bodyschema {
namespace {

/// A number of a unit in what people read: mm and degrees.
struct Shown {
  double factor = 1;
  std::string unit;
};
Shown shown(const std::string& unit) {
  if (unit == "m") return {1e3, "mm"};
  if (unit == "m/unit") return {1e3, "mm/unit"};
  if (unit == "rad") return {1 / kDegree, "°"};
  if (unit == "rad/unit") return {1 / kDegree, "°/unit"};
  if (unit == "rad/(N m)") return {1 / kDegree, "°/(N m)"};
  if (unit == "m/N") return {1e3, "mm/N"};
  if (unit == "1") return {100, "%"};
  return {1, unit};
}

Json parameter_json(const RefinedParameter& parameter) {
  return {{"name", parameter.name},
          {"unit", parameter.unit},
          {"change", parameter.change},
          {"sd", or_null(parameter.sd)}};
}

Json held_out_json(const HeldOutErrors& errors) {
  if (errors.num_samples == 0) return nullptr;
  Json json = errors_json(errors.num_samples, errors.parts);
  json["corner_rms_px"] = or_null(errors.px_rms);
  json["corner_median_px"] = or_null(errors.px_median);
  return json;
}

Json lens_json(const CameraCalibration& camera) {
  return {{"fx_px", camera.fx},
          {"fy_px", camera.fy},
          {"cx_px", camera.cx},
          {"cy_px", camera.cy},
          {"distortion", camera.distortion}};
}

Json tag_json(const TagPlacement& tag) {
  return {{"tag", tag.id},
          {"part", tag.part},
          {"size_m", tag.size_m},
          {"X_BM", tag.X_BM ? pose_json(*tag.X_BM) : Json()}};
}

std::string gauge_text(const Refinement& result) {
  if (!result.used_corners)
    return "a part's frame is where its poses are seen; the scale is that of the poses";
  return "a part's frame is where its tags are closest to where the rig says that they sit; the "
         "scale is the mean of all tags' sizes, weighed by their priors";
}

/// Over all parts, root mean squares.
Noise total_of(const std::vector<PartErrors>& parts) {
  double position = 0, rotation = 0, count = 0, turned = 0;
  for (const PartErrors& part : parts) {
    position += part.count * part.position_rms_m * part.position_rms_m;
    count += part.count;
    if (!part.has_rotation) continue;
    rotation += part.count * part.rotation_rms_rad * part.rotation_rms_rad;
    turned += part.count;
  }
  return {count > 0 ? std::sqrt(position / count) : 0,
          turned > 0 ? std::sqrt(rotation / turned) : 0};
}

std::string held_out_text(const Refinement& result) {
  if (result.before.num_samples == 0)
    return "  no TEST samples: nothing tells the error on samples that were not fitted (--test)\n";
  std::string text = fmt::format("  held out, {}:", counted(result.before.num_samples, "sample"));
  for (const auto& [name, errors] :
       {std::pair{"before", &result.before}, {"after", &result.after}}) {
    const Noise total = total_of(errors->parts);
    text += fmt::format("\n    {:<7} rms {:.3f} mm, {:.4f}° over all parts", name,
                        total.position_m * 1e3, total.rotation_rad / kDegree);
    if (errors->px_rms)
      text += fmt::format("; corners rms {:.3f} px, median {:.3f} px", *errors->px_rms,
                          *errors->px_median);
  }
  return text + "\n";
}

/// Those of the root, the edges and the lens, one a line.
std::string parameters_text(const std::vector<RefinedParameter>& parameters) {
  std::string text = fmt::format("  {:<40} {:>10} {:>10}\n", "parameter", "change", "sd");
  for (const RefinedParameter& parameter : parameters) {
    if (parameter.tag >= 0) continue;
    const Shown unit = shown(parameter.unit);
    const std::string sd =
        parameter.sd ? fmt::format("{:.4f}", *parameter.sd * unit.factor) : std::string("not told");
    text += fmt::format("    {:<38} {:10.4f} {:>10} {}\n", parameter.name,
                        parameter.change * unit.factor, sd, unit.unit);
  }
  return text;
}

/// How far each tag is from where the rig says, one a line.
std::string tags_text(const Refinement& result, const std::optional<RigCalibration>& claimed) {
  if (!result.used_corners || !claimed) return "";
  std::string text = "  tags, from where the rig says:\n";
  for (const TagPlacement& tag : result.rig.markers.tags) {
    const TagPlacement* before = claimed->markers.find(tag.id);
    Vector6d moved = Vector6d::Zero();
    if (tag.X_BM && before->X_BM) moved = log(before->X_BM->inverse() * *tag.X_BM);
    const double larger = 100 * (tag.size_m / before->size_m - 1);
    if (moved.isZero(1e-12) && std::abs(larger) < 1e-9) continue;
    text += fmt::format("    tag {:>3} of part {:>2}: {:.3f} mm, {:.3f}°; {:+.3f} % in size\n",
                        tag.id, tag.part, moved.head<3>().norm() * 1e3,
                        moved.tail<3>().norm() / kDegree, larger);
  }
  return text;
}

std::string plays_text(const std::vector<JointPlay>& plays) {
  std::string text;
  for (const JointPlay& play : plays)
    if (play.turn_rad > 0 || play.slide_m > 0)
      text += fmt::format("  {} is off its command by {:.4f}°, {:.4f} mm (1 σ)\n", play.joint,
                          play.turn_rad / kDegree, play.slide_m * 1e3);
  return text;
}

std::string bends_text(const std::vector<RefinedBend>& bends) {
  std::string text;
  for (const RefinedBend& bend : bends)
    text += fmt::format("  the command {} is bent: up to {:.4g} from a line, by {:.1f} nats\n",
                        bend.signal, bend.largest, bend.evidence);
  return text;
}

bool has_any(const std::vector<PartErrors>& parts) {
  return std::ranges::any_of(parts, [](const PartErrors& part) { return part.count > 0; });
}

Json elastic_errors_json(const Elasticity::Errors& errors) {
  const Noise fitted = total_of(errors.fitted), held_out = total_of(errors.held_out);
  const bool is_known = has_any(errors.held_out);
  return {{"noise_scale", errors.noise_scale},
          {"fitted_rms_m", fitted.position_m},
          {"fitted_rms_deg", fitted.rotation_rad / kDegree},
          {"held_out_rms_m", is_known ? Json(held_out.position_m) : Json()},
          {"held_out_rms_deg", is_known ? Json(held_out.rotation_rad / kDegree) : Json()}};
}

Json elasticity_json(const Elasticity& elasticity) {
  return {{"evidence", elasticity.evidence},
          {"stiff", elastic_errors_json(elasticity.stiff)},
          {"elastic", elastic_errors_json(elasticity.elastic)},
          {"joints", array_of(elasticity.joints, [](const JointCompliance& joint) {
             return Json{
                 {"joint", joint.joint},       {"unit", joint.unit},
                 {"compliance", joint.value},  {"sd", joint.sd > 0 ? Json(joint.sd) : Json()},
                 {"evidence", joint.evidence}, {"largest_droop", joint.droop}};
           })}};
}

std::string elasticity_text(const std::optional<Elasticity>& elasticity) {
  if (!elasticity) return "";
  std::string text = fmt::format(
      "  joints that give way to gravity are {} by {:.1f} nats (BIC)\n",
      elasticity->evidence > 0 ? "likelier than stiff ones" : "less likely than stiff ones",
      std::abs(elasticity->evidence));
  for (const auto& [name, errors] :
       {std::pair{"stiff", &elasticity->stiff}, {"elastic", &elasticity->elastic}}) {
    const Noise fitted = total_of(errors->fitted);
    text += fmt::format("    {:<7} rms {:.3f} mm, {:.4f}° on the fitted samples", name,
                        fitted.position_m * 1e3, fitted.rotation_rad / kDegree);
    if (has_any(errors->held_out))
      text += fmt::format(", {:.3f} mm held out", total_of(errors->held_out).position_m * 1e3);
    text += fmt::format("; {:.2f} times the noise\n", errors->noise_scale);
  }
  for (const JointCompliance& joint : elasticity->joints) {
    const Shown unit = shown(joint.unit);
    if (joint.sd == 0) {
      text += fmt::format("    {}: its load does not change\n", joint.joint);
      continue;
    }
    const bool is_turning = joint.unit == "rad/(N m)";
    text += fmt::format("    {} gives way by {:.5f} ± {:.5f} {}, {:.3f} {} at most; {:+.1f} nats\n",
                        joint.joint, joint.value * unit.factor, joint.sd * unit.factor, unit.unit,
                        joint.droop * unit.factor, is_turning ? "°" : "mm", joint.evidence);
    if (joint.rises())
      text +=
          "      against its load: its drive makes up for more than gravity, or the URDF's masses "
          "are too large\n";
  }
  return text;
}

std::string findings_text(const Refinement& result) {
  std::string text;
  for (const std::string& sentence : result.undetermined) text += "  " + sentence + "\n";
  for (const ParameterCorrelation& pair : result.correlations)
    text +=
        fmt::format("  {} and {} can hardly be told apart (correlation {:.3f}){}\n", pair.one,
                    pair.other, pair.correlation, pair.advice.empty() ? "" : ": " + pair.advice);
  if (!result.outliers.empty())
    text += fmt::format("  outliers, {} of {}{}:\n", result.num_outliers, result.num_observations,
                        std::ssize(result.outliers) < result.num_outliers ? ", the farthest" : "");
  for (const RefinementOutlier& outlier : result.outliers)
    text +=
        fmt::format("    sample {}, part {}{}, image at {:.3f} s: {:.1f} σ\n", outlier.sample_index,
                    outlier.part, outlier.tag < 0 ? "" : fmt::format(", tag {}", outlier.tag),
                    1e-6 * static_cast<double>(outlier.image_utime), outlier.distance);
  return text;
}

Json wanted_json(const Refinement& result) {
  return array_of(result.wanted_actions, [&](const WantedAction& wanted) {
    return Json{{"action", action_json(result.schema, wanted.action)},
                {"fall", wanted.fall},
                {"reducible_fall", wanted.reducible_fall}};
  });
}

std::string wanted_text(const Refinement& result) {
  if (result.wanted_actions.empty()) return "";
  std::string text = fmt::format(
      "  actions ({}) that would tell most; with each and those before it the worst predicted "
      "deviation falls by, and what actions can tell of it by:\n",
      listed(signal_names(result.schema)));
  for (const WantedAction& wanted : result.wanted_actions) {
    text += "   ";
    for (const double value : wanted.action) text += fmt::format(" {:10.4g}", value);
    text +=
        fmt::format("   {:5.1f} %  {:5.1f} %\n", 100 * wanted.fall, 100 * wanted.reducible_fall);
  }
  return text;
}

}  // namespace

Json refinement_json(const Refinement& result, const std::optional<RigCalibration>& claimed) {
  Json json;
  json["fitted"] = result.used_corners ? "corners" : "poses";
  json["samples"] = result.num_samples;
  json["available"] = result.num_available;
  json["observations"] = result.num_observations;
  json["root_moves"] = result.root_moves;
  json["iterations"] = result.num_iterations;
  json["seconds"] = result.seconds;
  json["noise_scale"] = result.noise_scale;
  json["serial_correlation"] = result.serial_correlation;
  json["gauge"] = gauge_text(result);
  json["before"] = held_out_json(result.before);
  json["after"] = held_out_json(result.after);
  json["parameters"] = array_of(result.parameters, parameter_json);
  json["undetermined"] = result.undetermined;
  json["correlations"] = array_of(result.correlations, [](const ParameterCorrelation& pair) {
    return Json{{"one", pair.one},
                {"other", pair.other},
                {"correlation", pair.correlation},
                {"advice", pair.advice}};
  });
  json["num_outliers"] = result.num_outliers;
  json["warnings"] = result.warnings;
  json["outliers"] = array_of(result.outliers, [](const RefinementOutlier& outlier) {
    return Json{{"sample", outlier.sample_index},
                {"part", outlier.part},
                {"tag", known(outlier.tag)},
                {"image_utime", outlier.image_utime},
                {"distance", outlier.distance}};
  });
  json["coverage"] = array_of(result.coverage, [](const SignalCoverage& signal) {
    return Json{{"signal", signal.signal}, {"share", signal.share}};
  });
  json["plays"] = array_of(result.plays, [](const JointPlay& play) {
    return Json{
        {"joint", play.joint}, {"slide_m", play.slide_m}, {"turn_deg", play.turn_rad / kDegree}};
  });
  json["bends"] = array_of(result.bends, [](const RefinedBend& bend) {
    return Json{{"signal", bend.signal}, {"evidence", bend.evidence}, {"largest", bend.largest}};
  });
  json["held"] = result.held;
  json["elasticity"] = result.elasticity ? elasticity_json(*result.elasticity) : Json();
  json["wanted_actions"] = wanted_json(result);
  if (result.used_corners && claimed) {
    json["tags"] = array_of(result.rig.markers.tags, tag_json);
    json["lens"] = lens_json(result.rig.camera);
  }
  return json;
}

std::string refinement_text(const Refinement& result,
                            const std::optional<RigCalibration>& claimed) {
  std::string text =
      fmt::format("refined: {} of {} fitted, {} of {}, {:.1f} s\n",
                  counted(result.num_samples, "sample"), result.num_available,
                  result.num_observations, result.used_corners ? "tags" : "poses", result.seconds);
  if (!result.used_corners && claimed)
    text += "  poses were fitted; --placements and --intrinsics fit the corners of the tags\n";
  if (result.root_moves) text += "  the root moves: it has a pose at every sample\n";
  if (result.noise_scale > 1.05)
    text += fmt::format("  residuals are {:.2f} times as large as the noise that is told\n",
                        result.noise_scale);
  if (result.serial_correlation > 0)
    text += fmt::format(
        "  noise lasts from one sample to the next (correlation {:.2f}): deviations are told so\n",
        result.serial_correlation);
  for (const std::string& warning : result.warnings) text += "  warning: " + warning + "\n";
  text += "  " + gauge_text(result) + "\n";
  for (const std::string& held : result.held) text += "  held: " + held + "\n";
  text += held_out_text(result) + parameters_text(result.parameters) + tags_text(result, claimed) +
          plays_text(result.plays) + bends_text(result.bends) + elasticity_text(result.elasticity) +
          findings_text(result);
  for (const SignalCoverage& signal : result.coverage)
    text += fmt::format("  {}: {:.0f} % of its range seen\n", signal.signal, 100 * signal.share);
  return text + wanted_text(result);
}

}  // namespace bodyschema
