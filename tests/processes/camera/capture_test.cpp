#include "processes/camera/capture.h"

#include <arpa/inet.h>
#include <gtest/gtest.h>
#include <netinet/in.h>
#include <sys/socket.h>
#include <unistd.h>

#include <atomic>
#include <chrono>
#include <filesystem>
#include <fstream>
#include <mutex>
#include <opencv2/imgcodecs.hpp>
#include <optional>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

namespace bodyschema {
namespace {

/// Asks until `question` returns true, for at most 10 s.
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
    throw std::runtime_error("the network is gone");
  });
  EXPECT_TRUE(eventually([&] {
    try {
      capture.check();
      return false;
    } catch (const std::runtime_error&) {
      return true;
    }
  }));
}

TEST(Capture, AFrameThatIsRefusedDoesNotEndIt) {
  int num = 0;
  Capture capture({sequence_of(5), 64, 48, 200}, [&](const cv::Mat&, std::int64_t) {
    if (++num % 2 == 1) throw std::invalid_argument("the frame has the wrong size");
  });
  ASSERT_TRUE(eventually([&] { return capture.state().phase == Capture::Phase::kEnded; }));
  EXPECT_EQ(capture.state().num_refused, 3);
  EXPECT_EQ(capture.state().num_frames, 2);
  EXPECT_NO_THROW(capture.check());
}

/// An IP camera: an MJPEG stream over HTTP that can be unplugged. Grey level 10 n in the n-th
/// frame.
class IpCamera {
 public:
  IpCamera() { plug_in(0); }
  ~IpCamera() { unplug(); }

  std::string url() const { return "http://127.0.0.1:" + std::to_string(port_) + "/video.mjpg"; }
  /// The connection is cut and nobody answers any more.
  void unplug() {
    is_plugged_ = false;
    ::shutdown(listener_, SHUT_RDWR);
    server_.join();
    ::close(listener_);
  }
  /// On the port that it had; 0: a free one.
  void plug_in(int port) {
    listener_ = ::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
    const int yes = 1;
    ::setsockopt(listener_, SOL_SOCKET, SO_REUSEADDR, &yes, sizeof yes);
    sockaddr_in address{};
    address.sin_family = AF_INET;
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    address.sin_port = htons(static_cast<std::uint16_t>(port));
    socklen_t size = sizeof address;
    if (::bind(listener_, reinterpret_cast<sockaddr*>(&address), size) != 0 ||
        ::listen(listener_, 4) != 0 ||
        ::getsockname(listener_, reinterpret_cast<sockaddr*>(&address), &size) != 0) {
      throw std::runtime_error("no port for the camera");
    }
    port_ = ntohs(address.sin_port);
    is_plugged_ = true;
    server_ = std::thread([this] { serve(); });
  }
  int port() const { return port_; }

 private:
  void serve() {
    while (is_plugged_) {
      const int client = ::accept4(listener_, nullptr, nullptr, SOCK_CLOEXEC);
      if (client < 0) return;
      const auto send = [&](const std::string& text) {
        return ::send(client, text.data(), text.size(), MSG_NOSIGNAL) ==
               static_cast<ssize_t>(text.size());
      };
      bool is_connected = send(
          "HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=frame\r\n\r\n");
      for (int n = 0; is_connected && is_plugged_; ++n) {
        std::vector<unsigned char> jpeg;
        cv::imencode(".jpg", cv::Mat(48, 64, CV_8UC1, cv::Scalar(10 * (n % 20))), jpeg);
        is_connected = send("--frame\r\nContent-Type: image/jpeg\r\nContent-Length: " +
                            std::to_string(jpeg.size()) + "\r\n\r\n" +
                            std::string(jpeg.begin(), jpeg.end()) + "\r\n");
        std::this_thread::sleep_for(std::chrono::milliseconds(10));  // 100 Hz
      }
      ::close(client);
    }
  }

  int listener_ = -1;
  int port_ = 0;
  std::atomic<bool> is_plugged_ = false;
  std::thread server_;
};

TEST(Capture, ACameraThatIsUnpluggedIsLostAndComesBack) {
  IpCamera camera;
  std::optional<Capture> capture;
  try {
    capture.emplace(CaptureConfig{camera.url(), 64, 48, 100},
                    [](const cv::Mat& frame, std::int64_t) { ASSERT_EQ(frame.cols, 64); });
  } catch (const std::runtime_error& problem) {
    GTEST_SKIP() << "this OpenCV reads no stream: " << problem.what();
  }
  ASSERT_TRUE(eventually([&] { return capture->state().num_frames > 5; }));
  EXPECT_EQ(capture->state().phase, Capture::Phase::kRunning);
  for (int round = 1; round <= 2; ++round) {
    camera.unplug();
    ASSERT_TRUE(eventually([&] { return capture->state().phase == Capture::Phase::kLost; }));
    EXPECT_NE(capture->state().text.find("lost: tries again"), std::string::npos);
    EXPECT_EQ(capture->state().num_losses, round);
    const auto num_frames = capture->state().num_frames;
    camera.plug_in(camera.port());
    ASSERT_TRUE(eventually([&] { return capture->state().num_frames > num_frames + 5; }))
        << capture->state().text;
    EXPECT_EQ(capture->state().phase, Capture::Phase::kRunning);
    EXPECT_NO_THROW(capture->check());
  }
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
