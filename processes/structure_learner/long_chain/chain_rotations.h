#pragma once

#include <vector>

#include "processes/structure_learner/long_chain/chain_search.h"

namespace bodyschema {

/// Finds the axes from the rotations of a pair alone, before any position is looked at. With free
/// lengths about one start in ten leads to the global minimum, which is unmistakable.
class RotationSearch : public ChainSearch {
 public:
  RotationSearch(const PairData& pair, const NormalizedActions& actions, int max_frames);

  ChainAxes fit(ChainAxes start, bool holds_lengths, int max_iterations) const override;

 private:
  void set_end(ChainAxes* chain) const override;
  void predict(const ChainAxes& chain, int frame, std::vector<Eigen::Matrix3d>* steps,
               std::vector<Eigen::Matrix3d>* suffixes) const;
  double evaluate(ChainAxes* chain) const;

  std::vector<Eigen::Matrix3d> rotations_;
};

}  // namespace bodyschema
