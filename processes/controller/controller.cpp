#include "processes/controller/controller.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <sstream>
#include <stdexcept>
#include <tuple>
#include <utility>

#include "common/bus/convert.h"
#include "common/bus/process.h"
#include "common/config/yaml.h"
#include "common/geometry/angle.h"
#include "processes/controller/controller_words.h"

namespace bodyschema {
namespace {

constexpr char kSource[] = "controller";
constexpr char kWasHalted[] = "the arm was halted; it is resumed: give the target again";
constexpr char kHeldAsBefore[] = "held as before the restart: ";
constexpr std::int64_t kRepeat_us = 1'000'000;

std::int64_t microseconds(double seconds) { return std::llround(seconds * 1e6); }

bool is_same(const control_status_t& a, const control_status_t& b) {
  const auto fields = [](const control_status_t& s) {
    return std::tie(s.sender, s.target_epoch, s.target_id, s.control_state, s.owns_arm, s.why,
                    s.schema_version, s.target_part, s.predicted_error_m, s.observed_error_m,
                    s.predicted_error_rad, s.observed_error_rad, s.num_moves, s.num_probes);
  };
  return fields(a) == fields(b) &&
         std::equal(std::begin(a.target_position_m), std::end(a.target_position_m),
                    std::begin(b.target_position_m));
}

}  // namespace

ControllerConfig ControllerConfig::load(const std::filesystem::path& file) {
  const Yaml yaml = Yaml::load(file);
  ControllerConfig config;
  config.signals = load_signals(file.parent_path()).signals;
  config.measurement = load_noise(file.parent_path()).measurement;
  for (const TargetTag& tag : load_markers(file.parent_path()).target_tags)
    config.target_tags.push_back(tag.id);
  config.reached_m = yaml.number("reached_m", 1e-6, 1);
  config.reached_rad = yaml.number("reached_deg", 1e-4, 180) * kDegree;
  config.max_step = yaml.number("max_step", 1e-3, 1);
  config.slow_step = yaml.number("slow_step", 1e-3, config.max_step);
  config.search_step = yaml.number("search_step", 1e-3, config.max_step / 2);
  config.max_searches = static_cast<int>(yaml.integer("max_searches", 0, 1000));
  config.max_corrections = static_cast<int>(yaml.integer("max_corrections", 0, 100));
  config.max_correction_m = yaml.number("max_correction_m", 0, 1);
  config.max_solutions = static_cast<int>(yaml.integer("max_solutions", 1, 1000));
  config.expiry_us = microseconds(yaml.number("expiry_s", 0.1, 3600));
  config.resend_us = microseconds(yaml.number("resend_s", 0.1, 3600));
  config.take_us = microseconds(yaml.number("take_s", 0, 60));
  config.sample_timeout_us = microseconds(yaml.number("sample_timeout_s", 0.1, 3600));
  config.verdict_timeout_us = microseconds(yaml.number("verdict_timeout_s", 0.1, 3600));
  config.rest_timeout_us = microseconds(yaml.number("rest_timeout_s", 1, 3600));
  config.lent_timeout_us = microseconds(yaml.number("lent_timeout_s", 1, 36'000));
  const Yaml silence = yaml.section("silence");
  const auto limit = [&](const char* key) { return microseconds(silence.number(key, 0.5, 60)); };
  config.max_motion_status_silence_us = limit("motion_status_s");
  config.max_marker_poses_silence_us = limit("marker_poses_s");
  config.max_body_schema_silence_us = limit("body_schema_s");
  const Yaml ik = yaml.section("inverse_kinematics");
  config.inverse_kinematics.tolerance_m = ik.number("tolerance_m", 1e-9, config.reached_m);
  config.inverse_kinematics.damping_m = ik.number("damping_m", 1e-4, 100);
  config.inverse_kinematics.max_iterations =
      static_cast<int>(ik.integer("max_iterations", 1, 10'000));
  config.inverse_kinematics.max_starts = static_cast<int>(ik.integer("max_starts", 1, 1000));
  if (yaml.has("workspace")) config.workspace = Workspace::load(yaml.section("workspace"));
  yaml.finish();
  return config;
}

Controller::Controller(ControllerConfig config) : config_(std::move(config)) {
  target_.target_id = -1;
  target_.target_part = -1;
  for (const int tag : config_.target_tags) tags_[tag];
}

// ---- what is told

control_status_t Controller::status() const {
  control_status_t status{};
  status.utime = motion_ ? motion_->utime : 0;
  status.sender = target_.sender;
  status.target_epoch = target_.epoch;
  status.target_id = target_.target_id;
  status.control_state = info(phase_).control_state;
  status.owns_arm = owns_arm(phase_);
  status.why = why_;
  status.schema_version = schema_ ? schema_->version : -1;
  status.target_part = target_.target_part;
  std::copy(std::begin(target_.position_m), std::end(target_.position_m),
            std::begin(status.target_position_m));
  status.predicted_error_m = predicted_error_m_;
  status.observed_error_m = observed_error_m_;
  status.predicted_error_rad = predicted_error_rad_;
  status.observed_error_rad = observed_error_rad_;
  status.num_moves = num_moves_;
  status.num_probes = num_probes_;
  status.way_point = target_.way_point;
  status.num_way_points = target_.num_way_points;
  return status;
}

Controller::Answer Controller::answer(std::int64_t now_us) {
  if (motion_) fire(Event::kDriverHeard);
  Answer result{std::exchange(out_, std::nullopt), std::nullopt};
  const control_status_t status = this->status();
  const bool is_due = now_us >= 0 && status_age_.elapsed_us(now_us) >= kRepeat_us;
  if (is_due || !told_ || !is_same(*told_, status)) {
    result.status = told_ = status;
    status_age_.restart(now_us);
  }
  return result;
}

bool Controller::fire(Event event, std::string why) {
  if (trace_) trace_(phase_, event);
  const Reaction& wanted = reaction(phase_, event);
  switch (wanted.kind) {
    case Reaction::Kind::kImpossible:
      throw std::logic_error("controller: \"" + std::string(info(event).name) + "\" in phase \"" +
                             std::string(info(phase_).name) + "\"");
    case Reaction::Kind::kIgnored:
      return false;
    case Reaction::Kind::kStays:
      why_ = std::move(why);
      return false;
    case Reaction::Kind::kGoes:
      break;
  }
  phase_ = wanted.next;
  why_ = std::move(why);
  phase_time_.restart();
  if (wanted.sends == Sends::kHold) sent_ = make_command(action_command_t::KIND_HOLD);
  out_ = wanted.sends == Sends::kNothing ? std::nullopt : sent_;
  return true;
}

action_command_t Controller::make_command(std::int8_t kind) {
  action_command_t command{};
  command.utime = motion_->utime;
  command.source = kSource;
  command.epoch = epoch_;
  command.action_id = next_action_id_++;
  command.kind = kind;
  command.purpose = action_command_t::PURPOSE_CONTROL;
  command.expiry_utime = motion_->utime + config_.expiry_us;
  return command;
}

// ---- what is heard

Controller::Answer Controller::on_motion_status(const motion_status_t& motion) {
  const std::optional<motion_status_t> previous = std::exchange(motion_, motion);
  motion_silence_.restart();
  if (epoch_ < 0) epoch_ = motion.utime;
  const bool is_mine = motion.source == kSource && motion.epoch == epoch_;
  // Where no state was kept, at least no id of a predecessor's is used again.
  if (is_mine && !previous) next_action_id_ = std::max(next_action_id_, motion.action_id + 1);
  // A refusal is said once, or repeated until the next answer; what the arm does is repeated.
  const bool is_refusal = motion.state == motion_status_t::STATE_REJECTED ||
                          motion.state == motion_status_t::STATE_EXPIRED;
  const bool began_anew = (previous && motion.utime < previous->utime) ||
                          (is_mine && !is_refusal && motion.action_id < last_done_id_);
  if (began_anew) {
    seen_until_utime_ = tracked_until_utime_ = position_rest_utime_ = -1;
    position_.reset();
  }
  bool is_news = false;
  if (!is_refusal) {
    if (is_mine) last_done_id_ = motion.action_id;
    const Deed deed{motion.source, motion.epoch, motion.action_id, motion.state};
    is_news = std::exchange(deed_, deed) != deed;
    if (is_news) quiet_.restart();
  }
  locate();
  const bool is_answer = is_mine && sent_ && motion.action_id == sent_->action_id;
  if (is_answer && sent_->kind == action_command_t::KIND_HOLD && !is_refusal)
    fire(Event::kHoldAnswered);
  on_driver(motion, is_news && previous && !is_mine, began_anew);
  if (is_answer && sent_->kind == action_command_t::KIND_MOVE) on_move_answer(motion);
  decide();
  return answer();
}

void Controller::on_driver(const motion_status_t& motion, bool is_foreign, bool began_anew) {
  if (motion.stop_latched) {
    fire(Event::kStopped,
         phase_ == Phase::kListening
             ? kHalted
             : motion.reason + "; after ./run resume give another target, or release the arm");
    return;
  }
  fire(Event::kResumed, kWasHalted);
  if (why_ == kHalted) why_ = kWasHalted;
  if (began_anew &&
      fire(Event::kDriverRestarted, "the driver began anew: its time or its answers went back"))
    ++counters_["driver began anew"];
  if (is_foreign && motion.kind == action_command_t::KIND_HOLD)
    fire(Event::kForeignHold, motion.source + " told the driver to hold");
  if (is_foreign && motion.kind == action_command_t::KIND_MOVE &&
      fire(Event::kForeignMove,
           motion.source + (phase_ == Phase::kKeeping ? " moved the arm away from the target"
                                                      : " moved the arm: taking it anew")))
    goal_.reset();
}

Controller::Answer Controller::on_marker_poses(const marker_poses_t& poses) {
  see(poses.utime);
  track(poses);
  decide();
  return answer();
}

Controller::Answer Controller::on_sample(const sample_t& sample) {
  if (!sample_ || !is_same_action(*sample_, sample)) {
    fire(Event::kNewSample);
    verdict_time_.restart();
  }
  sample_ = sample;
  see(sample.utime);
  locate();
  on_own_sample(sample);
  decide();
  return answer();
}

Controller::Answer Controller::on_body_schema(const body_schema_t& message) {
  // An older version counts only when the newer one has fallen silent.
  if (schema_ && message.schema_version < schema_->version) {
    ++counters_["older BODY_SCHEMA"];
    return answer();
  }
  schema_silence_.restart();
  if (!schema_ || message.schema_version != schema_->version) {
    schema_ = from_message(message);
    goal_.reset();
    rejected_.clear();
    offset_.reset();  // it was the other schema's
  }
  decide();
  return answer();
}

Controller::Answer Controller::on_model_health(const model_health_t& health) {
  health_ = health;
  // The monitor itself waits for the refiner, and not for ever.
  if (sample_ && health.awaited_refinement == sample_->sample_index) {
    verdict_time_.restart();
    idle_.restart();
  }
  decide();
  return answer();
}

Controller::Answer Controller::on_tick(std::int64_t now_us) {
  silent_ = silence(now_us);
  quiet_.elapsed_us(now_us);
  verdict_time_.elapsed_us(now_us);
  if (!concerns(Event::kGivenUp)) idle_.restart(now_us);
  if (schema_ && !concerns(Event::kInputSilent) &&
      schema_silence_.elapsed_us(now_us) > config_.max_body_schema_silence_us) {
    // Nobody stands behind it any more; the next that is heard counts, whatever its version.
    schema_.reset();
    goal_.reset();
  }
  see_time(now_us);
  return answer(now_us);
}

void Controller::see_time(std::int64_t now_us) {
  const std::int64_t elapsed_us = phase_time_.elapsed_us(now_us);
  const std::int64_t expiry_us = microseconds(target_.expiry_s);
  if (is_open(phase_) && expiry_us > 0 && expiry_.elapsed_us(now_us) >= expiry_us) {
    fire(Event::kTargetExpired, "not reached within " + seconds(expiry_us) + "; " + why_);
    return;
  }
  if (!silent_.empty() && fire(Event::kInputSilent, silent_)) return;
  if (elapsed_us >= config_.resend_us && fire(Event::kUnanswered)) {
    phase_time_.restart(now_us);
    return;
  }
  if (concerns(Event::kEndless) && under_way_.elapsed_us(now_us) >= config_.rest_timeout_us) {
    fire(Event::kEndless, "the driver has been moving for " + seconds(config_.rest_timeout_us));
    return;
  }
  if (concerns(Event::kGivenUp) && idle_.elapsed_us(now_us) >= config_.rest_timeout_us) {
    fail(Event::kGivenUp, "given up after " + seconds(config_.rest_timeout_us) + ": " + why_);
    return;
  }
  if (phase_ == Phase::kTaking) return take(now_us);
  if (concerns(Event::kNoSample)) {
    const std::string name = "SAMPLE of " + name_of(sent_->action_id, kSource);
    why_ = "waiting for the " + name;
    if (elapsed_us >= config_.sample_timeout_us)
      fire(Event::kNoSample, "no " + name + " within " + seconds(config_.sample_timeout_us) +
                                 ": is the observer alive?");
  } else if (elapsed_us > std::max({config_.max_motion_status_silence_us,
                                    config_.max_marker_poses_silence_us,
                                    config_.max_body_schema_silence_us}) &&
             concerns(Event::kNotHeard)) {
    fire(Event::kNotHeard, "not heard: " + unheard());
  } else if (elapsed_us >= config_.lent_timeout_us && concerns(Event::kLentInVain)) {
    fire(Event::kLentInVain, "no new SAMPLE for " + seconds(config_.lent_timeout_us) + " while " +
                                 why_ + "; does the babbler run, or is it done?");
  } else if (target_.keep_s >= 0 && elapsed_us >= microseconds(target_.keep_s)) {
    fire(Event::kKept, why_ + "; kept for " + seconds(microseconds(target_.keep_s)));
  }
}

// ---- what survives

std::string Controller::state_text() const {
  // A target that is kept until another is a hold as well.
  const bool holds = info(phase_).control_state == control_status_t::CONTROL_HOLDING ||
                     (phase_ == Phase::kKeeping && target_.keep_s < 0);
  std::ostringstream text;
  text << "# controller: its own action ids, the newest target, whether the arm is its own.\n"
       << "epoch: " << epoch_ << "\n"
       << "next_action_id: " << next_action_id_ << "\n"
       << "target: {sender: " << yaml_quoted(target_.sender) << ", epoch: " << floor_epoch_
       << ", target_id: " << floor_id_ << "}\n"
       << "was_served: " << (is_active(phase_) ? "false" : "true") << "\n"
       << "owns_arm: " << (owns_arm(phase_) ? "true" : "false") << "\n"
       << "holds: " << (holds ? "true" : "false") << "\n"
       << "why: " << yaml_quoted(holds ? why_ : "") << "\n";
  return text.str();
}

void Controller::restore(const std::filesystem::path& file, std::int64_t wall_clock_us) {
  const Yaml yaml = Yaml::load(file);
  epoch_ = yaml.integer("epoch", -1);
  next_action_id_ = yaml.integer("next_action_id", 0);
  const Yaml target = yaml.section("target");
  const std::string sender = target.text("sender");
  std::int64_t epoch = target.integer("epoch", 0);
  std::int64_t id = target.integer("target_id", -1);
  const bool was_served = yaml.boolean("was_served");
  const bool owns_arm = yaml.boolean("owns_arm");
  const bool holds = yaml.boolean("holds");
  std::string why = yaml.text("why");
  yaml.finish();
  const std::string name = "target " + std::to_string(id) + " of " + sender;
  if (is_from_ahead(epoch, wall_clock_us)) {
    epoch = 0;
    id = -1;
    ++counters_["POSE_TARGET from a clock ahead"];
  }
  floor_epoch_ = epoch;
  // A sender repeats what was not acknowledged: then the same target counts again.
  floor_id_ = owns_arm || was_served || id < 0 ? id : id - 1;
  if (owns_arm) {
    target_.sender = sender;
    target_.epoch = epoch;
    target_.target_id = id;
    if (why.starts_with(kHeldAsBefore)) why.erase(0, std::strlen(kHeldAsBefore));
    fire(Event::kRestored,
         holds ? kHeldAsBefore + why
               : "restarted in the middle of " + name + ": give another, or release the arm");
  } else if (id >= 0) {
    why_ = was_served ? "restarted; no target is open"
                      : "restarted: " + name + " was not begun; give it again";
  }
}

}  // namespace bodyschema
