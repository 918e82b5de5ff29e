#include "processes/refiner/expected_information.h"

#include <cmath>

namespace bodyschema {
namespace {

using Kind = ParameterBlock::Kind;
using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

constexpr double kLeastProbability = 0.01;

/// Blocks' derivatives of one residual, free directions alone.
struct Derivative {
  std::vector<RowMajor> J;
  int num_rows = 0;
};

std::optional<Derivative> derivative_of(const RefinementProblem::Cost& cost,
                                        RefinementProblem& problem) {
  Derivative result;
  result.num_rows = cost.function->num_residuals();
  std::vector<const double*> values;
  std::vector<double*> jacobians;
  for (const ParameterBlock* block : cost.blocks) {
    values.push_back(problem.memory_of(block));
    result.J.emplace_back(result.num_rows, std::ssize(block->values));
  }
  for (std::size_t b = 0; b < cost.blocks.size(); ++b) {
    const bool is_wanted = cost.blocks[b]->is_refined && !cost.blocks[b]->free.empty();
    jacobians.push_back(is_wanted ? result.J[b].data() : nullptr);
  }
  VectorXd residuals(result.num_rows);
  if (!cost.function->Evaluate(values.data(), residuals.data(), jacobians.data()))
    return std::nullopt;
  return result;
}

}  // namespace

InformationLayout::InformationLayout(RefinementProblem& problem, const Information& information)
    : units(information.curvature().rows()) {
  const std::vector<int> frame_tags = problem.frame_tags();
  std::vector<double> weak;
  for (const ParameterBlock* block : information.blocks()) {
    const VectorXd prior_sd = problem.prior_of(*block);
    std::vector<Index>& at = places[block];
    Index row = information.offset(block);
    for (const int direction : block->free) {
      units(row) = prior_sd.size() > 0 ? prior_sd(direction) : problem.weak_sd(*block, direction);
      if (is_frame(frame_tags, *block, direction)) {
        at.push_back(-1);
      } else if (block->kind == Kind::kTag) {
        at.push_back(std::ssize(tags));
        tags.push_back(row);
      } else {
        at.push_back(std::ssize(core));
        core.push_back(row);
        weak.push_back(problem.prior_information(*block, direction) > 0 ? 0 : 1);
      }
      ++row;
    }
  }
  prior = Eigen::Map<const VectorXd>(weak.data(), std::ssize(weak));
}

struct Forecast::Row {
  RefinementProblem::Cost cost;
  Derivative derivative;
  double weight = 0;  // of the square
};

Expectation Forecast::at(const VectorXd& action) const {
  Rows rows;
  const std::int64_t index = sights_.sample_index();
  if (has_corners_) {
    for (const auto& [sight, probability] : sights_.tags(action))
      add(problem_.cost_of(sight, action, index), probability, &rows);
  } else {
    for (const auto& [observation, probability] : sights_.parts(action))
      add(problem_.cost_of(observation, action, index), probability, &rows);
  }
  return assembled(rows);
}

Expectation Forecast::of(const RefinerSample& seen) const {
  Rows rows;
  const VectorXd& action = seen.sample.action;
  const std::int64_t index = sights_.sample_index();
  if (has_corners_) {
    for (const TagSight& sight : seen.tags) add(problem_.cost_of(sight, action, index), 1, &rows);
    return assembled(rows);
  }
  const std::map<int, Pose> X_CB = sights_.poses(action);
  for (PartObservation observation : seen.sample.parts) {
    const auto predicted = X_CB.find(observation.part);
    if (predicted == X_CB.end()) continue;
    observation.X_CB_other.reset();
    observation.X_CB = predicted->second;
    add(problem_.cost_of(observation, action, index), 1, &rows);
  }
  return assembled(rows);
}

void Forecast::add(std::optional<RefinementProblem::Cost> cost, double probability,
                   Rows* rows) const {
  if (!cost || probability < kLeastProbability) return;
  auto derivative = derivative_of(*cost, problem_);
  if (derivative) rows->push_back({std::move(*cost), std::move(*derivative), worth_ * probability});
}

Expectation Forecast::assembled(const Rows& rows) const {
  Index num_rows = 0;
  for (const Row& row : rows) num_rows += row.derivative.num_rows;
  Expectation result;
  result.core = MatrixXd::Zero(num_rows, std::ssize(layout_.core));
  MatrixXd instant;
  Index first = 0;
  for (const Row& row : rows) {
    const double weight = std::sqrt(row.weight);
    for (std::size_t b = 0; b < row.cost.blocks.size(); ++b) {
      const ParameterBlock* block = row.cost.blocks[b];
      const Eigen::MatrixXd J = weight * row.derivative.J[b].leftCols(block->num_free());
      if (block->kind == Kind::kInstant) {
        if (instant.size() == 0) instant = MatrixXd::Zero(num_rows, J.cols());
        instant.middleRows(first, J.rows()) = J * instant_sd(J.cols()).asDiagonal();
      } else if (const auto places = layout_.places.find(block); places != layout_.places.end()) {
        place(J, *block, places->second, first, &result);
      }
    }
    first += row.derivative.num_rows;
  }
  result.noise = MatrixXd::Identity(num_rows, num_rows);
  result.has_instant = instant.size() > 0;
  if (result.has_instant) result.noise += instant * instant.transpose();
  return result;
}

void Forecast::place(const MatrixXd& J, const ParameterBlock& block,
                     const std::vector<Index>& places, Index first, Expectation* result) const {
  const bool is_tag = block.kind == Kind::kTag;
  Expectation::TagRows tag{first, -1, MatrixXd(J.rows(), 0)};
  for (Index n = 0; n < J.cols(); ++n) {
    const Index at = places[static_cast<std::size_t>(n)];
    if (at < 0) continue;
    const double unit = layout_.units((is_tag ? layout_.tags : layout_.core)[at]);
    if (!is_tag) {
      result->core.col(at).segment(first, J.rows()) = unit * J.col(n);
      continue;
    }
    if (tag.column < 0) tag.column = at;
    tag.J.conservativeResize(Eigen::NoChange, tag.J.cols() + 1);
    tag.J.rightCols<1>() = unit * J.col(n);
  }
  if (tag.column >= 0) result->tags.push_back(std::move(tag));
}

// Prior deviations of an instant's block: a moving root's pose, then the plays.
VectorXd Forecast::instant_sd(Index size) const {
  VectorXd sd = VectorXd::Constant(size, kInstantPrior);
  sd.tail(problem_.play_sd().size()) = problem_.play_sd();
  return sd;
}

}  // namespace bodyschema
