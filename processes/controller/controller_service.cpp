// How class Controller serves a target: action by action, each seen before the next.

#include <algorithm>
#include <cmath>
#include <sstream>
#include <tuple>
#include <utility>

#include "common/bus/convert.h"
#include "common/bus/process.h"
#include "processes/controller/controller.h"
#include "processes/controller/controller_words.h"

namespace bodyschema {
namespace {

constexpr int kMaxExpired = 3;     // in a row
constexpr double kArrived = 1e-9;  // of a range

std::string millimetres(double m) {
  std::ostringstream text;
  text.precision(1);
  text << std::fixed << m * 1e3 << " mm";
  return text.str();
}

}  // namespace

bool Controller::is_newer(const pose_target_t& target) const {
  return std::tie(target.epoch, target.target_id) > std::tie(floor_epoch_, floor_id_);
}

bool Controller::is_from_ahead(std::int64_t epoch, std::int64_t wall_clock_us) {
  return wall_clock_us >= 0 && epoch > wall_clock_us + kClockTolerance_us;
}

void Controller::forget_plan() {
  goal_.reset();
  rejected_.clear();
  rejection_.clear();
  num_expired_ = 0;
}

Controller::Answer Controller::on_pose_target(const pose_target_t& target,
                                              std::int64_t wall_clock_us) {
  if (is_from_ahead(target.epoch, wall_clock_us)) {
    ++counters_["POSE_TARGET from a clock ahead"];
    return answer(std::nullopt);
  }
  if (!is_newer(target)) {
    const bool is_repeated = target.epoch == floor_epoch_ && target.target_id == floor_id_;
    if (!is_repeated) ++counters_["older POSE_TARGET"];
    return answer(std::nullopt);
  }
  floor_epoch_ = target.epoch;
  floor_id_ = target.target_id;
  target_ = target;
  aim_ = position_of(target);
  forget_plan();
  num_moves_ = num_corrections_ = 0;
  predicted_error_m_ = observed_error_m_ = -1;
  wants_hold_ = false;
  hold_command_.reset();
  switch (target.target_kind) {
    case pose_target_t::KIND_HOLD:
      return answer(hold("hold, asked for by " + target.sender));
    case pose_target_t::KIND_RELEASE:
      command_.reset();
      awaited_.reset();
      is_taken_ = false;
      enter(S::CONTROL_RELEASED, false, "released by " + target.sender);
      return answer(std::nullopt);
    default:
      // An action that is under way is waited for; the arm may be the controller's already.
      guard_.restart();
      taking_.restart();
      idle_.restart();
      enter(S::CONTROL_WAITING, owns_arm_, "taking up the target");
      return answer(advance());
  }
}

Controller::Command Controller::advance() {
  if (!is_active() || state_ == S::CONTROL_REACHED || command_ || awaited_) return std::nullopt;
  if (const std::string input = unheard(); !input.empty()) {
    why_ = "waiting for " + input;
    return std::nullopt;
  }
  if (const std::string why = objection(); !why.empty()) {
    refuse(why);
    return std::nullopt;
  }
  std::string edge;
  const EdgeState worst = worst_edge(&edge);
  const bool is_probe = worst != EdgeState::kOk && health_ && health_->probe_sample > probed_;
  if (worst == EdgeState::kInvalid || is_probe) {
    goal_.reset();
    is_taken_ = false;
    if (state_ != S::CONTROL_LENT) {
      lent_.restart();
      num_lent_samples_ = 0;
    }
    is_lent_for_probe_ = worst != EdgeState::kInvalid;
    enter(S::CONTROL_LENT, false,
          is_lent_for_probe_ ? edge + " can be told two ways: the babbler has the arm for a probe"
                             : edge + " is invalid: the babbler has the arm until it is mended");
    return std::nullopt;
  }
  if (!owns_arm_ || state_ == S::CONTROL_LENT) {
    is_taken_ = false;
    taking_.restart();
    enter(S::CONTROL_WAITING, true, "taking the arm");
  }
  // Until the arm is taken, on_tick goes on.
  if (!is_taken_ || !silent_.empty() || !is_at_rest() || !position_) return std::nullopt;
  return step();
}

Controller::Command Controller::take(std::int64_t now_us) {
  const std::int64_t waited_us = taking_.elapsed_us(now_us);
  if (!is_at_rest()) {
    why_ = "waiting for the arm to come to rest";
    taking_.restart(now_us);
    return std::nullopt;
  }
  if (quiet_.elapsed_us(now_us) < config_.take_us || waited_us < config_.take_us) {
    return std::nullopt;
  }
  const bool has_patience = waited_us < config_.sample_timeout_us;
  const bool is_settled = motion_->state == motion_status_t::STATE_SETTLED &&
                          motion_->kind == action_command_t::KIND_MOVE;
  if (is_settled && has_patience && !(sample_ && is_same_action(*motion_, *sample_))) {
    why_ = "waiting for the SAMPLE of " + name_of(motion_->action_id, motion_->source);
    return std::nullopt;
  }
  if (!position_) {
    why_ = "waiting to hear where the arm is";
    if (!has_patience) {
      refuse(
          "where the arm is was not heard: neither MOTION_STATUS nor SAMPLE tell the action it "
          "rests at; release the arm, so that the babbler moves it");
    }
    return std::nullopt;
  }
  is_taken_ = true;
  return advance();
}

Controller::Command Controller::step() {
  if (!goal_) {
    const InverseKinematicsSolution solution =
        solve_pose(*schema_, target_.target_part, {.p_RT = aim_}, config_.signals, *position_,
                   config_.inverse_kinematics, rejected_);
    if (solution.error_m > config_.reached_m) {
      const std::string after =
          num_moves_ > 0 ? " (after " + std::to_string(num_moves_) + " moves)" : "";
      if (num_corrections_ > 0) {
        aim_ = position_of(target_);  // beyond reach only with the correction
        return arrive();
      }
      if (rejected_.empty()) {
        predicted_error_m_ = solution.error_m;
        refuse("out of reach: within the limits part " + std::to_string(target_.target_part) +
               " comes no nearer than " + millimetres(solution.error_m) + after);
      } else {
        refuse("the driver refuses every way found" + after + ": " + rejection_);
      }
      return std::nullopt;
    }
    goal_ = solution.action;
  }
  predicted_error_m_ = predicted_error_m();

  Eigen::ArrayXd range(config_.signals.size()), lower(config_.signals.size());
  for (std::size_t i = 0; i < config_.signals.size(); ++i) {
    const Signal& signal = config_.signals[i];
    lower[static_cast<Eigen::Index>(i)] = signal.lower;
    range[static_cast<Eigen::Index>(i)] = signal.upper - signal.lower;
  }
  const Eigen::ArrayXd way = goal_->array() - position_->array();
  const double longest = (way / range).abs().maxCoeff();
  if (longest <= kArrived) return arrive();
  std::string doubtful;
  const bool is_slow = worst_edge(&doubtful) != EdgeState::kOk;
  const double share = is_slow ? config_.slow_step : config_.max_step;
  const Eigen::VectorXd action =
      longest <= share
          ? *goal_
          : (position_->array() + way * (share / longest)).max(lower).min(lower + range).matrix();
  command_ = make_command(action_command_t::KIND_MOVE);
  set_array(command_->num_signals, command_->action,
            std::vector<double>(action.begin(), action.end()));
  answer_wait_.restart();
  ++num_moves_;
  enter(S::CONTROL_MOVING, true,
        is_slow ? "in small steps: " + doubtful + " is in doubt" : "towards the target");
  return command_;
}

Controller::Command Controller::arrive() {
  if (sample_ && sample_->rest_begin_utime == motion_->rest_since_utime) observe(*sample_);
  predicted_error_m_ = predicted_error_m();
  const bool is_off = observed_error_m_ > config_.reached_m;
  if (is_off && is_observation_sure_ && num_corrections_ < config_.max_corrections &&
      observed_error_m_ <= config_.max_correction_m) {
    ++num_corrections_;
    aim_ += observed_offset_;
    goal_.reset();
    return step();
  }
  enter(S::CONTROL_REACHED, true,
        observed_error_m_ < 0 ? "reached by the schema; the part is not seen there"
        : is_off ? "reached by the schema, but seen " + millimetres(observed_error_m_) + " away"
                 : "reached, and seen there");
  keep_.restart();
  return std::nullopt;
}

Controller::Command Controller::on_own_answer(const motion_status_t& motion) {
  answer_wait_.restart();
  switch (motion.state) {
    case motion_status_t::STATE_SETTLED:
      awaited_ = command_->action_id;
      sample_wait_.restart();
      command_.reset();
      num_expired_ = 0;
      predicted_error_m_ = predicted_error_m();
      if (sample_ && is_same_action(motion, *sample_)) {
        awaited_.reset();
        observe(*sample_);
      }
      return advance();
    case motion_status_t::STATE_REJECTED:
      num_moves_ = std::max(0, num_moves_ - 1);  // it was none; the target may be another by now
      command_.reset();
      ++counters_["action rejected"];
      if (!is_at_rest()) {
        why_ = "waiting for the arm to come to rest";
        return std::nullopt;
      }
      rejection_ = motion.reason;
      if (goal_) rejected_.push_back(*goal_);
      goal_.reset();
      if (static_cast<int>(rejected_.size()) >= config_.max_solutions) {
        refuse("the driver refused " + std::to_string(rejected_.size()) + " ways: " + rejection_);
        return std::nullopt;
      }
      return advance();
    case motion_status_t::STATE_EXPIRED:
      num_moves_ = std::max(0, num_moves_ - 1);
      command_.reset();
      ++counters_["action expired"];
      if (++num_expired_ >= kMaxExpired) {
        refuse("the driver let " + std::to_string(num_expired_) +
               " actions expire; is its clock right? " + motion.reason);
        return std::nullopt;
      }
      return advance();
    case motion_status_t::STATE_STOPPED:
    case motion_status_t::STATE_HOLDING:
      halt("the driver ended the motion. " + motion.reason);
      return std::nullopt;
    default:
      return std::nullopt;
  }
}

}  // namespace bodyschema
