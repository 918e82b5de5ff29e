#include "processes/structure_learner/joint_scatter.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>
#include <vector>

#include "common/estimation/chi_square.h"

namespace bodyschema {
namespace {

constexpr int kSweeps = 3;
// In which readings that scatter makes likely come back from the outliers.
constexpr int kRounds = 3;
// Trial deviations in units of what one frame tells of a displacement.
constexpr double kLeast = 0.1, kMost = 100, kStep = 1.15;

// What a frame says of the displacements: A = UᵀU, b = Uᵀr, and |r|².
struct Term {
  Eigen::MatrixXd A;
  Eigen::VectorXd b;
  double squared_distance = 0;
  int num_residuals = 6;
  double bound = 2 * kOutlierThreshold;  ///< of a squared distance that counts

  double bounded(double d2) const { return std::min(d2, bound); }
};

// The joints that scatter.
std::vector<int> scattering(const Eigen::VectorXd& S) {
  std::vector<int> result;
  for (int d = 0; d < S.size(); ++d)
    if (S(d) > 0) result.push_back(d);
  return result;
}

// With C = I + U S Uᵀ: U_dᵀ C⁻¹ U_d, U_dᵀ C⁻¹ r, rᵀ C⁻¹ r and log |C|. (Woodbury)
struct Given {
  double information, score, squared_distance, log_det;
};
Given given(const Term& term, const Eigen::VectorXd& S, const std::vector<int>& those, int d) {
  if (those.empty()) return {term.A(d, d), term.b(d), term.squared_distance, 0};
  Eigen::MatrixXd B = term.A(those, those);
  for (std::size_t n = 0; n < those.size(); ++n) {
    const auto i = static_cast<Eigen::Index>(n);
    B(i, i) += 1 / S(those[n]);
  }
  const Eigen::LLT<Eigen::MatrixXd> llt(B);
  const Eigen::VectorXd a = llt.matrixL().solve(term.A(those, d)),
                        b = llt.matrixL().solve(term.b(those));
  return {term.A(d, d) - a.squaredNorm(), term.b(d) - a.dot(b),
          term.squared_distance - b.squaredNorm(),
          2 * llt.matrixLLT().diagonal().array().log().sum() + S(those).array().log().sum()};
}

// log N(r; 0, I + U S Uᵀ) − log N(r; 0, I), summed [nats]; the distance of an outlier is bounded.
double gain(const std::vector<Term>& terms, const Eigen::VectorXd& S) {
  const std::vector<int> those = scattering(S);
  double sum = 0;
  for (const Term& term : terms) {
    const Given all = given(term, S, those, 0);
    sum += term.bounded(term.squared_distance) - term.bounded(all.squared_distance) - all.log_det;
  }
  return 0.5 * sum;
}

// Of a joint with variance `s` beside the others, over none.
double gain_of(const std::vector<Term>& terms, const std::vector<Given>& others, double s) {
  double sum = 0;
  for (std::size_t t = 0; t < terms.size(); ++t) {
    const auto& [information, score, d2, log_det] = others[t];
    const double more = 1 + s * information;
    sum += terms[t].bounded(d2) - terms[t].bounded(d2 - s * score * score / more) - std::log(more);
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
      sum += term.bounded(term.squared_distance) - term.bounded(term.squared_distance / factor) -
             term.num_residuals * std::log(factor);
    if (0.5 * sum > best.second) best = {factor, 0.5 * sum};
  }
  return best;
}

// The variances [half ranges²] that explain most, a joint's if it gains `price`.
Eigen::VectorXd most_likely(const std::vector<Term>& terms, double price) {
  const auto k = terms.front().b.size();
  Eigen::VectorXd S = Eigen::VectorXd::Zero(k);
  Eigen::VectorXd information = Eigen::VectorXd::Zero(k);
  for (const Term& term : terms) information += term.A.diagonal();
  information /= static_cast<double>(terms.size());
  for (int sweep = 0; sweep < kSweeps; ++sweep)
    for (int d = 0; d < k; ++d) {
      if (!(information(d) > 0)) continue;
      S(d) = 0;
      const std::vector<int> those = scattering(S);
      std::vector<Given> others;
      for (const Term& term : terms) others.push_back(given(term, S, those, d));
      double best = price;
      for (double sd = kLeast; sd <= kMost; sd *= kStep) {
        const double s = sd * sd / information(d);
        const double found = gain_of(terms, others, s);
        if (found <= best) continue;
        best = found;
        S(d) = s;
      }
    }
  return S;
}

// Where a factor on the noise explains more: beside it.
Eigen::VectorXd beside_the_noise(std::vector<Term> terms, double price) {
  const Eigen::VectorXd S = most_likely(terms, price);
  const auto [factor, gained] = factor_on_noise(terms);
  if (gain(terms, S) >= gained) return S;
  for (Term& term : terms) {
    term.A /= factor;
    term.b /= factor;
    term.squared_distance /= factor;
  }
  return most_likely(terms, price);
}

// What BIC asks of a joint's scatter [nats].
double price_of(int num_frames, double num_independent) {
  return 0.5 * std::log(num_independent) * num_frames / num_independent;
}

// By node: the index of its edge's first joint among all joints of the tree; then their number.
std::vector<int> first_joints(const TreeFit& fit) {
  std::vector<int> result{0, 0};
  for (std::size_t k = 1; k < fit.nodes().size(); ++k)
    result.push_back(result.back() + fit.nodes()[k].model.num_joints());
  return result;
}

// What the readings of a frame say that are no outliers where the joints scatter by `S`.
Term term_of(const TreeFit& fit, const std::vector<PairData>& told, const std::vector<int>& first,
             const Eigen::VectorXd& S, double dof, int t) {
  Term term{.A = Eigen::MatrixXd::Zero(first.back(), first.back()),
            .b = Eigen::VectorXd::Zero(first.back()),
            .num_residuals = 0,
            .bound = std::numeric_limits<double>::infinity()};
  const std::vector<MotionJacobian> twists = fit.joint_twists(t);
  const int n = static_cast<int>(twists.size());
  std::vector<Matrix6d> information(n, Matrix6d::Zero());  // of the parts from there on
  std::vector<Vector6d> gradient(n, Vector6d::Zero());
  for (int k = n; k-- > 0;) {
    if (const FrameFit* reading = fit.reading(t, k)) {
      const PairHypothesis& h = told[k].hypotheses[reading->hypothesis];
      const Vector6d r = dof * h.whitened(reading->error, fit.pose(t, k));
      const Matrix6d A =
          h.residual_jacobian(reading->error, fit.pose(t, k)) * adjoint(fit.pose(t, k).inverse());
      Matrix6d C = Matrix6d::Identity();
      for (int e = k; e > 0; e = fit.nodes()[e].parent) {
        const MotionJacobian U = A * twists[e];
        C += U * S.segment(first[e], U.cols()).asDiagonal() * U.transpose();
      }
      if (r.dot(C.llt().solve(r)) < outlier_threshold(reading->num_residuals)) {
        information[k] += A.transpose() * A;
        gradient[k] += A.transpose() * r;
        term.squared_distance += r.squaredNorm();
        term.num_residuals += reading->num_residuals;
      }
    }
    if (k == 0) break;
    const int parent = fit.nodes()[k].parent;
    information[parent] += information[k];
    gradient[parent] += gradient[k];
    term.b.segment(first[k], twists[k].cols()) = twists[k].transpose() * gradient[k];
    const MotionJacobian IT = information[k] * twists[k];
    for (int e = k; e > 0; e = fit.nodes()[e].parent) {
      const Eigen::MatrixXd block = twists[e].transpose() * IT;
      term.A.block(first[e], first[k], block.rows(), block.cols()) = block;
      term.A.block(first[k], first[e], block.cols(), block.rows()) = block.transpose();
    }
  }
  return term;
}

}  // namespace

Eigen::VectorXd joint_scatter(const Fit& fit, const LeaveOneOut& loo, const PairData& pair,
                              const PairData& told, const NormalizedActions& actions) {
  const int k = fit.model.num_joints();
  std::vector<Term> terms = terms_of(fit, loo, pair, told, actions);
  if (k == 0 || terms.empty() || pair.num_residuals() < 6) return Eigen::VectorXd::Zero(k);
  const double num_independent =
      actions.blocks().count(pair.frames, [](const PairFrame& f) { return f.sample; });
  return beside_the_noise(std::move(terms), price_of(pair.size(), num_independent)).cwiseSqrt();
}

Eigen::VectorXd joint_scatter(const TreeFit& fit, const std::vector<PairData>& told,
                              const Eigen::VectorXd& start) {
  const std::vector<int> first = first_joints(fit);
  std::vector<int> samples;
  int num_residuals = 0, num_parameters = 6;
  for (int t = 0; t < fit.num_frames(); ++t) {
    samples.push_back(fit.sample(t));
    for (std::size_t k = 0; k < told.size(); ++k)
      if (const FrameFit* reading = fit.reading(t, static_cast<int>(k)))
        num_residuals += reading->num_residuals;
  }
  for (std::size_t k = 1; k < told.size(); ++k)
    num_parameters += 6 + 6 * fit.nodes()[k].model.num_joints();
  if (first.back() == 0 || num_residuals <= num_parameters) return start;
  const double dof = std::sqrt(num_residuals / static_cast<double>(num_residuals - num_parameters));
  const double num_independent = fit.actions().blocks().count(samples, [](int s) { return s; });
  const double price = price_of(fit.num_frames(), num_independent);
  Eigen::VectorXd S = start.cwiseAbs2();
  for (int round = 0; round < kRounds; ++round) {
    std::vector<Term> terms;
    for (int t = 0; t < fit.num_frames(); ++t)
      terms.push_back(term_of(fit, told, first, S, dof, t));
    S = beside_the_noise(std::move(terms), price);
  }
  return S.cwiseSqrt();
}

}  // namespace bodyschema
