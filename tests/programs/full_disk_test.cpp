// Programs that write files, on a full disk. Runs in tests/private_bus.sh and
// tiny_disk.sh.

#include <gtest/gtest.h>
#include <signal.h>

#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <map>
#include <string>
#include <vector>

#include "common/bus/convert.h"
#include "common/bus/event_log.h"
#include "tests/common/bus/bus_test_support.h"

namespace bodyschema::test {
namespace {

const char* const kUrl = "udpm://239.255.76.67:7667?ttl=0";
const std::filesystem::path kBin = BODYSCHEMA_BIN_FOLDER;
const std::filesystem::path kRig = std::filesystem::path(BODYSCHEMA_CONFIG) / "arm2";

class FullDisk : public testing::Test {
 protected:
  FullDisk() : disk_(std::getenv("TINY_DISK") ? std::getenv("TINY_DISK") : ""), bus_(kUrl, kUrl) {
    bus_.subscribe(kSample, [this](const sample_t& m) { ++heard_[m.sample_index]; });
    bus_.subscribe(kActionCommand, [this](const action_command_t& m) { commands_.push_back(m); });
    bus_.subscribe(kControlStatus, [this](const control_status_t& m) { control_ = m; });
    bus_.subscribe(kProcessInfo, [this](const process_info_t& m) { info_ = m; });
  }
  void SetUp() override { ASSERT_FALSE(disk_.empty()) << "runs in tests/programs/tiny_disk.sh"; }
  ~FullDisk() override {
    for (const auto& entry : std::filesystem::directory_iterator(disk_)) {
      std::filesystem::remove_all(entry);
    }
  }

  std::vector<std::string> program(const std::string& name, std::vector<std::string> more) const {
    std::vector<std::string> arguments = {(kBin / name).string(), "--config",
                                          (kRig / (name + ".yaml")).string(), "--in", kUrl};
    arguments.insert(arguments.end(), more.begin(), more.end());
    return arguments;
  }
  void fill_disk() const {
    // Until the last byte: page by page, then the rest of a page.
    std::ofstream filler(disk_ / "filler", std::ios::binary | std::ios::app);
    while (filler.write("x", 1).flush()) {
    }
  }
  void free_disk() const { std::filesystem::remove(disk_ / "filler"); }

  /// A settled action of the arm2 without visible parts, published once more.
  void act(std::int64_t id) {
    camera_info_t info{};
    info.camera_name = "arm2_camera";
    info.image_width = 1280;
    info.image_height = 960;
    info.fx = 1104.6;  // as in the rig's camera_info.yaml
    info.fy = 1098.9;
    info.cx = 645.2;
    info.cy = 470.8;
    bus_.publish(kCameraInfo, info);
    const std::int64_t begin = 1'000'000 * (id + 1);
    motion_status_t status{};
    status.utime = begin + 100'000;
    status.source = "test";
    status.epoch = 1;
    status.action_id = id;
    status.kind = action_command_t::KIND_MOVE;
    status.state = motion_status_t::STATE_SETTLED;
    status.rest_since_utime = begin;
    set_array(status.num_signals, status.commanded, {0.1, 0.2});
    bus_.publish(kMotionStatus, status);
    for (int frame = 0; frame < 2; ++frame) {
      marker_poses_t poses{};
      poses.utime = begin + 33'333 * frame;
      poses.image_seq = 2 * id + frame;
      poses.camera_name = "arm2_camera";
      bus_.publish(kMarkerPoses, poses);
    }
    bus_.handle(std::chrono::milliseconds(50));
  }
  bool act_until_heard(std::int64_t id) {
    return ask_until([&] { act(id); }, [&] { return heard_[id] > 0; });
  }
  bool says(const std::string& text) {
    return handle_until(bus_, [&] { return info_.activity.find(text) != std::string::npos; });
  }
  /// An arm2 that rests since its driver began.
  void rest() {
    motion_status_t status{};
    status.utime = status.rest_since_utime = 1'000'000;
    status.action_id = -1;
    set_array(status.num_signals, status.commanded, {0.1, 0.2});
    bus_.publish(kMotionStatus, status);
    bus_.handle(std::chrono::milliseconds(50));
  }
  std::int64_t counter(const std::string& name) const {
    for (const counter_t& counter : info_.counters) {
      if (counter.counter_name == name) return counter.count;
    }
    return 0;
  }

  const std::filesystem::path disk_;
  Bus bus_;
  std::map<std::int64_t, int> heard_;
  std::vector<action_command_t> commands_;
  control_status_t control_{};
  process_info_t info_{};
};

TEST_F(FullDisk, ASampleThatCannotBeWrittenIsHeldBackUntilItCan) {
  const auto file = disk_ / "samples.lcmlog";
  Program observer(program("observer", {"--samples", file.string()}));
  ASSERT_TRUE(act_until_heard(0)) << observer.err();
  fill_disk();
  // The page that the log ends in still takes some samples.
  std::int64_t next = 1;
  ASSERT_TRUE(ask_until([&] { act(next); },
                        [&] {
                          if (heard_[next] > 0) ++next;
                          return info_.activity.find("held back") != std::string::npos;
                        }))
      << info_.activity;
  EXPECT_NE(info_.activity.find("No space left"), std::string::npos) << info_.activity;
  ASSERT_TRUE(handle_until(bus_, [&] { return counter("held SAMPLE") > 0; }));
  // The newest sample on disk is still repeated, the unwritten one is not sent.
  heard_.clear();
  ASSERT_TRUE(handle_until(bus_, [&] { return heard_[next - 1] >= 2; }));
  EXPECT_EQ(heard_[next], 0);
  act(next + 1);

  free_disk();
  ASSERT_TRUE(act_until_heard(next)) << observer.err();
  ASSERT_TRUE(act_until_heard(next + 1));
  ASSERT_TRUE(
      handle_until(bus_, [&] { return info_.activity.find("held back") == std::string::npos; }));
  observer.send_signal(SIGTERM);
  EXPECT_EQ(observer.wait(), 0);
  const auto samples = read_log(file, kSample);
  ASSERT_EQ(samples.size(), static_cast<std::size_t>(next + 2));
  for (std::size_t i = 0; i < samples.size(); ++i) {
    EXPECT_EQ(samples[i].sample_index, static_cast<std::int64_t>(i));
    EXPECT_EQ(samples[i].action_id, static_cast<std::int64_t>(i));
  }
}

TEST_F(FullDisk, TheMonitorSaysThatItCannotSaveAndSavesWhenItCan) {
  fill_disk();
  Program monitor(program("model_monitor", {"--schema", (disk_ / "schema.lcmlog").string()}));
  ASSERT_TRUE(says("cannot save")) << info_.activity;
  EXPECT_FALSE(std::filesystem::exists(disk_ / "history.lcmlog"));
  free_disk();
  ASSERT_TRUE(says("waiting for LEARNED_SCHEMA")) << info_.activity;
  EXPECT_EQ(read_log(disk_ / "history.lcmlog", kModelHealth).size(), 2U);
  monitor.send_signal(SIGTERM);
  EXPECT_EQ(monitor.wait(), 0);
}

TEST_F(FullDisk, TheControllerHoldsAllTheSame) {
  fill_disk();
  const auto file = disk_ / "controller_state.yaml";
  Program controller(program("controller", {"--state", file.string()}));
  pose_target_t target{};
  target.sender = "test";
  target.target_kind = pose_target_t::KIND_HOLD;
  target.target_part = -1;
  target.keep_s = -1;
  ASSERT_TRUE(ask_until(
      [&] {
        bus_.publish(kPoseTarget, target);
        rest();
      },
      [&] { return control_.control_state == control_status_t::CONTROL_HOLDING; }))
      << controller.err();
  EXPECT_EQ(control_.owns_arm, 1);
  ASSERT_TRUE(handle_until(bus_, [&] { return !commands_.empty(); }));
  EXPECT_EQ(commands_.front().kind, action_command_t::KIND_HOLD);
  ASSERT_TRUE(says("not saved")) << info_.activity;
  EXPECT_NE(info_.activity.find("No space left"), std::string::npos) << info_.activity;
  ASSERT_TRUE(handle_until(bus_, [&] { return counter("state not saved") > 0; }));
  free_disk();
  ASSERT_TRUE(handle_until(bus_, [&] {
    return info_.activity.find("not saved") == std::string::npos;
  })) << info_.activity;
  EXPECT_TRUE(std::filesystem::exists(file));
  controller.send_signal(SIGTERM);
  EXPECT_EQ(controller.wait(), 0);
}

TEST_F(FullDisk, TheBabblerMovesNothingBeforeItsStateIsSaved) {
  fill_disk();
  const auto file = disk_ / "babbler_state.yaml";
  Program babbler(program("motor_babbler", {"--state", file.string()}));
  ASSERT_TRUE(ask_until([&] { rest(); },
                        [&] { return info_.activity.find("not saved") != std::string::npos; }))
      << babbler.err();
  // Longer than it waits before it sends a command again.
  const std::int64_t begin_utime = info_.utime;
  ASSERT_TRUE(handle_until(bus_, [&] { return info_.utime > begin_utime + 2'500'000; }));
  EXPECT_TRUE(commands_.empty());
  free_disk();
  ASSERT_TRUE(handle_until(bus_, [&] { return !commands_.empty(); })) << info_.activity;
  EXPECT_EQ(commands_.front().action_id, 0);
  EXPECT_TRUE(std::filesystem::exists(file));
  babbler.send_signal(SIGTERM);
  EXPECT_EQ(babbler.wait(), 0);
}

}  // namespace
}  // namespace bodyschema::test
