#pragma once

#include <cstdint>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "bodyschema/sample_t.hpp"
#include "common/config/yaml.h"
#include "common/schema/signal.h"

namespace bodyschema {

/// Which TRAIN actions move one joint alone: a share of them, from the first verdict on, until the
/// schema is complete, while no more than two parts were seen. Of joints between two parts with
/// nothing seen in the middle, two samples that differ in one signal show the axis and the gain of
/// that joint, whatever the others are; samples about one pose show those of all joints in one
/// frame, so that their order alone is left to find.
///
/// A round moves each signal once, in their order, away from one pose: that of the last sample
/// before the round that is learned from and shows two parts.
class SingleJointMoves {
 public:
  SingleJointMoves(std::vector<Signal> signals, double share);

  /// A SAMPLE of the babbler's own; `num_train`: those that are not TEST, with this one.
  void on_sample(const sample_t& sample, std::int64_t num_train);
  /// The verdict after TEST sample `test_sample`. The first counts: a later one may come before or
  /// after the next action.
  void on_verdict(std::int64_t test_sample, bool is_complete);

  /// The action after `num_train` samples: one signal lies at least a quarter of its range beside
  /// the pose, by `u` in [0, 1). std::nullopt: it is no single joint's turn.
  std::optional<std::vector<double>> action(std::int64_t num_train, double u) const;

  /// State for a restart: a line of YAML, key single_joint_moves, and its inverse.
  std::string state_text() const;
  void restore(const Yaml& section);

 private:
  /// The action after `num_train` samples moves one joint alone.
  bool is_turn(std::int64_t num_train) const;
  /// The signal that it moves.
  std::size_t next_signal() const;

  const std::vector<Signal> signals_;
  const double share_;
  std::vector<double> pose_;        ///< action; empty: none showed two parts yet
  std::int64_t num_moves_ = 0;      ///< made so far
  std::set<int> parts_;             ///< seen so far
  std::int64_t last_verdict_ = -1;  ///< TEST sample that it judged
  bool is_complete_ = false;        ///< by that verdict
};

}  // namespace bodyschema
