#pragma once

#include <vector>

#include "common/camera/lens.h"
#include "common/camera/tag_sight.h"
#include "common/config/rig.h"
#include "common/schema/body_schema.h"

namespace bodyschema {

/// Predicted corners against those seen.
struct CornerErrors {
  int num_tags = 0;
  std::vector<double> distances_px;  ///< of tags that are predicted before the camera
  double cost = 0;                   ///< −log likelihood: robust_cost() of the tags
};

/// What a schema says of the corners of a sample, with a rig's tags and its lens. `corner_noise`:
/// of corners without a covariance of their own.
CornerErrors corner_errors(const BodySchema& schema, const Eigen::VectorXd& action,
                           const std::vector<TagSight>& tags, const Markers& markers,
                           const Lens& lens, const CornerNoise& corner_noise);

/// Are more of the same samples likelier by a model than by another, and so many more that chance
/// does it in 2 % at most (sign test)? `costs`: −log likelihood of each sample. A sample counts
/// once: what its corners have in common, the play of joints, is one draw. Never below six samples.
bool is_likelier(const std::vector<double>& costs, const std::vector<double>& costs_of_other);

}  // namespace bodyschema
