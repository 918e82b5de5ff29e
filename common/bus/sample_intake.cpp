#include "common/bus/sample_intake.h"

#include <filesystem>

#include "common/bus/channels.h"
#include "common/bus/event_log.h"

namespace bodyschema {
namespace {

constexpr std::int64_t kQuietUs = 2'000'000;

}  // namespace

SampleIntake::SampleIntake(std::string samples_file, std::function<void(const sample_t&)> handler)
    : samples_file_(std::move(samples_file)), handler_(std::move(handler)) {
  read_log();
}

void SampleIntake::read_log() {
  if (samples_file_.empty() || !std::filesystem::exists(samples_file_)) return;
  size_read_ = std::filesystem::file_size(samples_file_);
  for (const sample_t& sample : bodyschema::read_log(samples_file_, kSample)) hand_on(sample);
}

void SampleIntake::on_tick(std::int64_t now_us) {
  if (!is_quiet_) quiet_since_us_ = now_us;
  is_quiet_ = true;
  if (now_us - quiet_since_us_ < kQuietUs || samples_file_.empty()) return;
  std::error_code none;
  if (std::filesystem::file_size(samples_file_, none) != size_read_ && !none) read_log();
}

void SampleIntake::on_sample(const sample_t& sample) {
  is_quiet_ = false;
  if (sample.sample_index > next_index_) read_log();
  hand_on(sample);
}

void SampleIntake::hand_on(const sample_t& sample) {
  if (sample.sample_index < next_index_) return;
  num_lost_ += sample.sample_index - next_index_;
  next_index_ = sample.sample_index + 1;
  handler_(sample);
}

}  // namespace bodyschema
