#pragma once

#include <map>
#include <optional>
#include <set>
#include <vector>

#include "common/schema/body_schema.h"
#include "common/schema/sample.h"

namespace bodyschema {

/// How far a tag may be from what markers.yaml says of it: standard deviations.
struct TagCalibration {
  double position_m = 0;    ///< of a tag on its part, per axis
  double rotation_rad = 0;  ///< per axis
  double size_share = 0;    ///< of the printed side
};

/// How far the observed pose of a part may be from the true one: the one place where an
/// observation becomes a covariance.
///
///   X_CB = X_CB_true · exp(ε + β),   ε ~ N(0, Σ),   β ~ N(0, M)
///
/// The noise ε is new at every sight but for what is off of a tag itself, which an observation's Σ
/// also has. The systematic error β (a lens that is not as calibrated, what a view biases) is the
/// same at every sight of the same tags from the same side: no number of samples averages it out.
struct MeasurementModel {
  /// Standard deviations per axis of ε, instead of each observation's own covariance.
  std::optional<Noise> noise = std::nullopt;
  /// Standard deviations per axis of β. Under-stating it refutes true models in the end;
  /// over-stating it hides joints and changes that move less.
  Noise systematic = {};
  /// What each observation's covariance has of its tags; the same at every sight of a tag.
  TagCalibration tags = {};
  /// Multiplies the standard deviations of ε: 1 where what is told of them is true.
  double scale = 1;
  /// Expected share of a part's observations that are flips of planar tags or false detections.
  double outlier_rate = 0.03;
  /// Independent samples that one sample is worth, in (0, 1]: log-likelihoods are multiplied by it
  /// where the noise of successive samples is correlated.
  double worth = 1;
  /// A second reading of a planar part counts while its reprojection error is at most this multiple
  /// of the first's.
  double max_error_ratio = 10;
  /// Parts whose pose is given, not measured, as the frame of a tracker: their ε is 0.
  std::set<int> fixed_parts = {};
  /// By part: where its marker is read from time to time though it is not there, in the part's
  /// frame. Half of its outliers are expected there.
  std::map<int, std::vector<Pose>> misread = {};

  /// Σ of X_CB: 6×6, (translation [m], rotation [rad]), right perturbation in B. Of a position
  /// alone the rotation rows are zero, here and in covariance().
  Matrix6d noise_covariance(const PartObservation& observation) const;
  /// M of a pose, and a little that keeps exact measurements invertible.
  Matrix6d systematic_covariance() const;
  /// 6×7, (translation [m], rotation [rad]), right perturbation in B: what one standard deviation
  /// of each error of one tag (place and rotation on its part, size: depth) makes of a pose that is
  /// the mean over `num_tags` of them. Takes the tag to be at the part's origin. Zero where `noise`
  /// is set or the tags are not known.
  Eigen::Matrix<double, 6, 7> effect_of_tag(const Pose& X_CB, std::size_t num_tags) const;
  /// Σ + M.
  Matrix6d covariance(const PartObservation& observation) const;
  /// An observation as a pose that can be compared with `expected`: a position alone is turned as
  /// expected, by a rotation of which nothing is known, so that three of its residuals are 0.
  struct Reading {
    Pose X_CB;
    Matrix6d covariance;    ///< Σ + M, which can be inverted
    int num_residuals = 6;  ///< that tell something: d² has so many degrees of freedom
  };
  Reading reading(const PartObservation& observation, const Pose& expected) const;
};

/// A covariance of (translation, rotation) with nothing of the rotation in it.
Matrix6d without_rotation(const Matrix6d& covariance);

/// Variances per axis on the diagonal: 6×6, (translation [m²], rotation [rad²]).
Matrix6d isotropic(const Noise& noise);

}  // namespace bodyschema
