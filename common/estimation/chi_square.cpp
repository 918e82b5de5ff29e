#include "common/estimation/chi_square.h"

#include <algorithm>
#include <boost/math/distributions/binomial.hpp>
#include <boost/math/distributions/chi_squared.hpp>
#include <boost/math/special_functions/gamma.hpp>
#include <cmath>

namespace bodyschema {

using boost::math::gamma_p;

double chi_square_quantile(double dof, double tail) {
  return boost::math::quantile(
      boost::math::complement(boost::math::chi_squared_distribution<double>(dof), tail));
}

double log_chi_square_tail(double x, double dof) {
  const double tail = boost::math::gamma_q(0.5 * dof, 0.5 * x);
  // Far out the tail underflows; its logarithm is −x/2 to leading order.
  return tail > 1e-300 ? std::log(tail) : -0.5 * x;
}

ChiSquareMoments chi_square_below(double limit, double dof) {
  // x · χ²_k(x) = k χ²_(k+2)(x).
  const double share = gamma_p(0.5 * dof, 0.5 * limit);
  const double mean = dof * gamma_p(0.5 * dof + 1, 0.5 * limit) / share;
  const double square = dof * (dof + 2) * gamma_p(0.5 * dof + 2, 0.5 * limit) / share;
  return {mean, square - mean * mean};
}

double as_of_six(double chi_square, int dof) {
  if (dof == 6) return chi_square;
  const auto spread = [](double n) { return 2 / (9 * n); };
  const double z = (std::cbrt(chi_square / dof) - 1 + spread(dof)) / std::sqrt(spread(dof));
  return 6 * std::pow(std::max(0.0, 1 - spread(6) + z * std::sqrt(spread(6))), 3);
}

int binomial_quantile(int trials, double rate, double p) {
  using namespace boost::math::policies;
  using RoundUp = policy<discrete_quantile<integer_round_up>>;
  return static_cast<int>(
      boost::math::quantile(boost::math::binomial_distribution<double, RoundUp>(trials, rate), p));
}

}  // namespace bodyschema
