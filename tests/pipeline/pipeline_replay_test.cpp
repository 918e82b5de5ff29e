// Two runs with one seed, and replays of a run: the same payloads, the same schema.

#include <gtest/gtest.h>

#include <algorithm>
#include <fstream>
#include <functional>
#include <nlohmann/json.hpp>
#include <set>
#include <string>
#include <vector>

#include "tests/pipeline/arm2_group.h"

namespace bodyschema::test {
namespace {

/// The payloads of one channel that `is_wanted`, each once, in the order in which they first came:
/// the number of 1 Hz repetitions depends on the clock, and differs between a replay and the live
/// run. (The camera repeats all frames of an action in turn, so neighbours are not enough.)
template <class Message>
std::vector<std::string> distinct_payloads(
    const fs::path& log, const Channel<Message>& channel,
    const std::function<bool(const Message&)>& is_wanted = [](const Message&) { return true; }) {
  std::vector<std::string> distinct;
  std::set<std::string> seen;
  for_each_event(log, [&](const LogEvent& event) {
    if (event.channel != channel.name) return;
    const auto decoded = decode<Message>(event.data.data(), event.data.size());
    if (!decoded.message) throw std::runtime_error(decoded.problem);
    const std::string payload(event.data.begin(), event.data.end());
    if (is_wanted(*decoded.message) && seen.insert(payload).second) distinct.push_back(payload);
  });
  return distinct;
}

/// Not EXPECT_EQ, which would print megabytes.
testing::AssertionResult are_equal(const std::vector<std::string>& replayed,
                                   const std::vector<std::string>& live) {
  if (live.empty()) return testing::AssertionFailure() << "nothing was recorded live";
  const std::size_t n = std::min(replayed.size(), live.size());
  for (std::size_t i = 0; i < n; ++i) {
    if (replayed[i] != live[i]) return testing::AssertionFailure() << "payload " << i << " differs";
  }
  if (replayed.size() == live.size()) return testing::AssertionSuccess();
  return testing::AssertionFailure()
         << replayed.size() << " payloads replayed, " << live.size() << " live";
}

/// The same of bytes.
testing::AssertionResult are_equal(const std::string& one, const std::string& other) {
  if (one.empty() && other.empty()) return testing::AssertionFailure() << "nothing was recorded";
  if (one == other) return testing::AssertionSuccess();
  const auto end =
      std::mismatch(one.begin(), one.begin() + std::min(one.size(), other.size()), other.begin());
  return testing::AssertionFailure() << one.size() << " and " << other.size()
                                     << " bytes differ from byte " << end.first - one.begin();
}

TEST_F(Arm2, TheBusAndTheImagesAreRecordedApart) {
  EXPECT_FALSE(payloads(run("first") / "images.lcmlog.00", "CAMERA_IMAGE").empty());
  EXPECT_TRUE(payloads(run("first") / "images.lcmlog.00", "SAMPLE").empty());
  EXPECT_TRUE(payloads(run("first") / "run.lcmlog.00", "CAMERA_IMAGE").empty());
  // On the bus the newest sample is repeated; in the file each stands once.
  EXPECT_TRUE(are_equal(distinct_payloads(run("first") / "run.lcmlog.00", kSample),
                        distinct_payloads(run("first") / "samples.lcmlog", kSample)));
  EXPECT_EQ(read_log(run("first") / "samples.lcmlog", kSample).size(), 30u);
}

TEST_F(Arm2, TwoRunsWithOneSeedAreIdentical) {
  ASSERT_EQ(second_exit_code_, 0) << text_of(folder_ / "second.err");
  EXPECT_TRUE(are_equal(payloads(run("first") / "samples.lcmlog", "SAMPLE"),
                        payloads(run("second") / "samples.lcmlog", "SAMPLE")));
  EXPECT_TRUE(are_equal(payloads(run("first") / "schema.lcmlog", "BODY_SCHEMA"),
                        payloads(run("second") / "schema.lcmlog", "BODY_SCHEMA")));
}

TEST_F(Arm2, AReplayThroughTheObserverGivesTheSameSamples) {
  EXPECT_TRUE(are_equal(distinct_payloads(replay("observer"), kSample),
                        distinct_payloads(run("first") / "run.lcmlog.00", kSample)));
}

TEST_F(Arm2, AReplayThroughTheSimulatorGivesTheSameStates) {
  // Live, the state before the first action is repeated at 1 Hz; no command causes it.
  const auto states = [](const fs::path& log) {
    return distinct_payloads<sim_state_t>(
        log, kSimState, [](const sim_state_t& state) { return state.action_id >= 0; });
  };
  EXPECT_TRUE(are_equal(states(replay("robot_simulator", "--seed 3 --ideal")),
                        states(run("first") / "run.lcmlog.00")));
}

TEST_F(Arm2, AReplayThroughTheBabblerGivesTheSameActions) {
  EXPECT_TRUE(
      are_equal(distinct_payloads(replay("motor_babbler", "--seed 3 --samples 30"), kActionCommand),
                distinct_payloads(run("first") / "run.lcmlog.00", kActionCommand)));
}

TEST_F(Arm2, AReplayThroughTheCameraGivesTheSameImages) {
  // The two frames of the start pose may have passed live before the logger listened.
  const auto images = [](const fs::path& log) {
    return distinct_payloads<camera_image_t>(
        log, kCameraImage, [](const camera_image_t& image) { return image.image_seq >= 2; });
  };
  EXPECT_TRUE(
      are_equal(images(replay("camera", "--ideal")), images(run("first") / "images.lcmlog.00")));
}

TEST_F(Arm2, AReplayThroughTheMarkerEstimatorGivesTheSamePoses) {
  const auto poses = [](const fs::path& log) {
    return distinct_payloads<marker_poses_t>(
        log, kMarkerPoses, [](const marker_poses_t& frame) { return frame.image_seq >= 2; });
  };
  const fs::path images = run("first") / "images.lcmlog.00";
  EXPECT_TRUE(are_equal(poses(replay("marker_estimator", "--images " + in_quotes(log_url(images)))),
                        poses(run("first") / "run.lcmlog.00")));
}

TEST_F(Arm2, AReplayFromTheLogGivesTheSameSchemaBytesTwice) {
  const std::string live = payloads(run("first") / "run.lcmlog.00", "LEARNED_SCHEMA", true);
  ASSERT_FALSE(live.empty());
  for (const char* name : {"replay1.lcmlog", "replay2.lcmlog"}) {
    const fs::path out = folder_ / name;
    ASSERT_EQ(shell(in_quotes(kBin / "structure_learner") + " --config " +
                    in_quotes(run("first") / "config/structure_learner.yaml") + " --in " +
                    in_quotes("file://" + (run("first") / "samples.lcmlog").string() + "?speed=0") +
                    " --out " + in_quotes("file://" + out.string() + "?mode=w") + " 2>/dev/null"),
              0);
    EXPECT_TRUE(are_equal(payloads(out, "LEARNED_SCHEMA", true), live));
  }
}

TEST_F(Arm2, AReplayThroughTheMonitorGivesTheSameBodySchemaBytes) {
  const fs::path out = folder_ / "monitor.lcmlog";
  ASSERT_EQ(shell(in_quotes(kBin / "model_monitor") + " --config " +
                  in_quotes(run("first") / "config/model_monitor.yaml") + " --in " +
                  in_quotes("file://" + (run("first") / "run.lcmlog.00").string() + "?speed=0") +
                  " --out " + in_quotes("file://" + out.string() + "?mode=w") + " 2>/dev/null"),
            0);
  EXPECT_TRUE(are_equal(payloads(out, "BODY_SCHEMA", true),
                        payloads(run("first") / "schema.lcmlog", "BODY_SCHEMA")));
}

TEST_F(Arm2, LogplayerOnALiveBusGivesTheSameSchemaBytes) {
  const fs::path expected = folder_ / "expected";
  std::ofstream(expected, std::ios::binary)
      << payloads(run("first") / "run.lcmlog.00", "LEARNED_SCHEMA", true);
  const int status = shell(in_quotes(kSource / "tests/private_bus.sh") + " " +
                           in_quotes(kSource / "tests/pipeline/replay_live.sh") + " " +
                           in_quotes(kBin) + " " + in_quotes(run("first") / "config") + " " +
                           in_quotes(run("first") / "samples.lcmlog") + " " + in_quotes(expected));
  if (status == 77) GTEST_SKIP() << "no user namespaces";
  EXPECT_EQ(status, 0);
}

TEST_F(Arm2, LearningFromTheSampleLogOfflineGivesTheStructureOfTheRun) {
  const fs::path json = folder_ / "learned.json";
  ASSERT_EQ(
      shell(in_quotes(kBin / "bodyschema") + " learn " +
            in_quotes(run("first") / "samples.lcmlog") + " --root 1 --json >" + in_quotes(json)),
      0);
  auto learned = nlohmann::json::parse(text_of(json));
  const auto result = nlohmann::json::parse(text_of(run("first") / "result.json"));
  EXPECT_EQ(learned["noise"]["from"], "covariances");
  learned["noise"].erase("from");  // neither is in a schema
  learned.erase("one_cluster");
  learned.erase("serial_correlation");
  learned.erase("command_lag_s");
  learned.erase("command_smear_s");
  EXPECT_EQ(learned, result["structure"]);
}

TEST_F(Arm2, AReplayOfTheGroupLearnsWhatTheRunLearned) {
  ASSERT_EQ(replay_group("again", run("first") / "run.lcmlog.00"), 0)
      << text_of(folder_ / "again.err");
  EXPECT_TRUE(are_equal(payloads(run("again") / "samples.lcmlog", "SAMPLE"),
                        payloads(run("first") / "samples.lcmlog", "SAMPLE")));
  EXPECT_TRUE(are_equal(payloads(run("again") / "schema.lcmlog", "BODY_SCHEMA"),
                        payloads(run("first") / "schema.lcmlog", "BODY_SCHEMA")));
  for (const char* key : {"rig", "samples", "structure", "held_out", "held_out_against"})
    EXPECT_EQ(result("again")[key], result("first")[key]) << key;
  EXPECT_EQ(result("again")["replay_of"], fs::canonical(run("first") / "run.lcmlog.00").string());
  EXPECT_NE(text_of(folder_ / "again.out").find("arm2 · replay of "), std::string::npos);
  EXPECT_EQ(processes_of(fs::canonical(run("again"))), std::vector<std::string>{});
}

TEST_F(Arm2, APlayedReplayLearnsTheSameAndNoCommandIsOnItsBus) {
  ASSERT_EQ(replay_group("played", run("first") / "run.lcmlog.00", "--speed 5"), 0)
      << text_of(folder_ / "played.err");
  EXPECT_TRUE(are_equal(payloads(run("played") / "schema.lcmlog", "BODY_SCHEMA"),
                        payloads(run("first") / "schema.lcmlog", "BODY_SCHEMA")));
  EXPECT_TRUE(are_equal(payloads(run("played") / "samples.lcmlog", "SAMPLE"),
                        payloads(run("first") / "samples.lcmlog", "SAMPLE")));
  EXPECT_EQ(result("played")["lost_frames"], 0);
  EXPECT_EQ(result("played")["lost_samples"], nlohmann::json::array());
  std::set<std::string> channels;
  for_each_event(run("played") / "run.lcmlog.00",
                 [&](const LogEvent& event) { channels.insert(event.channel); });
  EXPECT_TRUE(channels.contains("MARKER_POSES"));
  EXPECT_FALSE(channels.contains("ACTION_COMMAND"));
  EXPECT_FALSE(channels.contains("SIM_STATE")) << "the truth is on the bus";
  for (const char* robot : {"robot_simulator.log", "motor_babbler.log", "camera.log"})
    EXPECT_FALSE(fs::exists(run("played") / robot)) << robot;
}

TEST_F(Arm2, AReplayWithAHoleSaysWhatIsLostAndLearnsFromTheRest) {
  const auto without = [](const std::string& name, const std::set<std::int64_t>& removed) {
    const fs::path holed = folder_ / (name + ".lcmlog");
    LogAppender log(holed, LogAppender::Mode::kOverwrite, LogAppender::Durability::kToKernel);
    for (const sample_t& sample : read_log(kSource / "logs/arm2_15.lcmlog", kSample)) {
      if (!removed.contains(sample.sample_index)) log.append(kSample, sample);
    }
    return holed;
  };
  const auto expect = [&](const std::string& name, const fs::path& log, const std::string& flags,
                          int samples, const std::string& said) {
    ASSERT_EQ(replay_group(name, log, "--rig arm2 " + flags), 0)
        << text_of(folder_ / (name + ".err"));
    EXPECT_EQ(result(name)["samples"], samples);
    const std::string out = text_of(folder_ / (name + ".out"));
    EXPECT_NE(out.find("\n" + said + "\n"), std::string::npos) << out;
  };
  const fs::path middle = without("middle", {7});
  expect("without 7", middle, "", 14, "lost SAMPLE 7");
  expect("without 7, played", middle, "--speed 20", 14, "lost SAMPLE 7");
  expect("without the first", without("first five", {0, 1, 2, 3, 4}), "", 10, "lost SAMPLE 0…4");
  EXPECT_EQ(result("without the first")["lost_samples"], nlohmann::json({{0, 4}}));
}

TEST_F(Arm2, TheRecordingInLogsTeachesTheStructure) {
  ASSERT_EQ(replay_group("example", kSource / "logs/arm2_15.lcmlog", "--rig arm2"), 0)
      << text_of(folder_ / "example.err");
  EXPECT_EQ(text_of(folder_ / "example.err").find("cannot be read"), std::string::npos)
      << "make it again, as logs/README.md says: " << text_of(folder_ / "example.err");
  const RigTruth truth(kSource / "config/arm2");
  const auto schemas = read_log(run("example") / "schema.lcmlog", kBodySchema);
  ASSERT_EQ(schemas.size(), 1u);
  EXPECT_EQ(truth.objection(from_message(schemas[0]), truth.parts()), "");
  EXPECT_EQ(result("example")["samples"], 15);
}

TEST_F(Arm2, AReplayOfSamplesThatAreCutOffSaysWhereAndLearnsFromTheRest) {
  const fs::path whole = run("first") / "samples.lcmlog", cut = folder_ / "cut.lcmlog";
  fs::copy_file(whole, cut, fs::copy_options::overwrite_existing);
  fs::resize_file(cut, fs::file_size(whole) * 9 / 10);
  // No rig is named and none lies beside the log: it is found from the samples.
  ASSERT_EQ(replay_group("cut", cut), 0) << text_of(folder_ / "cut.err");
  EXPECT_EQ(result("cut")["rig"], "arm2");
  const int whole_samples = static_cast<int>(read_log(cut, kSample).size());
  EXPECT_EQ(result("cut")["samples"], whole_samples);
  EXPECT_EQ(result("cut")["structure"]["complete"], true);
  EXPECT_EQ(result("cut")["held_out_against"], "observations");
  const std::string said = text_of(folder_ / "cut.err");
  EXPECT_NE(said.find("is cut off in the middle of an event at byte "), std::string::npos) << said;
  EXPECT_NE(said.find("; the " + std::to_string(whole_samples) + " events before it are good"),
            std::string::npos)
      << said;
}

TEST_F(Arm2, AReplayOfAnOlderVersionsLogIsRefusedWithTheReason) {
  const fs::path older = folder_ / "older.lcmlog";
  {
    LogAppender log(older, LogAppender::Mode::kOverwrite, LogAppender::Durability::kToKernel);
    for_each_event(run("first") / "samples.lcmlog", [&](const LogEvent& event) {
      std::vector<std::uint8_t> data = event.data;
      data[0] ^= 1;  // the fingerprint
      log.append_bytes(event.channel, data, event.event_utime);
    });
  }
  EXPECT_NE(replay_group("older", older, "--rig arm2"), 0);
  const std::string said = text_of(folder_ / "older.err");
  EXPECT_NE(said.find("SAMPLE: 30 of 30 messages cannot be read: fingerprint "), std::string::npos)
      << said;
  EXPECT_NE(said.find("built from other message definitions"), std::string::npos) << said;
  EXPECT_NE(said.find("holds nothing to learn from"), std::string::npos) << said;
  EXPECT_FALSE(fs::exists(run("older"))) << "a run was begun";
}

}  // namespace
}  // namespace bodyschema::test
