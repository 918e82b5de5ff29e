// The processes' classes, from log to log in this program.

#include <gtest/gtest.h>

#include <filesystem>
#include <limits>
#include <set>
#include <string>
#include <vector>

#include "common/bus/convert.h"
#include "common/bus/event_log.h"
#include "processes/camera/camera_process.h"
#include "processes/controller/controller_process.h"
#include "processes/marker_estimator/marker_estimator_process.h"
#include "processes/model_monitor/model_monitor_process.h"
#include "processes/motor_babbler/motor_babbler_process.h"
#include "processes/observer/observer_process.h"
#include "processes/robot_driver_example/robot_driver_example_process.h"
#include "processes/robot_simulator/robot_simulator_process.h"
#include "processes/structure_learner/structure_learner_process.h"
#include "tests/common/bus/bus_test_support.h"

namespace bodyschema {
namespace {

namespace fs = std::filesystem;

const fs::path kRecorded = BODYSCHEMA_LOGS "/arm2_15.lcmlog";
const fs::path kRig = BODYSCHEMA_CONFIG "/arm2";

action_command_t move_to(const std::vector<double>& action) {
  action_command_t command{};
  command.utime = 1'000'000;
  command.source = "test";
  command.kind = action_command_t::KIND_MOVE;
  command.expiry_utime = std::numeric_limits<std::int64_t>::max();
  set_array(command.num_signals, command.action, action);
  return command;
}

class ProcessClasses : public testing::Test {
 protected:
  /// A log with these messages, at the end of it if it exists.
  template <class Message>
  fs::path log(const std::string& name, const Channel<Message>& channel,
               const std::vector<Message>& messages) const {
    LogAppender appender(folder_ / name);
    for (const Message& message : messages) appender.append(channel, message);
    return folder_ / name;
  }
  /// What the process writes from the log `in`.
  template <class Subscriber>
  fs::path replay(const std::string& name, const fs::path& in,
                  const std::vector<std::string>& flags = {}, const fs::path& rig = kRig) {
    const fs::path out = folder_ / (name + std::to_string(++num_runs_));
    EXPECT_EQ(test::run_on_log<Subscriber>(name, rig, in, out, flags), 0);
    return out;
  }
  static std::int64_t counter(const fs::path& log, const std::string& name) {
    const process_info_t info = read_log(log, kProcessInfo).back();
    for (const counter_t& counter : info.counters)
      if (counter.counter_name == name) return counter.count;
    return -1;
  }
  /// An arm2 at rest for four seconds, whose driver began 1 s ago.
  fs::path rest() const {
    std::vector<motion_status_t> statuses(4);
    for (std::size_t i = 0; i < statuses.size(); ++i) {
      statuses[i].utime = 1'000'000 * static_cast<std::int64_t>(i + 1);
      statuses[i].rest_since_utime = 1'000'000;
      statuses[i].action_id = -1;
      set_array(statuses[i].num_signals, statuses[i].commanded, {0.1, 0.2});
    }
    return log("rest", kMotionStatus, statuses);
  }
  std::string unwritable() const { return folder_ / "no" / "such" / "file"; }

  test::TemporaryFolder folder_;
  int num_runs_ = 0;
};

TEST_F(ProcessClasses, AnActionBecomesASampleOnDisk) {
  const fs::path moved = replay<RobotSimulatorProcess>(
      "robot_simulator", log("commands", kActionCommand, {move_to({0.1, 0.2})}), {"--ideal"});
  const std::vector<sim_state_t> states = read_log(moved, kSimState);
  ASSERT_FALSE(states.empty());
  const fs::path shown =
      replay<CameraProcess>("camera", log("states", kSimState, {states.back()}), {"--ideal"});
  const fs::path seen = replay<MarkerEstimatorProcess>("marker_estimator", shown);
  log("all", kCameraInfo, read_log(shown, kCameraInfo));
  log("all", kMotionStatus, read_log(moved, kMotionStatus));
  const fs::path all = log("all", kMarkerPoses, read_log(seen, kMarkerPoses));
  const fs::path file = folder_ / "samples.lcmlog";
  const auto told =
      read_log(replay<ObserverProcess>("observer", all, {"--samples", file}), kSample);
  const auto kept = read_log(file, kSample);
  ASSERT_EQ(told.size(), 1U);
  EXPECT_EQ(told[0].action, (std::vector<double>{0.1, 0.2}));
  EXPECT_GE(told[0].num_parts, 3);
  ASSERT_EQ(kept.size(), 1U);
  EXPECT_EQ(encode(kSample, kept[0]), encode(kSample, told[0]));
}

TEST_F(ProcessClasses, TheSimulatorTellsAStateThatItCannotSaveAndGoesOnFromOneThatItCould) {
  const fs::path commands = log("commands", kActionCommand, {move_to({0.1, 0.2})});
  const auto act = [&](const std::string& state_file) {
    return replay<RobotSimulatorProcess>("robot_simulator", commands, {"--state", state_file});
  };
  const fs::path unsaved = act(unwritable());
  EXPECT_EQ(counter(unsaved, "state not saved"), 1);
  EXPECT_EQ(read_log(unsaved, kMotionStatus).back().state, motion_status_t::STATE_SETTLED);
  const std::string state_file = folder_ / "state.yaml";
  const auto first = read_log(act(state_file), kSimState).back();
  // Known and answered again, not moved to.
  EXPECT_EQ(read_log(act(state_file), kSimState).back().utime, first.utime);
}

TEST_F(ProcessClasses, TheCameraRepeatsARepeatedStateThirtyTimes) {
  const fs::path moved = replay<RobotSimulatorProcess>(
      "robot_simulator", log("commands", kActionCommand, {move_to({0.1, 0.2})}));
  const std::vector<sim_state_t> repeated(40, read_log(moved, kSimState).back());
  const fs::path shown = replay<CameraProcess>("camera", log("states", kSimState, repeated));
  const CameraConfig config = CameraConfig::load(kRig / "camera.yaml");
  EXPECT_EQ(read_log(shown, kCameraImage).size(),
            31U * static_cast<std::size_t>(config.simulation->frames_per_action));
  EXPECT_EQ(read_log(shown, kCameraInfo).back().utime, read_log(shown, kCameraImage).back().utime);
  // Another start than the simulator's.
  const fs::path refused = replay<CameraProcess>("camera", folder_ / "states", {"--ideal"});
  EXPECT_EQ(counter(refused, "refused SIM_STATE"), 40);
  EXPECT_TRUE(read_log(refused, kCameraImage).empty());
}

TEST_F(ProcessClasses, TheBabblerSendsNoCommandThatItsStateDoesNotKnow) {
  const std::string state_file = folder_ / "state.yaml";
  const auto saved = replay<MotorBabblerProcess>("motor_babbler", rest(), {"--state", state_file});
  EXPECT_FALSE(read_log(saved, kActionCommand).empty());
  EXPECT_TRUE(fs::exists(state_file));
  const auto unsaved =
      replay<MotorBabblerProcess>("motor_babbler", folder_ / "rest", {"--state", unwritable()});
  EXPECT_TRUE(read_log(unsaved, kActionCommand).empty());
  EXPECT_GT(counter(unsaved, "state not saved"), 0);
}

TEST_F(ProcessClasses, TheControllerHoldsThoughItsStateIsNotSaved) {
  pose_target_t target{};
  target.utime = target.epoch = 4'000'000;
  target.sender = "test";
  target.target_kind = pose_target_t::KIND_HOLD;
  target.target_part = -1;
  target.keep_s = -1;
  rest();
  const fs::path unsaved = replay<ControllerProcess>(
      "controller", log("rest", kPoseTarget, {target}), {"--state", unwritable()});
  EXPECT_EQ(read_log(unsaved, kControlStatus).back().control_state,
            control_status_t::CONTROL_HOLDING);
  const auto commands = read_log(unsaved, kActionCommand);
  ASSERT_FALSE(commands.empty());
  EXPECT_EQ(commands.front().kind, action_command_t::KIND_HOLD);
  EXPECT_GT(counter(unsaved, "state not saved"), 0);
}

TEST_F(ProcessClasses, TheLearnerProposesAfterEveryTestSampleAtOnceAndAtTheEnd) {
  std::vector<std::int64_t> expected, proposed;
  for (const sample_t& sample : read_log(kRecorded, kSample))
    if (sample.purpose == action_command_t::PURPOSE_TEST &&
        (expected.empty() || sample.sample_index > expected.back()))
      expected.push_back(sample.sample_index);
  if (expected.back() != 14) expected.push_back(14);
  const fs::path out = replay<StructureLearnerProcess>("structure_learner", kRecorded);
  for (const body_schema_t& schema : read_log(out, kLearnedSchema))
    proposed.push_back(schema.last_sample_index);
  EXPECT_EQ(proposed, expected);
  std::set<std::int64_t> utimes;
  for_each_event(out, [&](const LogEvent& event) { utimes.insert(event.event_utime); });
  EXPECT_GE(utimes.size(), expected.size());
}

TEST_F(ProcessClasses, TheMonitorKeepsTheSchemaThatItPublishedAndBeginsWithIt) {
  const std::string file = folder_ / "schema.lcmlog";
  const auto published = read_log(
      replay<ModelMonitorProcess>("model_monitor", kRecorded, {"--schema", file}), kBodySchema);
  ASSERT_FALSE(published.empty());
  const auto kept = read_log(file, kBodySchema);
  ASSERT_EQ(kept.size(), 1U);
  EXPECT_EQ(encode(kBodySchema, kept[0]), encode(kBodySchema, published.back()));
  // A start on the same samples judges none of them again.
  const fs::path again = replay<ModelMonitorProcess>("model_monitor", kRecorded,
                                                     {"--schema", file, "--samples", kRecorded});
  for (const body_schema_t& schema : read_log(again, kBodySchema))
    EXPECT_EQ(schema.schema_version, kept[0].schema_version);
}

TEST_F(ProcessClasses, TheDriverTellsWhetherAStopOutlivesIt) {
  action_command_t stop = move_to({});
  stop.kind = action_command_t::KIND_STOP;
  const auto answer = [&](const std::string& record) {
    return replay<RobotDriverProcess>("robot_driver_example", log("stop", kActionCommand, {stop}),
                                      {"--record", record}, EXAMPLE_RIG);
  };
  const std::string record = folder_ / "record", forgotten = "a restart of the driver would forget";
  const motion_status_t kept = read_log(answer(record), kMotionStatus).at(0);
  EXPECT_EQ(kept.state, motion_status_t::STATE_STOPPED);
  EXPECT_EQ(kept.reason.find(forgotten), std::string::npos) << kept.reason;
  EXPECT_TRUE(read_log(record, kMotionStatus).at(0).stop_latched);
  const fs::path unkept = answer(unwritable());
  EXPECT_NE(read_log(unkept, kMotionStatus).at(0).reason.find(forgotten), std::string::npos);
  EXPECT_GT(counter(unkept, "record not saved"), 0);
}

}  // namespace
}  // namespace bodyschema
