#include "common/config/camera_calibration.h"

#include <yaml-cpp/yaml.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <fstream>
#include <initializer_list>
#include <sstream>

#include "common/config/yaml.h"
#include "common/text/text.h"

namespace bodyschema {
namespace {

/// A calibration file is written by a tool, not by us: keys that we do not need are left alone, so
/// the strict Yaml reader does not fit.
class CalibrationFile {
 public:
  explicit CalibrationFile(const std::filesystem::path& file) : name_(file.string()) {
    std::ifstream stream(file);
    std::stringstream text;
    text << stream.rdbuf();
    if (!stream || !std::filesystem::is_regular_file(file)) {
      throw ConfigError(name_ +
                        ": the camera calibration cannot be read; make one with e.g. ROS's "
                        "camera_calibration or OpenCV's calibration sample");
    }
    std::string content = text.str();
    // "%YAML:1.0" is OpenCV's and no YAML directive. Blanks keep the line numbers.
    if (content.starts_with("%YAML:")) {
      std::fill_n(content.begin(), std::min(content.find('\n'), content.size()), ' ');
    }
    root_ = only_document(content, name_);
    if (!root_.IsMap()) throw ConfigError(name_ + ":1: expected a mapping 'key: value'");
  }

  bool has(const std::string& key) const { return root_[key].IsDefined(); }

  [[noreturn]] void fail(const std::string& key, const std::string& what) const {
    const YAML::Node node = root_[key];
    const int line = node.IsDefined() ? node.Mark().line + 1 : 1;
    throw ConfigError(name_ + ":" + std::to_string(line) + ": " + key + ": " + what);
  }

  std::string text(const std::string& key) const {
    if (!root_[key].IsScalar()) fail(key, "expected a text");
    return root_[key].as<std::string>();
  }

  int size(const std::string& key) const {
    if (!has(key))
      fail(key, "this key is missing: the size in pixels that the calibration holds for");
    try {
      const int value = root_[key].as<int>();
      if (value >= 32 && value <= 32768) return value;
    } catch (const YAML::Exception&) {
    }
    fail(key, "expected a size in pixels, 32 … 32768");
  }

  /// {rows, cols, data: [...]}, both in ROS's files and under OpenCV's tag !!opencv-matrix.
  std::vector<double> matrix(const std::string& key,
                             std::initializer_list<std::size_t> sizes) const {
    const YAML::Node node = root_[key];
    if (!node.IsDefined()) fail(key, "this key is missing");
    std::vector<double> data;
    try {
      data = (node.IsMap() ? node["data"] : node).as<std::vector<double>>();
      if (node.IsMap() && node["rows"] && node["cols"] &&
          node["rows"].as<std::size_t>() * node["cols"].as<std::size_t>() != data.size()) {
        fail(key, "rows × cols is not the number of elements in data");
      }
    } catch (const YAML::Exception&) {
      fail(key, "expected {rows: …, cols: …, data: [numbers]}");
    }
    if (std::find(sizes.begin(), sizes.end(), data.size()) == sizes.end())
      fail(key, "has " + std::to_string(data.size()) + " elements, expected " +
                    listed(sizes, [](std::size_t size) { return std::to_string(size); }));
    for (const double value : data) {
      if (!std::isfinite(value)) fail(key, "expected finite numbers");
    }
    return data;
  }

 private:
  std::string name_;
  YAML::Node root_;
};

using Model = CameraCalibration::Model;

// Chosen far beyond any lens: a number that was damaged, not one that was measured.
constexpr double kLongestFocalLength_px = 1e6;
constexpr double kLargestDistortion = 1e4;

Model distortion_model(const CalibrationFile& file, std::size_t num_coefficients) {
  if (file.has("distortion_model")) {
    const std::string name = file.text("distortion_model");
    if (name == "plumb_bob" || name == "radtan") return Model::kPlumbBob;
    if (name == "rational_polynomial") return Model::kRational;
    if (name == "equidistant" || name == "fisheye") return Model::kFisheye;
    file.fail("distortion_model",
              "'" + name + "' is none of: plumb_bob, rational_polynomial, equidistant, fisheye");
  }
  // OpenCV's files name no model; its calibration sample marks a fisheye lens so.
  if (file.has("fisheye_model") && file.text("fisheye_model") != "0") return Model::kFisheye;
  return num_coefficients >= 8 ? Model::kRational : Model::kPlumbBob;
}

}  // namespace

const char* distortion_model_name(Model model) {
  constexpr std::array kNames = {"plumb_bob", "rational_polynomial", "equidistant"};
  return kNames.at(static_cast<std::size_t>(model));
}

CameraCalibration load_camera_calibration(const std::filesystem::path& path) {
  const CalibrationFile file(path);
  CameraCalibration calibration;
  calibration.camera_name =
      file.has("camera_name") ? file.text("camera_name") : path.stem().string();
  calibration.width = file.size("image_width");
  calibration.height = file.size("image_height");

  const std::vector<double> K = file.matrix("camera_matrix", {9});
  if (K[3] != 0 || K[6] != 0 || K[7] != 0 || std::abs(K[8] - 1) > 1e-9) {
    file.fail("camera_matrix", "expected [fx, 0, cx, 0, fy, cy, 0, 0, 1]");
  }
  if (K[1] != 0) file.fail("camera_matrix", "a skew is not supported, element 2 must be 0");
  if (std::min(K[0], K[4]) <= 0 || std::max(K[0], K[4]) > kLongestFocalLength_px) {
    file.fail("camera_matrix", "focal lengths must be above 0 and below 1e6 px");
  }
  calibration.fx = K[0];
  calibration.cx = K[2];
  calibration.fy = K[4];
  calibration.cy = K[5];
  if (K[2] <= 0 || K[2] >= calibration.width || K[5] <= 0 || K[5] >= calibration.height) {
    file.fail("camera_matrix",
              "the principal point lies outside the image: is image_width × "
              "image_height the size that was calibrated?");
  }

  calibration.distortion = file.matrix("distortion_coefficients", {0, 1, 4, 5, 8, 12, 14});
  std::vector<double>& distortion = calibration.distortion;
  calibration.model = distortion_model(file, distortion.size());
  for (const double value : distortion) {
    if (std::abs(value) > kLargestDistortion)
      file.fail("distortion_coefficients", "expected numbers within ±1e4");
  }
  const auto is_zero = [](double value) { return value == 0; };
  // OpenCV pads with thin-prism and tilt terms that its plain models leave at 0.
  if (distortion.size() > 8) {
    if (!std::all_of(distortion.begin() + 8, distortion.end(), is_zero)) {
      file.fail("distortion_coefficients",
                "thin-prism and tilt terms are not supported: calibrate "
                "with plumb_bob (5) or rational_polynomial (8)");
    }
    distortion.resize(8);
  }
  if (std::all_of(distortion.begin(), distortion.end(), is_zero) &&
      calibration.model != Model::kFisheye) {
    distortion.clear();
    return calibration;
  }
  const std::size_t n = distortion.size();
  if (calibration.model == Model::kPlumbBob && n != 4 && n != 5) {
    file.fail("distortion_coefficients", "plumb_bob has 4 or 5: k1 k2 p1 p2 [k3]");
  }
  if (calibration.model == Model::kRational && n != 8) {
    file.fail("distortion_coefficients", "rational_polynomial has 8: k1 k2 p1 p2 k3 k4 k5 k6");
  }
  if (calibration.model == Model::kFisheye && n != 4) {
    file.fail("distortion_coefficients", "a fisheye (equidistant) lens has 4: k1 k2 k3 k4");
  }
  return calibration;
}

}  // namespace bodyschema
