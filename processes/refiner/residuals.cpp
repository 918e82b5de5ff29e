#include "processes/refiner/residuals.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <utility>

#include "common/estimation/student_t.h"

namespace bodyschema {
namespace {

using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

template <class Matrix>
Matrix whitener_from(const Matrix& covariance) {
  const Eigen::LLT<Matrix> llt(covariance);
  if (llt.info() != Eigen::Success)
    throw std::invalid_argument("a covariance of the samples is not positive definite");
  return llt.matrixL().solve(Matrix::Identity());
}

}  // namespace

void StudentTLoss::Evaluate(double s, double rho[3]) const {
  rho[0] = 2 * robust_cost(s, num_residuals_);
  rho[1] = robust_weight(s, num_residuals_);
  rho[2] = -rho[1] / (kStudentNu + s);
}

ChainResidual::ChainResidual(PartChain chain, const std::vector<const ParameterBlock*>& blocks,
                             int num_residuals, const NoiseScale& scale, DriveEffects effects)
    : chain_(std::move(chain)),
      blocks_(blocks),
      scale_(scale),
      effects_(std::move(effects)),
      play_(find_play()) {
  if (effects_ && play_.num > 0 && effects_->rows() != play_.num)
    throw std::logic_error("the drive has other joints than those that are off their commands");
  set_num_residuals(num_residuals);
  for (const ParameterBlock* block : blocks_)
    mutable_parameter_block_sizes()->push_back(static_cast<int>(block->values.size()));
}

ChainResidual::Play ChainResidual::find_play() const {
  const auto found = std::ranges::find(blocks_, ParameterBlock::Kind::kInstant,
                                       [](const ParameterBlock* block) { return block->kind; });
  if (found == blocks_.end()) return {};
  const std::string& elements = (*found)->elements;
  const bool has_root = elements.starts_with("X");
  return {.block = static_cast<int>(found - blocks_.begin()),
          .value = has_root ? ParameterBlock::kPoseSize : 0,
          .num = static_cast<int>(elements.size()) - (has_root ? 1 : 0)};
}

Eigen::VectorXd ChainResidual::joint_offsets(double const* const* parameters) const {
  Eigen::VectorXd sum = Eigen::VectorXd::Zero(effects_ ? effects_->rows() : play_.num);
  if (play_.num > 0)
    sum += Eigen::Map<const Eigen::VectorXd>(parameters[play_.block] + play_.value, play_.num);
  if (effects_)
    sum += *effects_ *
           Eigen::Map<const Eigen::VectorXd>(parameters[blocks_.size() - 1], effects_->cols());
  return sum;
}

Pose ChainResidual::pose(double const* const* parameters, const Pose& suffix,
                         std::vector<PartChain::Jacobian>* by_chain,
                         PartChain::Jacobian* by_joints) const {
  const Eigen::VectorXd beyond = joint_offsets(parameters);
  if (beyond.size() == 0) return chain_.pose(parameters, suffix, by_chain);
  if (by_joints) by_joints->setZero(6, beyond.size());
  return chain_.pose(parameters, suffix, by_chain, beyond.data(), by_joints);
}

void ChainResidual::write(double** jacobians, int block, const Derivative& derivative) const {
  if (!jacobians || !jacobians[block]) return;
  Eigen::Map<RowMajor> J(jacobians[block], num_residuals(),
                         static_cast<Eigen::Index>(blocks_[block]->values.size()));
  J.setZero();
  const std::vector<int>& free = blocks_[block]->free;
  for (std::size_t n = 0; n < free.size(); ++n)
    J.col(static_cast<Eigen::Index>(n)) = derivative.col(free[n]);
}

void ChainResidual::write_chain(double** jacobians, const Derivative& by_pose,
                                std::vector<PartChain::Jacobian> by_chain,
                                const PartChain::Jacobian& by_joints) const {
  if (!jacobians) return;
  if (play_.num > 0 && play_.block == 0) {
    by_chain[0].conservativeResize(6, 6 + play_.num);
    by_chain[0].rightCols(play_.num) = by_joints;
  }
  for (int block = 0; block < static_cast<int>(by_chain.size()); ++block)
    if (jacobians[block]) write(jacobians, block, by_pose.lazyProduct(by_chain[block]));
  if (play_.num > 0 && play_.block > 0) write(jacobians, play_.block, by_pose * by_joints);
  if (effects_)
    write(jacobians, static_cast<int>(blocks_.size()) - 1, by_pose * by_joints * *effects_);
}

CornerResidual::CornerResidual(PartChain chain, const std::vector<const ParameterBlock*>& blocks,
                               double size_m, const Lens& lens, const TagSight& sight,
                               const Matrix8d& covariance_px2, const NoiseScale& scale,
                               DriveEffects effects)
    : ChainResidual(std::move(chain), blocks, 8, scale, std::move(effects)),
      size_m_(size_m),
      lens_(lens),
      measured_px_(sight.corners_px),
      whitener_(whitener_from(covariance_px2)) {}

Eigen::Matrix<double, 2, Eigen::Dynamic> CornerResidual::by_lens(const Eigen::VectorXd& lens,
                                                                 const Eigen::Vector2d& ray) const {
  Eigen::Matrix<double, 2, Eigen::Dynamic> J(2, lens.size());
  for (Eigen::Index n = 0; n < lens.size(); ++n) {
    // Pixels are linear in all parameters but the denominator of the rational model.
    const double step = 1e-4 * std::max(std::abs(lens(n)), 1.0);
    Eigen::VectorXd more = lens, less = lens;
    more(n) += step;
    less(n) -= step;
    J.col(n) = (lens_.with(more).project(ray) - lens_.with(less).project(ray)) / (2 * step);
  }
  return J;
}

bool CornerResidual::Evaluate(double const* const* parameters, double* residuals,
                              double** jacobians) const {
  const int tag = chain_.num_blocks(), lens_block = tag + 1;
  const Pose X_BM = pose_at(parameters[tag]);
  const double size_m = size_m_ * parameters[tag][ParameterBlock::kPoseSize];
  const Eigen::VectorXd lens_parameters = Eigen::Map<const Eigen::VectorXd>(
      parameters[lens_block], static_cast<Eigen::Index>(blocks_[lens_block]->values.size()));
  if (!(size_m > 0 && lens_parameters.head<2>().minCoeff() > 0)) return false;
  const Lens lens = lens_.with(lens_parameters);
  std::vector<PartChain::Jacobian> by_chain;
  PartChain::Jacobian by_joints;
  const Pose X_CM =
      pose(parameters, X_BM, jacobians ? &by_chain : nullptr, jacobians ? &by_joints : nullptr);

  Eigen::Matrix<double, 8, 1> error;
  Eigen::Matrix<double, 8, 7> by_tag;  // pose of the tag, then the size's factor
  Eigen::Matrix<double, 8, Eigen::Dynamic> by_lens_parameters(8, lens_parameters.size());
  const std::vector<Eigen::Vector3d> corners = tag_corners(size_m);
  for (int c = 0; c < 4; ++c) {
    const Eigen::Vector3d p_C = X_CM * corners[c];
    constexpr double kNearest_m = 1e-3;
    if (!(p_C.z() > kNearest_m)) return false;
    const Eigen::Vector2d ray = p_C.head<2>() / p_C.z();
    error.segment<2>(2 * c) = lens.project(ray) - measured_px_.segment<2>(2 * c);
    if (!jacobians) continue;
    Eigen::Matrix<double, 2, 3> dray_dp;
    dray_dp << 1, 0, -ray.x(), 0, 1, -ray.y();
    const Eigen::Matrix<double, 2, 3> J = lens.px_per_ray(ray) * dray_dp / p_C.z() * X_CM.linear();
    by_tag.block<2, 3>(2 * c, 0) = J;
    by_tag.block<2, 3>(2 * c, 3) = -J * skew(corners[c]);
    by_tag.block<2, 1>(2 * c, 6) = J * tag_corners(size_m_)[c];
    if (jacobians[lens_block])
      by_lens_parameters.middleRows<2>(2 * c) = by_lens(lens_parameters, ray);
  }
  const Matrix8d whitener = whitener_ / scale_.value;
  Eigen::Map<Eigen::Matrix<double, 8, 1>>(residuals, 8) = whitener * error;
  if (!jacobians) return true;
  const Eigen::Matrix<double, 8, 7> whitened = whitener * by_tag;
  write_chain(jacobians, whitened.leftCols<6>(), std::move(by_chain), by_joints);
  write(jacobians, tag, whitened);
  if (jacobians[lens_block]) write(jacobians, lens_block, whitener * by_lens_parameters);
  return true;
}

PoseResidual::PoseResidual(PartChain chain, const std::vector<const ParameterBlock*>& blocks,
                           const PartObservation& observation, const MeasurementModel& measurement,
                           const NoiseScale& scale, DriveEffects effects)
    : ChainResidual(std::move(chain), blocks, 6, scale, std::move(effects)) {
  const Matrix6d covariance = measurement.covariance(observation);
  readings_.push_back({observation.X_CB, whitener_from(covariance)});
  if (observation.X_CB_other && observation.error_ratio <= measurement.max_error_ratio)
    readings_.push_back(
        {*observation.X_CB_other, whitener_from(covariance_of_other(observation, covariance))});
}

bool PoseResidual::Evaluate(double const* const* parameters, double* residuals,
                            double** jacobians) const {
  std::vector<PartChain::Jacobian> by_chain;
  PartChain::Jacobian by_joints;
  const Pose X_CB = pose(parameters, Pose::Identity(), jacobians ? &by_chain : nullptr,
                         jacobians ? &by_joints : nullptr);
  Vector6d best, error = Vector6d::Zero();
  const Reading* reading = nullptr;
  for (const Reading& candidate : readings_) {
    const Vector6d difference = log(X_CB.inverse() * candidate.X_CB);
    const Vector6d whitened = candidate.whitener * difference / scale_.value;
    if (reading && whitened.squaredNorm() >= best.squaredNorm()) continue;
    reading = &candidate;
    best = whitened;
    error = difference;
  }
  Eigen::Map<Vector6d>(residuals, 6) = best;
  if (jacobians)
    write_chain(jacobians, -(reading->whitener / scale_.value) * right_jacobian_inverse(-error),
                std::move(by_chain), by_joints);
  return true;
}

PositionResidual::PositionResidual(PartChain chain,
                                   const std::vector<const ParameterBlock*>& blocks,
                                   const PartObservation& observation,
                                   const MeasurementModel& measurement, const NoiseScale& scale,
                                   DriveEffects effects)
    : ChainResidual(std::move(chain), blocks, 3, scale, std::move(effects)),
      p_CB_(observation.X_CB.translation()),
      whitener_(whitener_from(
          Eigen::Matrix3d(measurement.covariance(observation).topLeftCorner<3, 3>()))) {}

bool PositionResidual::Evaluate(double const* const* parameters, double* residuals,
                                double** jacobians) const {
  std::vector<PartChain::Jacobian> by_chain;
  PartChain::Jacobian by_joints;
  const Pose X_CB = pose(parameters, Pose::Identity(), jacobians ? &by_chain : nullptr,
                         jacobians ? &by_joints : nullptr);
  const Eigen::Matrix3d whitener = whitener_ / scale_.value;
  Eigen::Map<Eigen::Vector3d>(residuals, 3) = whitener * (X_CB.translation() - p_CB_);
  if (!jacobians) return true;
  Eigen::Matrix<double, 3, 6> by_pose = Eigen::Matrix<double, 3, 6>::Zero();
  by_pose.leftCols<3>() = whitener * X_CB.linear();
  write_chain(jacobians, by_pose, std::move(by_chain), by_joints);
  return true;
}

PlayResidual::PlayResidual(const ParameterBlock& block, const Eigen::VectorXd& sd)
    : num_values_(static_cast<int>(block.values.size())), sd_(sd) {
  set_num_residuals(static_cast<int>(sd.size()));
  mutable_parameter_block_sizes()->push_back(num_values_);
}

bool PlayResidual::Evaluate(double const* const* parameters, double* residuals,
                            double** jacobians) const {
  const auto num = static_cast<int>(sd_.size());
  for (int n = 0; n < num; ++n) residuals[n] = parameters[0][num_values_ - num + n] / sd_(n);
  if (!jacobians || !jacobians[0]) return true;
  Eigen::Map<RowMajor> J(jacobians[0], num, num_values_);
  J.setZero();
  // All directions of an instant are free: the pose's six come first.
  const int first = num_values_ > num ? 6 : 0;
  for (int n = 0; n < num; ++n) J(n, first + n) = 1 / sd_(n);
  return true;
}

PriorResidual::PriorResidual(const ParameterBlock& block, const Eigen::VectorXd& sd)
    : block_(block), sd_(sd(block.free)) {
  set_num_residuals(block.num_free());
  mutable_parameter_block_sizes()->push_back(static_cast<int>(block.values.size()));
}

bool PriorResidual::Evaluate(double const* const* parameters, double* residuals,
                             double** jacobians) const {
  ParameterBlock moved = block_;
  moved.values.assign(parameters[0], parameters[0] + block_.values.size());
  const Eigen::VectorXd change = moved.change()(block_.free);
  Eigen::Map<Eigen::VectorXd>(residuals, num_residuals()) = change.cwiseQuotient(sd_);
  if (!jacobians || !jacobians[0]) return true;
  Eigen::Map<RowMajor> J(jacobians[0], num_residuals(),
                         static_cast<Eigen::Index>(block_.values.size()));
  J.setZero();
  // log(X₀⁻¹ X exp δ) = log(X₀⁻¹ X) + J_r⁻¹ δ; a change within its prior is so small that J_r is I.
  J.leftCols(num_residuals()).diagonal() = sd_.cwiseInverse();
  return true;
}

}  // namespace bodyschema
