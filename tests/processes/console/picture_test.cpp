#include "processes/console/picture.h"

#include <gtest/gtest.h>
#include <unistd.h>

#include <filesystem>
#include <opencv2/imgcodecs.hpp>

#include "common/bus/convert.h"

namespace bodyschema {
namespace {

class PictureTest : public testing::Test {
 protected:
  PictureTest() {
    const auto* test = testing::UnitTest::GetInstance()->current_test_info();
    png_ = std::filesystem::path(testing::TempDir()) /
           (std::to_string(getpid()) + test->name() + ".png");
    image_.width = 200;
    image_.height = 100;
    image_.encoding = camera_image_t::ENCODING_GREY;
    image_.data.assign(200 * 100, 128);
    image_.num_bytes = 200 * 100;
    camera_.fx = camera_.fy = 100;
    camera_.cx = 100;
    camera_.cy = 50;
  }
  ~PictureTest() override { std::filesystem::remove(png_); }

  static cv::Mat drawn(const camera_image_t& image, const marker_poses_t& markers,
                       const camera_info_t& camera) {
    const std::string png = draw_detections(image, markers, camera, ".png");
    return cv::imdecode(std::vector<char>(png.begin(), png.end()), cv::IMREAD_COLOR);
  }
  /// A marker of 0.4 m straight before the camera at 2 m: 20 px wide.
  static marker_pose_t marker() {
    marker_pose_t marker{};
    marker.marker_id = 7;
    marker.size_m = 0.4;
    const double corners[4][2] = {{90, 40}, {110, 40}, {110, 60}, {90, 60}};
    std::copy(&corners[0][0], &corners[0][0] + 8, &marker.corner_px[0][0]);
    Pose X_CM = Pose::Identity();
    X_CM.translation().z() = 2;
    marker.X_CM[0] = marker.X_CM[1] = to_message(X_CM);
    return marker;
  }

  std::filesystem::path png_;
  camera_image_t image_{};
  camera_info_t camera_{};
};

TEST_F(PictureTest, AMarkersOutlineAndItsXAndYAxesStandWhereTheyShould) {
  marker_poses_t markers{};
  set_array(markers.num_markers, markers.markers, {marker()});
  const cv::Mat picture = drawn(image_, markers, camera_);
  ASSERT_EQ(picture.cols, 200);
  ASSERT_EQ(picture.rows, 100);
  const auto at = [&](int x, int y) { return picture.at<cv::Vec3b>(y, x); };
  EXPECT_EQ(at(20, 20), cv::Vec3b(128, 128, 128));
  EXPECT_GT(at(106, 50)[2], at(106, 50)[1] + 50);   // x to the right, red
  EXPECT_GT(at(100, 56)[1], at(100, 56)[2] + 50);   // y down, green
  EXPECT_GT(at(110, 45)[2], at(110, 45)[0] + 100);  // outline, yellow
  EXPECT_GT(at(95, 60)[2], at(95, 60)[0] + 100);
}

TEST_F(PictureTest, EveryEncodingAndLensIsDrawn) {
  marker_poses_t markers{};
  set_array(markers.num_markers, markers.markers, {marker()});
  const cv::Mat grey(100, 200, CV_8U, image_.data.data());
  for (const auto& [encoding, extension] :
       {std::pair{camera_image_t::ENCODING_JPEG, ".jpg"}, {camera_image_t::ENCODING_PNG, ".png"}}) {
    camera_image_t encoded = image_;
    encoded.encoding = encoding;
    ASSERT_TRUE(cv::imencode(extension, grey, encoded.data));
    encoded.num_bytes = static_cast<std::int32_t>(encoded.data.size());
    for (const auto& [model, count] : {std::pair{camera_info_t::MODEL_PLUMB_BOB, 5},
                                       {camera_info_t::MODEL_RATIONAL, 8},
                                       {camera_info_t::MODEL_FISHEYE, 4}}) {
      camera_info_t camera = camera_;
      camera.distortion_model = model;
      set_array(camera.num_coefficients, camera.distortion, std::vector<double>(count, 0.001));
      EXPECT_FALSE(drawn(encoded, markers, camera).empty());
    }
  }
}

// OpenCV wants coefficients of a fisheye lens even where there is no distortion.
TEST_F(PictureTest, ALensWithoutCoefficientsIsDrawnToo) {
  marker_poses_t markers{};
  set_array(markers.num_markers, markers.markers, {marker()});
  for (const auto model : {camera_info_t::MODEL_PLUMB_BOB, camera_info_t::MODEL_FISHEYE}) {
    camera_info_t camera = camera_;
    camera.distortion_model = model;
    EXPECT_FALSE(drawn(image_, markers, camera).empty()) << int(model);
  }
}

TEST_F(PictureTest, AnImageThatCannotBeDecodedIsAnErrorAndNothingIsWritten) {
  image_.encoding = camera_image_t::ENCODING_JPEG;
  EXPECT_THROW(draw_detections(image_, {}, camera_, ".png"), std::runtime_error);
  BestPicture best;
  best.on_info(camera_);
  best.on_image(image_);
  marker_poses_t markers{};
  markers.utime = image_.utime;
  set_array(markers.num_markers, markers.markers, {marker()});
  best.on_markers(markers);
  EXPECT_THROW(best.write(png_), std::runtime_error);
  EXPECT_FALSE(std::filesystem::exists(png_));
}

TEST_F(PictureTest, TheFrameWithTheMostMarkersIsKeptOnceItsImageCame) {
  BestPicture best;
  best.on_info(camera_);
  best.on_image(image_);
  EXPECT_FALSE(best.write(png_));
  marker_poses_t markers{};
  markers.utime = image_.utime + 1;
  set_array(markers.num_markers, markers.markers, {marker()});
  best.on_markers(markers);
  EXPECT_FALSE(best.write(png_));  // of another frame
  markers.utime = image_.utime;
  best.on_markers(markers);
  set_array(markers.num_markers, markers.markers, {});
  best.on_markers(markers);  // the same frame with fewer
  EXPECT_TRUE(best.write(png_));
  EXPECT_GT(cv::imread(png_.string()).at<cv::Vec3b>(50, 106)[2], 178);  // the marker's x axis, red
}

}  // namespace
}  // namespace bodyschema
