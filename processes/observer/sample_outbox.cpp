#include "processes/observer/sample_outbox.h"

#include <spdlog/spdlog.h>

#include <algorithm>
#include <utility>

#include "common/bus/channels.h"

namespace bodyschema {
namespace {

constexpr std::int64_t kSecond = 1'000'000;
constexpr std::size_t kMaxWanted = 50;
/// A tick: 100 ms.
constexpr std::size_t kMaxPerTick = 25;

bool is_damaged(const std::filesystem::path& file) {
  std::error_code none;
  if (std::filesystem::file_size(file, none) == 0 || none) return false;
  LogReport report;
  read_log(file, kSample, &report, OnDamage::kSkip);
  return report.damaged_bytes > 0;
}

}  // namespace

SampleOutbox::SampleOutbox(std::filesystem::path file, Publish publish)
    : file_(std::move(file)), publish_(std::move(publish)) {
  if (!file_.empty()) open();
}

void SampleOutbox::open() {
  std::error_code none;
  // A second observer, started by mistake, must not replace the file of the first. Held until the
  // new file is locked itself.
  std::optional<LogLock> repair;
  if (is_damaged(file_)) repair.emplace(file_);
  if (repair && std::filesystem::file_size(file_, none) > 0 && !none) {
    LogReport report;
    const auto readable = read_log(file_, kSample, &report, OnDamage::kSkip);
    if (report.damaged_bytes > 0) {
      const std::filesystem::path aside = copy_aside(file_);
      std::string text;
      std::int64_t number = 0;
      for (const sample_t& sample : readable) {
        const auto event =
            encode_event(kSample.name, encode(kSample, sample), sample.utime, number++);
        text.append(event.begin(), event.end());
      }
      write_file_atomically(file_, text);
      counters_["damaged bytes of samples.lcmlog"] += report.damaged_bytes;
      spdlog::warn(
          "{}: {} bytes are damaged; the {} samples that can be read are kept, the whole is in {}",
          file_.string(), report.damaged_bytes, readable.size(), aside.string());
    }
  }
  log_.emplace(file_);
  if (const auto byte = log_->found().truncated_at_byte) {
    spdlog::warn("{}: ended in the middle of an event; cut back to the {} before byte {}",
                 file_.string(), log_->found().events, *byte);
  }
  LogReader reader(file_);
  for (std::int64_t position = 0; reader.next(); position = reader.position()) {
    if (reader.event().channel != kSample.name) continue;
    const auto& data = reader.event().data;
    const auto sample = decode<sample_t>(data.data(), data.size()).message;
    if (!sample || !positions_.try_emplace(sample->sample_index, position).second) continue;
    if (!newest_ || sample->sample_index > newest_->sample_index) newest_ = sample;
  }
}

void SampleOutbox::for_each_recorded(const std::function<void(const sample_t&)>& visit) const {
  if (!log_) return;
  LogReader reader(file_);
  for (const auto& [index, position] : positions_) {
    if (reader.position() != position) reader.seek(position);
    if (!reader.next()) continue;
    const auto& data = reader.event().data;
    if (const auto sample = decode<sample_t>(data.data(), data.size()).message) visit(*sample);
  }
}

void SampleOutbox::send(const sample_t& sample) {
  held_.push_back(sample);
  if (problem_.empty()) flush();
  if (!held_.empty()) ++counters_["held SAMPLE"];
}

void SampleOutbox::flush() {
  while (!held_.empty()) {
    const sample_t& sample = held_.front();
    try {
      if (log_) {
        const std::int64_t position = log_->position();
        log_->append(kSample, sample);
        positions_[sample.sample_index] = position;
      }
    } catch (const std::runtime_error& error) {
      if (problem_.empty()) spdlog::warn("{}; tried again every second", error.what());
      problem_ = error.what();
      return;
    }
    if (!problem_.empty()) spdlog::info("{}: can be written again", file_.string());
    problem_.clear();
    newest_ = sample;
    held_.pop_front();
    is_newest_sent_ = true;
    publish_(*newest_);
  }
}

void SampleOutbox::on_request(const sample_request_t& request) {
  auto next = positions_.lower_bound(request.first_missing);
  for (; next != positions_.end() && next->first <= request.last_missing; ++next) {
    if (wanted_.size() >= kMaxWanted) return;
    wanted_.insert(next->first);
  }
}

void SampleOutbox::send_again() {
  if (wanted_.empty()) return;
  try {
    LogReader reader(file_);
    for (std::size_t n = 0; n < kMaxPerTick && !wanted_.empty(); ++n) {
      const std::int64_t index = *wanted_.begin();
      wanted_.erase(wanted_.begin());
      reader.seek(positions_.at(index));
      if (!reader.next()) continue;
      const auto& data = reader.event().data;
      const auto sample = decode<sample_t>(data.data(), data.size()).message;
      if (!sample || sample->sample_index != index) continue;
      publish_(*sample);
      ++counters_["sent again SAMPLE"];
    }
  } catch (const std::runtime_error& error) {
    // The asking process gives up in the end and says so.
    if (++counters_["unreadable SAMPLE"] == 1) spdlog::warn("{}", error.what());
  }
}

void SampleOutbox::on_tick(std::int64_t now_us) {
  if (!problem_.empty() && now_us - tried_us_ >= kSecond) {
    tried_us_ = now_us;
    flush();
  }
  send_again();
  if (std::exchange(is_newest_sent_, false)) sent_us_ = now_us;
  if (!newest_ || now_us - sent_us_ < kSecond) return;
  sent_us_ = now_us;
  publish_(*newest_);
}

std::string SampleOutbox::problem() const {
  return held_.empty() ? "" : std::to_string(held_.size()) + " samples are held back: " + problem_;
}

}  // namespace bodyschema
