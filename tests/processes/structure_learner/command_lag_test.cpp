#include "processes/structure_learner/command_lag.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <string>
#include <vector>

#include "common/geometry/angle.h"
#include "processes/structure_learner/learn.h"
#include "tests/support/imperfect_robot.h"

namespace bodyschema {
namespace {

using test::ImperfectRobot;
using test::Rightness;

constexpr int kSamples = 1000;
constexpr double kPeriod = 60;

std::vector<ActionPoseSample> stream_of(ImperfectRobot& robot) {
  return robot.wander(kSamples, kPeriod);
}

double interval_us(const std::vector<ActionPoseSample>& samples) {
  return static_cast<double>(samples.back().utime - samples.front().utime) / (kSamples - 1);
}

TEST(CommandLag, IsFoundToAShareOfTheInterval) {
  for (const double lag : {-4.0, -1.5, 1.5, 8.0})
    for (std::uint64_t seed = 0; seed < 3; ++seed) {
      ImperfectRobot robot(3, true, {.lag = lag}, seed);
      const auto samples = stream_of(robot);
      const CommandLag found = command_lag(samples, 3);
      EXPECT_TRUE(found.is_significant) << lag << ", seed " << seed;
      EXPECT_NEAR(static_cast<double>(found.us) / interval_us(samples), lag, 0.1) << seed;
    }
}

TEST(CommandLag, IsNoneWhereThereIsNone) {
  for (const test::Imperfection& is :
       std::vector<test::Imperfection>{{},
                                       {.droop_deg = 2},
                                       {.view_bias_m = 0.003, .view_bias_deg = 1.5},
                                       {.correlation = 0.9},
                                       {.student_nu = 2.2},
                                       {.flip_share = 0.1},
                                       {.missing_share = 0.6}})
    for (std::uint64_t seed = 0; seed < 3; ++seed) {
      ImperfectRobot robot(3, seed % 2, is, seed);
      EXPECT_FALSE(command_lag(stream_of(robot), 3).is_significant) << is.name << ", seed " << seed;
    }
}

TEST(CommandLag, IsNoneOfPosesAtRest) {
  ImperfectRobot robot(3, true, {}, 1);
  EXPECT_EQ(command_lag(robot.babble(200), 3).us, 0);
  EXPECT_EQ(command_lag({}, 0).us, 0);
  EXPECT_EQ(command_lag(robot.babble(1), 3).us, 0);
}

TEST(CommandLag, CommandsOfBeforeAreLinearBetweenTwo) {
  std::vector<ActionPoseSample> samples(3);
  for (int n = 0; n < 3; ++n) {
    samples[static_cast<std::size_t>(n)].utime = 1000 * n;
    samples[static_cast<std::size_t>(n)].action = Eigen::VectorXd::Constant(1, n * n);
  }
  const auto late = with_commands_of_before(samples, {.lag_us = 250});
  ASSERT_EQ(late.size(), 2U);
  EXPECT_EQ(late[0].utime, 1000);
  EXPECT_DOUBLE_EQ(late[0].action[0], 0.75);
  EXPECT_DOUBLE_EQ(late[1].action[0], 3.25);
  const auto early = with_commands_of_before(samples, {.lag_us = -1000});
  ASSERT_EQ(early.size(), 2U);
  EXPECT_DOUBLE_EQ(early[1].action[0], 4);
  EXPECT_TRUE(with_commands_of_before(samples, {.lag_us = 5000}).empty());
  // Of the time of a gap nothing is known.
  ActionPoseSample& late_one = samples.emplace_back(samples.back());
  late_one.utime = 9000;
  EXPECT_EQ(with_commands_of_before(samples, {.lag_us = 250}).size(), 2U);
}

// A sine of before is a mixture of two of now: late poses look like joints that both move.
TEST(CommandLag, OfOneRhythmIsNotKnown) {
  constexpr int kNum = 600, kLate = 6;
  int num_leaves_told = 0;
  for (std::uint64_t seed = 0; seed < 4; ++seed) {
    ImperfectRobot robot(2, true, {}, seed);
    const auto action_at = [&](int n) {
      Eigen::VectorXd action(2);
      for (Eigen::Index s = 0; s < 2; ++s) {
        const Signal& signal = robot.signals()[static_cast<std::size_t>(s)];
        action[s] = 0.5 * (signal.lower + signal.upper) +
                    0.4 * (signal.upper - signal.lower) *
                        std::sin(2 * M_PI * n / 90 + 1.3 * static_cast<double>(s));
      }
      return action;
    };
    std::vector<ActionPoseSample> samples;
    for (int n = 0; n < kNum; ++n) {
      samples.push_back(robot.go(action_at(n - kLate)));
      samples.back().action = action_at(n);
    }
    EXPECT_TRUE(is_one_rhythm(samples, 2));
    const BodySchema schema = learn(robot.signals(), samples).schema;
    EXPECT_NE(judge(schema, robot.structure()), Rightness::kWrong) << seed;
    ASSERT_FALSE(schema.unconnected.empty()) << seed;
    EXPECT_NE(schema.unconnected.front().detail.find("one rhythm"), std::string::npos) << seed;
    // Nor by the position of the hand alone.
    test::SyntheticRobot ends = robot.structure();
    test::hide_all_but_ends(&ends, &samples);
    const int hand = ends.visible_parts().back();
    const auto positions = test::with_positions_alone(std::move(samples), {hand});
    const BodySchema of_positions = learn(robot.signals(), positions).schema;
    EXPECT_FALSE(of_positions.complete) << seed;
    ASSERT_FALSE(of_positions.unconnected.empty()) << seed;
    num_leaves_told +=
        of_positions.unconnected.front().detail.find(kOneRhythm) != std::string::npos;
  }
  EXPECT_GE(num_leaves_told, 3);
  for (const bool is_chain : {false, true}) {
    ImperfectRobot robot(2, is_chain, {}, 1);
    EXPECT_FALSE(is_one_rhythm(stream_of(robot), 2));
    EXPECT_FALSE(is_one_rhythm(robot.babble(200), 2));
  }
  ImperfectRobot long_arm(7, true, {}, 1);
  EXPECT_FALSE(is_one_rhythm(long_arm.wander(300, kPeriod), 7)) << "few blocks of time";
}

// What is learned is where a command leads, not where the arm is when it is given.
TEST(CommandLag, IsTakenIntoAccount) {
  for (const double lag : {-4.0, 0.2, 1.5, 8.0})
    for (const bool is_chain : {true, false}) {
      ImperfectRobot robot(3, is_chain, {.lag = lag}, 2);
      LearnOptions options;
      options.root = 1;
      const LearnResult late = learn(robot.signals(), stream_of(robot), options);
      EXPECT_EQ(judge(late.schema, robot.structure()), Rightness::kRight) << lag;
      EXPECT_TRUE(late.schema.complete);
      ImperfectRobot punctual(3, is_chain, {}, 2);
      const auto samples = stream_of(punctual);
      const LearnResult right = learn(punctual.signals(), samples, options);
      EXPECT_EQ(right.command_delay, CommandDelay{});
      EXPECT_NEAR(static_cast<double>(late.command_delay.lag_us) / interval_us(samples), lag, 0.06);
      // Held against the schema the recording is taken in the same way.
      ImperfectRobot again(3, is_chain, {.lag = lag}, 2);
      EXPECT_NEAR(static_cast<double>(command_delay(stream_of(again), late.schema).lag_us),
                  static_cast<double>(late.command_delay.lag_us), 0.06 * interval_us(samples));
      EXPECT_EQ(command_delay(samples, right.schema), CommandDelay{});
      for (std::size_t n = 0; n < samples.size(); n += 100) {
        const auto a = late.schema.predict(1, 4, samples[n].action);
        const auto b = right.schema.predict(1, 4, samples[n].action);
        ASSERT_TRUE(a && b);
        EXPECT_LT((a->X_AB.translation() - b->X_AB.translation()).norm(), 0.001) << lag;
      }
    }
}

TEST(CommandLag, OfDrivesThatFollowIsTheirTimeConstantAndSmeared) {
  constexpr double kDrive = 4;
  LearnOptions options;
  options.root = 1;
  ImperfectRobot slow(3, true, {.drive = kDrive}, 2), quick(3, true, {}, 2);
  const auto samples = slow.wander(kSamples, 100), right = quick.wander(kSamples, 100);
  const LearnResult late = learn(slow.signals(), samples, options);
  EXPECT_EQ(judge(late.schema, slow.structure()), Rightness::kRight);
  EXPECT_NEAR(static_cast<double>(late.command_delay.lag_us) / interval_us(samples), kDrive, 0.3);
  EXPECT_NEAR(static_cast<double>(late.command_delay.smear_us) / interval_us(samples), kDrive, 1);
  const BodySchema schema = learn(quick.signals(), right, options).schema;
  std::vector<double> apart_m;
  for (const ActionPoseSample& sample : right)
    apart_m.push_back((late.schema.predict(1, 4, sample.action)->X_AB.translation() -
                       schema.predict(1, 4, sample.action)->X_AB.translation())
                          .norm());
  std::ranges::nth_element(apart_m, apart_m.begin() + kSamples / 2);
  EXPECT_LT(apart_m[kSamples / 2], 0.002);
}

// One that swings in twice its time constant goes less than a third as far as its command.
TEST(CommandLag, DrivesAreFollowedHoweverFastCommandsAre) {
  constexpr double kDrive_us = 200'000, kInterval_us = 33'333;
  constexpr int kNum = 400, kPeriod_us = 400'000;
  std::vector<ActionPoseSample> samples(kNum);
  std::vector<double> truth(kNum);  // of the commands linear between two, in fine steps
  const auto command_at = [](double us) { return std::sin(2 * M_PI * us / kPeriod_us); };
  double joint = 0;
  for (int n = 0; n < kNum; ++n) {
    samples[n].utime = std::llround(n * kInterval_us);
    samples[n].action = Eigen::VectorXd::Constant(1, command_at(n * kInterval_us));
    constexpr int kFine = 1000;
    for (int k = 0; n > 0 && k < kFine; ++k) {
      const double share = (k + 0.5) / kFine;
      const double input = (1 - share) * samples[n - 1].action[0] + share * samples[n].action[0];
      joint += (input - joint) * kInterval_us / kFine / kDrive_us;
    }
    truth[n] = joint;
  }
  const auto moved = with_commands_of_before(
      samples, {.lag_us = std::llround(kDrive_us), .smear_us = std::llround(kDrive_us)});
  ASSERT_GT(moved.size(), kNum - 20U);
  double largest = 0;
  const std::size_t skipped = samples.size() - moved.size();
  for (std::size_t n = 100; n < moved.size(); ++n) {
    EXPECT_NEAR(moved[n].action[0], truth[n + skipped], 1e-3);
    largest = std::max(largest, moved[n].action[0]);
  }
  EXPECT_LT(largest, 0.33);
  EXPECT_GT(largest, 0.25);
}

// Of even motion the lag is all that a drive makes; behind a gap it is not known for a while.
TEST(CommandLag, BehindAGapADriveIsNotKnownForThreeTimeConstants) {
  constexpr std::int64_t kStep_us = 20'000, kDead_us = 200'000, kConstant_us = 100'000;
  constexpr int kNum = 100;
  std::vector<ActionPoseSample> samples;
  const auto command_at = [](std::int64_t us) { return 1e-6 * static_cast<double>(us); };
  for (const std::int64_t begin_us : {0, 10'000'000})
    for (int n = 0; n < kNum; ++n) {
      samples.emplace_back().utime = begin_us + n * kStep_us;
      samples.back().action = Eigen::VectorXd::Constant(1, command_at(samples.back().utime));
    }
  const CommandDelay delay{.lag_us = kDead_us + kConstant_us, .smear_us = kConstant_us};
  const auto moved = with_commands_of_before(samples, delay);
  const int left_out = (kDead_us + 3 * kConstant_us) / kStep_us;
  EXPECT_EQ(moved.size(), 2 * (kNum - left_out) * 1U);
  for (const ActionPoseSample& sample : moved)
    EXPECT_NEAR(sample.action[0], command_at(sample.utime - delay.lag_us), 1e-9);
  // A time that goes back is left out.
  samples.push_back(samples.front());
  EXPECT_EQ(with_commands_of_before(samples, delay).size(), moved.size());
}

TEST(CommandLag, AJointThatGoesLessFarIsNoSlowDrive) {
  LearnOptions options;
  options.root = 1;
  ImperfectRobot robot(2, true, {}, 2);
  const auto samples = stream_of(robot);
  const BodySchema schema = learn(robot.signals(), samples, options).schema;
  auto farther = samples;  // the commands; so the joints go 0.9 times as far
  for (ActionPoseSample& sample : farther) sample.action /= 0.9;
  EXPECT_EQ(command_delay(farther, schema).smear_us, 0);
}

}  // namespace
}  // namespace bodyschema
