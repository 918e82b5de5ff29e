#include <gtest/gtest.h>

#include <algorithm>
#include <filesystem>
#include <set>
#include <vector>

#include "common/bus/channels.h"
#include "common/bus/codec.h"
#include "common/bus/convert.h"
#include "common/bus/event_log.h"
#include "processes/model_monitor/model_monitor.h"
#include "processes/structure_learner/learn.h"

namespace bodyschema {
namespace {

using Bytes = std::vector<std::uint8_t>;

/// A recording of arm2 in which every second sample, the first one too, is TEST. Its proposals are
/// the truth; others differ from them by an error of the last edge.
class RefinedSchemaTest : public testing::Test {
 protected:
  RefinedSchemaTest() {
    std::set<std::int64_t> known;
    for (const sample_t& sample : read_log(BODYSCHEMA_LOGS "/arm2_15.lcmlog", kSample)) {
      if (!known.insert(sample.sample_index).second) continue;
      samples_.push_back(sample);
      samples_.back().purpose = sample.sample_index % 2 == 0 ? action_command_t::PURPOSE_TEST
                                                             : action_command_t::PURPOSE_TRAIN;
    }
    proposals_ = read_log(BODYSCHEMA_LOGS "/arm2_15.lcmlog", kLearnedSchema);
    config_.refine_every = 10;
    config_.view = TagView::load(BODYSCHEMA_CONFIG "/arm2");
  }

  /// The proposal on a sample, with the last edge so much too long.
  body_schema_t learned(std::int64_t sample, double error_m) const {
    BodySchema schema = from_message(
        *std::find_if(proposals_.begin(), proposals_.end(),
                      [&](const body_schema_t& p) { return p.last_sample_index == sample; }));
    schema.edges.back().right.translation().x() += error_m;
    return to_message(schema);
  }
  /// The refiner's answer to it.
  body_schema_t refined(std::int64_t sample, double error_m) const {
    body_schema_t schema = learned(sample, error_m);
    schema.is_refined = 1;
    schema.calibration_id += 1;
    return schema;
  }
  /// After the verdict on sample 10.
  ModelMonitor monitor(double learned_error_m, double refined_error_m) const {
    ModelMonitor monitor(config_);
    for (std::int64_t i = 0; i <= 10; ++i) monitor.on_sample(samples_.at(i));
    monitor.on_refined_schema(refined(10, refined_error_m));
    EXPECT_TRUE(monitor.on_learned_schema(learned(10, learned_error_m)));
    return monitor;
  }
  /// Then the verdict on a later proposal.
  void go_on(ModelMonitor* monitor, std::int64_t sample, const body_schema_t& proposal) const {
    for (std::int64_t i = 11; i <= sample; ++i) monitor->on_sample(samples_.at(i));
    EXPECT_TRUE(monitor->on_learned_schema(proposal));
  }
  static double length(const body_schema_t& schema) {
    return from_message(schema).edges.back().right.translation().x();
  }
  static Bytes bytes_of(const ModelMonitor& monitor) {
    return encode(kBodySchema, *monitor.schema());
  }

  ModelMonitorConfig config_ = {.max_mahalanobis2 = 20.06,
                                .max_outlier_share = 0.2,
                                .measurement = {.systematic = kTagSystematic}};
  std::vector<sample_t> samples_;
  std::vector<body_schema_t> proposals_;
};

TEST_F(RefinedSchemaTest, ThatPredictsCornersBetterIsTheBodySchemaInTheRigsOwnCalibration) {
  const ModelMonitor monitor = this->monitor(5e-4, 0);
  ASSERT_TRUE(monitor.schema());
  EXPECT_EQ(monitor.schema()->is_refined, 1);
  EXPECT_EQ(monitor.schema()->schema_version, 11);
  EXPECT_EQ(monitor.schema()->calibration_id, learned(10, 0).calibration_id);
  EXPECT_EQ(length(*monitor.schema()), length(learned(10, 0)));
  EXPECT_NE(monitor.health().events.back().event_text.find("refined"), std::string::npos);
}

TEST_F(RefinedSchemaTest, ThatPredictsCornersWorseIsNot) {
  const ModelMonitor monitor = this->monitor(0, 5e-4);
  ASSERT_TRUE(monitor.schema());
  EXPECT_EQ(monitor.schema()->is_refined, 0);
  EXPECT_EQ(length(*monitor.schema()), length(learned(10, 0)));
}

// The root is seen beside where its corners are, which the learned schema rests on.
TEST_F(RefinedSchemaTest, ThatPosesRefuteLeavesTheLearnedOne) {
  Pose bias = Pose::Identity();
  bias.translation().x() = 0.03;
  const body_schema_t exact = learned(10, 0);
  for (sample_t& sample : samples_)
    for (part_observation_t& part : sample.parts)
      if (part.part_id == exact.root_part) part.X_CB = to_message(from_message(part.X_CB) * bias);
  BodySchema biased = from_message(exact);
  biased.X_CR = biased.X_CR * bias;
  for (Edge& edge : biased.edges)
    if (edge.from == biased.root) edge.left = bias.inverse() * edge.left;
  ModelMonitor monitor(config_);
  for (std::int64_t i = 0; i <= 10; ++i) monitor.on_sample(samples_.at(i));
  monitor.on_refined_schema(refined(10, 0));
  monitor.on_learned_schema(to_message(biased));
  ASSERT_TRUE(monitor.schema());
  EXPECT_EQ(monitor.schema()->is_refined, 0);
  EXPECT_EQ(monitor.schema()->schema_version, 11);
}

TEST_F(RefinedSchemaTest, AnAnswerThatIsNoRefinementIsNoneEitherNorIsOneWithoutAViewOfTheTags) {
  body_schema_t answer = refined(10, 0);
  answer.is_refined = 0;
  ModelMonitor monitor(config_);
  for (std::int64_t i = 0; i <= 10; ++i) monitor.on_sample(samples_.at(i));
  monitor.on_refined_schema(answer);
  monitor.on_learned_schema(learned(10, 5e-4));
  EXPECT_EQ(length(*monitor.schema()), length(learned(10, 5e-4)));

  config_.view.reset();
  EXPECT_EQ(this->monitor(5e-4, 0).schema()->is_refined, 0);
}

TEST_F(RefinedSchemaTest, OfASampleThatIsNotThereOrNotDueDisplacesNone) {
  const auto of_sample = [&](std::int64_t index) {
    body_schema_t forged = refined(14, 1e-3);
    forged.last_sample_index = index;
    return forged;
  };
  for (const std::int64_t index : {std::int64_t{12}, std::int64_t{1} << 40}) {
    ModelMonitor monitor(config_);
    for (std::int64_t i = 0; i <= 12; ++i) monitor.on_sample(samples_.at(i));
    for (int n = 0; n < 100; ++n)
      EXPECT_FALSE(monitor.on_refined_schema(of_sample(index + (index > 12 ? n : 0))));
    EXPECT_FALSE(monitor.on_learned_schema(learned(10, 5e-4)));
    EXPECT_EQ(monitor.health().awaited_refinement, 10);
    EXPECT_TRUE(monitor.on_refined_schema(refined(10, 0)));
    EXPECT_EQ(monitor.schema()->is_refined, 1);
    EXPECT_EQ(length(*monitor.schema()), length(learned(10, 0)));
  }
}

TEST_F(RefinedSchemaTest, StandsUntilAProposalPredictsCornersBetter) {
  ModelMonitor monitor = this->monitor(1e-3, 5e-4);
  const Bytes before = bytes_of(monitor);
  go_on(&monitor, 12, learned(12, 1e-3));
  EXPECT_EQ(bytes_of(monitor), before);
  EXPECT_EQ(monitor.health().judged_sample, 12);
  go_on(&monitor, 14, learned(14, 0));
  EXPECT_EQ(monitor.schema()->is_refined, 0);
  EXPECT_EQ(monitor.schema()->schema_version, 15);
  // A learned one does not stand so: each next one takes its place.
  ModelMonitor other = this->monitor(5e-4, 1e-3);
  go_on(&other, 12, learned(12, 1e-3));
  EXPECT_EQ(other.schema()->schema_version, 13);
}

TEST_F(RefinedSchemaTest, OfAnotherRunStandsJustSo) {
  body_schema_t initial = refined(14, 0);
  initial.last_sample_index = -1;
  initial.calibration_id = learned(14, 0).calibration_id;
  for (const bool is_refined : {true, false}) {
    initial.is_refined = is_refined ? 1 : 0;
    ModelMonitor monitor(config_);
    monitor.start_from(initial);
    for (std::int64_t i = 0; i <= 8; ++i) monitor.on_sample(samples_.at(i));
    ASSERT_TRUE(monitor.on_learned_schema(learned(8, 5e-4)));
    EXPECT_EQ(length(*monitor.schema()),
              length(learned(is_refined ? 14 : 8, is_refined ? 0 : 5e-4)));
  }
}

TEST_F(RefinedSchemaTest, GivesWayToOneThatShowsAPartThatItLacks) {
  const auto without_last_part = [](body_schema_t message) {
    BodySchema schema = from_message(message);
    std::erase(schema.parts, schema.edges.back().to);
    schema.frame_covariances.erase(schema.edges.back().to);
    schema.edges.pop_back();
    return to_message(schema);
  };
  ModelMonitor monitor(config_);
  body_schema_t initial = without_last_part(refined(14, 0));
  initial.last_sample_index = -1;
  monitor.start_from(initial);
  for (std::int64_t i = 0; i <= 8; ++i) monitor.on_sample(samples_.at(i));
  ASSERT_TRUE(monitor.on_learned_schema(learned(8, 5e-4)));
  EXPECT_EQ(monitor.schema()->num_parts, learned(8, 0).num_parts);
}

TEST_F(RefinedSchemaTest, IsDefendedAfterARestartToo) {
  const ModelMonitor before = monitor(1e-3, 5e-4);
  ModelMonitor monitor(config_);
  monitor.restore(before.memory());
  for (std::int64_t i = 0; i <= 10; ++i) monitor.on_sample(samples_.at(i));
  EXPECT_EQ(bytes_of(monitor), bytes_of(before));
  go_on(&monitor, 12, learned(12, 1e-3));
  EXPECT_EQ(bytes_of(monitor), bytes_of(before));
}

}  // namespace
}  // namespace bodyschema
