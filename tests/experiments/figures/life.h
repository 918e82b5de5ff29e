#pragma once

#include <algorithm>
#include <array>
#include <optional>
#include <vector>

#include "processes/model_monitor/adaptation.h"
#include "tests/support/broken_arm.h"

namespace bodyschema::experiments {

/// Below this error of the end effector the schema is right.
inline double limit_m(test::Regime regime) {
  return regime == test::Regime::kChapter ? 0.075 : 0.030;
}

/// One arm's life under one adaptation method.
struct Life {
  std::vector<double> error;      ///< of the judged part, by sample [m]
  std::vector<double> original;   ///< the same of the schema that was there at the start
  std::vector<bool> is_valid;     ///< every edge has a valid model, after the sample
  std::vector<double> statistic;  ///< CUSUM of the first edge that will break
  std::vector<AdaptationEvent> events;
  int num_wrong_events = 0;
  int num_strictly_wrong_events = 0;  ///< at what did not change, neighbours included
  /// Reported findings of blocks 2 to 4.
  struct Named {
    bool place = false, cause = false;
  };
  std::array<std::optional<Named>, 4> at_recovery, in_the_end;
  std::vector<int> num_sampled;     ///< new models so far, by sample: candidates, not restored ones
  double seconds = 0, slowest = 0;  ///< of processor time

  /// Samples of the block after which there is no valid spanning tree: the chapter's count.
  int without_tree(int block, int length) const {
    return static_cast<int>(std::count(is_valid.begin() + block * length,
                                       is_valid.begin() + (block + 1) * length, false));
  }
  /// Samples of the block until the schema is right for good.
  int until_right(int block, int length, double limit) const {
    int last = 0;
    for (int t = 0; t < length; ++t)
      if (error[static_cast<std::size_t>(block * length + t)] > limit) last = t + 1;
    return last;
  }
  int sampled_in(int block, int length) const {
    const auto until = [&](int t) {
      return t < 1 ? 0 : num_sampled[static_cast<std::size_t>(t - 1)];
    };
    return until((block + 1) * length) - until(block * length);
  }
  double mean_error(int begin, int end) const {
    double sum = 0;
    for (int t = begin; t < end; ++t) sum += error[static_cast<std::size_t>(t)];
    return sum / (end - begin);
  }
};

Life live(const test::Scenario& scenario, test::Regime regime, double noise_factor, int length,
          int seed);
/// The same by the chapter's procedure.
Life live_as_the_chapter(const test::Scenario& scenario, test::Regime regime, int length, int seed);

/// Samples of a block, and models sampled in it; one value a life.
struct Recovery {
  std::vector<double> without_tree, until_right, until_as_good, sampled;
};

/// `limit` [m]: below it the schema is right.
Recovery recovery_of(const std::vector<Life>& lives, int block, int length, double limit);

}  // namespace bodyschema::experiments
