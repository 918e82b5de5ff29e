#include "processes/console/views/run_result.h"

#include <gtest/gtest.h>

namespace bodyschema {
namespace {

RunResult result() {
  RunResult result;
  result.rig = "arm2";
  result.seed = 4;
  result.num_samples = 12;
  result.seconds = 33.37;
  result.is_accepted = true;
  result.schema.parts = {1, 2};
  result.visibility = {{1, 1.0}, {2, 0.5}};
  return result;
}

TEST(RunResultTest, TextAndJsonSayTheSame) {
  const auto json = run_result_json(result());
  EXPECT_EQ(json["seed"], 4);
  EXPECT_EQ(json["seconds"], 33.4);
  EXPECT_EQ(json["visibility"]["2"], 0.5);
  EXPECT_FALSE(json.contains("replay_of"));
  const std::string text = run_result_text(result(), "/nowhere");
  EXPECT_TRUE(text.starts_with("\narm2 · seed 4 · 12 samples, 0 of them held out · 33 s\n\n"))
      << text;
  EXPECT_TRUE(text.ends_with("\nFiles in /nowhere\n")) << text;
  EXPECT_EQ(text.find("accepted no"), std::string::npos);
}

TEST(RunResultTest, AReplaySaysWhatWasLost) {
  RunResult replay = result();
  replay.seed.reset();
  replay.replay_of = "run.lcmlog";
  replay.replay_from = "SAMPLE";
  replay.lost_samples = {{3, 3}, {5, 7}};
  replay.lost_frames = 2;
  const auto json = run_result_json(replay);
  EXPECT_TRUE(json["seed"].is_null());
  EXPECT_EQ(json["replay_of"], "run.lcmlog");
  EXPECT_EQ(json["lost_samples"][1][1], 7);
  const std::string text = run_result_text(replay, "/nowhere");
  EXPECT_NE(text.find("arm2 · replay of run.lcmlog · "), std::string::npos);
  EXPECT_NE(text.find("lost SAMPLE 3\nlost SAMPLE 5…7\n2 of the played SAMPLE were not heard"),
            std::string::npos)
      << text;
}

TEST(RunResultTest, WhatIsWrongWithTheBodyStandsFirst) {
  RunResult broken = result();
  broken.is_accepted = false;
  finding_t finding{};
  finding.finding_text = "q1 is stuck";
  broken.health = model_health_t{};
  broken.health->findings = {finding};
  EXPECT_EQ(run_result_json(broken)["wrong"][0]["text"], "q1 is stuck");
  const std::string text = run_result_text(broken, "/nowhere");
  EXPECT_LT(text.find("  q1 is stuck\n"), text.find("The monitor accepted no body schema"));
}

}  // namespace
}  // namespace bodyschema
