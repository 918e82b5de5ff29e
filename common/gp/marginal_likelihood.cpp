#include "common/gp/marginal_likelihood.h"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <limits>
#include <stdexcept>

#include "common/gp/minimize_in_box.h"

namespace bodyschema {
namespace {

// The coarse grid. Length scales in half ranges; noise variance over the kernel's.
constexpr double kLengths[] = {0.3, 0.7, 1.5, 3, 6, 12};
constexpr double kNoises[] = {1e-12, 1e-9, 1e-6, 1e-3, 0.03, 0.3, 3};
// Above so many dimensions the grid has equal length scales in all of them.
constexpr Eigen::Index kMaxGridDimensions = 2;
// The search from the best cell: log-likelihood [nats], steps in log-parameters (a cell's width).
constexpr double kTolerance = 1e-5;
constexpr double kMaxStep = 2;
constexpr int kMaxIterations = 40;

// The shape of a prior is what the search varies: log length scales and log noise variance over a
// kernel of variance 1.
struct Box {
  Eigen::VectorXd half_ranges;   // D, of the inputs
  Eigen::VectorXd lower, upper;  // D + 1
};

Box make_box(const Eigen::MatrixXd& inputs, const HyperParameterRange& range) {
  Box box;
  box.half_ranges = 0.5 * (inputs.rowwise().maxCoeff() - inputs.rowwise().minCoeff());
  for (double& half_range : box.half_ranges)
    if (!(half_range > 0)) half_range = 1;  // an input that does not vary
  box.lower.resize(inputs.rows() + 1);
  box.upper.resize(inputs.rows() + 1);
  box.lower << box.half_ranges.array().log() + std::log(range.least_length),
      std::log(range.least_noise);
  box.upper << box.half_ranges.array().log() + std::log(range.largest_length),
      std::log(range.largest_noise);
  if (!box.lower.allFinite() || !box.upper.allFinite() ||
      !(box.lower.array() <= box.upper.array()).all() || !(range.least_variance > 0))
    throw std::invalid_argument("hyper-parameters: the range is empty or not above 0");
  return box;
}

GpPrior unit_prior(const Eigen::VectorXd& shape, std::optional<double> mean) {
  const Eigen::Index D = shape.size() - 1;
  return {mean, SquaredExponential{1, shape.head(D).array().exp()}, std::exp(shape(D))};
}

std::vector<Eigen::VectorXd> coarse_grid(const Box& box) {
  const Eigen::Index D = box.half_ranges.size();
  const bool is_full = D <= kMaxGridDimensions;
  const int num_cells = static_cast<int>(std::pow(std::size(kLengths), is_full ? D : 1));
  std::vector<Eigen::VectorXd> grid;
  for (int cell = 0; cell < num_cells; ++cell) {
    Eigen::VectorXd shape(D + 1);
    int digits = cell;  // in base |kLengths|, one for every dimension
    for (Eigen::Index d = 0; d < D; ++d) {
      shape(d) = std::log(box.half_ranges(d) * kLengths[digits % std::size(kLengths)]);
      if (is_full) digits /= std::size(kLengths);
    }
    for (const double noise : kNoises) {
      shape(D) = std::log(noise);
      grid.push_back(shape.cwiseMax(box.lower).cwiseMin(box.upper));
    }
  }
  return grid;
}

/// The likeliest cell of the grid for each of P functions: one factorisation a cell for all of them.
/// An unknown mean is projected out.
std::vector<Eigen::VectorXd> best_cells(const Eigen::MatrixXd& inputs,
                                        const Eigen::MatrixXd& targets,
                                        const Eigen::VectorXd& noise_scales,
                                        std::optional<double> mean,
                                        const HyperParameterRange& range, const Box& box) {
  const Eigen::Index N = inputs.cols(), P = targets.cols();
  Eigen::MatrixXd centred = targets;
  if (mean) {
    centred.array() -= *mean;
  } else {
    centred.rowwise() -= targets.colwise().mean();
  }
  const double dof = static_cast<double>(mean ? N : N - 1);
  Eigen::VectorXd best = Eigen::VectorXd::Constant(P, -std::numeric_limits<double>::infinity());
  std::vector<Eigen::VectorXd> shapes(P, 0.5 * (box.lower + box.upper));
  for (const Eigen::VectorXd& shape : coarse_grid(box)) {
    const GpPrior prior = unit_prior(shape, mean);
    Eigen::MatrixXd K = prior.kernel.covariance(inputs, inputs);
    K.diagonal() += prior.noise_variance * noise_scales;
    const Eigen::LLT<Eigen::MatrixXd> llt(K);
    if (llt.info() != Eigen::Success) continue;
    double log_det = 2 * llt.matrixLLT().diagonal().array().log().sum();
    Eigen::MatrixXd whitened = llt.matrixL().solve(centred);
    if (!mean) {
      const Eigen::VectorXd one = llt.matrixL().solve(Eigen::VectorXd::Ones(N));
      log_det += std::log(one.squaredNorm());
      whitened -= one * (one.transpose() * whitened) / one.squaredNorm();
    }
    const Eigen::VectorXd scales =
        whitened.colwise().squaredNorm().transpose() / std::max(dof, 1.0);
    for (Eigen::Index p = 0; p < P; ++p) {
      const double scale = std::max(scales(p), range.least_variance);
      const double value = -0.5 * (dof * (scales(p) / scale + std::log(scale)) + log_det);
      if (value <= best(p)) continue;
      best(p) = value;
      shapes[p] = shape;
    }
  }
  return shapes;
}

}  // namespace

std::vector<GpPrior> maximize_marginal_likelihood(const Eigen::MatrixXd& inputs,
                                                  const Eigen::MatrixXd& targets,
                                                  const Eigen::VectorXd& noise_scales,
                                                  std::optional<double> mean,
                                                  const HyperParameterRange& range) {
  const Eigen::Index N = inputs.cols(), P = targets.cols();
  if (inputs.rows() < 1 || N < 1 || targets.rows() != N ||
      (noise_scales.size() > 0 && noise_scales.size() != N))
    throw std::invalid_argument("hyper-parameters: inputs must be D×N, targets N×P, with D, N ≥ 1");
  if (!inputs.allFinite() || !targets.allFinite() || !noise_scales.allFinite())
    throw std::invalid_argument("hyper-parameters: inputs and targets must be finite");
  const Eigen::VectorXd scales_of_noise =
      noise_scales.size() > 0 ? noise_scales : Eigen::VectorXd::Ones(N);
  const Box box = make_box(inputs, range);

  const std::vector<Eigen::VectorXd> shapes =
      best_cells(inputs, targets, scales_of_noise, mean, range, box);
  std::vector<GpPrior> result;
  for (Eigen::Index p = 0; p < P; ++p) {
    const auto fitted = [&](const Eigen::VectorXd& shape) {
      return FittedGp(unit_prior(shape, mean), inputs, targets.col(p), noise_scales);
    };
    const auto scale_of = [&](const FittedGp& gp) {
      return std::max(gp.best_scale(), range.least_variance);
    };
    // −log p(y) at the best scale. By the envelope theorem the scale adds nothing to the gradient.
    const auto objective = [&](const Eigen::VectorXd& shape, Eigen::VectorXd* gradient) {
      const FittedGp gp = fitted(shape);
      const double scale = scale_of(gp);
      if (gradient) *gradient = -gp.log_marginal_likelihood_gradient(scale).tail(shape.size());
      return -gp.log_marginal_likelihood(scale);
    };
    const Eigen::VectorXd shape = minimize_in_box(objective, shapes[p], box.lower, box.upper,
                                                  kTolerance, kMaxStep, kMaxIterations)
                                      .x;
    const double scale = scale_of(fitted(shape));
    const GpPrior unit = unit_prior(shape, mean);
    result.push_back({mean, SquaredExponential{scale, unit.kernel.terms().front().length_scales},
                      scale * unit.noise_variance});
  }
  return result;
}

}  // namespace bodyschema
