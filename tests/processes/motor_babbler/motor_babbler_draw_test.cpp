// Class MotorBabbler: the actions that it draws, one joint alone among them, and its configuration.

#include <gtest/gtest.h>

#include <fstream>
#include <functional>
#include <regex>
#include <set>

#include "common/config/yaml.h"
#include "common/geometry/angle.h"
#include "tests/processes/motor_babbler/motor_babbler_bench.h"
#include "tests/support/temporary_folder.h"
#include "tests/support/text_of.h"

namespace bodyschema::test {
namespace {

TEST(MotorBabblerTest, AnActionIsAFunctionOfSeedAndIdOnly) {
  const MotorBabblerConfig config = test_config();
  std::set<std::vector<double>> all;
  for (std::int64_t seed = 0; seed < 20; ++seed) {
    for (std::int64_t id = 0; id < 50; ++id) {
      const Eigen::VectorXd action = random_action(config, seed, id);
      EXPECT_EQ(action, random_action(config, seed, id));
      all.insert({action.begin(), action.end()});
    }
  }
  EXPECT_EQ(all.size(), 1000U);
  EXPECT_NE(random_action(config, std::int64_t{1} << 32, 0), random_action(config, 0, 0));
  EXPECT_NE(random_action(config, 0, std::int64_t{1} << 32), random_action(config, 0, 0));
}

TEST(MotorBabblerTest, TheActionsSentAreThoseOfTheirIdsWhateverHappenedBetween) {
  Bench smooth, rough;
  smooth.start();
  rough.start();
  smooth.run(3);
  rough.run(1);
  rough.take(rough.babbler.on_tick(10 * kSecond));
  rough.take(rough.babbler.on_tick(20 * kSecond));  // sent again
  rough.run(1);
  ASSERT_TRUE(rough.take(
      rough.babbler.on_motion_status(answer(rough.last, motion_status_t::STATE_REJECTED))));
  EXPECT_EQ(rough.last.action_id, 3);
  EXPECT_EQ(smooth.last.action_id, 3);
  EXPECT_EQ(rough.last.action, smooth.last.action);
}

TEST(MotorBabblerTest, ActionsStayWithinTheLimits) {
  const MotorBabblerConfig config = test_config();
  for (std::int64_t id = 0; id < 5000; ++id) {
    const Eigen::VectorXd action = random_action(config, 3, id);
    for (std::size_t i = 0; i < config.signals.size(); ++i) {
      EXPECT_GE(action[i], config.signals[i].lower);
      EXPECT_LE(action[i], config.signals[i].upper);
    }
  }
}

TEST(MotorBabblerTest, HalfOfTheActionsLieInTheOuterSeventyToHundredPercent) {
  const MotorBabblerConfig config = test_config();
  const int n = 5000;
  int num_outer = 0;
  Eigen::Vector3d num_upper = Eigen::Vector3d::Zero();
  double least = 1, most = 0;
  for (std::int64_t id = 0; id < n; ++id) {
    const Eigen::VectorXd action = random_action(config, 4, id);
    int outer = 0;
    for (std::size_t i = 0; i < config.signals.size(); ++i) {
      const Signal& s = config.signals[i];
      const double x = (action[i] - 0.5 * (s.lower + s.upper)) / (0.5 * (s.upper - s.lower));
      outer += std::abs(x) >= 0.7 - 1e-12;
      num_upper[i] += x > 0;
      if (std::abs(x) >= 0.7) least = std::min(least, std::abs(x));
      most = std::max(most, std::abs(x));
    }
    num_outer += outer == 3;
  }
  // Half by decision, and 0.3^3 of the other half by chance; five standard deviations.
  const double share = 0.5 + 0.5 * 0.027;
  EXPECT_NEAR(num_outer, n * share, 5 * std::sqrt(n * share * (1 - share)));
  for (int i = 0; i < 3; ++i) EXPECT_NEAR(num_upper[i], 0.5 * n, 5 * std::sqrt(0.25 * n));
  EXPECT_LT(least, 0.701);
  EXPECT_GT(most, 0.999);
}

TEST(MotorBabblerTest, EveryFifthSampleIsTest) {
  MotorBabblerConfig config = test_config();
  config.stop.max_samples = 1000;
  Bench bench(config);
  bench.start();
  for (int i = 0; i < 40; ++i) {
    EXPECT_EQ(bench.is_test(), i % 5 == 4) << i;
    bench.run(1);
  }
}

TEST(MotorBabblerTest, EveryFifthOfItsOwnSamplesIsTestWhateverOthersDoInBetween) {
  Bench bench;
  bench.start();
  std::int64_t own = 0;
  for (int i = 0; i < 20; ++i) {
    EXPECT_EQ(bench.is_test(), own % 5 == 4);
    if (i % 3 == 0) {
      action_command_t foreign = bench.last;
      foreign.source = "controller";
      bench.babbler.on_sample(sample_of(foreign, bench.num_samples++));
    }
    bench.run(1);
    EXPECT_EQ(bench.babbler.num_samples(), ++own);
  }
}

MotorBabblerConfig single_config(double share = 0.34) {
  MotorBabblerConfig config = test_config();
  config.single_joint_share = share;
  config.stop.min_samples = config.stop.max_samples = 200;
  return config;
}

/// Signals in which two actions differ.
std::vector<std::size_t> differences(const std::vector<double>& a, const std::vector<double>& b) {
  std::vector<std::size_t> result;
  for (std::size_t s = 0; s < a.size(); ++s)
    if (a[s] != b[s]) result.push_back(s);
  return result;
}

/// The samples of a run whose TEST samples all find the schema incomplete.
std::vector<sample_t> ends_run(const MotorBabblerConfig& config, int num_samples,
                               const std::function<std::vector<int>(int)>& parts_at) {
  Bench bench(config);
  bench.start();
  std::vector<sample_t> samples;
  for (int n = 0; n < num_samples; ++n) {
    samples.push_back(ends_seen(bench.last, n, parts_at(n)));
    bench.babbler.on_motion_status(answer(bench.last, motion_status_t::STATE_SETTLED));
    bench.babbler.remember(samples.back());
    bench.take(bench.babbler.on_sample(samples.back()));
    if (samples.back().purpose == action_command_t::PURPOSE_TEST)
      bench.take(bench.babbler.on_model_health(bad_health(n)));
  }
  return samples;
}

TEST(MotorBabblerTest, WhereTwoPartsAreSeenAThirdOfTheTrainActionsMovesOneJointAlone) {
  for (const Choice choice : {Choice::kRandom, Choice::kActive}) {
    MotorBabblerConfig config = single_config();
    config.choice = choice;
    const auto samples = ends_run(config, 100, [](int) { return std::vector{1, 2}; });
    int num_single = 0;
    std::set<std::vector<double>> poses;
    std::vector<double> pose;
    for (int n = 0; n < 100; ++n) {
      const bool is_test = n % 5 == 4;
      EXPECT_EQ(samples[n].purpose == action_command_t::PURPOSE_TEST, is_test) << n;
      if (is_drawn(samples[n], config)) {
        if (!is_test && num_single % 3 == 0) pose = samples[n].action;
        continue;
      }
      EXPECT_FALSE(is_test) << n;
      EXPECT_GT(n, 4) << "before the first verdict";
      // About one pose, each signal in turn and far.
      const std::size_t s = num_single++ % 3;
      ASSERT_EQ(differences(samples[n].action, pose), std::vector{s}) << n;
      poses.insert(pose);
      const Signal& signal = config.signals[s];
      EXPECT_GE(std::abs(samples[n].action[s] - pose[s]), 0.2499 * (signal.upper - signal.lower));
      EXPECT_GE(samples[n].action[s], signal.lower);
      EXPECT_LE(samples[n].action[s], signal.upper);
    }
    EXPECT_NEAR(num_single, 0.34 * 80, 2);
    EXPECT_EQ(poses.size(), (num_single + 2U) / 3);
  }
}

TEST(MotorBabblerTest, OnceAThirdPartWasSeenOrTheSchemaIsCompleteNoJointMovesAlone) {
  const MotorBabblerConfig config = single_config(1);
  const auto with_third = ends_run(config, 60, [](int n) {
    return n == 20 ? std::vector{1, 2, 3} : std::vector{1, 2};
  });
  for (int n = 0; n < 60; ++n)
    EXPECT_EQ(is_drawn(with_third[n], config), n < 5 || n > 20 || n % 5 == 4) << n;

  for (const int complete_at : {24, 29}) {
    Bench bench(config);
    bench.start();
    for (int n = 0; n < 60; ++n) {
      const sample_t sample = ends_seen(bench.last, n);
      EXPECT_EQ(is_drawn(sample, config), n < 5 || n > complete_at || n % 5 == 4) << n;
      // A verdict may come before its sample.
      const model_health_t health = n < complete_at ? bad_health(n) : good_health(n);
      const bool is_early = complete_at == 29;
      if (is_early && bench.is_test()) bench.take(bench.babbler.on_model_health(health));
      const bool was_test = bench.is_test();
      bench.babbler.on_motion_status(answer(bench.last, motion_status_t::STATE_SETTLED));
      bench.take(bench.babbler.on_sample(sample));
      if (!is_early && was_test) bench.take(bench.babbler.on_model_health(health));
      // What is found in between changes nothing.
      if (n > 5 && !was_test) bench.babbler.on_model_health(good_health(n / 5 * 5 - 1));
    }
  }
}

TEST(MotorBabblerTest, AJointMovesAloneFromAPoseAtWhichBothPartsWereSeen) {
  const MotorBabblerConfig config = single_config();
  const auto samples = ends_run(config, 100, [](int n) {
    return n % 3 ? std::vector{1} : std::vector{1, 2};
  });
  int num_single = 0;
  for (int n = 0; n < 100; ++n) {
    if (is_drawn(samples[n], config)) continue;
    ++num_single;
    const bool has_pose = std::any_of(samples.begin(), samples.begin() + n, [&](const sample_t& s) {
      return s.num_parts == 2 && s.purpose != action_command_t::PURPOSE_TEST &&
             differences(s.action, samples[n].action).size() == 1;
    });
    EXPECT_TRUE(has_pose) << n;
  }
  EXPECT_GT(num_single, 20);
  for (const sample_t& sample : ends_run(config, 50, [](int) { return std::vector{1}; }))
    EXPECT_TRUE(is_drawn(sample, config));
}

TEST(MotorBabblerTest, ARefusedMoveOfOneJointIsReplacedByAnotherOfThatJoint) {
  const MotorBabblerConfig config = single_config(1);
  Bench bench(config);
  bench.start();
  for (int n = 0; n < 12; ++n) {
    const bool was_test = bench.is_test();
    bench.babbler.on_motion_status(answer(bench.last, motion_status_t::STATE_SETTLED));
    bench.take(bench.babbler.on_sample(ends_seen(bench.last, n)));
    if (was_test) bench.take(bench.babbler.on_model_health(bad_health(n)));
    if (n < 5 || bench.is_test()) continue;
    const std::vector<double> refused = bench.last.action;
    ASSERT_TRUE(bench.take(
        bench.babbler.on_motion_status(answer(bench.last, motion_status_t::STATE_REJECTED))));
    EXPECT_EQ(differences(bench.last.action, refused).size(), 1U) << n;
  }
}

TEST(MotorBabblerTest, TheConfigurationIsReadInSiUnits) {
  const MotorBabblerConfig config =
      MotorBabblerConfig::load(std::string(BODYSCHEMA_CONFIG) + "/arm2/motor_babbler.yaml");
  EXPECT_EQ(config.choice, Choice::kRandom);
  EXPECT_EQ(config.signals.size(), 2U);
  EXPECT_EQ(config.resend_us, 1 * kSecond);
  EXPECT_EQ(config.expiry_us, 60 * kSecond);
  EXPECT_NEAR(config.stop.rotation_rad, kDegree, 1e-12);
  EXPECT_EQ(config.extreme_from, 0.7);
}

TEST(MotorBabblerTest, MoreLeastSamplesThanMostAreRefusedByName) {
  const TemporaryFolder rig(std::string(BODYSCHEMA_CONFIG) + "/arm2");
  const std::filesystem::path file = rig / "motor_babbler.yaml";
  const std::string text = text_of(file);
  std::ofstream(file) << std::regex_replace(text, std::regex("max_samples: *[0-9]+"),
                                            "max_samples: 3");
  try {
    MotorBabblerConfig::load(file);
    ADD_FAILURE() << "accepted";
  } catch (const ConfigError& error) {
    EXPECT_NE(std::string(error.what()).find("above max_samples, 3"), std::string::npos)
        << error.what();
  }
}

}  // namespace
}  // namespace bodyschema::test
