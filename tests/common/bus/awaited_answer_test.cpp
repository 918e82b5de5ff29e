#include "common/bus/awaited_answer.h"

#include <gtest/gtest.h>

namespace bodyschema {
namespace {

constexpr std::int64_t kSecond = 1'000'000, kNow = 1'700'000'000 * kSecond;

TEST(AwaitedAnswerTest, WaitsFromTheQuestionToTheAnswerToItOrToALaterOne) {
  AwaitedAnswer answer(true, 10 * kSecond);
  EXPECT_FALSE(answer.is_waiting());
  answer.ask(4);
  EXPECT_TRUE(answer.is_waiting());
  answer.answer(3);
  EXPECT_TRUE(answer.is_waiting());
  answer.answer(4);
  EXPECT_FALSE(answer.is_waiting());
  answer.ask(9);
  answer.answer(14);  // the answer to 9 was lost
  EXPECT_FALSE(answer.is_waiting());
  answer.ask(14);
  EXPECT_FALSE(answer.is_waiting());
}

TEST(AwaitedAnswerTest, GoesOnWithoutAfterATimeoutUntilOneIsHeardAgain) {
  AwaitedAnswer answer(true, 10 * kSecond);
  answer.ask(4);
  EXPECT_FALSE(answer.on_tick(kNow));  // from the first tick on
  EXPECT_FALSE(answer.on_tick(kNow + 10 * kSecond));
  EXPECT_TRUE(answer.is_waiting());
  EXPECT_TRUE(answer.on_tick(kNow + 11 * kSecond));
  EXPECT_FALSE(answer.on_tick(kNow + 12 * kSecond));  // said once
  EXPECT_FALSE(answer.is_waiting());
  answer.ask(9);
  EXPECT_FALSE(answer.is_waiting());
  answer.answer(9);
  answer.ask(14);
  EXPECT_TRUE(answer.is_waiting());
  EXPECT_FALSE(answer.on_tick(kNow + 30 * kSecond));  // its own time
}

TEST(AwaitedAnswerTest, NeverWaitsWhereItIsNotAwaited) {
  AwaitedAnswer answer(false, 10 * kSecond);
  answer.ask(4);
  EXPECT_FALSE(answer.is_waiting());
  answer.answer(2);
  EXPECT_FALSE(answer.is_waiting());
  EXPECT_FALSE(answer.on_tick(kNow));
}

}  // namespace
}  // namespace bodyschema
