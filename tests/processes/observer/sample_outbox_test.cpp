#include "processes/observer/sample_outbox.h"

#include <gtest/gtest.h>

#include <cmath>
#include <fstream>
#include <optional>

#include "tests/support/temporary_folder.h"

namespace bodyschema {
namespace {

constexpr std::int64_t kSecond = 1'000'000;

sample_t sample(std::int64_t index) {
  sample_t message{};
  message.utime = 1000 * index;
  message.sample_index = index;
  message.source = "motor_babbler";
  message.action_id = index;
  return message;
}

sample_request_t request(std::int64_t first, std::int64_t last) {
  sample_request_t message{};
  message.process_name = "test";
  message.first_missing = first;
  message.last_missing = last;
  return message;
}

class SampleOutboxTest : public testing::Test {
 protected:
  using Indices = std::vector<std::int64_t>;

  SampleOutbox& start() {
    outbox_.reset();
    outbox_.emplace(file_, [this](const sample_t& message) {
      sent_.push_back(message.sample_index);
      EXPECT_EQ(message.utime, 1000 * message.sample_index);
    });
    return *outbox_;
  }
  Indices recorded() const {
    Indices indices;
    for (const sample_t& message : read_log(file_, kSample))
      indices.push_back(message.sample_index);
    return indices;
  }
  /// Samples that a restart delivers.
  Indices kept() const {
    Indices indices;
    outbox_->for_each_recorded(
        [&](const sample_t& message) { indices.push_back(message.sample_index); });
    return indices;
  }
  Indices take_sent() { return std::exchange(sent_, {}); }
  /// Ticks of 100 ms over `seconds`.
  void tick_for(double seconds) {
    for (const std::int64_t end = now_us_ + std::llround(seconds * kSecond); now_us_ < end;) {
      outbox_->on_tick(now_us_ += kSecond / 10);
    }
  }

  test::TemporaryFolder folder_;
  std::filesystem::path file_ = folder_ / "samples.lcmlog";
  std::optional<SampleOutbox> outbox_;
  Indices sent_;
  std::int64_t now_us_ = 1'700'000'000 * kSecond;
};

TEST_F(SampleOutboxTest, ASampleIsOnDiskBeforeItIsSent) {
  std::optional<SampleOutbox> outbox;
  int num_sent = 0;
  outbox.emplace(file_, [&](const sample_t& message) {
    ++num_sent;
    EXPECT_EQ(recorded().back(), message.sample_index);
  });
  outbox->send(sample(0));
  outbox->send(sample(1));
  EXPECT_EQ(num_sent, 2);
}

TEST_F(SampleOutboxTest, TheNewestIsRepeatedAtOneHertzAlsoAfterARestart) {
  start();
  tick_for(3);
  EXPECT_EQ(take_sent(), Indices{});
  outbox_->send(sample(0));
  outbox_->send(sample(1));
  EXPECT_EQ(take_sent(), (Indices{0, 1}));
  tick_for(3.2);
  EXPECT_EQ(take_sent(), (Indices{1, 1, 1}));
  // A sample that a kill left on disk unsent is sent at once.
  start();
  tick_for(0.1);
  EXPECT_EQ(take_sent(), (Indices{1}));
  EXPECT_EQ(kept(), (Indices{0, 1}));
}

TEST_F(SampleOutboxTest, WhatIsAskedForIsSentAgainALittleAtATime) {
  start();
  for (std::int64_t i = 0; i < 200; ++i) outbox_->send(sample(i));
  take_sent();
  outbox_->on_request(request(3, 5));
  outbox_->on_request(request(4, 6));  // of another process, at the same time
  outbox_->on_tick(now_us_ += kSecond / 10);
  EXPECT_EQ(take_sent(), (Indices{3, 4, 5, 6}));
  // Any number of requests gets 50 samples together, 25 per tick.
  for (int n = 0; n < 1000; ++n) outbox_->on_request(request(0, INT64_MAX));
  outbox_->on_tick(now_us_ += kSecond / 10);
  EXPECT_EQ(sent_.size(), 25U);
  tick_for(0.3);
  EXPECT_EQ(sent_.size(), 50U);
  EXPECT_EQ(outbox_->counters().at("sent again SAMPLE"), 54);
}

TEST_F(SampleOutboxTest, WhatItDoesNotHaveIsNotSent) {
  start();
  outbox_->send(sample(7));
  take_sent();
  outbox_->on_request(request(0, 6));
  outbox_->on_request(request(8, 99));
  tick_for(0.5);
  EXPECT_EQ(take_sent(), Indices{});
  // The log was deleted while it was open.
  outbox_->on_request(request(7, 7));
  std::filesystem::remove(file_);
  EXPECT_NO_THROW(tick_for(0.2));
  EXPECT_EQ(take_sent(), Indices{});
}

TEST_F(SampleOutboxTest, ATornTailIsCutOffAtAnyByteAndWhatFollowsCanBeRead) {
  start();
  outbox_->send(sample(0));
  const auto one = std::filesystem::file_size(file_);
  outbox_->send(sample(1));
  const auto two = std::filesystem::file_size(file_);
  for (auto size = one + 1; size < two; ++size) {
    outbox_.reset();
    std::filesystem::resize_file(file_, size);
    start();
    EXPECT_EQ(kept(), Indices{0});
    outbox_->send(sample(1));
    ASSERT_EQ(recorded(), (Indices{0, 1})) << "cut at byte " << size;
  }
}

TEST_F(SampleOutboxTest, OfADamagedLogAllThatCanBeReadIsKeptAndTheWholeSetAside) {
  start();
  for (std::int64_t i = 0; i < 5; ++i) outbox_->send(sample(i));
  outbox_.reset();
  const auto size = std::filesystem::file_size(file_);
  std::fstream(file_, std::ios::in | std::ios::out | std::ios::binary)
      .seekp(static_cast<std::streamoff>(size / 5 * 2 + 22))
      .write("damage", 6);
  take_sent();
  start();
  EXPECT_EQ(recorded(), (Indices{0, 1, 3, 4}));
  EXPECT_EQ(std::filesystem::file_size(file_.string() + ".bad-1"), size);
  EXPECT_GT(outbox_->counters().at("damaged bytes of samples.lcmlog"), 0);
  outbox_->send(sample(5));
  outbox_->on_request(request(0, 9));
  tick_for(0.2);
  EXPECT_EQ(take_sent(), (Indices{5, 0, 1, 3, 4, 5}));
}

TEST_F(SampleOutboxTest, ASecondOneDoesNotRepairTheFileUnderTheFirst) {
  start();
  for (std::int64_t i = 0; i < 5; ++i) outbox_->send(sample(i));
  const auto size = std::filesystem::file_size(file_);
  std::fstream(file_, std::ios::in | std::ios::out | std::ios::binary)
      .seekp(static_cast<std::streamoff>(size / 5 * 2 + 22))
      .write("damage", 6);
  EXPECT_THROW(SampleOutbox(file_, [](const sample_t&) {}), std::runtime_error);
  EXPECT_FALSE(std::filesystem::exists(file_.string() + ".bad-1"));
  EXPECT_EQ(std::filesystem::file_size(file_), size);
  outbox_->send(sample(5));
  EXPECT_EQ(std::filesystem::file_size(file_), size / 5 * 6) << "it writes another file";
}

TEST_F(SampleOutboxTest, WithoutAFileTheNewestIsRepeated) {
  file_.clear();
  start();
  outbox_->send(sample(0));
  outbox_->on_request(request(0, 0));
  tick_for(1.5);
  EXPECT_EQ(take_sent(), (Indices{0, 0}));
  EXPECT_TRUE(kept().empty());
}

}  // namespace
}  // namespace bodyschema
