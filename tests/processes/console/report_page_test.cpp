// The page of a report.

#include <gtest/gtest.h>

#include <cstdlib>
#include <regex>

#include "common/bus/check.h"
#include "common/bus/convert.h"
#include "tests/processes/console/report_bench.h"

namespace bodyschema::test {
namespace {

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
    Rng rng(4);
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
  Rng rng(8);
  BodySchema schema = three_parts();
  schema.X_CR_covariance = 1e-6 * Matrix6d::Identity();
  schema.edges[0] = random_edge(1, 2, {0}, rng);
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
  Rng rng(4);
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
  Rng rng(6);
  const auto robot = chapter_robot("a", rng);
  const ObservationOptions options{.regime = Regime::kTag, .with_covariances = true};
  for (const ActionPoseSample& sample : babble(robot, 40, options, rng))
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
  Rng rng(7);
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
}  // namespace bodyschema::test
