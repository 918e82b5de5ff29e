#pragma once

#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "common/camera/fit_pose.h"
#include "common/config/calibration_id.h"
#include "common/estimation/evaluation.h"
#include "common/schema/body_schema.h"
#include "processes/refiner/refiner_config.h"
#include "processes/refiner/refiner_sample.h"

namespace bodyschema {

/// By how many command units gravity moves each joint at an action per unit of its compliance, in
/// the order of the schema's edges of screws and their joints: the torque [N m] about its axis over
/// its gain; of a joint that slides alone the force [N].
using JointLoads = std::function<Eigen::VectorXd(const Eigen::VectorXd& action)>;

struct RefineOptions {
  bool placements = false;  ///< also where the tags sit, and how large they are
  bool intrinsics = false;  ///< also focal lengths, centre and distortion
  RefinerConfig config;
  CornerNoise corner_noise;      ///< of corners without a covariance of their own
  MeasurementModel measurement;  ///< of poses
  /// Where poses are fitted: also fit joints that give way to these loads.
  JointLoads joint_loads;
};

/// A parameter after the refinement.
struct RefinedParameter {
  std::string name;          ///< "offset of q5 (5→6)", "placement of tag 12, about z"
  int tag = -1;              ///< that it is of; −1: of the root, an edge or the lens
  std::string unit;          ///< "m", "rad", "px", "1", "m/unit", "rad/unit"
  double change = 0;         ///< since the start, in `unit`
  std::optional<double> sd;  ///< none: the samples do not determine it
};

struct ParameterCorrelation {
  std::string one, other;
  double correlation = 0;
  std::string advice;  ///< which further samples would tell them apart; "" if unknown
};

struct RefinementOutlier {
  std::int64_t sample_index = 0;
  int part = 0;
  int tag = -1;                  ///< −1: a pose
  std::int64_t image_utime = 0;  ///< [us] of the sample's last image
  double distance = 0;           ///< Mahalanobis distance [σ]
};

struct SignalCoverage {
  std::string signal;
  double share = 0;  ///< of the range between its limits that the fitted samples span
};

/// How well a model predicts samples that it was not fitted to.
struct HeldOutErrors {
  int num_samples = 0;
  std::vector<PartErrors> parts;    ///< in the root's frame, of all parts but the root
  std::optional<double> px_rms;     ///< per coordinate of a corner; none without corners
  std::optional<double> px_median;  ///< of a corner's distance
  /// −log likelihood of the corners of each sample that shows some (robust_cost() of their tags).
  std::vector<double> corner_costs;
};

/// How far a joint is from its command, 1 σ over the samples: backlash and droop. 0: the
/// samples are no likelier with it.
struct JointPlay {
  std::string joint;  ///< "q5 (5→6)"
  double slide_m = 0, turn_rad = 0;
};

/// A command that was linear before the refinement, and is bent.
struct RefinedBend {
  std::string signal;
  double evidence = 0;  ///< [nats] over a linear command, all else free
  double largest = 0;   ///< farthest from a line over the range [command units]
};

/// An action that is expected to tell much.
struct WantedAction {
  Eigen::VectorXd action;  ///< one value per signal, command units
  /// Share by which the worst predicted deviation of a part falls with it and those before it …
  double fall = 0;
  /// … and the same of what would go if all wanted actions were taken a hundred times: the rest is
  /// of what no action tells, above all sizes and placements of tags.
  double reducible_fall = 0;
};

/// How far a joint gives way to its load.
struct JointCompliance {
  std::string joint;  ///< "q5 (5→6)"
  std::string unit;   ///< "rad/(N m)" or "m/N"
  double value = 0;
  double sd = 0;        ///< 0: its load does not change, it was not fitted
  double evidence = 0;  ///< [nats] of its own against a stiff joint, by its value and sd (BIC)
  double droop = 0;     ///< its largest displacement by the load at a fitted sample [rad, m]

  /// It moves against its load: no joint does, but a drive that makes up for too much of it.
  bool rises() const { return value < 0 && evidence > 0; }
};

/// Joints that give way to gravity beside stiff ones, each with a geometry of its own.
struct Elasticity {
  BodySchema schema;  ///< of the unloaded robot
  std::vector<JointCompliance> joints;
  double evidence = 0;  ///< [nats] of all compliances against stiff joints (BIC)
  struct Errors {
    double noise_scale = 1;          ///< Refinement::noise_scale
    std::vector<PartErrors> fitted;  ///< on the fitted samples
    std::vector<PartErrors> held_out;
  };
  Errors stiff, elastic;
};

struct Refinement {
  BodySchema schema;
  RigCalibration rig;  ///< refined; as claimed where nothing of it was
  bool used_corners = false, root_moves = false;
  int num_samples = 0, num_available = 0;  ///< fitted, and of how many
  int num_observations = 0;                ///< tags seen, or poses
  double seconds = 0;
  int num_iterations = 0;
  /// The residuals are this many times as large as told (≥ 1).
  double noise_scale = 1;
  /// Of the residuals of one sample with those of the next; 0 unless significant. Deviations are
  /// those of errors that last so.
  double serial_correlation = 0;
  std::vector<RefinedParameter> parameters;
  std::vector<std::string> undetermined;           ///< directions, in words
  std::vector<ParameterCorrelation> correlations;  ///< above kHighCorrelation, the highest first
  int num_outliers = 0;
  std::vector<RefinementOutlier> outliers;  ///< the farthest kMostOutliers first
  std::vector<std::string> warnings;        ///< why the answer is not to be trusted
  std::vector<SignalCoverage> coverage;
  std::vector<JointPlay> plays;    ///< where corners were fitted, or poses are likelier with them
  std::vector<RefinedBend> bends;  ///< in the order in which they were found
  std::optional<Elasticity> elasticity;  ///< where loads were given that change
  std::vector<std::string> held;         ///< what was not refined, and why
  /// kMostWantedActions, that of most help first; none where no signal moves what is refined.
  std::vector<WantedAction> wanted_actions;
  HeldOutErrors before, after;
};
inline constexpr double kHighCorrelation = 0.95;
inline constexpr std::size_t kMostOutliers = 50;  ///< chosen: what a person reads
inline constexpr int kMostWantedActions = 10;

/// Fits all parameters of a schema at once to TRAIN and PROBE samples, with Student-t weights:
/// where the root stands, every screw, and the bends of commands, new ones where the samples show
/// them (kWarpEvidence). While tags and lens are as the rig says, the data are the parts' poses,
/// which were made by these: their covariances know of errors of tags and lens, corners do not.
/// With tags or lens among the parameters, the data are the corners' pixels, the rig's claims are
/// priors, and at every sample each joint may be off its command (backlash, droop) by what is
/// estimated to be usual; samples without corners are not fitted then. Where poses are fitted
/// and no loads are given, joints are so if the marginal likelihood (Laplace) gains more than BIC
/// asks; these plays become ScrewJoint::scatter. Edges with a Gaussian process, the bends of what
/// moves them, and signals' limits stay as they are. Loads of the joints are fitted beside,
/// commands then bend no more than they did: the refined schema has stiff joints, for a schema
/// knows no loads. TEST samples are judged alone. The order of samples changes nothing.
///
/// Gauge: a part's frame is where its tags are closest to the rig's claims, and the scale is the
/// mean of all tags' sizes, all weighed by their priors, for images tell neither.
/// @throws std::invalid_argument for people: nothing to fit, corners missing that are asked for,
/// another rig, numbers that are not finite.
Refinement refine(const BodySchema& schema, std::vector<RefinerSample> samples,
                  const std::optional<RigCalibration>& rig, const RefineOptions& options);

}  // namespace bodyschema
