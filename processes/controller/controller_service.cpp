// How class Controller serves a target: action by action, each seen before the next.

#include <algorithm>
#include <bit>
#include <cmath>
#include <sstream>
#include <tuple>
#include <utility>

#include "common/bus/convert.h"
#include "common/bus/process.h"
#include "common/geometry/angle.h"
#include "processes/controller/controller.h"
#include "processes/controller/controller_words.h"

namespace bodyschema {
namespace {

constexpr int kMaxExpired = 3;  // in a row
// Of a range: a driver that counts in other units says what it was told within 1e-6.
constexpr double kArrived = 2e-6;

std::string in_tenths(double value, const char* unit) {
  std::ostringstream text;
  text.precision(1);
  text << std::fixed << value << unit;
  return text.str();
}

std::string millimetres(double m) { return in_tenths(m * 1e3, " mm"); }
std::string degrees(double rad) { return in_tenths(rad / kDegree, "°"); }

bool is_near(const Eigen::VectorXd& a, const Eigen::VectorXd& b,
             const std::vector<Signal>& signals) {
  for (std::size_t i = 0; i < signals.size(); ++i) {
    const auto n = static_cast<Eigen::Index>(i);
    if (std::abs(a[n] - b[n]) > kArrived * (signals[i].upper - signals[i].lower)) return false;
  }
  return true;
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
    return answer();
  }
  if (!is_newer(target)) {
    const bool is_repeated = target.epoch == floor_epoch_ && target.target_id == floor_id_;
    if (!is_repeated) ++counters_["older POSE_TARGET"];
    return answer();
  }
  const bool continues_path =
      target.num_way_points > 0 && target.epoch == target_.epoch && target.sender == target_.sender;
  floor_epoch_ = target.epoch;
  floor_id_ = target.target_id;
  target_ = target;
  tag_place_.reset();
  offset_.reset();
  forget_plan();
  num_moves_ = num_probes_ = num_corrections_ = num_searches_ = search_place_ = 0;
  has_left_line_ = false;
  was_its_own_ = owns_arm(phase_);
  predicted_error_m_ = predicted_error_rad_ = observed_error_m_ = observed_error_rad_ = -1;
  search_centre_.reset();
  expiry_.restart();
  idle_.restart();
  switch (target.target_kind) {
    case pose_target_t::KIND_HOLD:
      fire(Event::kHoldAsked, "hold, asked for by " + target.sender);
      break;
    case pose_target_t::KIND_RELEASE:
      fire(Event::kReleaseAsked, "released by " + target.sender);
      break;
    default:
      if (motion_ && motion_->stop_latched) {
        fire(Event::kTargetWhileHalted, kHalted);
      } else if (continues_path &&
                 info(phase_).control_state == control_status_t::CONTROL_HOLDING) {
        // Whoever gives it may have slept when the arm was halted.
        fire(Event::kTargetWhileHalted,
             "the arm was held on this path: nothing goes on by itself, follow it anew");
      } else {
        fire(Event::kTarget, "taking up the target");
        decide();
      }
  }
  return answer();
}

void Controller::decide() {
  if (!decides(phase_)) return;
  if (const std::string input = unheard(); !input.empty()) {
    fire(Event::kInputMissing, "waiting for " + input);
    return;
  }
  if (const std::string why = objection(); !why.empty()) {
    fail(Event::kUnservable, why);
    return;
  }
  std::string edge;
  const bool is_invalid = worst_edge(&edge) == EdgeState::kInvalid;
  if (!is_invalid) {
    num_searches_ = search_place_ = 0;
    search_centre_.reset();
  } else if (num_searches_ >= config_.max_searches) {
    goal_.reset();
    // Nobody moves at random in the middle of a path.
    if (target_.num_way_points > 0)
      return fail(Event::kUnservable, edge + " is invalid, and " + std::to_string(num_searches_) +
                                          " tries at actions that show what changed did not mend "
                                          "it: release the arm, so that it is learned anew, then "
                                          "follow the path again");
    fire(Event::kBroken, edge + " is invalid: the babbler has the arm until it is mended");
    return;
  }
  fire(Event::kServable, "taking the arm");
  // Until the arm is taken, on_tick goes on.
  if (phase_ == Phase::kTaking || !silent_.empty() || !is_at_rest() || !position_) return;
  if (target_.target_kind == pose_target_t::KIND_TAG) {
    // A part that is near enough may cover it; by an edge that is invalid nothing is near.
    const bool is_lost = !tags_.at(target_.target_tag).is_seen();
    if (!aim_at_tag() || (is_lost && is_invalid)) return wait_for_tag();
    fire(Event::kTagSeen, "the target tag is seen");
    if (is_lost) return arrive();
  }
  if (is_invalid) return search(edge);
  if (const auto action = wanted_probe()) return probe(*action);
  step();
}

void Controller::take(std::int64_t now_us) {
  const std::int64_t waited_us = phase_time_.elapsed_us(now_us);
  if (!is_at_rest()) {
    why_ = "waiting for the arm to come to rest";
    phase_time_.restart(now_us);
    return;
  }
  if (quiet_.elapsed_us(now_us) < config_.take_us || waited_us < config_.take_us) return;
  const bool has_patience = waited_us < config_.sample_timeout_us;
  const bool is_settled = motion_->state == motion_status_t::STATE_SETTLED &&
                          motion_->kind == action_command_t::KIND_MOVE;
  if (is_settled && has_patience && !(sample_ && is_same_action(*motion_, *sample_))) {
    why_ = "waiting for the SAMPLE of " + name_of(motion_->action_id, motion_->source);
  } else if (awaits_verdict(now_us)) {
    why_ = "waiting for the monitor's verdict on sample " + std::to_string(sample_->sample_index);
  } else if (position_) {
    fire(Event::kArmFree);
    decide();
  } else if (has_patience) {
    why_ = "waiting to hear where the arm is";
  } else {
    fail(Event::kPositionUnknown,
         "where the arm is was not heard: neither MOTION_STATUS nor SAMPLE tell the action it "
         "rests at; release the arm, so that the babbler moves it");
  }
}

bool Controller::awaits_verdict(std::int64_t now_us) {
  if (!sample_ || sample_->purpose != action_command_t::PURPOSE_TEST) return false;
  const bool is_judged = health_ && health_->judged_sample >= sample_->sample_index;
  return !is_judged && verdict_time_.elapsed_us(now_us) < config_.verdict_timeout_us;
}

bool Controller::aim_at_tag() {
  const TagTrack& tag = tags_.at(target_.target_tag);
  if (tag_place_) update_predicted_errors();
  const bool may_be_covered =
      tag_place_ && predicted_error_m_ >= 0 && predicted_error_m_ <= tolerance_m();
  if (!tag.is_seen() && may_be_covered) return true;
  if (!tag.is_known() || (tag_place_ && *tag_place_ != tag.place())) return false;
  Pose X_CR = schema_->X_CR;
  if (sample_) {
    ActionPoseSample sample = from_message(*sample_);
    drop_moved_tags(schema_->moved_tags, &sample);
    X_CR = X_CR_at(sample).X_CR;
  }
  const Eigen::Vector3d p_RM = X_CR.inverse() * tag.p_CM();
  const double moved_m = (p_RM - position_of(target_)).norm();
  if (!tag_place_ || moved_m > std::min(tolerance_m(), config_.reached_m)) {
    tag_place_ = tag.place();
    std::copy(p_RM.begin(), p_RM.end(), target_.position_m);
    offset_.reset();
    forget_plan();
  }
  return true;
}

void Controller::wait_for_tag() {
  const bool was_aimed_at = tag_place_.has_value();
  tag_place_.reset();
  forget_plan();
  fire(was_aimed_at ? Event::kTagLost : Event::kTagUnseen,
       "target tag " + std::to_string(target_.target_tag) + " " +
           tags_.at(target_.target_tag).account() + ": the arm holds until " +
           std::to_string(TagTrack::kFrames) + " frames at rest show it in one place");
}

void Controller::step() {
  if (!goal_) {
    InverseKinematicsOptions options = config_.inverse_kinematics;
    options.tolerance_m = std::min(options.tolerance_m, tolerance_m());
    options.tolerance_rad = std::min(options.tolerance_rad, tolerance_rad());
    options.uncertain_m = tolerance_m();
    // So that the nearest approach is the one by what is tolerated.
    options.metres_per_radian = tolerance_m() / tolerance_rad();
    const InverseKinematicsSolution solution =
        solve_pose(*schema_, target_.target_part, {aim(), wanted_orientation()}, config_.signals,
                   *position_, options, rejected_);
    if (solution.error_m > tolerance_m() || solution.error_rad > tolerance_rad()) {
      if (!offset_) return fail_unreachable(solution);
      take_back_correction();
      return decide();
    }
    goal_ = solution.action;
    if (const std::string why = config_.workspace.objection(*schema_, *position_, *goal_);
        !why.empty()) {
      serves_ = Serves::kTarget;
      strike(why);
      return decide();
    }
  }
  update_predicted_errors();
  std::string doubtful;
  const bool is_slow = worst_edge(&doubtful) != EdgeState::kOk;
  const Eigen::VectorXd action = towards(*goal_, is_slow ? config_.slow_step : config_.max_step);
  if (is_near(action, *position_, config_.signals)) {
    if (num_moves_ > 0 || is_seen_here()) return arrive();
    return move_to(*goal_, Serves::kTarget, action_command_t::PURPOSE_CONTROL,
                   "the arm is there already: its SAMPLE is made, to see whether the part is");
  }
  return move_to(action, Serves::kTarget, action_command_t::PURPOSE_CONTROL,
                 is_slow ? "in small steps: " + doubtful + " is in doubt" : "towards the target");
}

void Controller::fail(Event event, std::string why) {
  if (owns_arm(phase_) && (was_its_own_ || num_moves_ > 0))
    fire(Event::kFailed, std::move(why) + "; the arm stays here");
  else
    fire(event, std::move(why));
}

void Controller::fail_unreachable(const InverseKinematicsSolution& nearest) {
  const std::string after =
      num_moves_ > 0 ? " (after " + std::to_string(num_moves_) + " moves)" : "";
  if (!rejected_.empty()) {
    fail(Event::kUnreachable, "every way found is refused" + after + ": " + rejection_);
    return;
  }
  predicted_error_m_ = nearest.error_m;
  std::string left = millimetres(nearest.error_m);
  if (wanted_orientation()) {
    predicted_error_rad_ = nearest.error_rad;
    left += " and " + degrees(nearest.error_rad);
  }
  fail(Event::kUnreachable, "out of reach: within the limits part " +
                                std::to_string(target_.target_part) + " comes no nearer than " +
                                left + after);
}

void Controller::probe(const Eigen::VectorXd& action) {
  goal_.reset();
  const Eigen::VectorXd next = towards(action, config_.slow_step);
  if (!is_near(next, action, config_.signals)) {
    return move_to(next, Serves::kProbe, action_command_t::PURPOSE_CONTROL,
                   "towards an action that tells two explanations of a change apart");
  }
  probed_ = health_->probe_sample;  // also if the driver refuses it
  return move_to(action, Serves::kProbe, action_command_t::PURPOSE_PROBE,
                 "making the action that tells two explanations of a change apart");
}

void Controller::search(const std::string& edge) {
  goal_.reset();
  if (!search_centre_) search_centre_ = position_;
  ++num_searches_;
  Eigen::VectorXd action = searched(search_place_);
  if (is_near(action, *position_, config_.signals)) action = searched(++search_place_);
  return move_to(towards(action, config_.slow_step), Serves::kSearch,
                 action_command_t::PURPOSE_PROBE,
                 edge + " is invalid: small moves show what changed");
}

Eigen::VectorXd Controller::searched(int place) const {
  // Up and down by the signs of a screening design (Plackett and Burman 1946; Walsh functions of
  // the place's number): after eight places up to seven signals are told apart, after sixteen
  // fifteen.
  Eigen::VectorXd action = *search_centre_;
  for (std::size_t i = 0; i < config_.signals.size(); ++i) {
    const Signal& signal = config_.signals[i];
    const bool is_up =
        std::popcount(static_cast<unsigned>(place) & static_cast<unsigned>(i + 1)) % 2 == 0;
    const double step = (is_up ? 1 : -1) * config_.search_step * (signal.upper - signal.lower);
    double& value = action[static_cast<Eigen::Index>(i)];
    value = std::clamp(value + step, signal.lower, signal.upper);
  }
  return action;
}

Eigen::VectorXd Controller::towards(const Eigen::VectorXd& action, double share) const {
  double longest = 0;
  for (std::size_t i = 0; i < config_.signals.size(); ++i) {
    const auto n = static_cast<Eigen::Index>(i);
    const double range = config_.signals[i].upper - config_.signals[i].lower;
    if (range > 0) longest = std::max(longest, std::abs(action[n] - (*position_)[n]) / range);
  }
  if (longest <= share) return action;
  Eigen::VectorXd next = *position_ + (action - *position_) * (share / longest);
  // A held arm may rest beyond a limit: nothing is commanded there.
  for (std::size_t i = 0; i < config_.signals.size(); ++i) {
    double& value = next[static_cast<Eigen::Index>(i)];
    value = std::clamp(value, config_.signals[i].lower, config_.signals[i].upper);
  }
  return next;
}

void Controller::move_to(const Eigen::VectorXd& action, Serves serves, std::int8_t purpose,
                         std::string why) {
  serves_ = serves;
  const std::string objection = config_.workspace.objection(*schema_, *position_, action);
  if (!objection.empty()) {
    strike(objection);
    return decide();
  }
  sent_ = make_command(action_command_t::KIND_MOVE);
  sent_->purpose = purpose;
  set_array(sent_->num_signals, sent_->action, std::vector<double>(action.begin(), action.end()));
  under_way_.restart();
  ++num_moves_;
  num_probes_ += purpose == action_command_t::PURPOSE_PROBE;
  fire(Event::kStep, std::move(why));
}

void Controller::forget_move() {
  // The target may be another by now.
  num_moves_ = std::max(0, num_moves_ - 1);
  if (sent_->purpose == action_command_t::PURPOSE_PROBE) num_probes_ = std::max(0, num_probes_ - 1);
}

void Controller::strike(const std::string& why) {
  if (serves_ == Serves::kProbe && health_) probed_ = std::max(probed_, health_->probe_sample);
  if (serves_ == Serves::kSearch) ++search_place_;
  // A new target or schema has no goal yet; a search goes on elsewhere.
  if (serves_ != Serves::kTarget || !goal_) return;
  rejection_ = why;
  rejected_.push_back(*goal_);
  goal_.reset();
  // Another solution would swing the arm off the line from the way point before.
  const bool is_on_line = target_.way_point > 1 && !has_left_line_;
  if (!is_on_line && static_cast<int>(rejected_.size()) < config_.max_solutions) return;
  if (offset_) return take_back_correction();
  fail(Event::kUnreachable, is_on_line
                                ? "the way along the line is refused: " + why
                                : std::to_string(rejected_.size()) + " ways are refused: " + why);
}

void Controller::take_back_correction() {
  offset_ = std::exchange(served_offset_, std::nullopt);
  num_corrections_ = config_.max_corrections;
  rejected_.clear();
  goal_.reset();
}

bool Controller::is_seen_here() const {
  return sample_ && sample_->rest_begin_utime == motion_->rest_since_utime;
}

void Controller::arrive() {
  if (is_seen_here())
    observe(*sample_);
  else
    forget_sight();
  update_predicted_errors();
  const bool is_off = observed_error_m_ > tolerance_m();
  const bool is_turned = observed_error_rad_ > tolerance_rad();
  if (is_off && observed_offset_ && num_corrections_ < config_.max_corrections &&
      observed_error_m_ <= config_.max_correction_m) {
    ++num_corrections_;
    served_offset_ = std::exchange(offset_, observed_offset_);
    goal_.reset();
    return step();
  }
  std::string seen = "reached, and seen there";
  if (is_off || is_turned) {
    seen = "reached by the schema, but seen " + millimetres(observed_error_m_);
    if (is_turned) seen += " and " + degrees(observed_error_rad_);
    seen += " away";
  }
  fire(Event::kReached, observed_error_m_ < 0 ? "reached by the schema; the part is not seen there"
                                              : std::move(seen));
}

void Controller::on_move_answer(const motion_status_t& motion) {
  switch (motion.state) {
    case motion_status_t::STATE_SETTLED:
      if (!fire(Event::kSettled)) return;
      has_left_line_ |= serves_ != Serves::kTarget;
      num_expired_ = 0;
      update_predicted_errors();
      if (sample_) on_own_sample(*sample_);
      return;
    case motion_status_t::STATE_REJECTED:
      if (!fire(Event::kRejected, is_at_rest() ? why_ : "waiting for the arm to come to rest"))
        return;
      forget_move();
      ++counters_["action rejected"];
      if (phase_ == Phase::kDeciding && is_at_rest()) strike(motion.reason);
      return;
    case motion_status_t::STATE_EXPIRED:
      if (!fire(Event::kExpired)) return;
      forget_move();
      ++counters_["action expired"];
      if (++num_expired_ >= kMaxExpired)
        fail(Event::kUnservable, "the driver let " + std::to_string(num_expired_) +
                                     " actions expire; is its clock right? " + motion.reason);
      return;
    case motion_status_t::STATE_STOPPED:
    case motion_status_t::STATE_HOLDING:
      fire(Event::kEnded, "the driver ended the motion. " + motion.reason);
      return;
    default:
      fire(Event::kUnderWay);
  }
}

void Controller::on_own_sample(const sample_t& sample) {
  if (sent_ && sample.source == sent_->source && sample.epoch == sent_->epoch &&
      sample.action_id == sent_->action_id && fire(Event::kSampleCame))
    observe(sample);
}

}  // namespace bodyschema
