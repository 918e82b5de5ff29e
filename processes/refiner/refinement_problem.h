#pragma once

#include <ceres/crs_matrix.h>
#include <ceres/problem.h>
#include <ceres/solver.h>

#include <deque>
#include <map>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "common/camera/lens.h"
#include "common/config/rig.h"
#include "processes/refiner/drive_model.h"
#include "processes/refiner/parameter_block.h"
#include "processes/refiner/part_chain.h"
#include "processes/refiner/refine.h"
#include "processes/refiner/residuals.h"

namespace bodyschema {

/// What a schema, the rig's calibration and samples make for Ceres: blocks of parameters, residuals
/// of the tags' corners (or of parts' poses), priors.
class RefinementProblem {
 public:
  /// One observation: a tag's corners, or a part's pose.
  struct Datum {
    ceres::ResidualBlockId id = nullptr;
    int num_residuals = 0;
    std::int64_t sample_index = 0, utime = 0;
    int part = 0;
    int tag = -1;                                  ///< −1: of a pose
    const PartObservation* observation = nullptr;  ///< of a pose
  };

  /// `samples`: those to fit, as select_samples() has them. `rig`: none where poses are fitted. A
  /// part that hangs on nothing is passed over. `poses_have_plays`: joints may be off their
  /// commands also where poses are fitted, whose covariances else hold that. All arguments must
  /// outlive this.
  /// @throws std::invalid_argument.
  RefinementProblem(const BodySchema& schema, const std::vector<RefinerSample>& samples,
                    const std::optional<RigCalibration>& rig, const RefineOptions& options,
                    bool root_moves, bool poses_have_plays = false);

  /// An observation as a residual, and the blocks that it depends on.
  struct Cost {
    std::unique_ptr<ceres::CostFunction> function;
    std::vector<ParameterBlock*> blocks;
    int part = 0;
  };
  /// Of a tag's corners at an action; nothing if the rig has no such tag, or its part hangs on
  /// nothing or is predicted behind the camera.
  std::optional<Cost> cost_of(const TagSight& sight, const Eigen::VectorXd& action,
                              std::int64_t sample_index);
  /// Of a part's pose; nothing if the part hangs on nothing.
  std::optional<Cost> cost_of(const PartObservation& observation, const Eigen::VectorXd& action,
                              std::int64_t sample_index);

  /// Begins where another problem of the same samples is now, with bends, and plays, where both
  /// have them.
  void begin_at(RefinementProblem& other);
  /// Levenberg–Marquardt with Student-t weights, the noise's scale estimated between its runs,
  /// until neither changes. A joint that rested stays as it was.
  void solve();

  /// Those that a residual depends on: instants, root, edges, tags ascending, lens.
  std::vector<ParameterBlock*> blocks();
  const std::vector<Datum>& data() const { return data_; }
  /// That it was made with.
  const BodySchema& schema() const { return schema_; }
  bool fits_corners() const { return rig_.has_value(); }
  double num_residuals() const;
  ceres::Problem& problem() { return problem_; }
  /// What Ceres makes of the values now; null: not wanted. @throws std::runtime_error.
  void evaluate(const ceres::Problem::EvaluateOptions& options, std::vector<double>* residuals,
                std::vector<double>* gradient, ceres::CRSMatrix* jacobian);
  /// Where Ceres knows a block's values. All are in one array, in the order of the blocks: Ceres
  /// orders blocks by address, and the same samples shall give the same bytes.
  double* memory_of(const ParameterBlock* block) { return &memory_[memory_offsets_.at(block)]; }
  double scale() const { return scale_.value; }
  int num_iterations() const { return num_iterations_; }
  /// Whether solve() came to where neither parameters nor scale and plays change.
  bool has_converged() const { return has_converged_; }
  /// Of each part the tag that was seen most often.
  std::vector<int> frame_tags() const;
  bool root_moves() const { return root_moves_; }
  struct Joint {
    int edge = 0, joint = 0;  ///< indices into the schema's edges, and the edge's joints
  };
  /// How far each joint is off its command, as solve() found it [command units]: by sample.
  std::map<std::int64_t, Eigen::VectorXd> plays_by_sample() const;
  /// The action of a sample.
  const Eigen::VectorXd& action_of(std::int64_t sample_index) const {
    return actions_.at(sample_index);
  }
  /// Joints that may be off their command at every sample, and by how much, 1 σ [command units].
  const std::vector<Joint>& plays() const { return plays_; }
  const Eigen::VectorXd& play_sd() const { return play_sd_; }
  /// Those that rested: solve() leaves their axes and gains as they were, which nothing tells.
  const std::vector<Joint>& joints_at_rest() const { return joints_at_rest_; }
  /// How many directions of a refined block solve() moves.
  int num_fitted(const ParameterBlock& block) const;
  /// Deviation of a direction of which nothing is known: 1 m, 1 rad, of a gain as much over half
  /// of its signal's range.
  double weak_sd(const ParameterBlock& block, int direction) const;
  /// Parts on the way to others that were never seen: their frames are held.
  const std::vector<int>& unseen_parts() const { return unseen_parts_; }
  /// As if every joint had gone where it was told.
  void zero_plays();
  /// Of the data now, given the scale; up to a constant.
  double log_likelihood();
  /// The same, integrated over the instants: plays, and poses of a moving root (Laplace).
  double log_marginal_likelihood();
  /// Largest standardised score (Rao) of a joint's variance of plays at 0, by the noise as told;
  /// about N(0, 1) for each joint without plays. Some joint must have plays, now 0.
  double play_score();
  /// After solve(): takes as exact the worse half of the joints whose plays gain less than this
  /// [nats] over none, the others' estimated. Returns whether there were some.
  bool drop_plays(double least_evidence);
  /// play_sd(), 0 of joints that are taken as exact or fit best as such.
  Eigen::VectorXd shown_play_sd() const;
  /// How many numbers of the data the plays took: the rest of each is its prior's.
  double num_determined_plays() const { return num_determined_plays_; }
  /// What drive_model() adds to the commands; null: nothing.
  ParameterBlock* drive() const { return drive_; }
  const DriveModel& drive_model() const { return drive_model_; }
  /// Derivative of the log posterior by the free directions of these blocks, now.
  Eigen::VectorXd score(const std::vector<ParameterBlock*>& blocks);
  /// Of the residuals of one sample with those of the next, in that axis of the part or the camera
  /// where it is largest; 0 unless significant and positive.
  double serial_correlation();
  /// d² of each datum now.
  std::vector<double> squared_distances();
  /// Standard deviations of a block's whole tangent beforehand; empty: nothing is known.
  Eigen::VectorXd prior_of(const ParameterBlock& block) const;
  /// Information beforehand of a direction, also by weak_sd() of what rested.
  double prior_information(const ParameterBlock& block, int direction) const;
  const std::map<int, std::vector<const Edge*>>& paths() const { return paths_; }
  /// Whether the sample's root has a pose: always where it rests.
  bool has_root(std::int64_t sample_index) const {
    return !root_moves_ || instants_.contains(sample_index);
  }
  /// The root's pose at a sample that has one, now.
  Pose X_CR(std::int64_t sample_index) {
    return pose_at(memory_of(root_moves_ ? instants_.at(sample_index) : root_));
  }
  /// Blocks of the edges with a block on the way to a part, the root's first (of a sample).
  std::vector<ParameterBlock*> chain_blocks(int part, std::int64_t sample_index);

 private:
  /// θ of every signal, and what the drive's scalars add to each joint.
  Eigen::VectorXd displacements(const Eigen::VectorXd& action) const;
  DriveEffects effects(const Eigen::VectorXd& action);
  void add_paths();
  void add_plays();
  void add_drive();
  void add_instants(const std::vector<RefinerSample>& samples);
  void add_tags();
  void add_lens();
  void add_corners(const RefinerSample& sample);
  void add_poses(const RefinerSample& sample);
  void add(Cost cost, Datum datum);
  void add_priors();
  void place_blocks();
  void hold_unseen_frames();
  std::optional<Pose> root_seen_in(const ActionPoseSample& sample) const;
  ceres::Solver::Options solver_options();
  double estimated_scale();
  double estimate_play();
  std::vector<ParameterBlock*> used_instants();
  double curvature_share();
  Eigen::ArrayXd determined_plays();
  Eigen::ArrayXd play_evidence();
  /// How far each joint is beyond its command there, now.
  Eigen::Map<const Eigen::ArrayXd> plays_at(const ParameterBlock& instant);
  /// Of each instant, given everything else: the data's and the plays' priors', instants ascending.
  std::vector<Eigen::MatrixXd> information_of_instants();
  /// Whether a signal hardly moved where parts beyond the edge were seen.
  bool rests(const Edge& edge, int signal) const;
  bool is_at_rest(const ParameterBlock& block, int direction) const;
  void set_free(ParameterBlock* block, const std::vector<int>& directions);
  /// Returns what was free in their blocks.
  std::map<ParameterBlock*, std::vector<int>> hold_joints_at_rest();

  const BodySchema& schema_;
  const std::optional<RigCalibration>& rig_;
  const RefineOptions& options_;
  const bool root_moves_, poses_have_plays_;
  const DriveModel drive_model_;
  std::optional<Lens> lens_;
  std::map<std::int64_t, Eigen::VectorXd> actions_;   // by sample
  std::map<int, std::vector<const Edge*>> paths_;     // by part
  std::deque<ParameterBlock> storage_;                // addresses stay
  ParameterBlock* root_ = nullptr;                    // that rests
  std::map<std::int64_t, ParameterBlock*> instants_;  // by sample
  std::vector<Joint> plays_, joints_at_rest_;
  std::vector<bool> is_exact_;  // by play
  Eigen::VectorXd play_sd_, play_start_;
  double num_determined_plays_ = 0;
  std::map<int, ParameterBlock*> edges_, tags_;  // by index, by id
  ParameterBlock* drive_ = nullptr;
  Eigen::VectorXd last_action_;  // that last_effects_ are of
  DriveEffects last_effects_;
  ParameterBlock* lens_block_ = nullptr;
  std::vector<double> memory_;
  std::map<const ParameterBlock*, std::size_t> memory_offsets_;
  NoiseScale scale_;
  StudentTLoss loss_of_corners_{8}, loss_of_poses_{6}, loss_of_positions_{3};
  std::deque<BlockManifold> manifolds_;
  std::set<const ParameterBlock*> used_;
  std::vector<Datum> data_;
  std::vector<int> unseen_parts_;
  int num_iterations_ = 0;
  bool has_converged_ = false;
  ceres::Problem problem_;
};

/// Standard deviation beforehand of a moving root's pose at an instant [m, rad].
inline constexpr double kInstantPrior = 1;

/// Is a direction taken as known where parameters are told apart? Placements of these tags, one a
/// part, and the size of the last, for all lengths have a common factor.
bool is_frame(const std::vector<int>& frame_tags, const ParameterBlock& block, int direction);

}  // namespace bodyschema
