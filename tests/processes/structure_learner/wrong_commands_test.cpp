#include "processes/structure_learner/wrong_commands.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <numeric>
#include <vector>

#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::Rng;

// 30 Hz for 60 s; signal 1 rests but for three stretches of 70 frames.
TEST(WrongCommands, OutliersOfAStreamWhereARestingSignalMovesAreMotion) {
  std::vector<ActionPoseSample> samples(1800);
  std::vector<bool> moving(1800), wild(1800), elsewhere(1800);
  Rng rng(1);
  bool is_wild = false;
  for (int t = 0; t < 1800; ++t) {
    samples[t].utime = 33'333 * std::int64_t{t};
    const int phase = t % 600;
    const double moved = phase < 70 ? std::sin(M_PI * phase / 70) : 0;
    samples[t].action = Eigen::Vector2d(std::sin(0.02 * t), moved);
    if (t % 30 == 0) is_wild = test::uniform(rng, 0, 1) < 0.1;
    wild[t] = is_wild;
    moving[t] = moved > 0.1 || wild[t];
    elsewhere[t] = (phase >= 200 && phase < 270) || wild[t];
  }
  const NormalizedActions actions(samples, 2);
  ASSERT_TRUE(actions.blocks().is_stream());
  std::vector<int> all(1800);
  std::iota(all.begin(), all.end(), 0);
  EXPECT_TRUE(is_wrong_at_some_commands(all, moving, actions));
  EXPECT_FALSE(is_wrong_at_some_commands(all, elsewhere, actions));
  EXPECT_FALSE(is_wrong_at_some_commands(all, wild, actions));
  // What hides a tag while it moves once.
  std::vector<bool> once(1800);
  std::copy(moving.begin(), moving.begin() + 70, once.begin());
  for (int t = 600; t < 1800; ++t) samples[t].action(1) = 0;
  EXPECT_FALSE(is_wrong_at_some_commands(all, once, NormalizedActions(samples, 2)));
}

// 30 Hz for 60 s, all signals move: at a stop beyond a part of its range a joint stands still.
TEST(WrongCommands, OutliersAtNearlyAllVisitsToAStretchAreTheModelsFault) {
  constexpr int kFrames = 1800;
  std::vector<ActionPoseSample> samples(kFrames);
  std::vector<bool> beyond(kFrames), later(kFrames), once(kFrames), short_ones(kFrames);
  for (int t = 0; t < kFrames; ++t) {
    samples[t].utime = 33'333 * std::int64_t{t};
    const double x = 0.6 * std::sin(0.021 * t) + 0.4 * std::sin(0.033 * t + 1);
    samples[t].action = Eigen::Vector2d(std::sin(0.017 * t), x);
    beyond[t] = x > 0.62;
    short_ones[t] = beyond[t] && t % 3 == 0;
  }
  // As many and as long, but not when the signal is there.
  for (int t = 0; t < kFrames; ++t) later[t] = beyond[(t + 500) % kFrames];
  const auto first = std::find(beyond.begin(), beyond.end(), true);
  const auto end = std::find(first, beyond.end(), false);
  std::fill(once.begin() + (first - beyond.begin()), once.begin() + (end - beyond.begin()), true);

  const NormalizedActions actions(samples, 2);
  ASSERT_TRUE(actions.blocks().is_stream());
  std::vector<int> all(kFrames);
  std::iota(all.begin(), all.end(), 0);
  EXPECT_TRUE(is_wrong_at_some_commands(all, beyond, actions));
  EXPECT_FALSE(is_wrong_at_some_commands(all, later, actions));
  EXPECT_FALSE(is_wrong_at_some_commands(all, once, actions));
  EXPECT_FALSE(is_wrong_at_some_commands(all, short_ones, actions));
}

}  // namespace
}  // namespace bodyschema
