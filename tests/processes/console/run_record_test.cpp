#include "processes/console/run_record.h"

#include <gtest/gtest.h>

#include "common/bus/convert.h"
#include "tests/lcmtypes/example_messages.h"

namespace bodyschema::test {
namespace {

constexpr std::int64_t kStart = 1'700'000'000'000'000;

/// A record and the logger that feeds it.
struct Recorded {
  RunRecord record;

  template <class Message>
  void hear(const Channel<Message>& channel, const Message& message, std::int64_t at_us,
            std::int64_t byte = 0) {
    LogEvent event;
    event.channel = channel.name;
    event.data = encode(channel, message);
    event.event_utime = kStart + at_us;
    record.on_event(event, "log", byte);
  }

  std::vector<double> latency(const std::string& name) const {
    for (const auto& latency : record.latencies()) {
      if (latency.name == name) return latency.seconds;
    }
    return {};
  }
};

sample_t sample(std::int64_t index, std::int64_t utime, std::int64_t action_id) {
  sample_t message = example_sample();
  message.sample_index = index;
  message.utime = message.rest_end_utime = message.rest_begin_utime + utime;
  message.action_id = action_id;
  return message;
}

process_info_t info(std::int64_t utime, std::int64_t cpu_us) {
  process_info_t message = example_process_info();
  message.utime = kStart + utime;
  message.start_utime = kStart;
  message.cpu_us = cpu_us;
  return message;
}

TEST(RunRecordTest, LatenciesAreBetweenTheFirstReceipts) {
  Recorded run;
  action_command_t command = example_action_command();
  command.kind = action_command_t::KIND_MOVE;
  motion_status_t status = example_motion_status();
  status.source = command.source;
  status.epoch = command.epoch;
  status.action_id = command.action_id;
  status.state = motion_status_t::STATE_ACCEPTED;
  run.hear(kActionCommand, command, 0);
  run.hear(kActionCommand, command, 5'000);  // sent again
  run.hear(kMotionStatus, status, 10'000);
  status.state = motion_status_t::STATE_SETTLED;
  run.hear(kMotionStatus, status, 40'000);
  run.hear(kMotionStatus, status, 900'000);  // repeated at 1 Hz

  sample_t taken = sample(0, 777, command.action_id);
  taken.source = command.source;
  taken.epoch = command.epoch;
  camera_image_t image = example_camera_image();
  image.utime = taken.utime;
  marker_poses_t markers = example_marker_poses();
  markers.utime = taken.utime;
  // The markers' log may be read before the images'.
  run.hear(kMarkerPoses, markers, 70'000);
  run.hear(kSample, taken, 72'000);
  run.hear(kSample, taken, 999'000);
  run.hear(kCameraImage, image, 50'000);
  run.hear(kCameraImage, image, 950'000);

  const std::vector<double> one_20ms = {0.02};
  EXPECT_EQ(run.latency("frame → MARKER_POSES"), one_20ms);
  EXPECT_EQ(run.latency("last frame → SAMPLE"), std::vector<double>{0.022});
  EXPECT_EQ(run.latency("ACTION_COMMAND → answer of the driver"), std::vector<double>{0.01});
  EXPECT_EQ(run.latency("ACTION_COMMAND → settled"), std::vector<double>{0.04});
  EXPECT_EQ(run.latency("ACTION_COMMAND → SAMPLE"), std::vector<double>{0.072});
  EXPECT_EQ(run.record.begin_utime(), kStart);
  EXPECT_DOUBLE_EQ(run.record.duration_s(), 0.999);
}

// samples.lcmlog has the samples' own times: nothing was received there.
TEST(RunRecordTest, AFileThatTheObserverWroteTellsNoLatency) {
  RunRecord record;
  const sample_t message = sample(0, 1, 3);
  LogEvent event;
  event.channel = kSample.name;
  event.data = encode(kSample, message);
  event.event_utime = message.utime;
  record.on_event(event, "samples.lcmlog", 0);
  EXPECT_EQ(record.watch().num_samples(), 1);
  EXPECT_FALSE(record.begin_utime());
  EXPECT_TRUE(record.latencies().empty());
}

TEST(RunRecordTest, LoadIsTheTimeUsedBetweenTwoMessages) {
  Recorded run;
  run.hear(kProcessInfo, info(0, 100'000), 0);
  run.hear(kProcessInfo, info(300'000, 999'999), 300'000);  // too soon to tell
  run.hear(kProcessInfo, info(1'000'000, 350'000), 1'000'000);
  ASSERT_EQ(run.record.processes().size(), 1U);
  const auto load = run.record.processes()[0].load;
  ASSERT_EQ(load.size(), 1U);
  EXPECT_DOUBLE_EQ(load[0].cpu_percent, 25);
  EXPECT_DOUBLE_EQ(load[0].at_s, 1);
}

TEST(RunRecordTest, ALongRunsLoadIsThinnedAndStillReachesItsEnd) {
  Recorded run;
  constexpr int kSeconds = 10'000;
  for (std::int64_t s = 0; s <= kSeconds; ++s)
    run.hear(kProcessInfo, info(s * 1'000'000, s * 500'000), s * 1'000'000);
  const auto load = run.record.processes()[0].load;
  EXPECT_LE(load.size(), 801U);
  EXPECT_GT(load.size(), 300U);
  EXPECT_GT(load.back().at_s, kSeconds - 40);
  for (const auto& point : load) EXPECT_NEAR(point.cpu_percent, 50, 1e-9);
  for (std::size_t i = 1; i < load.size(); ++i) EXPECT_GT(load[i].at_s, load[i - 1].at_s);
}

TEST(RunRecordTest, ThePictureIsTheFrameWithTheMostMarkersWhoseImageIsThere) {
  Recorded run;
  const auto markers = [](std::int64_t utime, int count) {
    marker_poses_t message = example_marker_poses();
    message.utime = utime;
    const marker_pose_t one = message.markers.front();
    std::vector<marker_pose_t> all(static_cast<std::size_t>(count), one);
    for (int i = 0; i < count; ++i) all[static_cast<std::size_t>(i)].marker_id = i;
    set_array(message.num_markers, message.markers, all);
    return message;
  };
  for (int i = 0; i < 30; ++i) run.hear(kMarkerPoses, markers(i, 1 + i % 20), i);
  EXPECT_TRUE(run.record.pictures().empty());
  camera_image_t image = example_camera_image();
  for (const int lost : {19}) {
    for (int i = 0; i < 30; ++i) {
      image.utime = i;
      if (i != lost) run.hear(kCameraImage, image, 100 + i, 1000 * i);
    }
  }
  const auto pictures = run.record.pictures();
  ASSERT_FALSE(pictures.empty());
  EXPECT_EQ(pictures[0].markers.num_markers, 19);
  EXPECT_EQ(pictures[0].image.byte, 18'000);
}

TEST(RunRecordTest, EventsOutliveTheNewest32AndARestartOfTheMonitor) {
  Recorded run;
  model_health_t health = example_model_health();
  const auto event = [](std::int64_t number, std::int64_t sample) {
    health_event_t event{};
    event.event_number = number;
    event.event_kind = health_event_t::EVENT_MISMATCH;
    event.event_sample = sample;
    event.event_text = "sample " + std::to_string(sample);
    return event;
  };
  for (std::int64_t n = 0; n < 50; ++n) {
    set_array(health.num_events, health.events, {event(n, 5 * n)});
    run.hear(kModelHealth, health, n);
    run.hear(kModelHealth, health, n);
  }
  set_array(health.num_events, health.events, {event(0, 1000)});
  run.hear(kModelHealth, health, 99);
  const auto events = run.record.events();
  ASSERT_EQ(events.size(), 51U);
  EXPECT_EQ(events.front().event_sample, 0);
  EXPECT_EQ(events.back().event_sample, 1000);
}

TEST(RunRecordTest, OfAcceptancesInARowTheNewestIsAnEvent) {
  Recorded run;
  model_health_t health = example_model_health();
  const auto tell = [&](std::int64_t number, std::int8_t kind) {
    health_event_t event{};
    event.event_number = number;
    event.event_kind = kind;
    event.event_sample = 5 * number;
    set_array(health.num_events, health.events, {event});
    run.hear(kModelHealth, health, number);
  };
  std::int64_t number = 0;
  for (; number < 10; ++number) tell(number, health_event_t::EVENT_SCHEMA_ACCEPTED);
  tell(number++, health_event_t::EVENT_CANDIDATE);
  for (; number < 20; ++number) tell(number, health_event_t::EVENT_SCHEMA_ACCEPTED);
  const auto events = run.record.events();
  ASSERT_EQ(events.size(), 3U);
  EXPECT_EQ(events[0].event_number, 9);
  EXPECT_EQ(events[1].event_number, 10);
  EXPECT_EQ(events[2].event_number, 19);
}

TEST(RunRecordTest, OfManyVersionsAnEvenChoiceIsKeptWithBothEndsOfEachBody) {
  Recorded run;
  body_schema_t schema = example_body_schema();
  const auto version = [&](std::int64_t number, std::int64_t num_changes) {
    schema.schema_version = number;
    std::vector<body_change_t> changes(static_cast<std::size_t>(num_changes));
    for (std::int64_t c = 0; c < num_changes; ++c)
      changes[static_cast<std::size_t>(c)].found_sample = c;
    set_array(schema.num_changes, schema.changes, std::move(changes));
    run.hear(kBodySchema, schema, number);
    run.hear(kBodySchema, schema, number);  // repeated at 1 Hz
  };
  for (std::int64_t n = 1; n <= 3000; ++n) version(n, n < 1000 ? 0 : n < 1010 ? 1 : 2);
  EXPECT_EQ(run.record.num_versions(), 3000);
  EXPECT_LE(run.record.versions().size(), 256U);
  EXPECT_GT(run.record.versions().size(), 100U);
  for (const std::int64_t kept : {1, 999, 1000, 1009, 1010, 3000})
    EXPECT_TRUE(run.record.versions().contains(kept)) << kept;
}

// Images are read before the markers found in them.
TEST(RunRecordTest, OfManyFramesTheLatenciesAreThinnedAndOneWithAnImageIsThePicture) {
  Recorded run;
  constexpr std::int64_t kMany = 20'000;
  camera_image_t image = example_camera_image();
  marker_poses_t markers = example_marker_poses();
  action_command_t command = example_action_command();
  command.kind = action_command_t::KIND_MOVE;
  motion_status_t status = example_motion_status();
  status.source = command.source;
  status.epoch = command.epoch;
  status.state = motion_status_t::STATE_SETTLED;
  for (std::int64_t i = 0; i < kMany; ++i) {
    image.utime = 100'000 * (i + 1);
    run.hear(kCameraImage, image, image.utime, i);
  }
  for (std::int64_t i = 0; i < kMany; ++i) {
    markers.utime = 100'000 * (i + 1);
    run.hear(kMarkerPoses, markers, markers.utime + 20'000);
    command.action_id = status.action_id = i;
    run.hear(kActionCommand, command, markers.utime);
    run.hear(kMotionStatus, status, markers.utime + 30'000);
  }
  for (const char* name : {"frame → MARKER_POSES", "ACTION_COMMAND → settled"}) {
    const auto seconds = run.latency(name);
    EXPECT_LE(seconds.size(), 4096U);
    EXPECT_GT(seconds.size(), 1500U);
    EXPECT_NEAR(quantile(seconds, 0.5), name[0] == 'f' ? 0.02 : 0.03, 1e-12);
  }
  ASSERT_FALSE(run.record.pictures().empty());
  const auto& picture = run.record.pictures().front();
  EXPECT_EQ(100'000 * (picture.image.byte + 1), picture.markers.utime);
}

TEST(RunRecordTest, FaultsAreTheirChanges) {
  Recorded run;
  sim_state_t state = example_sim_state();
  const auto broken = [&](std::vector<std::string> faults, std::int64_t at_us) {
    set_array(state.num_faults, state.faults, std::move(faults));
    run.hear(kSimState, state, at_us);
  };
  broken({}, 0);
  broken({"stuck q3"}, 2'000'000);
  broken({"stuck q3"}, 3'000'000);
  broken({}, 4'000'000);
  ASSERT_EQ(run.record.faults().size(), 2U);
  EXPECT_EQ(run.record.faults()[0].faults, std::vector<std::string>{"stuck q3"});
  EXPECT_TRUE(run.record.faults()[1].faults.empty());
}

TEST(RunRecordTest, WhatCannotBeReadIsPassedOver) {
  RunRecord record;
  for_each_channel([&](const auto& channel, const auto& message) {
    LogEvent event;
    event.channel = channel.name;
    event.data = encode(channel, message);
    event.data.resize(event.data.size() - 1);
    record.on_event(event, "log", 0);
  });
  EXPECT_TRUE(record.is_empty());
  EXPECT_FALSE(record.begin_utime());
}

TEST(QuantileTest, IsTheValueOfThatRank) {
  EXPECT_EQ(quantile({3, 1, 2}, 0), 1);
  EXPECT_EQ(quantile({3, 1, 2}, 0.5), 2);
  EXPECT_EQ(quantile({3, 1, 2}, 1), 3);
  EXPECT_EQ(quantile({7}, 0.95), 7);
}

}  // namespace
}  // namespace bodyschema::test
