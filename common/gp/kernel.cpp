#include "common/gp/kernel.h"

#include <cmath>
#include <stdexcept>
#include <string>

namespace bodyschema {
namespace {

bool is_positive(double value) { return std::isfinite(value) && value > 0; }

void check_dimensions(const Kernel& kernel, Eigen::Index rows) {
  if (rows != kernel.num_dimensions())
    throw std::invalid_argument("kernel over " + std::to_string(kernel.num_dimensions()) +
                                " dimensions got inputs of " + std::to_string(rows));
}

// exp(−½ |(a_s − b_t)/ℓ|²), N_A×N_B. By differences: |a|² − 2aᵀb + |b|² cancels where points lie
// close, and there the marginal likelihood of exact data is decided.
Eigen::MatrixXd correlation(const SquaredExponential& term, const Eigen::MatrixXd& a,
                            const Eigen::MatrixXd& b) {
  Eigen::MatrixXd squared = Eigen::MatrixXd::Zero(a.cols(), b.cols());
  for (Eigen::Index d = 0; d < term.length_scales.size(); ++d) {
    const double scale = 1 / term.length_scales(d);
    for (Eigen::Index t = 0; t < b.cols(); ++t)
      squared.col(t).array() += (scale * (a.row(d).transpose().array() - b(d, t))).square();
  }
  return (-0.5 * squared.array()).exp().matrix();
}

}  // namespace

Kernel::Kernel(SquaredExponential term) : terms_{std::move(term)} {
  bool ok = is_positive(terms_[0].variance);
  for (const double scale : terms_[0].length_scales) ok &= is_positive(scale);
  if (!ok)
    throw std::invalid_argument("kernel: variance and length scales must be finite and above 0");
}

Kernel operator+(Kernel left, const Kernel& right) {
  if (left.num_dimensions() != right.num_dimensions())
    throw std::invalid_argument("kernels over " + std::to_string(left.num_dimensions()) + " and " +
                                std::to_string(right.num_dimensions()) + " dimensions do not add");
  left.terms_.insert(left.terms_.end(), right.terms_.begin(), right.terms_.end());
  return left;
}

int Kernel::num_parameters() const {
  return static_cast<int>(terms_.size()) * (1 + num_dimensions());
}

Eigen::VectorXd Kernel::log_parameters() const {
  Eigen::VectorXd result(num_parameters());
  Eigen::Index n = 0;
  for (const SquaredExponential& term : terms_) {
    result(n++) = std::log(term.variance);
    for (const double scale : term.length_scales) result(n++) = std::log(scale);
  }
  return result;
}

Kernel Kernel::with_log_parameters(const Eigen::VectorXd& log_parameters) const {
  if (log_parameters.size() != num_parameters())
    throw std::invalid_argument("kernel has " + std::to_string(num_parameters()) +
                                " parameters, not " + std::to_string(log_parameters.size()));
  const int stride = 1 + num_dimensions();
  const auto term = [&](std::size_t n) {
    const auto parameters =
        log_parameters.segment(static_cast<Eigen::Index>(n) * stride, stride).array().exp();
    return SquaredExponential{parameters(0), parameters.tail(stride - 1)};
  };
  Kernel result(term(0));
  for (std::size_t n = 1; n < terms_.size(); ++n) result = result + term(n);
  return result;
}

double Kernel::variance() const {
  double sum = 0;
  for (const SquaredExponential& term : terms_) sum += term.variance;
  return sum;
}

Eigen::MatrixXd Kernel::covariance(const Eigen::MatrixXd& a, const Eigen::MatrixXd& b) const {
  check_dimensions(*this, a.rows());
  check_dimensions(*this, b.rows());
  Eigen::MatrixXd result = Eigen::MatrixXd::Zero(a.cols(), b.cols());
  for (const SquaredExponential& term : terms_) result += term.variance * correlation(term, a, b);
  return result;
}

Eigen::MatrixXd Kernel::input_gradient(const Eigen::VectorXd& x, const Eigen::MatrixXd& a) const {
  check_dimensions(*this, x.size());
  check_dimensions(*this, a.rows());
  Eigen::MatrixXd result = Eigen::MatrixXd::Zero(a.rows(), a.cols());
  for (const SquaredExponential& term : terms_) {
    const Eigen::RowVectorXd k = term.variance * correlation(term, x, a);
    for (Eigen::Index d = 0; d < a.rows(); ++d)
      result.row(d).array() +=
          (a.row(d).array() - x(d)) * k.array() / std::pow(term.length_scales(d), 2);
  }
  return result;
}

Eigen::VectorXd Kernel::weighted_parameter_gradient(const Eigen::MatrixXd& a,
                                                    const Eigen::MatrixXd& weights) const {
  check_dimensions(*this, a.rows());
  if (weights.rows() != a.cols() || weights.cols() != a.cols())
    throw std::invalid_argument("weights must have a row and a column per input");
  Eigen::VectorXd result(num_parameters());
  Eigen::Index n = 0;
  for (const SquaredExponential& term : terms_) {
    const Eigen::MatrixXd weighted = term.variance * correlation(term, a, a).cwiseProduct(weights);
    result(n++) = weighted.sum();  // ∂k/∂log variance = k
    // ∂k/∂log ℓ_d = k · (x_d − x'_d)²/ℓ_d²
    for (Eigen::Index d = 0; d < a.rows(); ++d) {
      const double scale = 1 / term.length_scales(d);
      double sum = 0;
      for (Eigen::Index t = 0; t < a.cols(); ++t)
        sum +=
            ((scale * (a.row(d).transpose().array() - a(d, t))).square() * weighted.col(t).array())
                .sum();
      result(n++) = sum;
    }
  }
  return result;
}

}  // namespace bodyschema
