#include "processes/refiner/refiner_process.h"

#include <gtest/gtest.h>

#include <filesystem>
#include <fstream>
#include <regex>
#include <set>
#include <string>
#include <vector>

#include "common/bus/channels.h"
#include "common/bus/check.h"
#include "common/bus/convert.h"
#include "common/bus/event_log.h"
#include "common/config/calibration_id.h"
#include "common/config/yaml.h"
#include "tests/common/bus/bus_test_support.h"
#include "tests/support/text_of.h"

namespace bodyschema {
namespace {

namespace fs = std::filesystem;
using test::text_of;

const fs::path kArm2 = BODYSCHEMA_LOGS "/arm2_15.lcmlog";

/// A recording of arm2 in which every second sample, the first one too, is TEST, and a rig that
/// refines every ten and claims that the tags of part 5 are 1 % larger than they are.
class RefinerTest : public testing::Test {
 protected:
  RefinerTest() {
    fs::copy(BODYSCHEMA_CONFIG "/arm2", rig_);
    set("refiner.yaml", "refine_every: 50", "refine_every: 10");
    set("markers.yaml", "size_m: 0.08, part: 5", "size_m: 0.0808, part: 5");
    std::set<std::int64_t> known;
    for (const sample_t& sample : read_log(kArm2, kSample)) {
      if (!known.insert(sample.sample_index).second) continue;
      samples_.push_back(sample);
      samples_.back().calibration_id = calibration_id(rig_);
      samples_.back().purpose = sample.sample_index % 2 == 0 ? action_command_t::PURPOSE_TEST
                                                             : action_command_t::PURPOSE_TRAIN;
    }
    for (const body_schema_t& proposal : read_log(kArm2, kLearnedSchema)) {
      proposals_.push_back(proposal);
      proposals_.back().calibration_id = calibration_id(rig_);
    }
    LogAppender log(recorded_);
    for (const sample_t& sample : samples_) {
      log.append(kSample, sample);
      for (const body_schema_t& proposal : proposals_)
        if (proposal.last_sample_index == sample.sample_index) log.append(kLearnedSchema, proposal);
    }
  }

  void set(const std::string& file, const std::string& from, const std::string& to) const {
    const std::string text = text_of(rig_ / file);
    ASSERT_NE(text.find(from), std::string::npos);
    std::ofstream(rig_ / file) << std::regex_replace(text, std::regex(from), to);
  }
  Refiner refiner() const {
    return Refiner(RefinerSettings::load(rig_, RefinerConfig::load(rig_ / "refiner.yaml")));
  }
  const body_schema_t& proposal_after(std::int64_t sample) const {
    return *std::find_if(proposals_.begin(), proposals_.end(),
                         [&](const auto& p) { return p.last_sample_index == sample; });
  }
  /// What the process writes from the log `in`.
  fs::path replay(const fs::path& in, const std::vector<std::string>& flags = {}) {
    const fs::path out = folder_ / ("out" + std::to_string(++num_runs_));
    EXPECT_EQ(test::run_on_log<RefinerProcess>("refiner", rig_, in, out, flags), 0);
    return out;
  }

  test::TemporaryFolder folder_;
  const fs::path rig_ = folder_ / "rig", recorded_ = folder_ / "recorded.lcmlog";
  std::vector<sample_t> samples_;
  std::vector<body_schema_t> proposals_;
  int num_runs_ = 0;
};

TEST_F(RefinerTest, RefinesTheProposalOfTheFirstTestSampleAfterEveryTen) {
  Refiner refiner = this->refiner();
  std::vector<std::int64_t> refined;
  for (const sample_t& sample : samples_) {
    refiner.on_sample(sample);
    for (const body_schema_t& proposal : proposals_)
      if (proposal.last_sample_index == sample.sample_index) refiner.on_learned_schema(proposal);
    while (refiner.has_job()) refined.push_back(refiner.take_job()().learned.last_sample_index);
  }
  EXPECT_EQ(refined, std::vector<std::int64_t>{10});
}

TEST_F(RefinerTest, TheOrderOfSamplesAndProposalsDoesNotMatter) {
  const auto refined = [&](bool proposals_first) {
    Refiner refiner = this->refiner();
    if (proposals_first)
      for (const body_schema_t& proposal : proposals_) refiner.on_learned_schema(proposal);
    for (const sample_t& sample : samples_) refiner.on_sample(sample);
    for (const body_schema_t& proposal : proposals_) refiner.on_learned_schema(proposal);
    EXPECT_TRUE(refiner.has_job());
    const RefinedProposal result = refiner.take_job()();
    EXPECT_FALSE(refiner.has_job());
    EXPECT_TRUE(result.refinement) << result.problem;
    return encode(kRefinedSchema, result.answer());
  };
  EXPECT_EQ(refined(false), refined(true));
}

TEST_F(RefinerTest, AnIncompleteProposalIsNotRefinedNorOneThatWas) {
  Refiner refiner = this->refiner();
  for (const sample_t& sample : samples_) refiner.on_sample(sample);
  body_schema_t incomplete = proposal_after(10);
  incomplete.is_complete = 0;
  refiner.on_learned_schema(incomplete);
  EXPECT_FALSE(refiner.has_job());
  refiner.skip(10);
  refiner.on_learned_schema(proposal_after(10));
  EXPECT_FALSE(refiner.has_job());
}

TEST_F(RefinerTest, ARefinementThatFailsSaysWhy) {
  Refiner refiner = this->refiner();
  for (sample_t sample : samples_) {
    sample.calibration_id += 1;
    refiner.on_sample(sample);
  }
  refiner.on_learned_schema(proposal_after(10));
  const RefinedProposal result = refiner.take_job()();
  EXPECT_FALSE(result.refinement);
  EXPECT_NE(result.problem.find("another calibration"), std::string::npos) << result.problem;
  EXPECT_FALSE(result.is_better());
}

TEST_F(RefinerTest, WhatChanceMayHaveDoneIsNoBetter) {
  Refiner refiner = this->refiner();
  for (const sample_t& sample : samples_) refiner.on_sample(sample);
  refiner.on_learned_schema(proposal_after(10));
  RefinedProposal result = refiner.take_job()();
  EXPECT_TRUE(result.is_better());
  // Better in five samples of six.
  std::vector<double>& after = result.refinement->after.corner_costs;
  ASSERT_EQ(after.size(), 6U);
  after[3] = result.refinement->before.corner_costs[3];
  EXPECT_FALSE(result.is_better());
  // The answer is the proposal as it was; what is wanted is no worse for that.
  body_schema_t answer = result.answer();
  EXPECT_EQ(answer.num_wanted, 10);
  set_array(answer.num_wanted, answer.wanted_actions, {});
  EXPECT_EQ(encode(kRefinedSchema, answer), encode(kRefinedSchema, proposal_after(10)));
}

TEST_F(RefinerTest, ItsAnswerHasTheActionsThatTheRefinementWants) {
  Refiner refiner = this->refiner();
  for (const sample_t& sample : samples_) refiner.on_sample(sample);
  refiner.on_learned_schema(proposal_after(10));
  const RefinedProposal result = refiner.take_job()();
  const body_schema_t answer = result.answer();
  EXPECT_EQ(check(answer), "");
  EXPECT_NE(answer.calibration_id, proposal_after(10).calibration_id);
  ASSERT_EQ(answer.num_wanted, 10);
  for (int n = 0; n < 10; ++n) {
    const WantedAction& wanted = result.refinement->wanted_actions[n];
    EXPECT_EQ(answer.wanted_actions[n].wanted_action,
              std::vector<double>(wanted.action.begin(), wanted.action.end()));
    EXPECT_EQ(answer.wanted_actions[n].fall, wanted.fall);
    EXPECT_EQ(answer.wanted_actions[n].reducible_fall, wanted.reducible_fall);
  }
}

TEST_F(RefinerTest, WhatCouldNotBeRefinedIsAnsweredToo) {
  // Without samples to learn from.
  LogAppender log(folder_ / "tests alone.lcmlog");
  for (sample_t& sample : samples_) {
    sample.purpose = action_command_t::PURPOSE_TEST;
    log.append(kSample, sample);
  }
  log.append(kLearnedSchema, proposal_after(9));
  const auto answers =
      read_log(replay(folder_ / "tests alone.lcmlog", {"--refined", folder_ / "refined.lcmlog"}),
               kRefinedSchema);
  ASSERT_EQ(answers.size(), 1U);
  EXPECT_EQ(encode(kRefinedSchema, answers[0]), encode(kRefinedSchema, proposal_after(9)));
  EXPECT_FALSE(fs::exists(folder_ / "refined.lcmlog"));
}

TEST_F(RefinerTest, AReplayWritesTheSameBytesAndFilesThatGoTogether) {
  const std::vector<std::string> files = {"--refined", folder_ / "refined.lcmlog", "--proposed",
                                          folder_ / "proposed"};
  const auto schemas = read_log(replay(recorded_, files), kRefinedSchema);
  ASSERT_EQ(schemas.size(), 1U);
  EXPECT_EQ(schemas[0].last_sample_index, 10);
  EXPECT_NE(schemas[0].calibration_id, samples_[0].calibration_id);
  const auto kept = read_log(folder_ / "refined.lcmlog", kBodySchema);
  ASSERT_EQ(kept.size(), 1U);
  EXPECT_EQ(encode(kRefinedSchema, kept[0]), encode(kRefinedSchema, schemas[0]));
  // With the proposed files the rig is the one that the schema goes with.
  for (const std::string name : {"markers.yaml", "camera_info.yaml"})
    fs::copy(folder_ / "proposed" / name, rig_ / name, fs::copy_options::overwrite_existing);
  EXPECT_EQ(calibration_id(rig_), schemas[0].calibration_id);
}

TEST_F(RefinerTest, WhatAnEarlierProcessRefinedIsNotRefinedAgain) {
  const std::vector<std::string> file = {"--refined", folder_ / "refined.lcmlog"};
  EXPECT_EQ(read_log(replay(recorded_, file), kRefinedSchema).size(), 1U);
  const std::string kept = text_of(folder_ / "refined.lcmlog");
  EXPECT_TRUE(read_log(replay(recorded_, file), kRefinedSchema).empty());
  EXPECT_EQ(text_of(folder_ / "refined.lcmlog"), kept);
  // A file that is none is no reason to end.
  std::ofstream(folder_ / "refined.lcmlog") << "no log";
  EXPECT_EQ(read_log(replay(recorded_, file), kRefinedSchema).size(), 1U);
}

TEST_F(RefinerTest, WhatRestsOnSamplesThatAreNotThereIsSetAside) {
  const std::vector<std::string> file = {"--refined", folder_ / "refined.lcmlog"};
  EXPECT_EQ(read_log(replay(recorded_, file), kRefinedSchema).size(), 1U);
  LogAppender(folder_ / "samples.lcmlog").append(kSample, samples_.front());
  const std::vector<std::string> anew = {"--refined", folder_ / "refined.lcmlog", "--samples",
                                         folder_ / "samples.lcmlog"};
  EXPECT_EQ(read_log(replay(recorded_, anew), kRefinedSchema).size(), 1U);
  EXPECT_TRUE(fs::exists(folder_ / "refined.lcmlog.bad-1"));
  // So is one of another rig.
  body_schema_t other = proposal_after(10);
  other.signals.front().signal_name = "other";
  write_one_event_log(folder_ / "refined.lcmlog", kBodySchema, other);
  EXPECT_EQ(read_log(replay(recorded_, file), kRefinedSchema).size(), 1U);
  EXPECT_TRUE(fs::exists(folder_ / "refined.lcmlog.bad-2"));
}

TEST_F(RefinerTest, TwoReplaysAreTheSame) {
  const auto refined = [&] {
    std::vector<std::vector<std::uint8_t>> bytes;
    for (const body_schema_t& schema : read_log(replay(recorded_), kRefinedSchema))
      bytes.push_back(encode(kRefinedSchema, schema));
    return bytes;
  };
  EXPECT_EQ(refined(), refined());
}

TEST_F(RefinerTest, SamplesOfAnotherCalibrationAreRefused) {
  set("markers.yaml", "size_m: 0.08, part: 1", "size_m: 0.09, part: 1");
  const fs::path out = replay(recorded_);
  EXPECT_TRUE(read_log(out, kRefinedSchema).empty());
}

TEST_F(RefinerTest, WhatCannotBeSavedIsPublishedAndCounted) {
  const fs::path out = replay(recorded_, {"--refined", folder_ / "no" / "such" / "refined.lcmlog"});
  EXPECT_EQ(read_log(out, kRefinedSchema).size(), 1U);
  std::int64_t not_saved = 0;
  const process_info_t info = read_log(out, kProcessInfo).back();
  for (const counter_t& counter : info.counters)
    if (counter.counter_name == "refined schema not saved") not_saved = counter.count;
  EXPECT_EQ(not_saved, 1);
}

TEST(RefinerConfig, RefusesAFileThatLeavesNothingToRefine) {
  test::TemporaryFolder folder;
  fs::copy(BODYSCHEMA_CONFIG "/arm2", folder / "rig");
  const std::string text = text_of(folder / "rig" / "refiner.yaml");
  std::ofstream(folder / "rig" / "refiner.yaml")
      << std::regex_replace(text, std::regex("(placements|intrinsics): true"), "$1: false");
  EXPECT_THROW(RefinerConfig::load(folder / "rig" / "refiner.yaml"), ConfigError);
}

}  // namespace
}  // namespace bodyschema
