#include "common/bus/sample_intake.h"

#include <spdlog/spdlog.h>

#include <filesystem>
#include <utility>

#include "common/bus/channels.h"
#include "common/bus/event_log.h"
#include "common/bus/process.h"

namespace bodyschema {
namespace {

constexpr std::int64_t kAskPeriodUs = 500'000;
constexpr int kMaxUnanswered = 10;
/// At 1 Hz this is sooner than any gap is given up.
constexpr int kMaxRepeats = 3;
constexpr std::size_t kMaxAhead = 1'000;

/// Which action it is a sample of, and when: two samples of one index that agree in that are one.
std::size_t identity(const sample_t& sample) {
  return std::hash<std::string>()(
      fmt::format("{} {} {} {}", sample.source, sample.epoch, sample.action_id, sample.utime));
}

}  // namespace

SampleIntake::Ask SampleIntake::asking(Process& process, bool has_observer) {
  if (process.bus().is_replay() || !has_observer) return nullptr;
  return [&process](sample_request_t request) {
    request.process_name = process.name();
    process.bus().publish(kSampleRequest, request);
  };
}

SampleIntake::SampleIntake(std::string samples_file, Handler handler, Ask ask)
    : samples_file_(std::move(samples_file)), handler_(std::move(handler)), ask_(std::move(ask)) {
  catch_up();
}

void SampleIntake::catch_up() {
  bool is_read = false;
  while (!is_read && ahead_.size() < kMaxAhead) {
    is_read = read_file();
    hand_on();
  }
}

/// Goes on where it ended the last time. False: there is more, for which there is no room yet.
bool SampleIntake::read_file() {
  std::error_code none;
  const auto size = static_cast<std::int64_t>(std::filesystem::file_size(samples_file_, none));
  if (none || size == size_read_) return true;
  if (size < position_) position_ = 0;  // it was replaced
  size_read_ = size;
  try {
    LogReader reader(samples_file_, OnDamage::kSkip, position_);
    while (reader.next()) {
      position_ = reader.position();
      if (reader.event().channel != kSample.name) continue;
      const auto& data = reader.event().data;
      if (const auto sample = decode<sample_t>(data.data(), data.size()).message) take(*sample);
      while (hand_on_next()) continue;
      if (ahead_.size() < kMaxAhead) continue;
      size_read_ = 0;
      return false;
    }
  } catch (const std::runtime_error& error) {
    spdlog::warn("{}; the observer is asked instead", error.what());
  }
  return true;
}

void SampleIntake::on_sample(const sample_t& sample) {
  take(sample);
  is_observer_heard_ |= !ahead_.empty() && sample.sample_index >= ahead_.begin()->first;
  if (sample.sample_index > next_index_) catch_up();
  // The observer says again and again that this is its newest: what seemed to come after it is not
  // the observer's.
  if (sample.sample_index == next_index_ - 1 && !ahead_.empty() && ++num_repeats_ >= kMaxRepeats) {
    counters_["conflicting SAMPLE"] += static_cast<std::int64_t>(ahead_.size());
    ahead_.clear();
    num_unanswered_ = num_repeats_ = 0;
  }
  hand_on();
  if (ahead_.size() > kMaxAhead) ahead_.erase(std::prev(ahead_.end()));  // asked for in due course
}

void SampleIntake::take(const sample_t& sample) {
  if (sample.sample_index >= next_index_) {
    ahead_.try_emplace(sample.sample_index, sample);
    return;
  }
  const auto known = known_.find(sample.sample_index);
  if (known == known_.end() || known->second == identity(sample)) return;
  is_begun_anew_ = true;
  if (++counters_["conflicting SAMPLE"] > 1) return;
  spdlog::warn("SAMPLE {} is not the one that was heard before", sample.sample_index);
}

bool SampleIntake::hand_on_next() {
  if (ahead_.empty() || ahead_.begin()->first > next_index_) return false;
  const sample_t sample = std::move(ahead_.extract(ahead_.begin()).mapped());
  if (sample.sample_index < next_index_) return true;  // the file had filled the gap
  next_index_ = sample.sample_index + 1;
  known_[sample.sample_index] = identity(sample);
  num_unanswered_ = num_repeats_ = 0;
  handler_(sample);
  return true;
}

void SampleIntake::hand_on() {
  while (true) {
    while (hand_on_next()) continue;
    if (ahead_.empty() || ask_) return;
    give_up_gap();
  }
}

void SampleIntake::give_up_gap() {
  const std::int64_t first = ahead_.begin()->first;
  spdlog::warn("lost SAMPLE {}…{}: {}", next_index_, first - 1,
               ask_ ? "the observer does not have them" : "the recording does not have them");
  counters_["lost SAMPLE"] += first - next_index_;
  lost_.emplace_back(next_index_, first - 1);
  next_index_ = first;
}

void SampleIntake::on_tick(std::int64_t now_us) {
  if (ahead_.empty() || (asked_us_ >= 0 && now_us - asked_us_ < kAskPeriodUs)) return;
  asked_us_ = now_us;
  if (std::exchange(is_observer_heard_, false) && ++num_unanswered_ > kMaxUnanswered) {
    give_up_gap();
    hand_on();
    catch_up();
    return;
  }
  sample_request_t request{};
  request.utime = now_us;
  request.first_missing = next_index_;
  request.last_missing = ahead_.begin()->first - 1;
  ask_(request);
}

std::string SampleIntake::activity() const {
  if (!ahead_.empty()) {
    return fmt::format("waits for SAMPLE {} to {}, which the observer is asked for", next_index_,
                       ahead_.begin()->first - 1);
  }
  if (is_begun_anew_) {
    return "hears of other samples than before: the observer has begun anew; start this process "
           "again too";
  }
  return "";
}

}  // namespace bodyschema
