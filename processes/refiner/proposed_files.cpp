#include "processes/refiner/proposed_files.h"

#include <fmt/format.h>

#include "common/bus/event_log.h"
#include "common/config/proposed_calibration.h"
#include "processes/refiner/calibrated_lens.h"

namespace bodyschema {
namespace {

std::string placement_text(const std::optional<Pose>& X_BM) {
  if (!X_BM) return "none";
  const Eigen::Vector3d p = X_BM->translation();
  const Eigen::Quaterniond q(X_BM->linear());
  return fmt::format("{{position_m: [{}, {}, {}], rotation_wxyz: [{}, {}, {}, {}]}}", p.x(), p.y(),
                     p.z(), q.w(), q.x(), q.y(), q.z());
}

std::string markers_text(const Markers& markers, const std::string& header) {
  std::string text = header + "# Where the tags were found to sit, and how large.\n";
  text += fmt::format("family: {}\ntags:\n", markers.family);
  for (const TagPlacement& tag : markers.tags)
    text += fmt::format("  - {{id: {}, size_m: {}, part: {}, placement: {}}}\n", tag.id, tag.size_m,
                        tag.part, placement_text(tag.X_BM));
  if (!markers.target_tags.empty()) text += "target_tags:\n";
  for (const TargetTag& tag : markers.target_tags)
    text += fmt::format("  - {{id: {}, size_m: {}}}\n", tag.id, tag.size_m);
  return text;
}

std::string camera_text(const CameraCalibration& found, const std::string& header) {
  const CameraCalibration camera = with_all_coefficients(found);
  return header + fmt::format(
                      "image_width: {}\nimage_height: {}\ncamera_name: {}\n"
                      "camera_matrix:\n  rows: 3\n  cols: 3\n  data: [{}, 0.0, {}, 0.0, {}, {}, "
                      "0.0, 0.0, 1.0]\n"
                      "distortion_model: {}\n"
                      "distortion_coefficients:\n  rows: 1\n  cols: {}\n  data: [{}]\n",
                      camera.width, camera.height,
                      camera.camera_name.empty() ? "camera" : camera.camera_name, camera.fx,
                      camera.cx, camera.fy, camera.cy, distortion_model_name(camera.model),
                      camera.distortion.size(), fmt::join(camera.distortion, ", "));
}

}  // namespace

void write_proposed_files(const RigCalibration& rig, const std::filesystem::path& folder) {
  std::filesystem::create_directories(folder);
  const std::string header = fmt::format("{} {}\n", kProposalMark, calibration_id(rig));
  write_file_atomically(folder / "markers.yaml", markers_text(rig.markers, header));
  write_file_atomically(folder / "camera_info.yaml", camera_text(rig.camera, header));
}

}  // namespace bodyschema
