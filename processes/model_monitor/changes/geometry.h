#pragma once

#include "processes/model_monitor/changes/change_family.h"

namespace bodyschema {

/// Transforms before and behind a place: T(θ_1) · X · T(θ_2), or one of them; a base for all that
/// moves poses.
class Geometry : public ChangeFamily {
 public:
  ChangePrior prior(const BodySchema& schema, const BodyChange& change) const override;
  /// What each of the newest measurements alone says.
  std::vector<Eigen::VectorXd> starts(
      const BodySchema& schema, const BodyChange& change,
      const std::vector<PlaceMeasurement>& measurements) const override;
  void apply(const BodyChange& change, const Eigen::VectorXd& theta,
             const Eigen::MatrixXd& covariance, BodySchema* schema) const override;
  PlacePrediction prediction(const BodySchema& schema, const BodyChange& change,
                             const Eigen::VectorXd& theta) const override;
  /// How far what follows the place went with all signals in mid-range.
  ChangeSize size(const BodySchema& schema, const BodyChange& change, const Eigen::VectorXd& theta,
                  const Eigen::MatrixXd& covariance) const override;
};

}  // namespace bodyschema
