#pragma once

#include "common/gp/gp.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema::test {

/// A D×N matrix, uniform in [low, high].
inline Eigen::MatrixXd random_inputs(int num_dimensions, int num_points, double low, double high,
                                     Rng& rng) {
  Eigen::MatrixXd x(num_dimensions, num_points);
  for (double& value : x.reshaped()) value = uniform(rng, low, high);
  return x;
}

/// One draw of y = f(x) + ε at the columns of `inputs`; an unknown mean is 0.
inline Eigen::VectorXd draw(const GpPrior& prior, const Eigen::MatrixXd& inputs, Rng& rng) {
  Eigen::MatrixXd K = prior.kernel.covariance(inputs, inputs);
  K.diagonal().array() += prior.noise_variance + 1e-12;
  Eigen::VectorXd white(inputs.cols());
  for (double& value : white) value = gaussian(rng);
  return ((K.llt().matrixL() * white).array() + prior.mean.value_or(0)).matrix();
}

}  // namespace bodyschema::test
