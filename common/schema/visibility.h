#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <map>
#include <set>
#include <vector>

#include "common/schema/body_schema.h"

namespace bodyschema {

/// An action that was taken, and which parts were seen at it.
struct SeenAction {
  std::int64_t sample_index = 0;
  bool is_learned_from = true;  ///< false of TEST and CONTROL samples
  Eigen::VectorXd action;       ///< one value per signal, command units
  std::set<int> parts;
};

/// Probability that the camera sees a part at an action: the mean of a Beta distribution whose
/// counts are the past actions, each weighted by its similarity to this one for that part.
///
/// For a part that is connected to the root, actions are similar that show the camera the part from
/// similar directions (Gaussian weight, 15°). The side that a marker shows decides whether it is
/// seen; that is two numbers, however many signals move the part, and the schema predicts them also
/// for actions at which the part was not seen. For other parts, actions are similar with similar
/// signals, all of them, since it is unknown which move the part. Occlusion by other parts is
/// covered as far as it depends on these.
class VisibilityModel {
 public:
  /// Every past action has one value per signal of the schema.
  VisibilityModel(const BodySchema& schema, const std::vector<SeenAction>& past);

  /// 0..1 for every part of the schema, unconnected ones included.
  std::map<int, double> probabilities(const Eigen::VectorXd& action) const;

 private:
  struct View {
    std::map<int, Eigen::Vector3d> directions;  ///< from the part to the camera, in its frame, unit
    Eigen::VectorXd x;                          ///< signals, −1..1 over their ranges
    std::set<int> parts;                        ///< seen at it
  };
  View view_at(const Eigen::VectorXd& action) const;

  const BodySchema schema_;
  std::vector<View> past_;
};

}  // namespace bodyschema
