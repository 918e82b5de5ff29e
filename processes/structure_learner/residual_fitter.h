#pragma once

#include <memory>
#include <vector>

#include "processes/structure_learner/residual_fit.h"

namespace bodyschema {

/// Log density of a residual without its constant; the distance of an outlier is bounded.
double bounded_log_density(double squared_distance, double log_det);

/// Fits a Gaussian process to what a chain of screws leaves of a pair, ρ = Log(f_screw(q)⁻¹ z),
/// of given signals, and judges it by the blocks of time that are left out. n frames, D signals.
/// Inputs are signals scaled to [−1, 1]. Keeps references; a copy continues from the same fit.
class ResidualFitter {
 public:
  /// Factors on the variance that is assumed: a tenth and twice the deviation.
  static constexpr double kLeastNoise = 1e-2, kMostNoise = 4;

  /// Hyper-parameters over normalised inputs.
  struct Shape {
    Eigen::VectorXd log_lengths;  ///< D
    Vector6d log_variances;       ///< of ρ [m², rad²]
    double log_noise = 0;         ///< factor on the mean variance of a reading
  };

  /// What a signal gains [nats], and the standard error of that.
  struct Gain {
    double sum = 0, error = 0;
  };

  /// Weights are those of the screws' residuals, by their own spread.
  ResidualFitter(const LocalModel& screws, const PairData& pair, const NormalizedActions& actions);

  int num_blocks() const { return blocks_.count; }

  /// Signals by how much of the residuals a line in them explains, most first.
  std::vector<int> ranked_signals() const;

  /// Hyper-parameters and judgement for this Q, from `start` (nullptr: from several lengths).
  /// False: too few instants are no outliers.
  bool fit(const std::vector<int>& signals, const Shape* start, int max_iterations);
  /// Without the signal at this place in signals(), from the same samples: others make a difference
  /// of their own.
  ResidualFitter without(int place, int max_iterations) const;
  /// As many samples as a process takes, with the hyper-parameters as they are.
  void use_all_samples();
  /// Readings and weights from the judgement. Outliers in a row at an end of a signal's range weigh
  /// as others: there a process that is too straight is off. True if there are any: another start
  /// may lead to one that bends.
  bool reweigh();

  /// Of the last fit().
  const Shape& shape() const { return shape_; }
  const SoftFit& judged() const { return judged_; }
  const std::vector<int>& signals() const { return signals_; }
  /// No bend in the signal at this place in signals(): at most a line.
  bool is_straight(int place) const;
  std::shared_ptr<const ResidualGp> residual_gp() const;

  /// What the left-out blocks, taken together, gain by the signals that `fewer` is without.
  Gain gain_over(const ResidualFitter& fewer) const;
  /// log P of a line in this signal explaining as much of the inliers' residuals by chance, beyond
  /// what lines in signals() do: Hotelling's T² of the blocks' scores. Each frame counts, where
  /// fit() takes few.
  double log_chance_of_line(int signal) const;

 private:
  struct Blocks {
    std::vector<int> of_frame;  // n, ascending from 0
    int count = 0;
  };
  // The tangent-space residuals of one choice of readings, and what they are trusted with.
  struct Targets {
    std::vector<FrameFit> frames;
    ResidualGp::Residuals rho;  // 6×n
    Eigen::VectorXd weights;    // n
    Vector6d noise;             // mean variance of a reading, per coordinate
  };

  static Blocks blocks_of(const PairData& pair, const TimeBlocks& time);
  Eigen::VectorXd input_row(int signal) const;
  void set_targets(bool first = true);
  Eigen::VectorXd noise_scales() const;
  // Of poses at rest: more than chance explains at one end of a signal's range, with no inlier
  // beyond and none that is wild.
  std::vector<int> outliers_at_ends() const;
  // Among the frames that are no outliers, as far as one can tell.
  void choose_samples(std::size_t most);
  void set_signals(const std::vector<int>& signals);
  void maximize(const Shape* start, int max_iterations);
  // Mean and variance of every coordinate at every frame (6×n), without the frame's block, in
  // closed form: with P = K⁻¹, the precision of the remaining samples is P_RR − P_RB P_BB⁻¹ P_BR.
  void leave_blocks_out(ResidualGp::Residuals* mean, ResidualGp::Residuals* variance) const;
  // The model's judgement on every frame without the frame's block.
  void judge();

  std::vector<double> block_density_;  // what judged_.log_density is the sum of
  const LocalModel* screws_;
  const PairData* pair_;
  const NormalizedActions* actions_;
  Blocks blocks_;
  Targets targets_;
  std::vector<int> signals_;
  Eigen::MatrixXd inputs_;    // D×n
  std::vector<int> samples_;  // indices into the frames
  Shape shape_;
  SoftFit judged_;
};

}  // namespace bodyschema
