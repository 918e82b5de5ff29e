#include "processes/structure_learner/structure_learner_process.h"

#include <malloc.h>
#include <spdlog/spdlog.h>

#include <algorithm>
#include <chrono>
#include <stdexcept>

namespace bodyschema {
namespace {

/// Listening waits for a fit this long at most, so that the proposal of a usual one is published at
/// once.
constexpr std::chrono::milliseconds kUsualFit{20};
constexpr std::int64_t kVerdictTimeout_us = 10'000'000;

template <class Future>
bool is_ready(const Future& future, std::chrono::milliseconds within = {}) {
  return future.valid() && future.wait_for(within) == std::future_status::ready;
}

}  // namespace

StructureLearnerProcess::StructureLearnerProcess(Process& process, const Options& options)
    : process_(process),
      door_(process.rig_folder()),
      learner_(StructureLearnerConfig::load(process.config_file())),
      intake_(
          options.samples_file, [this](const sample_t& sample) { learn_from(sample); },
          SampleIntake::asking(process, !options.is_replayed)),
      resumed_after_(learner_.last_sample_index()),
      verdicts_(options.is_replayed, kVerdictTimeout_us) {
  process.set_activity(process_info_t::PHASE_WAITING, "waiting for SAMPLE");
  door_.subscribe(process, kSample, [this](const sample_t& sample) { intake_.on_sample(sample); });
  door_.subscribe(process, kBodySchema,
                  [this](const body_schema_t& schema) { learner_.on_body_schema(schema); });
  door_.subscribe(process, kModelHealth,
                  [this](const model_health_t& health) { on_model_health(health); });
  process.on_idle([this] { work(); });
  process.on_tick([this](std::int64_t now_us) { on_tick(now_us); });
  process.on_end([this] { on_end(); });
}

void StructureLearnerProcess::learn_from(const sample_t& sample) {
  if (!door_.takes(process_, sample)) return;
  try {
    learner_.on_sample(sample);
  } catch (const std::invalid_argument&) {
    process_.count("refused SAMPLE");  // a samples file of another rig
  }
}

void StructureLearnerProcess::on_model_health(const model_health_t& health) {
  verdicts_.answer(health.judged_sample);
  // The monitor itself waits, and not for ever.
  if (health.awaited_refinement == verdicts_.question()) verdicts_.ask(verdicts_.question());
  learner_.skip_judged(std::min(health.judged_sample, resumed_after_));
}

void StructureLearnerProcess::on_tick(std::int64_t now_us) {
  intake_.on_tick(now_us);
  if (!fit_.valid() && verdicts_.on_tick(now_us))
    spdlog::warn("no verdict of model_monitor on sample {}: goes on without", verdicts_.question());
  process_.set_counters(intake_.counters());
  work();
  if (has_learned_ && !process_.bus().is_replay() && now_us - sent_us_ >= 1'000'000) {
    sent_us_ = now_us;
    publish();
  }
  if (!intake_.activity().empty()) {
    process_.set_activity(process_info_t::PHASE_WAITING, intake_.activity());
  }
}

void StructureLearnerProcess::on_end() {
  if (fit_.valid()) collect();
  while (learner_.has_job()) learn_now();
}

void StructureLearnerProcess::work() {
  if (is_ready(fit_)) collect();
  if (is_ready(preparation_)) preparation_.get();
  if (process_.bus().is_replay()) {
    while (learner_.has_test_job()) learn_now();
    return;
  }
  if (!fit_.valid()) start_fit();
  if (!fit_.valid() && !learner_.has_job() && !preparation_.valid()) start_preparation();
}

void StructureLearnerProcess::start_fit() {
  if (!learner_.has_job() || (learner_.has_test_job() && verdicts_.is_waiting())) return;
  if (learner_.has_test_job()) verdicts_.ask(learner_.next_sample_index());
  fit_ = std::async(std::launch::async, learner_.take_job());
  if (is_ready(fit_, kUsualFit)) collect();
}

void StructureLearnerProcess::start_preparation() {
  if (!learner_.has_preparation()) return;
  preparation_ = std::async(std::launch::async, [prepare = learner_.take_preparation()] {
    prepare();
    malloc_trim(0);  // a search needs for a moment several times what is kept
  });
}

void StructureLearnerProcess::collect() {
  learned_ = fit_.get();
  has_learned_ = true;
  publish();
}

void StructureLearnerProcess::learn_now() {
  fit_ = std::async(std::launch::deferred, learner_.take_job());
  collect();
}

void StructureLearnerProcess::publish() {
  process_.bus().publish(kLearnedSchema, learned_);
  process_.set_activity(process_info_t::PHASE_WORKING,
                        std::to_string(learned_.num_samples_seen) + " samples learned, " +
                            std::to_string(learned_.num_edges) + " edges of " +
                            std::to_string(learned_.num_parts) + " parts");
}

}  // namespace bodyschema
