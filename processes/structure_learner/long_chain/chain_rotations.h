#pragma once

#include <algorithm>
#include <random>
#include <vector>

#include "processes/structure_learner/pair_data.h"

namespace bodyschema {

/// The rotations of a chain of joints between its two ends, over normalised signals:
///   R(q) = ∏_j Exp(w_j q_j) · R_end.
/// They depend on the axes alone, so that they are found before any position is looked at.
struct ChainRotations {
  std::vector<int> signals;           ///< from part i to part j
  std::vector<Eigen::Vector3d> axes;  ///< w_j [rad per half range]; near zero: a joint that slides
  Eigen::Matrix3d R_end = Eigen::Matrix3d::Identity();
  double cost = 0;        ///< Σ ½ s² log(1 + 4 sin²(ϑ/2) / s²) of the angles ϑ left [rad²]
  double median_rad = 0;  ///< of the angles left
};

/// Moves the element at `from` to `to`, those between by one place.
template <class T>
void move_element(std::vector<T>* v, int from, int to) {
  if (from < to)
    std::rotate(v->begin() + from, v->begin() + from + 1, v->begin() + to + 1);
  else
    std::rotate(v->begin() + to, v->begin() + from, v->begin() + from + 1);
}

/// Finds the axes of chains of joints from the rotations of a pair alone, by Levenberg–Marquardt
/// from random axes with a heavy-tailed loss. Where the lengths |w_j| are held about right the
/// landscape is benign, and the order of the joints is found, too; with free ones about one start
/// in ten leads to the global minimum, which is unmistakable.
///
/// Deterministic: the starts are drawn by a seed of its own.
class RotationSearch {
 public:
  /// An even subset of at most `max_frames` of the pair's frames, by their first readings.
  RotationSearch(const PairData& pair, const NormalizedActions& actions, int max_frames);

  int num_frames() const { return static_cast<int>(rotations_.size()); }

  /// From `start`. `holds_lengths`: |w_j| stay as they are.
  ChainRotations fit(ChainRotations start, bool holds_lengths, int max_iterations) const;

  /// A start with random directions; lengths |w_j| as given, or random where `lengths` is empty.
  ChainRotations random_start(const std::vector<int>& signals, const std::vector<double>& lengths);

  /// The best of `max_starts` random starts; fewer once several have ended in it.
  ChainRotations best_of(const std::vector<int>& signals, const std::vector<double>& lengths,
                         int max_starts);

  /// From a random order of `signals`: moves one joint at a time to the place that costs least, or
  /// lets it slide, and tries the reverse; with the lengths held until nothing is better, then with
  /// free ones, or until the goal is reached.
  ChainRotations best_order(const std::vector<int>& signals, const std::vector<double>& lengths,
                            double goal_rad);

 private:
  void predict(const ChainRotations& chain, int frame, std::vector<Eigen::Matrix3d>* steps,
               std::vector<Eigen::Matrix3d>* suffixes) const;
  double evaluate(ChainRotations* chain) const;
  void set_end(ChainRotations* chain) const;
  double uniform();
  Eigen::Vector3d random_direction();

  std::vector<Eigen::Matrix3d> rotations_;
  Eigen::MatrixXd q_;  // signals × frames
  std::mt19937_64 random_{20100511};
};

}  // namespace bodyschema
