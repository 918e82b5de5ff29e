// How RefinementProblem is solved.

#include <ceres/crs_matrix.h>
#include <ceres/solver.h>
#include <glog/logging.h>

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <stdexcept>
#include <utility>

#include "common/estimation/chi_square.h"
#include "common/estimation/quantile.h"
#include "common/estimation/student_t.h"
#include "common/kinematics/screw_chain.h"
#include "processes/refiner/refinement_problem.h"

namespace bodyschema {

// Maximum likelihood of the scale given the residuals, by the fixed point of its own weights.
double RefinementProblem::estimated_scale() {
  const std::vector<double> d2 = squared_distances();
  double ratio = 1;  // of the squares, to the scale that they are whitened with
  double num = 0;
  for (const Datum& datum : data_) num += datum.num_residuals;
  for (int iteration = 0; iteration < 100; ++iteration) {
    double sum = 0;
    for (std::size_t n = 0; n < d2.size(); ++n)
      sum += robust_weight(d2[n] / ratio, data_[n].num_residuals) * d2[n];
    const double next = std::max(sum / num, 1e-30);
    const bool is_done = std::abs(next / ratio - 1) < 1e-9;
    ratio = next;
    if (is_done) break;
  }
  return scale_.value * std::sqrt(ratio);
}

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

std::vector<Eigen::MatrixXd> RefinementProblem::information_of_instants() {
  const std::vector<ParameterBlock*> instants = used_instants();
  const int size = instants.front()->num_free();
  ceres::Problem::EvaluateOptions options;
  options.num_threads = 1;
  for (const ParameterBlock* block : instants) options.parameter_blocks.push_back(memory_of(block));
  ceres::CRSMatrix J;  // of all residuals, also the priors', with the loss's weights
  if (!problem_.Evaluate(options, nullptr, nullptr, nullptr, &J))
    throw std::runtime_error("the refined model cannot be evaluated");
  std::vector<Eigen::MatrixXd> information(instants.size(), Eigen::MatrixXd::Zero(size, size));
  for (int row = 0; row < J.num_rows; ++row) {
    const int begin = J.rows[row], end = J.rows[row + 1];
    if (begin == end) continue;
    const Eigen::Map<const Eigen::VectorXd> values(&J.values[begin], end - begin);
    information[J.cols[begin] / size] += values * values.transpose();
  }
  return information;
}

// Evidence (MacKay 1992): the sum of squares of a joint's plays over the number of them that the
// data determine. Returns the largest change, a share.
double RefinementProblem::estimate_play() {
  if (plays_.empty()) return 0;
  const auto num = std::ssize(plays_);
  Eigen::ArrayXd squares = Eigen::ArrayXd::Zero(num), determined = Eigen::ArrayXd::Zero(num);
  for (const Eigen::MatrixXd& information : information_of_instants()) {
    const Eigen::MatrixXd covariance =
        information.llt().solve(Eigen::MatrixXd::Identity(information.rows(), information.cols()));
    determined += 1 - covariance.diagonal().tail(num).array() / play_sd_.array().square();
  }
  for (const ParameterBlock* block : used_instants()) squares += plays_at(*block).square();
  const Eigen::ArrayXd next = (squares / determined.max(1e-6))
                                  .sqrt()
                                  .max(kLeastPlay * play_start_.array())
                                  .min(play_start_.array() / kLeastPlay);
  num_determined_plays_ = determined.sum();
  const double change = (next / play_sd_.array()).log().abs().maxCoeff();
  play_sd_ = next;
  return change;
}

Eigen::VectorXd RefinementProblem::shown_play_sd() const {
  return (play_sd_.array() > 2 * kLeastPlay * play_start_.array()).select(play_sd_, 0);
}

// ½ log |2πC| of each instant's plays, of a moving root's pose less that without plays.
double RefinementProblem::log_likelihood_without_plays() {
  double sum = log_likelihood();
  if (plays_.empty()) return sum;
  const auto num = std::ssize(plays_);
  for (const ParameterBlock* block : used_instants())
    sum -= 0.5 * (plays_at(*block) / play_sd_.array()).square().sum();
  const auto log_determinant = [](const Eigen::MatrixXd& matrix) {
    return 2 * matrix.llt().matrixL().toDenseMatrix().diagonal().array().log().sum();
  };
  for (const Eigen::MatrixXd& information : information_of_instants()) {
    const auto num_others = information.rows() - num;
    sum -= 0.5 * log_determinant(information) + play_sd_.array().log().sum();
    if (num_others > 0)
      sum += 0.5 * log_determinant(information.topLeftCorner(num_others, num_others));
  }
  return sum;
}

void RefinementProblem::begin_at(RefinementProblem& other) {
  std::vector<ParameterBlock*> from = other.blocks();
  std::erase(from, other.drive_);
  const auto is_of_plays = [](const RefinementProblem& problem, const ParameterBlock* block) {
    return block->kind == ParameterBlock::Kind::kInstant && !problem.root_moves_;
  };
  std::erase_if(from, [&](const ParameterBlock* block) { return is_of_plays(other, block); });
  auto next = from.begin();
  for (ParameterBlock* block : blocks()) {
    if (is_of_plays(*this, block)) continue;
    if (block != drive_) {
      const ParameterBlock* same = *next++;
      std::copy_n(other.memory_of(same), std::min(same->values.size(), block->values.size()),
                  memory_of(block));
    } else if (other.drive_) {
      drive_model_.copy_weights(other.drive_model_, other.memory_of(other.drive_),
                                memory_of(drive_));
    }
  }
  scale_ = other.scale_;
  if (play_sd_.size() == other.play_sd_.size()) play_sd_ = other.play_sd_;
}

// The derivative of the log likelihood, integrated over the plays, by each joint's variance of
// them at 0, over its deviation: ½ Σ (tᵀr)² − tᵀt over the samples, t by a play, r with weights.
double RefinementProblem::play_score() {
  ceres::Problem::EvaluateOptions options;
  options.apply_loss_function = false;
  options.num_threads = 1;
  const std::vector<ParameterBlock*> instants = used_instants();
  for (const ParameterBlock* block : instants) options.parameter_blocks.push_back(memory_of(block));
  for (const Datum& datum : data_) options.residual_blocks.push_back(datum.id);
  const double scale = std::exchange(scale_.value, 1.0);
  std::vector<double> residuals;
  ceres::CRSMatrix J;
  if (!problem_.Evaluate(options, nullptr, &residuals, nullptr, &J))
    throw std::runtime_error("the refined model cannot be evaluated");
  scale_.value = scale;
  const auto num = std::ssize(plays_);
  const int size = instants.front()->num_free();
  Eigen::MatrixXd gradient = Eigen::MatrixXd::Zero(num, std::ssize(instants)), square = gradient;
  int row = 0;
  for (const Datum& datum : data_) {
    const Eigen::Map<const Eigen::VectorXd> r(&residuals[row], datum.num_residuals);
    const double w = robust_weight(r.squaredNorm(), datum.num_residuals);
    for (const int end = row + datum.num_residuals; row < end; ++row)
      for (int n = J.rows[row]; n < J.rows[row + 1]; ++n) {
        const Eigen::Index play = J.cols[n] % size - (size - num);
        if (play < 0) continue;
        gradient(play, J.cols[n] / size) += w * J.values[n] * residuals[row];
        square(play, J.cols[n] / size) += w * J.values[n] * J.values[n];
      }
  }
  double best = -std::numeric_limits<double>::infinity();
  for (Eigen::Index play = 0; play < num; ++play) {
    const double deviation = std::sqrt(2 * square.row(play).squaredNorm());
    const double score = gradient.row(play).squaredNorm() - square.row(play).sum();
    if (deviation > 0) best = std::max(best, score / deviation);
  }
  return best;
}

ceres::Solver::Options RefinementProblem::solver_options() {
  ceres::Solver::Options options;
  options.logging_type = ceres::SILENT;
  options.num_threads = 1;
  options.gradient_tolerance = 1e-12;
  options.parameter_tolerance = 1e-12;
  // Each residual has one instant and one tag: either can be eliminated.
  const auto eliminated =
      instants_.empty() ? ParameterBlock::Kind::kTag : ParameterBlock::Kind::kInstant;
  options.linear_solver_type = ceres::SPARSE_NORMAL_CHOLESKY;
  options.linear_solver_ordering = std::make_shared<ceres::ParameterBlockOrdering>();
  for (ParameterBlock* block : blocks()) {
    options.linear_solver_ordering->AddElementToGroup(memory_of(block),
                                                      block->kind == eliminated ? 0 : 1);
    if (block->kind == eliminated && block->is_refined)
      options.linear_solver_type = ceres::DENSE_SCHUR;
  }
  return options;
}

bool RefinementProblem::rests(const Edge& edge, int signal) const {
  // Chosen: over less of its range noise says how far a joint goes.
  constexpr double kRestingShare = 1e-3;
  double least = std::numeric_limits<double>::infinity(), most = -least;
  for (const Datum& datum : data_) {
    const std::vector<const Edge*>& path = paths_.at(datum.part);
    if (std::ranges::find(path, &edge) == path.end()) continue;
    const double command = actions_.at(datum.sample_index)(signal);
    least = std::min(least, command);
    most = std::max(most, command);
  }
  const Signal& limits = schema_.signals[signal];
  return most - least <= kRestingShare * (limits.upper - limits.lower);
}

bool RefinementProblem::is_at_rest(const ParameterBlock& block, int direction) const {
  if (block.kind != ParameterBlock::Kind::kEdge) return false;
  return std::ranges::any_of(joints_at_rest_, [&](const Joint& joint) {
    return joint.edge == &schema_.edges[block.id] &&
           direction >= ScrewChainLayout::transform(joint.d) &&
           direction <= ScrewChainLayout::turn(joint.d);
  });
}

int RefinementProblem::num_fitted(const ParameterBlock& block) const {
  return static_cast<int>(std::ranges::count_if(
      block.free, [&](int direction) { return !is_at_rest(block, direction); }));
}

void RefinementProblem::set_free(ParameterBlock* block, const std::vector<int>& directions) {
  double* const memory = memory_of(block);
  block->free = directions;
  problem_.SetManifold(memory, &manifolds_.emplace_back(*block));
  if (directions.empty())
    problem_.SetParameterBlockConstant(memory);
  else
    problem_.SetParameterBlockVariable(memory);
}

// Nothing tells the axis and the gain of a joint at rest from what follows it, which is enough.
std::map<ParameterBlock*, std::vector<int>> RefinementProblem::hold_joints_at_rest() {
  std::map<ParameterBlock*, std::vector<int>> free_before;
  joints_at_rest_.clear();
  if (options_.joint_loads) return free_before;  // which move joints at rest
  for (const auto& [index, block] : edges_) {
    const Edge& edge = schema_.edges[index];
    for (int d = 0; used_.contains(block) && d < std::ssize(edge.joints); ++d)
      if (rests(edge, edge.joints[d].signal)) joints_at_rest_.push_back({&edge, d});
    std::vector<int> free = block->free;
    std::erase_if(free, [&](int direction) { return is_at_rest(*block, direction); });
    if (free == block->free) continue;
    free_before[block] = block->free;
    set_free(block, free);
  }
  return free_before;
}

void RefinementProblem::solve() {
  // A step for which Cholesky fails is tried again with more damping; glog would tell the user.
  FLAGS_minloglevel = google::GLOG_ERROR;
  const auto free_before = hold_joints_at_rest();
  ceres::Solver::Options options = solver_options();
  const auto run = [&](double tolerance, int max_iterations) {
    options.function_tolerance = tolerance;
    options.max_num_iterations = max_iterations;
    ceres::Solver::Summary summary;
    ceres::Solve(options, &problem_, &summary);
    num_iterations_ += static_cast<int>(summary.iterations.size());
    if (!summary.IsSolutionUsable()) throw std::runtime_error("the fit failed: " + summary.message);
  };
  // Far from the minimum all residuals are large: with the scale that they have none is an outlier.
  std::vector<double> shares;
  const std::vector<double> start = squared_distances();
  for (std::size_t n = 0; n < start.size(); ++n)
    shares.push_back(start[n] / chi_square_median(data_[n].num_residuals));
  scale_.value = std::max(1.0, std::sqrt(median(shares)));
  // Chosen: scale and plays are estimates from few residuals, known to no more than these shares.
  constexpr double kSettledScale = 0.01, kSettledPlay = 0.2;
  constexpr int kMaxRounds = 20;
  for (int round = 0; round < kMaxRounds; ++round) {
    run(1e-5, 10);
    const double scale = std::max(1.0, estimated_scale());
    const double change = std::abs(scale / scale_.value - 1);
    scale_.value = scale;
    const double change_of_play = estimate_play();
    if (change < kSettledScale && change_of_play < kSettledPlay) break;
  }
  run(1e-9, 200);
  for (const auto& [block, directions] : free_before) set_free(block, directions);
  for (ParameterBlock* block : blocks())
    std::copy_n(memory_of(block), block->values.size(), block->values.begin());
}

}  // namespace bodyschema
