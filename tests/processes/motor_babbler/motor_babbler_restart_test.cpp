// Class MotorBabbler: restarts.

#include <gtest/gtest.h>
#include <unistd.h>

#include <fstream>
#include <memory>
#include <random>

#include "common/config/yaml.h"
#include "tests/processes/motor_babbler/motor_babbler_bench.h"

namespace bodyschema::test {
namespace {

TEST(MotorBabblerTest, ARestartGoesOnAfterTheLastActionOfItsPredecessor) {
  Bench before;
  before.start();
  before.run(7);
  MotorBabbler after = free_babbler();
  const auto command = after.on_motion_status(answer(before.last, motion_status_t::STATE_SETTLED));
  ASSERT_TRUE(command);
  EXPECT_EQ(command->action_id, before.last.action_id + 1);
  EXPECT_NE(command->epoch, before.last.epoch);
  const Eigen::VectorXd expected = random_action(test_config(), 1, command->action_id);
  EXPECT_EQ(command->action, std::vector<double>(expected.begin(), expected.end()));
}

TEST(MotorBabblerTest, ARestartKeepsEveryFifthSampleTest) {
  Bench before;
  before.start();
  before.run(9);
  ASSERT_TRUE(before.is_test());
  MotorBabbler after = free_babbler();
  // The monitor repeats its verdict at 1 Hz, so it may be heard before the driver is.
  EXPECT_FALSE(after.on_model_health(bad_health(8)));
  const auto command = after.on_motion_status(answer(before.last, motion_status_t::STATE_SETTLED));
  ASSERT_TRUE(command);
  EXPECT_EQ(command->purpose, action_command_t::PURPOSE_TEST);
}

/// Driver, observer and monitor that outlive the babbler. Each answers and repeats as in a group.
class World {
 public:
  World(double kill_share, std::uint64_t seed, MotorBabblerConfig config = test_config())
      : config_(std::move(config)), kill_share_(kill_share), rng_(seed) {}
  ~World() { std::filesystem::remove(file_); }

  /// Runs until the babbler is done; every message may be the last that this babbler hears or
  /// sends.
  void run() {
    start();
    for (int i = 0; i < 20'000 && !babbler_->is_done(); ++i) {
      now_ += kSecond / 10;
      tell(babbler_->on_tick(now_));
      if (i % 10) continue;
      tell(babbler_->on_motion_status(status_));
      if (!samples.empty()) tell(babbler_->on_sample(samples.back()));
      tell_verdict();
    }
  }

  std::vector<action_command_t> served;
  std::vector<sample_t> samples;
  int num_kills = 0;

 private:
  void start() {
    babbler_ = std::make_unique<MotorBabbler>(config_, 1);
    if (!kept_.empty()) {
      std::ofstream(file_) << kept_;
      babbler_->restore(file_);
    }
    num_remembered_ = 0;
    while (num_remembered_ < samples.size()) babbler_->remember(samples[num_remembered_++]);
  }
  /// The schema after sample n is version n + 1; every TEST sample makes one.
  void tell_verdict() {
    std::int64_t version = 0;
    for (const sample_t& sample : samples) {
      if (sample.purpose == action_command_t::PURPOSE_TEST) version = sample.sample_index + 1;
    }
    if (version > 0) tell(babbler_->on_body_schema(schema_of(version)));
    model_health_t health = verdict(samples.empty() ? -1 : newest_index(), version);
    // Of every second schema actions are wanted.
    const std::int64_t wanted_sample = version / 10 * 10 - 1;
    if (wanted_sample > 0) health = wanting(health, wanted_sample, 3);
    tell(babbler_->on_model_health(health));
  }
  std::int64_t newest_index() const { return samples.back().sample_index; }
  bool is_killed() {
    if (std::uniform_real_distribution<double>(0, 1)(rng_) >= kill_share_) return false;
    ++num_kills;
    start();
    return true;
  }
  /// As MotorBabblerProcess does: saved, then sent.
  void tell(const std::optional<action_command_t>& command) {
    if (is_killed()) return;
    kept_ = babbler_->state_text();
    if (is_killed() || !command) return;
    serve(*command);
  }
  void serve(const action_command_t& command) {
    const bool is_new = std::none_of(served.begin(), served.end(), [&](const auto& before) {
      return before.epoch == command.epoch && before.action_id == command.action_id;
    });
    if (is_new) served.push_back(command);
    const bool is_refused = command.action_id % 7 == 3;
    status_ = answer(command,
                     is_refused ? motion_status_t::STATE_REJECTED : motion_status_t::STATE_SETTLED);
    if (!is_refused && is_new)
      samples.push_back(ends_seen(command, static_cast<std::int64_t>(samples.size())));
    tell(babbler_->on_motion_status(status_));
    if (is_refused || !is_new) return;
    if (num_remembered_ < samples.size()) tell(babbler_->remember(samples[num_remembered_++]));
    tell(babbler_->on_sample(samples.back()));
    tell_verdict();
  }

  const std::filesystem::path file_ =
      std::filesystem::path(testing::TempDir()) / ("babbler_state_" + std::to_string(getpid()));
  const MotorBabblerConfig config_;
  std::size_t num_remembered_ = 0;  ///< by this babbler
  std::string kept_;
  const double kill_share_;
  std::mt19937_64 rng_;
  std::unique_ptr<MotorBabbler> babbler_;
  motion_status_t status_ = idle_at_rest(5 * kSecond);
  std::int64_t now_ = 100 * kSecond;
};

void kill_and_compare(const MotorBabblerConfig& config) {
  World undisturbed(0, 0, config);
  undisturbed.run();
  ASSERT_EQ(undisturbed.samples.size(), 40U);
  int num_kills = 0;
  for (std::uint64_t seed = 0; seed < 10; ++seed) {
    World world(0.05, seed, config);
    world.run();
    ASSERT_EQ(world.served.size(), undisturbed.served.size()) << seed;
    for (std::size_t i = 0; i < world.served.size(); ++i) {
      const action_command_t &a = world.served[i], &b = undisturbed.served[i];
      EXPECT_EQ(std::tie(a.epoch, a.action_id, a.purpose, a.utime, a.expiry_utime, a.action),
                std::tie(b.epoch, b.action_id, b.purpose, b.utime, b.expiry_utime, b.action))
          << seed << " " << i;
    }
    EXPECT_EQ(world.samples.size(), undisturbed.samples.size());
    num_kills += world.num_kills;
  }
  EXPECT_GT(num_kills, 200);
}

TEST(MotorBabblerTest, KilledAtAnyMomentItGoesOnAsIfNothingHadHappened) {
  kill_and_compare(test_config());
}

TEST(MotorBabblerTest, KilledAtAnyMomentItChoosesTheSameActions) {
  kill_and_compare(active_config());
}

TEST(MotorBabblerTest, KilledAtAnyMomentItMovesTheSameJointsAlone) {
  for (MotorBabblerConfig config : {test_config(), active_config()}) {
    config.single_joint_share = 0.5;
    kill_and_compare(config);
  }
}

TEST(MotorBabblerTest, ARestartListensFirstWhetherTheArmIsLent) {
  Bench before;
  before.start();
  before.run(3);
  const std::filesystem::path file =
      std::filesystem::path(testing::TempDir()) / ("babbler_restart_" + std::to_string(getpid()));
  std::ofstream(file) << before.babbler.state_text();
  const auto restarted = [&] {
    MotorBabbler babbler(test_config(), 1);
    babbler.restore(file);
    return babbler;
  };
  const motion_status_t status = answer(before.last, motion_status_t::STATE_SETTLED);

  MotorBabbler alone = restarted();
  EXPECT_FALSE(alone.on_tick(100 * kSecond));
  EXPECT_FALSE(alone.on_motion_status(status));
  EXPECT_FALSE(alone.on_tick(101 * kSecond));
  const auto again = alone.on_tick(101 * kSecond + kSecond / 2);
  ASSERT_TRUE(again);
  EXPECT_EQ(again->action_id, before.last.action_id);
  EXPECT_EQ(again->expiry_utime, before.last.expiry_utime);

  MotorBabbler free = restarted();
  EXPECT_FALSE(free.on_motion_status(status));
  EXPECT_TRUE(free.on_control_status(control(false)));

  MotorBabbler lent = restarted();
  EXPECT_FALSE(lent.on_control_status(control(true)));
  EXPECT_FALSE(lent.on_motion_status(status));
  EXPECT_FALSE(lent.on_tick(100 * kSecond));
  EXPECT_FALSE(lent.on_tick(200 * kSecond));
  EXPECT_FALSE(lent.on_sample(sample_of(before.last, 3)));  // its SAMPLE is there
  const auto next = lent.on_control_status(control(false));
  ASSERT_TRUE(next);
  EXPECT_EQ(next->action_id, before.last.action_id + 1);
  EXPECT_EQ(next->purpose, action_command_t::PURPOSE_TEST);

  EXPECT_THROW(MotorBabbler(test_config(), 2).restore(file), ConfigError);
  MotorBabblerConfig other = test_config();
  other.signals.pop_back();
  EXPECT_THROW(MotorBabbler(other, 1).restore(file), ConfigError);
  std::filesystem::remove(file);
}

TEST(MotorBabblerTest, BeforeItsFirstCommandThereIsNothingToKeep) {
  MotorBabbler babbler(test_config(), 1);
  babbler.on_model_health(bad_health(8));
  EXPECT_EQ(babbler.state_text(), "");
}

}  // namespace
}  // namespace bodyschema::test
