#pragma once

#include <ceres/manifold.h>

#include <Eigen/Core>
#include <string>
#include <vector>

#include "common/geometry/pose.h"
#include "common/schema/body_schema.h"

namespace bodyschema {

/// A block of parameters as Ceres moves it: poses, each the 16 numbers of its matrix column by
/// column, and scalars, one after another. The tangent of a pose has 6 numbers (translation [m],
/// rotation [rad]), right perturbation; that of a scalar is itself.
struct ParameterBlock {
  /// kInstant: of one sample, the root's pose if it moves, and how far each joint is from its
  /// command. kDrive: of all joints, how they miss commands: see DriveModel.
  enum class Kind { kInstant, kRoot, kEdge, kDrive, kTag, kLens };
  static constexpr int kPoseSize = 16;

  Kind kind = Kind::kRoot;
  int id = 0;                      ///< index of the edge, id of the tag
  std::string elements;            ///< 'X' a pose, 's' a scalar
  std::vector<std::string> names;  ///< of the scalars of kDrive
  std::vector<double> values;
  std::vector<double> start;  ///< values before the refinement
  /// Directions that may move: ascending indices into the tangent of all elements.
  std::vector<int> free;
  bool is_refined = true;  ///< else known as well as its prior says, and held

  void add(const Pose& X);
  void add(double scalar);
  int tangent_size() const;  ///< of all elements, free or not
  int num_free() const { return static_cast<int>(free.size()); }
  /// x ⊞ δ, δ along `free`.
  void plus(const double* x, const double* delta, double* x_plus_delta) const;
  /// What all values have moved by since the start, tangent_size().
  Eigen::VectorXd change() const;
};

/// The pose at `values`, written by ParameterBlock::add().
Pose pose_at(const double* values);

/// Moves the free directions of a block. Cost functions write the derivative by these into the
/// first columns of their Jacobian, so that nothing is left to multiply: the tangent is the
/// linearisation that Ceres' LM steps in, and no other derivative by the matrices' 16 numbers
/// exists anywhere: nothing else of Ceres that asks for Jacobians may be used with it.
class BlockManifold final : public ceres::Manifold {
 public:
  explicit BlockManifold(const ParameterBlock& block) : block_(block) {}

  int AmbientSize() const override { return static_cast<int>(block_.values.size()); }
  int TangentSize() const override { return block_.num_free(); }
  bool Plus(const double* x, const double* delta, double* x_plus_delta) const override;
  bool PlusJacobian(const double* x, double* jacobian) const override;
  /// Never asked by a least-squares solver.
  bool Minus(const double*, const double*, double*) const override { return false; }
  bool MinusJacobian(const double*, double*) const override { return false; }

 private:
  const ParameterBlock& block_;
};

/// Block of an edge of screws, elements X (s s X)…: left, then slide, turn and X_after of each
/// joint, in the order of Edge::parameter_covariance. Free is what poses depend on: the frame of a
/// joint that turns may slide along its axis and turn about it, that of one that slides alone be
/// anywhere, so these directions are held, and with them a slide or turn of 0.
/// `is_position`: of the part beyond positions alone are known.
ParameterBlock edge_block(const Edge& edge, int index, bool is_position);
/// By how much half of its signal's range moves a joint [rad, m]; an edge's gain is in its screw.
double half_travel(const BodySchema& schema, const ScrewJoint& joint);
/// The edge with the block's values.
Edge edge_from(const ParameterBlock& block, Edge edge);
/// Place of the edge block's values: left is X_after of joint −1.
inline int value_of_transform(int joint) { return (joint + 1) * (ParameterBlock::kPoseSize + 2); }
inline int value_of_slide(int joint) { return value_of_transform(joint) - 2; }

}  // namespace bodyschema
