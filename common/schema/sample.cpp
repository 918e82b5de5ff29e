#include "common/schema/sample.h"

#include <algorithm>

namespace bodyschema {

Matrix6d covariance_of_other(const PartObservation& observation, const Matrix6d& covariance) {
  Matrix6d T = Matrix6d::Identity();
  T.topLeftCorner<3, 3>() =
      observation.X_CB_other->linear().transpose() * observation.X_CB.linear();
  return T * covariance * T.transpose();
}

const PartObservation* ActionPoseSample::find(int part) const {
  const auto it = std::lower_bound(parts.begin(), parts.end(), part,
                                   [](const PartObservation& o, int id) { return o.part < id; });
  return it == parts.end() || it->part != part ? nullptr : &*it;
}

}  // namespace bodyschema
