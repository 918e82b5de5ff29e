// Class ModelMonitor: figures computed by hand, and its configuration.

#include <gtest/gtest.h>

#include <filesystem>
#include <fstream>

#include "common/bus/check.h"
#include "common/config/yaml.h"
#include "common/geometry/angle.h"
#include "tests/processes/model_monitor/model_monitor_bench.h"
#include "tests/support/temporary_folder.h"

namespace bodyschema::test {
namespace {

// Parts 1 (root, 2 m before the camera) and 2 (0.1 m beside it), no joint.
BodySchema two_parts() {
  BodySchema schema;
  schema.complete = true;
  schema.parts = {1, 2};
  schema.root = 1;
  schema.X_CR.translation() = Eigen::Vector3d(0, 0, 2);
  schema.signals = {{"q1", -1, 1}};
  Edge edge;
  edge.from = 1;
  edge.to = 2;
  edge.right.translation() = Eigen::Vector3d(0.1, 0, 0);
  schema.edges = {edge};
  return schema;
}

sample_t two_parts_seen(std::int64_t index, double error_m, double error_rad, bool sees_2 = true) {
  ActionPoseSample sample;
  sample.sample_index = index;
  sample.utime = index + 1;
  sample.purpose = Purpose::kTest;
  sample.action = Eigen::VectorXd::Constant(1, 0.5);
  PartObservation one = observation(1, Pose::Identity(), 0.01, 0.1);
  one.X_CB.translation() = Eigen::Vector3d(0, 0, 2);
  PartObservation two = observation(2, Pose::Identity(), 0.01, 0.1);
  two.X_CB.translation() = Eigen::Vector3d(0.1, error_m, 2);
  two.X_CB.linear() = exp_so3({0, 0, error_rad});
  sample.parts = {one};
  if (sees_2) sample.parts.push_back(two);
  return to_message(sample);
}

TEST(ModelMonitorByHandTest, ErrorsAndVisibilityAreAsComputedByHand) {
  ModelMonitor monitor(test_config());
  monitor.on_sample(two_parts_seen(0, 0.005, 0.03));
  monitor.on_sample(two_parts_seen(1, 0.001, 0.01));
  monitor.on_sample(two_parts_seen(2, 0, 0, false));
  monitor.on_sample(two_parts_seen(3, 0.002, 0.02));
  monitor.on_sample(two_parts_seen(4, 9, 1));  // beyond the proposal
  BodySchema schema = two_parts();
  schema.last_sample_index = 3;
  EXPECT_TRUE(monitor.on_learned_schema(to_message(schema)));
  ASSERT_TRUE(monitor.schema());
  const model_health_t& health = monitor.health();
  EXPECT_EQ(health.num_test_samples, 4);
  ASSERT_EQ(health.num_parts, 2);
  EXPECT_EQ(health.part_health[0].num_predicted, 4);
  EXPECT_DOUBLE_EQ(health.part_health[0].visibility, 1);
  EXPECT_NEAR(health.part_health[0].position_median_m, 0, 1e-12);
  EXPECT_EQ(health.part_health[1].num_predicted, 3);
  EXPECT_DOUBLE_EQ(health.part_health[1].visibility, 0.75);
  EXPECT_NEAR(health.part_health[1].position_median_m, 0.002, 1e-12);
  EXPECT_NEAR(health.part_health[1].rotation_median_rad, 0.02, 1e-9);
  EXPECT_NEAR(health.worst_position_m, 0.002, 1e-12);
  EXPECT_NEAR(health.worst_rotation_rad, 0.02, 1e-9);
  // d² of sample 3: z = (0.1, 0.002, 0) turned by 0.02 about z. Σ_z = Σ_2 + Ad(z⁻¹) Σ_1 Ad(z⁻¹)ᵀ
  // + model error; the lever arm of 0.1 m makes the root's turn about z a shift along y.
  ASSERT_EQ(health.num_edges, 1);
  EXPECT_EQ(health.edge_health[0].num_tests, 3);
  const double var_p = 0.01 * 0.01, var_r = 0.1 * 0.1, model_r = 0.2 * kDegree;
  const double yy = 2 * var_p + 0.1 * 0.1 * var_r + 1e-6, rr = 2 * var_r + model_r * model_r;
  const double ry = 0.1 * var_r;
  const double det = yy * rr - ry * ry;
  const double y = 0.002, r = 0.02;
  const double d2 = (rr * y * y - 2 * ry * y * r + yy * r * r) / det;
  EXPECT_NEAR(health.edge_health[0].median_mahalanobis2, d2, 0.02 * d2);
}

TEST(ModelMonitorByHandTest, TheMedianOfAnEvenNumberIsTheMeanOfTheMiddleTwo) {
  ModelMonitor monitor(test_config());
  const double errors_m[] = {0.008, 0.001, 0.004, 0.002};
  for (int i = 0; i < 4; ++i) monitor.on_sample(two_parts_seen(i, errors_m[i], 0));
  BodySchema schema = two_parts();
  schema.last_sample_index = 3;
  monitor.on_learned_schema(to_message(schema));
  EXPECT_NEAR(monitor.health().worst_position_m, 0.003, 1e-12);
}

TEST(ModelMonitorByHandTest, SamplesOfAnotherRigDoNotEndTheProcess) {
  ModelMonitor monitor(test_config());
  BodySchema schema = two_parts();
  schema.signals.push_back({"q2", -1, 1});
  schema.last_sample_index = 1;
  schema.version = 2;
  EXPECT_NO_THROW(monitor.start_from(to_message(schema)));
  monitor.on_sample(two_parts_seen(0, 0, 0));
  monitor.on_sample(two_parts_seen(1, 0, 0));
  EXPECT_EQ(monitor.health().worst_position_m, -1);
  monitor.on_sample(two_parts_seen(2, 0, 0));
  schema.last_sample_index = 2;
  EXPECT_NO_THROW(monitor.on_learned_schema(to_message(schema)));
  EXPECT_EQ(check(monitor.health()), "");
}

TEST(ModelMonitorByHandTest, VerdictsThatWereTooManyToRememberAreCountedAfterARestart) {
  MonitorMemory memory;
  memory.at_base.judged_sample = -1;
  std::vector<health_event_t> verdicts;
  for (int n = 8; n < 40; ++n) {
    health_event_t event{};
    event.event_number = n;
    event.event_sample = n - 8;
    event.event_from = event.event_to = event.event_part = event.event_tag = -1;
    event.event_kind = health_event_t::EVENT_SCHEMA_REFUSED;
    verdicts.push_back(event);
  }
  set_array(memory.verdicts.num_events, memory.verdicts.events, std::move(verdicts));
  memory.verdicts.judged_sample = 31;
  ModelMonitor monitor(test_config());
  monitor.restore(memory);
  for (int i = 0; i < 32; ++i) monitor.on_sample(two_parts_seen(i, 0, 0));
  EXPECT_EQ(monitor.health().events.back().event_number, 39);
}

TEST(ModelMonitorByHandTest, AProposalWithoutPartsIsRefusedQuietly) {
  ModelMonitor monitor(test_config());
  monitor.on_sample(two_parts_seen(0, 0, 0));
  BodySchema schema;
  schema.signals = {{"q1", -1, 1}};
  schema.last_sample_index = 0;
  EXPECT_TRUE(monitor.on_learned_schema(to_message(schema)));
  EXPECT_FALSE(monitor.schema());
  EXPECT_EQ(check(monitor.health()), "");
}

TEST(ModelMonitorByHandTest, ALearnedEdgeTravelsAndIsKnownAgainInTheHistory) {
  constexpr int kSamples = 100;
  BrokenArm arm({Fault::kWorn, "", 1}, Regime::kTagIso, kSamples / 2, 3);
  const AdaptationOptions options = adaptation_options(Regime::kTagIso);
  Adaptation adaptation(arm.engineered(), options);
  for (int t = 0; t < kSamples; ++t) adaptation.on_sample(arm.observe(t));
  const BodySchema& schema = adaptation.schema();
  const Edge* learned = edge_to(schema, 4);
  ASSERT_TRUE(learned->residual_gp);
  EXPECT_STREQ(learned->kind(), "screw_gp");
  const body_schema_t message = to_message(schema);
  EXPECT_EQ(check(message), "");
  EXPECT_LT(encode(kBodySchema, message).size(), 64000U);
  const BodySchema again = from_message(message);
  const Edge* back = edge_to(again, 4);
  ASSERT_TRUE(back && back->residual_gp);
  EXPECT_EQ(back->signals(), learned->signals());
  for (double q = -1.3; q <= 1.3; q += 0.26) {
    const Eigen::VectorXd theta = Eigen::VectorXd::Constant(7, q);
    EXPECT_LT(log(back->predict(theta).inverse() * learned->predict(theta)).norm(), 1e-9);
    EXPECT_LT((back->prediction_covariance(theta) - learned->prediction_covariance(theta)).norm(),
              1e-12);
  }
  EXPECT_EQ(Adaptation(again, options, {arm.engineered(), schema}, {}).history().size(), 2U);
}

TEST(ModelMonitorConfigTest, IsReadInSiUnits) {
  const TemporaryFolder folder;
  const std::filesystem::path file = folder / "model_monitor.yaml";
  std::ofstream(file) << "max_mahalanobis2: 16\nmax_outlier_share: 0.25\nfalse_alarm_rate: 1e-6\n";
  EXPECT_THROW(ModelMonitorConfig::load(file), ConfigError);  // no noise.yaml
  std::filesystem::copy_file(std::filesystem::path(BODYSCHEMA_CONFIG) / "arm4" / "noise.yaml",
                             folder / "noise.yaml");
  const ModelMonitorConfig config = ModelMonitorConfig::load(file);
  EXPECT_EQ(config.max_mahalanobis2, 16);
  EXPECT_EQ(config.max_outlier_share, 0.25);
  EXPECT_EQ(config.measurement.systematic.position_m, 0.001);
  EXPECT_EQ(config.false_alarm_rate, 1e-6);
  std::ofstream(file) << "max_mahalanobis2: 0.5\n";
  EXPECT_THROW(ModelMonitorConfig::load(file), ConfigError);
}

}  // namespace
}  // namespace bodyschema::test
