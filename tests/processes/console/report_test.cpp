#include <gtest/gtest.h>

#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <regex>

#include "common/bus/check.h"
#include "common/bus/convert.h"
#include "common/geometry/angle.h"
#include "common/plot/plot.h"
#include "processes/console/report/report_figures.h"
#include "processes/console/report/report_page.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

int count(const std::string& text, const std::string& what) {
  int n = 0;
  for (std::size_t at = 0; (at = text.find(what, at)) != std::string::npos; at += what.size()) ++n;
  return n;
}

/// Part 2 turns about part 1 with q1, part 3 about part 2 with q1 and then q2.
BodySchema three_parts() {
  test::Rng rng(5);
  BodySchema schema;
  schema.version = 3;
  schema.complete = true;
  schema.num_samples = 40;
  schema.last_sample_index = 49;
  schema.parts = {1, 2, 3};
  schema.root = 1;
  schema.signals = {{"q1", -1, 1}, {"q2", 0, 100}};
  Edge hinge;
  hinge.from = 1;
  hinge.to = 2;
  hinge.left = test::random_pose(rng, 0.1, 0.2);
  hinge.joints = {ScrewJoint{.signal = 0, .turn = 1.2}};
  hinge.right = test::random_pose(rng, 0.1, 0.2);
  Edge two = hinge;
  two.from = 2;
  two.to = 3;
  two.joints = {ScrewJoint{.signal = 0, .turn = 0.4},
                ScrewJoint{.signal = 1, .slide = 0.001, .turn = 0.01}};
  schema.edges = {hinge, two};
  return schema;
}

/// Samples of that schema; `noise` is the covariance of each part's pose.
std::vector<ActionPoseSample> samples_of(const BodySchema& schema, int num, const Matrix6d& noise,
                                         test::Rng& rng) {
  const Matrix6d root = noise.llt().matrixL();
  std::vector<ActionPoseSample> samples;
  for (int i = 0; i < num; ++i) {
    ActionPoseSample& sample = samples.emplace_back();
    sample.sample_index = i;
    sample.purpose = i % 5 == 4 ? Purpose::kTest : Purpose::kTrain;
    sample.action.resize(2);
    sample.action << test::uniform(rng, -1, 1), test::uniform(rng, 0, 100);
    const Pose X_CR = test::random_pose(rng, 1, 2);
    for (const auto& [part, X_RB] : schema.predict_all(sample.action)) {
      PartObservation observation;
      observation.part = part;
      observation.X_CB = X_CR * X_RB * exp(root * test::gaussian6(rng));
      observation.covariance = noise;
      sample.parts.push_back(observation);
    }
  }
  return samples;
}

Matrix6d uneven_noise() {
  Vector6d sigma;
  sigma << 0.001, 0.002, 0.008, 0.03, 0.004, 0.01;
  return sigma.cwiseAbs2().asDiagonal();
}

// The bands are right if they hold what a normal distribution puts within two sigma: with noise
// that differs by axis, levers and rotations of up to 70° a wrong frame or Jacobian would show.
TEST(EdgeSliceTest, TheBandHoldsTheShareOfObservationsThatItShould) {
  test::Rng rng(1);
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
  test::Rng rng(2);
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
  test::Rng rng(3);
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
  test::Rng rng(8);
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

/// A record of `samples` as the bus carries them, and of a schema.
class ReportPageTest : public testing::Test {
 protected:
  template <class Message>
  void hear(const Channel<Message>& channel, const Message& message) {
    LogEvent event;
    event.channel = channel.name;
    event.data = encode(channel, message);
    event.event_utime = 1'700'000'000'000'000 + 1000 * num_++;
    record_.on_event(event, "run.lcmlog.00", 0);
    report_.logs["run.lcmlog.00"].add(event);
  }
  void hear_run() {
    test::Rng rng(4);
    const BodySchema schema = three_parts();
    for (const ActionPoseSample& sample : samples_of(schema, 50, uneven_noise(), rng))
      hear(kSample, to_message(sample));
    for (std::int64_t version : {1, 2, 3}) {
      BodySchema each = schema;
      each.version = version;
      each.last_sample_index = 10 * version;
      hear(kBodySchema, to_message(each));
    }
    process_info_t info{};
    info.process_name = "<script>alert(1)</script>";
    info.pid = 5;
    info.utime = info.start_utime = 1'700'000'000'000'000;
    info.program_version = program_version();
    info.activity = "waits & sees";
    info.configuration = "key: <value>  # \"quoted\"";
    hear(kProcessInfo, info);
    for (int i = 0; i < 3; ++i) {
      info.utime += 1'000'000;
      info.cpu_us += 100'000;
      hear(kProcessInfo, info);
    }
  }
  std::string page() {
    report_.title = "run & <title>";
    report_.record = &record_;
    return report_page(report_, &problem_);
  }

  RunRecord record_;
  Report report_;
  std::string problem_;

 private:
  int num_ = 0;
};

TEST_F(ReportPageTest, ARunIsToldInOneFileThatNeedsNoOther) {
  hear_run();
  report_.end_effector = 3;
  report_.picture = "not really a picture";
  const std::string html = page();
  EXPECT_EQ(problem_, "");
  for (const char* heading : {"The body", "Held-out error", "Local models", "Visibility",
                              "Processes", "Messages recorded", "Configuration"}) {
    EXPECT_EQ(count(html, std::string("<h2>") + heading + "</h2>"), 1) << heading;
  }
  // Held-out error, three slices of two edges, processor time, memory; tree, visibility, symbols.
  EXPECT_EQ(count(html, "<svg class=\"plot\""), 1 + 3 + 2);
  EXPECT_EQ(count(html, "<!--plot"), 0);
  for (const char* element : {"svg", "g", "section", "table", "figure", "details", "pre"}) {
    const std::string name = element;
    EXPECT_EQ(count(html, "<" + name + " ") + count(html, "<" + name + ">"),
              count(html, "</" + name + ">"))
        << name;
  }
  // Nothing is fetched: no link, script or image but what is in the page.
  for (const char* unwanted : {"<script", "<link", "@import", "url(", "NaN"})
    EXPECT_EQ(count(html, unwanted), 0) << unwanted;
  EXPECT_EQ(count(html, "src="), 1);
  EXPECT_EQ(count(html, "src=\"data:image/jpeg;base64,bm90IHJlYWxseSBhIHBpY3R1cmU=\""), 1);
  const std::regex outside("(href|src)=['\"](?!#|data:)");
  EXPECT_FALSE(std::regex_search(html, outside));
  // Errors are against what was observed: no simulator was heard.
  EXPECT_GT(count(html, "what the camera saw"), 0);
  EXPECT_EQ(count(html, "noise-free truth"), 0);
}

TEST_F(ReportPageTest, TheRootAndEveryJointHaveStandardDeviations) {
  test::Rng rng(8);
  BodySchema schema = three_parts();
  schema.X_CR_covariance = 1e-6 * Matrix6d::Identity();
  schema.edges[0] = test::random_edge(1, 2, {0}, rng);
  hear(kBodySchema, to_message(schema));
  EXPECT_EQ(count(page(), "± 1 1 1 mm, 0.057 0.057 0.057°"), 1);
  EXPECT_EQ(count(page(), "<tr><td>1 → 2</td><td>q1</td><td class=\"n\">"), 1);
}

TEST_F(ReportPageTest, WhatIsWrongStandsFirst) {
  hear_run();
  EXPECT_EQ(count(page(), "What is wrong now"), 0);
  EXPECT_EQ(count(page(), "The body is known: 3 parts"), 1);
  model_health_t health{};
  health.judged_sample = 49;
  health.probe_sample = health.awaited_refinement = health.wanted_sample = -1;
  edge_health_t edge{};
  edge.health_from = 1;
  edge.health_to = 2;
  edge.edge_state = schema_edge_t::EDGE_INVALID;
  set_array(health.num_edges, health.edge_health, {edge});
  hear(kModelHealth, health);
  EXPECT_EQ(count(page(), "The body is known"), 0);
  EXPECT_EQ(count(page(), "in doubt: 1→2. 3 parts hang together"), 1);
  finding_t finding{};
  finding.finding_text = "q1 (1→2) stuck at <b>";
  set_array(health.num_findings, health.findings, {finding});
  health_event_t event{};
  event.utime = 5'000'000;
  event.event_sample = 30;
  event.event_text = "q1 (1→2) stuck at 0.20 ± 0.01 since sample 29: adopted";
  set_array(health.num_events, health.events, {event});
  hear(kModelHealth, health);
  const std::string html = page();
  EXPECT_LT(html.find("What is wrong now"), html.find("The body is not as the schema says in 1 "
                                                      "place. 3 parts hang together"));
  EXPECT_EQ(count(html, "<li>q1 (1→2) stuck at &lt;b&gt;</li>"), 1);
  EXPECT_EQ(count(html, "The body is known"), 0);
  EXPECT_EQ(count(html, "q1 (1→2) stuck at 0.20 ± 0.01 since sample 29: adopted"), 1);
  EXPECT_EQ(count(html, "As of sample 49, the last. No sample comes any more"), 1);
  // While the run goes on somebody watches.
  report_.goes_on = true;
  EXPECT_EQ(count(page(), "No sample comes any more"), 0);
}

TEST_F(ReportPageTest, TheBodyChangesWhereTheSimulationBrokeIt) {
  test::Rng rng(4);
  auto samples = samples_of(three_parts(), 50, uneven_noise(), rng);
  for (ActionPoseSample& sample : samples) {
    sample.utime = 1'000'000 * (sample.sample_index + 1);
    hear(kSample, to_message(sample));
  }
  const auto broken = [&](std::int64_t utime, std::vector<std::string> faults) {
    sim_state_t state{};
    state.utime = utime;
    state.X_WC = to_message(Pose::Identity());
    set_array(state.num_faults, state.faults, std::move(faults));
    hear(kSimState, state);
  };
  broken(0, {});
  broken(20'500'000, {"stuck q1"});
  // One that goes on is one fault.
  for (int n = 0; n < 5; ++n)
    broken(30'500'000 + n * 1'000'000,
           {"stuck q1", "drift arm 0.5 deg per action, " + std::to_string(n) + " deg so far"});
  broken(40'500'000, {});
  const auto marks = body_marks(record_);
  ASSERT_EQ(marks.size(), 3U);
  EXPECT_EQ(marks[0].sample, 20);
  EXPECT_EQ(marks[0].label, "stuck q1");
  EXPECT_EQ(marks[1].sample, 30);
  EXPECT_EQ(marks[1].label, "drift arm 0.5 deg per action");
  EXPECT_EQ(marks[2].sample, 40);
  EXPECT_EQ(marks[2].label, "repair");
}

TEST_F(ReportPageTest, WithoutASimulationTheBodyChangesWhereTheMonitorFoundIt) {
  BodySchema schema = three_parts();
  schema.changes = {{12, 10}, {31, 30}, {33, 28}};  // the last is the second, told better
  hear(kBodySchema, to_message(schema));
  const auto marks = body_marks(record_);
  ASSERT_EQ(marks.size(), 2U);
  EXPECT_EQ(marks[0].sample, 10);
  EXPECT_EQ(marks[1].sample, 28);
}

TEST_F(ReportPageTest, WhatMessagesSayIsTextAndNeverMarkup) {
  hear_run();
  const std::string html = page();
  EXPECT_EQ(count(html, "<title>run &amp; &lt;title&gt;</title>"), 1);
  EXPECT_GT(count(html, "&lt;script&gt;alert(1)&lt;/script&gt;"), 0);
  EXPECT_EQ(count(html, "key: &lt;value&gt;  # &quot;quoted&quot;"), 1);
}

TEST_F(ReportPageTest, ARunOfWhichNothingIsThereYetSaysSo) {
  report_.reload_s = 10;
  EXPECT_NE(page().find("Nothing was recorded yet"), std::string::npos);
  EXPECT_NE(page().find("http-equiv=\"refresh\" content=\"10\""), std::string::npos);
  report_.reload_s.reset();
  EXPECT_EQ(page().find("http-equiv"), std::string::npos);
  EXPECT_EQ(problem_, "");
}

TEST_F(ReportPageTest, ADamagedNoiseHidesNoSchema) {
  hear_run();
  report_.measurement = []() -> MeasurementModel { throw std::runtime_error("noise.yaml"); };
  EXPECT_NE(page().find("accepted by the monitor"), std::string::npos);
}

TEST_F(ReportPageTest, SamplesAloneAreLearnedFrom) {
  test::Rng rng(6);
  const auto robot = test::chapter_robot("a", rng);
  const test::ObservationOptions options{.regime = test::Regime::kTag, .with_covariances = true};
  for (const ActionPoseSample& sample : test::babble(robot, 40, options, rng))
    hear(kSample, to_message(sample));
  report_.measurement = [] {
    return MeasurementModel{.systematic = {.position_m = 0.001, .rotation_rad = 0.005}};
  };
  const std::string html = page();
  EXPECT_NE(html.find("learned for this report"), std::string::npos);
  EXPECT_NE(html.find("The body is known: 5 parts hang together by 4 edges"), std::string::npos);
  EXPECT_NE(html.find("No held-out sample yet"), std::string::npos);
}

TEST_F(ReportPageTest, FewOrHostileSamplesMakeAPageToo) {
  test::Rng rng(7);
  auto samples = samples_of(three_parts(), 3, uneven_noise(), rng);
  for (const ActionPoseSample& sample : samples) hear(kSample, to_message(sample));
  EXPECT_EQ(problem_, "");
  EXPECT_NE(page().find("The body is not known yet"), std::string::npos);
  // Another rig's sample and schema on the same bus, a signal without a range.
  ActionPoseSample other = samples[0];
  other.sample_index = 99;
  other.action = Eigen::VectorXd::Zero(9);
  hear(kSample, to_message(other));
  BodySchema flat = three_parts();
  flat.signals[0].upper = flat.signals[0].lower;
  body_schema_t message = to_message(flat);
  if (check(message).empty()) hear(kBodySchema, message);
  page();
  EXPECT_EQ(problem_, "");
}

TEST_F(ReportPageTest, WithoutGnuplotThePageSaysWhatToInstall) {
  hear_run();
  const std::string path = std::getenv("PATH");
  ::setenv("PATH", "/nonexistent", 1);
  const std::string html = page();
  ::setenv("PATH", path.c_str(), 1);
  EXPECT_NE(problem_.find("apt-get install gnuplot-nox"), std::string::npos);
  EXPECT_GT(count(html, "apt-get install gnuplot-nox"), 0);
  EXPECT_EQ(count(html, "<h2>The body</h2>"), 1);
}

TEST_F(ReportPageTest, ALogThatIsCutOffIsToldAtTheTop) {
  hear_run();
  report_.logs["run.lcmlog.00"].damage = "is cut off in the middle of an event at byte 123";
  EXPECT_NE(page().find("run.lcmlog.00: is cut off in the middle of an event at byte 123"),
            std::string::npos);
  // While it is written it always ends somewhere.
  report_.goes_on = true;
  EXPECT_EQ(page().find("cut off"), std::string::npos);
}

}  // namespace
}  // namespace bodyschema
