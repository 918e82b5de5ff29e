#pragma once

#include <cstdint>
#include <filesystem>
#include <functional>
#include <limits>
#include <optional>
#include <string>
#include <vector>

#include "bodyschema/body_schema_t.hpp"
#include "bodyschema/model_health_t.hpp"
#include "common/bus/sample_trail.h"

namespace bodyschema {

/// What the monitor cannot find again from the samples: accepted proposals and other verdicts.
struct MonitorMemory {
  /// Of the history, oldest first; the last one is the base, that the samples after its
  /// last_sample_index changed since. Empty before the first accepted proposal.
  std::vector<body_schema_t> schemas;
  /// After that sample: with the newest events. num_test_samples: those that had confirmed the
  /// base's tree (BaselineYouth); kOld of a base that is not young.
  model_health_t at_base{};
  static constexpr std::int32_t kOld = std::numeric_limits<std::int32_t>::max();
  /// The newest judged sample, and what was decided on proposals after the base's: events.
  /// schema_version: the first that told of changes that had been held back; 0: none.
  model_health_t verdicts{};

  bool operator==(const MonitorMemory& other) const;
};

/// The memory as a file, history.lcmlog: BODY_SCHEMA messages, two MODEL_HEALTH, and on
/// SAMPLES_CHECKSUM, as text, the marks of the samples that it rests on; replaced atomically
/// (temporary name, sync, rename).
class MemoryFile {
 public:
  /// Without a name nothing is kept.
  explicit MemoryFile(std::filesystem::path file) : file_(std::move(file)) {}

  using Objection = std::function<std::string(const body_schema_t&)>;
  /// std::nullopt if there is none that can be used: whole, without an `objection` to a schema, and
  /// resting on the samples in `samples_file`. See use_or_set_aside().
  std::optional<MonitorMemory> load(const Objection& objection,
                                    const std::filesystem::path& samples_file);
  bool rests_on_other_samples() const { return rests_on_other_samples_; }
  /// Of the samples that what was loaded rests on; none in a file from before there were any.
  const std::vector<SampleMark>& marks() const { return marks_; }
  /// Writes it unless it is what was written last. Returns "" or why it could not be written, for
  /// people; the next call tries again.
  std::string save(const MonitorMemory& memory, const std::vector<SampleMark>& marks);

 private:
  const std::filesystem::path file_;
  std::string saved_;
  std::vector<SampleMark> marks_;
  bool rests_on_other_samples_ = false;
};

}  // namespace bodyschema
