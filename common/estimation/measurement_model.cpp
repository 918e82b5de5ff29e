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

Matrix6d MeasurementModel::systematic_covariance() const {
  return isotropic(systematic) + kLeastVariance * Matrix6d::Identity();
}

Matrix6d MeasurementModel::covariance(const PartObservation& observation) const {
  return noise_covariance(observation) + systematic_covariance();
}

}  // namespace bodyschema
