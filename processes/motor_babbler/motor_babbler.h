#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <deque>
#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "bodyschema/action_command_t.hpp"
#include "bodyschema/body_schema_t.hpp"
#include "bodyschema/control_status_t.hpp"
#include "bodyschema/marker_poses_t.hpp"
#include "bodyschema/model_health_t.hpp"
#include "bodyschema/motion_status_t.hpp"
#include "bodyschema/sample_t.hpp"
#include "common/config/rig.h"
#include "common/schema/body_schema.h"
#include "processes/motor_babbler/action_choice.h"
#include "processes/motor_babbler/single_joint_moves.h"
#include "processes/motor_babbler/wanted_actions.h"

namespace bodyschema {

/// When babbling ends: after max_samples, or from min_samples on after a TEST sample for which the
/// monitor finds the schema complete and its worst part within both errors on at least
/// min_test_samples TEST samples.
struct StoppingRule {
  std::int64_t min_samples = 0;
  std::int64_t max_samples = 0;
  std::int64_t min_test_samples = 0;
  double position_m = 0;
  double rotation_rad = 0;
};

/// Choice of the next action: drawn, or by the information that the body schema expects from it.
enum class Choice { kRandom, kActive };

struct MotorBabblerConfig {
  std::vector<Signal> signals;
  Choice choice = Choice::kRandom;
  double extreme_share = 0;            ///< share of actions drawn from the ends of the ranges, 0..1
  double extreme_from = 0;             ///< these lie at extreme_from..1 of each half range
  double single_joint_share = 0;       ///< share of TRAIN actions, see SingleJointMoves, 0..1
  std::int64_t test_every = 0;         ///< every n-th sample is TEST
  std::int64_t expiry_us = 0;          ///< of a command, driver's time
  std::int64_t resend_us = 0;          ///< a command without an answer is sent again after this
  std::int64_t sample_timeout_us = 0;  ///< a settled action without a SAMPLE is given up after this
                                       ///< with camera and observer alive
  std::int64_t verdict_timeout_us = 0;  ///< a TEST sample's MODEL_HEALTH is awaited this long
  StoppingRule stop;

  /// Reads motor_babbler.yaml and signals.yaml beside it. @throws ConfigError.
  static MotorBabblerConfig load(const std::filesystem::path& file);
};

/// The action number `action_id` of a run: a pure function of the seed, so that a restart or a
/// rejected action changes nothing about the others.
Eigen::VectorXd random_action(const MotorBabblerConfig& config, std::int64_t seed,
                              std::int64_t action_id);
/// Candidates for action `action_id`: 40, uniform over the ranges. (With half of them near the ends
/// fewer structures are right if the view is narrow: docs/results.md, Active babbling.)
std::vector<Eigen::VectorXd> candidate_actions(const MotorBabblerConfig& config, std::int64_t seed,
                                               std::int64_t action_id);

/// Motor babbling: actions within the limits, one at a time, each answered by the driver and
/// followed by its SAMPLE, until the stopping rule holds. The driver refuses collisions: a
/// rejected action is replaced by the next.
///
/// Before the first MOTION_STATUS it does nothing (start guard), and it listens until it knows
/// whether the arm is lent out, 1.5 s at most. When the driver falls silent it repeats its last
/// command, which the driver answers without moving twice.
///
/// It does not move blind: a settled action whose SAMPLE does not come is replaced only after
/// sample_timeout in which frames of that rest and the observer (which repeats its newest SAMPLE at
/// 1 Hz) were heard. Otherwise it waits for them; when they are back that SAMPLE is made after all.
/// Before the first SAMPLE the observer cannot be heard: then one action is replaced.
///
/// While a STOP is latched it waits for RESUME; while the controller owns the arm it sends nothing,
/// however long the controller is silent. An action that was cut short by that is replaced by the
/// next. After each TEST sample it waits for the monitor's verdict, so that with a fast bus or a
/// slow learner the run ends at the same sample.
///
/// With Choice::kActive an action is chosen (choose_action) by the body schema that the monitor
/// published with its verdict on the newest TEST sample, and by the 500 newest samples: both are
/// the same in every run of a seed, however fast learner and monitor are. Drawn at random are:
/// actions before the first schema; TEST actions, so that held-out data do not depend on the
/// schema that they judge; replacements of actions that were refused, cut short or not seen, so
/// that no refusal is chosen again and again; and the actions up to the next TEST if schema or
/// verdict did not come within verdict_timeout (counted). If the verdict came with wanted actions
/// of the refiner (MODEL_HEALTH), those are taken before any is chosen, each once (WantedActions).
/// While the monitor itself waits for the refiner, its verdict is waited for.
///
/// If the verdict on a TEST sample comes with a probe (MODEL_HEALTH), the action that tells two
/// explanations of a change apart, the next action is that one, with purpose PROBE. Refused, it is
/// replaced as any other; still wanted after the next TEST sample, it is made again.
///
/// Some TRAIN actions move one joint alone (SingleJointMoves).
///
/// A restart with the kept state goes on as if nothing had happened: it sends the last command
/// again, unless that command's SAMPLE has come. Only its own samples are counted, so that every
/// test_every-th of them is TEST whatever other sources do in between.
class MotorBabbler {
 public:
  MotorBabbler(MotorBabblerConfig config, std::int64_t seed);

  std::optional<action_command_t> on_motion_status(const motion_status_t& status);
  std::optional<action_command_t> on_sample(const sample_t& sample);
  /// Shows that camera and marker_estimator see the arm at rest.
  void on_marker_poses(const marker_poses_t& poses);
  std::optional<action_command_t> on_model_health(const model_health_t& health);
  std::optional<action_command_t> on_body_schema(const body_schema_t& schema);
  /// Every SAMPLE of any source, once and in order of its index, as SampleIntake delivers them: the
  /// basis of a choice. on_sample() gets the newest when it comes, and its repetitions.
  std::optional<action_command_t> remember(const sample_t& sample);
  std::optional<action_command_t> on_control_status(const control_status_t& status);
  /// `now_us`: the clock. Detects silence.
  std::optional<action_command_t> on_tick(std::int64_t now_us);

  bool is_done() const { return done_; }
  /// Activity for people.
  std::string activity() const;
  /// Samples of its own actions, those of predecessors included.
  std::int64_t num_samples() const { return num_samples_; }
  std::int64_t num_rejected() const { return num_rejected_; }
  /// Settled actions whose SAMPLE never came.
  std::int64_t num_unseen() const { return num_unseen_; }
  /// TEST samples after which the body schema did not come in time.
  std::int64_t num_without_schema() const { return num_without_schema_; }
  /// Actions of the refiner that it made.
  std::int64_t num_wanted_taken() const { return wanted_actions_.num_taken(); }

  /// State for a restart, as YAML; to be on disk before a command is sent. "" before the first.
  std::string state_text() const;
  /// Continues from a file with state_text(). @throws ConfigError, also if it is of another seed.
  void restore(const std::filesystem::path& file);

 private:
  enum class Wait { kDriver, kAnswer, kSample, kVerdict, kRest, kDone };

  std::optional<action_command_t> begin();
  std::optional<action_command_t> act();
  /// act(), once everything that the next action rests on has come.
  std::optional<action_command_t> go_on();
  bool has_verdict() const { return health_.judged_sample >= last_test_sample_; }
  /// There was one at the verdict; that of `--initial` has version 0 until it changes.
  bool has_schema() const { return health_.schema_version > 0 || health_.num_edges > 0; }
  /// Tells single_joint_moves_ of the verdict on the newest TEST sample once both have come.
  void note_verdict();
  /// The next action is to be chosen, not drawn.
  bool is_to_choose() const;
  /// Verdict, its schema (if there is one at all) and every sample so far have come.
  bool can_choose() const;
  /// Takes the schema of the verdict once both have come.
  void take_schema();
  /// Makes the probe that the verdict on a TEST sample wants the next action.
  bool is_to_probe() const;
  Eigen::VectorXd next_action();
  std::int8_t next_purpose() const;
  /// The next action, if it moves one joint alone.
  std::optional<std::vector<double>> single_joint_action() const;
  /// Samples of its own actions that are not TEST.
  std::int64_t num_train() const { return num_samples_ - num_samples_ / config_.test_every; }
  bool may_move() const { return is_at_rest_ && !is_stopped_ && !is_lent_; }
  bool is_mine(const motion_status_t& status) const;
  bool should_stop() const;
  /// Reason why no SAMPLE can come, for people; "" if none is known.
  std::string blindness() const;

  const MotorBabblerConfig config_;
  const std::int64_t seed_;
  Wait wait_ = Wait::kDriver;
  std::int64_t epoch_ = 0;
  std::int64_t action_id_ = 0;
  std::int64_t num_samples_ = 0;
  std::int64_t num_rejected_ = 0;
  int num_rejected_in_a_row_ = 0;
  std::string rejection_;  ///< why the driver refused the last action that it refused
  std::int64_t num_unseen_ = 0;
  std::int64_t driver_utime_ = 0;
  std::int64_t last_sample_ = -1;       ///< sample_index of its newest
  std::int64_t last_test_sample_ = -1;  ///< the same of its newest TEST
  bool is_seen_ = false;                ///< the SAMPLE of command_ came
  bool is_restored_ = false;
  bool is_at_rest_ = false, is_stopped_ = false;
  bool is_lent_ = false;                ///< the controller owns the arm
  bool has_heard_control_ = false;      ///< or listened long enough
  std::int64_t started_us_ = -1;        ///< clock, as the first tick saw it
  std::int64_t control_since_us_ = -1;  ///< clock; since when CONTROL_STATUS is silent
  bool is_control_silent_ = false;
  std::int64_t wait_since_us_ = -1;  ///< clock; −1: not yet seen by a tick
  std::int64_t rest_utime_ = -1;     ///< driver's time since when the arm rests
  bool has_seen_frame_ = false, has_heard_observer_ = false;  ///< since the last tick
  bool has_ever_heard_observer_ = false;
  std::int64_t frame_us_ = 0, observer_us_ = 0;  ///< clock, when these were last so; 0: not yet
  std::int64_t now_us_ = 0;                      ///< clock, as the last tick saw it
  int num_unseen_in_a_row_ = 0;
  bool done_ = false;
  action_command_t command_{};
  model_health_t health_{};
  body_schema_t heard_schema_{};      ///< the newest
  std::int64_t schema_version_ = -1;  ///< of schema_, by which is chosen; −1: none was heard
  BodySchema schema_;
  std::deque<SeenAction> memory_;
  SingleJointMoves single_joint_moves_;
  WantedActions wanted_actions_;
  std::int64_t without_schema_since_ = -1;  ///< TEST sample whose verdict or schema was given up
  std::int64_t num_without_schema_ = 0;
};

}  // namespace bodyschema
