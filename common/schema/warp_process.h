#pragma once

#include <Eigen/Core>
#include <array>
#include <vector>

#include "common/schema/signal.h"

namespace bodyschema {

/// Number of weights of a process that is searched for.
inline constexpr int kWarpSize = 20;
/// Correlation lengths and amplitudes that are tried for a warp, in half ranges.
inline constexpr std::array<double, 3> kWarpLengths{0.25, 0.4, 0.7};
inline constexpr std::array<double, 5> kWarpAmplitudes{0.003, 0.01, 0.03, 0.1, 0.3};

/// Log marginal likelihood that a warp must gain over the linear command [nats].
inline constexpr double kWarpEvidence = 10;
/// Positions of a signal below which its command is taken to be linear: a line and a process of
/// unknown amplitude and length go through any few. Chosen: of 20 random positions 18 count.
inline constexpr int kFewestWarpPositions = 15;
/// How many of the positions [half ranges] are 0.01 from each other: a repeated one tells nothing
/// of what is between.
int num_positions_apart(std::vector<double> positions);

/// Variances of the weights of warp_basis() for a process of amplitude 1: the spectral density of
/// a squared exponential of that length (Solin and Särkkä 2020).
Eigen::ArrayXd warp_spectrum(double length, Eigen::Index size);

/// A process that may have bent a command, by what the data tell.
struct WarpProcess {
  Eigen::VectorXd mean;            ///< of all parameters, the weights last
  Eigen::VectorXd prior_variance;  ///< of the same
  double evidence = 0;             ///< log marginal likelihood over that without weights [nats]
};

/// Processes of all lengths and amplitudes, for a log likelihood bᵀx − ½ xᵀAx of parameters x, in
/// half ranges: `num_others` that are all but free, then the weights of warp_basis().
std::vector<WarpProcess> warp_processes(const Eigen::MatrixXd& A, const Eigen::VectorXd& b,
                                        int num_others);

}  // namespace bodyschema
