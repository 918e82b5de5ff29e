#include "common/estimation/measurement_model.h"

namespace bodyschema {
namespace {

/// 7 µm and 7 µrad: below what any camera resolves.
constexpr double kLeastVariance = 5e-11;

}  // namespace

Matrix6d isotropic(const Noise& noise) {
  Vector6d variances;
  variances << Eigen::Vector3d::Constant(noise.position_m * noise.position_m),
      Eigen::Vector3d::Constant(noise.rotation_rad * noise.rotation_rad);
  return variances.asDiagonal();
}

Matrix6d MeasurementModel::noise_covariance(const PartObservation& observation) const {
  return scale * scale * (noise ? isotropic(*noise) : observation.covariance);
}

Eigen::Matrix<double, 6, 7> MeasurementModel::effect_of_tag(const Pose& X_CB,
                                                            std::size_t num_tags) const {
  Eigen::Matrix<double, 6, 7> result = Eigen::Matrix<double, 6, 7>::Zero();
  if (noise || num_tags == 0) return result;
  result.diagonal().head<3>().setConstant(tags.position_m);
  result.diagonal().tail<3>().setConstant(tags.rotation_rad);
  result.col(6).head<3>() = tags.size_share * (X_CB.linear().transpose() * X_CB.translation());
  return scale / static_cast<double>(num_tags) * result;
}

Matrix6d MeasurementModel::systematic_covariance() const {
  return isotropic(systematic) + kLeastVariance * Matrix6d::Identity();
}

Matrix6d MeasurementModel::covariance(const PartObservation& observation) const {
  return noise_covariance(observation) + systematic_covariance();
}

}  // namespace bodyschema
