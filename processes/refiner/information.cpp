#include "processes/refiner/information.h"

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>

#include "common/estimation/chi_square.h"
#include "common/estimation/student_t.h"
#include "processes/refiner/shared_errors.h"

namespace bodyschema {
namespace {

/// Eigenvalue of the information scaled to a unit diagonal below which nothing is told of a
/// direction: rounding leaves 1e-14 of one, a direction that is told has more than 1e-9.
constexpr double kLeastEigenvalue = 1e-11;

/// ∂r/∂(free directions) of all data, blocks in the order given.
ceres::CRSMatrix jacobian_of(RefinementProblem& problem,
                             const std::vector<ParameterBlock*>& blocks) {
  ceres::Problem::EvaluateOptions options;
  options.apply_loss_function = false;
  for (ParameterBlock* block : blocks) options.parameter_blocks.push_back(problem.memory_of(block));
  for (const auto& datum : problem.data()) options.residual_blocks.push_back(datum.id);
  ceres::CRSMatrix jacobian;
  problem.evaluate(options, nullptr, nullptr, &jacobian);
  return jacobian;
}

}  // namespace

// Over all free directions, the instants' eliminated: those refined and those held by priors.
struct Information::Sums {
  std::vector<ParameterBlock*> blocks;
  Eigen::MatrixXd A, B, shared;  // curvature, covariance of the score, Σ G Gᵀ
  int num_instants = 0, instant_size = 0;
};

// Student-t weights of the data, and what they make of a fit's covariance.
struct Information::Weights {
  std::vector<double> of_datum;
  double alpha = 0, beta = 0, mean = 0;

  Weights(const std::vector<RefinementProblem::Datum>& data, std::vector<double> squared,
          double num_parameters, double num_plays) {
    double num_residuals = 0;
    for (const auto& datum : data) num_residuals += datum.num_residuals;
    // Residuals of a fit are smaller than errors by the degrees of freedom that it took.
    const auto lost = [&](double num_fitted) {
      return num_residuals / std::max(num_residuals - num_fitted, 1.0);
    };
    for (double& d2 : squared) d2 *= lost(num_parameters + num_plays);
    double total = 0, second = 0, score = 0, inlier_total = 0, num_inliers = 0;
    const auto is_inlier = [&](std::size_t n) {
      return squared[n] < chi_square_quantile(data[n].num_residuals, 0.0027);
    };
    for (std::size_t n = 0; n < data.size(); ++n) {
      const int num = data[n].num_residuals;
      const double d2 = squared[n], w = robust_weight(d2, num);
      of_datum.push_back(w);
      total += w * num;
      second += w * num - 2 * w * d2 / (kStudentNu + d2);
      score += w * w * d2;
      if (!is_inlier(n)) continue;
      inlier_total += w;
      num_inliers += 1;
    }
    // Among inliers a weight tells chance alone, and data would count more where they agree with
    // the fit by chance: they all have the mean.
    for (std::size_t n = 0; n < data.size(); ++n)
      if (is_inlier(n)) of_datum[n] = inlier_total / num_inliers;
    alpha = second / total;
    mean = total / num_residuals;
    // Once more for what weights, derivatives and the fit owe to the same few samples: without it
    // the ellipsoids of 95 % hold 89 to 91 % at 10 samples (`./run experiment refinement robots`).
    // Plays are drawn anew in each sample, as noise is.
    beta = lost(num_parameters) * score / total;
  }
};

Information::Information(RefinementProblem& problem, const MeasurementModel& measurement,
                         int num_not_fitted) {
  double num_parameters = -num_not_fitted;
  for (ParameterBlock* block : problem.blocks()) {
    if (!block->is_refined) continue;
    const bool has_plays = block->kind == ParameterBlock::Kind::kInstant;
    num_parameters += problem.num_fitted(*block) - (has_plays ? std::ssize(problem.plays()) : 0);
  }
  const Weights weights(problem.data(), problem.squared_distances(), num_parameters,
                        problem.num_determined_plays());
  const double correlation = problem.serial_correlation();
  // A joint that rested would seem to have moved by its play.
  problem.zero_plays();
  // What is held has a derivative too.
  for (ParameterBlock* block : problem.blocks())
    if (!block->is_refined) problem.problem().SetParameterBlockVariable(problem.memory_of(block));
  Sums sums = weighted(problem, weights, measurement);
  // The sum of a first-order autoregression's errors, over that of white ones.
  sums.B *= (1 + correlation) / (1 - correlation);
  for (ParameterBlock* block : problem.blocks())
    if (!block->is_refined) problem.problem().SetParameterBlockConstant(problem.memory_of(block));
  invert(problem, sums, weights);
}

namespace {

/// Rows of one residual block of the Jacobian, with the columns that they have.
struct Rows {
  Eigen::MatrixXd J;
  std::vector<int> columns;
};

std::vector<Rows> rows_of(const ceres::CRSMatrix& jacobian,
                          const std::vector<RefinementProblem::Datum>& data) {
  std::vector<Rows> result;
  int row = 0;
  for (const auto& datum : data) {
    // All rows of a residual block have the same columns.
    const int begin = jacobian.rows[row], end = jacobian.rows[row + 1];
    Rows& rows = result.emplace_back();
    rows.columns.assign(jacobian.cols.begin() + begin, jacobian.cols.begin() + end);
    rows.J.resize(datum.num_residuals, end - begin);
    for (int r = 0; r < datum.num_residuals; ++r, ++row)
      for (int c = 0; c < end - begin; ++c) rows.J(r, c) = jacobian.values[jacobian.rows[row] + c];
  }
  return result;
}

/// Σ w JᵀJ of one instant's own parameters, and mixed with the others.
struct Instant {
  Eigen::MatrixXd own, mixed;  // e×e, e×P
};

/// Σ G Gᵀ over the errors, the instants' own parameters eliminated by their `effects`.
struct Sizes {
  Eigen::Index parameters = 0;
  int instant = 0, eliminated = 0;
};
Eigen::MatrixXd shared_score(const std::vector<Rows>& rows, const std::vector<double>& weights,
                             const std::vector<std::vector<SharedError>>& errors,
                             const std::map<int, Eigen::MatrixXd>& effects, const Sizes& sizes) {
  std::map<int, Eigen::MatrixXd> shared;  // G, by error
  for (std::size_t n = 0; n < rows.size(); ++n) {
    if (errors[n].empty()) continue;
    Eigen::MatrixXd J = Eigen::MatrixXd::Zero(rows[n].J.rows(), sizes.parameters);
    for (auto c = static_cast<std::size_t>(sizes.instant); c < rows[n].columns.size(); ++c)
      J.col(rows[n].columns[c] - sizes.eliminated) = rows[n].J.col(static_cast<Eigen::Index>(c));
    if (sizes.instant > 0)
      J -= rows[n].J.leftCols(sizes.instant) * effects.at(rows[n].columns.front());
    for (const auto& [error, effect] : errors[n]) {
      Eigen::MatrixXd& G = shared[error];
      if (G.size() == 0) G = Eigen::MatrixXd::Zero(sizes.parameters, effect.cols());
      G += weights[n] * J.transpose() * effect;
    }
  }
  Eigen::MatrixXd sum = Eigen::MatrixXd::Zero(sizes.parameters, sizes.parameters);
  for (const auto& [error, G] : shared) sum += G * G.transpose();
  return sum;
}

}  // namespace

Information::Sums Information::weighted(RefinementProblem& problem, const Weights& weights,
                                        const MeasurementModel& measurement) {
  Sums sums;
  Eigen::Index size = 0;
  for (ParameterBlock* block : problem.blocks()) {
    if (block->kind == ParameterBlock::Kind::kInstant) {
      ++sums.num_instants;
      sums.instant_size = block->num_free();
    } else {
      sums.blocks.push_back(block);
      size += block->num_free();
    }
  }
  const std::vector<Rows> rows = rows_of(jacobian_of(problem, problem.blocks()), problem.data());
  const int e = sums.instant_size, num_eliminated = e * sums.num_instants;
  Eigen::MatrixXd H = Eigen::MatrixXd::Zero(size, size);
  std::map<int, Instant> instants;  // by their first column
  for (std::size_t n = 0; n < rows.size(); ++n) {
    const Eigen::MatrixXd product = weights.of_datum[n] * rows[n].J.transpose() * rows[n].J;
    const auto column = [&](int c) { return rows[n].columns[c] - num_eliminated; };
    const int width = static_cast<int>(rows[n].columns.size());
    for (int c = e; c < width; ++c)
      for (int r = e; r < width; ++r) H(column(r), column(c)) += product(r, c);
    if (e == 0) continue;
    Instant& instant = instants[rows[n].columns.front()];
    if (instant.own.size() == 0) {
      instant.own = Eigen::MatrixXd::Zero(e, e);
      instant.mixed = Eigen::MatrixXd::Zero(e, size);
    }
    instant.own += product.topLeftCorner(e, e);
    for (int c = e; c < width; ++c) instant.mixed.col(column(c)) += product.col(c).head(e);
  }
  std::map<int, Eigen::MatrixXd> effects;
  sums.A = weights.alpha * H;
  sums.B = weights.beta * H;
  // Plays have a prior, a moving root's pose has none here.
  Eigen::VectorXd prior = Eigen::VectorXd::Zero(e);
  if (e > 0) prior.tail(problem.play_sd().size()) = problem.play_sd().array().square().inverse();
  for (const auto& [column, instant] : instants) {
    Eigen::MatrixXd own_A = weights.alpha * instant.own, own_B = weights.beta * instant.own;
    own_A.diagonal() += prior;
    own_B.diagonal() += prior;
    const Eigen::MatrixXd effect = own_A.ldlt().solve(weights.alpha * instant.mixed);
    const Eigen::MatrixXd both = weights.beta * instant.mixed.transpose() * effect;
    sums.A -= weights.alpha * instant.mixed.transpose() * effect;
    sums.B += effect.transpose() * own_B * effect - both - both.transpose();
    effects[column] = effect;
  }
  sums.shared = shared_score(rows, weights.of_datum, shared_errors(problem, measurement), effects,
                             {size, e, num_eliminated});
  return sums;
}

void Information::invert(const RefinementProblem& problem, const Sums& sums,
                         const Weights& weights) {
  std::vector<Eigen::Index> refined, held;
  std::vector<double> prior;  // information, by column of H
  for (ParameterBlock* block : sums.blocks) {
    if (block->is_refined) {
      offsets_[block] = static_cast<int>(refined.size());
      blocks_.push_back(block);
    }
    for (const int direction : block->free) {
      (block->is_refined ? refined : held).push_back(std::ssize(prior));
      prior.push_back(problem.prior_information(*block, direction));
    }
  }
  const Eigen::VectorXd P = Eigen::Map<const Eigen::VectorXd>(prior.data(), std::ssize(prior));
  const Eigen::MatrixXd P_refined = P(refined).asDiagonal();
  curvature_ = sums.A(refined, refined) + P_refined;
  lasting_score_ = sums.shared(refined, refined);
  worth_ = weights.alpha * weights.mean;
  const Eigen::MatrixXd& A = curvature_;

  const Eigen::VectorXd unit =
      A.diagonal().unaryExpr([](double x) { return x > 0 ? 1 / std::sqrt(x) : 1.0; });
  const Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd> eigen(unit.asDiagonal() * A *
                                                             unit.asDiagonal());
  const Eigen::VectorXd& values = eigen.eigenvalues();
  const auto num_undetermined = (values.array() < kLeastEigenvalue).count();
  undetermined_ = eigen.eigenvectors().leftCols(num_undetermined);
  const Eigen::MatrixXd half =
      unit.asDiagonal() * eigen.eigenvectors() *
      values.cwiseMax(kLeastEigenvalue).cwiseSqrt().cwiseInverse().asDiagonal();
  const Eigen::MatrixXd inverse = half * half.transpose();
  covariance_ =
      inverse * (sums.B(refined, refined) + P_refined + sums.shared(refined, refined)) * inverse;
  // Along what nothing tells there is no score either.
  const Eigen::MatrixXd open = half.leftCols(num_undetermined);
  covariance_ += open * open.transpose();
  if (held.empty()) return;
  const Eigen::MatrixXd mixed = sums.A(refined, held);
  const Eigen::MatrixXd K = inverse * mixed;
  covariance_ += K * P(held).cwiseInverse().asDiagonal() * K.transpose();
  lasting_score_ += mixed * P(held).cwiseInverse().asDiagonal() * mixed.transpose();
}

int Information::offset(const ParameterBlock* block) const {
  const auto found = offsets_.find(block);
  return found == offsets_.end() ? -1 : found->second;
}

Eigen::MatrixXd Information::cross_covariance(const ParameterBlock* one,
                                              const ParameterBlock* other) const {
  Eigen::MatrixXd full = Eigen::MatrixXd::Zero(one->tangent_size(), other->tangent_size());
  const int row = offset(one), column = offset(other);
  if (row < 0 || column < 0) return full;
  full(one->free, other->free) = covariance_.block(row, column, one->num_free(), other->num_free());
  return full;
}

}  // namespace bodyschema
