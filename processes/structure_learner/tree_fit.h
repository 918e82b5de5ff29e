#pragma once

#include <optional>
#include <utility>
#include <vector>

#include "processes/structure_learner/joints/joint_insertion.h"
#include "processes/structure_learner/validity.h"

namespace bodyschema {

/// Does a part keep its pose in the camera's frame? `data` are its make_part_data(); true if a
/// rigid model of them is valid.
bool is_at_rest(const PairData& data, const NormalizedActions& actions,
                const ValidityOptions& options);

/// All poses of a tree's parts fitted at once, to judge its edges by every marker and not only by
/// the two they connect.
///
/// x_y(t) = X_C,root(t) ∏ Δ_e(q_t) along the path to y, residual Log(x_y⁻¹ y) in the marker's own
/// noise: no lever arm, and all parts beyond a joint are its witnesses. The root rests (one pose),
/// or has a free pose at each instant, which is eliminated (Schur complement) and costs a good part
/// of the evidence near it.
///
/// Gauss–Newton on the tree: with all twists in the camera's frame the normal matrix of edges e
/// above e' is Σ_t S_eᵀ I_e'(t) S_e', where I_e' is the information of all markers beyond e' (the
/// composite inertias of the rigid-body algorithms, Featherstone 2008, ch. 6).
class TreeFit {
 public:
  /// `data`: make_part_data() of each node, in their order. `nodes`: parents before children.
  TreeFit(std::vector<TreeNode> nodes, std::vector<PairData> data, const NormalizedActions& actions,
          bool root_rests);

  /// Levenberg–Marquardt with Student-t weights until a step gains less than `tolerance` [nats].
  void fit(int max_iterations, double tolerance);

  const std::vector<TreeNode>& nodes() const { return nodes_; }
  /// The pose of a root that rests in the camera's frame.
  const Pose& root_pose() const { return roots_.front(); }
  double cost() const { return cost_; }  ///< Σ (ν + n)/2 · log(1 + d²/ν)
  double log_likelihood() const;         ///< −cost − ½ Σ log|2πΣ|
  int num_frames() const { return static_cast<int>(samples_.size()); }

  /// Covariance of the fit's parameters, normalised; right perturbations. The covariance of the
  /// score, by what is told of the measurements, between two inverse Hessians (the sandwich of an
  /// M-estimator). What does not average out: the errors of a tag, which all its sights share; of
  /// near-identical views of a part its systematic error and `view_share` of the variance of its
  /// noise. Noise that lasts is found in what the fit leaves.
  struct Covariance {
    Matrix6d root = Matrix6d::Zero();     ///< of root_pose()
    std::vector<ParameterMatrix> models;  ///< by node
    /// By node, in its part's frame: what the edges that meet there have in common with opposite
    /// sign, for the part's frame is where its markers were seen. Zero at leaves.
    std::vector<Matrix6d> frames;
  };
  /// std::nullopt if the root moves, or the data do not determine the tree. `scatter`
  /// [half ranges]: of the joints of all nodes in their order, joint_scatter(); or empty.
  std::optional<Covariance> covariance(const MeasurementModel& measurement, double view_share,
                                       const Eigen::VectorXd& scatter = {}) const;

  /// Of the noise, from one sample to the next; 0 in a stream, whose blocks have it already.
  double serial_correlation() const;

  bool root_rests() const { return root_rests_; }
  const NormalizedActions& actions() const { return actions_; }
  int sample(int frame) const { return samples_[frame]; }
  /// In the camera's frame.
  const Pose& pose(int frame, int node) const { return poses_[at(frame, node)]; }
  bool is_seen(int node) const { return data_[node].size() > 0; }
  /// By node: twists of the joints of its edge in the camera's frame, a column each.
  std::vector<MotionJacobian> joint_twists(int frame) const;
  /// nullptr where the frame did not see the node.
  const FrameFit* reading(int frame, int node) const {
    const int index = at(frame, node);
    return frame_index_[index] < 0 ? nullptr : &fits_[index];
  }
  bool is_below(int node, int ancestor) const;  ///< or the same
  /// Index of a frame and node in Normal.
  int at(int frame, int node) const { return frame * static_cast<int>(nodes_.size()) + node; }
  struct Normal;  // tree_fit_normal.h
  Normal normal_equations() const;

 private:
  double evaluate(const std::vector<TreeNode>& nodes, const std::vector<Pose>& roots,
                  std::vector<Pose>* poses, std::vector<FrameFit>* fits) const;
  void start_roots();
  void gather(int frame, Normal* normal) const;
  void add_frame(int frame, Normal* normal) const;
  // The tree after a step of the parameters, and what the eliminated roots make of it.
  void move_by(const Eigen::VectorXd& step, const Normal& normal, std::vector<TreeNode>* nodes,
               std::vector<Pose>* roots) const;
  std::vector<int> views_of(int node) const;
  Eigen::MatrixXd with_fixed_gauge(const Normal& normal) const;
  Eigen::MatrixXd score_covariance(const Normal& normal, const MeasurementModel& measurement,
                                   double view_share, double correlation_time) const;
  void add_lasting(const Normal& normal, int node,
                   const std::vector<std::pair<int, Matrix6d>>& effects, double coefficient,
                   Eigen::MatrixXd* sum) const;
  void add_scatter(const Normal& normal, const Eigen::VectorXd& scatter,
                   Eigen::MatrixXd* sum) const;
  Eigen::MatrixXd scores(const Normal& normal) const;
  std::vector<Matrix6d> frame_covariances(const Normal& normal, const Eigen::MatrixXd& joint) const;
  void add_composites(const Normal& normal, std::vector<Matrix6d> own, Eigen::MatrixXd* sum) const;

  std::vector<TreeNode> nodes_;
  std::vector<PairData> data_;
  const NormalizedActions& actions_;
  bool root_rests_;
  std::vector<int> samples_;      // of the frames
  std::vector<int> frame_index_;  // at(frame, node) → index into data_[node].frames, −1: not seen
  std::vector<Pose> roots_;       // one, or one a frame
  std::vector<Pose> poses_;       // at(frame, node), in the camera's frame
  std::vector<FrameFit> fits_;    // at(frame, node)
  double cost_ = 0;
};

}  // namespace bodyschema
