#pragma once

#include <cstdint>

namespace bodyschema {

/// Waits for another process' answers to numbered questions, as learner and monitor do for each
/// other's in a replay, where nobody else waits for them, and the monitor always for the refiner's.
/// After a timeout it no longer waits, until an answer is heard again. Answers come in order: one
/// to a later question answers all before it.
class AwaitedAnswer {
 public:
  AwaitedAnswer(bool is_awaited, std::int64_t timeout_us)
      : is_awaited_(is_awaited), is_heard_(is_awaited), timeout_us_(timeout_us) {}

  void ask(std::int64_t question) {
    question_ = question;
    asked_us_ = -1;
  }
  void answer(std::int64_t question) {
    if (question <= answered_) return;
    answered_ = question;
    is_heard_ = is_awaited_;
  }
  /// Returns true if the answer is given up now.
  bool on_tick(std::int64_t now_us) {
    if (!is_waiting()) return false;
    if (asked_us_ < 0) asked_us_ = now_us;
    if (now_us - asked_us_ <= timeout_us_) return false;
    is_heard_ = false;
    return true;
  }
  bool is_waiting() const { return is_heard_ && answered_ < question_; }
  std::int64_t question() const { return question_; }

 private:
  const bool is_awaited_;
  bool is_heard_;
  const std::int64_t timeout_us_;
  std::int64_t question_ = -1, answered_ = -1, asked_us_ = -1;
};

}  // namespace bodyschema
