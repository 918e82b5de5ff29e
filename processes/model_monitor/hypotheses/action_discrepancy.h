#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <deque>
#include <vector>

#include "common/schema/signal.h"

namespace bodyschema {

/// How far the newest actions lie from those before: the squared maximum mean discrepancy (Gretton
/// et al., A kernel two-sample test, 2012) under the mean over the signals of Gaussian kernels.
///
/// What a model is off by differs from action to action. As a Gaussian process of this kernel and
/// unit variance it is off by so much variance more, or less, over the newest actions than over
/// those before: about 1/n for n actions at random, up to 2 where all signals stay elsewhere.
class ActionDiscrepancy {
 public:
  /// `action`: one value per signal, in its units.
  void add(const Eigen::VectorXd& action, const std::vector<Signal>& signals,
           std::int64_t sample_index);
  void clear() { *this = {}; }
  /// Of the actions from sample `first` on and those before. 1 if there are none on one side.
  double since(std::int64_t first) const;

 private:
  struct Added {
    std::int64_t sample_index;
    Eigen::VectorXd action;  ///< in lengths of the kernel
  };
  std::deque<Added> added_;
  Eigen::MatrixXd kernel_;       ///< of added_ by added_
  std::vector<double> squared_;  ///< by the first of the newest
};

}  // namespace bodyschema
