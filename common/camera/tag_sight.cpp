#include "common/camera/tag_sight.h"

#include <algorithm>
#include <cmath>

#include "common/bus/convert.h"

namespace bodyschema {
namespace {

TagSight tag_sight(const tag_corners_t& message) {
  TagSight sight;
  sight.tag = message.tag_id;
  for (int c = 0; c < 4; ++c)
    for (int axis = 0; axis < 2; ++axis)
      sight.corners_px(2 * c + axis) = message.mean_corner_px[c][axis];
  const bool is_told =
      std::any_of(std::begin(message.corner_covariance), std::end(message.corner_covariance),
                  [](float c) { return c != 0; });
  if (is_told) sight.covariance_px2 = from_message(message.corner_covariance);
  return sight;
}

}  // namespace

Matrix8d covariance_of(const TagSight& sight, const CornerNoise& corner_noise) {
  if (!sight.covariance_px2.isZero(0)) return sight.covariance_px2;
  std::vector<Eigen::Vector2d> corners;
  for (int c = 0; c < 4; ++c) corners.emplace_back(sight.corners_px.segment<2>(2 * c));
  return std::pow(corner_noise.sigma_px(corners), 2) * Matrix8d::Identity();
}

std::vector<TagSight> tag_sights(const sample_t& message) {
  std::vector<TagSight> sights;
  for (const auto* observations : {&message.parts, &message.contradictions})
    for (const part_observation_t& observation : *observations)
      for (const tag_corners_t& tag : observation.tags) sights.push_back(tag_sight(tag));
  std::stable_sort(sights.begin(), sights.end(),
                   [](const TagSight& a, const TagSight& b) { return a.tag < b.tag; });
  return sights;
}

}  // namespace bodyschema
