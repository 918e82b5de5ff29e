#include "processes/model_monitor/model_monitor_process.h"

#include <spdlog/spdlog.h>

#include <stdexcept>
#include <utility>

#include "common/config/yaml.h"

namespace bodyschema {
namespace {

constexpr std::int64_t kProposalTimeout_us = 30'000'000;
constexpr int kMostAtOnce = 100;

ModelMonitorConfig load_config(const std::filesystem::path& file,
                               const std::filesystem::path& refiner_file) {
  ModelMonitorConfig config = ModelMonitorConfig::load(file);
  config.view = TagView::load(file.parent_path());
  if (!refiner_file.empty()) config.refine_every = refine_every(Yaml::load(refiner_file));
  return config;
}

/// "" where there is no file.
std::filesystem::path beside(const std::filesystem::path& file, const char* name) {
  return file.empty() ? file : std::filesystem::path(file).replace_filename(name);
}

}  // namespace

void ModelMonitorProcess::Options::add_to(Arguments app) {
  SampleIntake::Options::add_to(app);
  app.add_option("--schema", schema_file,
                 "Where the body schema is kept, and history.lcmlog beside it; reloaded at start");
  app.add_option("--initial", initial_file,
                 "Body schema to begin with where none is kept: engineered, learned, another run's")
      .existing_file();
  app.add_option("--refiner", refiner_file,
                 "refiner.yaml of a refiner on the bus: what it answers is awaited")
      .existing_file();
}

ModelMonitorProcess::ModelMonitorProcess(Process& process, const Options& options)
    : process_(process),
      door_(process.rig_folder()),
      schema_file_(options.schema_file),
      history_file_(beside(schema_file_, "history.lcmlog")),
      monitor_(load_config(process.config_file(), options.refiner_file)),
      saved_schema_(schema_file_, kBodySchema),
      saved_memory_(history_file_),
      trail_(restore(options)),
      proposals_(options.is_replayed, kProposalTimeout_us),
      intake_(
          options.samples_file,
          [this](const sample_t& sample) {
            waiting_.push_back(sample);
            go_on();
          },
          SampleIntake::asking(process, !options.is_replayed)) {
  say();
  door_.subscribe(process, kSample, [this](const sample_t& sample) {
    intake_.on_sample(sample);
    publish_news();
  });
  door_.subscribe(process, kLearnedSchema,
                  [this](const body_schema_t& proposal) { on_learned_schema(proposal); });
  if (!options.refiner_file.empty())
    process.bus().subscribe(kRefinedSchema,
                            [this](const body_schema_t& refined) { on_refined_schema(refined); });
  process.on_tick([this](std::int64_t now_us) { on_tick(now_us); });
  process.on_idle([this] { say(); });
}

SampleTrail ModelMonitorProcess::restore(const Options& options) {
  const auto not_ours = [&](const body_schema_t& schema) { return door_.objection(schema); };
  const auto memory = saved_memory_.load(not_ours, options.samples_file);
  const auto schema = saved_schema_.load([&](const body_schema_t& kept) -> std::string {
    if (const std::string why = not_ours(kept); !why.empty() || memory) return why;
    if (saved_memory_.rests_on_other_samples()) return "goes with that history";
    return contradiction(options.samples_file, kept.last_sample_index, {});
  });
  if (memory) {
    monitor_.restore(*memory);
    return SampleTrail(saved_memory_.marks());
  }
  if (schema) {
    monitor_.start_from(*schema);
  } else if (!options.initial_file.empty()) {
    body_schema_t initial = door_.load_initial_schema(options.initial_file);
    initial.last_sample_index = -1;
    initial.schema_version = 0;
    monitor_.start_from(initial);
  }
  return SampleTrail();
}

void ModelMonitorProcess::on_learned_schema(const body_schema_t& proposal) {
  is_news_ |= monitor_.on_learned_schema(proposal);
  proposals_.answer(proposal.last_sample_index);
  go_on();
  publish_news();
}

void ModelMonitorProcess::on_refined_schema(const body_schema_t& refined) {
  body_schema_t ours = refined;
  ours.calibration_id = 0;  // it has tags and lens of its own
  if (!door_.lets_in(process_, kRefinedSchema, ours)) return;
  is_news_ |= monitor_.on_refined_schema(refined);
  publish_news();
}

void ModelMonitorProcess::on_tick(std::int64_t now_us) {
  intake_.on_tick(now_us);
  if (proposals_.on_tick(now_us))
    spdlog::warn("no proposal of structure_learner on sample {}: goes on without",
                 proposals_.question());
  const std::int64_t awaited = monitor_.awaited_refinement();
  if (monitor_.on_tick(now_us)) {
    spdlog::warn("no REFINED_SCHEMA of sample {}: goes on without", awaited);
    is_news_ = true;
  }
  go_on();
  publish_news();
  process_.set_counters(intake_.counters());
  if (process_.bus().is_replay() || now_us - sent_us_ < 1'000'000) return;
  sent_us_ = now_us;
  publish();
}

void ModelMonitorProcess::go_on() {
  for (int n = 0; n < kMostAtOnce && !waiting_.empty() && !proposals_.is_waiting(); ++n) {
    const sample_t& sample = waiting_.front();
    follow(sample);
    if (door_.takes(process_, sample)) {
      if (sample.purpose == action_command_t::PURPOSE_TEST) proposals_.ask(sample.sample_index);
      is_news_ |= monitor_.on_sample(sample);
    }
    waiting_.pop_front();
  }
}

void ModelMonitorProcess::follow(const sample_t& sample) {
  const std::string problem = trail_.add(sample);
  if (problem.empty()) return;
  // Samples that come by the bus alone are compared only now. The next start begins anew.
  const std::string why = history_file_.string() + ": " + problem;
  set_aside(history_file_, why);
  if (std::filesystem::exists(schema_file_))
    set_aside(schema_file_, schema_file_.string() + ": goes with that history");
  throw std::runtime_error(why);
}

void ModelMonitorProcess::publish_news() {
  if (std::exchange(is_news_, false)) publish();
}

void ModelMonitorProcess::publish() {
  // The memory first: the schema is found again from it and the samples.
  std::string not_saved = saved_memory_.save(monitor_.memory(), trail_.marks());
  if (monitor_.schema()) {
    if (not_saved.empty()) not_saved = saved_schema_.save(*monitor_.schema());
    process_.bus().publish(kBodySchema, *monitor_.schema());
  }
  process_.bus().publish(kModelHealth, monitor_.health());
  if (!not_saved.empty() && problem_.empty())
    spdlog::warn("{}; tried again every second", not_saved);
  if (!not_saved.empty()) process_.count("schema not saved");
  problem_ = not_saved;
}

void ModelMonitorProcess::say() {
  if (!problem_.empty() || !intake_.activity().empty()) {
    process_.set_activity(process_info_t::PHASE_WAITING,
                          problem_.empty() ? intake_.activity() : "cannot save: " + problem_);
  } else if (!monitor_.schema() && monitor_.health().judged_sample < 0) {
    process_.set_activity(process_info_t::PHASE_WAITING, "waiting for LEARNED_SCHEMA");
  } else {
    const std::int64_t awaited = monitor_.awaited_refinement();
    process_.set_activity(
        process_info_t::PHASE_WORKING,
        fmt::format(
            "schema version {}, judged up to sample {}{}", monitor_.health().schema_version,
            monitor_.health().judged_sample,
            awaited < 0 ? "" : fmt::format(", waiting for REFINED_SCHEMA of sample {}", awaited)));
  }
}

}  // namespace bodyschema
