#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <random>
#include <vector>

#include "processes/structure_learner/pair_data.h"

namespace bodyschema {

/// What turns in a chain of joints, over normalised signals:
///   R(q) = ∏_j Exp(w_j q_j) · R_end.
struct ChainAxes {
  std::vector<int> signals;           ///< from part i to part j
  std::vector<Eigen::Vector3d> axes;  ///< w_j [rad per half range]; near zero: a joint that slides
  Eigen::Matrix3d R_end = Eigen::Matrix3d::Identity();  ///< positions do not tell it
  double cost = 0;         ///< Σ ½ s² log(1 + e²/s²) of what is left [rad², m²]
  double median_left = 0;  ///< e of a frame [rad, m]
};

/// Moves the element at `from` to `to`, those between by one place.
template <class T>
void move_element(std::vector<T>* v, int from, int to) {
  if (from < to)
    std::rotate(v->begin() + from, v->begin() + from + 1, v->begin() + to + 1);
  else
    std::rotate(v->begin() + to, v->begin() + from, v->begin() + from + 1);
}

/// Finds the axes of a chain of joints by Levenberg–Marquardt from random ones with a heavy-tailed
/// loss: from rotations alone (RotationSearch), or from positions (PositionSearch). Where the
/// lengths |w_j| are held about right the landscape is benign, and the order of the joints is
/// found, too.
///
/// Deterministic: the starts are drawn by a seed of its own.
class ChainSearch {
 public:
  /// How hard is searched where nothing seems to fit: random starts in all, orders that are begun
  /// with, joints of which an order is searched for at most, and, in best_order(), starts from
  /// random axes beside each that is moved.
  struct Effort {
    int free_starts, orders, most_ordered, random_starts;
  };

  virtual ~ChainSearch() = default;

  int num_frames() const { return static_cast<int>(samples_.size()); }

  /// From `start`. `holds_lengths`: |w_j| stay as they are.
  virtual ChainAxes fit(ChainAxes start, bool holds_lengths, int max_iterations) const = 0;

  /// The chain, or a better one: moves one joint at a time to another place, as long as that leaves
  /// clearly less.
  ChainAxes with_joints_moved(ChainAxes chain) const;

  /// What a chain leaves at most that is near enough to the right order for with_joints_moved().
  virtual double nearly_nothing() const { return 0; }
  int free_starts() const { return effort_.free_starts; }
  /// Random orders that a search for one is worth begun with.
  int num_orders(int num_joints) const {
    return num_joints <= effort_.most_ordered ? effort_.orders : 0;
  }

  /// A start with random directions; lengths |w_j| as given, or random where `lengths` is empty.
  ChainAxes random_start(const std::vector<int>& signals, const std::vector<double>& lengths);

  /// The best of `max_starts` random starts; fewer once several have ended in it.
  ChainAxes best_of(const std::vector<int>& signals, const std::vector<double>& lengths,
                    int max_starts);

  /// From a random order of `signals`: moves one joint at a time to the place that costs least, or
  /// lets it slide, and tries the reverse; with the lengths held until nothing is better, then with
  /// free ones, or until no more than `goal` is left [rad, m].
  ChainAxes best_order(const std::vector<int>& signals, const std::vector<double>& lengths,
                       double goal);

 protected:
  /// An even subset of at most `max_frames` of the pair's frames, by their first readings.
  ChainSearch(const PairData& pair, const NormalizedActions& actions, int max_frames,
              const Effort& effort);
  /// R_end that fits the axes best.
  virtual void set_end(ChainAxes*) const {}

  std::vector<int> frames_;   ///< of the pair
  std::vector<int> samples_;  ///< of these frames
  Eigen::MatrixXd q_;         ///< signals × frames

 private:
  double uniform();
  Eigen::Vector3d random_direction();

  Effort effort_;
  std::mt19937_64 random_{20100511};
};

/// Jr(w): Exp(w + δ) = Exp(w) Exp(Jr δ + O(δ²)).
Eigen::Matrix3d right_jacobian_so3(const Eigen::Vector3d& w);

/// How each joint's parameters move its axis: 3×2 where lengths are held, else 3×3.
std::vector<Eigen::MatrixXd> axis_bases(const ChainAxes& chain, bool holds_lengths);

/// The axes moved by their parameters in `bases`, one joint's after the other's; where a basis has
/// no columns the axis stays.
ChainAxes with_axes_moved(const ChainAxes& chain, const std::vector<Eigen::MatrixXd>& bases,
                          const Eigen::VectorXd& step, bool holds_lengths);

}  // namespace bodyschema
