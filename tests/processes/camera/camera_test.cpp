#include "processes/camera/camera.h"

#include <gtest/gtest.h>

#include <fstream>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>
#include <stdexcept>

#include "common/bus/check.h"
#include "common/bus/images_url.h"
#include "common/config/yaml.h"

namespace bodyschema {
namespace {

CameraConfig config() {
  CameraConfig config;
  config.calibration.camera_name = "test";
  config.calibration.width = 64;
  config.calibration.height = 48;
  config.calibration.fx = config.calibration.fy = 60;
  config.calibration.cx = 32;
  config.calibration.cy = 24;
  config.encoding.format = camera_image_t::ENCODING_GREY;
  config.simulation = SimulationConfig{.frames_per_action = 2};
  return config;
}

sim_state_t state(std::int64_t action_id, std::int64_t utime) {
  sim_state_t state{};
  state.action_id = action_id;
  state.utime = utime;
  return state;
}

TEST(SimulatedCamera, DatesAndNumbersItsFramesByTheState) {
  int num_rendered = 0;
  SimulatedCamera camera(config(), [&](const sim_state_t&, int frame) {
    ++num_rendered;
    return cv::Mat(48, 64, CV_8UC1, cv::Scalar(10 * frame));
  });
  const auto start = camera.on_sim_state(state(-1, 1'000'000));
  ASSERT_EQ(start.size(), 2u);
  EXPECT_EQ(start[0].image_seq, 0);
  EXPECT_EQ(start[1].image_seq, 1);
  const auto images = camera.on_sim_state(state(6, 5'000'000));
  EXPECT_EQ(images[0].utime, 5'000'000);
  EXPECT_EQ(images[1].utime, 5'033'333);
  EXPECT_EQ(images[0].image_seq, 14);
  EXPECT_EQ(images[1].image_seq, 15);
  EXPECT_EQ(images[1].data[0], 10);
  EXPECT_EQ(check(images[0]), "");
  EXPECT_EQ(num_rendered, 4);
}

TEST(SimulatedCamera, SendsTheSameBytesForARepeatedStateWithoutRenderingThemAgain) {
  int num_rendered = 0;
  SimulatedCamera camera(config(), [&](const sim_state_t&, int) {
    return cv::Mat(48, 64, CV_8UC1, cv::Scalar(++num_rendered));
  });
  const auto first = camera.on_sim_state(state(0, 5));
  const auto again = camera.on_sim_state(state(0, 5));
  EXPECT_EQ(first[0].data, again[0].data);
  EXPECT_EQ(first[1].utime, again[1].utime);
  EXPECT_EQ(num_rendered, 2);
  sim_state_t bumped = state(0, 5);
  bumped.X_WC.position_m[0] = 1;
  camera.on_sim_state(bumped);
  EXPECT_EQ(num_rendered, 4);
}

TEST(SimulatedCamera, RefusesAStateOfASimulatorThatWasStartedOtherwise) {
  sim_state_t ideal = state(0, 5), honest = state(0, 5);
  ideal.is_ideal = 1;
  EXPECT_FALSE(ideal_problem(true, ideal));
  EXPECT_FALSE(ideal_problem(false, honest));
  EXPECT_EQ(ideal_problem(true, honest),
            "shows nothing: robot_simulator runs without --ideal, this camera with it; start both "
            "alike");
  EXPECT_EQ(ideal_problem(false, ideal),
            "shows nothing: robot_simulator runs with --ideal, this camera without; start both "
            "alike");
}

TEST(MakeImage, TurnsColourAnd16BitFramesIntoGrey) {
  const CameraConfig c = config();
  const cv::Mat colour(48, 64, CV_8UC3, cv::Scalar(50, 100, 150));  // blue, green, red
  EXPECT_EQ(make_image(colour, c.calibration, c.encoding, 1, 2).data[0],
            std::lround(0.114 * 50 + 0.587 * 100 + 0.299 * 150));
  const cv::Mat deep(48, 64, CV_16UC1, cv::Scalar(257 * 77));
  EXPECT_EQ(make_image(deep, c.calibration, c.encoding, 1, 2).data[0], 77);
}

TEST(MakeImage, EncodesWhatOpenCvDecodes) {
  CameraConfig c = config();
  cv::Mat frame(48, 64, CV_8UC1);
  cv::randu(frame, 0, 255);
  cv::GaussianBlur(frame, frame, {0, 0}, 2);
  for (const std::int8_t format : {camera_image_t::ENCODING_JPEG, camera_image_t::ENCODING_PNG}) {
    c.encoding = {format, 95};
    const camera_image_t image = make_image(frame, c.calibration, c.encoding, 1, 2);
    EXPECT_EQ(check(image), "");
    const cv::Mat decoded = cv::imdecode(image.data, cv::IMREAD_GRAYSCALE);
    EXPECT_LE(cv::norm(frame, decoded, cv::NORM_INF),
              format == camera_image_t::ENCODING_PNG ? 0 : 12);
  }
}

TEST(MakeImage, RefusesAFrameThatIsNotOfTheCalibratedSize) {
  const CameraConfig c = config();
  try {
    make_image(cv::Mat::zeros(96, 128, CV_8UC1), c.calibration, c.encoding, 1, 2);
    FAIL();
  } catch (const std::invalid_argument& problem) {
    EXPECT_NE(std::string(problem.what()).find("128×96"), std::string::npos);
    EXPECT_NE(std::string(problem.what()).find("64×48"), std::string::npos);
  }
  EXPECT_THROW(make_image(cv::Mat(), c.calibration, c.encoding, 1, 2), std::invalid_argument);
}

TEST(MakeInfo, CarriesTheCalibration) {
  CameraConfig c = config();
  c.calibration.model = CameraCalibration::Model::kFisheye;
  c.calibration.distortion = {1, 2, 3, 4};
  const camera_info_t info = make_info(c.calibration, 9);
  EXPECT_EQ(info.utime, 9);
  EXPECT_EQ(info.image_width, 64);
  EXPECT_EQ(info.cx, 32);
  EXPECT_EQ(info.distortion_model, camera_info_t::MODEL_FISHEYE);
  EXPECT_EQ(info.num_coefficients, 4);
  EXPECT_EQ(check(info), "");
}

TEST(CameraConfig, OfEveryShippedRigIsReadable) {
  for (const char* rig : {"arm2", "arm4", "arm6_ends", "arm7"}) {
    EXPECT_NO_THROW(
        CameraConfig::load(std::filesystem::path(BODYSCHEMA_CONFIG) / rig / "camera.yaml"));
  }
}

TEST(CameraConfig, WantsExactlyOneSourceOfTheCalibratedSize) {
  const std::filesystem::path calibration =
      std::filesystem::path(BODYSCHEMA_CONFIG) / "arm2" / "camera_info.yaml";
  const auto file = std::filesystem::path(testing::TempDir()) / "camera_config_test.yaml";
  const auto load = [&](const std::string& source) {
    std::ofstream(file) << "calibration: " << calibration.string() << "\nencoding: png\n" << source;
    return CameraConfig::load(file);
  };
  EXPECT_THROW(load(""), ConfigError);
  EXPECT_THROW(load("capture: {device: a, width_px: 32, height_px: 32, max_rate_hz: 15}"),
               ConfigError);
  const CameraConfig good =
      load("capture: {device: a, width_px: 1280, height_px: 960, max_rate_hz: 15}");
  EXPECT_EQ(good.capture->device, "a");
  EXPECT_FALSE(good.simulation);
}

TEST(ImagesUrl, IsTheNextPortOfTheBus) {
  EXPECT_EQ(images_url("udpm://239.255.76.67:7667?ttl=0"), "udpm://239.255.76.67:7668?ttl=0");
  EXPECT_EQ(images_url("udpm://239.255.76.67:7800"), "udpm://239.255.76.67:7801");
  EXPECT_EQ(images_url("udpm://239.255.76.67?ttl=1"), "udpm://239.255.76.67:7668?ttl=1");
  EXPECT_EQ(images_url("tcpq://host:7700"), "tcpq://host:7701");
  EXPECT_EQ(images_url("memq://"), "memq://");
  EXPECT_EQ(images_url("file:///a:b.lcmlog?speed=0"), "file:///a:b.lcmlog?speed=0");
  EXPECT_EQ(images_url(""), "");
  EXPECT_THROW(images_url("udpm://239.255.76.67:65535"), std::runtime_error);
  EXPECT_THROW(images_url("udpm://239.255.76.67:x"), std::runtime_error);
}

}  // namespace
}  // namespace bodyschema
