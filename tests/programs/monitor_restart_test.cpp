// The program model_monitor, killed and started again while a joint sticks: it ends with the same
// result as without kills.

#include <gtest/gtest.h>
#include <sys/wait.h>

#include <algorithm>
#include <csignal>
#include <filesystem>
#include <fstream>
#include <random>
#include <string>
#include <vector>

#include "common/bus/convert.h"
#include "common/bus/event_log.h"
#include "processes/structure_learner/learn.h"
#include "tests/common/bus/bus_test_support.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

namespace fs = std::filesystem;

const fs::path kRig = BODYSCHEMA_CONFIG "/arm2";
constexpr std::int64_t kNumSamples = 45, kStuckFrom = 27;

/// A 2-DOF robot in a rig of its own, and its messages on the bus.
class MonitorRestartTest : public testing::Test {
 protected:
  MonitorRestartTest() {
    test::Rng rng(31);
    robot_ = test::chapter_robot("a", rng);
    fs::copy(kRig, folder_ / "rig");
    std::ofstream signals(folder_ / "rig" / "signals.yaml");
    signals.precision(17);
    signals << "signals:\n";
    for (const Signal& signal : robot_.signals)
      signals << "  - {name: " << signal.name << ", lower: " << signal.lower
              << ", upper: " << signal.upper << "}\n";
    signals << "root_part: 1\nend_effector_part: 5\n";

    const test::ObservationOptions options{
        .regime = test::Regime::kTag, .with_covariances = true, .with_other_hypothesis = true};
    std::vector<ActionPoseSample> samples = test::babble(robot_, kStuckFrom, options, rng);
    // Signal 1 sticks; the sample has the command.
    for (ActionPoseSample sample : test::babble(robot_, kNumSamples - kStuckFrom, options, rng)) {
      Eigen::VectorXd stuck = sample.action;
      stuck(1) = 0.4;
      const auto healthy = robot_.poses_in_camera(sample.action);
      const auto poses = robot_.poses_in_camera(stuck);
      for (PartObservation& part : sample.parts) {
        const Pose change = poses.at(part.part) * healthy.at(part.part).inverse();
        part.X_CB = change * part.X_CB;
        if (part.X_CB_other) part.X_CB_other = change * *part.X_CB_other;
      }
      samples.push_back(sample);
    }
    for (std::int64_t i = 0; i < kNumSamples; ++i) {
      ActionPoseSample& sample = samples[static_cast<std::size_t>(i)];
      sample.sample_index = i;
      sample.utime = 1'000'000 * (i + 1);
      sample.purpose = i % 5 == 4 ? Purpose::kTest : Purpose::kTrain;
    }
    for (std::int64_t i = 0; i < kNumSamples; ++i) {
      samples_.push_back(to_message(samples[static_cast<std::size_t>(i)]));
      if (i % 5 != 4) continue;
      std::vector<ActionPoseSample> training;
      for (const ActionPoseSample& sample : samples) {
        if (sample.sample_index <= std::min<std::int64_t>(i, 24) &&
            sample.purpose == Purpose::kTrain)
          training.push_back(sample);
      }
      LearnOptions learn_options;
      learn_options.root = 1;
      BodySchema schema = learn(robot_.signals, training, learn_options).schema;
      schema.last_sample_index = i;
      schema.utime = samples_.back().utime;
      proposals_.push_back(to_message(schema));
    }
  }

  /// A log of the samples up to `last`, with the proposals between them or without.
  fs::path log_up_to(std::int64_t last, bool with_proposals) {
    const fs::path file =
        folder_ / ((with_proposals ? "bus_" : "samples_") + std::to_string(last) + ".lcmlog");
    fs::remove(file);
    LogAppender log(file);
    for (std::int64_t i = 0; i <= last; ++i) {
      log.append(kSample, samples_[static_cast<std::size_t>(i)]);
      if (with_proposals && i % 5 == 4)
        log.append(kLearnedSchema, proposals_[static_cast<std::size_t>(i / 5)]);
    }
    return file;
  }
  std::vector<std::string> arguments(const fs::path& in, const std::string& name,
                                     const fs::path& samples) const {
    return {BODYSCHEMA_BIN "/model_monitor",
            "--config",
            folder_ / "rig" / "model_monitor.yaml",
            "--in",
            "file://" + in.string() + "?speed=0",
            "--out",
            "file://" + out(name).string() + "?mode=w",
            "--schema",
            folder_ / name / "schema.lcmlog",
            "--samples",
            samples};
  }
  fs::path out(const std::string& name) const { return folder_ / name / "out.lcmlog"; }
  void run(std::int64_t last, const std::string& name, const fs::path& samples) {
    fs::create_directories(folder_ / name);
    test::Program program(arguments(log_up_to(last, true), name, samples));
    ASSERT_EQ(program.wait(), 0) << program.err();
  }
  template <class Message>
  std::vector<std::uint8_t> last_of(const std::string& name, Channel<Message> channel) const {
    const std::vector<Message> all = read_log(out(name), channel);
    return all.empty() ? std::vector<std::uint8_t>() : encode(channel, all.back());
  }

  test::TemporaryFolder folder_;
  test::SyntheticRobot robot_;
  std::vector<sample_t> samples_;
  std::vector<body_schema_t> proposals_;
};

TEST_F(MonitorRestartTest, AfterAnEndAtAnyMomentItEndsWithTheSameSchemaAndHealth) {
  ASSERT_NO_FATAL_FAILURE(run(kNumSamples - 1, "undisturbed", folder_ / "none"));
  const auto schema = last_of("undisturbed", kBodySchema);
  const auto health = last_of("undisturbed", kModelHealth);
  ASSERT_FALSE(schema.empty());
  const auto events = read_log(out("undisturbed"), kModelHealth).back().events;
  ASSERT_TRUE(std::any_of(events.begin(), events.end(), [](const health_event_t& event) {
    return event.event_kind == health_event_t::EVENT_CANDIDATE;
  }));
  for (const std::int64_t ended_after : {3, 11, 19, 27, 29, 31, 38}) {
    const std::string name = "ended_" + std::to_string(ended_after);
    // The second start finds the samples that the observer had written by then.
    ASSERT_NO_FATAL_FAILURE(run(ended_after, name, folder_ / "none"));
    ASSERT_NO_FATAL_FAILURE(run(kNumSamples - 1, name, log_up_to(ended_after, false)));
    EXPECT_EQ(last_of(name, kBodySchema), schema) << ended_after;
    EXPECT_EQ(last_of(name, kModelHealth), health) << ended_after;
  }
}

TEST_F(MonitorRestartTest, KilledInTheMiddleOfItAllItEndsWithTheSameFiles) {
  ASSERT_NO_FATAL_FAILURE(run(kNumSamples - 1, "undisturbed", folder_ / "none"));
  const fs::path all = log_up_to(kNumSamples - 1, true);
  const auto written = test::read_bytes(out("undisturbed")).size();
  for (int eighth = 0; eighth < 8; ++eighth) {
    const std::string name = "killed_" + std::to_string(eighth);
    fs::create_directories(folder_ / name);
    {
      test::Program program(arguments(all, name, folder_ / "none"));
      // As soon as so much was written.
      const auto is_running = [&] {
        siginfo_t ended{};
        waitid(P_PID, static_cast<id_t>(program.pid()), &ended, WEXITED | WNOHANG | WNOWAIT);
        return ended.si_pid == 0;
      };
      while (is_running() &&
             (!fs::exists(out(name)) || fs::file_size(out(name)) < written * eighth / 8)) {
      }
      program.send_signal(SIGKILL);
      program.wait();
    }
    ASSERT_NO_FATAL_FAILURE(run(kNumSamples - 1, name, folder_ / "none"));
    for (const char* file : {"schema.lcmlog", "history.lcmlog"}) {
      EXPECT_EQ(test::read_bytes(folder_ / name / file),
                test::read_bytes(folder_ / "undisturbed" / file))
          << name << " " << file;
    }
  }
}

// A bit lost by a disk gives no wrong body schema: the end is the same, or the monitor reports the
// file that it could not use.
TEST_F(MonitorRestartTest, AFlippedBitIsHarmlessOrNoticed) {
  constexpr std::int64_t kEndedAfter = 38;
  ASSERT_NO_FATAL_FAILURE(run(kNumSamples - 1, "undisturbed", folder_ / "none"));
  ASSERT_NO_FATAL_FAILURE(run(kEndedAfter, "ended", folder_ / "none"));
  const fs::path bus = log_up_to(kNumSamples - 1, true);
  std::mt19937_64 random(13);
  for (const char* file : {"history.lcmlog", "schema.lcmlog", "samples.lcmlog"}) {
    for (int n = 0; n < 6; ++n) {
      const std::string name = std::string(file) + std::to_string(n);
      fs::copy(folder_ / "ended", folder_ / name);
      fs::copy_file(log_up_to(kEndedAfter, false), folder_ / name / "samples.lcmlog");
      auto bytes = test::read_bytes(folder_ / name / file);
      const std::size_t bit = random() % (8 * bytes.size());
      bytes[bit / 8] ^= static_cast<std::uint8_t>(1U << bit % 8);
      test::write_bytes(folder_ / name / file, bytes);
      test::Program program(arguments(bus, name, folder_ / name / "samples.lcmlog"));
      ASSERT_EQ(program.wait(), 0) << program.err();
      EXPECT_NE(program.err().find(file), std::string::npos)
          << "bit " << bit << " of " << file << ": " << program.err();
      if (std::string(file) != "schema.lcmlog") continue;
      // It is found again from the history and the samples.
      EXPECT_EQ(last_of(name, kBodySchema), last_of("undisturbed", kBodySchema)) << "bit " << bit;
      EXPECT_EQ(last_of(name, kModelHealth), last_of("undisturbed", kModelHealth)) << "bit " << bit;
    }
  }
}

TEST_F(MonitorRestartTest, AHistoryOfOtherSamplesIsSetAside) {
  ASSERT_NO_FATAL_FAILURE(run(38, "ended", folder_ / "none"));
  const fs::path fewer = folder_ / "fewer.lcmlog";
  fs::copy_file(log_up_to(20, false), fewer);
  test::Program program(arguments(log_up_to(kNumSamples - 1, true), "ended", fewer));
  ASSERT_EQ(program.wait(), 0) << program.err();
  EXPECT_NE(program.err().find("rests on samples up to 38, the newest in fewer.lcmlog is 20"),
            std::string::npos)
      << program.err();
  EXPECT_TRUE(fs::exists(folder_ / "ended" / "history.lcmlog.bad-1"));
  EXPECT_TRUE(fs::exists(folder_ / "ended" / "schema.lcmlog.bad-1"));
  // From the samples alone, as without a history.
  ASSERT_NO_FATAL_FAILURE(run(kNumSamples - 1, "undisturbed", folder_ / "none"));
  EXPECT_EQ(last_of("ended", kBodySchema), last_of("undisturbed", kBodySchema));
}

TEST_F(MonitorRestartTest, BeginsWithAnInitialSchemaWhateverLimitsItsRecordingHad) {
  body_schema_t initial = proposals_[4];
  initial.schema_version = 7;
  for (signal_t& signal : initial.signals) {
    signal.upper_limit -= 0.01;
    signal.covered_upper = std::min(signal.covered_upper, signal.upper_limit);
  }
  const fs::path file = folder_ / "initial.lcmlog";
  const auto begin = [&](const std::string& name) {
    write_one_event_log(file, kBodySchema, initial);
    fs::create_directories(folder_ / name);
    auto with = arguments(log_up_to(kNumSamples - 1, false), name, folder_ / "none");
    with.insert(with.end(), {"--initial", file});
    test::Program program(with);
    const int code = program.wait();
    return std::pair(code, program.err());
  };
  EXPECT_EQ(begin("begun").first, 0);
  const std::vector<body_schema_t> schemas = read_log(out("begun"), kBodySchema);
  ASSERT_FALSE(schemas.empty());
  EXPECT_EQ(schemas[0].num_edges, initial.num_edges);
  for (std::size_t s = 0; s < robot_.signals.size(); ++s)
    EXPECT_EQ(schemas[0].signals[s].upper_limit, robot_.signals[s].upper);

  initial.signals[0].signal_name = "another";
  const auto [code, err] = begin("refused");
  EXPECT_NE(code, 0);
  EXPECT_NE(err.find("initial.lcmlog: signal 'another'"), std::string::npos) << err;
}

}  // namespace
}  // namespace bodyschema
