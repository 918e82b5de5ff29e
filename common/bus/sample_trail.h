#pragma once

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <string>
#include <utility>
#include <vector>

#include "bodyschema/sample_t.hpp"

namespace bodyschema {

/// A running checksum of all samples up to one, in their order.
struct SampleMark {
  std::int64_t sample_index = -1;
  std::uint32_t checksum = 0;
  bool operator==(const SampleMark&) const = default;
};

/// Follows the samples that a memory rests on, so that a memory and samples that do not belong
/// together (another run's, or fewer) are noticed at the next start. Costs the same for every
/// sample.
class SampleTrail {
 public:
  /// `claimed`: marks that these samples must have, ascending.
  explicit SampleTrail(std::vector<SampleMark> claimed = {}) : claimed_(std::move(claimed)) {}

  /// "" or how the samples contradict what is claimed of them, for people.
  std::string add(const sample_t& sample);
  /// Of the first sample and the newest: another run is noticed at its first. What is claimed, as
  /// long as the samples have not come so far.
  const std::vector<SampleMark>& marks() const {
    return num_met_ < claimed_.size() ? claimed_ : marks_;
  }
  std::int64_t newest() const { return marks_.empty() ? -1 : marks_.back().sample_index; }

 private:
  std::vector<SampleMark> claimed_;
  std::size_t num_met_ = 0;  ///< of claimed_
  std::vector<SampleMark> marks_;
};

/// "" or why what rests on the samples up to `newest`, with these marks, does not follow from those
/// in the file, for people. Where there is no file nothing is known of it yet.
std::string contradiction(const std::filesystem::path& samples_file, std::int64_t newest,
                          const std::vector<SampleMark>& marks);

}  // namespace bodyschema
