#pragma once

#include <algorithm>
#include <optional>
#include <set>
#include <vector>

#include "processes/structure_learner/long_chain/long_chain.h"
#include "processes/structure_learner/screen.h"

namespace bodyschema {

/// Frames that models are judged by.
inline constexpr int kMaxPositionFrames = 300;
/// Independent positions a signal below which no chain is looked for: twice as many equations as it
/// has parameters.
inline constexpr int kPositionsPerJoint = 4;

/// The parts that have poses at most instants, ascending.
std::vector<int> parts_with_rotation(const std::vector<ActionPoseSample>& samples);

/// The parts that leaves may hang on.
class PositionParents {
 public:
  PositionParents(const std::vector<ActionPoseSample>& samples, const NormalizedActions& actions,
                  int root, const std::set<int>& resting, const MeasurementModel& measurement);

  const std::vector<int>& parts() const { return parts_; }
  /// The leaf's positions in the frame of the parent; of one that rests, in the camera's.
  PairData pair(int parent, int leaf, int max_frames) const {
    return parent == at_rest_ ? make_part_data(samples_, leaf, measurement_, max_frames)
                              : make_pair_data(samples_, parent, leaf, measurement_, max_frames);
  }
  /// A model of pair() in the frame of the parent.
  LocalModel in_parent(int parent, LocalModel model) const {
    if (parent == at_rest_) model.first = X_at_rest_.inverse() * model.first;
    return model;
  }
  int num_common(int leaf) const {
    int most = 0;
    for (const int parent : parts_)
      most = std::max(most, pair(parent, leaf, kMaxPositionFrames).size());
    return most;
  }

 private:
  const std::vector<ActionPoseSample>& samples_;
  const MeasurementModel& measurement_;
  int at_rest_ = -1;
  Pose X_at_rest_ = Pose::Identity();
  std::vector<int> parts_;
};

/// The starts at all parents that deserve a fit, best first.
struct StartAt {
  std::size_t parent = 0;
  Start start;
};
std::vector<StartAt> starts_of(const std::vector<PairData>& pairs, const NormalizedActions& actions,
                               int num_joints, int* num_screens);

/// The indices of a few pairs.
std::vector<std::size_t> most_often_seen(const std::vector<PairData>& pairs);

/// An order is searched for where a leaf can hang on one part alone, from poses at rest; else it is
/// that of the signals, or the reverse.
JointOrder order_of_chains(const PositionParents& parents, const NormalizedActions& actions);

/// A chain on `signals` without the joints that do not pay; std::nullopt if they are too few, or so
/// are the positions. `noise_m`: as fit_long_chain().
std::optional<Fit> fit_position_chain(const PairData& pair, const NormalizedActions& actions,
                                      const std::vector<int>& signals, JointOrder order,
                                      double noise_m);

}  // namespace bodyschema
