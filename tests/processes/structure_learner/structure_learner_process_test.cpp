#include <gtest/gtest.h>
#include <unistd.h>

#include <filesystem>
#include <fstream>
#include <future>
#include <map>
#include <set>

#include "common/bus/check.h"
#include "common/bus/codec.h"
#include "common/bus/convert.h"
#include "common/config/yaml.h"
#include "processes/structure_learner/structure_learner.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::Rng;

using Bytes = std::vector<std::uint8_t>;
Bytes bytes_of(const body_schema_t& message) { return encode(kLearnedSchema, message); }

/// The samples of a babbling 2-DOF robot, as the observer sends them: every fifth is TEST.
class StructureLearnerTest : public testing::Test {
 protected:
  StructureLearnerTest() {
    Rng rng(21);
    robot_ = test::chapter_robot("a", rng);
    const test::ObservationOptions options{.regime = test::Regime::kTag, .with_covariances = true};
    auto samples = test::babble(robot_, 30, options, rng);
    for (ActionPoseSample& sample : samples) {
      sample.utime = 1'000'000 * (sample.sample_index + 1);
      if (sample.sample_index % 5 == 4) sample.purpose = Purpose::kTest;
      samples_.push_back(to_message(sample));
    }
    config_.signals = robot_.signals;
    config_.options.root = 1;
  }

  /// All that is proposed by the end of `samples`, where the learner found time for a job after
  /// those in `jobs_after` only.
  std::vector<body_schema_t> proposals(const std::vector<sample_t>& samples,
                                       const std::set<std::size_t>& jobs_after = {}) const {
    StructureLearner learner(config_);
    std::vector<body_schema_t> result;
    for (std::size_t i = 0; i < samples.size(); ++i) {
      learner.on_sample(samples[i]);
      if (jobs_after.contains(i) && learner.has_job()) result.push_back(learner.take_job()());
      if (jobs_after.contains(i) && i % 2 == 0) learner.take_preparation()();
    }
    while (learner.has_job()) result.push_back(learner.take_job()());
    return result;
  }
  /// The proposal after all of `samples`.
  body_schema_t learn_all(const std::vector<sample_t>& samples) const {
    return proposals(samples).back();
  }

  test::SyntheticRobot robot_;
  std::vector<sample_t> samples_;
  StructureLearnerConfig config_;
};

TEST_F(StructureLearnerTest, LearnsTheStructureOfTheRobotFromItsSamples) {
  const body_schema_t proposal = learn_all(samples_);
  EXPECT_EQ(check(proposal), "");
  EXPECT_TRUE(test::is_right(from_message(proposal), robot_));
  EXPECT_EQ(proposal.num_samples_seen, 24);
  EXPECT_EQ(proposal.last_sample_index, 29);
  EXPECT_EQ(proposal.utime, samples_.back().utime);
  EXPECT_EQ(proposal.schema_version, 0);
  EXPECT_EQ(proposal.base_version, 0);
}

TEST_F(StructureLearnerTest, ATestSampleIsNeverLearnedFrom) {
  const Bytes expected = bytes_of(learn_all(samples_));
  Rng rng(22);
  std::vector<sample_t> garbage = samples_;
  for (sample_t& sample : garbage) {
    if (sample.purpose != action_command_t::PURPOSE_TEST) continue;
    for (double& value : sample.action) value = test::uniform(rng, -1e3, 1e3);
    for (auto& part : sample.parts) {
      part.part_id += 100;  // parts that do not exist
      part.X_CB = to_message(test::random_pose(rng, 0, 100));
      for (float& value : part.covariance) value *= 1e4F;
    }
  }
  EXPECT_EQ(bytes_of(learn_all(garbage)), expected);
}

TEST_F(StructureLearnerTest, ControlIsNotLearnedFromButAProbeIs) {
  const auto with_purpose = [&](std::int8_t purpose) {
    std::vector<sample_t> samples = samples_;
    for (std::size_t i = 0; i < samples.size(); i += 2) samples[i].purpose = purpose;
    return learn_all(samples).num_samples_seen;
  };
  EXPECT_EQ(with_purpose(action_command_t::PURPOSE_PROBE), 27);
  EXPECT_EQ(with_purpose(action_command_t::PURPOSE_CONTROL), 12);
  EXPECT_EQ(with_purpose(action_command_t::PURPOSE_TEST), 12);
}

// However seldom the learner finds time: what it proposes after a sample is the same, and after a
// TEST sample, where the monitor judges, it does propose.
TEST_F(StructureLearnerTest, HowFastItIsDoesNotChangeAnyProposal) {
  std::map<std::int64_t, Bytes> expected;
  for (std::size_t i = 0; i < samples_.size(); ++i)
    expected[i] = bytes_of(learn_all({samples_.begin(), samples_.begin() + i + 1}));
  Rng rng(23);
  for (const double speed : {0.0, 0.2, 0.5, 1.0}) {
    std::set<std::size_t> jobs_after;
    for (std::size_t i = 0; i < samples_.size(); ++i)
      if (test::uniform(rng, 0, 1) < speed) jobs_after.insert(i);
    std::set<std::int64_t> proposed;
    std::int64_t last = -1;
    for (const body_schema_t& proposal : proposals(samples_, jobs_after)) {
      EXPECT_EQ(bytes_of(proposal), expected.at(proposal.last_sample_index));
      EXPECT_GT(proposal.last_sample_index, last);
      last = proposal.last_sample_index;
      proposed.insert(last);
    }
    EXPECT_EQ(last, 29);
    for (std::int64_t i = 4; i < 30; i += 5) EXPECT_TRUE(proposed.contains(i)) << i;
    if (speed == 1) {
      EXPECT_EQ(proposed.size(), 30U);
    }
  }
}

TEST_F(StructureLearnerTest, OfPrefixesThatNobodyJudgesOnlyTheNewestWaits) {
  StructureLearner learner(config_);
  for (int i = 0; i < 13; ++i) learner.on_sample(samples_[i]);
  for (const std::int64_t expected : {4, 9, 12}) {
    EXPECT_EQ(learner.has_test_job(), expected != 12);
    ASSERT_TRUE(learner.has_job());
    EXPECT_EQ(learner.take_job()().last_sample_index, expected);
  }
  EXPECT_FALSE(learner.has_job());
  EXPECT_FALSE(learner.has_test_job());
}

TEST_F(StructureLearnerTest, WhatWasJudgedBeforeARestartIsNotLearnedAgainAndTheRestIsTheSame) {
  const std::vector<body_schema_t> all = proposals(samples_);
  StructureLearner learner(config_);
  for (const sample_t& sample : samples_) learner.on_sample(sample);
  learner.skip_judged(19);
  for (std::size_t n = 4; n < all.size(); ++n) {
    ASSERT_TRUE(learner.has_job());
    EXPECT_EQ(bytes_of(learner.take_job()()), bytes_of(all[n]));
  }
  EXPECT_FALSE(learner.has_job());
  // The newest proposal is repeated: there is always one.
  StructureLearner other(config_);
  for (const sample_t& sample : samples_) other.on_sample(sample);
  other.skip_judged(29);
  ASSERT_TRUE(other.has_job());
  EXPECT_EQ(bytes_of(other.take_job()()), bytes_of(all.back()));
}

TEST_F(StructureLearnerTest, AJobIsACopyThatLaterSamplesDoNotChange) {
  StructureLearner learner(config_);
  for (int i = 0; i < 20; ++i) learner.on_sample(samples_[i]);
  for (int i = 0; i < 3; ++i) learner.take_job();  // those after 4, 9 and 14
  const auto job = learner.take_job();
  auto fit = std::async(std::launch::async, job);
  for (std::size_t i = 20; i < samples_.size(); ++i) learner.on_sample(samples_[i]);
  const body_schema_t first = fit.get();
  EXPECT_EQ(first.last_sample_index, 19);
  EXPECT_EQ(bytes_of(first), bytes_of(job()));
  EXPECT_EQ(bytes_of(first), bytes_of(learn_all({samples_.begin(), samples_.begin() + 20})));
}

TEST_F(StructureLearnerTest, WhatRestsOnAMovedTagIsLeftOutWhereThatWasKnown) {
  constexpr int kTag = 21;
  BodySchema known;
  known.moved_tags = {{.tag = kTag, .found = 13, .since = 8, .until = 24}};
  std::vector<sample_t> moved = samples_, without = samples_;
  for (std::size_t i = 0; i < moved.size(); ++i) {
    ActionPoseSample sample = from_message(moved[i]);
    for (PartObservation& o : sample.parts) {
      o.tags = {o.part == 2 && i % 2 ? kTag : 10 * o.part};
      if (o.tags.front() == kTag && i >= 8 && i < 20) o.X_CB.translation().y() += 0.1;
    }
    moved[i] = to_message(sample);
    if (i < 24) drop_moved_tags(known.moved_tags, &sample);
    without[i] = to_message(sample);
  }
  StructureLearner learner(config_);
  learner.on_body_schema(to_message(known));
  const auto last_of = [&](std::size_t end) {
    while (learner.last_sample_index() + 1 < static_cast<std::int64_t>(end))
      learner.on_sample(moved[static_cast<std::size_t>(learner.last_sample_index() + 1)]);
    body_schema_t last;
    while (learner.has_job()) last = learner.take_job()();
    return last;
  };
  const auto first = [](const std::vector<sample_t>& samples, std::ptrdiff_t n) {
    return std::vector<sample_t>(samples.begin(), samples.begin() + n);
  };
  // Not known yet; known; and that it is back.
  EXPECT_EQ(bytes_of(last_of(10)), bytes_of(learn_all(first(moved, 10))));
  for (const int end : {20, 30}) {
    const body_schema_t proposal = last_of(static_cast<std::size_t>(end));
    ASSERT_EQ(proposal.num_moved_tags, 1);
    EXPECT_EQ(proposal.moved_tags[0].moved_until_sample, end == 20 ? -1 : 24);
    BodySchema expected = from_message(learn_all(first(without, end)));
    expected.moved_tags = known.moved_tags_known(end - 1);
    EXPECT_EQ(bytes_of(to_message(from_message(proposal))), bytes_of(to_message(expected)));
  }
}

TEST_F(StructureLearnerTest, ThereIsAJobWheneverThereIsANewSampleAlsoATest) {
  StructureLearner learner(config_);
  EXPECT_FALSE(learner.has_job());
  for (int i = 0; i < 5; ++i) {
    learner.on_sample(samples_[i]);
    EXPECT_TRUE(learner.has_job());
    learner.take_job();
    EXPECT_FALSE(learner.has_job());
  }
}

TEST_F(StructureLearnerTest, AnOldOrRepeatedSampleIsIgnored) {
  const Bytes expected = bytes_of(learn_all(samples_));
  std::vector<sample_t> repeated;
  for (std::size_t i = 0; i < samples_.size(); ++i) {
    repeated.push_back(samples_[i]);
    repeated.push_back(samples_[i]);
    repeated.push_back(samples_[i / 2]);
  }
  EXPECT_EQ(bytes_of(learn_all(repeated)), expected);

  StructureLearner learner(config_);
  learner.on_sample(samples_[3]);
  learner.take_job();
  learner.on_sample(samples_[3]);
  learner.on_sample(samples_[1]);
  EXPECT_FALSE(learner.has_job());
}

TEST_F(StructureLearnerTest, AnActionOfAnotherLengthIsRefused) {
  StructureLearner learner(config_);
  sample_t sample = samples_[0];
  sample.action.push_back(0);
  sample.num_signals = 3;
  EXPECT_THROW(learner.on_sample(sample), std::invalid_argument);
  sample.action.clear();
  sample.num_signals = 0;
  EXPECT_THROW(learner.on_sample(sample), std::invalid_argument);
  EXPECT_FALSE(learner.has_job());
}

TEST_F(StructureLearnerTest, EveryProposalOfARunMayBeSent) {
  StructureLearner learner(config_);
  for (const sample_t& sample : samples_) {
    learner.on_sample(sample);
    EXPECT_EQ(check(learner.take_job()()), "") << "after sample " << sample.sample_index;
  }
}

TEST_F(StructureLearnerTest, AProposalWithoutAnySightOfTheRootMayBeSentAndIsIncomplete) {
  std::vector<sample_t> samples = samples_;
  for (sample_t& sample : samples) {
    std::vector<part_observation_t> others;
    for (const auto& part : sample.parts)
      if (part.part_id != 1) others.push_back(part);
    set_array(sample.num_parts, sample.parts, std::move(others));
  }
  const body_schema_t proposal = learn_all(samples);
  EXPECT_EQ(check(proposal), "");
  EXPECT_EQ(proposal.is_complete, 0);
  EXPECT_EQ(proposal.num_edges, 3);  // what is seen is connected
  ASSERT_EQ(proposal.num_unconnected, 1);
  EXPECT_EQ(proposal.unconnected[0].unconnected_part, 1);
  EXPECT_EQ(proposal.unconnected[0].reason, unconnected_part_t::REASON_NEVER_SEEN);
}

TEST_F(StructureLearnerTest, AProposalMayBeSentWhenNothingWasSeenAtAll) {
  std::vector<sample_t> samples = samples_;
  for (sample_t& sample : samples) set_array(sample.num_parts, sample.parts, {});
  const body_schema_t proposal = learn_all(samples);
  EXPECT_EQ(check(proposal), "");
  EXPECT_EQ(proposal.is_complete, 0);
  EXPECT_EQ(proposal.root_part, -1);
  EXPECT_EQ(proposal.last_sample_index, 29);
}

TEST(StructureLearnerConfigTest, IsReadInSiUnitsWithTheRootOfTheRig) {
  const std::filesystem::path folder = std::filesystem::path(testing::TempDir()) /
                                       ("structure_learner_config_" + std::to_string(getpid()));
  std::filesystem::create_directories(folder);
  std::ofstream(folder / "signals.yaml")
      << "signals:\n  - {name: a, lower: 0, upper: 1}\nroot_part: 4\nend_effector_part: 5\n";
  std::ofstream(folder / "structure_learner.yaml") << "max_signals: 1\n";
  std::ofstream(folder / "noise.yaml")
      << "corner_noise_px: 0.05\nsmall_tag_noise_px: 0.15\noutlier_rate: 0.1\n"
         "tag_position_m: 0\ntag_rotation_deg: 0\ntag_size_share: 0\nsystematic_position_m: "
         "0.002\nsystematic_rotation_deg: 90\n";
  std::ofstream(folder / "markers.yaml")
      << "family: tag36h11\ntags:\n  - {id: 0, size_m: 0.1, part: 5, placement: none}\n"
         "  - {id: 1, size_m: 0.1, part: 4, placement: none}\n";
  const auto config = StructureLearnerConfig::load(folder / "structure_learner.yaml");
  EXPECT_EQ(config.signals.size(), 1U);
  EXPECT_EQ(config.options.root, 4);
  EXPECT_EQ(config.options.expected_parts, (std::vector<int>{4, 5}));
  EXPECT_EQ(config.options.max_signals, 1);
  EXPECT_EQ(config.options.measurement.outlier_rate, 0.1);
  EXPECT_EQ(config.options.measurement.systematic.position_m, 0.002);
  EXPECT_DOUBLE_EQ(config.options.measurement.systematic.rotation_rad, M_PI / 2);

  std::ofstream(folder / "structure_learner.yaml", std::ios::app) << "window: 3\n";
  EXPECT_THROW(StructureLearnerConfig::load(folder / "structure_learner.yaml"), ConfigError);
  std::filesystem::remove_all(folder);
}

// The retained set, whenever it is asked: after a restart, with prefixes left out, or since a
// change that was found long after it.
TEST_F(StructureLearnerTest, ManySamplesAreLearnedFromTheRetainedOnes) {
  constexpr std::int64_t kMany = 5'000, kSince = 400, kFound = 4'500;
  std::vector<sample_t> samples;
  for (std::int64_t i = 0; i < kMany; ++i) {
    sample_t sample = samples_[static_cast<std::size_t>(i) % samples_.size()];
    sample.sample_index = i;
    sample.utime = 1'000'000 * (i + 1);
    samples.push_back(sample);
  }
  const auto expected = [&](std::int64_t since) {
    std::vector<ActionPoseSample> training;
    const std::int64_t stride = retained_stride(since, kMany - 1);
    for (const sample_t& sample : samples)
      if (sample.sample_index >= since && sample.sample_index % stride == 0 &&
          sample.purpose != action_command_t::PURPOSE_TEST)
        training.push_back(from_message(sample));
    return training.size();
  };
  const auto last = [](StructureLearner* learner) {
    // What waited too long was given up: no more jobs than there are TEST samples in kMaxLag.
    std::function<body_schema_t()> job;
    int num_jobs = 0;
    for (; learner->has_job(); ++num_jobs) job = learner->take_job();
    EXPECT_LE(num_jobs, RetainedSamples::kMaxLag / 5 + 1);
    return job();
  };
  StructureLearner at_once(config_), in_steps(config_), told(config_);
  body_schema_t stepped;
  BodySchema known;
  known.signals = robot_.signals;
  known.changes = {{kFound, kSince}};
  for (const sample_t& sample : samples) {
    at_once.on_sample(sample);
    in_steps.on_sample(sample);
    told.on_sample(sample);
    if (sample.sample_index % 1'000 == 999) stepped = last(&in_steps);
  }
  told.on_body_schema(to_message(known));
  const body_schema_t of_all = last(&at_once);
  // 1250 multiples of 4 … of which a fifth are TEST; the last twentieth may wait for a checkpoint.
  EXPECT_LE(of_all.num_samples_seen, static_cast<std::int32_t>(expected(0)));
  EXPECT_GT(of_all.num_samples_seen, 0.94 * static_cast<double>(expected(0)));
  EXPECT_EQ(bytes_of(stepped), bytes_of(of_all));
  const body_schema_t since = last(&told);
  EXPECT_LE(since.num_samples_seen, static_cast<std::int32_t>(expected(kSince)));
  EXPECT_GT(since.num_samples_seen, 0.94 * static_cast<double>(expected(kSince)));
  EXPECT_EQ(since.edges.at(0).valid_since_sample, kSince);
}

}  // namespace
}  // namespace bodyschema
