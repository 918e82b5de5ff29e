// How far joints are off their commands: RefinementProblem's plays.

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <utility>

#include "common/estimation/chi_square.h"
#include "common/estimation/student_t.h"
#include "processes/refiner/refinement_problem.h"

namespace bodyschema {
namespace {

/// Least and largest deviation of plays, as shares of what the search begins with; chosen.
constexpr double kLeastPlay = 0.01, kMostPlay = 100;
/// Of residuals that are bounded in the score; chosen.
constexpr double kWildProbability = 1e-3;
/// Of a moving root's pose beforehand [1/m², 1/rad²].
constexpr double kPoseInformation = 1 / (kInstantPrior * kInstantPrior);

Eigen::LLT<Eigen::MatrixXd> factorized(const Eigen::MatrixXd& information) {
  Eigen::LLT<Eigen::MatrixXd> llt(information);
  if (llt.info() != Eigen::Success)
    throw std::runtime_error("the refined model has an instant whose information is not positive");
  return llt;
}

}  // namespace

std::vector<ParameterBlock*> RefinementProblem::used_instants() {
  std::vector<ParameterBlock*> result = blocks();
  std::erase_if(result, [](const ParameterBlock* block) {
    return block->kind != ParameterBlock::Kind::kInstant;
  });
  return result;
}

Eigen::Map<const Eigen::ArrayXd> RefinementProblem::plays_at(const ParameterBlock& instant) {
  const auto num = std::ssize(plays_);
  return {memory_of(&instant) + std::ssize(instant.values) - num, num};
}

std::map<std::int64_t, Eigen::VectorXd> RefinementProblem::plays_by_sample() const {
  std::map<std::int64_t, Eigen::VectorXd> result;
  if (plays_.empty()) return result;
  for (const auto& [index, block] : instants_)
    if (used_.contains(block))
      result[index] =
          Eigen::Map<const Eigen::VectorXd>(block->values.data(), std::ssize(block->values))
              .tail(std::ssize(plays_));
  return result;
}

double RefinementProblem::curvature_share() {
  const std::vector<double> d2 = squared_distances();
  double curvature = 0, weights = 0;
  for (std::size_t n = 0; n < d2.size(); ++n) {
    const int num = data_[n].num_residuals;
    const double w = robust_weight(d2[n], num);
    curvature += w * num - 2 * w * d2[n] / (kStudentNu + d2[n]);
    weights += w * num;
  }
  return curvature / weights;
}

std::vector<Eigen::MatrixXd> RefinementProblem::information_of_instants() {
  const std::vector<ParameterBlock*> instants = used_instants();
  if (instants.empty()) return {};
  ceres::Problem::EvaluateOptions options;
  for (const ParameterBlock* block : instants) options.parameter_blocks.push_back(memory_of(block));
  ceres::CRSMatrix J;  // of all residuals, also the priors', with the loss's weights
  evaluate(options, nullptr, nullptr, &J);
  const int size = instants.front()->num_free();
  std::vector<Eigen::MatrixXd> result(instants.size(), Eigen::MatrixXd::Zero(size, size));
  for (int row = 0; row < J.num_rows; ++row) {
    const int begin = J.rows[row], end = J.rows[row + 1];
    if (begin == end) continue;
    const Eigen::Map<const Eigen::VectorXd> t(&J.values[begin], end - begin);
    result[J.cols[begin] / size] += t * t.transpose();
  }
  // The curvature of Student's t is less than that of its weights.
  const double alpha = curvature_share();
  Eigen::VectorXd prior = Eigen::VectorXd::Constant(size, kPoseInformation);
  if (!plays_.empty()) prior.tail(std::ssize(plays_)) = play_sd_.array().square().inverse();
  for (Eigen::MatrixXd& information : result) {
    if (!plays_.empty())
      information.diagonal().tail(std::ssize(plays_)) -= prior.tail(std::ssize(plays_));
    information *= alpha;
    information.diagonal() += prior;
  }
  return result;
}

Eigen::ArrayXd RefinementProblem::determined_plays() {
  const auto num = std::ssize(plays_);
  Eigen::ArrayXd result = Eigen::ArrayXd::Zero(num);
  for (const Eigen::MatrixXd& information : information_of_instants()) {
    const Eigen::MatrixXd covariance =
        factorized(information)
            .solve(Eigen::MatrixXd::Identity(information.rows(), information.cols()));
    result += 1 - covariance.diagonal().tail(num).array() / play_sd_.array().square();
  }
  return result;
}

// Evidence (MacKay 1992): the sum of squares of a joint's plays over the number of them that the
// data determine. Returns the largest change, a share.
double RefinementProblem::estimate_play() {
  if (plays_.empty()) return 0;
  Eigen::ArrayXd squares = Eigen::ArrayXd::Zero(std::ssize(plays_));
  for (const ParameterBlock* block : used_instants()) squares += plays_at(*block).square();
  Eigen::ArrayXd next = (squares / determined_plays().max(1e-6))
                            .sqrt()
                            .max(kLeastPlay * play_start_.array())
                            .min(kMostPlay * play_start_.array());
  for (std::size_t n = 0; n < plays_.size(); ++n)
    if (is_exact_[n]) next(static_cast<Eigen::Index>(n)) = play_sd_(static_cast<Eigen::Index>(n));
  const double change = (next / play_sd_.array()).log().abs().maxCoeff();
  play_sd_ = next;
  return change;
}

double RefinementProblem::log_marginal_likelihood() {
  double sum = log_likelihood();
  for (const ParameterBlock* block : used_instants())
    sum -= 0.5 * (plays_at(*block) / play_sd_.array()).square().sum();
  for (const Eigen::MatrixXd& information : information_of_instants()) {
    const Eigen::MatrixXd L = factorized(information).matrixL();
    sum -= L.diagonal().array().log().sum() + play_sd_.array().log().sum();
  }
  return sum;
}

// By the ratio of Savage and Dickey: of the densities at 0 after the data and before.
Eigen::ArrayXd RefinementProblem::play_evidence() {
  const auto num = std::ssize(plays_);
  Eigen::ArrayXd result = Eigen::ArrayXd::Zero(num);
  const std::vector<ParameterBlock*> instants = used_instants();
  const std::vector<Eigen::MatrixXd> all = information_of_instants();
  for (std::size_t n = 0; n < all.size(); ++n) {
    const Eigen::MatrixXd covariance =
        factorized(all[n]).solve(Eigen::MatrixXd::Identity(all[n].rows(), all[n].cols()));
    const Eigen::ArrayXd variance = covariance.diagonal().tail(num);
    result += 0.5 * ((variance / play_sd_.array().square()).log() +
                     plays_at(*instants[n]).square() / variance);
  }
  return result;
}

bool RefinementProblem::drop_plays(double least_evidence) {
  const Eigen::ArrayXd evidence = play_evidence();
  std::vector<Eigen::Index> idle;
  for (Eigen::Index n = 0; n < evidence.size(); ++n)
    if (!is_exact_[static_cast<std::size_t>(n)] && evidence(n) < least_evidence) idle.push_back(n);
  std::ranges::sort(idle, {}, [&](Eigen::Index n) { return evidence(n); });
  idle.resize((idle.size() + 1) / 2);
  for (const Eigen::Index n : idle) {
    is_exact_[static_cast<std::size_t>(n)] = true;
    play_sd_(n) = kLeastPlay * play_start_(n);
    for (const ParameterBlock* block : used_instants())
      memory_of(block)[std::ssize(block->values) - std::ssize(plays_) + n] = 0;
  }
  return !idle.empty();
}

Eigen::VectorXd RefinementProblem::shown_play_sd() const {
  Eigen::VectorXd result = play_sd_;
  for (Eigen::Index n = 0; n < result.size(); ++n)
    if (play_sd_(n) <= kLeastPlay * play_start_(n)) result(n) = 0;
  return result;
}

// The derivative of the log marginal likelihood by the variance of a joint's plays at 0, over its
// deviation: ½ Σ g² − s over the instants, g the gradient by the play and s its information, both
// given what a moving root's pose makes of them. Of Gaussian noise, wild residuals bounded (Huber
// 1964): by Student's weights what is far off its command would count less than what is not.
double RefinementProblem::play_score() {
  ceres::Problem::EvaluateOptions options;
  options.apply_loss_function = false;
  const std::vector<ParameterBlock*> instants = used_instants();
  for (const ParameterBlock* block : instants) options.parameter_blocks.push_back(memory_of(block));
  for (const Datum& datum : data_) options.residual_blocks.push_back(datum.id);
  const double scale = std::exchange(scale_.value, 1.0);
  std::vector<double> residuals;
  ceres::CRSMatrix J;
  evaluate(options, &residuals, nullptr, &J);
  scale_.value = scale;
  const int size = instants.front()->num_free();
  const auto num = std::ssize(plays_), num_others = size - num;
  std::vector<Eigen::MatrixXd> A(instants.size(), Eigen::MatrixXd::Zero(size, size));
  std::vector<Eigen::VectorXd> g(instants.size(), Eigen::VectorXd::Zero(size));
  int row = 0;
  for (const Datum& datum : data_) {
    const Eigen::Map<const Eigen::VectorXd> r(&residuals[row], datum.num_residuals);
    const double most = chi_square_quantile(datum.num_residuals, kWildProbability);
    const double w = std::min(1.0, std::sqrt(most / r.squaredNorm()));
    for (const int end = row + datum.num_residuals; row < end; ++row) {
      const int begin = J.rows[row];
      const Eigen::Map<const Eigen::VectorXd> t(&J.values[begin], J.rows[row + 1] - begin);
      A[J.cols[begin] / size] += t * t.transpose();
      g[J.cols[begin] / size] += w * residuals[row] * t;
    }
  }
  Eigen::ArrayXd score = Eigen::ArrayXd::Zero(num), variance = score;
  for (std::size_t n = 0; n < instants.size(); ++n) {
    Eigen::ArrayXd gradient = g[n].tail(num), information = A[n].diagonal().tail(num);
    if (num_others > 0) {
      Eigen::MatrixXd of_pose = A[n].topLeftCorner(num_others, num_others);
      of_pose.diagonal().array() += kPoseInformation;
      const Eigen::MatrixXd mixed = A[n].topRightCorner(num_others, num);
      const Eigen::MatrixXd effect = factorized(of_pose).solve(mixed);
      gradient -= (effect.transpose() * g[n].head(num_others)).array();
      information -= mixed.cwiseProduct(effect).colwise().sum().transpose().array();
    }
    score += 0.5 * (gradient.square() - information);
    variance += 0.5 * information.square();
  }
  double best = -std::numeric_limits<double>::infinity();
  for (Eigen::Index n = 0; n < num; ++n)
    if (variance(n) > 0) best = std::max(best, score(n) / std::sqrt(variance(n)));
  return best;
}

}  // namespace bodyschema
