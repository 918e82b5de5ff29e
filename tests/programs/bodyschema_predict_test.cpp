// bodyschema predict, reach, show and engineer: what a schema says of poses and actions.

#include <gtest/gtest.h>

#include <algorithm>
#include <nlohmann/json.hpp>
#include <string>
#include <vector>

#include "common/geometry/angle.h"
#include "tests/programs/bodyschema_program.h"

namespace bodyschema::test {
namespace {

TEST_F(BodyschemaProgramTest, ALearnedSchemaPredictsWhatItHasNotSeen) {
  const auto csv = write_robot("train.csv", Regime::kFree);
  ASSERT_EQ(run({"learn", csv, "--out", "schema.lcmlog"}).exit_code, 0);
  Rng rng(73);
  const auto held_out = write("test.csv", babble(robot_, 11, {}, rng));
  const Json json = run({"predict", "schema.lcmlog", held_out, "--json"}).json();
  EXPECT_EQ(json["samples"], 11);
  ASSERT_EQ(json["parts"].size(), 4U);
  for (std::size_t i = 0; i < 4; ++i) {
    const Json& part = json["parts"][i];
    EXPECT_EQ(part.size(), 10U);
    EXPECT_EQ(part.at("part"), i + 2);
    EXPECT_EQ(part.at("count"), 11);
    EXPECT_LT(part.at("position_max_m").get<double>(), 1e-4);
    EXPECT_LE(part.at("position_median_m").get<double>(), part.at("position_max_m").get<double>());
    EXPECT_LE(part.at("position_rms_m").get<double>(), part.at("position_max_m").get<double>());
    EXPECT_LT(part.at("rotation_rms_deg").get<double>(), 0.01);
    EXPECT_GE(part.at("rotation_median_deg").get<double>(), 0);
  }
  const Outcome text = run({"predict", "schema.lcmlog", held_out});
  EXPECT_EQ(text.exit_code, 0);
  EXPECT_NE(text.out.find("median"), std::string::npos);
}

// Long, for all is asked of one learned schema.
TEST_F(BodyschemaProgramTest, ReachFindsTheActionOfAPoseOrTheNearest) {
  ASSERT_EQ(
      run({"learn", write_robot("train.csv", Regime::kFree), "--out", "schema.lcmlog"}).exit_code,
      0);
  const Json shown = run({"show", "schema.lcmlog", "--json"}).json();
  std::vector<std::string> at = {"predict", "schema.lcmlog", "--json", "--action"};
  for (const Json& signal : shown["signals"])
    at.push_back(
        std::to_string(0.7 * signal["upper"].get<double>() + 0.3 * signal["lower"].get<double>()));
  const auto pose_of = [](const Json& predicted) {
    for (const Json& part : predicted["parts"])
      if (part["part"] == 5) return part["X_RB"];
    return Json();
  };
  const Json X_RB = pose_of(run(at).json());
  const auto add = [](std::vector<std::string> to, const Json& numbers) {
    for (const Json& number : numbers) to.push_back(number.dump());
    return to;
  };
  std::vector<std::string> reach = {"reach", "schema.lcmlog", "--part",
                                    "5",     "--json",        "--position"};
  reach = add(reach, X_RB["position_m"]);
  EXPECT_TRUE(run(reach).json()["rotation_error_deg"].is_null());
  const Outcome too_far =
      run({"reach", "schema.lcmlog", "--part", "5", "--position", "1e300", "0", "0", "--json"});
  EXPECT_EQ(too_far.exit_code, 2);
  EXPECT_NE(too_far.err.find("within ±1000"), std::string::npos) << too_far.err;
  reach.push_back("--orientation");
  reach = add(reach, X_RB["rotation_wxyz"]);
  const Outcome reached = run(reach);
  EXPECT_EQ(reached.exit_code, 0);
  const Json json = reached.json();
  EXPECT_EQ(json["reached"], true) << json;
  EXPECT_LE(json["position_error_m"].get<double>(), 1e-4);
  EXPECT_LE(json["rotation_error_deg"].get<double>(), 0.01);
  at.resize(4);
  for (const auto& [name, value] : json["action"].items()) at.push_back(value.dump());
  const Json found = pose_of(run(at).json());
  for (int i = 0; i < 3; ++i)
    EXPECT_NEAR(found["position_m"][i].get<double>(), X_RB["position_m"][i].get<double>(), 1e-3);

  const Json where = run({"where", "5", "--schema", "schema.lcmlog", "--json"}).json();
  ASSERT_EQ(where["parts"].size(), 1U) << where;
  EXPECT_EQ(where["parts"][0]["part"], 5);
  EXPECT_TRUE(where["signals"].is_null());
  for (int i = 0; i < 3; ++i) {
    const double at = X_RB["position_m"][i].get<double>();
    EXPECT_LE(where["parts"][0]["lowest_m"][i].get<double>(), at);
    EXPECT_GE(where["parts"][0]["highest_m"][i].get<double>(), at);
  }
  expect_failure({"where", "77", "--schema", "schema.lcmlog"}, "no part 77");

  const Outcome far =
      run({"reach", "schema.lcmlog", "--part", "5", "--json", "--position", "9", "9", "9"});
  EXPECT_EQ(far.exit_code, 1);
  const Json nearest = Json::parse(far.out);
  EXPECT_EQ(nearest["reached"], false);
  EXPECT_GT(nearest["position_error_m"].get<double>(), 5);
  EXPECT_NE(nearest["why"].get<std::string>().find("out of reach"), std::string::npos);

  const auto reach_at = [&](const char* x) {
    return run({"reach", "schema.lcmlog", "--part", "5", "--json", "--position", x, "0", "-.5"})
        .out;
  };
  EXPECT_EQ(reach_at("-.25"), reach_at("-0.25"));
}

TEST_F(BodyschemaProgramTest, ReachRefusesWhatMakesNoSense) {
  ASSERT_EQ(
      run({"learn", write_robot("train.csv", Regime::kFree), "--out", "schema.lcmlog"}).exit_code,
      0);
  const std::vector<std::string> of_none = {
      "reach", "schema.lcmlog", "--part", "77", "--position", "0", "0", "0"};
  expect_failure(of_none, "--part");
  expect_failure({"reach", "schema.lcmlog", "--part", "5", "--position", "0", "0", "nan"},
                 "--position");
  expect_failure({"reach", "schema.lcmlog", "--part", "5", "--position", "0", "0", "0",
                  "--orientation", "1", "1", "0", "0"},
                 "unit quaternion");
  expect_failure(
      {"reach", "schema.lcmlog", "--part", "5", "--position", "0", "0", "0", "--from", "1"},
      "--from");
  expect_failure(
      {"reach", "schema.lcmlog", "--part", "5", "--position", "0", "0", "0", "--from", "1e9", "0"},
      "beyond its limits");
}

TEST_F(BodyschemaProgramTest, APredictionSaysHowWellItIsKnownAndWhatWasNeverTried) {
  const auto csv = write_robot("train.csv", Regime::kTagIso);
  const Json learned = run({"learn", csv, "--out", "schema.lcmlog", "--json"}).json();
  ASSERT_TRUE(learned.at("complete"));
  const Json within = run({"predict", "schema.lcmlog", "--action", "0.1", "-0.2", "--json"}).json();
  const Json beyond = run({"predict", "schema.lcmlog", "--action", "9", "-0.2", "--json"}).json();
  EXPECT_EQ(within.at("action"), Json({{"q1", 0.1}, {"q2", -0.2}}));
  EXPECT_EQ(within.at("outside_training"), Json::array());
  EXPECT_EQ(beyond.at("outside_training"), Json({"q1"}));
  ASSERT_EQ(within.at("parts").size(), 4U);
  int num_outside = 0;
  for (std::size_t i = 0; i < 4; ++i) {
    const Json &in = within["parts"][i], &out = beyond["parts"][i];
    EXPECT_EQ(in.at("outside_training"), Json::array());
    EXPECT_GT(in.at("position_sd_m").get<double>(), 1e-5);
    EXPECT_LT(in.at("position_sd_m").get<double>(), 0.01);
    EXPECT_GT(in.at("rotation_sd_deg").get<double>(), 1e-3);
    if (out.at("outside_training").empty()) continue;
    EXPECT_EQ(out.at("outside_training"), Json({"q1"}));
    EXPECT_GT(out.at("rotation_sd_deg"), in.at("rotation_sd_deg"));
    ++num_outside;
  }
  EXPECT_GT(num_outside, 0);
  EXPECT_NE(
      run({"predict", "schema.lcmlog", "--action", "9", "-0.2"}).out.find("outside training: q1"),
      std::string::npos);

  // Of a recording: the samples outside are counted, and each row says it.
  Rng rng(75);
  std::vector<ActionPoseSample> samples = babble(robot_, 3, {}, rng);
  for (ActionPoseSample& sample : samples) sample.action << 0, 0;
  samples[1].action << 0, 9;
  const auto odd = write("odd.csv", samples);
  const Json json =
      run({"predict", "schema.lcmlog", odd, "--out", "predicted.csv", "--json"}).json();
  EXPECT_EQ(json.at("outside_training"), Json({{"samples", 1}, {"signals", {"q2"}}}));
  const std::string rows = text_of(folder_ / "predicted.csv");
  EXPECT_TRUE(
      rows.starts_with("t,q1,q2,part,x,y,z,qw,qx,qy,qz,position_sd_m,rotation_sd_deg,"
                       "outside_training\n0,0,0,2,"))
      << rows;
  EXPECT_EQ(std::count(rows.begin(), rows.end(), '\n'), 1 + 3 * 4);
  EXPECT_NE(rows.find(",q2\n"), std::string::npos);

  expect_failure({"predict", "schema.lcmlog", "--action", "1"}, "q1 q2");
  expect_failure({"predict", "schema.lcmlog", odd, "--action", "1", "2"}, "--action");
}

TEST_F(BodyschemaProgramTest, PredictionErrorsAreThoseThatWerePutIn) {
  ASSERT_EQ(
      run({"learn", write_robot("train.csv", Regime::kFree), "--out", "schema.lcmlog"}).exit_code,
      0);
  Rng rng(74);
  auto samples = babble(robot_, 9, {}, rng);
  for (ActionPoseSample& sample : samples) {
    for (PartObservation& part : sample.parts) {
      if (part.part != 5) continue;
      part.X_CB.translation() += Eigen::Vector3d(0, 0.03, 0.04);
      part.X_CB.linear() *= exp_so3({0, 0, 0.1});
    }
  }
  const Json json = run({"predict", "schema.lcmlog", write("s.csv", samples), "--json"}).json();
  const Json& part = json["parts"].back();
  EXPECT_EQ(part["part"], 5);
  EXPECT_NEAR(part["position_median_m"].get<double>(), 0.05, 1e-4);
  EXPECT_NEAR(part["position_rms_m"].get<double>(), 0.05, 1e-4);
  EXPECT_NEAR(part["rotation_median_deg"].get<double>(), 0.1 / kDegree, 1e-2);
}

TEST_F(BodyschemaProgramTest, ShowPrintsASchemaFile) {
  const Json learned =
      run({"learn", write_robot("s.csv"), "--out", "schema.lcmlog", "--json"}).json();
  const Json shown = run({"show", "schema.lcmlog", "--json"}).json();
  EXPECT_EQ(shown["parts"], learned["parts"]);
  EXPECT_EQ(shown["root"], learned["root"]);
  EXPECT_EQ(shown["samples"], learned["samples"]);
  EXPECT_EQ(shown["edges"].size(), learned["edges"].size());
  EXPECT_EQ(shown["version"], 30);
  for (const Json& edge : shown["edges"]) EXPECT_TRUE(edge.contains("joints"));
  const Outcome text = run({"show", "schema.lcmlog"});
  EXPECT_EQ(text.exit_code, 0);
  // Only `learn` knows the source of the noise.
  std::string learned_text = run({"learn", "s.csv"}).out;
  const std::string source = ", estimated from what the best models leave";
  ASSERT_NE(learned_text.find(source), std::string::npos) << learned_text;
  EXPECT_EQ(text.out, learned_text.erase(learned_text.find(source), source.size()));
}

TEST_F(BodyschemaProgramTest, AnEngineeredModelPredictsTheRobotItDescribes) {
  write("robot.urdf", R"(<robot name="r"><link name="base"/><link name="arm"/>
    <joint name="j" type="revolute"><parent link="base"/><child link="arm"/>
      <origin xyz="0 0 0.5" rpy="0 0 0"/><axis xyz="0 0 1"/>
      <limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>)");
  write("placement.yaml", R"(root: 1
uncertainty: {position_m: 0.002, rotation_deg: 0.5}
signals: [{name: q, joint: j, gain: 0.5, offset: 0, lower: -2, upper: 2}]
parts:
  - {part: 1, link: base, X_LB: {position_m: [0, 0, 0]}}
  - {part: 2, link: arm, X_LB: {position_m: [0.2, 0, 0]}}
)");
  // At q = π the arm has turned by 90 degrees; the root stands 2 m in front of the camera.
  write("samples.csv",
        "t,q,part,x,y,z,qw,qx,qy,qz\n"
        "0,0,1,0,0,2,1,0,0,0\n0,0,2,0.2,0,2.5,1,0,0,0\n"
        "1,3.14159265358979,1,0,0,2,1,0,0,0\n"
        "1,3.14159265358979,2,0,0.2,2.5,0.707106781186547,0,0,0.707106781186547\n");
  const Json json = run({"engineer", "robot.urdf", "placement.yaml", "--samples", "samples.csv",
                         "--out", "schema.lcmlog", "--json"})
                        .json();
  EXPECT_NEAR(json["X_CR"]["position_m"][2].get<double>(), 2, 1e-9);
  const Json errors = run({"predict", "schema.lcmlog", "samples.csv", "--json"}).json();
  EXPECT_EQ(errors["parts"][0]["count"], 2);
  EXPECT_LT(errors["parts"][0]["position_max_m"], 1e-9);
  EXPECT_LT(errors["parts"][0]["rotation_rms_deg"], 1e-6);
}

}  // namespace
}  // namespace bodyschema::test
