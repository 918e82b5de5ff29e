#include "common/config/calibration_id.h"

#include <Eigen/Geometry>
#include <cmath>

#include "common/config/yaml.h"

namespace bodyschema {
namespace {

class Fnv1a {
 public:
  void add(std::int64_t number) {
    for (int shift = 0; shift < 64; shift += 8) {
      hash_ ^= (static_cast<std::uint64_t>(number) >> shift) & 0xFFU;
      hash_ *= 0x100000001B3U;
    }
  }
  std::int64_t id() const { return hash_ == 0 ? 1 : static_cast<std::int64_t>(hash_); }

 private:
  std::uint64_t hash_ = 0xCBF29CE484222325U;
};

std::int64_t multiple(double value, double unit) { return std::llround(value / unit); }

constexpr double kLength = 1e-9, kFraction = 1e-9, kPixel = 1e-6;

void add_pose(Fnv1a& hash, const Pose& X) {
  for (const double coordinate : X.translation()) hash.add(multiple(coordinate, kLength));
  const Eigen::Quaterniond q(X.linear());
  std::int64_t wxyz[] = {multiple(q.w(), kFraction), multiple(q.x(), kFraction),
                         multiple(q.y(), kFraction), multiple(q.z(), kFraction)};
  std::int64_t sign = 0;
  for (const std::int64_t number : wxyz)
    if (sign == 0 && number != 0) sign = number < 0 ? -1 : 1;
  for (const std::int64_t number : wxyz) hash.add(sign * number);
}

}  // namespace

std::int64_t calibration_id(const Markers& markers, const CameraCalibration& camera) {
  Fnv1a hash;
  for (const TagPlacement& tag : markers.tags) {
    hash.add(tag.id);
    hash.add(tag.part);
    hash.add(multiple(tag.size_m, kLength));
    hash.add(tag.X_BM ? 1 : 0);
    if (tag.X_BM) add_pose(hash, *tag.X_BM);
  }
  hash.add(camera.width);
  hash.add(camera.height);
  for (const double number : {camera.fx, camera.fy, camera.cx, camera.cy})
    hash.add(multiple(number, kPixel));
  hash.add(camera.model == CameraCalibration::Model::kFisheye ? 1 : 0);
  std::vector<std::int64_t> distortion;
  for (const double coefficient : camera.distortion)
    distortion.push_back(multiple(coefficient, kFraction));
  while (!distortion.empty() && distortion.back() == 0) distortion.pop_back();
  for (const std::int64_t coefficient : distortion) hash.add(coefficient);
  return hash.id();
}

std::int64_t calibration_id(const RigCalibration& calibration) {
  return calibration_id(calibration.markers, calibration.camera);
}

std::filesystem::path calibration_file(const std::filesystem::path& rig_folder) {
  const std::filesystem::path file = Yaml::load(rig_folder / "camera.yaml").text("calibration");
  return file.is_relative() ? rig_folder / file : file;
}

RigCalibration load_calibration(const std::filesystem::path& rig_folder) {
  return {load_markers(rig_folder), load_camera_calibration(calibration_file(rig_folder))};
}

std::int64_t calibration_id(const std::filesystem::path& rig_folder) {
  return calibration_id(load_calibration(rig_folder));
}

}  // namespace bodyschema
