#pragma once

#include <ceres/cost_function.h>
#include <ceres/loss_function.h>

#include <Eigen/Core>
#include <memory>
#include <optional>
#include <vector>

#include "common/camera/lens.h"
#include "common/estimation/measurement_model.h"
#include "processes/refiner/parameter_block.h"
#include "processes/refiner/part_chain.h"
#include "processes/refiner/refiner_sample.h"

namespace bodyschema {

/// Student_t.h's robust_cost() of so many residuals: ρ(s) = (ν + n) log(1 + s/ν).
class StudentTLoss final : public ceres::LossFunction {
 public:
  explicit StudentTLoss(int num_residuals) : num_residuals_(num_residuals) {}
  void Evaluate(double s, double rho[3]) const override;

 private:
  const int num_residuals_;
};

/// Standard deviations of the residuals are this many times as large as their covariances say.
struct NoiseScale {
  double value = 1;
};

/// What the drive's scalars add to each joint at an action, joint by scalar; the observations of a
/// sample share one. Null: there is no drive.
using DriveEffects = std::shared_ptr<const Eigen::MatrixXd>;

/// Base of what depends on a part's pose: blocks are those of the chain, then those of the tag and
/// the lens, where there are any. Where there is a block of the instant it has the joints' plays
/// last: it is the chain's first if the root moves, else it comes then. The drive's, where there is
/// one, comes last.
class ChainResidual : public ceres::CostFunction {
 protected:
  ChainResidual(PartChain chain, const std::vector<const ParameterBlock*>& blocks,
                int num_residuals, const NoiseScale& scale, DriveEffects effects);
  /// The pose of the chain, times `suffix`. `by_chain`, if given, receives the derivatives by the
  /// blocks of the chain, `by_joints` by how far the joints go beyond their commands.
  Pose pose(double const* const* parameters, const Pose& suffix,
            std::vector<PartChain::Jacobian>* by_chain, PartChain::Jacobian* by_joints) const;

  using Derivative = Eigen::Ref<const Eigen::MatrixXd>;
  /// Writes the free columns of ∂r/∂tangent of a block into Ceres' array for it, if it wants one.
  void write(double** jacobians, int block, const Derivative& derivative) const;
  /// Of the blocks of the chain, of the instant and of the drive, by what pose() gave.
  void write_chain(double** jacobians, const Derivative& by_pose,
                   std::vector<PartChain::Jacobian> by_chain,
                   const PartChain::Jacobian& by_joints) const;

  /// Which block has the plays, and where they begin in its values.
  struct Play {
    int block = -1, value = 0, num = 0;
  };

  const PartChain chain_;
  const std::vector<const ParameterBlock*> blocks_;
  const NoiseScale& scale_;
  const DriveEffects effects_;
  const Play play_;

 private:
  Play find_play() const;
  /// By how far each joint goes beyond its command: its play at the instant, and the drive's.
  Eigen::VectorXd joint_offsets(double const* const* parameters) const;
};

/// Corners of a tag M on part B, 8 whitened residuals [σ]: predicted minus measured.
class CornerResidual final : public ChainResidual {
 public:
  /// Blocks after the chain's: the tag's (X_BM and the size's factor), the lens's
  /// (Lens::parameters()). `covariance_px2` is positive definite.
  CornerResidual(PartChain chain, const std::vector<const ParameterBlock*>& blocks, double size_m,
                 const Lens& lens, const TagSight& sight, const Matrix8d& covariance_px2,
                 const NoiseScale& scale, DriveEffects effects = nullptr);
  /// False if a corner lies behind the camera.
  bool Evaluate(double const* const* parameters, double* residuals,
                double** jacobians) const override;

 private:
  /// ∂pixel/∂lens of one corner, by central differences.
  Eigen::Matrix<double, 2, Eigen::Dynamic> by_lens(const Eigen::VectorXd& lens,
                                                   const Eigen::Vector2d& ray) const;

  const double size_m_;
  const Lens lens_;
  const Eigen::Matrix<double, 8, 1> measured_px_;
  const Matrix8d whitener_;
};

/// An observed pose, 6 whitened residuals Log(X_CB⁻¹ y), by the reading that fits better.
class PoseResidual final : public ChainResidual {
 public:
  PoseResidual(PartChain chain, const std::vector<const ParameterBlock*>& blocks,
               const PartObservation& observation, const MeasurementModel& measurement,
               const NoiseScale& scale, DriveEffects effects = nullptr);
  bool Evaluate(double const* const* parameters, double* residuals,
                double** jacobians) const override;

 private:
  struct Reading {
    Pose X_CB;
    Matrix6d whitener;
  };
  std::vector<Reading> readings_;
};

/// An observed position alone, 3 whitened residuals in the camera's axes.
class PositionResidual final : public ChainResidual {
 public:
  PositionResidual(PartChain chain, const std::vector<const ParameterBlock*>& blocks,
                   const PartObservation& observation, const MeasurementModel& measurement,
                   const NoiseScale& scale, DriveEffects effects = nullptr);
  bool Evaluate(double const* const* parameters, double* residuals,
                double** jacobians) const override;

 private:
  const Eigen::Vector3d p_CB_;
  Eigen::Matrix3d whitener_;
};

/// How far joints are from their commands at one instant, over their standard deviations, which may
/// be changed between evaluations. `sd`: of the scalars of an instant's block.
class PlayResidual final : public ceres::CostFunction {
 public:
  PlayResidual(const ParameterBlock& block, const Eigen::VectorXd& sd);
  bool Evaluate(double const* const* parameters, double* residuals,
                double** jacobians) const override;

 private:
  const int num_values_;
  const Eigen::VectorXd& sd_;
};

/// What is known of a block beforehand: the change of each free direction over its standard
/// deviation. `sd`: of the block's whole tangent.
class PriorResidual final : public ceres::CostFunction {
 public:
  PriorResidual(const ParameterBlock& block, const Eigen::VectorXd& sd);
  bool Evaluate(double const* const* parameters, double* residuals,
                double** jacobians) const override;

 private:
  const ParameterBlock block_;
  Eigen::VectorXd sd_;
};

}  // namespace bodyschema
