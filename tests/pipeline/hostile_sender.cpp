// hostile_sender: every kind of foreign and broken message, on every channel, until FILE
// exists: bytes that are no message, cut, lengthened and of other types, counts beyond reason, NaN,
// nonsense, and recorded messages of another rig's group.
//
//   hostile_sender FOREIGN_RUN_FOLDER --until FILE
//
// Not sent are forgeries of the rig's own messages, such as a STOP, which any sender may send.

#include <lcm/lcm.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <filesystem>
#include <limits>
#include <map>
#include <memory>
#include <random>
#include <set>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "common/bus/bus.h"
#include "common/bus/event_log.h"
#include "common/bus/images_url.h"
#include "tests/lcmtypes/example_messages.h"

using namespace bodyschema;

namespace {

using Bytes = std::vector<std::uint8_t>;

struct Hostile {
  std::string channel;
  Bytes bytes;
};

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();

/// Without check(), as a careful sender never does.
template <class Message>
Bytes bytes_of(const Message& message) {
  Bytes bytes(static_cast<std::size_t>(message.getEncodedSize()));
  message.encode(bytes.data(), 0, static_cast<int>(bytes.size()));
  return bytes;
}

void add_garbage(std::vector<Hostile>& all, std::mt19937_64& random) {
  std::vector<Bytes> types;
  test::for_each_channel(
      [&](const auto&, const auto& message) { types.push_back(bytes_of(message)); });
  test::for_each_channel([&](const auto& channel, const auto& message) {
    const Bytes good = bytes_of(message);
    const std::string name = channel.name;
    all.push_back({name, {}});
    all.push_back({name, {good.begin(), good.begin() + 8}});
    for (int n = 0; n < 5; ++n) {
      const auto size = static_cast<std::ptrdiff_t>(random() % good.size());
      all.push_back({name, {good.begin(), good.begin() + size}});
    }
    Bytes longer = good;
    longer.resize(good.size() + 1 + random() % 1000, 0x55);
    all.push_back({name, longer});
    Bytes counts(good.begin(), good.begin() + 8);
    counts.resize(64, 0x7F);
    all.push_back({name, counts});
    Bytes noise(20'000);
    for (std::uint8_t& byte : noise) byte = static_cast<std::uint8_t>(random());
    all.push_back({name, noise});
    Bytes older = good;  // as a program built from other message definitions sends it
    older[7] ^= 1;
    all.push_back({name, older});
    for (const Bytes& other : types) {
      if (!std::equal(other.begin(), other.begin() + 8, good.begin())) all.push_back({name, other});
    }
  });
}

void add_nonsense(std::vector<Hostile>& all) {
  const auto add = [&](const auto& channel, auto message, const auto& spoil) {
    spoil(message);
    all.push_back({channel.name, bytes_of(message)});
  };
  using namespace test;
  add(kActionCommand, example_action_command(), [](auto& m) { m.kind = 77; });
  add(kMotionStatus, example_motion_status(), [](auto& m) { m.commanded.at(0) = kNan; });
  add(kMotionStatus, example_motion_status(), [](auto& m) { m.utime = -5; });
  add(kSimState, example_sim_state(), [](auto& m) { m.X_WC.position_m[0] = kNan; });
  add(kCameraInfo, example_camera_info(), [](auto& m) { m.fx = kNan; });
  add(kCameraInfo, example_camera_info(), [](auto& m) { m.image_width = 1 << 30; });
  add(kMarkerPoses, example_marker_poses(), [](auto& m) { m.markers.at(0).size_m = kNan; });
  add(kMarkerPoses, example_marker_poses(), [](auto& m) { m.markers.at(0).marker_id = -3; });
  add(kSample, example_sample(), [](auto& m) { m.parts.at(0).covariance[2] = -1; });
  add(kSample, example_sample(), [](auto& m) { m.action.at(0) = kNan; });
  add(kSample, example_sample(), [](auto& m) { m.sample_index = -9; });
  add(kSampleRequest, example_sample_request(), [](auto& m) { m.last_missing = -1; });
  add(kSampleRequest, example_sample_request(), [](auto& m) {
    m.first_missing = 0;
    m.last_missing = std::numeric_limits<std::int64_t>::max();
  });
  add(kLearnedSchema, example_body_schema(), [](auto& m) { m.root_part = 4711; });
  add(kLearnedSchema, example_body_schema(), [](auto& m) { m.X_CR.rotation_wxyz[0] = 9; });
  add(kRefinedSchema, example_body_schema(), [](auto& m) { m.X_CR.position_m[1] = kNan; });
  add(kBodySchema, example_body_schema(), [](auto& m) { m.noise_position_m = kNan; });
  add(kModelHealth, example_model_health(), [](auto& m) { m.part_health.at(0).visibility = kNan; });
  add(kPoseTarget, example_pose_target(), [](auto& m) { m.position_m[2] = kNan; });
  add(kControlStatus, example_control_status(), [](auto& m) { m.control_state = 99; });
  add(kFaultCommand, example_fault_command(), [](auto& m) { m.amount_deg = kNan; });
  add(kProcessInfo, example_process_info(), [](auto& m) { m.pid = 0; });
  add(kCameraImage, example_camera_image(), [](auto& m) { m.width = 31; });
  // Well-formed and sensible, but of no shipped rig.
  add(kLearnedSchema, example_body_schema(), [](auto&) {});
  add(kRefinedSchema, example_body_schema(), [](auto& m) { m.last_sample_index = 1'000'000'000; });
  add(kSample, example_sample(), [](auto& m) { m.sample_index = 1'000'000'000; });
  add(kMarkerPoses, example_marker_poses(), [](auto&) {});
  add(kCameraInfo, example_camera_info(), [](auto&) {});
  add(kCameraImage, example_camera_image(), [](auto&) {});
  add(kSimState, example_sim_state(), [](auto&) {});
  add(kModelHealth, example_model_health(),
      [](auto& m) { m.part_health.back().health_part = 999; });
}

/// Recorded messages of another rig's group, commands included: they have another number of
/// signals.
void add_foreign(std::vector<Hostile>& all, const std::filesystem::path& run) {
  std::size_t num_images = 0;
  for (const char* log : {"run.lcmlog.00", "images.lcmlog.00"}) {
    for_each_event(run / log, [&](const LogEvent& event) {
      if (event.channel == kCameraImage.name && ++num_images > 10) return;
      all.push_back({event.channel, event.data});
    });
  }
}

}  // namespace

int main(int argc, char** argv) {
  std::string foreign, until;
  CLI::App app("Everything that should not be on a robot's bus");
  app.add_option("FOREIGN", foreign, "Run folder of another rig")->required();
  app.add_option("--until", until, "Ends when this file exists")->required();
  CLI11_PARSE(app, argc, argv);

  std::mt19937_64 random(6);
  std::vector<Hostile> kinds[3];
  add_garbage(kinds[0], random);
  add_nonsense(kinds[1]);
  add_foreign(kinds[2], foreign);
  // In turn, so that each channel gets each kind however long it lasts: a group sends few messages
  // on MODEL_HEALTH.
  struct Turn {
    std::vector<Hostile> all;
    std::size_t next = 0;
  };
  std::map<std::pair<int, std::string>, Turn> turns;
  for (int kind = 0; kind < 3; ++kind) {
    std::shuffle(kinds[kind].begin(), kinds[kind].end(), random);
    for (Hostile& hostile : kinds[kind])
      turns[{kind, hostile.channel}].all.push_back(std::move(hostile));
  }

  const std::unique_ptr<lcm_t, void (*)(lcm_t*)> bus(lcm_create(default_url().c_str()),
                                                     &lcm_destroy);
  const std::unique_ptr<lcm_t, void (*)(lcm_t*)> images(
      lcm_create(images_url(default_url()).c_str()), &lcm_destroy);
  if (!bus || !images) return 1;
  // Some 300 a second, and no longer than two minutes.
  const auto end = std::chrono::steady_clock::now() + std::chrono::minutes(2);
  std::uint64_t num_sent = 0;
  for (auto turn = turns.begin();
       !std::filesystem::exists(until) && std::chrono::steady_clock::now() < end;) {
    Turn& now = turn->second;
    const Hostile& hostile = now.all[now.next++ % now.all.size()];
    // Images on both ports: there they are expected, here they are not.
    lcm_t* to =
        hostile.channel == kCameraImage.name && now.next % 2 == 0 ? images.get() : bus.get();
    lcm_publish(to, hostile.channel.c_str(), hostile.bytes.data(),
                static_cast<unsigned>(hostile.bytes.size()));
    if (++turn == turns.end()) turn = turns.begin();
    if (++num_sent % 30 == 0) std::this_thread::sleep_for(std::chrono::milliseconds(100));
  }
  std::printf("%llu\n", static_cast<unsigned long long>(num_sent));
  return 0;
}
