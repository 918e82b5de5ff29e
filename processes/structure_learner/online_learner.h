#pragma once

#include <map>
#include <memory>
#include <mutex>
#include <vector>

#include "processes/structure_learner/learn.h"

namespace bodyschema {

/// The samples so far, of which later ones take nothing away.
using SharedSamples = std::vector<std::shared_ptr<const ActionPoseSample>>;

/// learn() for samples that come one by one: what a new sample costs does not grow with their
/// number.
///
/// The schema after n samples is a pure function of the samples 1..n. The search for the structure
/// runs at checkpoints alone: after every sample while they are few, then whenever there are 5 %
/// more. Let c < n be the last checkpoint before n. The schema after n is the structure of c fitted
/// to 1..n; where these are too many for that, the schema of c, so that a twentieth of the data at
/// most waits for the next checkpoint. But it is learn() of 1..n
///   where a sample after c refutes an edge or shows a part that c had not seen,
///   and where the structure of c spans too little, while samples are few.
/// Since c < n, what the next sample will start from can be prepared before it comes. What is kept
/// is a cache and no more: whatever was asked or prepared before, the answers are the same.
///
/// Any number of threads may ask; they wait for each other.
class OnlineLearner {
 public:
  /// There is a checkpoint after each of so many samples.
  static constexpr int kEverySample = 30;
  /// Readings of parts (about 9 a sample of a 7-DOF arm) up to which all edges are fitted anew.
  static constexpr int kMaxRefitReadings = 1500;

  OnlineLearner(std::vector<Signal> signals, LearnOptions options);

  /// The schema after `samples`. As learn() with the options, except that a root that
  /// nobody saw is only expected and makes the schema incomplete: the rest is learned without it.
  BodySchema learn(const SharedSamples& samples);
  /// Finds what learn() will start from when one more sample comes, unless that is known.
  void prepare(const SharedSamples& samples);

  /// The last checkpoint before n; 0: none.
  static int checkpoint_before(int n);

 private:
  struct Checkpoint {
    LearnedStructure structure;
    std::optional<BodySchema> schema;  ///< of the samples that it was found from; made when asked
  };

  LearnOptions options_for(const std::vector<ActionPoseSample>& samples) const;
  Checkpoint& checkpoint(const SharedSamples& samples, int n);
  const BodySchema& schema_of(Checkpoint* checkpoint, const SharedSamples& samples, int n) const;

  const std::vector<Signal> signals_;
  const LearnOptions options_;
  std::mutex mutex_;
  std::map<int, Checkpoint> checkpoints_;  // by number of samples; the newest few
};

}  // namespace bodyschema
