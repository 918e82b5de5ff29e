#pragma once

#include <Eigen/Core>
#include <map>
#include <vector>

#include "processes/refiner/parameter_block.h"
#include "processes/refiner/refine.h"

namespace bodyschema {

/// Whether a signal's bend may be refined: no edge with a Gaussian process, which stays as it is,
/// is moved by it.
bool is_bendable(const BodySchema& schema, int signal);

/// How far joints go beyond their commands, linear in the scalars of one block: a compliance of
/// each joint of edges of screws, where loads are given; then the weights of each bent command
/// (Signal::warp) that is bendable.
class DriveModel {
 public:
  /// `loads`: those at the actions of `samples` are fitted; none: joints are stiff. `schema` must
  /// outlive this.
  DriveModel(const BodySchema& schema, JointLoads loads, const std::vector<RefinerSample>& samples);

  /// Begins with stiff joints and the schema's weights. Compliances whose loads do not change,
  /// which are offsets, are not free.
  ParameterBlock block() const;
  /// θ of every signal without what the block has of it.
  Eigen::VectorXd displacements(const Eigen::VectorXd& action) const;
  /// What the block's scalars add to each joint [command units], joints in the order of the edges.
  Eigen::MatrixXd effects(const Eigen::VectorXd& action) const;
  /// Whether a scalar of the block is a weight, and the index of the signal that it bends.
  bool is_weight(int scalar) const { return signal_of(scalar) >= 0; }
  int signal_of(int weight) const;
  /// Copies the weights of the signals that both bend, by as many each.
  void copy_weights(const DriveModel& other, const double* from, double* to) const;
  /// Place of the first joint of each edge of screws among all their joints.
  const std::map<const Edge*, int>& first_joints() const { return first_joints_; }
  /// Standard deviations of the scalars, which have the mean 0; infinite for compliances. Those of
  /// weights fall as a Gaussian process's spectral density does; its length and amplitude are the
  /// likeliest ones of the schema's weights.
  Eigen::VectorXd prior_sd() const;
  /// Sets the weights of bent commands.
  void set_warps(const ParameterBlock& block, BodySchema* schema) const;

 private:
  void find_changing_loads(const std::vector<RefinerSample>& samples);

  const BodySchema& schema_;
  const JointLoads loads_;
  std::vector<int> changing_loads_;  ///< joints
  std::map<const Edge*, int> first_joints_;
  std::vector<int> signals_;          ///< by joint
  std::map<int, int> first_weights_;  ///< by bent signal, in the block
  int num_scalars_ = 0;
};

}  // namespace bodyschema
