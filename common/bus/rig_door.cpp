#include "common/bus/rig_door.h"

#include <spdlog/spdlog.h>

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <tuple>
#include <vector>

#include "common/bus/convert.h"
#include "common/bus/event_log.h"

namespace bodyschema {
namespace {

/// Largest change of a calibration by rewriting it as text [px, or no unit].
constexpr double kSameNumber = 1e-6;

constexpr const char* kNewRun =
    "begin a new run, or put those files back as they were and start the group again";

bool is_same(double a, double b) { return std::abs(a - b) <= kSameNumber; }

/// Without the zeros at its end, which have no effect.
std::vector<double> significant(std::vector<double> distortion) {
  while (!distortion.empty() && distortion.back() == 0) distortion.pop_back();
  return distortion;
}

std::string text_of(std::int8_t model, const std::vector<double>& distortion) {
  static const char* const kModels[] = {"plumb_bob", "rational_polynomial", "fisheye"};
  return fmt::format("{} [{}]", kModels[model], fmt::join(distortion, ", "));
}

/// Plumb bob is the rational model whose last three coefficients are 0.
bool is_same_distortion(std::int8_t model, const std::vector<double>& distortion,
                        std::int8_t other_model, const std::vector<double>& other_distortion) {
  const bool is_fisheye = model == camera_info_t::MODEL_FISHEYE;
  if (is_fisheye != (other_model == camera_info_t::MODEL_FISHEYE)) return false;
  const auto a = significant(distortion), b = significant(other_distortion);
  return std::equal(a.begin(), a.end(), b.begin(), b.end(), is_same);
}

}  // namespace

RigDoor::RigDoor(const std::filesystem::path& rig_folder, const std::filesystem::path& calibration)
    : signals_(load_signals(rig_folder)),
      markers_(load_markers(rig_folder)),
      calibration_file_(calibration.filename().string()),
      camera_(load_camera_calibration(calibration)),
      calibration_id_(bodyschema::calibration_id(markers_, camera_)) {}

void RigDoor::refuse(Process& process, const std::string& channel, const std::string& why) {
  if (process.count("refused " + channel) == 1) {
    spdlog::warn("{}: refused, not of this rig: {} (further ones are only counted)", channel, why);
  }
  process.set_notice(channel, channel + " refused: " + why);
}

bool RigDoor::takes(Process& process, const sample_t& sample) const {
  return lets_in(process, kSample, sample);
}

std::string RigDoor::objection_to_calibration(std::int64_t id, const char* what_to_do) const {
  if (id == 0 || id == calibration_id_) return "";
  return fmt::format(
      "of another calibration of the tags or lens: {:016x}, that of markers.yaml and {} is "
      "{:016x}; {}",
      static_cast<std::uint64_t>(id), calibration_file_,
      static_cast<std::uint64_t>(calibration_id_), what_to_do);
}

std::string RigDoor::objection_to_part(int part) const {
  const bool is_known = std::any_of(markers_.tags.begin(), markers_.tags.end(),
                                    [&](const TagPlacement& tag) { return tag.part == part; });
  return is_known ? "" : fmt::format("part {} is not in markers.yaml", part);
}

std::string RigDoor::objection_to_signals(std::size_t num_signals) const {
  if (num_signals == signals_.signals.size()) return "";
  return fmt::format("it has {} action signals, signals.yaml names {}", num_signals,
                     signals_.signals.size());
}

std::string RigDoor::objection(const camera_info_t& info) const {
  if (info.camera_name != camera_.camera_name) {
    return fmt::format("camera '{}' is not '{}'", info.camera_name, camera_.camera_name);
  }
  if (info.image_width != camera_.width || info.image_height != camera_.height) {
    return fmt::format("it holds for {}×{} px, the rig's calibration for {}×{}", info.image_width,
                       info.image_height, camera_.width, camera_.height);
  }
  const std::tuple<const char*, double, double> numbers[] = {{"fx", info.fx, camera_.fx},
                                                             {"fy", info.fy, camera_.fy},
                                                             {"cx", info.cx, camera_.cx},
                                                             {"cy", info.cy, camera_.cy}};
  for (const auto& [name, theirs, ours] : numbers) {
    if (is_same(theirs, ours)) continue;
    return fmt::format("{} {} px, the rig's {} says {}", name, theirs, calibration_file_, ours);
  }
  const auto model = static_cast<std::int8_t>(camera_.model);
  if (!is_same_distortion(info.distortion_model, info.distortion, model, camera_.distortion)) {
    return fmt::format("distortion {}, the rig's {} says {}",
                       text_of(info.distortion_model, info.distortion), calibration_file_,
                       text_of(model, camera_.distortion));
  }
  return "";
}

std::string RigDoor::objection(const marker_poses_t& poses) const {
  if (poses.camera_name != camera_.camera_name) {
    return fmt::format("camera '{}' is not '{}'", poses.camera_name, camera_.camera_name);
  }
  for (const marker_pose_t& marker : poses.markers) {
    const std::optional<double> size_m = markers_.size_m(marker.marker_id);
    if (!size_m) return fmt::format("tag {} is not in markers.yaml", marker.marker_id);
    if (std::abs(marker.size_m - *size_m) > 1e-6) {
      return fmt::format("tag {} is {} m wide, in markers.yaml {} m", marker.marker_id,
                         marker.size_m, *size_m);
    }
  }
  return objection_to_calibration(poses.calibration_id,
                                  "start marker_estimator and this process again");
}

std::string RigDoor::objection(const motion_status_t& status) const {
  // Only a MOVE has an action to echo; a driver that was never commanded has none.
  const bool has_action = status.kind == action_command_t::KIND_MOVE && status.action_id >= 0;
  if (!has_action && status.commanded.empty()) return "";
  return objection_to_signals(status.commanded.size());
}

std::string RigDoor::objection(const sample_t& sample) const {
  std::string why_not = objection_to_signals(sample.action.size());
  for (const auto* observations : {&sample.parts, &sample.contradictions}) {
    for (const part_observation_t& part : *observations) {
      if (why_not.empty()) why_not = objection_to_part(part.part_id);
      for (const tag_corners_t& corners : part.tags) {
        const TagPlacement* tag = markers_.find(corners.tag_id);
        if (why_not.empty() && (!tag || tag->part != part.part_id))
          why_not = fmt::format("tag {} does not belong to part {}", corners.tag_id, part.part_id);
      }
    }
  }
  return why_not.empty() ? objection_to_calibration(sample.calibration_id, kNewRun) : why_not;
}

std::string RigDoor::objection(const body_schema_t& schema) const {
  std::string why_not = objection_to_signals(schema.signals.size());
  if (!why_not.empty()) return why_not;
  for (std::size_t i = 0; i < schema.signals.size(); ++i) {
    const signal_t& theirs = schema.signals[i];
    const Signal& ours = signals_.signals[i];
    if (theirs.signal_name != ours.name || theirs.lower_limit != ours.lower ||
        theirs.upper_limit != ours.upper) {
      return fmt::format("signal '{}' {} … {} is '{}' {} … {} in signals.yaml", theirs.signal_name,
                         theirs.lower_limit, theirs.upper_limit, ours.name, ours.lower, ours.upper);
    }
  }
  for (const std::int32_t part : schema.part_ids) {
    if (why_not.empty()) why_not = objection_to_part(part);
  }
  return why_not.empty() ? objection_to_calibration(schema.calibration_id, kNewRun) : why_not;
}

std::string RigDoor::objection(const model_health_t& health) const {
  std::string why_not;
  for (const part_health_t& part : health.part_health) {
    if (why_not.empty()) why_not = objection_to_part(part.health_part);
  }
  return why_not;
}

body_schema_t RigDoor::load_initial_schema(const std::filesystem::path& file) const {
  std::vector<body_schema_t> schemas = read_log(file, kBodySchema);
  if (schemas.empty()) throw std::runtime_error(file.string() + ": no BODY_SCHEMA in the file");
  body_schema_t schema = std::move(schemas.back());
  set_array(schema.num_wanted, schema.wanted_actions, {});  // of a refined schema
  if (schema.signals.size() == signals_.signals.size()) {
    for (std::size_t s = 0; s < schema.signals.size(); ++s) {
      if (!schema.signals[s].warp_weights.empty()) continue;
      signal_t& signal = schema.signals[s];
      signal.lower_limit = signals_.signals[s].lower;
      signal.upper_limit = signals_.signals[s].upper;
      signal.covered_lower =
          std::clamp(signal.covered_lower, signal.lower_limit, signal.upper_limit);
      signal.covered_upper =
          std::clamp(signal.covered_upper, signal.lower_limit, signal.upper_limit);
    }
  }
  if (const std::string why = objection(schema); !why.empty())
    throw std::runtime_error(file.string() + ": " + why);
  return schema;
}

std::string RigDoor::objection(const sim_state_t& state) const {
  std::string why_not;
  for (const std::int32_t part : state.true_part) {
    if (why_not.empty()) why_not = objection_to_part(part);
  }
  return why_not;
}

}  // namespace bodyschema
