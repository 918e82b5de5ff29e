#pragma once

#include <map>
#include <memory>
#include <mutex>
#include <vector>

#include "common/schema/retained_samples.h"
#include "processes/structure_learner/learn.h"

namespace bodyschema {

/// learn() for samples that come one by one: what a new sample costs does not grow with their
/// number.
///
/// The search for the structure runs at checkpoints alone: after every sample while they are few,
/// then whenever there are 5 % more. The schema of samples 1..n is the structure of a checkpoint c
/// fitted to all of them: an edge that they refute is left out, a part that c had not seen is
/// unconnected until the next checkpoint. Where samples are too many for that, the schema is that
/// of c: a twentieth of the data at most waits for the next.
///
/// Which c is the caller's choice and not that of a clock, so that the schema is a pure function of
/// the samples: with c < n the search is done before sample n comes, if there was time to prepare;
/// with c = n it is learn(). What is kept is a cache and no more: whatever was asked or prepared
/// before, the answers are the same.
///
/// Any number of threads may ask; they wait for each other.
class OnlineLearner {
 public:
  /// There is a checkpoint after each of so many samples.
  static constexpr int kEverySample = 30;
  /// Readings of parts (about 9 a sample of a 7-DOF arm) up to which all edges are fitted anew.
  static constexpr int kMaxRefitReadings = 450;

  OnlineLearner(std::vector<Signal> signals, LearnOptions options);

  /// The schema of `samples` by the structure of the last checkpoint within the first
  /// `num_searched` of them. As learn() with the options, except that a root that nobody saw is
  /// only expected and makes the schema incomplete: the rest is learned without it.
  BodySchema learn(const SharedSamples& samples, int num_searched);
  /// Makes learn() of these samples, or of more with the same checkpoint, free of searches.
  void prepare(const SharedSamples& samples);

  /// The last checkpoint within the first n samples.
  static int checkpoint_within(int n);

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
