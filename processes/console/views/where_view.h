#pragma once

#include <Eigen/Geometry>
#include <optional>
#include <string>
#include <vector>

#include "common/schema/body_schema.h"
#include "processes/console/views/json.h"
#include "processes/console/views/prediction_view.h"

namespace bodyschema {

/// What a person chooses a target by: where parts are and can go, by the schema.
struct Whereabouts {
  struct Part {
    int part = 0;
    Eigen::AlignedBox3d reachable;           ///< see reachable_box()
    std::optional<PartPrediction> now = {};  ///< with an action
  };
  std::vector<Part> parts;                     ///< that hang on the root, ascending
  std::optional<Eigen::VectorXd> action = {};  ///< where the arm rests, if that is known
};

/// Of one part, or of all that hang on the root. @throws std::invalid_argument if the part does
/// not, or `action` does not have one value per signal.
Whereabouts whereabouts_of(const BodySchema& schema, std::optional<int> part,
                           const std::optional<Eigen::VectorXd>& action);

Json where_json(const BodySchema& schema, const Whereabouts& where);
std::string where_text(const BodySchema& schema, const Whereabouts& where);

}  // namespace bodyschema
