#include "processes/camera/capture.h"

#include <gtest/gtest.h>

#include <atomic>
#include <chrono>
#include <filesystem>
#include <fstream>
#include <mutex>
#include <opencv2/imgcodecs.hpp>
#include <stdexcept>
#include <vector>

namespace bodyschema {
namespace {

/// Asks until `question` is answered with yes, for at most 10 s.
template <class Question>
bool eventually(const Question& question) {
  const auto end = std::chrono::steady_clock::now() + std::chrono::seconds(10);
  while (std::chrono::steady_clock::now() < end) {
    if (question()) return true;
    std::this_thread::yield();
  }
  return false;
}

std::filesystem::path sequence_of(int num_images) {
  const auto* test = testing::UnitTest::GetInstance()->current_test_info();
  const auto folder = std::filesystem::path(testing::TempDir()) / test->name();
  std::filesystem::remove_all(folder);
  std::filesystem::create_directories(folder);
  for (int i = 0; i < num_images; ++i) {
    cv::imwrite(folder / ("frame" + std::to_string(1000 + i).substr(1) + ".png"),
                cv::Mat(48, 64, CV_8UC1, cv::Scalar(10 * i)));
  }
  return folder / "frame%03d.png";
}

TEST(Capture, ReadsAnImageSequenceInOrderToItsEnd) {
  std::mutex mutex;
  std::vector<int> greys;
  std::vector<std::int64_t> utimes;
  Capture capture({sequence_of(5), 64, 48, 200}, [&](const cv::Mat& frame, std::int64_t utime) {
    const std::lock_guard lock(mutex);
    greys.push_back(frame.data[0]);
    utimes.push_back(utime);
  });
  ASSERT_TRUE(eventually([&] { return capture.state().phase == Capture::Phase::kEnded; }));
  EXPECT_NE(capture.state().text.find("video ended"), std::string::npos);
  EXPECT_EQ(capture.state().num_frames, 5);
  EXPECT_EQ(greys, (std::vector<int>{0, 10, 20, 30, 40}));
  EXPECT_TRUE(std::is_sorted(utimes.begin(), utimes.end()));
  EXPECT_NO_THROW(capture.check());
}

TEST(Capture, HandsOnWhatTheFramesReceiverThrew) {
  Capture capture({sequence_of(3), 64, 48, 200}, [](const cv::Mat&, std::int64_t) {
    throw std::invalid_argument("the frame has the wrong size");
  });
  EXPECT_TRUE(eventually([&] {
    try {
      capture.check();
      return false;
    } catch (const std::invalid_argument&) {
      return true;
    }
  }));
}

TEST(Capture, EndsAtOnceWhileItWaitsForTheNextFrame) {
  std::atomic<int> num_frames = 0;
  const auto begin = std::chrono::steady_clock::now();
  {
    Capture capture({sequence_of(3), 64, 48, 0.1},
                    [&](const cv::Mat&, std::int64_t) { ++num_frames; });
    EXPECT_TRUE(eventually([&] { return num_frames > 0; }));
  }
  EXPECT_LT(std::chrono::steady_clock::now() - begin, std::chrono::seconds(5));
}

TEST(Capture, SaysWhyASourceCannotBeOpened) {
  const auto why = [](const std::string& device) {
    try {
      Capture capture({device, 64, 48, 30}, [](const cv::Mat&, std::int64_t) {});
    } catch (const std::runtime_error& problem) {
      return std::string(problem.what());
    }
    return std::string("opened");
  };
  EXPECT_NE(why("/dev/video97").find("no such device"), std::string::npos);
  EXPECT_NE(why("97").find("no such device"), std::string::npos);
  EXPECT_NE(why("/nowhere/film.mp4").find("no such file"), std::string::npos);
  EXPECT_NE(why("/nowhere/%04d.png").find("no first image"), std::string::npos);
  const auto text = std::filesystem::path(testing::TempDir()) / "no_film.mp4";
  std::ofstream(text) << "this is no film";
  EXPECT_NE(why(text).find("codec"), std::string::npos);
}

TEST(Capture, KnowsWhatKindOfSourceANameMeans) {
  EXPECT_EQ(kind_of("0"), SourceKind::kDevice);
  EXPECT_EQ(kind_of("/dev/video2"), SourceKind::kDevice);
  EXPECT_EQ(kind_of("rtsp://camera/stream"), SourceKind::kStream);
  EXPECT_EQ(kind_of("frames/%04d.png"), SourceKind::kSequence);
  EXPECT_EQ(kind_of("film.mp4"), SourceKind::kFile);
}

}  // namespace
}  // namespace bodyschema
