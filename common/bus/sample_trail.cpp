#include "common/bus/sample_trail.h"

#include <spdlog/fmt/fmt.h>

#include <algorithm>
#include <stdexcept>
#include <system_error>

#include "common/bus/event_log.h"

namespace bodyschema {

std::string SampleTrail::add(const sample_t& sample) {
  // The checksum before, then the sample's: so each costs its own length, however many there are.
  std::vector<std::uint8_t> bytes = encode(kSample, sample);
  const std::uint32_t before = marks_.empty() ? 0 : marks_.back().checksum;
  for (int shift = 0; shift < 32; shift += 8)
    bytes.push_back(static_cast<std::uint8_t>(before >> shift));
  const SampleMark mark{sample.sample_index, crc32c(bytes)};
  if (marks_.size() > 1) marks_.pop_back();
  marks_.push_back(mark);

  if (num_met_ == claimed_.size() || mark.sample_index < claimed_[num_met_].sample_index) return "";
  const SampleMark& claim = claimed_[num_met_++];
  if (mark == claim) return "";
  return fmt::format(
      "rests on other samples: sample {} or one before it is missing or is not what it was",
      claim.sample_index);
}

std::string contradiction(const std::filesystem::path& samples_file, std::int64_t newest,
                          const std::vector<SampleMark>& marks) {
  std::error_code none;
  if (!std::filesystem::exists(samples_file, none)) return "";
  SampleTrail trail(marks);
  std::string problem;
  try {
    LogReader reader(samples_file, OnDamage::kSkip);
    while (problem.empty() && reader.next()) {
      if (reader.event().channel != kSample.name) continue;
      const auto& data = reader.event().data;
      const auto sample = decode<sample_t>(data.data(), data.size()).message;
      if (sample && sample->sample_index > trail.newest()) problem = trail.add(*sample);
    }
  } catch (const std::runtime_error&) {
    return "";  // no log: the observer says so, and does not begin
  }
  const std::int64_t claimed = marks.empty() ? newest : std::max(newest, marks.back().sample_index);
  if (problem.empty() && trail.newest() < claimed)
    problem = fmt::format("rests on samples up to {}, the newest in {} is {}", claimed,
                          samples_file.filename().string(), trail.newest());
  return problem;
}

}  // namespace bodyschema
