#pragma once

#include <string>

#include "common/schema/body_schema.h"
#include "processes/console/views/json.h"
#include "processes/controller/inverse_kinematics.h"

namespace bodyschema {

/// What `reach` found.
struct Reach {
  int part = 0;
  bool has_orientation = false;  ///< one was asked
  InverseKinematicsSolution solution;
  Noise sd;         ///< of the part's pose there, per axis, to first order; 0: not known
  std::string why;  ///< it is reached, or not
};

/// Within 0.1 mm and 0.01° by the schema, or the nearest of a hundred starts; where the
/// schema's samples were if it is there, else within the limits. Deterministic. @throws as
/// solve_pose().
Reach reach_of(const BodySchema& schema, int part, const PoseTarget& target,
               const Eigen::VectorXd& start);

Json reach_json(const BodySchema& schema, const Reach& reach);
std::string reach_text(const BodySchema& schema, const Reach& reach);

}  // namespace bodyschema
