// structure_learner: SAMPLE, BODY_SCHEMA, MODEL_HEALTH -> LEARNED_SCHEMA, SAMPLE_REQUEST

#include <malloc.h>
#include <spdlog/spdlog.h>

#include <algorithm>
#include <future>
#include <stdexcept>

#include "common/bus/awaited_answer.h"
#include "common/bus/process.h"
#include "common/bus/rig_door.h"
#include "common/bus/sample_intake.h"
#include "processes/structure_learner/structure_learner.h"

using namespace bodyschema;

int main(int argc, char** argv) {
  std::string samples_file;
  bool is_replayed = false;
  const auto add_options = [&](Arguments app) {
    app.add_option("--samples", samples_file, "The observer's samples.lcmlog, read at start");
    app.add_flag("--replayed", is_replayed,
                 "The samples are a recording's and no observer runs: what is missing is given up");
  };
  const auto body = [&](Process& process) {
    const RigDoor door(process.rig_folder());
    StructureLearner learner(StructureLearnerConfig::load(process.config_file()));
    const auto learn_from = [&](const sample_t& sample) {
      if (!door.takes(process, sample)) return;
      try {
        learner.on_sample(sample);
      } catch (const std::invalid_argument&) {
        process.count("refused SAMPLE");  // a samples file of another rig
      }
    };
    SampleIntake intake(samples_file, learn_from, SampleIntake::asking(process, !is_replayed));
    const std::int64_t resumed_after = learner.last_sample_index();

    // The fit runs beside the loop: listening does not wait for learning, or not longer than to
    // publish at once what is learned in the usual time.
    constexpr std::chrono::milliseconds kUsualFit{20};
    std::future<body_schema_t> fit;
    std::future<void> preparation;
    body_schema_t learned;
    bool has_learned = false;
    std::int64_t sent_us = 0;
    // A babbler waits for the monitor's verdict on every TEST sample; so does, where there is none,
    // the learner, or it would learn from a body of which the monitor knows already that it is no
    // more.
    AwaitedAnswer verdicts(is_replayed, 10'000'000);
    const auto publish = [&] {
      process.bus().publish(kLearnedSchema, learned);
      process.set_activity(process_info_t::PHASE_WORKING,
                           std::to_string(learned.num_samples_seen) + " samples learned, " +
                               std::to_string(learned.num_edges) + " edges of " +
                               std::to_string(learned.num_parts) + " parts");
    };
    const auto collect = [&] {
      learned = fit.get();
      has_learned = true;
      publish();
    };
    const auto learn_now = [&] {
      fit = std::async(std::launch::deferred, learner.take_job());
      collect();
    };
    const auto is_ready = [](const auto& future, std::chrono::milliseconds within) {
      return future.wait_for(within) == std::future_status::ready;
    };
    const auto work = [&] {
      if (fit.valid() && is_ready(fit, {})) collect();
      if (preparation.valid() && is_ready(preparation, {})) preparation.get();
      if (process.bus().is_replay()) {
        // A log does not wait: what the monitor will judge is learned at once, the rest at the end,
        // so that a replay always writes the same messages.
        while (learner.has_test_job()) learn_now();
        return;
      }
      if (!fit.valid() && learner.has_job() && !(learner.has_test_job() && verdicts.is_waiting())) {
        if (learner.has_test_job()) verdicts.ask(learner.next_sample_index());
        fit = std::async(std::launch::async, learner.take_job());
        if (is_ready(fit, kUsualFit)) collect();
      }
      if (!fit.valid() && !learner.has_job() && !preparation.valid() && learner.has_preparation()) {
        preparation = std::async(std::launch::async, [prepare = learner.take_preparation()] {
          prepare();
          malloc_trim(0);  // a search needs for a moment several times what is kept
        });
      }
    };

    process.set_activity(process_info_t::PHASE_WAITING, "waiting for SAMPLE");
    door.subscribe(process, kSample, [&](const sample_t& sample) { intake.on_sample(sample); });
    door.subscribe(process, kBodySchema,
                   [&](const body_schema_t& schema) { learner.on_body_schema(schema); });
    door.subscribe(process, kModelHealth, [&](const model_health_t& health) {
      verdicts.answer(health.judged_sample);
      learner.skip_judged(std::min(health.judged_sample, resumed_after));
    });
    process.on_idle(work);
    process.on_tick([&](std::int64_t now_us) {
      intake.on_tick(now_us);
      if (!fit.valid() && verdicts.on_tick(now_us))
        spdlog::warn("no verdict of model_monitor on sample {}: goes on without",
                     verdicts.question());
      process.set_counters(intake.counters());
      work();
      if (has_learned && !process.bus().is_replay() && now_us - sent_us >= 1'000'000) {
        sent_us = now_us;
        publish();
      }
      if (!intake.activity().empty()) {
        process.set_activity(process_info_t::PHASE_WAITING, intake.activity());
      }
    });
    process.on_end([&] {
      if (fit.valid()) collect();
      while (learner.has_job()) learn_now();
    });
    process.run();
  };
  return run_process("structure_learner", argc, argv, body, add_options);
}
