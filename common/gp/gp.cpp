#include "common/gp/gp.h"

#include <cmath>
#include <limits>
#include <stdexcept>
#include <string>

namespace bodyschema {
namespace {

constexpr double kLeastJitter = 1e-12, kLargestJitter = 1e-6;  // of the largest variance

bool is_factorised(const Eigen::LLT<Eigen::MatrixXd>& llt, double largest) {
  const auto pivots = llt.matrixLLT().diagonal().array();
  const double least =
      static_cast<double>(pivots.size()) * std::numeric_limits<double>::epsilon() * largest;
  return llt.info() == Eigen::Success && pivots.square().minCoeff() > least;
}

}  // namespace

Eigen::VectorXd GpPrior::log_parameters() const {
  Eigen::VectorXd result(kernel.num_parameters() + 1);
  result << kernel.log_parameters(), std::log(noise_variance);
  return result;
}

GpPrior GpPrior::with_log_parameters(const Eigen::VectorXd& log_parameters) const {
  if (log_parameters.size() != kernel.num_parameters() + 1)
    throw std::invalid_argument("prior has " + std::to_string(kernel.num_parameters() + 1) +
                                " parameters, not " + std::to_string(log_parameters.size()));
  return {mean, kernel.with_log_parameters(log_parameters.head(kernel.num_parameters())),
          std::exp(log_parameters(kernel.num_parameters()))};
}

FittedGp::FittedGp(GpPrior prior, Eigen::MatrixXd inputs, const Eigen::VectorXd& targets,
                   const Eigen::VectorXd& noise_scales)
    : prior_(std::move(prior)),
      inputs_(std::move(inputs)),
      targets_(targets),
      noise_scales_(noise_scales.size() > 0 ? noise_scales
                                            : Eigen::VectorXd::Ones(targets.size())) {
  const Eigen::Index n = inputs_.cols();
  if (targets_.size() != n || noise_scales_.size() != n)
    throw std::invalid_argument("Gaussian process: " + std::to_string(n) + " inputs, " +
                                std::to_string(targets_.size()) + " targets, " +
                                std::to_string(noise_scales_.size()) + " noise scales");
  if (!inputs_.allFinite() || !targets_.allFinite() || !noise_scales_.allFinite() ||
      !std::isfinite(prior_.mean.value_or(0)))
    throw std::invalid_argument("Gaussian process: inputs, targets and mean must be finite");
  if (!std::isfinite(prior_.noise_variance) || prior_.noise_variance < 0 ||
      (noise_scales_.array() <= 0).any())
    throw std::invalid_argument("Gaussian process: a noise variance is not finite or below 0");
  Eigen::MatrixXd K = prior_.kernel.covariance(inputs_, inputs_);
  K.diagonal() += prior_.noise_variance * noise_scales_;
  mean_ = prior_.mean.value_or(0);
  llt_.compute(K);
  if (n == 0) {
    if (!prior_.mean)
      throw std::invalid_argument("Gaussian process: neither a mean nor observations");
    return;
  }
  const double largest = K.diagonal().maxCoeff();
  for (double relative = kLeastJitter;
       !is_factorised(llt_, largest) && relative < 2 * kLargestJitter; relative *= 10) {
    K.diagonal().array() += relative * largest - jitter_;
    jitter_ = relative * largest;
    llt_.compute(K);
  }
  if (!is_factorised(llt_, largest))  // a covariance beyond what doubles hold
    throw std::invalid_argument("Gaussian process: the covariance cannot be factorised");
  if (!prior_.mean) {
    mean_weights_ = llt_.solve(Eigen::VectorXd::Ones(n));
    mean_information_ = mean_weights_.sum();
    mean_ = mean_weights_.dot(targets_) / mean_information_;
  }
  alpha_ = llt_.solve((targets_.array() - mean_).matrix());
}

// How far an error of the estimated mean reaches: 1 − k(x)ᵀ K⁻¹ 1. `k` is N×M.
Eigen::VectorXd FittedGp::mean_influence(const Eigen::MatrixXd& k) const {
  return (1 - (k.transpose() * mean_weights_).array()).matrix();
}

Eigen::VectorXd FittedGp::mean(const Eigen::MatrixXd& x) const {
  const Eigen::MatrixXd k = prior_.kernel.covariance(x, inputs_);
  if (num_observations() == 0) return Eigen::VectorXd::Constant(x.cols(), mean_);
  return ((k * alpha_).array() + mean_).matrix();
}

Eigen::VectorXd FittedGp::marginal_variance(const Eigen::MatrixXd& x) const {
  const Eigen::MatrixXd k = prior_.kernel.covariance(inputs_, x);
  Eigen::VectorXd result = Eigen::VectorXd::Constant(x.cols(), prior_.kernel.variance());
  if (num_observations() > 0) result -= llt_.matrixL().solve(k).colwise().squaredNorm().transpose();
  if (!prior_.mean) result += mean_influence(k).cwiseAbs2() / mean_information_;
  return result.cwiseMax(0);  // rounding
}

Eigen::MatrixXd FittedGp::joint_covariance(const Eigen::MatrixXd& x) const {
  const Eigen::MatrixXd k = prior_.kernel.covariance(inputs_, x);
  Eigen::MatrixXd result = prior_.kernel.covariance(x, x);
  if (num_observations() > 0) {
    const Eigen::MatrixXd half = llt_.matrixL().solve(k);
    result -= half.transpose() * half;
  }
  if (!prior_.mean) {
    const Eigen::VectorXd u = mean_influence(k);
    result += u * u.transpose() / mean_information_;
  }
  result.diagonal() = result.diagonal().cwiseMax(0);
  return result;
}

Eigen::VectorXd FittedGp::mean_gradient(const Eigen::VectorXd& x) const {
  const Eigen::MatrixXd gradient = prior_.kernel.input_gradient(x, inputs_);
  if (num_observations() == 0) return Eigen::VectorXd::Zero(x.size());
  return gradient * alpha_;
}

// K⁻¹; with an unknown mean P = K⁻¹ − K⁻¹1 1ᵀK⁻¹/(1ᵀK⁻¹1), which takes its place everywhere.
Eigen::MatrixXd FittedGp::precision() const {
  Eigen::MatrixXd P = llt_.solve(Eigen::MatrixXd::Identity(num_observations(), num_observations()));
  if (!prior_.mean) P -= mean_weights_ * mean_weights_.transpose() / mean_information_;
  return P;
}

GpLeaveOneOut FittedGp::leave_one_out() const {
  if (num_observations() == 0) return {};
  if (degrees_of_freedom() == 0)
    throw std::invalid_argument("leave-one-out of a single observation takes a known mean");
  const Eigen::ArrayXd variance = precision().diagonal().array().inverse();
  return {(targets_.array() - alpha_.array() * variance).matrix(), variance.matrix()};
}

double FittedGp::best_scale() const {
  if (degrees_of_freedom() == 0) return 0;
  return (targets_.array() - mean_).matrix().dot(alpha_) / degrees_of_freedom();
}

double FittedGp::log_marginal_likelihood(double scale) const {
  if (degrees_of_freedom() == 0) return 0;
  double result =
      -0.5 * degrees_of_freedom() * (best_scale() / scale + std::log(2 * M_PI * scale)) -
      llt_.matrixLLT().diagonal().array().log().sum();
  if (!prior_.mean) result -= 0.5 * std::log(mean_information_);
  return result;
}

Eigen::VectorXd FittedGp::log_marginal_likelihood_gradient(double scale) const {
  Eigen::VectorXd result = Eigen::VectorXd::Zero(prior_.kernel.num_parameters() + 1);
  if (degrees_of_freedom() == 0) return result;
  // ½ tr((ααᵀ/scale − K⁻¹) ∂K/∂θ): a factor on all of K cancels in K⁻¹ ∂K.
  Eigen::MatrixXd weights = -0.5 * precision();
  weights += (0.5 / scale * alpha_) * alpha_.transpose();
  result << prior_.kernel.weighted_parameter_gradient(inputs_, weights),
      prior_.noise_variance * weights.diagonal().dot(noise_scales_);
  return result;
}

}  // namespace bodyschema
