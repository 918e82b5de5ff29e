// model_monitor: SAMPLE, LEARNED_SCHEMA -> BODY_SCHEMA, MODEL_HEALTH

#include <CLI/CLI.hpp>
#include <filesystem>

#include "common/bus/event_log.h"
#include "common/bus/process.h"
#include "common/bus/sample_intake.h"
#include "processes/model_monitor/model_monitor.h"

using namespace bodyschema;

int main(int argc, char** argv) {
  std::string samples_file;
  std::string schema_file;
  const auto add_options = [&](CLI::App& app) {
    app.add_option("--samples", samples_file, "The observer's samples.lcmlog, read at start");
    app.add_option("--schema", schema_file, "Where the body schema is kept; reloaded at start");
  };
  const auto body = [&](Process& process) {
    ModelMonitor monitor(ModelMonitorConfig::load(process.config_file()));
    SampleIntake intake(samples_file, [&](const sample_t& sample) { monitor.on_sample(sample); });
    if (!schema_file.empty() && std::filesystem::exists(schema_file)) {
      const auto saved = read_log(schema_file, kBodySchema);
      if (saved.empty()) throw std::runtime_error(schema_file + ": holds no BODY_SCHEMA");
      monitor.reload(saved.back());
    }

    std::int64_t saved_version = monitor.schema() ? monitor.schema()->schema_version : 0;
    const auto publish = [&] {
      if (monitor.schema()) {
        if (monitor.schema()->schema_version != saved_version && !schema_file.empty()) {
          write_one_event_log(schema_file, kBodySchema, *monitor.schema());
        }
        saved_version = monitor.schema()->schema_version;
        process.bus().publish(kBodySchema, *monitor.schema());
      }
      process.bus().publish(kModelHealth, monitor.health());
      process.set_activity(process_info_t::PHASE_WORKING,
                           "schema version " + std::to_string(saved_version) +
                               ", judged up to sample " +
                               std::to_string(monitor.health().judged_sample));
    };

    process.set_activity(process_info_t::PHASE_WAITING, "waiting for LEARNED_SCHEMA");
    Bus& bus = process.bus();
    bus.subscribe<sample_t>(kSample, [&](const sample_t& sample) {
      const std::int64_t judged = monitor.health().judged_sample;
      intake.on_sample(sample);
      if (monitor.health().judged_sample != judged) publish();
    });
    bus.subscribe<body_schema_t>(kLearnedSchema, [&](const body_schema_t& proposal) {
      if (monitor.on_learned_schema(proposal)) publish();
    });
    std::int64_t sent_us = 0;
    process.on_tick([&](std::int64_t now_us) {
      intake.on_tick(now_us);
      if (bus.is_replay() || now_us - sent_us < 1'000'000) return;
      sent_us = now_us;
      publish();
    });
    process.run();
  };
  return run_process("model_monitor", argc, argv, body, add_options);
}
