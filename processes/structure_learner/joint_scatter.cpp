#include "processes/structure_learner/joint_scatter.h"

#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <vector>

#include "common/estimation/chi_square.h"

namespace bodyschema {
namespace {

constexpr int kSweeps = 3;
// Trial deviations in units of what one frame tells of a displacement.
constexpr double kLeast = 0.1, kMost = 100, kStep = 1.15;

// What a frame says of the displacements: A = UᵀU, b = Uᵀr, and |r|².
struct Term {
  Eigen::MatrixXd A;
  Eigen::VectorXd b;
  double squared_distance = 0;
};

double bounded(double squared_distance) {
  return std::min(squared_distance, 2 * kOutlierThreshold);
}

// log N(r; 0, I + U S Uᵀ) − log N(r; 0, I), summed [nats]; the distance of an outlier is bounded.
double gain(const std::vector<Term>& terms, const Eigen::VectorXd& S) {
  double sum = 0;
  for (const Term& term : terms) {
    const Eigen::MatrixXd SA = S.asDiagonal() * term.A;
    const Eigen::PartialPivLU<Eigen::MatrixXd> lu(Eigen::MatrixXd::Identity(S.size(), S.size()) +
                                                  SA);
    const double explained = term.b.dot(lu.solve(S.cwiseProduct(term.b)));
    sum += bounded(term.squared_distance) - bounded(term.squared_distance - explained) -
           std::log(lu.determinant());
  }
  return 0.5 * sum;
}

std::vector<Term> terms_of(const Fit& fit, const LeaveOneOut& loo, const PairData& pair,
                           const PairData& told, const NormalizedActions& actions) {
  std::vector<Term> terms;
  for (int t = 0; t < pair.size(); ++t) {
    const int h = fit.frames[t].hypothesis;
    const Matrix6d& W = told.hypotheses[h].whitening;
    // As long as one of unit covariance: without what the parameters are off by.
    const double whole = (pair.hypotheses[h].whitening * loo.residual[t]).squaredNorm();
    const Vector6d r =
        W * loo.residual[t] * std::sqrt(loo.squared_distance[t] / std::max(whole, 1e-300));
    const Eigen::MatrixXd U = W * motion_jacobian(fit.model, actions, pair.frames[t].sample);
    terms.push_back({U.transpose() * U, U.transpose() * r, r.squaredNorm()});
  }
  return terms;
}

// The factor ≥ 1 on the noise's variance that explains most, and what it gains [nats].
std::pair<double, double> factor_on_noise(const std::vector<Term>& terms) {
  std::pair<double, double> best{1, 0};
  for (double factor = 1; factor < kMost * kMost; factor *= kStep) {
    double sum = 0;
    for (const Term& term : terms)
      sum += bounded(term.squared_distance) - bounded(term.squared_distance / factor) -
             6 * std::log(factor);
    if (0.5 * sum > best.second) best = {factor, 0.5 * sum};
  }
  return best;
}

// The variances [half ranges²] that explain most, a joint's if it gains `price`.
Eigen::VectorXd most_likely(const std::vector<Term>& terms, int k, double price) {
  Eigen::VectorXd S = Eigen::VectorXd::Zero(k);
  Eigen::VectorXd information = Eigen::VectorXd::Zero(k);
  for (const Term& term : terms) information += term.A.diagonal();
  information /= static_cast<double>(terms.size());
  for (int sweep = 0; sweep < kSweeps; ++sweep)
    for (int d = 0; d < k; ++d) {
      if (!(information(d) > 0)) continue;
      Eigen::VectorXd trial = S;
      trial(d) = S(d) = 0;
      double best = gain(terms, S) + price;
      for (double sd = kLeast; sd <= kMost; sd *= kStep) {
        trial(d) = sd * sd / information(d);
        const double found = gain(terms, trial);
        if (found <= best) continue;
        best = found;
        S(d) = trial(d);
      }
    }
  return S;
}

}  // namespace

Eigen::VectorXd joint_scatter(const Fit& fit, const LeaveOneOut& loo, const PairData& pair,
                              const PairData& told, const NormalizedActions& actions) {
  const int k = fit.model.num_joints();
  std::vector<Term> terms = terms_of(fit, loo, pair, told, actions);
  if (k == 0 || terms.empty() || pair.num_residuals() < 6) return Eigen::VectorXd::Zero(k);
  const double num_independent =
      actions.blocks().count(pair.frames, [](const PairFrame& f) { return f.sample; });
  const double price = 0.5 * std::log(num_independent) * pair.size() / num_independent;
  const Eigen::VectorXd S = most_likely(terms, k, price);
  const auto [factor, gained] = factor_on_noise(terms);
  if (gain(terms, S) >= gained) return S.cwiseSqrt();
  for (Term& term : terms) {
    term.A /= factor;
    term.b /= factor;
    term.squared_distance /= factor;
  }
  return most_likely(terms, k, price).cwiseSqrt();
}

}  // namespace bodyschema
