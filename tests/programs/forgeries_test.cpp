// Forged messages that agree with the rig, and their effect on the programs. Runs
// in tests/private_bus.sh.

#include <gtest/gtest.h>
#include <signal.h>

#include <chrono>
#include <filesystem>
#include <fstream>
#include <limits>
#include <string>
#include <vector>

#include "common/bus/convert.h"
#include "common/bus/event_log.h"
#include "common/config/camera_calibration.h"
#include "tests/common/bus/bus_test_support.h"

namespace bodyschema::test {
namespace {

const char* const kUrl = "udpm://239.255.76.67:7667?ttl=0";
const std::filesystem::path kBin = BODYSCHEMA_BIN_FOLDER;
const std::filesystem::path kRig = std::filesystem::path(BODYSCHEMA_CONFIG) / "arm2";

class Forgeries : public testing::Test {
 protected:
  Forgeries() : bus_(kUrl, kUrl) {
    bus_.subscribe(kProcessInfo, [this](const process_info_t& m) { info_ = m; });
    bus_.subscribe(kControlStatus, [this](const control_status_t& m) { control_ = m; });
  }
  static std::vector<std::string> program(const std::string& name,
                                          const std::vector<std::string>& more) {
    std::vector<std::string> arguments = {(kBin / name).string(), "--config",
                                          (kRig / (name + ".yaml")).string(), "--in", kUrl};
    arguments.insert(arguments.end(), more.begin(), more.end());
    return arguments;
  }
  /// Sends by `send` until the process's PROCESS_INFO is as wanted.
  template <class Send, class IsWanted>
  bool send_until(Send send, IsWanted is_wanted) {
    return ask_until(
        [&] {
          send();
          bus_.handle(std::chrono::milliseconds(50));
        },
        is_wanted);
  }
  std::int64_t counter(const std::string& name) const {
    for (const counter_t& counter : info_.counters) {
      if (counter.counter_name == name) return counter.count;
    }
    return 0;
  }
  bool says(const std::string& text) const {
    return info_.activity.find(text) != std::string::npos;
  }

  TemporaryFolder folder_;
  Bus bus_;
  process_info_t info_{};
  control_status_t control_{};
};

TEST_F(Forgeries, AnotherCalibrationIsRefusedAndBothValuesAreSaid) {
  const CameraCalibration calibration = load_camera_calibration(kRig / "camera_info.yaml");
  camera_info_t info{};
  info.camera_name = calibration.camera_name;
  info.image_width = calibration.width;
  info.image_height = calibration.height;
  info.fx = 1159.1;
  info.fy = calibration.fy;
  info.cx = calibration.cx;
  info.cy = calibration.cy;
  for (const char* name : {"observer", "marker_estimator"}) {
    info_ = {};
    Program process(program(name, {}));
    info.fx = 1159.1;
    const auto send = [&] { bus_.publish(kCameraInfo, info); };
    ASSERT_TRUE(send_until(
        send,
        [&] {
          return says(
                     "CAMERA_INFO refused: fx 1159.1 px, the rig's camera_info.yaml says 1104.6") &&
                 says("waits for CAMERA_INFO");
        }))
        << name << ": " << info_.activity;
    EXPECT_GT(counter("refused CAMERA_INFO"), 0);
    info.fx = calibration.fx;
    EXPECT_TRUE(send_until(send, [&] { return !info_.activity.empty() && !says("CAMERA_INFO"); }))
        << name << ": " << info_.activity;
    process.send_signal(SIGTERM);
    EXPECT_EQ(process.wait(), 0);
    EXPECT_NE(process.err().find("fx 1159.1 px"), std::string::npos) << process.err();
  }
}

TEST_F(Forgeries, ATargetFromTheFarFutureBlocksNoOtherNotEvenOneThatWasKept) {
  const std::string state = (folder_ / "controller_state.yaml").string();
  pose_target_t target{};
  target.target_kind = pose_target_t::KIND_HOLD;
  target.target_part = -1;
  target.keep_s = -1;
  const auto send = [&] { bus_.publish(kPoseTarget, target); };
  const auto forge = [&] {
    target.sender = "stranger";
    target.epoch = std::numeric_limits<std::int64_t>::max();
    send();
  };
  const auto give = [&] {
    target.sender = "console";
    target.epoch = 1'700'000'000'000'000;
    send();
  };
  // As one of before kept it.
  std::ofstream(state) << "epoch: -1\nnext_action_id: 0\n"
                          "target: {sender: stranger, epoch: 9223372036854775807, target_id: 7}\n"
                          "was_served: true\nowns_arm: true\nholds: true\nwhy: hold\n";
  Program controller(program("controller", {"--state", state}));
  ASSERT_TRUE(send_until(forge, [&] { return says("POSE_TARGET of stranger refused"); }))
      << info_.activity << controller.err();
  EXPECT_GT(counter("POSE_TARGET from a clock ahead"), 0);
  ASSERT_TRUE(send_until(give, [&] { return control_.sender == "console"; }));
  EXPECT_EQ(control_.target_epoch, 1'700'000'000'000'000);
  controller.send_signal(SIGTERM);
  EXPECT_EQ(controller.wait(), 0);
}

TEST_F(Forgeries, ASampleThatTheObserverDidNotWriteIsNotLearned) {
  const std::filesystem::path file = folder_ / "samples.lcmlog";
  sample_t sample{};
  sample.source = "motor_babbler";
  sample.epoch = 5;
  set_array(sample.num_signals, sample.action, {0.1, 0.2});
  LogAppender log(file);
  log.append(kSample, sample);
  Program learner(program("structure_learner", {"--samples", file.string()}));
  sample_t forged = sample;
  forged.epoch = 77;
  const auto forge = [&] {
    for (const std::int64_t index : {1, 2, 1'000'000}) {
      forged.sample_index = index;
      bus_.publish(kSample, forged);
    }
  };
  ASSERT_TRUE(send_until(forge, [&] { return counter("unrecorded SAMPLE") > 0; })) << learner.err();
  EXPECT_FALSE(says("waits for SAMPLE")) << info_.activity;
  sample.sample_index = 1;
  sample.action_id = 1;
  log.append(kSample, sample);
  EXPECT_TRUE(
      send_until([&] { bus_.publish(kSample, sample); }, [&] { return says("2 samples learned"); }))
      << info_.activity;
  EXPECT_EQ(counter("conflicting SAMPLE"), 0);
  learner.send_signal(SIGTERM);
  EXPECT_EQ(learner.wait(), 0);
}

}  // namespace
}  // namespace bodyschema::test
