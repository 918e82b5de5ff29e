#pragma once

#include <vector>

#include "bodyschema/sample_t.hpp"
#include "common/camera/tag_sight.h"
#include "common/schema/sample.h"

namespace bodyschema {

/// An action–pose sample with what the camera saw of each tag.
struct RefinerSample {
  ActionPoseSample sample;
  /// As tag_sights() has them; empty where the recording has poses alone.
  std::vector<TagSight> tags;
};

inline std::int64_t index_of(const RefinerSample& seen) { return seen.sample.sample_index; }

RefinerSample refiner_sample(const sample_t& message);
/// `sights`: of single tags, by sample_index (Recording); none: samples without corners.
std::vector<RefinerSample> refiner_samples(const std::vector<ActionPoseSample>& samples,
                                           const std::vector<std::vector<TagSight>>& sights = {});

/// At most `most` of them, evenly spaced in their order, the first among them.
std::vector<RefinerSample> thinned(std::vector<RefinerSample> samples, std::size_t most);

}  // namespace bodyschema
