#include "processes/console/views/structure_view.h"

#include <gtest/gtest.h>

#include <cmath>
#include <set>

#include "common/geometry/angle.h"
#include "processes/structure_learner/learn.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using Keys = std::vector<std::string>;

Keys keys_of(const nlohmann::ordered_json& object) {
  Keys keys;
  for (const auto& item : object.items()) keys.push_back(item.key());
  return keys;
}

bool contains_null(const Json& value) {
  if (value.is_null()) return true;
  if (value.is_structured()) {
    for (const auto& item : value)
      if (contains_null(item)) return true;
  }
  return false;
}

LearnResult learned(test::SyntheticRobot& robot) {
  test::Rng rng(61);
  robot = test::chapter_robot("a", rng);
  robot.signals.push_back({"idle", -1, 1});
  return learn(robot.signals, test::babble(robot, 30, {.regime = test::Regime::kTag}, rng));
}

TEST(SchemaJsonTest, LearnHasExactlyTheDocumentedKeysAndTypes) {
  test::SyntheticRobot robot;
  const LearnResult result = learned(robot);
  const auto json = structure_json(result.schema, {{3, 2}, {5, 4}});
  EXPECT_EQ(keys_of(json),
            (Keys{"complete", "samples", "parts", "position_parts", "root", "edges", "unconnected",
                  "unused_signals", "undecided_signals", "outliers", "noise"}));
  EXPECT_TRUE(json["complete"].is_boolean());
  EXPECT_TRUE(json["samples"].is_number_integer());
  EXPECT_EQ(json["samples"], 30);
  EXPECT_EQ(json["parts"], (nlohmann::ordered_json{1, 2, 3, 4, 5}));
  EXPECT_EQ(json["root"], 1);
  ASSERT_EQ(json["edges"].size(), 4U);
  for (std::size_t i = 0; i < 4; ++i) {
    const auto& edge = json["edges"][i];
    EXPECT_EQ(keys_of(edge), (Keys{"from", "to", "signals", "kind", "position_rms_m",
                                   "rotation_rms_deg", "samples", "outliers"}));
    EXPECT_EQ(edge["from"], result.schema.edges[i].from);
    EXPECT_EQ(edge["to"], result.schema.edges[i].to);
    EXPECT_EQ(edge["kind"], edge["signals"].empty() ? "rigid" : "screw");
    EXPECT_TRUE(edge["position_rms_m"].is_number_float());
    EXPECT_NEAR(edge["rotation_rms_deg"].get<double>(),
                result.schema.edges[i].rotation_rms_rad / kDegree, 1e-12);
    for (const auto& signal : edge["signals"]) EXPECT_TRUE(signal.is_string());
  }
  EXPECT_TRUE(json["unconnected"].is_array());
  EXPECT_EQ(json["unused_signals"], (nlohmann::ordered_json{"idle"}));
  EXPECT_TRUE(json["undecided_signals"].empty());
  EXPECT_EQ(Json::parse(json["outliers"].dump()),
            Json::parse(R"([{"sample": 3, "part": 2}, {"sample": 5, "part": 4}])"));
  EXPECT_EQ(keys_of(json["noise"]), (Keys{"position_m", "rotation_deg"}));
  EXPECT_GT(json["noise"]["position_m"].get<double>(), 0);
  EXPECT_FALSE(contains_null(Json::parse(json.dump())));
}

TEST(SchemaJsonTest, ASchemaOfNothingIsPrintedToo) {
  const auto json = structure_json(BodySchema{}, {});
  EXPECT_EQ(Json::parse(json.dump()), Json::parse(R"({"complete": false, "samples": 0, "parts": [],
                            "position_parts": [], "root": null,
                            "edges": [], "unconnected": [], "unused_signals": [],
                            "undecided_signals": [], "outliers": [],
                            "noise": {"position_m": 0, "rotation_deg": 0}})"));
  EXPECT_NO_THROW(schema_json(BodySchema{}).dump());
  EXPECT_EQ(structure_text(BodySchema{}), "Incomplete structure of 0 parts from 0 samples\n");
}

TEST(SchemaJsonTest, TheNoiseIsPrintedWithWhereItIsKnownFrom) {
  BodySchema schema;
  schema.noise = {0.0031, 1.2 * kDegree};
  EXPECT_NE(structure_text(schema).find("noise per axis and marker: 3.10 mm 1.20°\n"),
            std::string::npos);
  std::set<std::string> words;
  for (const NoiseSource source :
       {NoiseSource::kGiven, NoiseSource::kCovariances, NoiseSource::kRepeats, NoiseSource::kFrames,
        NoiseSource::kResiduals, NoiseSource::kAssumed}) {
    words.insert(structure_json(schema, {}, source)["noise"]["from"]);
    EXPECT_NE(structure_text(schema, source).find("3.10 mm 1.20°, "), std::string::npos);
  }
  EXPECT_EQ(words, (std::set<std::string>{"given", "covariances", "repeats", "frames", "residuals",
                                          "assumed"}));
}

TEST(SchemaJsonTest, AnUnconnectedPartComesWithItsReason) {
  BodySchema schema;
  schema.parts = {1, 4, 6, 7};
  schema.root = 1;
  schema.unconnected = {{4, Unconnected::kNoValidModel, "k up to 2 was tried"},
                        {6, Unconnected::kNotEnoughData, ""},
                        {7, Unconnected::kNeverSeen, "never seen"}};
  const auto json = structure_json(schema, {});
  EXPECT_EQ(Json::parse(json["unconnected"].dump()), Json::parse(R"([
      {"part": 4, "reason": "no valid model: k up to 2 was tried"},
      {"part": 6, "reason": "not enough data yet"},
      {"part": 7, "reason": "never seen"}])"));
  const std::string text = structure_text(schema);
  EXPECT_NE(text.find("4   not connected: no valid model: k up to 2 was tried\n"),
            std::string::npos);
}

TEST(SchemaJsonTest, PredictHasExactlyTheDocumentedKeysAndDegrees) {
  PartErrors errors;
  errors.part = 3;
  errors.count = 7;
  errors.position_median_m = 0.001;
  errors.position_rms_m = 0.002;
  errors.position_max_m = 0.003;
  errors.rotation_median_rad = kDegree;
  errors.rotation_rms_rad = M_PI / 90;
  const auto json = errors_json(11, std::vector{errors});
  EXPECT_EQ(keys_of(json), (Keys{"samples", "parts"}));
  EXPECT_EQ(json["samples"], 11);
  ASSERT_EQ(json["parts"].size(), 1U);
  const auto& part = json["parts"][0];
  EXPECT_EQ(keys_of(part), (Keys{"part", "count", "position_median_m", "position_rms_m",
                                 "position_max_m", "rotation_median_deg", "rotation_rms_deg"}));
  EXPECT_EQ(part["part"], 3);
  EXPECT_EQ(part["count"], 7);
  EXPECT_EQ(part["position_max_m"], 0.003);
  EXPECT_NEAR(part["rotation_median_deg"].get<double>(), 1, 1e-12);
  EXPECT_NEAR(part["rotation_rms_deg"].get<double>(), 2, 1e-12);
  EXPECT_NE(errors_text({.parts = {errors}})
                .find("   3      7    1.00 mm  1.00°    2.00 mm  2.00°    3.00 mm"),
            std::string::npos)
      << errors_text({.parts = {errors}});
}

TEST(SchemaJsonTest, WhereNothingWasMeasuredStandsNoNumber) {
  PartErrors errors;
  errors.part = 3;
  const auto json = errors_json(0, std::vector{errors});
  EXPECT_EQ(json["parts"][0]["count"], 0);
  EXPECT_TRUE(json["parts"][0]["position_rms_m"].is_null());
  EXPECT_EQ(json.dump().find("nan"), std::string::npos);
  EXPECT_NE(errors_text({.parts = {errors}}).find("never seen together with the root"),
            std::string::npos);
}

TEST(SchemaJsonTest, ShowHasEveryParameterOfEveryEdge) {
  test::SyntheticRobot robot;
  const BodySchema schema = learned(robot).schema;
  const auto json = schema_json(schema);
  EXPECT_EQ(keys_of(json),
            (Keys{"complete", "samples", "parts", "position_parts", "root", "edges", "unconnected",
                  "unused_signals", "undecided_signals", "noise", "refined", "version",
                  "base_version", "last_sample", "X_CR", "signals"}));
  EXPECT_EQ(json["signals"].size(), 3U);
  EXPECT_EQ(keys_of(json["signals"][0]), (Keys{"name", "lower", "upper", "covered", "warp"}));
  EXPECT_EQ(json["last_sample"], 29);
  EXPECT_EQ(keys_of(json["X_CR"]),
            (Keys{"position_m", "rotation_wxyz", "position_sd_m", "rotation_sd_deg"}));

  // The model can be built again from what is printed.
  const auto pose_of = [](const nlohmann::ordered_json& X) {
    const auto p = X["position_m"].get<std::vector<double>>();
    const auto q = X["rotation_wxyz"].get<std::vector<double>>();
    return make_pose({q.at(0), q.at(1), q.at(2), q.at(3)}, {p.at(0), p.at(1), p.at(2)});
  };
  test::Rng rng(62);
  for (std::size_t i = 0; i < schema.edges.size(); ++i) {
    const auto& printed = json["edges"][i];
    EXPECT_EQ(printed["state"], "OK");
    Edge edge;
    edge.left = pose_of(printed["left"]);
    edge.right = pose_of(printed["right"]);
    for (const auto& j : printed["joints"]) {
      ScrewJoint joint;
      for (std::size_t s = 0; s < schema.signals.size(); ++s)
        if (schema.signals[s].name == j["signal"].get<std::string>())
          joint.signal = static_cast<int>(s);
      joint.gain = j["gain"];
      joint.offset = j["offset"];
      joint.slide = j["slide_m"];
      joint.turn = j["turn_rad"];
      joint.X_after = pose_of(j["X_after"]);
      EXPECT_TRUE(j["order_group"].is_null());
      edge.joints.push_back(joint);
    }
    for (int n = 0; n < 5; ++n) {
      const Eigen::VectorXd action = robot.random_action(rng);
      EXPECT_LT((edge.predict(action).matrix() - schema.edges[i].predict(action).matrix()).norm(),
                1e-9);
    }
  }
}

// A robot in tag noise (3 mm, 1°) seen 30 times.
TEST(SchemaJsonTest, ShowHasStandardDeviationsThatAPersonCanRead) {
  test::SyntheticRobot robot;
  BodySchema schema = learned(robot).schema;
  const auto json = schema_json(schema);
  for (const auto& sd : json["X_CR"]["position_sd_m"]) EXPECT_GT(sd.get<double>(), 1e-5);
  for (const auto& edge : json["edges"]) {
    EXPECT_GT(edge["position_sd_m"], 1e-5);
    EXPECT_LT(edge["position_sd_m"], 3e-3);
    EXPECT_GT(edge["rotation_sd_deg"], 1e-3);
    EXPECT_LT(edge["rotation_sd_deg"], 1);
    for (const auto& joint : edge["joints"]) {
      const auto& sd = joint["sd"];
      EXPECT_EQ(keys_of(sd), (Keys{"axis_position_m", "axis_tilt_deg", "displacement_m",
                                   "displacement_deg", "slide_m", "turn_rad"}));
      EXPECT_LT(sd["axis_tilt_deg"], 1);
      EXPECT_LT(sd["displacement_deg"], 1);
      if (joint["turn_rad"] == 0)
        EXPECT_TRUE(sd["axis_position_m"].is_null());
      else
        EXPECT_LT(sd["axis_position_m"], 0.01);
    }
  }
  schema.edges[0].parameter_covariance.resize(0, 0);
  EXPECT_TRUE(schema_json(schema)["edges"][0]["position_sd_m"].is_null());
  EXPECT_TRUE(schema_json(schema)["edges"][0]["joints"][0]["sd"].is_null());
}

TEST(SchemaJsonTest, JointsWhoseOrderIsOpenHaveTheNumberOfTheirGroup) {
  BodySchema schema;
  schema.signals = {{"a", -1, 1, {}}, {"b", -1, 1, {}}};
  Edge& edge = schema.edges.emplace_back();
  edge.joints = {ScrewJoint{.signal = 0, .turn = 1, .order_group = 2},
                 ScrewJoint{.signal = 1, .turn = 1}};
  const auto joints = schema_json(schema)["edges"][0]["joints"];
  EXPECT_EQ(joints[0]["order_group"], 2);
  EXPECT_TRUE(joints[1]["order_group"].is_null());
}

/// Parts 1 and 2 with six joints between them, q3 sliding, as signals q6 … q1.
BodySchema long_edge(test::Rng& rng) {
  BodySchema schema;
  schema.complete = true;
  schema.parts = {1, 2};
  schema.root = 1;
  for (const char* name : {"q1", "q2", "q3", "q4", "q5", "q6"})
    schema.signals.push_back({name, -1, 1, {}});
  schema.edges = {test::random_edge(1, 2, {5, 4, 3, 2, 1, 0}, rng)};
  for (ScrewJoint& joint : schema.edges[0].joints) {
    joint.gain = 1;
    joint.slide = 0;
    joint.turn = 30 * kDegree;
  }
  schema.edges[0].joints[3].slide = -0.02;
  schema.edges[0].joints[3].turn = 0;
  return schema;
}

TEST(SchemaJsonTest, WhatDoesNotShowOverTheRangeOfASignalIsNought) {
  test::Rng rng(63);
  BodySchema schema = long_edge(rng);
  for (ScrewJoint& joint : schema.edges[0].joints) joint.slide = joint.turn != 0 ? 6.937e-8 : 0.02;
  std::string text = structure_text(schema);
  EXPECT_NE(text.find(" 0 mm ± "), std::string::npos) << text;
  EXPECT_EQ(text.find("e-"), std::string::npos) << text;
  schema.edges[0].parameter_covariance.setZero();
  text = structure_text(schema);
  EXPECT_EQ(text.find(" 0 mm"), std::string::npos) << text;
  EXPECT_NE(text.find("°"), std::string::npos) << text;
}

TEST(SchemaJsonTest, TheJointsOfALongEdgeStandInTheirOrderWithWhatEachDoes) {
  test::Rng rng(63);
  BodySchema schema = long_edge(rng);
  schema.edges[0].joints[1].order_group = schema.edges[0].joints[2].order_group = 0;
  const Json edge = schema_json(schema)["edges"][0];
  EXPECT_EQ(edge["signals"], (Json{"q6", "q5", "q4", "q3", "q2", "q1"}));
  ASSERT_EQ(edge["joints"].size(), 6U);
  for (std::size_t d = 0; d < 6; ++d) {
    const Json& joint = edge["joints"][d];
    EXPECT_EQ(joint["signal"], "q" + std::to_string(6 - d));
    EXPECT_EQ(joint["order_group"].is_null(), d != 1 && d != 2);
    EXPECT_GT(joint["sd"]["axis_tilt_deg"].get<double>(), 0);
    EXPECT_GT(joint["sd"]["turn_rad"].get<double>(), 0);
  }

  const std::string text = structure_text(schema);
  std::size_t at = text.find("{q6,q5,q4,q3,q2,q1}");
  ASSERT_NE(at, std::string::npos) << text;
  for (const char* name : {"q6 ", "q5 ", "q4 ", "q3 ", "q2 ", "q1 "}) {
    at = text.find(name, at);
    ASSERT_NE(at, std::string::npos) << name << text;
  }
  EXPECT_NE(text.find("q6          30° ± "), std::string::npos) << text;
  EXPECT_NE(text.find("q3         -20 mm ± "), std::string::npos) << text;
  EXPECT_NE(text.find(" per unit, order open (group 0)\n"), std::string::npos) << text;
  // The residual stands below its heading however long the signals are.
  const std::size_t heading = text.find("residual");
  const std::size_t line = text.rfind('\n', heading), end = text.find('\n', heading);
  const std::size_t millimetres = text.find(" mm", end);
  // The arrow has two bytes more than columns.
  EXPECT_EQ(millimetres + 3 - end - 2, heading + 8 - line) << text;
}

TEST(SchemaJsonTest, ASignalThatDidNotMoveEnoughToTellIsNotCalledWithoutEffect) {
  BodySchema schema;
  schema.signals = {{"idle", -1, 1, {}}, {"held", -1, 1, {}}};
  schema.undecided_signals = {1};
  EXPECT_EQ(structure_json(schema, {})["unused_signals"], (nlohmann::ordered_json{"idle"}));
  EXPECT_EQ(structure_json(schema, {})["undecided_signals"], (nlohmann::ordered_json{"held"}));
  const std::string text = structure_text(schema);
  EXPECT_NE(text.find("signals without effect: idle\n"), std::string::npos) << text;
  EXPECT_NE(text.find("signals whose effect is not told yet: held\n"), std::string::npos) << text;
}

TEST(SchemaJsonTest, TheTextNamesEdgesSignalsAndIdleOnes) {
  test::SyntheticRobot robot;
  const std::string text = structure_text(learned(robot).schema);
  EXPECT_EQ(text.rfind("Complete structure of 5 parts from 30 samples\n"
                       "  edge      kind      signals        residual   (rms)\n",
                       0),
            0U)
      << text;
  EXPECT_NE(text.find("{q1}"), std::string::npos) << text;
  EXPECT_NE(text.find("rigid"), std::string::npos) << text;
  EXPECT_NE(text.find("signals without effect: idle\n"), std::string::npos) << text;
}

}  // namespace
}  // namespace bodyschema
