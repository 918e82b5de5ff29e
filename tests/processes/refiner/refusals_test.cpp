#include <gtest/gtest.h>

#include <algorithm>
#include <filesystem>
#include <fstream>
#include <limits>
#include <set>
#include <stdexcept>
#include <string>

#include "common/geometry/angle.h"
#include "processes/refiner/informative_samples.h"
#include "processes/refiner/refine.h"
#include "processes/refiner/refiner_config.h"
#include "tests/processes/refiner/tagged_robot.h"

namespace bodyschema {
namespace {

class RefineRefuses : public testing::Test {
 protected:
  RefineRefuses()
      : robot_(test::tagged(test::chapter_robot("a", rng_), 2, rng_)),
        samples_(test::seen_corners(robot_, robot_.truth, 10, 0.05, rng_)),
        schema_(test::true_schema(robot_.robot)) {
    schema_.X_CR = robot_.robot.X_CR;
    options_.placements = true;
  }

  std::string refusal(const std::optional<RigCalibration>& rig) const {
    try {
      refine(schema_, samples_, rig, options_);
    } catch (const std::invalid_argument& error) {
      return error.what();
    }
    return "";
  }
  void expect_refusal(const std::string& words, const std::optional<RigCalibration>& rig) const {
    const std::string refused = refusal(rig);
    EXPECT_NE(refused.find(words), std::string::npos) << "'" << refused << "'";
  }

  test::Rng rng_{1};
  test::TaggedRobot robot_;
  std::vector<RefinerSample> samples_;
  BodySchema schema_;
  RefineOptions options_;
};

TEST_F(RefineRefuses, NothingThatIsRight) { EXPECT_EQ(refusal(robot_.truth), ""); }

TEST_F(RefineRefuses, CommandsInAnotherUnit) {
  for (RefinerSample& seen : samples_) seen.sample.action /= kDegree;
  expect_refusal("another unit", robot_.truth);
}

TEST_F(RefineRefuses, PlacementsWithoutARig) { expect_refusal("rig", std::nullopt); }

TEST_F(RefineRefuses, PlacementsWithoutCorners) {
  for (RefinerSample& seen : samples_) seen.tags.clear();
  expect_refusal("corners", robot_.truth);
}

TEST_F(RefineRefuses, SamplesThatShowTheRootAlone) {
  options_.placements = false;
  for (RefinerSample& seen : samples_) {
    seen.sample.parts.resize(1);
    seen.sample.parts.front().part = schema_.root;
    seen.sample.parts.front().X_CB = schema_.X_CR;
  }
  expect_refusal("but its root", std::nullopt);
}

TEST_F(RefineRefuses, AnotherRig) {
  RigCalibration other = robot_.truth;
  other.markers.tags.front().size_m *= 1.01;
  expect_refusal("another calibration", other);
}

TEST_F(RefineRefuses, NoSamples) {
  samples_.clear();
  expect_refusal("no samples", robot_.truth);
}

TEST_F(RefineRefuses, SamplesThatAreAllForTests) {
  for (RefinerSample& seen : samples_) seen.sample.purpose = Purpose::kTest;
  expect_refusal("no TRAIN samples", robot_.truth);
}

TEST_F(RefineRefuses, NumbersThatAreNotFinite) {
  samples_[3].tags.front().corners_px(2) = std::numeric_limits<double>::quiet_NaN();
  expect_refusal("sample 3 has numbers that are not finite", robot_.truth);
}

TEST_F(RefineRefuses, ActionsOfAnotherSize) {
  samples_[2].sample.action.conservativeResize(1);
  expect_refusal("sample 2 has 1 action signals, the schema 2", robot_.truth);
}

TEST_F(RefineRefuses, ASchemaWithoutEdges) {
  schema_.edges.clear();
  expect_refusal("nothing to refine", robot_.truth);
}

TEST_F(RefineRefuses, TagsOfOtherParts) {
  for (RefinerSample& seen : samples_)
    for (TagSight& sight : seen.tags) sight.tag += 500;
  expect_refusal("no sample shows a tag", robot_.truth);
}

TEST(RefinerConfig, ReadsEveryKeyAndRefusesAFileWithoutOne) {
  const auto file = std::filesystem::path(testing::TempDir()) / "refiner.yaml";
  const std::string text =
      "enabled: true\nrefine_every: 20\nplacements: true\nintrinsics: false\n"
      "tag_position_m: 0.001\ntag_rotation_deg: 0.5\ntag_size_share: 0.01\n"
      "focal_length_share: 0.02\ncentre_px: 7\ndistortion: 0.05\njoint_play_m: 0.001\n"
      "joint_play_deg: 0.1\n";
  std::ofstream(file) << text;
  EXPECT_THROW(RefinerConfig::load(file), std::runtime_error);
  std::ofstream(file) << text << "max_samples: 50\n";
  const RefinerConfig config = RefinerConfig::load(file);
  EXPECT_TRUE(config.enabled && config.placements && !config.intrinsics);
  EXPECT_EQ(config.refine_every, 20);
  EXPECT_EQ(config.tags.position_m, 0.001);
  EXPECT_EQ(config.centre_px, 7);
  EXPECT_EQ(config.joint_play.position_m, 0.001);
  EXPECT_EQ(config.max_samples, 50);
}

TEST(RefinerSamples, AreThinnedEvenly) {
  std::vector<RefinerSample> samples(10);
  for (int n = 0; n < 10; ++n) samples[n].sample.sample_index = n;
  const std::vector<RefinerSample> few = thinned(samples, 5);
  ASSERT_EQ(few.size(), 5U);
  for (int n = 0; n < 5; ++n) EXPECT_EQ(few[n].sample.sample_index, 2 * n);
  EXPECT_EQ(thinned(samples, 20).size(), 10U);
}

// Nine of ten samples are of one action. Evenly spaced, hardly any other would be fitted.
TEST(RefinerSamples, ThatTellMostAreFitted) {
  test::Rng rng(4);
  const test::SyntheticRobot robot = test::chapter_robot("a", rng);
  const test::ObservationOptions noise{.regime = test::Regime::kTagIso, .with_covariances = true};
  std::vector<ActionPoseSample> samples = test::babble(robot, 400, noise, rng);
  std::set<std::int64_t> others;
  for (ActionPoseSample& sample : samples) {
    if (sample.sample_index % 10 == 1)
      others.insert(sample.sample_index);
    else
      sample = test::observe(robot, samples.front().action, noise, sample.sample_index, rng);
  }
  BodySchema schema = test::true_schema(robot);
  schema.X_CR = robot.X_CR;
  RefineOptions options;
  options.config.max_samples = 60;
  const auto chosen = informative(refiner_samples(samples), schema, {}, options, false);
  EXPECT_LE(chosen.size(), 60U);
  EXPECT_GE(chosen.size(), 55U);
  const auto num_others = std::ranges::count_if(
      chosen, [&](const auto& seen) { return others.contains(seen.sample.sample_index); });
  EXPECT_GE(num_others, 36);  // of 40
  const Refinement result = refine(schema, refiner_samples(samples), {}, options);
  EXPECT_EQ(result.num_samples, static_cast<int>(chosen.size()));
  EXPECT_EQ(result.num_available, 400);
}

}  // namespace
}  // namespace bodyschema
