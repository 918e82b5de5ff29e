#include "common/bus/check.h"

#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <functional>
#include <random>
#include <string>
#include <type_traits>
#include <utility>

#include "common/bus/convert.h"
#include "common/bus/triangle.h"
#include "common/text/text.h"
#include "tests/lcmtypes/example_messages.h"

namespace bodyschema::test {
namespace {

/// Fails unless check() refuses the changed message and its complaint begins with `field`.
template <class Message>
void expect_refused(Message message, const std::string& field,
                    const std::type_identity_t<std::function<void(Message&)>>& change) {
  ASSERT_EQ(check(message), "");
  change(message);
  const std::string problem = check(message);
  EXPECT_EQ(problem.substr(0, field.size() + 1), field + " ") << "complaint: " << problem;
}

TEST(Check, AcceptsEveryExample) {
  for_each_channel([](const auto& channel, const auto& message) {
    EXPECT_EQ(check(message), "") << channel.name;
  });
}

TEST(Check, RefusesTimesBeforeZero) {
  expect_refused(example_action_command(), "utime", [](auto& m) { m.utime = -1; });
  expect_refused(example_action_command(), "expiry_utime", [](auto& m) { m.expiry_utime = -1; });
  expect_refused(example_motion_status(), "rest_since_utime",
                 [](auto& m) { m.rest_since_utime = -2; });
  expect_refused(example_sample(), "sample_index", [](auto& m) { m.sample_index = INT64_MAX; });
  expect_refused(example_sample(), "rest_end_utime",
                 [](auto& m) { m.rest_end_utime = m.rest_begin_utime - 1; });
}

TEST(Check, RefusesConstantsThatNobodyDefined) {
  expect_refused(example_action_command(), "kind", [](auto& m) { m.kind = 4; });
  expect_refused(example_action_command(), "purpose", [](auto& m) { m.purpose = -1; });
  expect_refused(example_motion_status(), "state", [](auto& m) { m.state = 8; });
  expect_refused(example_camera_image(), "encoding", [](auto& m) { m.encoding = 3; });
  expect_refused(example_body_schema(), "edges[0].state", [](auto& m) { m.edges[0].state = 4; });
  expect_refused(example_process_info(), "phase", [](auto& m) { m.phase = 9; });
  expect_refused(example_model_health(), "events[0].event_kind",
                 [](auto& m) { m.events[0].event_kind = 11; });
  expect_refused(example_model_health(), "part_health[0].part_state",
                 [](auto& m) { m.part_health[0].part_state = 4; });
  expect_refused(example_model_health(), "part_health[0].is_unseen",
                 [](auto& m) { m.part_health[0].is_unseen = 2; });
  expect_refused(example_model_health(), "edge_health[0].edge_is_drifting",
                 [](auto& m) { m.edge_health[0].edge_is_drifting = -1; });
  expect_refused(example_sample(), "parts[0].has_other", [](auto& m) { m.parts[0].has_other = 2; });
}

TEST(Check, RefusesQuaternionsThatAreNotUnit) {
  expect_refused(example_sample(), "parts[1].X_CB.rotation_wxyz",
                 [](auto& m) { m.parts[1].X_CB.rotation_wxyz[0] += 0.01; });
  expect_refused(example_sim_state(), "X_WG[2].pose.rotation_wxyz", [](auto& m) {
    for (double& q : m.X_WG[2].rotation_wxyz) q = 0;
  });
}

TEST(Check, RefusesCovariancesThatAreNone) {
  expect_refused(example_sample(), "parts[0].covariance",
                 [](auto& m) { m.parts[0].covariance[4] = 1; });
  expect_refused(example_sample(), "parts[0].covariance",
                 [](auto& m) { m.parts[0].covariance[9] = -1e-9F; });
  expect_refused(example_sample(), "parts[0].tags[0].corner_covariance",
                 [](auto& m) { m.parts[0].tags[0].corner_covariance[1] = 1; });
  expect_refused(example_marker_poses(), "markers[0].corner_covariance",
                 [](auto& m) { m.markers[0].corner_covariance[35] = 0; });
  expect_refused(example_marker_poses(), "markers[0].covariance",
                 [](auto& m) { std::ranges::fill(m.markers[0].covariance, 0.0F); });
  expect_refused(example_body_schema(), "edges[0].parameter_covariance",
                 [](auto& m) { m.edges[0].parameter_covariance[1] = 1; });
  body_schema_t schema = example_body_schema();
  std::ranges::fill(schema.X_CR_covariance, 0.0F);
  EXPECT_EQ(check(schema), "") << "an unknown camera pose has no covariance yet";
}

TEST(Check, AcceptsASingularCovarianceAndOneWithVeryDifferentUnits) {
  sample_t sample = example_sample();
  for (int i = 0, k = 0; i < 6; ++i) {
    for (int j = 0; j <= i; ++j, ++k) {
      const float scale_i = i < 3 ? 1e-6F : 1e3F;
      const float scale_j = j < 3 ? 1e-6F : 1e3F;
      sample.parts[0].covariance[k] = scale_i * scale_j;
    }
  }
  EXPECT_EQ(check(sample), "");
}

TEST(Check, AcceptsANearlySingularCovarianceThatRoundingToFloatMadeIndefinite) {
  std::mt19937_64 rng(5);
  std::normal_distribution<double> normal;
  int num_indefinite = 0;
  sample_t sample = example_sample();
  for (int n = 0; n < 2000; ++n) {
    Eigen::Matrix<double, 6, 6> root = Eigen::Matrix<double, 6, 6>::Zero();
    for (double& value : root.leftCols<5>().reshaped()) value = normal(rng);
    root.topRows<3>() *= 1e-3;
    const Eigen::Matrix<double, 6, 6> singular = root * root.transpose();
    pack_triangle(singular, sample.parts[0].covariance);
    ASSERT_EQ(check(sample), "");
    const auto rounded = unpack_triangle<6>(sample.parts[0].covariance);
    num_indefinite += correlation_of(rounded).selfadjointView<Eigen::Lower>().eigenvalues()[0] < 0;
    // A receiver may invert it, and sends it on unchanged.
    const Matrix6d covariance = from_message(sample.parts[0].covariance);
    EXPECT_EQ(covariance.llt().info(), Eigen::Success);
    EXPECT_TRUE(correlation_of(covariance).isApprox(correlation_of(rounded), 3e-5));
    to_message(covariance, sample.parts[0].covariance);
    EXPECT_EQ(from_message(sample.parts[0].covariance),
              unpack_triangle<6>(sample.parts[0].covariance));
  }
  EXPECT_GT(num_indefinite, 100);
}

TEST(Check, APositionAloneSaysNothingOfRotation) {
  const auto alone = [] {
    sample_t sample = example_sample();
    part_observation_t& part = sample.parts[0];
    part.has_rotation = 0;
    part.X_CB.rotation_wxyz[0] = 1;
    for (int i = 1; i < 4; ++i) part.X_CB.rotation_wxyz[i] = 0;
    part.X_CB_other = part.X_CB;
    std::fill(part.covariance + 6, part.covariance + 21, 0.0F);
    return sample;
  };
  EXPECT_EQ(check(alone()), "");
  expect_refused(alone(), "parts[0].X_CB", [](auto& m) { m.parts[0].X_CB = m.parts[1].X_CB; });
  expect_refused(alone(), "parts[0].X_CB_other",
                 [](auto& m) { m.parts[0].X_CB_other = m.parts[1].X_CB; });
  expect_refused(alone(), "parts[0].covariance",
                 [](auto& m) { m.parts[0].covariance[20] = 1e-6F; });
  expect_refused(alone(), "parts[0].covariance", [](auto& m) {
    std::fill(m.parts[0].covariance, m.parts[0].covariance + 6, 0.0F);
  });
  expect_refused(alone(), "parts[0].has_other", [](auto& m) {
    m.parts[0].has_other = 1;
    m.parts[0].error_ratio = 2;
  });
  expect_refused(alone(), "parts[0].has_rotation", [](auto& m) { m.parts[0].has_rotation = 2; });
}

TEST(Check, RefusesIdsThatRepeatOrAreOutOfOrder) {
  expect_refused(example_sample(), "parts[1].part_id",
                 [](auto& m) { m.parts[1].part_id = m.parts[0].part_id; });
  expect_refused(example_sample(), "parts[0].part_id", [](auto& m) { m.parts[0].part_id = -1; });
  expect_refused(example_marker_poses(), "markers[1].marker_id",
                 [](auto& m) { m.markers[1].marker_id = 2; });
  expect_refused(example_sim_state(), "true_part", [](auto& m) { m.true_part = {7, 1}; });
  expect_refused(example_body_schema(), "part_ids", [](auto& m) { m.part_ids[3] = 1; });
  expect_refused(example_process_info(), "counters[1].counter_name",
                 [](auto& m) { m.counters[1].counter_name = m.counters[0].counter_name; });
}

TEST(Check, RefusesCountsThatAreNotTheLengthOfTheirArray) {
  expect_refused(example_sample(), "action", [](auto& m) { ++m.num_signals; });
  expect_refused(example_sample(), "parts", [](auto& m) { m.num_parts = -1; });
  expect_refused(example_sample(), "parts[0].tags", [](auto& m) { ++m.parts[0].num_tags; });
  expect_refused(example_camera_image(), "data", [](auto& m) { --m.num_bytes; });
  expect_refused(example_sim_state(), "geom_alpha", [](auto& m) { m.geom_alpha.pop_back(); });
}

TEST(Check, RefusesCountsBeyondReason) {
  expect_refused(example_sample(), "parts", [](auto& m) {
    m.parts.resize(10'001);
    m.num_parts = 10'001;
  });
  expect_refused(example_model_health(), "events", [](auto& m) {
    m.events.resize(33);
    m.num_events = 33;
  });
}

TEST(Check, RefusesAnImageThatItsBytesCannotBe) {
  expect_refused(example_camera_image(), "num_bytes", [](auto& m) { ++m.height; });
  expect_refused(example_camera_image(), "width", [](auto& m) { m.width = 31; });
  expect_refused(example_camera_image(), "height", [](auto& m) { m.height = 16'385; });
  expect_refused(example_camera_info(), "num_coefficients", [](auto& m) {
    m.distortion.resize(3);
    m.num_coefficients = 3;
  });
  expect_refused(example_camera_info(), "fx", [](auto& m) { m.fx = 0; });
}

TEST(Check, RefusesASchemaThatIsNoTreeOfItsOwnPartsAndSignals) {
  expect_refused(example_body_schema(), "edges[0].to_part",
                 [](auto& m) { m.edges[0].to_part = 7; });
  expect_refused(example_body_schema(), "edges[0].from_part",
                 [](auto& m) { m.edges[0].from_part = 7; });
  expect_refused(example_body_schema(), "edges[1].to_part",
                 [](auto& m) { m.edges[1].to_part = 2; });
  expect_refused(example_body_schema(), "edges[1].to_part",
                 [](auto& m) { std::swap(m.edges[0], m.edges[1]); });
  expect_refused(example_body_schema(), "edges[0].joints[1].signal_index",
                 [](auto& m) { m.edges[0].joints[1].signal_index = 2; });
  expect_refused(example_body_schema(), "undecided_signals",
                 [](auto& m) { m.undecided_signals[1] = m.num_signals; });
  expect_refused(example_body_schema(), "undecided_signals",
                 [](auto& m) { m.undecided_signals[1] = 0; });
  expect_refused(example_body_schema(), "root_part", [](auto& m) { m.root_part = -1; });
  expect_refused(example_body_schema(), "is_complete", [](auto& m) { m.is_complete = 1; });
  expect_refused(example_body_schema(), "edges[1].base_kind",
                 [](auto& m) { m.edges[1].base_kind = schema_edge_t::EDGE_SCREW; });
  expect_refused(example_body_schema(), "edges[0].num_covariance", [](auto& m) {
    m.edges[0].parameter_covariance.resize(21);
    m.edges[0].num_covariance = 21;
  });
}

TEST(Check, RefusesAGaussianProcessThatCannotBeFactorisedAgain) {
  const auto residual = [](const std::string& field, const auto& spoil) {
    expect_refused(example_body_schema(), "edges[2].residual_gp[0]." + field,
                   [&](auto& m) { spoil(m.edges[2].residual_gp[0]); });
  };
  residual("gp_signals", [](auto& gp) { gp.gp_signals[1] = 2; });
  residual("gp_length_scales", [](auto& gp) { gp.gp_length_scales[0] = 0; });
  residual("gp_length_scales", [](auto& gp) { gp.gp_length_scales.pop_back(); });
  residual("gp_variances", [](auto& gp) { gp.gp_variances[5] = -1; });
  residual("gp_variances", [](auto& gp) { gp.gp_variances[0] = 1e200; });
  residual("gp_noise_variances", [](auto& gp) { gp.gp_noise_variances[3] = NAN; });
  residual("gp_noise_scales", [](auto& gp) { gp.gp_noise_scales[2] = 0; });
  residual("gp_inputs", [](auto& gp) { gp.gp_inputs[4] = INFINITY; });
  residual("gp_inputs", [](auto& gp) {
    gp.gp_inputs.resize(3);
    gp.num_gp_inputs = 3;
  });
  residual("gp_residuals", [](auto& gp) { gp.gp_residuals[7] = 1e4; });
  residual("num_gp_samples", [](auto& gp) {
    gp.num_gp_samples = 65;
    gp.gp_noise_scales.assign(65, 1);
    gp.num_gp_inputs = 130;
    gp.gp_inputs.assign(130, 0);
    gp.num_gp_residuals = 390;
    gp.gp_residuals.assign(390, 0);
  });
  const auto matrix = [](const std::string& field, const auto& spoil) {
    expect_refused(example_body_schema(), "edges[3].matrix_gp[0]." + field,
                   [&](auto& m) { spoil(m.edges[3].matrix_gp[0]); });
  };
  matrix("matrix_signals", [](auto& gp) { gp.matrix_signals[0] = -1; });
  matrix("entry_length_scales", [](auto& gp) { gp.entry_length_scales[11] = -2; });
  matrix("entry_variances", [](auto& gp) { gp.entry_variances[2] = 0; });
  matrix("entry_noise_variances", [](auto& gp) { gp.entry_noise_variances[4] = -1e-9; });
  matrix("matrix_poses[1].z.rotation_wxyz",
         [](auto& gp) { gp.matrix_poses[1].rotation_wxyz[0] += 0.5; });
  matrix("num_matrix_poses", [](auto& gp) {
    gp.matrix_poses.clear();
    gp.num_matrix_poses = 0;
  });
  // Each kind of edge has what its name says, and nothing else.
  expect_refused(example_body_schema(), "edges[2].num_residual_gp",
                 [](auto& m) { m.edges[2].base_kind = schema_edge_t::EDGE_SCREW; });
  expect_refused(example_body_schema(), "edges[3].num_matrix_gp",
                 [](auto& m) { m.edges[3].base_kind = schema_edge_t::EDGE_RIGID; });
  expect_refused(example_body_schema(), "edges[0].base_kind",
                 [](auto& m) { m.edges[0].base_kind = schema_edge_t::EDGE_MATRIX_GP; });
}

TEST(Check, KnowsMinusOneOnlyWhereItMeansNotMeasured) {
  expect_refused(example_model_health(), "events[0].event_margin",
                 [](auto& m) { m.events[0].event_margin = std::nan(""); });
  expect_refused(example_model_health(), "edge_health[0].edge_cusum",
                 [](auto& m) { m.edge_health[0].edge_cusum = -2; });
  expect_refused(example_model_health(), "findings[0].amount_sd[0].amount_sd",
                 [](auto& m) { m.findings[0].finding_size.amount_sd[0] = -0.5; });
  expect_refused(example_model_health(), "findings[0].num_amounts", [](auto& m) {
    change_size_t& size = m.findings[0].finding_size;
    size.num_amounts = 1;
    size.amount.resize(1);
    size.amount_sd.resize(1);
  });
  expect_refused(example_model_health(), "events[0].amount",
                 [](auto& m) { m.events[0].event_size.amount[0] = std::nan(""); });
  expect_refused(example_model_health(), "findings[0].finding_since",
                 [](auto& m) { m.findings[0].finding_since = -1; });
  expect_refused(example_model_health(), "probe_action",
                 [](auto& m) { m.probe_action[1] = std::nan(""); });
  expect_refused(example_model_health(), "worst_position_m",
                 [](auto& m) { m.worst_position_m = -0.5; });
  expect_refused(example_body_schema(), "noise_position_m",
                 [](auto& m) { m.noise_position_m = -1; });
  model_health_t health = example_model_health();
  health.worst_position_m = health.part_health[0].position_median_m = -1;
  health.edge_health[0].median_mahalanobis2 = -1;
  EXPECT_EQ(check(health), "");
}

TEST(Check, RefusesTextThatIsNotUtf8) {
  expect_refused(example_motion_status(), "reason", [](auto& m) { m.reason = "50 \xB0"; });
  expect_refused(example_motion_status(), "reason",
                 [](auto& m) { m.reason = std::string("a\0b", 3); });
  expect_refused(example_motion_status(), "reason", [](auto& m) { m.reason = "\xED\xA0\x80"; });
  expect_refused(example_action_command(), "source", [](auto& m) { m.source.clear(); });
}

TEST(Check, OnlyAMoveHasAnAction) {
  expect_refused(example_action_command(), "num_signals",
                 [](auto& m) { m.kind = action_command_t::KIND_STOP; });
  expect_refused(example_action_command(), "num_signals", [](auto& m) {
    m.action.clear();
    m.num_signals = 0;
  });
}

TEST(AsText, ReplacesOnlyWhatIsNotUtf8) {
  EXPECT_EQ(as_text("2 → 4, 50°"), "2 → 4, 50°");
  EXPECT_EQ(as_text("50 \xB0"
                    "C"),
            "50 ?C");
  EXPECT_EQ(as_text(std::string("a\0b", 3)), "a?b");
  EXPECT_EQ(as_text("cut \xE2\x86"), "cut ??");
}

}  // namespace
}  // namespace bodyschema::test
