#include "common/config/camera_calibration.h"

#include <gtest/gtest.h>

#include <fstream>
#include <opencv2/core.hpp>

#include "common/config/yaml.h"

namespace bodyschema {
namespace {

using Model = CameraCalibration::Model;

std::filesystem::path file_with(const std::string& text) {
  const auto* test = testing::UnitTest::GetInstance()->current_test_info();
  const auto file =
      std::filesystem::path(testing::TempDir()) / (std::string(test->name()) + ".yaml");
  std::ofstream(file) << text;
  return file;
}

std::string ros_file(const std::string& model, const std::string& coefficients, int count) {
  return R"(image_width: 1280
image_height: 960
camera_name: wrist
camera_matrix:
  rows: 3
  cols: 3
  data: [1159.5, 0, 640.25, 0, 1160.5, 480.75, 0, 0, 1]
distortion_model: )" +
         model + "\ndistortion_coefficients:\n  rows: 1\n  cols: " + std::to_string(count) +
         "\n  data: [" + coefficients + R"(]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [1159.5, 0, 640.25, 0, 0, 1160.5, 480.75, 0, 0, 0, 1, 0]
)";
}

std::string what_is_wrong_with(const std::string& text) {
  try {
    load_camera_calibration(file_with(text));
  } catch (const ConfigError& problem) {
    return problem.what();
  }
  return "nothing";
}

TEST(CameraCalibration, ReadsARosFileWithPlumbBobDistortion) {
  const auto calibration =
      load_camera_calibration(file_with(ros_file("plumb_bob", "-0.3, 0.1, 1e-3, -2e-3, 0.01", 5)));
  EXPECT_EQ(calibration.camera_name, "wrist");
  EXPECT_EQ(calibration.width, 1280);
  EXPECT_EQ(calibration.height, 960);
  EXPECT_EQ(calibration.fx, 1159.5);
  EXPECT_EQ(calibration.fy, 1160.5);
  EXPECT_EQ(calibration.cx, 640.25);
  EXPECT_EQ(calibration.cy, 480.75);
  EXPECT_EQ(calibration.model, Model::kPlumbBob);
  EXPECT_EQ(calibration.distortion, (std::vector<double>{-0.3, 0.1, 1e-3, -2e-3, 0.01}));
}

TEST(CameraCalibration, ReadsTheRationalAndTheFisheyeModel) {
  const auto rational =
      load_camera_calibration(file_with(ros_file("rational_polynomial", "1,2,3,4,5,6,7,8", 8)));
  EXPECT_EQ(rational.model, Model::kRational);
  EXPECT_EQ(rational.distortion.size(), 8u);
  for (const char* name : {"equidistant", "fisheye"}) {
    const auto fisheye = load_camera_calibration(file_with(ros_file(name, "0.1,0.2,0.3,0.4", 4)));
    EXPECT_EQ(fisheye.model, Model::kFisheye);
    EXPECT_EQ(fisheye.distortion.size(), 4u);
  }
}

TEST(CameraCalibration, KeepsAFisheyeLensWhoseCoefficientsAreZero) {
  const auto calibration =
      load_camera_calibration(file_with(ros_file("equidistant", "0,0,0,0", 4)));
  EXPECT_EQ(calibration.model, Model::kFisheye);
  EXPECT_EQ(calibration.distortion.size(), 4u);
}

TEST(CameraCalibration, ReadsWhatOpenCvFileStorageWrote) {
  const auto file = file_with("");
  {
    cv::FileStorage storage(file.string(), cv::FileStorage::WRITE);
    storage << "image_width" << 640 << "image_height" << 480;
    storage << "camera_matrix" << (cv::Mat_<double>(3, 3) << 500, 0, 320, 0, 501, 240, 0, 0, 1);
    storage << "distortion_coefficients" << (cv::Mat_<double>(5, 1) << 0.1, 0.2, 0.3, 0.4, 0.5);
  }
  const auto calibration = load_camera_calibration(file);
  EXPECT_EQ(calibration.width, 640);
  EXPECT_EQ(calibration.fy, 501);
  EXPECT_EQ(calibration.model, Model::kPlumbBob);
  EXPECT_EQ(calibration.distortion, (std::vector<double>{0.1, 0.2, 0.3, 0.4, 0.5}));
}

TEST(CameraCalibration, DropsThePaddingOfOpenCvsFourteenCoefficientsAndRefusesItIfUsed) {
  std::string text = ros_file("rational_polynomial", "1,2,3,4,5,6,7,8,0,0,0,0,0,0", 14);
  EXPECT_EQ(load_camera_calibration(file_with(text)).distortion.size(), 8u);
  text = ros_file("rational_polynomial", "1,2,3,4,5,6,7,8,0,0,0,0,0,1", 14);
  EXPECT_NE(what_is_wrong_with(text).find("thin-prism"), std::string::npos);
}

TEST(CameraCalibration, SaysFileLineAndKeyOfWhatIsWrong) {
  EXPECT_NE(
      what_is_wrong_with(ros_file("pincushion", "0,0,0,0,1", 5)).find(".yaml:8: distortion_model"),
      std::string::npos);
  EXPECT_NE(what_is_wrong_with(ros_file("plumb_bob", "1,2,3,4,5,6,7,8", 8)).find("4 or 5"),
            std::string::npos);
  EXPECT_NE(what_is_wrong_with(ros_file("plumb_bob", "1,2,3,4", 5)).find("rows × cols"),
            std::string::npos);
  EXPECT_NE(what_is_wrong_with("image_width: 640\n").find("image_height: this key is missing"),
            std::string::npos);
  EXPECT_NE(what_is_wrong_with("a: [1\n").find(".yaml:"), std::string::npos);
  std::string halved = ros_file("plumb_bob", "0,0,0,0,0", 5);
  halved.replace(halved.find("1280"), 4, "0640");
  EXPECT_NE(what_is_wrong_with(halved).find("principal point lies outside"), std::string::npos);
  EXPECT_THROW(load_camera_calibration("/nowhere/camera.yaml"), ConfigError);
}

}  // namespace
}  // namespace bodyschema
