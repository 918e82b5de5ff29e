#include "common/estimation/measurement_model.h"

namespace bodyschema {
namespace {

/// 7 µm and 7 µrad: below what any camera resolves.
constexpr double kLeastVariance = 5e-11;
/// Of a rotation of which nothing is known: its normal density at 0 is that of all rotations alike,
/// 1/(8π²), so that likelihoods with it can be compared with those of a position anywhere.
constexpr double kUnknownRotation_rad = 1.711;

}  // namespace

Matrix6d isotropic(const Noise& noise) {
  Vector6d variances;
  variances << Eigen::Vector3d::Constant(noise.position_m * noise.position_m),
      Eigen::Vector3d::Constant(noise.rotation_rad * noise.rotation_rad);
  return variances.asDiagonal();
}

Matrix6d without_rotation(const Matrix6d& covariance) {
  Matrix6d result = Matrix6d::Zero();
  result.topLeftCorner<3, 3>() = covariance.topLeftCorner<3, 3>();
  return result;
}

Matrix6d MeasurementModel::noise_covariance(const PartObservation& observation) const {
  if (fixed_parts.contains(observation.part)) return Matrix6d::Zero();
  const Matrix6d covariance = scale * scale * (noise ? isotropic(*noise) : observation.covariance);
  return observation.has_rotation ? covariance : without_rotation(covariance);
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
  const Matrix6d M = systematic_covariance();
  return noise_covariance(observation) + (observation.has_rotation ? M : without_rotation(M));
}

MeasurementModel::Reading MeasurementModel::reading(const PartObservation& observation,
                                                    const Pose& expected) const {
  const Matrix6d known = covariance(observation);
  if (observation.has_rotation) return {observation.X_CB, known, 6};
  Reading reading{expected, Matrix6d::Zero(), 3};
  reading.X_CB.translation() = observation.X_CB.translation();
  const Eigen::Matrix3d R = expected.linear();
  reading.covariance.topLeftCorner<3, 3>() = R.transpose() * known.topLeftCorner<3, 3>() * R;
  reading.covariance.diagonal().tail<3>().setConstant(kUnknownRotation_rad * kUnknownRotation_rad);
  return reading;
}

}  // namespace bodyschema
