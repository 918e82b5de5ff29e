#include "processes/controller/controller.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <sstream>
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
  status.control_state = state_;
  status.owns_arm = owns_arm_;
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

Controller::Answer Controller::answer(Command command, std::int64_t now_us) {
  Answer result{std::move(command), std::nullopt};
  const control_status_t status = this->status();
  const bool is_due = now_us >= 0 && status_age_.elapsed_us(now_us) >= kRepeat_us;
  if (is_due || !told_ || !is_same(*told_, status)) {
    result.status = told_ = status;
    status_age_.restart(now_us);
  }
  return result;
}

void Controller::enter(std::int8_t control_state, bool owns_arm, std::string why) {
  state_ = control_state;
  owns_arm_ = owns_arm;
  why_ = std::move(why);
}

void Controller::refuse(const std::string& why) {
  forget_plan();
  is_taken_ = false;
  enter(S::CONTROL_REFUSED, false, why);
}

void Controller::halt(const std::string& why) {
  forget_plan();
  command_.reset();
  awaited_.reset();
  is_taken_ = false;
  enter(S::CONTROL_HOLDING, true, why);
}

Controller::Command Controller::hold(const std::string& why) {
  halt(why);
  return send_hold();
}

Controller::Command Controller::send_hold() {
  wants_hold_ = true;
  if (!motion_) return std::nullopt;
  wants_hold_ = false;
  hold_command_ = make_command(action_command_t::KIND_HOLD);
  hold_wait_.restart();
  return hold_command_;
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
  if (state_ == S::CONTROL_REFUSED && why_ == kHalted && !motion.stop_latched) why_ = kWasHalted;
  if (hold_command_ && is_mine && motion.action_id == hold_command_->action_id) {
    hold_command_.reset();
  }
  if (wants_hold_) return answer(send_hold());
  if (!is_active()) return answer(std::nullopt);

  if (motion.stop_latched) {
    if (state_ == S::CONTROL_WAITING && !owns_arm_) {
      refuse(kHalted);
    } else {
      halt(motion.reason + "; after ./run resume give another target, or release the arm");
    }
    return answer(std::nullopt);
  }
  if (owns_arm_ && began_anew) {
    ++counters_["driver began anew"];
    return answer(hold("the driver began anew: its time or its answers went back"));
  }
  if (owns_arm_ && is_news && previous && !is_mine) {
    if (motion.kind == action_command_t::KIND_HOLD) {
      halt(motion.source + " told the driver to hold");
      return answer(std::nullopt);
    }
    if (motion.kind == action_command_t::KIND_MOVE && state_ != S::CONTROL_REACHED) {
      is_taken_ = false;  // somebody else moved it; what was planned no longer begins here
      goal_.reset();
      taking_.restart();
    }
  }
  if (is_mine && command_ && motion.action_id == command_->action_id) {
    return answer(on_own_answer(motion));
  }
  return answer(advance());
}

Controller::Answer Controller::on_marker_poses(const marker_poses_t& poses) {
  see(poses.utime);
  track(poses);
  return answer(advance());
}

Controller::Answer Controller::on_sample(const sample_t& sample) {
  if (!sample_ || !is_same_action(*sample_, sample)) {
    lent_.restart();
  }
  sample_ = sample;
  see(sample.utime);
  locate();
  if (awaited_ && sample.source == kSource && sample.epoch == epoch_ &&
      sample.action_id == *awaited_) {
    awaited_.reset();
    observe(sample);
  }
  return answer(advance());
}

Controller::Answer Controller::on_body_schema(const body_schema_t& message) {
  // An older version counts only when the newer one has fallen silent.
  if (schema_ && message.schema_version < schema_->version) {
    ++counters_["older BODY_SCHEMA"];
    return answer(std::nullopt);
  }
  schema_silence_.restart();
  if (!schema_ || message.schema_version != schema_->version) {
    schema_ = from_message(message);
    goal_.reset();
    rejected_.clear();
  }
  return answer(advance());
}

Controller::Answer Controller::on_model_health(const model_health_t& health) {
  health_ = health;
  return answer(advance());
}

bool Controller::has_expired(std::int64_t now_us) {
  const bool is_open = is_active() && state_ != S::CONTROL_REACHED;
  return is_open && target_.expiry_s > 0 &&
         expiry_.elapsed_us(now_us) >= microseconds(target_.expiry_s);
}

Controller::Answer Controller::on_tick(std::int64_t now_us) {
  silent_ = silence(now_us);
  quiet_.elapsed_us(now_us);
  const bool is_serving =
      owns_arm_ && (state_ == S::CONTROL_WAITING || state_ == S::CONTROL_MOVING);
  if (!is_serving || command_ || awaited_) idle_.restart(now_us);
  Command command;
  if (schema_ && !owns_arm_ &&
      schema_silence_.elapsed_us(now_us) > config_.max_body_schema_silence_us) {
    // Nobody stands behind it any more; the next that is heard counts, whatever its version.
    schema_.reset();
    goal_.reset();
  }
  if (has_expired(now_us)) {
    const std::string why =
        "not reached within " + seconds(microseconds(target_.expiry_s)) + "; " + why_;
    if (owns_arm_) {
      command = hold(why);
    } else {
      refuse(why);
    }
  } else if (is_serving) {
    if (!silent_.empty()) {
      command = hold(silent_);
    } else if (command_) {
      if (answer_wait_.elapsed_us(now_us) >= config_.resend_us) {
        answer_wait_.restart(now_us);
        command = command_;
      }
    } else if (awaited_) {
      why_ = "waiting for the SAMPLE of " + name_of(*awaited_, kSource);
      if (sample_wait_.elapsed_us(now_us) >= config_.sample_timeout_us) {
        command = hold("no SAMPLE of " + name_of(*awaited_, kSource) + " within " +
                       seconds(config_.sample_timeout_us) + ": is the observer alive?");
      }
    } else if (idle_.elapsed_us(now_us) >= config_.rest_timeout_us) {
      refuse("given up after " + seconds(config_.rest_timeout_us) + ": " + why_);
    } else if (!is_taken_) {
      command = take(now_us);
    }
  } else if (state_ == S::CONTROL_WAITING) {
    const std::int64_t patience_us =
        std::max({config_.max_motion_status_silence_us, config_.max_marker_poses_silence_us,
                  config_.max_body_schema_silence_us});
    if (guard_.elapsed_us(now_us) > patience_us) refuse("not heard: " + unheard());
  } else if (state_ == S::CONTROL_LENT) {
    if (lent_.elapsed_us(now_us) >= config_.lent_timeout_us) {
      refuse("no new SAMPLE for " + seconds(config_.lent_timeout_us) + " while " + why_ +
             "; does the babbler run, or is it done?");
    }
  } else if (state_ == S::CONTROL_REACHED && target_.keep_s >= 0 &&
             keep_.elapsed_us(now_us) >= microseconds(target_.keep_s)) {
    enter(S::CONTROL_RELEASED, false, why_ + "; kept for " + seconds(microseconds(target_.keep_s)));
  } else if (hold_command_ && hold_wait_.elapsed_us(now_us) >= config_.resend_us) {
    hold_wait_.restart(now_us);
    command = hold_command_;
  }
  return answer(std::move(command), now_us);
}

// ---- what survives

std::string Controller::state_text() const {
  // A target that is kept until another is a hold as well.
  const bool holds =
      state_ == S::CONTROL_HOLDING || (state_ == S::CONTROL_REACHED && target_.keep_s < 0);
  std::ostringstream text;
  text << "# controller: its own action ids, the newest target, whether the arm is its own.\n"
       << "epoch: " << epoch_ << "\n"
       << "next_action_id: " << next_action_id_ << "\n"
       << "target: {sender: " << yaml_quoted(target_.sender) << ", epoch: " << floor_epoch_
       << ", target_id: " << floor_id_ << "}\n"
       << "was_served: " << (is_active() ? "false" : "true") << "\n"
       << "owns_arm: " << (owns_arm_ ? "true" : "false") << "\n"
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
  floor_id_ = owns_arm ? id : id - 1;
  if (owns_arm) {
    target_.sender = sender;
    target_.epoch = epoch;
    target_.target_id = id;
    if (why.starts_with(kHeldAsBefore)) why.erase(0, std::strlen(kHeldAsBefore));
    hold(holds ? kHeldAsBefore + why
               : "restarted in the middle of " + name + ": give another, or release the arm");
  } else if (id >= 0) {
    why_ = was_served ? "restarted; no target is open"
                      : "restarted: " + name + " was not begun; give it again";
  }
}

}  // namespace bodyschema
