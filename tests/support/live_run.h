#pragma once

#include <optional>
#include <vector>

#include "bodyschema/health_event_t.hpp"
#include "bodyschema/sample_t.hpp"
#include "common/schema/body_schema.h"
#include "processes/model_monitor/model_monitor.h"
#include "processes/structure_learner/structure_learner.h"

namespace bodyschema::test {

/// Last outputs of learner and monitor.
struct LiveRun {
  std::optional<BodySchema> schema;    ///< BODY_SCHEMA
  std::vector<health_event_t> events;  ///< all except verdicts on proposals
};

/// The learner and the monitor on the samples of one run, in one thread, message by message.
LiveRun live_run(const std::vector<sample_t>& samples, const StructureLearnerConfig& learner,
                 const ModelMonitorConfig& monitor);

/// learn() on those of the samples that the learner may use.
BodySchema learned_offline(const std::vector<sample_t>& samples,
                           const StructureLearnerConfig& learner);

/// The run as it would be if the part had no marker.
std::vector<sample_t> without_part(std::vector<sample_t> samples, int part);

}  // namespace bodyschema::test
