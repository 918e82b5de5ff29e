#pragma once

#include <cstdint>
#include <deque>
#include <filesystem>
#include <functional>
#include <optional>
#include <vector>

#include "bodyschema/body_schema_t.hpp"
#include "bodyschema/sample_t.hpp"
#include "common/config/rig.h"
#include "processes/structure_learner/online_learner.h"

namespace bodyschema {

struct StructureLearnerConfig {
  std::vector<Signal> signals;
  LearnOptions options;

  /// Reads structure_learner.yaml, and beside it signals.yaml and, for the parts there are,
  /// markers.yaml. @throws ConfigError.
  static StructureLearnerConfig load(const std::filesystem::path& file);
};

/// Collects TRAIN and PROBE samples and turns them into a proposal, LEARNED_SCHEMA. The proposal
/// after sample n is a pure function of the samples 0..n (see OnlineLearner): which prefixes were
/// skipped while a fit was running, and what was prepared, does not matter. TEST samples are
/// never learned from; they only advance last_sample_index, so that the monitor can judge.
///
/// Where the monitor found that the body changed, the samples of the body before are left out: the
/// proposal after sample n rests on those since the change that was known at sample n. What rests
/// on tags that had moved on their parts is left out likewise.
///
/// A training sample is answered by the structure found before it came, a TEST sample by one that
/// the samples so far may change: in the time that the arm takes to move, both were prepared.
///
/// It learns from the retained set of the body's samples (RetainedSamples): memory, and what a
/// sample costs, stay the same however long the run. A prefix that waited while kMaxLag more
/// samples came is given up, which no fit is slow enough for.
///
/// Before the first sample there is no proposal; when samples stop, the last proposal stands.
class StructureLearner {
 public:
  explicit StructureLearner(StructureLearnerConfig config);

  /// Samples in order of sample_index; one that is not newer than the last is ignored.
  /// @throws std::invalid_argument if the action does not have one value per signal.
  void on_sample(const sample_t& sample);

  /// BODY_SCHEMA, for the changes of the body that the monitor found.
  void on_body_schema(const body_schema_t& schema);

  std::int64_t last_sample_index() const { return last_sample_index_; }
  /// True if there is a prefix of the samples to learn from that was not given out yet.
  bool has_job() const { return !pending_.empty(); }
  /// The same for a prefix that ends with a TEST sample.
  bool has_test_job() const { return has_job() && pending_.front().is_test; }
  /// The last sample of that prefix.
  std::int64_t next_sample_index() const { return pending_.front().last_sample_index; }
  /// The fit of the next prefix, on a copy, to be run in any thread. Prefixes that end with a TEST
  /// sample come in order and none is left out that was not judged; of the others only the newest
  /// waits. There must be one.
  std::function<body_schema_t()> take_job();
  /// Leaves out the prefixes that the monitor judged already, as there are after a restart; no
  /// proposal depends on one before it. Never the newest, which is repeated.
  void skip_judged(std::int64_t judged_sample);

  /// Idle time can make the next job short: to be run, in any thread, when there is no job; asked
  /// once a training sample.
  std::function<void()> take_preparation();
  bool has_preparation() const { return has_new_; }

 private:
  /// The samples 0..last_sample_index.
  struct Prefix {
    std::int64_t last_sample_index = 0;
    std::int64_t utime = 0;
    bool is_test = false;
  };

  /// The retained training samples up to this one, of the body as it was known after it, without
  /// what rests on moved tags; online_ is for them.
  SharedSamples of_this_body(std::int64_t sample_index);

  const StructureLearnerConfig config_;
  std::shared_ptr<OnlineLearner> online_;
  std::int64_t online_since_ = 0, online_stride_ = 1;
  std::vector<MovedTag> online_moved_;
  BodySchema known_;         ///< for its changes and moved tags
  RetainedSamples samples_;  ///< TRAIN and PROBE
  bool has_new_ = false;     ///< since the last preparation
  std::int64_t last_sample_index_ = -1;
  std::deque<Prefix> pending_;
};

}  // namespace bodyschema
