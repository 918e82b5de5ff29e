// How RefinementProblem is solved.

#include <ceres/solver.h>
#include <glog/logging.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <stdexcept>

#include "common/estimation/chi_square.h"
#include "common/estimation/quantile.h"
#include "common/estimation/student_t.h"
#include "common/kinematics/screw_chain.h"
#include "processes/refiner/refinement_problem.h"

namespace bodyschema {
namespace {

// Of an edge's tangent: of the axis or the gain of its d-th joint.
bool moves_joint(int direction, int d) {
  return direction >= ScrewChainLayout::transform(d) && direction <= ScrewChainLayout::turn(d);
}

}  // namespace

// Maximum likelihood of the scale given the residuals, by the fixed point of its own weights.
double RefinementProblem::estimated_scale() {
  const std::vector<double> d2 = squared_distances();
  double ratio = 1;  // of the squares, to the scale that they are whitened with
  const double num = num_residuals();
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

void RefinementProblem::begin_at(RefinementProblem& other) {
  const auto copy = [&](const ParameterBlock* from, const ParameterBlock* to) {
    if (from && to && other.used_.contains(from) && used_.contains(to))
      std::copy_n(other.memory_of(from), std::min(from->values.size(), to->values.size()),
                  memory_of(to));
  };
  const auto copy_all = [&](const auto& from, const auto& to) {
    for (const auto& [id, block] : to)
      if (const auto same = from.find(id); same != from.end()) copy(same->second, block);
  };
  copy(other.root_, root_);
  // Where one problem alone has plays, they come after the pose.
  if (root_moves_ || plays_.size() == other.plays_.size()) copy_all(other.instants_, instants_);
  copy_all(other.edges_, edges_);
  copy_all(other.tags_, tags_);
  copy(other.lens_block_, lens_block_);
  if (drive_ && other.drive_)
    drive_model_.copy_weights(other.drive_model_, other.memory_of(other.drive_), memory_of(drive_));
  scale_ = other.scale_;
  if (plays_.size() == other.plays_.size()) play_sd_ = other.play_sd_;
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
  return block.kind == ParameterBlock::Kind::kEdge &&
         std::ranges::any_of(joints_at_rest_, [&](const Joint& joint) {
           return joint.edge == block.id && moves_joint(direction, joint.joint);
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
    std::vector<int> free = block->free;
    for (int d = 0; used_.contains(block) && d < std::ssize(edge.joints); ++d)
      if (rests(edge, edge.joints[d].signal) &&
          std::erase_if(free, [&](int direction) { return moves_joint(direction, d); }) > 0)
        joints_at_rest_.push_back({index, d});
    if (free == block->free) continue;
    free_before[block] = block->free;
    set_free(block, free);
  }
  return free_before;
}

void RefinementProblem::solve() {
  // A step for which Cholesky fails is tried again with more damping; glog would tell the user.
  static const auto log_level = FLAGS_minloglevel = google::GLOG_ERROR;
  static_cast<void>(log_level);
  const auto free_before = hold_joints_at_rest();
  ceres::Solver::Options options = solver_options();
  const auto run = [&](double tolerance, int max_iterations) {
    options.function_tolerance = tolerance;
    options.max_num_iterations = max_iterations;
    ceres::Solver::Summary summary;
    ceres::Solve(options, &problem_, &summary);
    num_iterations_ += static_cast<int>(summary.iterations.size());
    if (!summary.IsSolutionUsable()) throw std::runtime_error("the fit failed: " + summary.message);
    return summary.termination_type == ceres::CONVERGENCE;
  };
  // Far from the minimum all residuals are large: with the scale that they have none is an outlier.
  std::vector<double> shares;
  const std::vector<double> start = squared_distances();
  for (std::size_t n = 0; n < start.size(); ++n)
    shares.push_back(start[n] / chi_square_median(data_[n].num_residuals));
  scale_.value = std::max(1.0, std::sqrt(median(shares)));
  // Chosen: scale and plays are estimates from few residuals, known to no more than these shares.
  constexpr double kSettledScale = 0.01;
  const double settled_play = rig_ ? 0.2 : 0.05;  // poses are compared by it
  constexpr int kMaxRounds = 40;
  bool is_settled = false;
  for (int round = 0; round < kMaxRounds; ++round) {
    // In a long valley short runs go on without an end, and scale and plays seem to be settled.
    const bool is_last = is_settled;
    run(is_last ? 1e-9 : 1e-5, is_last ? 200 : 10);
    const double scale = std::max(1.0, estimated_scale());
    const double change = std::abs(scale / scale_.value - 1);
    scale_.value = scale;
    const double change_of_play = estimate_play();
    is_settled = change < kSettledScale && change_of_play < settled_play;
    if (is_last && is_settled) break;
  }
  has_converged_ = run(1e-9, 200) && is_settled;
  num_determined_plays_ = plays_.empty() ? 0 : determined_plays().sum();
  for (const auto& [block, directions] : free_before) set_free(block, directions);
  for (ParameterBlock* block : blocks())
    std::copy_n(memory_of(block), block->values.size(), block->values.begin());
}

}  // namespace bodyschema
