#include "processes/console/run_watch.h"

#include <gtest/gtest.h>

#include "common/bus/convert.h"

namespace bodyschema {
namespace {

sample_t sample(std::int64_t index, const std::vector<int>& parts,
                Purpose purpose = Purpose::kTrain) {
  ActionPoseSample result;
  result.sample_index = index;
  result.purpose = purpose;
  result.action = Eigen::VectorXd::Constant(1, 0.1 * static_cast<double>(index));
  for (const int part : parts) {
    PartObservation seen;
    seen.part = part;
    seen.X_CB.translation() = Eigen::Vector3d(part, 0, 0.01);  // 1 cm of noise
    result.parts.push_back(seen);
  }
  sample_t message = to_message(result);
  message.action_id = 100 + index;
  message.utime = 1000 * (message.action_id + 1) + 500;  // a frame after the arm had come to rest
  return message;
}

sim_state_t truth(std::int64_t action_id, const std::vector<int>& parts) {
  sim_state_t state{};
  state.utime = 1000 * (action_id + 1);
  state.action_id = action_id;
  // The camera stands at (0, 0, 5) in the world, without rotation.
  Pose X_WC = Pose::Identity();
  X_WC.translation().z() = 5;
  state.X_WC = to_message(X_WC);
  std::vector<pose_t> X_WB;
  for (const int part : parts) {
    Pose X = Pose::Identity();
    X.translation() = Eigen::Vector3d(part, 0, 5);
    X_WB.push_back(to_message(X));
  }
  state.num_parts = static_cast<std::int32_t>(parts.size());
  state.true_part.assign(parts.begin(), parts.end());
  state.X_WB = X_WB;
  return state;
}

process_info_t info(const std::string& name, std::int8_t phase, const std::string& activity = "") {
  process_info_t message{};
  message.process_name = name;
  message.phase = phase;
  message.activity = activity;
  return message;
}

model_health_t health(std::int64_t judged_sample) {
  model_health_t message{};
  message.judged_sample = judged_sample;
  message.worst_position_m = 0.0042;
  message.worst_rotation_rad = 0.01;
  return message;
}

TEST(RunWatchTest, ARunIsFinishedWhenTheBabblerIsDoneAndTheLastSampleJudged) {
  RunWatch watch;
  EXPECT_FALSE(watch.is_finished());
  watch.on_process_info(info("motor_babbler", process_info_t::PHASE_WORKING), 0);
  watch.on_sample(sample(0, {1}));
  watch.on_sample(sample(1, {1}, Purpose::kTest));
  watch.on_model_health(health(1));
  EXPECT_FALSE(watch.is_finished());
  watch.on_process_info(info("robot_simulator", process_info_t::PHASE_DONE), 0);
  EXPECT_FALSE(watch.is_finished());
  watch.on_process_info(info("motor_babbler", process_info_t::PHASE_DONE), 0);
  EXPECT_TRUE(watch.is_finished());
  // The monitor judges at TEST samples: there is nothing to wait for after another.
  watch.on_sample(sample(2, {1}));
  EXPECT_TRUE(watch.is_finished());
  watch.on_sample(sample(3, {1}, Purpose::kTest));
  watch.on_sample(sample(4, {1}));
  EXPECT_FALSE(watch.is_finished());
  watch.on_model_health(health(3));
  EXPECT_TRUE(watch.is_finished());
}

TEST(RunWatchTest, ARunWithoutSamplesOrVerdictIsNotFinished) {
  RunWatch watch;
  watch.on_process_info(info("motor_babbler", process_info_t::PHASE_DONE), 0);
  EXPECT_FALSE(watch.is_finished());
  watch.on_sample(sample(0, {1}, Purpose::kTest));
  EXPECT_FALSE(watch.is_finished());
}

TEST(RunWatchTest, AReplayHasCaughtUpWhenItsSamplesAreLearnedAndJudged) {
  RunWatch watch;
  body_schema_t learned{};
  learned.last_sample_index = 0;
  watch.on_learned_schema(learned);
  EXPECT_FALSE(watch.is_caught_up());  // nothing was replayed yet
  watch.on_sample(sample(0, {1}));
  EXPECT_TRUE(watch.is_caught_up());
  watch.on_sample(sample(1, {1}, Purpose::kTest));
  learned.last_sample_index = 1;
  watch.on_learned_schema(learned);
  EXPECT_FALSE(watch.is_caught_up());
  watch.on_model_health(health(1));
  EXPECT_TRUE(watch.is_caught_up());
  watch.on_sample(sample(2, {1}));
  EXPECT_FALSE(watch.is_caught_up());
}

TEST(RunWatchTest, SilentIsWhoWasNotHeardForThreeSeconds) {
  RunWatch watch;
  watch.on_process_info(info("camera", process_info_t::PHASE_WORKING), 1'000'000);
  watch.on_process_info(info("observer", process_info_t::PHASE_WORKING), 3'000'000);
  const std::set<std::string> all = {"camera", "log", "observer"};
  EXPECT_EQ(watch.silent(all, 3'000'000), (std::set<std::string>{"log"}));
  EXPECT_EQ(watch.silent(all, 5'000'000), (std::set<std::string>{"camera", "log"}));
}

TEST(RunWatchTest, WhoIsStartingDoesNotListenYet) {
  RunWatch watch;
  watch.on_process_info(info("observer", process_info_t::PHASE_STARTING), 1'000'000);
  EXPECT_TRUE(watch.silent({"observer"}, 2'000'000).empty());
  EXPECT_FALSE(watch.are_listening({"observer"}, 2'000'000));
  process_info_t observer = info("observer", process_info_t::PHASE_WAITING);
  counter_t heard{};
  heard.counter_name = "received MARKER_POSES";
  heard.count = 7;
  set_array(observer.num_counters, observer.counters, std::vector<counter_t>{heard});
  watch.on_process_info(observer, 2'000'000);
  EXPECT_TRUE(watch.are_listening({"observer"}, 3'000'000));
  EXPECT_FALSE(watch.are_listening({"observer", "model_monitor"}, 3'000'000));
  EXPECT_EQ(watch.counter("observer", "received MARKER_POSES"), 7);
  EXPECT_EQ(watch.counter("observer", "received SAMPLE"), 0);
  EXPECT_EQ(watch.counter("camera", "received MARKER_POSES"), 0);
}

TEST(RunWatchTest, ABabblerThatWasEndedIsNotDone) {
  RunWatch watch;
  watch.on_sample(sample(0, {1}, Purpose::kTest));
  watch.on_model_health(health(0));
  watch.on_process_info(info("motor_babbler", process_info_t::PHASE_ENDED), 0);
  EXPECT_FALSE(watch.is_finished());
}

TEST(RunWatchTest, ARunWithoutTestsIsFinishedWithTheBabbler) {
  RunWatch watch;
  watch.on_sample(sample(0, {1}));
  EXPECT_FALSE(watch.is_finished());
  watch.on_process_info(info("motor_babbler", process_info_t::PHASE_DONE), 0);
  EXPECT_TRUE(watch.is_finished());
}

TEST(RunWatchTest, RepeatedSamplesAreCountedOnceAlsoAfterALoss) {
  RunWatch watch;
  for (const std::int64_t index : {0, 0, 1, 4, 4, 2, 5, 5}) watch.on_sample(sample(index, {1}));
  ASSERT_EQ(watch.num_samples(), 4);
  std::vector<std::int64_t> indices;
  for (const auto& s : watch.samples()) indices.push_back(s.sample_index);
  EXPECT_EQ(indices, (std::vector<std::int64_t>{0, 1, 4, 5}));
}

TEST(RunWatchTest, HeldOutAreTheTestSamplesAsTheCameraSawThem) {
  RunWatch watch;
  watch.on_sample(sample(0, {1, 2}));
  watch.on_sample(sample(1, {1, 2}, Purpose::kTest));
  watch.on_sample(sample(2, {1}, Purpose::kTest));
  const auto held_out = watch.held_out();
  EXPECT_FALSE(watch.has_truth());
  ASSERT_EQ(held_out.size(), 2U);
  EXPECT_EQ(held_out[0].sample_index, 1);
  EXPECT_EQ(held_out[0].parts.size(), 2U);
  EXPECT_EQ(held_out[1].parts.size(), 1U);
  EXPECT_EQ(held_out[0].parts[0].X_CB.translation(), Eigen::Vector3d(1, 0, 0.01));
}

TEST(RunWatchTest, OfABodyThatChangedTheyMayBeThoseSince) {
  RunWatch watch;
  for (int n = 0; n < 6; ++n) watch.on_sample(sample(n, {1, 2}, Purpose::kTest));
  EXPECT_EQ(watch.body_since(), 0);
  BodySchema schema;
  schema.version = 6;
  schema.last_sample_index = 5;
  schema.changes = {{2, 1}, {5, 4}};
  watch.on_body_schema(to_message(schema));
  EXPECT_EQ(watch.body_since(), 4);
  const auto held_out = watch.held_out(watch.body_since());
  ASSERT_EQ(held_out.size(), 2U);
  EXPECT_EQ(held_out[0].sample_index, 4);
  EXPECT_EQ(watch.held_out().size(), 6U);
}

TEST(RunWatchTest, WithASimulatorTheyHoldTheTruthOfTheirAction) {
  RunWatch watch;
  watch.on_sim_state(truth(-1, {1, 2, 3}));
  for (std::int64_t i = 0; i < 3; ++i) {
    watch.on_sample(sample(i, {1}, Purpose::kTest));
    if (i != 1) watch.on_sim_state(truth(100 + i, {1, 2, 3}));
  }
  EXPECT_TRUE(watch.has_truth());
  const auto held_out = watch.held_out();
  ASSERT_EQ(held_out.size(), 2U);  // nobody knows the truth of sample 1
  EXPECT_EQ(held_out[1].sample_index, 2);
  EXPECT_EQ(held_out[1].action[0], 0.2);
  ASSERT_EQ(held_out[1].parts.size(), 3U);  // also what the camera did not see
  const Pose& X_CB = held_out[1].parts[2].X_CB;
  EXPECT_LT((X_CB.translation() - Eigen::Vector3d(3, 0, 0)).norm(), 1e-12);
}

// The controller counts its actions from 0 as the babbler does.
TEST(RunWatchTest, AnActionOfTheSameNumberOfAnotherSourceDoesNotChangeTheTruth) {
  RunWatch watch;
  watch.on_sim_state(truth(100, {1}));
  watch.on_sample(sample(0, {1}, Purpose::kTest));
  sim_state_t other = truth(100, {1});
  other.utime += 10'000;
  other.X_WB[0].position_m[0] = 77;
  watch.on_sim_state(other);
  ASSERT_EQ(watch.held_out().size(), 1U);
  EXPECT_LT((watch.held_out()[0].parts[0].X_CB.translation() - Eigen::Vector3d(1, 0, 0)).norm(),
            1e-12);
}

// The retained samples of a long run are kept, with their truths, in whatever order logs are read.
TEST(RunWatchTest, OfManySamplesTheRetainedOnesAndTheirTruthsAreKept) {
  constexpr std::int64_t kMany = 12'000;
  for (const bool has_truth_first : {true, false}) {
    RunWatch watch;
    if (has_truth_first)
      for (std::int64_t i = 0; i < kMany; ++i) watch.on_sim_state(truth(100 + i, {1}));
    for (std::int64_t i = 0; i < kMany; ++i)
      watch.on_sample(sample(i, {1}, i % 5 == 4 ? Purpose::kTest : Purpose::kTrain));
    if (!has_truth_first)
      for (std::int64_t i = 0; i < kMany; ++i) watch.on_sim_state(truth(100 + i, {1}));
    EXPECT_EQ(watch.num_samples(), kMany);
    EXPECT_EQ(watch.visibility().at(1), 1);
    EXPECT_EQ(watch.samples().size(), 1500U);
    const auto held_out = watch.held_out();
    ASSERT_EQ(held_out.size(), 300U);
    for (const ActionPoseSample& s : held_out) {
      EXPECT_EQ(s.sample_index % 8, 0);
      EXPECT_EQ(s.parts.at(0).X_CB.translation().z(), 0);  // the truth, not what was seen
    }
    EXPECT_EQ(watch.held_out(kMany - 100).size(), 20U);
  }
}

TEST(RunWatchTest, VisibilityIsAShareOfAllSamples) {
  RunWatch watch;
  EXPECT_TRUE(watch.visibility().empty());
  for (std::int64_t i = 0; i < 10; ++i)
    watch.on_sample(sample(i, i % 5 == 0 ? std::vector<int>{1, 7} : std::vector<int>{1}));
  const auto visibility = watch.visibility();
  ASSERT_EQ(visibility.size(), 2U);
  EXPECT_EQ(visibility.at(1), 1);  // exactly: it is printed
  EXPECT_EQ(visibility.at(7), 0.2);
}

TEST(RunWatchTest, TheLineOfProgressSaysWhatIsKnownAndWhatIsMissing) {
  RunWatch watch;
  EXPECT_EQ(watch.progress(),
            "   0 samples ·  0 parts, each seen in   0 % · 0 of 0 edges, no proposal yet");
  watch.on_sample(sample(0, {1, 2, 3}));
  watch.on_sample(sample(1, {1}));
  body_schema_t proposal{};
  unconnected_part_t two{}, three{};
  two.unconnected_part = 2;
  two.reason = unconnected_part_t::REASON_NOT_ENOUGH_DATA;
  three.unconnected_part = 3;
  three.reason = unconnected_part_t::REASON_NO_VALID_MODEL;
  set_array(proposal.num_unconnected, proposal.unconnected, {two, three});
  watch.on_learned_schema(proposal);
  EXPECT_EQ(watch.progress(),
            "   2 samples ·  3 parts, each seen in  67 % · 0 of 2 edges, missing: part 2 (not "
            "enough data yet), part 3 (no valid model)");
  set_array(proposal.num_unconnected, proposal.unconnected, {});
  watch.on_learned_schema(proposal);
  watch.on_model_health(health(1));
  EXPECT_EQ(watch.progress(),
            "   2 samples ·  3 parts, each seen in  67 % · 0 of 2 edges, not judged yet · worst "
            "part 4.2 mm 0.57° off, as the camera sees it, held out");
  model_health_t untested = health(1);
  untested.worst_position_m = -1;
  watch.on_model_health(untested);
  EXPECT_EQ(watch.progress().find("held out"), std::string::npos);
}

TEST(RunWatchTest, TheLineOfProgressSaysHowManyThereWillBeAndWhenAndWhatIsWrong) {
  RunWatch watch;
  watch.on_sample(sample(0, {1}));
  EXPECT_TRUE(
      watch.progress(SampleGoal{60, true}, 14.4).starts_with("   1 of 60 samples · 14 s left · "));
  EXPECT_TRUE(watch.progress(SampleGoal{60, true}).starts_with("   1 of 60 samples ·  1 parts"));
  EXPECT_TRUE(watch.progress(SampleGoal{300, false}, 70)
                  .starts_with("   1 of at most 300 samples · at most 70 s left · "));
  EXPECT_TRUE(watch.progress(SampleGoal{300, true}, 540)
                  .starts_with("   1 of 300 samples · 9 min left · "));
  EXPECT_EQ(watch.progress(SampleGoal{1, true}, 0.).find("left"), std::string::npos);
  model_health_t broken = health(1);
  finding_t finding{};
  set_array(broken.num_findings, broken.findings, {finding});
  watch.on_model_health(broken);
  EXPECT_TRUE(watch.progress().ends_with("The body is not as the schema says in 1 place."));
}

TEST(PaceTest, IsThatOfTheLastMinute) {
  Pace pace;
  EXPECT_FALSE(pace.seconds_for(10));
  pace.note(0, 0);
  EXPECT_FALSE(pace.seconds_for(10));
  for (int n = 1; n <= 100; ++n) pace.note(10 * n, n);  // slow at first
  for (int n = 1; n <= 100; ++n) pace.note(1000 + n, 100 + n);
  EXPECT_NEAR(pace.seconds_for(10).value(), 10, 0.2);
}

TEST(RunWatchTest, TheDiagnosisNamesWhoIsSilent) {
  RunWatch watch;
  const std::int64_t s = 1'000'000;
  watch.on_process_info(info("camera", process_info_t::PHASE_WORKING, "30 images/s"), 10 * s);
  watch.on_process_info(info("observer", process_info_t::PHASE_WAITING, "waiting for rest"),
                        10 * s);
  watch.on_process_info(info("observer", process_info_t::PHASE_WAITING, "waiting for tags"),
                        12 * s);
  EXPECT_EQ(watch.diagnosis({"camera", "observer", "motor_babbler"}, 13 * s + 1),
            "  camera             is silent\n"
            "  motor_babbler      is silent\n"
            "  observer           waiting for tags\n");
}

TEST(RunWatchTest, TheNewestSchemaStands) {
  RunWatch watch;
  EXPECT_FALSE(watch.schema());
  BodySchema schema;
  schema.version = 5;
  watch.on_body_schema(to_message(schema));
  schema.version = 10;
  watch.on_body_schema(to_message(schema));
  ASSERT_TRUE(watch.schema());
  EXPECT_EQ(watch.schema()->version, 10);
}

TEST(LastWords, AreTheLineOfAProcessThatEnded) {
  EXPECT_EQ(
      last_words("10:00:00.000 camera info: up\ncamera: c.yaml:1:1: fps is missing\n", "camera"),
      "c.yaml:1:1: fps is missing");
  EXPECT_EQ(last_words("camera: one\ncamera: two", "camera"), "two");
  // Started again, and going on.
  EXPECT_EQ(last_words("camera: one\n10:00:00.000 camera info: up\n", "camera"), "");
  EXPECT_EQ(last_words("", "camera"), "");
  EXPECT_EQ(last_words("\n\n", "camera"), "");
}

}  // namespace
}  // namespace bodyschema
