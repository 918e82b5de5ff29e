#include "common/schema/residual_gp.h"

#include <stdexcept>
#include <string>
#include <utility>

namespace bodyschema {

ResidualGp::ResidualGp(std::vector<int> signals, Eigen::MatrixXd inputs, Residuals residuals,
                       Eigen::VectorXd noise_scales, Prior prior)
    : signals_(std::move(signals)),
      inputs_(std::move(inputs)),
      residuals_(std::move(residuals)),
      noise_scales_(std::move(noise_scales)),
      prior_(std::move(prior)) {
  const auto D = static_cast<Eigen::Index>(signals_.size());
  const Eigen::Index N = inputs_.cols();
  if (D < 1 || inputs_.rows() != D || prior_.length_scales.size() != D)
    throw std::invalid_argument("residual GP: one row of inputs and one length scale per signal");
  if (N < 1 || N > kMaxSamples || residuals_.cols() != N || noise_scales_.size() != N)
    throw std::invalid_argument("residual GP: takes 1 to " + std::to_string(kMaxSamples) +
                                " samples, each with input, residual and noise scale");
  for (const int signal : signals_)
    if (signal < 0) throw std::invalid_argument("residual GP: a signal's index is below 0");
  for (int c = 0; c < 6; ++c)
    coordinates_.emplace_back(
        GpPrior{0.0, SquaredExponential{prior_.variances(c), prior_.length_scales},
                prior_.noise_variances(c)},
        inputs_, residuals_.row(c).transpose(), noise_scales_);
}

Eigen::VectorXd ResidualGp::input_of(const Eigen::VectorXd& theta) const {
  Eigen::VectorXd x(signals_.size());
  for (std::size_t d = 0; d < signals_.size(); ++d) {
    if (signals_[d] >= theta.size())
      throw std::invalid_argument("action has no signal " + std::to_string(signals_[d]));
    x(static_cast<Eigen::Index>(d)) = theta(signals_[d]);
  }
  return x;
}

Vector6d ResidualGp::mean(const Eigen::VectorXd& theta) const {
  const Eigen::VectorXd x = input_of(theta);
  Vector6d result;
  for (int c = 0; c < 6; ++c) result(c) = coordinates_[c].mean(x)(0);
  return result;
}

Eigen::MatrixXd ResidualGp::mean_gradient(const Eigen::VectorXd& theta) const {
  const Eigen::VectorXd x = input_of(theta);
  Eigen::MatrixXd result = Eigen::MatrixXd::Zero(6, theta.size());
  for (int c = 0; c < 6; ++c) {
    const Eigen::VectorXd gradient = coordinates_[c].mean_gradient(x);
    for (std::size_t d = 0; d < signals_.size(); ++d)
      result(c, signals_[d]) += gradient(static_cast<Eigen::Index>(d));
  }
  return result;
}

Vector6d ResidualGp::variance(const Eigen::VectorXd& theta) const {
  const Eigen::VectorXd x = input_of(theta);
  Vector6d result;
  for (int c = 0; c < 6; ++c) result(c) = coordinates_[c].marginal_variance(x)(0);
  return result;
}

bool ResidualGp::operator==(const ResidualGp& other) const {
  return signals_ == other.signals_ && num_samples() == other.num_samples() &&
         inputs_ == other.inputs_ && residuals_ == other.residuals_ &&
         noise_scales_ == other.noise_scales_ &&
         prior_.length_scales == other.prior_.length_scales &&
         prior_.variances == other.prior_.variances &&
         prior_.noise_variances == other.prior_.noise_variances;
}

}  // namespace bodyschema
