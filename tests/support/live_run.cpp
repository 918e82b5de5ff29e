#include "tests/support/live_run.h"

#include <algorithm>

#include "common/bus/convert.h"

namespace bodyschema::test {

LiveRun live_run(const std::vector<sample_t>& samples, const StructureLearnerConfig& learner_config,
                 const ModelMonitorConfig& monitor_config) {
  StructureLearner learner(learner_config);
  ModelMonitor monitor(monitor_config);
  LiveRun run;
  std::int64_t num_told = 0;
  for (const sample_t& sample : samples) {
    learner.on_sample(sample);
    monitor.on_sample(sample);
    while (learner.has_test_job()) monitor.on_learned_schema(learner.take_job()());
    if (monitor.schema()) learner.on_body_schema(*monitor.schema());
    for (const health_event_t& event : monitor.health().events) {
      if (event.event_number < num_told) continue;
      num_told = event.event_number + 1;
      if (event.event_kind > health_event_t::EVENT_SCHEMA_REFUSED) run.events.push_back(event);
    }
  }
  if (monitor.schema()) run.schema = from_message(*monitor.schema());
  return run;
}

BodySchema learned_offline(const std::vector<sample_t>& samples,
                           const StructureLearnerConfig& config) {
  std::vector<ActionPoseSample> training;
  for (const sample_t& message : samples) {
    ActionPoseSample sample = from_message(message);
    if (is_learned_from(sample)) training.push_back(std::move(sample));
  }
  return learn(config.signals, training, config.options).schema;
}

std::vector<sample_t> without_part(std::vector<sample_t> samples, int part) {
  for (sample_t& sample : samples) {
    std::erase_if(sample.parts, [part](const auto& seen) { return seen.part_id == part; });
    sample.num_parts = static_cast<std::int32_t>(sample.parts.size());
  }
  return samples;
}

}  // namespace bodyschema::test
