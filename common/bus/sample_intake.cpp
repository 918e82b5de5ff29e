#include "common/bus/sample_intake.h"

#include <spdlog/spdlog.h>
#include <sys/stat.h>

#include <algorithm>
#include <optional>
#include <stdexcept>
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

/// Identity of a sample's action: two samples of one index that agree in it are the same.
std::size_t identity(const sample_t& sample) {
  return std::hash<std::string>()(
      fmt::format("{} {} {} {}", sample.source, sample.epoch, sample.action_id, sample.utime));
}

}  // namespace

void SampleIntake::Options::add_to(Arguments app) {
  app.add_option("--samples", samples_file, "The observer's samples.lcmlog, read at start");
  app.add_flag("--replayed", is_replayed,
               "The samples are a recording's and no observer runs: what is missing is given up");
}

SampleIntake::Ask SampleIntake::asking(Process& process, bool has_observer) {
  if (process.bus().is_replay() || !has_observer) return nullptr;
  return [&process](sample_request_t request) {
    request.process_name = process.name();
    process.bus().publish(kSampleRequest, request);
  };
}

SampleIntake::SampleIntake(std::string samples_file, Handler handler, Ask ask)
    : samples_file_(std::move(samples_file)), handler_(std::move(handler)), ask_(std::move(ask)) {
  read_file();
  hand_on(!ask_);
}

bool SampleIntake::is_recorded_here() const { return ask_ && file_id_ != 0; }

void SampleIntake::read_file() {
  struct stat status {};
  if (samples_file_.empty() || ::stat(samples_file_.c_str(), &status) != 0) return;
  const auto size = static_cast<std::int64_t>(status.st_size);
  // Replaced as a whole where it was damaged.
  const bool is_another = std::exchange(file_id_, status.st_ino) != status.st_ino;
  if (is_another || size < size_read_) size_read_ = position_ = 0;
  if (size == std::exchange(size_read_, size)) return;
  const auto or_warn = [&](const auto& act) {
    try {
      return act();
    } catch (const std::runtime_error& error) {
      spdlog::warn("{}; the observer is asked instead", error.what());
      return false;
    }
  };
  std::optional<LogReader> reader;
  if (!or_warn([&] { return reader.emplace(samples_file_, OnDamage::kSkip, position_), true; }))
    return;
  while (or_warn([&] { return reader->next(); })) {
    position_ = reader->position();
    if (reader->event().channel != kSample.name) continue;
    const auto& data = reader->event().data;
    const auto sample = decode<sample_t>(data.data(), data.size()).message;
    if (!sample) continue;
    newest_recorded_ = std::max(newest_recorded_, sample->sample_index);
    is_begun_anew_ |= take(*sample) == Taken::kConflicting;
    hand_on(false);
  }
  position_ = reader->position();
  if (!reader->report().damaged_at_byte) return;
  counters_["damaged bytes of samples.lcmlog"] += reader->report().damaged_bytes;
  spdlog::warn("{}: {}", samples_file_, reader->report().damage);
}

bool SampleIntake::on_sample(const sample_t& sample) {
  const std::int64_t index = sample.sample_index;
  if (index > next_index_ || (ask_ && index == next_index_)) read_file();
  if (is_recorded_here() && index > newest_recorded_) {
    if (++counters_["unrecorded SAMPLE"] == 1) {
      spdlog::warn("SAMPLE {} is refused: it is not in {} (further ones are only counted)", index,
                   samples_file_);
    }
    return false;
  }
  const Taken taken = take(sample);
  if (taken == Taken::kConflicting) is_begun_anew_ |= !is_recorded_here() && index < next_index_;
  if (taken == Taken::kConflicting || taken == Taken::kTooLate) return false;
  is_observer_heard_ |= !ahead_.empty() && index >= ahead_.begin()->first;
  // The observer has reported its newest index again and again: a sample that seemed to come after
  // it is not the observer's.
  if (index == next_index_ - 1 && !ahead_.empty() && ++num_repeats_ >= kMaxRepeats) {
    counters_["conflicting SAMPLE"] += static_cast<std::int64_t>(ahead_.size());
    ahead_.clear();
    num_unanswered_ = num_repeats_ = 0;
  }
  hand_on(!ask_);
  if (ahead_.size() > kMaxAhead) ahead_.erase(std::prev(ahead_.end()));  // asked for in due course
  return true;
}

SampleIntake::Taken SampleIntake::take(const sample_t& sample) {
  const std::int64_t index = sample.sample_index;
  bool is_same = false;
  if (index >= next_index_) {
    const auto [place, is_new] = ahead_.try_emplace(index, sample);
    if (is_new) return Taken::kNew;
    is_same = identity(place->second) == identity(sample);
  } else {
    const auto known = known_.find(index);
    if (known == known_.end()) return Taken::kTooLate;  // its gap was given up
    is_same = known->second == identity(sample);
  }
  if (is_same) return Taken::kRepeated;
  if (++counters_["conflicting SAMPLE"] == 1)
    spdlog::warn("SAMPLE {} is not the one that was heard before", index);
  return Taken::kConflicting;
}

void SampleIntake::hand_on(bool over_gaps) {
  while (!ahead_.empty()) {
    if (ahead_.begin()->first > next_index_) {
      if (!over_gaps) return;
      give_up_gap();
    }
    const sample_t sample = std::move(ahead_.extract(ahead_.begin()).mapped());
    next_index_ = sample.sample_index + 1;
    known_[sample.sample_index] = identity(sample);
    num_unanswered_ = num_repeats_ = 0;
    handler_(sample);
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
    hand_on(false);
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
