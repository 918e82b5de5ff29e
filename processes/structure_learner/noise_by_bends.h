#pragma once

#include <map>
#include <vector>

#include "processes/structure_learner/learn.h"

namespace bodyschema {

/// marker_noise() of the same samples by how their commands are bent: each estimated once, for a
/// structure may be looked for with noise several times as large.
class NoiseByBends {
 public:
  /// `displaced_by_these`: the samples, their actions bent as `signals` are.
  const SourcedNoise& at(const std::vector<Signal>& signals,
                         const std::vector<ActionPoseSample>& displaced_by_these,
                         const LearnOptions& options);

 private:
  std::map<std::vector<std::vector<double>>, SourcedNoise> known_;
};

}  // namespace bodyschema
