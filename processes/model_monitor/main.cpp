// model_monitor: SAMPLE, LEARNED_SCHEMA -> BODY_SCHEMA, MODEL_HEALTH, SAMPLE_REQUEST

#include <spdlog/spdlog.h>

#include <deque>
#include <filesystem>
#include <stdexcept>
#include <utility>
#include <vector>

#include "common/bus/awaited_answer.h"
#include "common/bus/process.h"
#include "common/bus/rig_door.h"
#include "common/bus/sample_intake.h"
#include "processes/model_monitor/model_monitor.h"
#include "processes/model_monitor/monitor_memory.h"
#include "processes/model_monitor/sample_trail.h"
#include "processes/model_monitor/saved_message.h"

using namespace bodyschema;

namespace {

/// "" where there is no file.
std::filesystem::path beside(const std::filesystem::path& file, const char* name) {
  return file.empty() ? file : std::filesystem::path(file).replace_filename(name);
}

}  // namespace

int main(int argc, char** argv) {
  std::string samples_file;
  bool is_replayed = false;
  std::string schema_file, initial_file;
  const auto add_options = [&](Arguments app) {
    app.add_option("--samples", samples_file, "The observer's samples.lcmlog, read at start");
    app.add_flag("--replayed", is_replayed,
                 "The samples are a recording's and no observer runs: what is missing is given up");
    app.add_option(
        "--schema", schema_file,
        "Where the body schema is kept, and history.lcmlog beside it; reloaded at start");
    app.add_option(
           "--initial", initial_file,
           "Body schema to begin with where none is kept: engineered, learned, another run's")
        .existing_file();
  };
  const auto body = [&](Process& process) {
    const RigDoor door(process.rig_folder());
    ModelMonitor monitor(ModelMonitorConfig::load(process.config_file()));
    SavedMessage saved_schema(schema_file, kBodySchema);
    const std::filesystem::path history_file = beside(schema_file, "history.lcmlog");
    MemoryFile saved_memory(history_file);
    SampleTrail trail;
    {
      const auto not_ours = [&](const body_schema_t& schema) { return door.objection(schema); };
      const auto memory = saved_memory.load(not_ours, samples_file);
      const auto schema = saved_schema.load([&](const body_schema_t& schema) -> std::string {
        if (const std::string why = not_ours(schema); !why.empty() || memory) return why;
        if (saved_memory.rests_on_other_samples()) return "goes with that history";
        return contradiction(samples_file, schema.last_sample_index, {});
      });
      if (memory) {
        trail = SampleTrail(saved_memory.marks());
        monitor.restore(*memory);
      } else if (schema) {
        monitor.start_from(*schema);
      } else if (!initial_file.empty()) {
        body_schema_t initial = door.load_initial_schema(initial_file);
        initial.last_sample_index = -1;
        initial.schema_version = 0;
        monitor.start_from(initial);
      }
    }
    bool is_news = false;
    // A recording's samples are there all at once, and what was judged ahead of a proposal is
    // judged again: so each TEST sample waits for the learner's, which in turn waits for the
    // verdict.
    AwaitedAnswer proposals(is_replayed, 30'000'000);
    constexpr int kMostAtOnce = 100;
    std::deque<sample_t> ahead;
    const auto follow = [&](const sample_t& sample) {
      const std::string problem = trail.add(sample);
      if (problem.empty()) return;
      // Where the samples come by the bus alone it is found out only now. Its next start begins
      // anew.
      const std::string why = history_file.string() + ": " + problem;
      set_aside(history_file, why);
      if (std::filesystem::exists(schema_file))
        set_aside(schema_file, schema_file + ": goes with that history");
      throw std::runtime_error(why);
    };
    const auto go_on = [&] {
      for (int n = 0; n < kMostAtOnce && !ahead.empty() && !proposals.is_waiting(); ++n) {
        const sample_t& sample = ahead.front();
        follow(sample);
        if (door.takes(process, sample)) {
          if (sample.purpose == action_command_t::PURPOSE_TEST) proposals.ask(sample.sample_index);
          is_news |= monitor.on_sample(sample);
        }
        ahead.pop_front();
      }
    };
    SampleIntake intake(
        samples_file,
        [&](const sample_t& sample) {
          ahead.push_back(sample);
          go_on();
        },
        SampleIntake::asking(process, !is_replayed));

    std::string problem;
    const auto publish = [&] {
      // The memory first: the schema is found again from it and the samples.
      std::string not_saved = saved_memory.save(monitor.memory(), trail.marks());
      if (monitor.schema()) {
        if (not_saved.empty()) not_saved = saved_schema.save(*monitor.schema());
        process.bus().publish(kBodySchema, *monitor.schema());
      }
      process.bus().publish(kModelHealth, monitor.health());
      if (!not_saved.empty() && problem.empty()) {
        spdlog::warn("{}; tried again every second", not_saved);
      }
      if (!not_saved.empty()) process.count("schema not saved");
      problem = not_saved;
    };
    const auto say = [&] {
      if (!problem.empty() || !intake.activity().empty()) {
        process.set_activity(process_info_t::PHASE_WAITING,
                             problem.empty() ? intake.activity() : "cannot save: " + problem);
      } else if (!monitor.schema() && monitor.health().judged_sample < 0) {
        process.set_activity(process_info_t::PHASE_WAITING, "waiting for LEARNED_SCHEMA");
      } else {
        process.set_activity(process_info_t::PHASE_WORKING,
                             "schema version " + std::to_string(monitor.health().schema_version) +
                                 ", judged up to sample " +
                                 std::to_string(monitor.health().judged_sample));
      }
    };

    say();
    Bus& bus = process.bus();
    door.subscribe(process, kSample, [&](const sample_t& sample) {
      intake.on_sample(sample);
      if (std::exchange(is_news, false)) publish();
    });
    door.subscribe(process, kLearnedSchema, [&](const body_schema_t& proposal) {
      is_news |= monitor.on_learned_schema(proposal);
      proposals.answer(proposal.last_sample_index);
      go_on();
      if (std::exchange(is_news, false)) publish();
    });
    std::int64_t sent_us = 0;
    process.on_tick([&](std::int64_t now_us) {
      intake.on_tick(now_us);
      if (proposals.on_tick(now_us))
        spdlog::warn("no proposal of structure_learner on sample {}: goes on without",
                     proposals.question());
      go_on();
      if (std::exchange(is_news, false)) publish();
      process.set_counters(intake.counters());
      if (bus.is_replay() || now_us - sent_us < 1'000'000) return;
      sent_us = now_us;
      publish();
    });
    process.on_idle(say);
    process.run();
  };
  return run_process("model_monitor", argc, argv, body, add_options);
}
