#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <vector>

namespace bodyschema {

/// Which instants say the same thing. Poses at rest of a random babbler are independent. A stream
/// is not: an instant's neighbours tell its pose whatever the model, and a flip stays for many
/// frames. So a model of a stream is judged by what it says about a block of time without the whole
/// block, and a block counts as one sample.
class TimeBlocks {
 public:
  /// Every instant for itself.
  TimeBlocks() = default;

  /// A stream is what comes faster than any arm can move and settle (median interval up to 1 s)
  /// and moves slowly compared with that: the mean square of the difference of actions `lag`
  /// instants apart reaches half of that of two random instants only at a lag above 2. A block is
  /// twice that lag long; at least two blocks. `actions` is m×N, any units that make the signals
  /// comparable; instants ascend in time, and are `least_instants` or more, else they are no
  /// stream.
  TimeBlocks(const std::vector<std::int64_t>& utimes, const Eigen::MatrixXd& actions,
             Eigen::Index least_instants = 50);

  bool is_stream() const { return length_ > 1; }
  int length() const { return length_; }  ///< [instants]
  int block_of(int sample) const { return sample / length_; }
  /// How many of these ascending samples are independent: the blocks that they touch.
  template <class Samples, class IndexOf>
  int count(const Samples& samples, IndexOf index_of) const {
    int blocks = 0, previous = -1;
    for (const auto& s : samples) {
      const int block = block_of(index_of(s));
      if (block != previous) ++blocks;
      previous = block;
    }
    return blocks;
  }

 private:
  int length_ = 1;
};

}  // namespace bodyschema
