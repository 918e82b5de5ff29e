#include "common/scene/calibration_error.h"

#include <algorithm>
#include <random>

#include "common/config/yaml.h"
#include "common/geometry/angle.h"
#include "common/scene/robot.h"

namespace bodyschema {
namespace {

/// Id of the lens's draw, in place of a tag's id.
constexpr std::uint32_t kLens = 0xffffffffU;

/// Standard normal numbers for one displaced tag or lens.
class Draw {
 public:
  Draw(std::int64_t seed, std::uint32_t what) {
    std::seed_seq sequence{static_cast<std::uint32_t>(seed), static_cast<std::uint32_t>(seed >> 32),
                           what, 0xca11bU};
    engine_.seed(sequence);
  }
  double operator()() { return normal_(engine_); }
  Eigen::Vector3d vector() {
    const double x = (*this)(), y = (*this)(), z = (*this)();
    return {x, y, z};
  }

 private:
  std::mt19937_64 engine_;
  std::normal_distribution<double> normal_;
};

}  // namespace

CalibrationError CalibrationError::load(const Yaml& yaml) {
  CalibrationError error;
  error.tag_position_m = yaml.number("tag_position_mm", 0, 100) / 1000;
  error.tag_rotation_rad = yaml.number("tag_rotation_deg", 0, 30) * kDegree;
  error.tag_size_share = yaml.number("tag_size_percent", 0, 10) / 100;
  error.focal_length_share = yaml.number("focal_length_percent", 0, 10) / 100;
  error.distortion_k1 = yaml.number("distortion_k1", 0, 1);
  error.backlash_rad = yaml.number("backlash_deg", 0, 10) * kDegree;
  error.droop_share = yaml.number("droop_percent", 0, 100) / 100;
  return error;
}

Robot with_calibration_error(Robot robot, std::int64_t seed) {
  const CalibrationError& error = robot.calibration_error;
  for (TagPlacement& tag : robot.markers.tags) {
    Draw draw(seed, static_cast<std::uint32_t>(tag.id));
    Pose X_MTrue = Pose::Identity();
    X_MTrue.translation() = error.tag_position_m * draw.vector();
    X_MTrue.linear() = exp_so3(error.tag_rotation_rad * draw.vector());
    tag.X_BM = tag.X_BM.value_or(Pose::Identity()) * X_MTrue;
    tag.size_m *= 1 + error.tag_size_share * draw();
  }
  Draw draw(seed, kLens);
  const double factor = 1 + error.focal_length_share * draw();
  robot.lens.fx *= factor;
  robot.lens.fy *= factor;
  robot.lens.distortion.at(0) += error.distortion_k1 * draw();
  return robot;
}

double play_after(double position, double before, double width) {
  return std::clamp(before - position, -width / 2, width / 2);
}

}  // namespace bodyschema
