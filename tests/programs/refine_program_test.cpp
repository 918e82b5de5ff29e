#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <fstream>
#include <limits>
#include <string>
#include <vector>

#include "common/bus/convert.h"
#include "common/bus/event_log.h"
#include "common/config/camera_calibration.h"
#include "common/config/rig.h"
#include "tests/programs/program_test.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema::test {
namespace {

/// `bodyschema refine` on the recorded log of arm2, in a folder of its own.
class RefineProgramTest : public ProgramTest {
 protected:
  RefineProgramTest() { EXPECT_EQ(run("learn '" + log_ + "' --out schema").exit_code, 0); }

  Json json_of(const std::string& arguments) const { return run(arguments).json(); }
  void expect_failure(const std::string& arguments, int exit_code, const std::string& what) const {
    ProgramTest::expect_failure(arguments, what, exit_code);
  }

  const std::string log_ = BODYSCHEMA_LOGS "/arm2_15.lcmlog";
  const std::string rig_ = "--rig '" BODYSCHEMA_CONFIG "/arm2'";
};

TEST_F(RefineProgramTest, FitsCornersAndProposesFilesThatReadBack) {
  const Json json = json_of("refine schema '" + log_ + "' --out refined " + rig_ +
                            " --placements --intrinsics --proposed found --json");
  EXPECT_EQ(json.at("fitted"), "corners");
  EXPECT_EQ(json.at("before").at("samples"), 3);
  EXPECT_LT(json.at("after").at("corner_rms_px").get<double>(), 0.015);
  EXPECT_LT(json.at("after").at("corner_rms_px"), json.at("before").at("corner_rms_px"));
  for (const char* key : {"parameters", "correlations", "coverage", "plays", "tags", "lens"})
    EXPECT_FALSE(json.at(key).empty()) << key;
  EXPECT_TRUE(std::ranges::any_of(json.at("correlations"), [](const Json& c) {
    return c.at("advice") == "show tags 0, 1 in one image";
  }));
  const Markers markers = load_markers(folder_ / "found");
  ASSERT_EQ(markers.tags.size(), json.at("tags").size());
  for (std::size_t n = 0; n < markers.tags.size(); ++n)
    EXPECT_EQ(markers.tags[n].size_m, json.at("tags")[n].at("size_m").get<double>());
  const CameraCalibration camera = load_camera_calibration(folder_ / "found" / "camera_info.yaml");
  EXPECT_EQ(camera.fx, json.at("lens").at("fx_px").get<double>());
  const Json shown = json_of("show refined --json");
  EXPECT_EQ(shown.at("edges").size(), 4U);
  EXPECT_EQ(shown.at("base_version"), json_of("show schema --json").at("version"));
}

// A packed log has corners as well, and samples are counted from 0, whatever the log calls them.
TEST_F(RefineProgramTest, FitsTheCornersOfAPackedLogWhoseFirstSamplesAreMissing) {
  LogAppender later(folder_ / "later");
  for (const sample_t& sample : read_log(log_, kSample))
    if (sample.sample_index >= 2) later.append(kSample, sample);
  ASSERT_EQ(std::system(("gzip -k '" + (folder_ / "later").string() + "'").c_str()), 0);
  ASSERT_EQ(run("learn later --out schema").exit_code, 0);
  const std::string rest = " --out refined " + rig_ + " --placements --json";
  const Json json = json_of("refine schema later.gz" + rest);
  EXPECT_EQ(json.at("fitted"), "corners");
  Json plain = json_of("refine schema later" + rest);
  plain["seconds"] = json.at("seconds");
  EXPECT_EQ(plain, json);
  // As many as the learner has, of indices from 0 on.
  EXPECT_EQ(json.at("available"), json_of("show schema --json").at("samples"));
}

// What was fitted to poses is of their calibration, whatever it began with.
TEST_F(RefineProgramTest, OfPosesHasTheCalibrationOfTheSamples) {
  BodySchema other = from_message(read_log(folder_ / "schema", kBodySchema).back());
  const std::int64_t id = other.calibration_id;
  ASSERT_NE(id, 0);
  other.calibration_id = id + 1;
  write_one_event_log(folder_ / "other", kBodySchema, to_message(other));
  ASSERT_EQ(run("refine other '" + log_ + "' --out refined").exit_code, 0);
  EXPECT_EQ(read_log(folder_ / "refined", kBodySchema).back().calibration_id, id);
}

TEST_F(RefineProgramTest, FitsPosesWithoutAnOption) {
  const Json json = json_of("refine schema '" + log_ + "' --out refined --json");
  EXPECT_EQ(json.at("fitted"), "poses");
  EXPECT_EQ(json.at("samples"), 12);
  EXPECT_LT(json.at("after").at("parts")[0].at("position_rms_m").get<double>(), 0.001);
  EXPECT_FALSE(json.contains("tags"));
  ASSERT_EQ(json.at("wanted_actions").size(), 10U);
  for (const Json& wanted : json.at("wanted_actions")) {
    EXPECT_LE(std::abs(wanted.at("action").at("q2").get<double>()), 60);
    EXPECT_GT(wanted.at("reducible_fall"), 0);
  }
  const Outcome text = run("refine schema '" + log_ + "' --out refined");
  for (const char* words : {"12 samples", "held out, 3 samples", "gain of q1 (2→3)",
                            "actions (q1, q2) that would tell most"})
    EXPECT_NE(text.out.find(words), std::string::npos) << text.out;
}

// The same bytes on one processor with one thread as on all with many.
TEST_F(RefineProgramTest, TheNumberOfThreadsChangesNothing) {
  const std::string refine =
      "refine schema '" + log_ + "' " + rig_ + " --placements --intrinsics --proposed found --out ";
  ASSERT_EQ(run(refine + "one", "OMP_NUM_THREADS=1 taskset -c 0 ").exit_code, 0);
  const std::string found = text_of(folder_ / "found" / "markers.yaml");
  ASSERT_EQ(run(refine + "many", "OMP_NUM_THREADS=8 ").exit_code, 0);
  EXPECT_EQ(text_of(folder_ / "one"), text_of(folder_ / "many"));
  EXPECT_EQ(text_of(folder_ / "found" / "markers.yaml"), found);
}

TEST_F(RefineProgramTest, WritesTheUrdfThatUrdfMakesOfTheRefinedSchema) {
  const std::string refine = "refine schema '" + log_ + "' --out refined --urdf r.urdf ";
  const Json json = json_of(refine + "--urdf-placement p.yaml --json");
  EXPECT_EQ(json.at("urdf").at("file"), "r.urdf");
  EXPECT_EQ(json.at("urdf").at("moving_joints"), 2);
  const Outcome urdf = run("urdf refined --out r2.urdf --placement p2.yaml");
  ASSERT_EQ(urdf.exit_code, 0) << urdf.err;
  EXPECT_EQ(text_of(folder_ / "r.urdf"), text_of(folder_ / "r2.urdf"));
  EXPECT_EQ(text_of(folder_ / "p.yaml"), text_of(folder_ / "p2.yaml"));
  EXPECT_FALSE(text_of(folder_ / "p.yaml").empty());
  std::filesystem::remove(folder_ / "p.yaml");
  const Outcome text = run(refine);
  EXPECT_EQ(text.exit_code, 0) << text.err;
  EXPECT_NE(text.out.find("\nr.urdf: " + urdf.out.substr(urdf.out.find(' ') + 1)),
            std::string::npos)
      << text.out << urdf.out;
  EXPECT_FALSE(std::filesystem::exists(folder_ / "p.yaml"));
}

TEST_F(RefineProgramTest, ASchemaThatNoUrdfHasIsRefinedAllTheSame) {
  BodySchema schema = from_message(read_log(folder_ / "schema", kBodySchema).back());
  schema.signals.front().warp = {0.1, 0.1, 0.1, 0.1};
  write_one_event_log(folder_ / "bent", kBodySchema, to_message(schema));
  const Outcome outcome = run("refine bent '" + log_ + "' --out refined --urdf r.urdf --json");
  EXPECT_EQ(outcome.exit_code, 1);
  EXPECT_NE(
      outcome.err.find("`bodyschema urdf refined --out r.urdf --placement PLACEMENT [--nominal]`"),
      std::string::npos)
      << outcome.err;
  EXPECT_TRUE(Json::parse(outcome.out).at("urdf").is_null());
  EXPECT_EQ(run("show refined").exit_code, 0);
  EXPECT_FALSE(exists("r.urdf"));
}

TEST_F(RefineProgramTest, FitsTheRowsOfACsv) {
  Rng rng(71);
  const SyntheticRobot robot = chapter_robot("a", rng);
  std::ofstream csv(folder_ / "samples.csv");
  write_csv(babble(robot, 30, {.regime = Regime::kTagIso}, rng), csv);
  csv.close();
  ASSERT_EQ(run("learn samples.csv --out of_csv --noise 0.003 1").exit_code, 0);
  const Json json = json_of("refine of_csv samples.csv --out refined --json");
  EXPECT_EQ(json.at("fitted"), "poses");
  EXPECT_TRUE(json.at("before").is_null());
  EXPECT_TRUE(json.at("undetermined").empty());
  // Another recording tells the error, and is not fitted.
  std::ofstream other(folder_ / "other.csv");
  write_csv(babble(robot, 10, {.regime = Regime::kTagIso}, rng), other);
  other.close();
  const Json judged = json_of("refine of_csv samples.csv --test other.csv --out judged --json");
  EXPECT_EQ(judged.at("after").at("samples"), 10);
  EXPECT_EQ(judged.at("parameters"), json.at("parameters"));
  EXPECT_EQ(run("refine of_csv samples.csv --test samples.csv --out judged").exit_code, 2);
  // What looks odd in the recording is a warning.
  std::ofstream wrong(folder_ / "millimetres.csv");
  std::vector<ActionPoseSample> scaled = babble(robot, 10, {.regime = Regime::kTagIso}, rng);
  for (ActionPoseSample& sample : scaled)
    for (PartObservation& seen : sample.parts) seen.X_CB.translation() *= 1000;
  write_csv(scaled, wrong);
  wrong.close();
  const Json odd = json_of("refine of_csv millimetres.csv --out odd --json");
  const std::string warning = odd.at("warnings").at(0);
  EXPECT_NE(warning.find("look like millimetres"), std::string::npos) << warning;
}

/// Median distance of a part from where it is in the root, over random actions [m].
double distance_from_truth(const BodySchema& schema, const BodySchema& truth, int part) {
  Rng rng(72);
  std::vector<double> distances;
  for (int n = 0; n < 101; ++n) {
    Eigen::VectorXd action(static_cast<Eigen::Index>(truth.signals.size()));
    for (Eigen::Index s = 0; s < action.size(); ++s) {
      const Signal& signal = truth.signals[static_cast<std::size_t>(s)];
      action(s) = uniform(rng, signal.lower, signal.upper);
    }
    const auto predicted = schema.predict(schema.root, part, action);
    if (!predicted) return std::numeric_limits<double>::infinity();
    distances.push_back((predicted->X_AB.translation() -
                         truth.predict(truth.root, part, action)->X_AB.translation())
                            .norm());
  }
  std::nth_element(distances.begin(), distances.begin() + 50, distances.end());
  return distances[50];
}

// What was seen before the change is of another body; another recording counts its samples anew.
TEST_F(RefineProgramTest, WhatMonitorRepairedIsRefinedByTheSamplesSince) {
  Rng rng(74);
  const SyntheticRobot robot = chapter_robot("a", rng);
  SyntheticRobot bent = robot;
  for (TrueLink& link : bent.links)
    if (link.signal == 1) link.zero -= 0.06;
  const ObservationOptions seen{.regime = Regime::kTagIso};
  const auto write = [&](const char* file, const std::vector<ActionPoseSample>& samples) {
    std::ofstream csv(folder_ / file);
    write_csv(samples, csv);
  };
  std::vector<ActionPoseSample> changing;
  for (int n = 0; n < 160; ++n)
    changing.push_back(observe(n < 100 ? robot : bent, robot.random_action(rng), seen, n, rng));
  write("healthy.csv", babble(robot, 60, seen, rng));
  write("changing.csv", changing);
  write("later.csv", babble(bent, 50, seen, rng));
  ASSERT_EQ(run("learn healthy.csv --out learned --noise 0.003 1").exit_code, 0);
  ASSERT_EQ(run("monitor learned changing.csv --out repaired").exit_code, 0);
  const BodySchema truth = true_schema(bent);
  const int end = truth.edges.back().to;
  for (const std::string recording : {"changing.csv", "later.csv"}) {
    const Json json = json_of("refine repaired " + recording + " --out refined --json");
    const BodySchema refined = from_message(read_log(folder_ / "refined", kBodySchema).back());
    EXPECT_LT(distance_from_truth(refined, truth, end), 0.002) << recording;
    EXPECT_EQ(json.at("plays").size(), 0U) << recording;
    EXPECT_EQ(json.at("held").dump().find("before it changed") != std::string::npos,
              recording == "changing.csv")
        << json.at("held");
    std::filesystem::remove(folder_ / "refined");
  }
}

// The job of robot_calibration: the URDF, robot.urdf with ends.yaml, is millimetres and degrees
// off, and the camera sees the base and the end of seven joints, how the end is turned or not.
class RefineKnownStructureTest : public RefineProgramTest {
 protected:
  RefineKnownStructureTest() {
    BodySchema nominal = truth_;
    for (Edge& edge : nominal.edges) {
      Vector6d error;
      for (int k = 0; k < 6; ++k) error(k) = uniform(rng_, -1, 1) * (k < 3 ? 0.004 : 0.02);
      edge.left = edge.left * exp(error);
    }
    write_one_event_log(folder_ / "nominal", kBodySchema, to_message(nominal));
    EXPECT_EQ(run("urdf nominal --out robot.urdf --placement all.yaml --nominal").exit_code, 0);
    std::ifstream all(folder_ / "all.yaml");
    std::ofstream placement(folder_ / "ends.yaml");
    for (std::string line; std::getline(all, line);) {
      const bool is_part = line.find("{part: ") != std::string::npos;
      const auto is_of = [&](int part) {
        return line.find("{part: " + std::to_string(part) + ",") != std::string::npos;
      };
      if (!is_part || is_of(truth_.root) || is_of(end_)) placement << line << "\n";
    }
    placement.close();
    samples_ = babble(robot_, 100, {.regime = Regime::kTagIso}, rng_);
    for (ActionPoseSample& sample : samples_)
      std::erase_if(sample.parts, [&](const auto& seen) {
        return seen.part != truth_.root && seen.part != end_;
      });
  }
  void write_samples(const std::vector<ActionPoseSample>& samples, bool has_orientation) const {
    std::ofstream csv(folder_ / "samples.csv");
    write_csv(has_orientation ? samples : with_positions_alone(samples, {end_}), csv);
  }

  Rng rng_{73};
  const SyntheticRobot robot_ = chapter_robot("d", rng_);
  const BodySchema truth_ = true_schema(robot_);
  const int end_ = truth_.edges.back().to;
  std::vector<ActionPoseSample> samples_;
};

TEST_F(RefineKnownStructureTest, ARobotOfAUrdfIsRefinedFromItsEndAlone) {
  const BodySchema& truth = truth_;
  const int end = end_;
  write_samples(samples_, true);
  std::filesystem::rename(folder_ / "samples.csv", folder_ / "full.csv");
  for (const bool has_orientation : {true, false}) {
    SCOPED_TRACE(has_orientation ? "poses" : "positions");
    write_samples(samples_, has_orientation);
    const Outcome engineered =
        run("engineer robot.urdf ends.yaml --samples samples.csv --out begin");
    ASSERT_EQ(engineered.exit_code, 0) << engineered.err;
    json_of("refine begin samples.csv --noise 0.003 1 --out refined --json");
    const auto schema = [&](const char* file) {
      return from_message(read_log(folder_ / file, kBodySchema).back());
    };
    EXPECT_GT(distance_from_truth(schema("begin"), truth, end), 0.008);
    EXPECT_LT(distance_from_truth(schema("refined"), truth, end), 0.002);
    // Both in one command.
    json_of(
        "refine --structure robot.urdf --placement ends.yaml samples.csv --noise 0.003 1 --out "
        "one --json");
    const Eigen::VectorXd action = robot_.random_action(rng_);
    const BodySchema one = schema("one"), two = schema("refined");
    EXPECT_EQ(one.position_parts.empty(), has_orientation);
    // How a part is turned of which positions alone are known is not told, not even beside poses.
    const Json part = json_of("predict refined full.csv --json").at("parts")[0];
    EXPECT_EQ(part.at("rotation_sd_deg").is_null(), !has_orientation) << part;
    EXPECT_EQ(part.at("rotation_rms_deg").is_null(), !has_orientation) << part;
    EXPECT_EQ(one.position_parts, two.position_parts);
    for (const auto& [part, X_RB] : two.predict_all(action))
      EXPECT_LT(log(X_RB.inverse() * one.predict_all(action).at(part)).norm(), 1e-9) << part;
    EXPECT_LT(log(one.X_CR.inverse() * two.X_CR).norm(), 1e-9);
    std::filesystem::remove(folder_ / "begin");
    std::filesystem::remove(folder_ / "refined");
  }
}

// Nothing else is seen: where the root stands in the camera's frame is not known either.
TEST_F(RefineKnownStructureTest, ASinglePartIsEnough) {
  for (ActionPoseSample& sample : samples_)
    std::erase_if(sample.parts, [&](const auto& seen) { return seen.part != end_; });
  for (const bool has_orientation : {true, false}) {
    SCOPED_TRACE(has_orientation ? "poses" : "positions");
    write_samples(samples_, has_orientation);
    const Json json = json_of(
        "refine samples.csv --structure robot.urdf --placement ends.yaml --noise 0.003 1 --out "
        "refined --json");
    EXPECT_EQ(json.at("held").size(), 1U) << json.at("held");
    EXPECT_TRUE(json.at("undetermined").empty()) << json.at("undetermined");
    const BodySchema refined = from_message(read_log(folder_ / "refined", kBodySchema).back());
    std::vector<double> distances;
    for (int n = 0; n < 101; ++n) {
      const Eigen::VectorXd action = robot_.random_action(rng_);
      const Pose X_CE = refined.X_CR * refined.predict(refined.root, end_, action)->X_AB;
      distances.push_back(
          (X_CE.translation() - robot_.poses_in_camera(action).at(end_).translation()).norm());
    }
    std::nth_element(distances.begin(), distances.begin() + 50, distances.end());
    EXPECT_LT(distances[50], 0.002);
  }
}

TEST_F(RefineKnownStructureTest, JointsThatGiveWayAreFittedByTheMassesOfTheUrdf) {
  write_samples(samples_, true);
  const std::string refine =
      "refine samples.csv --structure robot.urdf --placement ends.yaml --noise 0.003 1 --out "
      "refined --elastic unloaded";
  const Json elasticity = json_of(refine + " --json").at("elasticity");
  // The arm is stiff.
  EXPECT_LT(elasticity.at("evidence"), 0);
  EXPECT_EQ(elasticity.at("joints").size(), 7U);
  EXPECT_LE(elasticity.at("elastic").at("noise_scale"), elasticity.at("stiff").at("noise_scale"));
  EXPECT_LT(elasticity.at("elastic").at("noise_scale"), 1.1);
  EXPECT_TRUE(elasticity.at("elastic").at("held_out_rms_m").is_null());
  EXPECT_EQ(run("show unloaded").exit_code, 0);
  const Outcome text = run(refine);
  EXPECT_NE(text.out.find("gravity are less likely than stiff ones"), std::string::npos)
      << text.out;
  std::string urdf = text_of(folder_ / "robot.urdf");
  for (auto at = urdf.find("<mass"); at != std::string::npos; at = urdf.find("<mass", at))
    urdf.erase(at, urdf.find('>', at) + 1 - at);
  for (auto at = urdf.find("<inertial"); at != std::string::npos; at = urdf.find("<inertial", at))
    urdf.erase(at, urdf.find("</inertial>", at) + 11 - at);
  std::ofstream(folder_ / "robot.urdf") << urdf;
  expect_failure(refine, 1, "no link has a mass");
}

TEST_F(RefineKnownStructureTest, SaysThatNoLoadChanges) {
  for (ActionPoseSample& sample : samples_) sample.action = samples_.front().action;
  write_samples(samples_, true);
  const Outcome outcome =
      run("refine samples.csv --structure robot.urdf --placement ends.yaml --noise 0.003 1 --out "
          "refined --elastic unloaded");
  EXPECT_EQ(outcome.exit_code, 1);
  EXPECT_NE(outcome.err.find("unloaded was not written"), std::string::npos) << outcome.err;
  EXPECT_TRUE(exists("refined"));
  EXPECT_FALSE(exists("unloaded"));
}

TEST_F(RefineKnownStructureTest, SaysWhatIsWrongWithIt) {
  write_samples(samples_, true);
  const std::string files = "--structure robot.urdf --placement ends.yaml ";
  expect_failure("refine samples.csv --out refined --structure robot.urdf", 2, "--placement");
  expect_failure("refine samples.csv --out refined --placement ends.yaml", 2, "--structure");
  expect_failure("refine samples.csv --out refined", 2, "SAMPLES");
  expect_failure("refine schema samples.csv --out refined " + files, 2, "SCHEMA");
  expect_failure("refine --out refined " + files, 2, "SAMPLES");
  expect_failure("refine samples.csv --out robot.urdf --noise 0.003 1 " + files, 1,
                 "is an input itself");
  expect_failure("refine schema samples.csv --out refined --elastic e", 2, "--structure");
  expect_failure("refine samples.csv --out refined " + files, 1, "--noise");
}

TEST_F(RefineProgramTest, SaysWhatIsWrong) {
  const std::string refine = "refine schema '" + log_ + "' --out refined ";
  expect_failure(refine + "--placements", 1, "rig");
  expect_failure(refine + "--placements --rig '" BODYSCHEMA_CONFIG "/arm7'", 1,
                 "another calibration");
  expect_failure(refine + "--proposed found", 2, "--proposed");
  expect_failure(refine + rig_ + " --placements --proposed schema", 2, "schema is no folder");
  expect_failure("refine schema '" + log_ + "' --out schema", 1, "is an input itself");
  expect_failure("refine schema '" + log_ + "'", 2, "--out");
  expect_failure(refine + "--urdf refined", 1, "--urdf: expected another file than --out");
  expect_failure(refine + "--urdf schema", 1, "--urdf: schema is an input itself");
  expect_failure(refine + "--urdf-placement p.yaml", 2, "--urdf-placement requires --urdf");
  expect_failure("refine missing '" + log_ + "' --out refined", 1, "missing");
  EXPECT_FALSE(exists("refined"));
  std::ofstream(folder_ / "a.csv") << "t,q1,q2,part,x,y,z,qw,qx,qy,qz\n0,nan,0,1,0,0,0,1,0,0,0\n";
  expect_failure("refine schema a.csv --out refined", 1, "a.csv:2:3");
}

}  // namespace
}  // namespace bodyschema::test
