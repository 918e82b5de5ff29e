#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <deque>
#include <optional>
#include <utility>
#include <vector>

#include "common/schema/sample.h"
#include "common/schema/signal.h"

namespace bodyschema {

/// No signal moves by more than a tenth of its range: what cameras, tags and joints are off by all
/// the time is about the same before and after.
bool is_small_step(const Eigen::VectorXd& from, const Eigen::VectorXd& to,
                   const std::vector<Signal>& signals);

/// Which samples say something new. In a stream of frames what a soft body's model does not know
/// (hysteresis, creep, a bend that it was never shown) and a marker that is read turned over are
/// the same for many frames, and would count a hundred times. So of a stream one sample a second is
/// judged, the shortest block of time that counts for one in learning (time_blocks.h).
class SampleStream {
 public:
  /// Whether the sample repeats the one judged last: it is at most a second later, and from there
  /// to here every sample followed the one before within a quarter of a second, faster than any arm
  /// can move and settle, and with no signal moved by more than a tenth of its range. A pure
  /// function of the samples so far; without a clock (times that do not ascend) nothing repeats.
  bool repeats(const ActionPoseSample& sample, const std::vector<Signal>& signals);

  /// Repetitions came: these samples are a stream, maybe with gaps.
  bool is_dense() const { return num_repetitions_ > 0; }

  /// Samples are counted without the repetitions: the index of the newest, and back.
  std::int64_t count() const { return sample_index_ - num_repetitions_; }
  /// Of one of the newest kRemembered that were no repetitions.
  std::int64_t sample_index_of(std::int64_t count) const;
  static constexpr std::size_t kRemembered = 256;

 private:
  struct Last {
    std::int64_t utime = 0;
    std::int64_t judged_utime = 0;
    Eigen::VectorXd action;
  };
  std::optional<Last> last_;
  std::int64_t sample_index_ = 0;
  std::int64_t num_repetitions_ = 0;
  /// (count, repetitions before it) of what came after repetitions.
  std::deque<std::pair<std::int64_t, std::int64_t>> repetitions_before_;
};

}  // namespace bodyschema
