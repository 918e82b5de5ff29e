// bodyschema monitor: a schema held against a recording.

#include <gtest/gtest.h>

#include <filesystem>
#include <map>
#include <nlohmann/json.hpp>
#include <string>
#include <vector>

#include "common/bus/convert.h"
#include "common/bus/event_log.h"
#include "common/geometry/angle.h"
#include "tests/programs/bodyschema_program.h"
#include "tests/support/imperfect_robot.h"

namespace bodyschema::test {
namespace {

/// The joint of q2 stands where a command of 0.4 had turned it.
SyntheticRobot with_q2_stuck(SyntheticRobot robot) {
  for (TrueLink& link : robot.links) {
    if (link.signal != 1) continue;
    Vector6d turned = Vector6d::Zero();
    turned(5) = link.turn * 0.4;
    link.X_before = link.X_before * exp(turned);
    link.signal = -1;
  }
  return robot;
}

TEST_F(BodyschemaProgramTest, MonitorFindsAStuckJointNamesItAndWritesTheRepairedSchema) {
  Rng rng(73);
  const SyntheticRobot robot = chapter_robot("a", rng);
  const SyntheticRobot stuck = with_q2_stuck(robot);
  ObservationOptions options;
  options.regime = Regime::kTagIso;
  const auto learned = write("learned.csv", babble(robot, 60, options, rng));
  std::vector<ActionPoseSample> samples;
  for (int n = 0; n < 80; ++n)
    samples.push_back(observe(n < 40 ? robot : stuck, robot.random_action(rng), options, n, rng));
  const auto changing = write("changing.csv", samples);
  options.regime = Regime::kFree;
  const auto truth = write("truth.csv", babble(stuck, 20, options, rng));
  run({"learn", learned, "--noise", "0.003", "1", "--out", "schema.lcmlog"});

  const Outcome outcome = run({"monitor", "schema.lcmlog", changing, "--noise", "0.003", "1",
                               "--evaluate", truth, "--out", "repaired.lcmlog", "--json"});
  ASSERT_EQ(outcome.exit_code, 0) << outcome.err;
  const std::vector<Json> lines = lines_of(outcome.out);
  int num_judged = 0;
  std::vector<std::string> causes;
  for (const Json& line : lines) {
    if (line.contains("event")) {
      EXPECT_GE(line["sample"], 40) << line;
      if (line["event"] == "candidate" || line["event"] == "refined")
        causes.push_back(line["cause"]);
      if (line["event"] == "candidate") {
        EXPECT_TRUE(line["signal"].is_string()) << line;
        EXPECT_NEAR(line["amount"]["command"].get<double>(), 0.4, 0.05) << line;
        EXPECT_GT(line["amount_sd"]["command"], 0) << line;
        EXPECT_EQ(line["since"], 40) << line;
      }
      EXPECT_TRUE(line.contains("margin") && line.contains("samples_used") && line.contains("t"));
      EXPECT_TRUE(line.contains("part") != (line.contains("from") && line.contains("to"))) << line;
      continue;
    }
    EXPECT_EQ(line["sample"], num_judged++);
    for (const Json& part : line["parts"]) {
      const double error = part["position_rms_m"];
      if (line["sample"] >= 50) {
        EXPECT_LT(error, 0.02) << line;
      }
    }
  }
  EXPECT_EQ(num_judged, 80);
  ASSERT_FALSE(causes.empty());
  EXPECT_EQ(causes.back(), "joint_stuck");
  const Json errors = run({"predict", "repaired.lcmlog", truth, "--json"}).json();
  for (const Json& part : errors["parts"]) EXPECT_LT(part["position_rms_m"], 0.02) << part;

  // The same again gives the same bytes; people get a line an event.
  EXPECT_EQ(run({"monitor", "schema.lcmlog", changing, "--noise", "0.003", "1", "--evaluate", truth,
                 "--json"})
                .out,
            outcome.out);
  const Outcome text = run({"monitor", "schema.lcmlog", changing, "--noise", "0.003", "1"});
  EXPECT_NE(text.out.find("q2 (3→4) stuck at 0."), std::string::npos) << text.out;
  EXPECT_NE(text.out.find("since sample 40: adopted"), std::string::npos) << text.out;
  EXPECT_NE(text.out.find("80 samples, "), std::string::npos) << text.out;
}

TEST_F(BodyschemaProgramTest, MonitorSaysNothingOfAHealthyBody) {
  const auto csv = write_robot("robot.csv");
  run({"learn", csv, "--out", "schema.lcmlog"});
  Rng rng(74);
  ObservationOptions options;
  options.regime = Regime::kTagIso;
  const auto later = write("later.csv", babble(robot_, 200, options, rng));
  const Outcome outcome = run({"monitor", "schema.lcmlog", later, "--json"});
  EXPECT_EQ(outcome.exit_code, 0) << outcome.err;
  EXPECT_EQ(outcome.out, "");
}

TEST_F(BodyschemaProgramTest, PositionsAloneAreLearnedShownPredictedAndMonitored) {
  Rng rng(75);
  robot_ = chapter_robot("a", rng);
  const int leaf = robot_.visible_parts().back();
  const auto csv_of = [&](const std::string& name, int num_samples) {
    return write(name,
                 with_positions_alone(babble(robot_, num_samples, {Regime::kTagIso}, rng), {leaf}));
  };
  const Json learned =
      run({"learn", csv_of("s.csv", 100), "--out", "schema.lcmlog", "--json"}).json();
  EXPECT_TRUE(learned["complete"].get<bool>()) << learned.dump(1);
  EXPECT_EQ(learned["position_parts"], Json({leaf}));
  for (const Json& edge : learned["edges"])
    EXPECT_EQ(edge.at("rotation_rms_deg").is_null(), edge.at("to") == leaf);
  const Json shown = run({"show", "schema.lcmlog", "--json"}).json();
  for (const Json& edge : shown["edges"]) {
    EXPECT_EQ(edge.at("rotation_sd_deg").is_null(), edge.at("to") == leaf);
    EXPECT_GT(edge.at("position_sd_m").get<double>(), 0);
  }
  EXPECT_NE(run({"show", "schema.lcmlog"}).out.find("position alone"), std::string::npos);
  const auto later = csv_of("later.csv", 150);
  const Json predicted = run({"predict", "schema.lcmlog", later, "--json"}).json();
  for (const Json& part : predicted["parts"]) {
    EXPECT_LT(part.at("position_median_m").get<double>(), 0.02);
    EXPECT_EQ(part.at("rotation_median_deg").is_null(), part.at("part") == leaf);
    EXPECT_EQ(part.at("rotation_rms_deg").is_null(), part.at("part") == leaf);
  }
  const Outcome monitored = run({"monitor", "schema.lcmlog", later, "--json"});
  EXPECT_EQ(monitored.exit_code, 0) << monitored.err;
  EXPECT_EQ(monitored.out, "");
  expect_failure({"learn", later, "--method", "chapter"}, "needs orientations", 1);
  expect_failure({"monitor", "schema.lcmlog", later, "--method", "chapter"}, "needs orientations",
                 1);
  expect_failure({"learn", write("half.csv", "t,q1,part,x,y,z,qw,qx,qy,qz\n0,0,1,0,0,0,1,,,\n")},
                 "half.csv:2:", 1);
}

TEST_F(BodyschemaProgramTest, WildPosesAreSeenWhateverRateTheRigBesideALogTells) {
  Rng rng(76);
  robot_ = chapter_robot("a", rng);
  const ObservationOptions options{.regime = Regime::kTagIso, .with_covariances = true};
  {
    LogAppender log(folder_ / "run.lcmlog");
    for (ActionPoseSample& sample : babble(robot_, 100, options, rng)) {
      for (PartObservation& part : sample.parts)
        if (uniform(rng, 0, 1) < 0.1) part.X_CB = random_pose(rng, 1, 2);
      log.append(kSample, to_message(sample));
    }
  }
  std::filesystem::create_directory(folder_ / "config");
  std::map<std::string, std::size_t> num_edges, events;
  for (const std::string rate : {"0.3", "0.001"}) {
    write("config/noise.yaml",
          "tag_position_m: 0\ntag_rotation_deg: 0\ntag_size_share: 0\n"
          "systematic_position_m: 0.0005\nsystematic_rotation_deg: 0.1\n"
          "corner_noise_px: 0.05\nsmall_tag_noise_px: 0.15\noutlier_rate: " +
              rate + "\n");
    std::vector<std::string> learn = {"learn", "run.lcmlog", "--json"};
    if (!exists("schema.lcmlog")) learn.insert(learn.end(), {"--out", "schema.lcmlog"});
    num_edges[rate] = run(learn).json()["edges"].size();
    events[rate] = run({"monitor", "schema.lcmlog", "run.lcmlog", "--json"}).out.size();
  }
  EXPECT_EQ(num_edges["0.3"], 4U);
  // Learner and monitor see that they are wild, whatever is told.
  EXPECT_EQ(num_edges["0.001"], 4U);
  EXPECT_EQ(events["0.3"], 0U);
  EXPECT_EQ(events["0.001"], 0U);
  write("config/noise.yaml", "tag_position_m: 0\noutlier_rate: often\n");
  expect_failure({"learn", "run.lcmlog"}, "noise.yaml");
  expect_failure({"report", "run.lcmlog"}, "noise.yaml");
}

TEST_F(BodyschemaProgramTest, AStreamWhosePosesComeLateIsLearnedAndMonitored) {
  constexpr std::size_t kLate = 3;
  const auto recorded = [&](const char* name, double bend_rad) {
    const auto commands = ImperfectRobot(3, true, {}, 5).wander(1200, 120);
    ImperfectRobot robot(3, true, {}, 5);
    std::vector<ActionPoseSample> samples;
    for (std::size_t n = 0; n + kLate < commands.size(); ++n) {
      if (n == 600) robot.bend(2, 0, bend_rad);
      samples.push_back(robot.go(commands[n].action));
      samples.back().action = commands[n + kLate].action;
    }
    return write(name, samples);
  };
  const Outcome learned =
      run({"learn", recorded("late.csv", 0), "--json", "--out", "schema.lcmlog"});
  EXPECT_TRUE(learned.json()["complete"].get<bool>()) << learned.out;
  EXPECT_NEAR(learned.json()["command_lag_s"].get<double>(), kLate, 0.1);  // at 1 Hz
  const Outcome healthy = run({"monitor", "schema.lcmlog", "late.csv", "--json"});
  EXPECT_EQ(healthy.out, "");
  EXPECT_NE(healthy.err.find("late.csv: the poses come "), std::string::npos) << healthy.err;
  const Outcome bent =
      run({"monitor", "schema.lcmlog", recorded("bent.csv", 10 * kDegree), "--json"});
  EXPECT_NE(bent.out.find("\"geometry\""), std::string::npos) << bent.out;
}

TEST_F(BodyschemaProgramTest, MonitorRefusesWhatDoesNotBelongTogether) {
  const auto csv = write_robot("robot.csv");
  run({"learn", csv, "--out", "schema.lcmlog"});
  Rng rng(75);
  const auto other = write("other.csv", babble(chapter_robot("c", rng), 5, {}, rng));
  expect_failure({"monitor", "schema.lcmlog", other}, "other.csv: the signals of the samples are");
  expect_failure({"monitor", "schema.lcmlog", csv, "--evaluate", other}, "other.csv");
  expect_failure({"monitor", "schema.lcmlog", csv, "--out", csv}, "--out");
  expect_failure({"monitor", "schema.lcmlog", csv, "--out", "/dev/null"}, "no regular file");
  expect_failure({"monitor", "schema.lcmlog", csv, "--out", "no such folder/out.lcmlog"},
                 "cannot write no such");
  expect_failure({"monitor", csv, csv}, "robot.csv");
  auto samples = babble(robot_, 5, {}, rng);
  for (ActionPoseSample& sample : samples)
    for (PartObservation& o : sample.parts) o.part += 100;
  expect_failure({"monitor", "schema.lcmlog", write("elsewhere.csv", samples)},
                 "none of the parts of schema.lcmlog");
}

}  // namespace
}  // namespace bodyschema::test
