#pragma once

#include <algorithm>
#include <cstdint>
#include <deque>
#include <functional>
#include <map>
#include <optional>
#include <string>

#include "bodyschema/body_schema_t.hpp"
#include "bodyschema/sample_t.hpp"
#include "common/config/refinement_schedule.h"
#include "common/schema/retained_samples.h"
#include "processes/refiner/refiner_settings.h"

namespace bodyschema {

/// A proposal of the learner after refine().
struct RefinedProposal {
  body_schema_t learned;
  std::optional<Refinement> refinement;
  std::string problem;  ///< why there is no refinement, for people

  /// The corners of TEST samples are predicted better than by the proposal and the rig's files:
  /// predicts_corners_better().
  bool is_better() const;
  /// REFINED_SCHEMA: the refined schema where that is better, else the proposal as it was; and the
  /// actions that the refinement wants.
  body_schema_t answer() const;
};

/// Collects samples and refines the learner's complete proposals on the TEST samples of
/// RefinementSchedule. The refinement is a pure function of
/// the proposal and of the samples up to its last, those of the retained set (Retained).
class Refiner {
 public:
  explicit Refiner(RefinerSettings settings);

  /// Samples in order of sample_index; one that is not newer than the last is ignored.
  void on_sample(const sample_t& sample);
  /// A proposal that is ahead of the samples waits for them.
  void on_learned_schema(const body_schema_t& proposal);
  /// Proposals up to this sample are not refined: an earlier process did it.
  void skip(std::int64_t sample_index) { taken_ = std::max(taken_, sample_index); }

  bool has_job() const { return !jobs_.empty(); }
  /// The next refinement, to be run in any thread. There must be one.
  std::function<RefinedProposal()> take_job();
  /// Of several that wait only the newest is wanted.
  void drop_older_jobs();

  const RefinerSettings& settings() const { return settings_; }

 private:
  void match();

  const RefinerSettings settings_;
  Retained<RefinerSample> samples_;
  std::int64_t last_sample_index_ = -1;
  RefinementSchedule schedule_;
  std::deque<std::int64_t> due_;
  std::map<std::int64_t, body_schema_t> proposals_;  ///< complete, without a job; the newest
  std::deque<body_schema_t> jobs_;
  std::int64_t taken_ = -1;
};

}  // namespace bodyschema
