// logs/arm2_15.lcmlog, a run as a lab records it, through the programs that read logs. Record it
// again when a message type changes; logs/README.md has the command.

#include <gtest/gtest.h>
#include <sys/wait.h>

#include <algorithm>
#include <csignal>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <set>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "common/bus/convert.h"
#include "common/bus/event_log.h"
#include "common/bus/log_summary.h"
#include "common/config/rig.h"
#include "processes/structure_learner/learn.h"
#include "processes/structure_learner/structure_learner.h"
#include "tests/common/bus/bus_test_support.h"
#include "tests/support/rig_truth.h"
#include "tests/support/text_of.h"

namespace bodyschema {
namespace {

namespace fs = std::filesystem;
using test::text_of;

const fs::path kLog = BODYSCHEMA_LOGS "/arm2_15.lcmlog";
const fs::path kRig = BODYSCHEMA_CONFIG "/arm2";
const std::string kBin = BODYSCHEMA_BIN "/";

class RecordedLogTest : public testing::Test {
 protected:
  /// Runs a process of the group from the log to a log; returns its messages.
  fs::path replay(const std::string& process) {
    const fs::path out = folder_ / (process + ".lcmlog");
    test::Program program({kBin + process, "--config", kRig / (process + ".yaml"), "--in",
                           "file://" + kLog.string() + "?speed=0", "--out",
                           "file://" + out.string() + "?mode=w"});
    EXPECT_EQ(program.wait(), 0) << program.err();
    return out;
  }
  static std::string objection(const BodySchema& schema) {
    const test::RigTruth truth(kRig);
    return truth.objection(schema, truth.parts());
  }

  test::TemporaryFolder folder_;
};

TEST_F(RecordedLogTest, CutOffIsDamageInAReportUnlessItIsStillWritten) {
  const fs::path log = folder_ / "cut.lcmlog", page = folder_ / "page.html";
  fs::copy_file(kLog, log);
  fs::resize_file(log, fs::file_size(log) - 10);
  const auto report = [&](std::vector<std::string> flags) {
    std::vector<std::string> command = {kBin + "bodyschema", "report", log, "--out", page};
    command.insert(command.end(), flags.begin(), flags.end());
    test::Program program(command);
    EXPECT_EQ(program.wait(), 0) << program.err();
    return text_of(page);
  };
  EXPECT_NE(report({}).find("bytes after it are lost"), std::string::npos);
  const std::string growing = report({"--growing"});
  EXPECT_EQ(growing.find("bytes after it are lost"), std::string::npos);
  EXPECT_NE(growing.find("the run goes on"), std::string::npos);
}

TEST_F(RecordedLogTest, IsWholeAndOfThisVersion) {
  const LogSummary summary = summarize_log(kLog);
  EXPECT_TRUE(summary.is_sound()) << flaws_text(summary)
                                  << "record it again with the command in logs/README.md";
  EXPECT_FALSE(summary.channels.contains("SIM_STATE"));
}

TEST_F(RecordedLogTest, TheObserverMakesItsSamplesAgain) {
  std::set<std::int64_t> recorded, replayed;
  for (const sample_t& sample : read_log(kLog, kSample)) recorded.insert(sample.sample_index);
  const auto samples = read_log(replay("observer"), kSample);
  for (const sample_t& sample : samples) replayed.insert(sample.sample_index);
  EXPECT_EQ(replayed, recorded);
  EXPECT_EQ(recorded.size(), 15U);
}

TEST_F(RecordedLogTest, TheLearnerFindsTheBody) {
  const auto learned = read_log(replay("structure_learner"), kLearnedSchema);
  ASSERT_FALSE(learned.empty());
  EXPECT_EQ(learned.back().num_samples_seen, 12);
  EXPECT_EQ(objection(from_message(learned.back())), "");
}

// markers.yaml was edited after the recording, or in the middle of the run.
TEST_F(RecordedLogTest, SamplesOfAnotherCalibrationAreRefusedFromTheBusAndFromTheirFile) {
  const fs::path rig = folder_ / "arm2";
  fs::copy(kRig, rig, fs::copy_options::recursive);
  std::string markers = text_of(rig / "markers.yaml");
  markers.replace(markers.find("-0.056"), 6, "-0.057");
  std::ofstream(rig / "markers.yaml") << markers;
  for (const std::string process : {"structure_learner", "model_monitor"}) {
    const fs::path out = folder_ / (process + ".lcmlog");
    test::Program program({kBin + process, "--config", rig / (process + ".yaml"), "--samples", kLog,
                           "--in", "file://" + kLog.string() + "?speed=0", "--out",
                           "file://" + out.string() + "?mode=w"});
    EXPECT_EQ(program.wait(), 0) << program.err();
    EXPECT_NE(program.err().find("of another calibration of the tags or lens"), std::string::npos)
        << program.err();
    for (const body_schema_t& schema : read_log(out, kLearnedSchema))
      EXPECT_EQ(schema.num_samples_seen, 0);
    EXPECT_TRUE(read_log(out, kBodySchema).empty());
    const process_info_t info = read_log(out, kProcessInfo).back();
    const auto refused =
        std::find_if(info.counters.begin(), info.counters.end(),
                     [](const counter_t& c) { return c.counter_name == "refused SAMPLE"; });
    ASSERT_NE(refused, info.counters.end());
    EXPECT_GE(refused->count, 15);
    EXPECT_NE(info.activity.find("begin a new run"), std::string::npos) << info.activity;
  }
}

TEST_F(RecordedLogTest, TheMonitorAcceptsWhatItAcceptedThen) {
  const auto then = read_log(kLog, kBodySchema);
  const auto now = read_log(replay("model_monitor"), kBodySchema);
  ASSERT_FALSE(then.empty());
  ASSERT_FALSE(now.empty());
  EXPECT_EQ(now.back().schema_version, then.back().schema_version);
  EXPECT_EQ(objection(from_message(now.back())), "");
}

TEST_F(RecordedLogTest, TheConsoleLearnsFromItAndKnowsItsSchema) {
  test::Program learn({kBin + "bodyschema", "learn", kLog, "--out", folder_ / "schema.lcmlog"});
  ASSERT_EQ(learn.wait(), 0) << learn.err();
  const auto schemas = read_log(folder_ / "schema.lcmlog", kBodySchema);
  ASSERT_EQ(schemas.size(), 1U);
  EXPECT_EQ(objection(from_message(schemas[0])), "");
}

TEST_F(RecordedLogTest, ItsReportTellsTheRun) {
  test::Program report({kBin + "bodyschema", "report", kLog, "--out", folder_ / "report.html"});
  ASSERT_EQ(report.wait(), 0) << report.err();
  const std::string html = text_of(folder_ / "report.html");
  EXPECT_NE(html.find("The body is known: 5 parts hang together by 4 edges"), std::string::npos);
  EXPECT_NE(html.find("accepted by the monitor"), std::string::npos);
  EXPECT_NE(html.find("what the camera saw"), std::string::npos);
  EXPECT_NE(html.find("max_signals"), std::string::npos);  // a configuration
  EXPECT_EQ(html.find("cut off"), std::string::npos);
}

TEST_F(RecordedLogTest, CutOffAnywhereItIsReportedAndSaysSo) {
  const auto bytes = test::read_bytes(kLog);
  for (const double share : {0.001, 0.1, 0.35, 0.6, 0.999}) {
    const auto size = static_cast<std::ptrdiff_t>(share * static_cast<double>(bytes.size())) + 1;
    test::write_bytes(folder_ / "cut.lcmlog", {bytes.begin(), bytes.begin() + size});
    test::Program report({kBin + "bodyschema", "report", folder_ / "cut.lcmlog"});
    ASSERT_EQ(report.wait(), 0) << share << report.err();
    EXPECT_NE(text_of(folder_ / "cut.lcmlog.html").find("is cut off in the middle of an event"),
              std::string::npos)
        << share;
    test::Program check({kBin + "bodyschema", "log", "--check", folder_ / "cut.lcmlog"});
    EXPECT_EQ(check.wait(), 1);
    EXPECT_NE(check.err().find("is cut off"), std::string::npos) << check.err();
  }
  // A recording that is cut off is learned from, with a message.
  test::Program learn({kBin + "bodyschema", "learn", folder_ / "cut.lcmlog"});
  EXPECT_EQ(learn.wait(), 0);
  EXPECT_NE(learn.err().find("ends in the middle of an event"), std::string::npos) << learn.err();
}

TEST_F(RecordedLogTest, RecordedWithOtherMessagesItSaysSo) {
  {
    LogAppender log(folder_ / "old.lcmlog");
    for_each_event(kLog, [&](const LogEvent& event) {
      auto data = event.data;
      if (event.channel == "SAMPLE") data[0] ^= 1;  // of the fingerprint
      log.append_bytes(event.channel, data, event.event_utime);
    });
  }
  test::Program check({kBin + "bodyschema", "log", "--check", folder_ / "old.lcmlog"});
  EXPECT_EQ(check.wait(), 1);
  EXPECT_NE(check.out().find("SAMPLE: 15 of 15 messages cannot be read: fingerprint"),
            std::string::npos)
      << check.out();
  test::Program report({kBin + "bodyschema", "report", folder_ / "old.lcmlog"});
  EXPECT_EQ(report.wait(), 0) << report.err();
  EXPECT_NE(text_of(folder_ / "old.lcmlog.html").find("15 of 15 messages cannot be read"),
            std::string::npos);
}

TEST_F(RecordedLogTest, AThinCopyHoldsEveryMessageOnce) {
  {
    LogAppender log(folder_ / "twice.lcmlog");
    for (int pass = 0; pass < 2; ++pass) {
      for_each_event(kLog, [&](const LogEvent& event) {
        log.append_bytes(event.channel, event.data, event.event_utime);
      });
      log.append_bytes("SIM_STATE", std::vector<std::uint8_t>{1}, 1);
    }
  }
  test::Program thin(
      {kBin + "bodyschema", "log", folder_ / "twice.lcmlog", "--thin", folder_ / "thin.lcmlog"});
  ASSERT_EQ(thin.wait(), 0) << thin.err();
  const auto messages = [](const fs::path& file) {
    std::multiset<std::pair<std::string, std::vector<std::uint8_t>>> all;
    for_each_event(file, [&](const LogEvent& event) { all.emplace(event.channel, event.data); });
    return all;
  };
  EXPECT_TRUE(messages(folder_ / "thin.lcmlog") == messages(kLog));
}

TEST_F(RecordedLogTest, AReportFollowsARunUntilItIsEnded) {
  const auto bytes = test::read_bytes(kLog);
  const fs::path html = folder_ / "report.html";
  test::Program follow({kBin + "bodyschema", "report", "--follow", folder_.path()});
  const auto says = [&](const std::string& what) {
    return test::ask_until(
        [] { std::this_thread::yield(); },
        [&] { return fs::exists(html) && text_of(html).find(what) != std::string::npos; });
  };
  EXPECT_TRUE(says("Nothing was recorded yet"));
  EXPECT_TRUE(says("http-equiv=\"refresh\""));
  EXPECT_TRUE(says("the run goes on"));
  test::write_bytes(folder_ / "run.lcmlog.00",
                    {bytes.begin(), bytes.begin() + static_cast<std::ptrdiff_t>(bytes.size() / 2)});
  // Asked to end, it reads the rest and writes a last time.
  test::write_bytes(folder_ / "run.lcmlog.00", bytes);
  follow.send_signal(SIGTERM);
  EXPECT_EQ(follow.wait(), 0) << follow.err();
  EXPECT_TRUE(says("The body is known"));
  EXPECT_EQ(text_of(html).find("http-equiv"), std::string::npos);
  EXPECT_EQ(text_of(html).find("the run goes on"), std::string::npos);
}

TEST_F(RecordedLogTest, WhatIsNoRunIsAClearError) {
  test::Program report({kBin + "bodyschema", "report", folder_ / "none"});
  EXPECT_EQ(report.wait(), 1);
  EXPECT_NE(report.err().find("none: no such run folder or log"), std::string::npos);
  test::write_bytes(folder_ / "empty", {});
  test::Program empty({kBin + "bodyschema", "report", folder_ / "empty"});
  EXPECT_EQ(empty.wait(), 1);
  EXPECT_NE(empty.err().find("empty: is empty"), std::string::npos);
  test::write_bytes(folder_ / "text", {'t', ',', 'q', '1', '\n'});
  test::Program text({kBin + "bodyschema", "report", folder_ / "text"});
  EXPECT_EQ(text.wait(), 1);
  EXPECT_NE(text.err().find("text: is not an LCM log"), std::string::npos);
}

}  // namespace
}  // namespace bodyschema
