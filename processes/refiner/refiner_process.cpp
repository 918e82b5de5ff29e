#include "processes/refiner/refiner_process.h"

#include <fmt/format.h>
#include <spdlog/spdlog.h>

#include <chrono>
#include <exception>

#include "common/bus/channels.h"
#include "common/bus/convert.h"
#include "common/bus/sample_trail.h"
#include "processes/refiner/proposed_files.h"

namespace bodyschema {

void RefinerProcess::Options::add_to(Arguments app) {
  SampleIntake::Options::add_to(app);
  app.add_option("--refined", schema_file,
                 "Where the refined schema is kept; reloaded and repeated at start");
  app.add_option("--proposed", proposed_folder,
                 "Folder for markers.yaml and camera_info.yaml as found");
}

RefinerProcess::RefinerProcess(Process& process, const Options& options)
    : process_(process),
      door_(process.rig_folder()),
      proposed_folder_(options.proposed_folder),
      saved_(options.schema_file, kBodySchema),
      refiner_(
          RefinerSettings::load(process.rig_folder(), RefinerConfig::load(process.config_file()))),
      intake_(
          options.samples_file,
          [this](const sample_t& sample) {
            if (door_.takes(process_, sample)) refiner_.on_sample(sample);
          },
          SampleIntake::asking(process, !options.is_replayed)) {
  process.set_activity(process_info_t::PHASE_WAITING, "waiting for LEARNED_SCHEMA");
  restore(options.samples_file);
  door_.subscribe(process, kSample, [this](const sample_t& sample) { intake_.on_sample(sample); });
  door_.subscribe(process, kLearnedSchema,
                  [this](const body_schema_t& proposal) { refiner_.on_learned_schema(proposal); });
  process.on_idle([this] { work(); });
  process.on_tick([this](std::int64_t now_us) { on_tick(now_us); });
  process.on_end([this] { on_end(); });
}

void RefinerProcess::restore(const std::filesystem::path& samples_file) {
  answer_ = refined_ = saved_.load([&](body_schema_t kept) {
    kept.calibration_id = 0;  // it has tags and lens of its own
    const std::string why = door_.objection(kept);
    return why.empty() ? contradiction(samples_file, kept.last_sample_index, {}) : why;
  });
  if (refined_) refiner_.skip(refined_->last_sample_index);
}

void RefinerProcess::on_tick(std::int64_t now_us) {
  intake_.on_tick(now_us);
  process_.set_counters(intake_.counters());
  work();
  if (process_.bus().is_replay() || now_us - sent_us_ < 1'000'000) return;
  sent_us_ = now_us;
  if (unsaved_) save();
  if (answer_) process_.bus().publish(kRefinedSchema, *answer_);
}

void RefinerProcess::on_end() {
  if (fit_.valid()) collect();
  if (refiner_.has_job()) refine_now();
}

void RefinerProcess::refine_now() {
  refiner_.drop_older_jobs();
  fit_ = std::async(std::launch::deferred, refiner_.take_job());
  collect();
}

void RefinerProcess::work() {
  if (fit_.valid() && fit_.wait_for(std::chrono::seconds(0)) == std::future_status::ready)
    collect();
  if (process_.bus().is_replay()) {
    if (refiner_.has_job()) refine_now();
  } else if (!fit_.valid() && refiner_.has_job()) {
    refiner_.drop_older_jobs();
    fit_ = std::async(std::launch::async, refiner_.take_job());
    process_.set_activity(process_info_t::PHASE_WORKING, "refines");
  }
}

void RefinerProcess::collect() {
  const RefinedProposal proposal = fit_.get();
  say(proposal);
  answer_ = proposal.answer();
  if (proposal.is_better()) {
    refined_ = answer_;
    unsaved_ = proposal.refinement->rig;
    save();
  }
  process_.bus().publish(kRefinedSchema, *answer_);
}

void RefinerProcess::save() {
  std::string problem;
  try {
    if (!proposed_folder_.empty()) write_proposed_files(*unsaved_, proposed_folder_);
    problem = saved_.save(*refined_);
  } catch (const std::exception& error) {
    problem = error.what();
  }
  if (problem.empty()) {
    unsaved_.reset();
    process_.set_activity(process_info_t::PHASE_WORKING, words_);
    return;
  }
  if (process_.count("refined schema not saved") == 1)
    spdlog::warn("{}; tried again every second", problem);
  process_.set_activity(process_info_t::PHASE_WAITING, "cannot save: " + problem);
}

void RefinerProcess::say(const RefinedProposal& proposal) {
  if (!proposal.refinement) {
    words_ = fmt::format("sample {}: not refined: {}", proposal.learned.last_sample_index,
                         proposal.problem);
  } else if (const Refinement& r = *proposal.refinement;
             !r.before.px_median || !r.after.px_median) {
    words_ = fmt::format("sample {}: refined, but no TEST sample shows corners to judge it by",
                         proposal.learned.last_sample_index);
  } else {
    words_ = fmt::format(
        "sample {}: corners of {} TEST samples {:.3f} → {:.3f} px (median), {:.3f} → {:.3f} px "
        "(rms) in {:.1f} s{}",
        proposal.learned.last_sample_index, r.after.num_samples, *r.before.px_median,
        *r.after.px_median, *r.before.px_rms, *r.after.px_rms, r.seconds,
        proposal.is_better() ? "" : ": not surely better, nothing is proposed");
  }
  spdlog::info("{}", words_);
  process_.set_activity(process_info_t::PHASE_WORKING, words_);
}

}  // namespace bodyschema
