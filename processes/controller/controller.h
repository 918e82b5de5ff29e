#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <filesystem>
#include <functional>
#include <map>
#include <optional>
#include <string>
#include <tuple>
#include <vector>

#include "bodyschema/action_command_t.hpp"
#include "bodyschema/body_schema_t.hpp"
#include "bodyschema/control_status_t.hpp"
#include "bodyschema/marker_poses_t.hpp"
#include "bodyschema/model_health_t.hpp"
#include "bodyschema/motion_status_t.hpp"
#include "bodyschema/pose_target_t.hpp"
#include "bodyschema/sample_t.hpp"
#include "common/config/rig.h"
#include "processes/controller/controller_states.h"
#include "processes/controller/inverse_kinematics.h"
#include "processes/controller/tag_track.h"
#include "processes/controller/workspace.h"

namespace bodyschema {

struct ControllerConfig {
  std::vector<Signal> signals;
  MeasurementModel measurement;  ///< of noise.yaml
  std::vector<int> target_tags;  ///< of markers.yaml
  InverseKinematicsOptions inverse_kinematics;
  Workspace workspace;
  /// A target that asks for no tolerance of its own is reached this near, and out of reach if no
  /// action comes as near.
  double reached_m = 0, reached_rad = 0;
  double max_step = 0;     ///< of one action, share of each signal's range
  double slow_step = 0;    ///< the same while an edge on the way is suspect or provisional
  double search_step = 0;  ///< half width of the box searched while one is invalid, share of ranges
  int max_searches = 0;    ///< actions there, until the arm is lent
  int max_corrections = 0;      ///< by what was seen at the end, if that is not within reached_m
  double max_correction_m = 0;  ///< what is seen farther off is not believed
  int max_solutions = 0;        ///< tried before a target that the driver rejects is refused
  std::int64_t expiry_us = 0;   ///< of a command, driver's time
  std::int64_t resend_us = 0;   ///< a command without an answer is sent again after this
  std::int64_t take_us = 0;     ///< the arm is taken when MOTION_STATUS did not change for so long
  std::int64_t sample_timeout_us = 0;   ///< a settled action's SAMPLE is awaited this long
  std::int64_t verdict_timeout_us = 0;  ///< a TEST sample's MODEL_HEALTH is awaited this long
  std::int64_t rest_timeout_us = 0;     ///< an arm that cannot be moved from is given up after this
  std::int64_t lent_timeout_us = 0;     ///< lent so long without a new SAMPLE, a target is refused
  std::int64_t max_motion_status_silence_us = 0;
  std::int64_t max_marker_poses_silence_us = 0;
  std::int64_t max_body_schema_silence_us = 0;

  /// Reads controller.yaml, and signals.yaml, noise.yaml and markers.yaml beside it.
  /// @throws ConfigError.
  static ControllerConfig load(const std::filesystem::path& file);
};

/// Brings a body part to a target position or pose by the body schema alone: a sequence of small
/// MOVE actions towards a solution of inverse kinematics, each answered by the driver and followed
/// by its SAMPLE before the next is sent, so no step is taken unseen and no sample is lost.
///
/// What follows from what in which phase is one table (controller_states.h; for people states.md).
///
/// Of all targets the highest (epoch, target_id) counts; a repeated one does nothing. One whose
/// epoch is more than kClockTolerance_us ahead of the clock is refused: every later one would count
/// for less than it. The arm is its own (owns_arm) from the moment that a target can be served
/// until it was reached and kept, is released, or was refused before it moved the arm. Before it
/// takes the arm it waits until the arm rests, the last settled action has its SAMPLE and, if that
/// is TEST, the monitor has judged it (verdict_timeout, not counted while the monitor waits for the
/// refiner). A target that is not reached within its expiry is dropped, as by a HOLD. The next step
/// of a path (num_way_points, same sender and epoch) is refused once the arm is held.
///
/// No part leaves the workspace on the way, by the schema; a solution towards which one would is
/// dealt with like one that the driver rejects: another is tried, but not on the line from one way
/// point to the next, where that ends the path.
///
/// A probe that the monitor wants while an edge on the way is PROVISIONAL is made before the next
/// step, as slowly as steps are then; refused by the driver, it is done without. While an edge is
/// INVALID the arm is moved a little about the place where that was heard, so that the monitor sees
/// what changed; where max_searches samples do not mend it, the arm is lent to the babbler, on a
/// path held. Nothing lasts for ever: an arm that does not come to rest within rest_timeout, a MOVE
/// that does not end within it, or an arm that is lent for lent_timeout without a new SAMPLE, ends
/// the target.
///
/// Start guard: nothing is sent before MOTION_STATUS, BODY_SCHEMA and MARKER_POSES of the present
/// rest were heard, and no MOVE from a position that was not heard: the last settled action of this
/// rest, as the driver or a SAMPLE echoes it. HOLD waits for MOTION_STATUS alone. When
/// MOTION_STATUS, MARKER_POSES or BODY_SCHEMA falls silent while a target is served, when a SAMPLE
/// does not come, when the driver begins anew or somebody says STOP or HOLD: the target is dropped
/// and the arm held until another target or a release; nothing is resumed by itself. Silence of the
/// eyes is not measured by the clock alone: in lock-step the driver's time stands still and so do
/// the images. They are due when the driver's time has gone on.
///
/// A tag as target (KIND_TAG) is a KIND_POSITION target at the mean position of the tag over the
/// frames of MARKER_POSES (TagTrack) of the present rest, and of those after it, in the root's
/// frame by the schema's X_CR, or by the root's pose in the newest SAMPLE if the camera was moved
/// since. A mean that has moved by more than reached_m, or the tolerance if that is less, is aimed
/// at anew. Before each step the newest frame of that rest must show the tag, except where the
/// part is within the tolerance and may cover it. If it does not, or shows the tag elsewhere by
/// more than the noise, HOLD is sent, and the target waits, the arm its own, until
/// TagTrack::kFrames frames at rest show the tag in one place: there it is served anew. A step that
/// is under way ends first. A target that was reached does not follow its tag.
///
/// A target that is kept is over when somebody else moves the arm away: nothing drives it back.
///
/// Messages must be of the rig (RigDoor): signals are not compared here.
///
/// After a restart that owned the arm it is held, and the target that was in progress is over: it
/// stays acknowledged, a repetition does nothing. A target for which the arm was not taken yet is
/// no longer acknowledged, so that its sender gives it again.
class Controller {
 public:
  /// What is to be sent. `status` on every change and at 1 Hz.
  struct Answer {
    std::optional<action_command_t> command;
    std::optional<control_status_t> status;
  };

  explicit Controller(ControllerConfig config);

  /// `wall_clock_us`: since 1970; -1 where there is none (a replay).
  Answer on_pose_target(const pose_target_t& target, std::int64_t wall_clock_us = -1);
  Answer on_motion_status(const motion_status_t& motion);
  Answer on_marker_poses(const marker_poses_t& poses);
  Answer on_sample(const sample_t& sample);
  Answer on_body_schema(const body_schema_t& schema);
  Answer on_model_health(const model_health_t& health);
  /// `now_us`: the clock. Sees silence.
  Answer on_tick(std::int64_t now_us);

  control_status_t status() const;
  Phase phase() const { return phase_; }
  /// `told` gets each event and the phase in which it came, before what it brings about.
  void trace(std::function<void(Phase, Event)> told) { trace_ = std::move(told); }
  /// Messages that came too late and commands that were in vain, since the start.
  const std::map<std::string, std::int64_t>& counters() const { return counters_; }

  /// What a restart needs, as YAML; to be on disk before a MOVE is sent.
  std::string state_text() const;
  /// Continues from a file with state_text(). A target in it from a clock ahead is forgotten (the
  /// arm stays held if it was). @throws ConfigError.
  void restore(const std::filesystem::path& file, std::int64_t wall_clock_us = -1);

 private:
  /// Source, epoch, action id and state of an answer.
  using Deed = std::tuple<std::string, std::int64_t, std::int64_t, std::int8_t>;

  /// What a MOVE is for.
  enum class Serves : std::uint8_t { kTarget, kProbe, kSearch };

  /// Clock time since restart(), as ticks see it.
  class Stopwatch {
   public:
    void restart(std::int64_t now_us = -1) { begin_us_ = now_us; }
    std::int64_t elapsed_us(std::int64_t now_us) {
      if (begin_us_ < 0) begin_us_ = now_us;
      return now_us - begin_us_;
    }

   private:
    std::int64_t begin_us_ = -1;
  };

  /// By how much the schema misplaces the part near the target: its position by the schema minus
  /// the seen one, in R.
  struct Offset {
    Eigen::Vector3d mean_m;
    Eigen::Matrix3d covariance;
  };
  struct RootPose {
    Pose X_CR;
    Matrix6d covariance;
  };

  /// `now_us` ≥ 0: the clock; then the status is repeated when it is due.
  Answer answer(std::int64_t now_us = -1);
  /// Looks the event up in the transition table (controller_states.h): the one place that changes
  /// the phase. True if the phase began, or began again. @throws std::logic_error: impossible.
  bool fire(Event event, std::string why);
  bool fire(Event event) { return fire(event, why_); }
  /// Whether fire() would be true.
  bool concerns(Event event) const { return reaction(phase_, event).kind == Reaction::Kind::kGoes; }
  bool is_at_rest() const { return motion_ && motion_->rest_since_utime >= 0; }
  bool is_newer(const pose_target_t& target) const;
  static bool is_from_ahead(std::int64_t epoch, std::int64_t wall_clock_us);
  /// "" or which input was not heard yet.
  std::string unheard() const;
  /// "" or which input has been silent for too long.
  std::string silence(std::int64_t now_us);
  /// "" or why the schema cannot serve the target, whatever the arm does.
  std::string objection() const;
  double tolerance_m() const;
  double tolerance_rad() const;
  std::optional<Eigen::Quaterniond> wanted_orientation() const;
  /// Worst state of the edges between root and target part.
  EdgeState worst_edge(std::string* name = nullptr) const;

  bool is_from_far_ahead(std::int64_t frame_utime) const;
  void see(std::int64_t frame_utime);
  /// Of the target tags, if the arm was at rest.
  void track(const marker_poses_t& poses);
  void locate();
  void forget_plan();
  /// The schema's, or by the sample if the camera was moved since.
  RootPose X_CR_at(const ActionPoseSample& sample) const;
  /// Where the part is brought by the schema, so that it is at the target, in R.
  Eigen::Vector3d aim() const;
  /// offset_ with what is seen [its mean and covariance]. std::nullopt: that is noise.
  std::optional<Offset> updated_offset(const Offset& seen) const;
  /// Nothing was seen at this rest.
  void forget_sight();
  void observe(const sample_t& sample);
  void update_predicted_errors();

  /// What the clock brings about.
  void see_time(std::int64_t now_us);
  /// Whatever the target needs next, when no command is unanswered.
  void decide();
  /// Waits until the arm is free, by the clock.
  void take(std::int64_t now_us);
  /// The newest SAMPLE is a TEST sample that the monitor has yet to judge.
  bool awaits_verdict(std::int64_t now_us);
  void step();
  /// Aims at the target's tag. False: it must be seen first.
  bool aim_at_tag();
  void wait_for_tag();
  /// The action that the monitor wants to see, one for each signal and within its limits.
  std::optional<Eigen::VectorXd> wanted_probe() const;
  void probe(const Eigen::VectorXd& action);
  void search(const std::string& edge);
  /// Where the search for what changed goes, place by place.
  Eigen::VectorXd searched(int place) const;
  /// From the arm's position towards an action, as far as `share` of the ranges.
  Eigen::VectorXd towards(const Eigen::VectorXd& action, double share) const;
  /// The way counts as rejected where it leads out of the workspace.
  void move_to(const Eigen::VectorXd& action, Serves serves, std::int8_t purpose, std::string why);
  /// Takes back the counts of a MOVE that was not made.
  void forget_move();
  /// The newest MOVE is refused, by the driver or before it was sent: the target is reached in
  /// another way, a probe is given up, a search goes on elsewhere.
  void strike(const std::string& why);
  /// Aims again where it did before the newest correction, which cannot be served.
  void take_back_correction();
  void arrive();
  /// The newest SAMPLE is of the present rest.
  bool is_seen_here() const;
  /// STOP, a driver that began anew, and what others had it do.
  void on_driver(const motion_status_t& motion, bool is_foreign, bool began_anew);
  void on_move_answer(const motion_status_t& motion);
  void on_own_sample(const sample_t& sample);
  /// The target is over: `event`, but the arm stays held where it was held before or was moved.
  void fail(Event event, std::string why);
  void fail_unreachable(const InverseKinematicsSolution& nearest);
  action_command_t make_command(std::int8_t kind);

  const ControllerConfig config_;
  std::map<std::string, std::int64_t> counters_;
  std::function<void(Phase, Event)> trace_;

  // What was heard.
  std::optional<motion_status_t> motion_;
  Deed deed_;  ///< newest answer that was no refusal
  std::optional<sample_t> sample_;
  std::optional<BodySchema> schema_;
  std::optional<model_health_t> health_;
  std::int64_t seen_until_utime_ = -1;       ///< newest frame
  std::map<int, TagTrack> tags_;             ///< target tags, by id
  std::int64_t tracked_until_utime_ = -1;    ///< newest frame in tags_
  std::int64_t tracked_rest_utime_ = -1;     ///< and its rest
  std::optional<Eigen::VectorXd> position_;  ///< of the present rest, command units
  std::int64_t position_rest_utime_ = -1;
  Stopwatch motion_silence_, eyes_silence_, schema_silence_;
  std::string silent_;  ///< input that was silent for too long at the last tick; "": none

  // The newest target, and how far it is.
  pose_target_t target_{};
  std::int64_t floor_epoch_ = 0, floor_id_ = -1;  ///< older targets are ignored
  Phase phase_ = Phase::kIdle;
  std::string why_ = "no target was given since the start";
  std::optional<int> tag_place_;           ///< of the target's tag: TagTrack::place()
  bool was_its_own_ = false;               ///< the arm, before the target came
  std::optional<Offset> served_offset_;    ///< what was corrected for where the arm is
  std::optional<Offset> offset_;           ///< corrected for
  std::optional<Eigen::VectorXd> goal_;    ///< action that brings the part to aim()
  std::vector<Eigen::VectorXd> rejected_;  ///< goals the driver would not go to
  std::string rejection_;
  int num_expired_ = 0;
  int num_corrections_ = 0;
  bool has_left_line_ = false;  ///< for a probe or a search on the way to this target
  int num_moves_ = 0, num_probes_ = 0;
  double predicted_error_m_ = -1, predicted_error_rad_ = -1;
  double observed_error_m_ = -1, observed_error_rad_ = -1;
  std::optional<Offset> observed_offset_;  ///< by the newest SAMPLE; none: noise, or ambiguous
  Stopwatch phase_time_;                   ///< since the phase began
  Stopwatch quiet_;                        ///< since the driver's last news
  Stopwatch idle_;                         ///< its own arm, but nothing is sent or awaited
  Stopwatch expiry_;
  Stopwatch verdict_time_;    ///< since the newest SAMPLE, or the refiner was last waited for
  Stopwatch under_way_;       ///< since the newest MOVE was decided
  std::int64_t probed_ = -1;  ///< probes wanted up to this sample are made, or given up
  std::optional<Eigen::VectorXd> search_centre_;  ///< where an edge was heard to be invalid
  int search_place_ = 0;                          ///< of searched()
  int num_searches_ = 0;                          ///< actions

  // What was sent.
  std::int64_t epoch_ = -1;
  std::int64_t next_action_id_ = 0;
  std::int64_t last_done_id_ = -1;        ///< of its own, newest that was not refused
  std::optional<action_command_t> sent_;  ///< the newest command
  Serves serves_ = Serves::kTarget;       ///< the newest MOVE
  std::optional<action_command_t> out_;   ///< to be sent with the next answer
  Stopwatch status_age_;
  std::optional<control_status_t> told_;
};

}  // namespace bodyschema
