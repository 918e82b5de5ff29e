// The views of a report: slices of edges, errors of versions, trees, visibility, plots.

#include <gtest/gtest.h>

#include <cmath>
#include <filesystem>
#include <fstream>
#include <regex>

#include "common/bus/convert.h"
#include "common/geometry/angle.h"
#include "tests/processes/console/report_bench.h"

namespace bodyschema::test {
namespace {

// The bands are right if they hold what a normal distribution puts within two sigma: with noise
// that differs by axis, levers and rotations of up to 70° a wrong frame or Jacobian would show.
TEST(EdgeSliceTest, TheBandHoldsTheShareOfObservationsThatItShould) {
  Rng rng(1);
  const BodySchema schema = three_parts();
  const auto samples = samples_of(schema, 3000, uneven_noise(), rng);
  for (const Edge& edge : schema.edges) {
    for (const int signal : edge.signals()) {
      const EdgeSlice slice = edge_slice(schema, edge, signal, samples);
      EXPECT_EQ(slice.observations.size(), 3000U);
      EXPECT_NEAR(slice.coverage, 0.9545, 0.012) << edge.from << " " << signal;
    }
  }
}

TEST(EdgeSliceTest, ObservationsWithoutNoiseLieOnTheCurveOfTheirSlice) {
  Rng rng(2);
  const BodySchema schema = three_parts();
  const auto samples = samples_of(schema, 50, 1e-20 * Matrix6d::Identity(), rng);
  const Edge& edge = schema.edges[1];
  for (const int signal : {0, 1}) {
    const EdgeSlice slice = edge_slice(schema, edge, signal, samples);
    ASSERT_GE(slice.curve.size(), 2U);
    EXPECT_EQ(slice.curve.front().q, schema.signals[signal].lower);
    EXPECT_EQ(slice.curve.back().q, schema.signals[signal].upper);
    for (const auto& observation : slice.observations) {
      Eigen::VectorXd action(2);
      action << 0, 50;  // the middle
      const Pose X_middle = edge.predict(action);
      action[signal] = observation.q;
      const Pose X = edge.predict(action);
      EXPECT_LT((observation.value.head<3>() - 1e3 * X.translation()).norm(), 1e-4);
      EXPECT_NEAR(observation.value.tail<3>().norm(),
                  rotation_angle(X_middle.inverse() * X) / kDegree, 1e-4);
    }
    EXPECT_TRUE(slice.observations[4].is_held_out);
    EXPECT_FALSE(slice.observations[3].is_held_out);
  }
}

TEST(EdgeSliceTest, TheParametersBandIsThatOfTheirCovariance) {
  BodySchema schema = three_parts();
  Edge& edge = schema.edges[0];
  // Only the hinge's gain is unsure: nothing at θ = 0, then in proportion.
  edge.parameter_covariance = Eigen::MatrixXd::Zero(14, 14);
  edge.parameter_covariance(7, 7) = std::pow(0.01, 2);
  const EdgeSlice slice = edge_slice(schema, edge, 0, {});
  EXPECT_TRUE(std::isnan(slice.coverage));
  const auto turn_sigma = [](const EdgeSlice::Point& point) {
    return point.sigma_model.tail<3>().norm();
  };
  EXPECT_NEAR(turn_sigma(slice.curve.front()), 0.01 / kDegree, 1e-6);
  EXPECT_NEAR(turn_sigma(slice.curve[slice.curve.size() / 2]), 0, 1e-9);
  EXPECT_NEAR(turn_sigma(slice.curve.back()), 0.01 / kDegree, 1e-6);
}

TEST(VersionErrorsTest, EveryVersionIsJudgedOnTheSameSamples) {
  Rng rng(3);
  const BodySchema right = three_parts();
  const auto held_out = samples_of(right, 9, 1e-20 * Matrix6d::Identity(), rng);
  std::map<std::int64_t, BodySchema> versions;
  for (std::int64_t v = 1; v <= 100; ++v) {
    BodySchema schema = right;
    schema.last_sample_index = v - 1;
    schema.edges[0].right.translation().x() += v < 100 ? 0.010 : 0;
    if (v < 50) schema.edges.pop_back();
    versions[v] = schema;
  }
  const auto errors = version_errors(versions, held_out, {}, 3, 10);
  ASSERT_EQ(errors.size(), 10U);
  EXPECT_EQ(errors.front().num_samples, 10);
  EXPECT_EQ(errors.front().num_edges, 1);
  EXPECT_FALSE(errors.front().end_effector_m);  // not connected then
  EXPECT_NEAR(errors.front().worst_position_m, 0.010, 1e-9);
  EXPECT_EQ(errors.back().num_samples, 100);
  EXPECT_NEAR(errors.back().worst_position_m, 0, 1e-9);
  EXPECT_NEAR(errors.back().end_effector_m.value(), 0, 1e-9);
  // Samples of another rig are not its business.
  ActionPoseSample other = held_out[0];
  other.action.resize(5);
  EXPECT_TRUE(version_errors(versions, {other}, {}, 3).empty());
}

TEST(VersionErrorsTest, AVersionIsJudgedByTheBodyThatItWasFor) {
  Rng rng(8);
  const BodySchema first = three_parts();
  BodySchema second = first;
  second.edges[0].right.translation().x() += 0.2;
  auto held_out = samples_of(first, 60, 1e-20 * Matrix6d::Identity(), rng);
  const auto later = samples_of(second, 60, 1e-20 * Matrix6d::Identity(), rng);
  std::copy(later.begin() + 30, later.end(), held_out.begin() + 30);  // it broke at sample 30
  std::map<std::int64_t, BodySchema> versions;
  const auto add = [&](std::int64_t last_sample, BodySchema schema) {
    schema.last_sample_index = last_sample;
    versions[last_sample + 1] = std::move(schema);
  };
  add(10, first);
  add(20, first);
  add(34, second);
  const auto errors = version_errors(versions, held_out, {{30, "tool 1"}}, 3);
  ASSERT_EQ(errors.size(), 4U);
  EXPECT_EQ(errors[1].body, 0U);
  EXPECT_NEAR(errors[1].worst_position_m, 0, 1e-9);
  // The version that stood when it broke, on the broken body.
  EXPECT_EQ(errors[2].body, 1U);
  EXPECT_EQ(errors[2].num_samples, 30);
  EXPECT_NEAR(errors[2].worst_position_m, 0.2, 0.05);
  EXPECT_EQ(errors[3].num_samples, 35);
  EXPECT_NEAR(errors[3].worst_position_m, 0, 1e-9);
  const auto plot = version_plot(errors, {{30, "tool 1"}});
  ASSERT_TRUE(plot);
  EXPECT_NE(plot->script.find("from 30, graph 0 to 30, graph 1"), std::string::npos);
  EXPECT_NE(plot->script.find("'tool 1'"), std::string::npos);
  const auto svg = draw_plots({*plot});
  EXPECT_NE(svg[0].find("tool 1"), std::string::npos);
}

TEST(TreeTest, EveryPartStandsThereOnce) {
  BodySchema schema = three_parts();
  schema.parts = {1, 2, 3, 77, 88};
  schema.unconnected = {{77, Unconnected::kNeverSeen, ""}, {88, Unconnected::kNoValidModel, ""}};
  schema.signals[1].name = "<q&2>";
  const std::string svg = tree_svg(schema, 3);
  for (const char* part : {">1<", ">2<", ">3<", ">77<", ">88<"})
    EXPECT_EQ(count(svg, part), 1) << part;
  EXPECT_EQ(count(svg, "class=\"root\""), 1);
  EXPECT_EQ(count(svg, "class=\"effector\""), 1);
  EXPECT_EQ(count(svg, "&lt;q&amp;2&gt;"), 1);
  EXPECT_EQ(count(svg, "<q&2>"), 0);
  EXPECT_NE(svg.find("no valid model"), std::string::npos);
  EXPECT_NO_THROW(tree_svg(BodySchema(), std::nullopt));
}

TEST(TreeTest, TheSignalsOfALongEdgeFitBetweenItsParts) {
  BodySchema schema;
  schema.parts = {1, 2};
  schema.root = 1;
  Edge edge;
  edge.from = 1;
  edge.to = 2;
  for (int s = 0; s < 8; ++s) {
    schema.signals.push_back({"joint_" + std::to_string(s), -1, 1});
    edge.joints.push_back({.signal = s, .turn = 1});
  }
  schema.edges = {edge};
  const std::string svg = tree_svg(schema, 2);
  std::smatch places;
  ASSERT_TRUE(std::regex_search(svg, places, std::regex("d=\"M([0-9.]+),[0-9.]+ H([0-9.]+)\"")));
  // At least 5 px a letter.
  EXPECT_GT(std::stod(places[2]) - std::stod(places[1]),
            5.0 * std::string("joint_0, joint_1, joint_2, joint_3, joint_4, joint_5, joint_6, "
                              "joint_7")
                      .size());
  std::smatch size;
  ASSERT_TRUE(std::regex_search(svg, size, std::regex("viewBox=\"0 0 ([0-9]+) ")));
  EXPECT_GE(std::stod(size[1]), std::stod(places[2]) + 2 * 17);
}

TEST(VisibilityTest, ABinSaysInHowManyOfItsSamplesAPartWasSeen) {
  std::vector<ActionPoseSample> samples;
  for (int i = 0; i < 4; ++i) {
    ActionPoseSample& sample = samples.emplace_back();
    sample.action = Eigen::VectorXd::Constant(1, i < 3 ? -1 : 1);
    if (i == 0) {
      PartObservation seen;
      seen.part = 6;
      sample.parts.push_back(seen);
    }
  }
  const std::string svg = visibility_svg({{"q1", -1, 1}}, samples, {6});
  EXPECT_EQ(count(svg, "part 6: seen in 1 of 3 samples"), 1) << svg;
  EXPECT_EQ(count(svg, "fill-opacity=\"0.33\""), 1);
  EXPECT_EQ(count(svg, "class=\"seen\""), 1);
  EXPECT_EQ(count(svg, "class=\"unknown\""), kVisibilityBins - 2);
}

TEST(PlotTest, ANameIsOnlyAString) {
  EXPECT_EQ(gnuplot_string("q1"), "'q1'");
  const std::string hostile = "'; set print '/tmp/x' `touch y` \n$(z)\"";
  EXPECT_EQ(gnuplot_string(hostile), "'''; set print ''/tmp/x'' `touch y`  $(z)\"'");
  // gnuplot itself agrees: the name stands in the picture, as it is.
  const auto svg = draw_plots({{.script = "plot x title " + gnuplot_string("a`echo b`'c") + "\n"}});
  ASSERT_EQ(svg.size(), 1U);
  EXPECT_TRUE(svg[0].starts_with("<svg"));
  EXPECT_NE(svg[0].find("a`echo b`'c"), std::string::npos) << svg[0];
  EXPECT_EQ(svg[0].find("black"), std::string::npos);
}

TEST(PlotTest, AScriptThatGnuplotRefusesIsAnError) {
  EXPECT_THROW(draw_plots({{.script = "no such command\n"}}), PlotError);
}

TEST(PlotTest, APictureOfItsOwnIsAPngAndNeedsAFolder) {
  const std::filesystem::path folder = testing::TempDir();
  const Plot plot{.width_px = 320, .height_px = 200, .script = "plot x\n"};
  draw_png(plot, folder / "plot.png");
  std::ifstream stream(folder / "plot.png", std::ios::binary);
  std::string start(24, 0);
  stream.read(start.data(), 24);
  EXPECT_EQ(start.substr(1, 3), "PNG");
  EXPECT_EQ(start.substr(16, 8), std::string("\0\0\x01\x40\0\0\0\xc8", 8));  // 320 × 200
  EXPECT_THROW(draw_png(plot, folder / "no_such_folder" / "plot.png"), PlotError);
}

}  // namespace
}  // namespace bodyschema::test
