#include "processes/refiner/refinement_problem.h"

#include <ceres/solver.h>
#include <glog/logging.h>

#include <algorithm>
#include <cmath>
#include <memory>
#include <stdexcept>

#include "common/estimation/chi_square.h"
#include "common/estimation/quantile.h"
#include "common/estimation/student_t.h"
#include "common/kinematics/kinematic_tree.h"
#include "processes/refiner/calibrated_lens.h"

namespace bodyschema {
namespace {

ceres::Problem::Options problem_options() {
  ceres::Problem::Options options;
  options.loss_function_ownership = ceres::DO_NOT_TAKE_OWNERSHIP;
  options.manifold_ownership = ceres::DO_NOT_TAKE_OWNERSHIP;
  return options;
}

}  // namespace

RefinementProblem::RefinementProblem(const BodySchema& schema,
                                     const std::vector<RefinerSample>& samples,
                                     const std::optional<RigCalibration>& rig,
                                     const RefineOptions& options, bool root_moves)
    : schema_(schema),
      rig_(rig),
      options_(options),
      root_moves_(root_moves),
      problem_(problem_options()) {
  add_paths();
  add_roots(samples);
  if (rig_) {
    add_tags(samples);
    add_lens();
  }
  place_blocks();
  for (const RefinerSample& sample : samples) rig_ ? add_corners(sample) : add_poses(sample);
  if (data_.empty())
    throw std::invalid_argument(
        rig_ ? "no sample shows a tag of the rig on a part of the schema"
             : "no sample shows a part that the schema connects to its root");
  hold_unseen_frames();
  for (ParameterBlock* block : blocks())
    problem_.SetManifold(memory_of(block), &manifolds_.emplace_back(*block));
  add_priors();
  for (ParameterBlock* block : blocks())
    if (!block->is_refined) problem_.SetParameterBlockConstant(memory_of(block));
}

// The frame of a part that was never seen is anywhere: it stays where it is.
void RefinementProblem::hold_unseen_frames() {
  std::set<int> seen;
  for (const Datum& datum : data_) seen.insert(datum.part);
  const auto hold = [&](ParameterBlock* block, int first, int part) {
    if (seen.contains(part) || !used_.contains(block)) return;
    std::erase_if(block->free, [&](int direction) { return direction >= first; });
    unseen_parts_.push_back(part);
    if (!block->free.empty()) return;
    problem_.SetParameterBlockConstant(memory_of(block));
    used_.erase(block);
  };
  if (!root_moves_) hold(roots_.at(-1), 0, schema_.root);
  for (const auto& [index, block] : edges_)
    hold(block, block->tangent_size() - 6, schema_.edges[index].to);
}

void RefinementProblem::place_blocks() {
  for (const ParameterBlock& block : storage_) {
    memory_offsets_[&block] = memory_.size();
    memory_.insert(memory_.end(), block.values.begin(), block.values.end());
  }
}

void RefinementProblem::add_paths() {
  const KinematicTree tree(schema_.edges, schema_.root);
  for (std::size_t node = 0; node < tree.nodes().size(); ++node) {
    std::vector<const Edge*>& path = paths_[tree.nodes()[node].part];
    for (const int below : tree.path_to(static_cast<int>(node))) {
      if (!tree.nodes()[below].is_forward)
        throw std::invalid_argument("an edge of the schema leads towards its root");
      path.push_back(&schema_.edges[tree.nodes()[below].edge]);
    }
  }
  for (std::size_t e = 0; e < schema_.edges.size(); ++e) {
    const Edge& edge = schema_.edges[e];
    if (!PartChain::has_block(edge)) continue;
    edges_[static_cast<int>(e)] = &storage_.emplace_back(
        edge_block(edge, static_cast<int>(e), !schema_.has_rotation(edge.to)));
  }
}

// Of a root that moves: where its parts say that it was.
void RefinementProblem::add_roots(const std::vector<RefinerSample>& samples) {
  const auto add_root = [&](std::int64_t index, const Pose& X_CR) {
    ParameterBlock& root = storage_.emplace_back();
    root.id = static_cast<int>(index);
    root.add(X_CR);
    root.free = {0, 1, 2, 3, 4, 5};
    roots_[index] = &root;
  };
  if (!root_moves_) return add_root(-1, schema_.X_CR);
  for (const RefinerSample& seen : samples) {
    const std::map<int, Pose> X_RB = schema_.predict_all(seen.sample.action);
    for (const PartObservation& observation : seen.sample.parts) {
      if (!observation.has_rotation || !X_RB.contains(observation.part)) continue;
      add_root(seen.sample.sample_index, observation.X_CB * X_RB.at(observation.part).inverse());
      break;
    }
  }
}

void RefinementProblem::add_tags(const std::vector<RefinerSample>& samples) {
  std::map<int, int> num_seen;
  for (const RefinerSample& sample : samples)
    for (const TagSight& sight : sample.tags) ++num_seen[sight.tag];
  for (const TagPlacement& tag : rig_->markers.tags)
    if (tag.part == schema_.root && num_seen[tag.id] > 0 &&
        (gauge_tag_ < 0 || num_seen[tag.id] > num_seen[gauge_tag_]))
      gauge_tag_ = tag.id;
  for (const TagPlacement& tag : rig_->markers.tags) {
    ParameterBlock& block = storage_.emplace_back();
    block.kind = ParameterBlock::Kind::kTag;
    block.id = tag.id;
    block.add(tag.X_BM.value_or(Pose::Identity()));
    block.add(1.0);
    // Without a placement the tag is the part's frame.
    if (tag.id == gauge_tag_ || !tag.X_BM)
      block.free = {6};
    else
      block.free = {0, 1, 2, 3, 4, 5, 6};
    block.is_refined = options_.placements;
    tags_[tag.id] = &block;
  }
}

void RefinementProblem::add_lens() {
  lens_ = lens_of(rig_->camera);
  lens_block_ = &storage_.emplace_back();
  lens_block_->kind = ParameterBlock::Kind::kLens;
  for (const double parameter : lens_->parameters()) {
    lens_block_->free.push_back(static_cast<int>(lens_block_->values.size()));
    lens_block_->add(parameter);
  }
  lens_block_->is_refined = options_.intrinsics;
}

bool RefinementProblem::is_usable(int part, std::int64_t sample_index) const {
  const auto path = paths_.find(part);
  return path != paths_.end() &&
         std::none_of(path->second.begin(), path->second.end(),
                      [&](const Edge* edge) { return sample_index < edge->valid_since_sample; });
}

std::vector<ParameterBlock*> RefinementProblem::chain_blocks(int part, std::int64_t sample_index) {
  std::vector<ParameterBlock*> blocks = {roots_.at(root_moves_ ? sample_index : -1)};
  for (const Edge* edge : paths_.at(part)) {
    const auto block = edges_.find(static_cast<int>(edge - schema_.edges.data()));
    if (block != edges_.end()) blocks.push_back(block->second);
  }
  return blocks;
}

void RefinementProblem::add(ceres::CostFunction* cost, const std::vector<ParameterBlock*>& blocks,
                            Datum datum) {
  std::vector<double*> values;
  for (ParameterBlock* block : blocks) {
    values.push_back(memory_of(block));
    used_.insert(block);
  }
  datum.num_residuals = cost->num_residuals();
  StudentTLoss& loss = datum.num_residuals == 8   ? loss_of_corners_
                       : datum.num_residuals == 6 ? loss_of_poses_
                                                  : loss_of_positions_;
  datum.id = problem_.AddResidualBlock(cost, &loss, values);
  data_.push_back(datum);
}

void RefinementProblem::add_corners(const RefinerSample& seen) {
  const std::int64_t index = seen.sample.sample_index;
  if (!has_root(index)) return;
  const Eigen::VectorXd theta = schema_.displacements(seen.sample.action);
  for (const TagSight& sight : seen.tags) {
    const TagPlacement* tag = rig_->markers.find(sight.tag);
    if (!tag || !is_usable(tag->part, index) || has_moved(schema_.moved_tags, sight.tag, index))
      continue;
    const std::vector<ParameterBlock*> chain = chain_blocks(tag->part, index);
    Matrix8d covariance = sight.covariance_px2;
    if (covariance.isZero(0)) {
      std::vector<Eigen::Vector2d> corners;
      for (int c = 0; c < 4; ++c) corners.emplace_back(sight.corners_px.segment<2>(2 * c));
      covariance = std::pow(options_.corner_noise.sigma_px(corners), 2) * Matrix8d::Identity();
    }
    std::vector<ParameterBlock*> blocks = chain;
    blocks.push_back(tags_.at(sight.tag));
    blocks.push_back(lens_block_);
    auto cost = std::make_unique<CornerResidual>(
        PartChain(paths_.at(tag->part), theta),
        std::vector<const ParameterBlock*>(blocks.begin(), blocks.end()), tag->size_m, *lens_,
        sight, covariance, scale_);
    // Predicted behind the camera: nothing to start from.
    std::vector<const double*> values;
    for (const ParameterBlock* block : blocks) values.push_back(block->values.data());
    Eigen::Matrix<double, 8, 1> residuals;
    if (!cost->Evaluate(values.data(), residuals.data(), nullptr)) continue;
    add(cost.release(), blocks, {.sample_index = index, .part = tag->part, .tag = sight.tag});
  }
}

void RefinementProblem::add_poses(const RefinerSample& seen) {
  const std::int64_t index = seen.sample.sample_index;
  if (!has_root(index)) return;
  const Eigen::VectorXd theta = schema_.displacements(seen.sample.action);
  for (const PartObservation& observation : seen.sample.parts) {
    if (!is_usable(observation.part, index)) continue;
    const std::vector<ParameterBlock*> blocks = chain_blocks(observation.part, index);
    const std::vector<const ParameterBlock*> constant(blocks.begin(), blocks.end());
    PartChain chain(paths_.at(observation.part), theta);
    ceres::CostFunction* cost = nullptr;
    if (observation.has_rotation && schema_.has_rotation(observation.part))
      cost =
          new PoseResidual(std::move(chain), constant, observation, options_.measurement, scale_);
    else
      cost = new PositionResidual(std::move(chain), constant, observation, options_.measurement,
                                  scale_);
    add(cost, blocks, {.sample_index = index, .part = observation.part});
  }
}

std::vector<ParameterBlock*> RefinementProblem::blocks() {
  std::vector<ParameterBlock*> result;
  const auto add_all = [&](const auto& blocks) {
    for (const auto& [id, block] : blocks)
      if (used_.contains(block)) result.push_back(block);
  };
  add_all(roots_);
  add_all(edges_);
  add_all(tags_);
  if (lens_block_) result.push_back(lens_block_);
  return result;
}

Eigen::VectorXd RefinementProblem::prior_of(const ParameterBlock& block) const {
  const RefinerConfig& config = options_.config;
  if (block.kind == ParameterBlock::Kind::kTag) {
    Eigen::VectorXd sd(7);
    sd << Eigen::Vector3d::Constant(config.tags.position_m),
        Eigen::Vector3d::Constant(config.tags.rotation_rad), config.tags.size_share;
    return sd;
  }
  if (block.kind != ParameterBlock::Kind::kLens) return {};
  Eigen::VectorXd sd =
      Eigen::VectorXd::Constant(static_cast<Eigen::Index>(block.values.size()), config.distortion);
  for (int axis = 0; axis < 2; ++axis) {
    sd(axis) = config.focal_length_share * block.start[axis];
    sd(2 + axis) = config.centre_px;
  }
  return sd;
}

void RefinementProblem::add_priors() {
  for (ParameterBlock* block : blocks()) {
    const Eigen::VectorXd sd = prior_of(*block);
    if (sd.size() == 0) continue;
    problem_.AddResidualBlock(new PriorResidual(*block, sd), nullptr, memory_of(block));
  }
}

std::vector<double> RefinementProblem::squared_distances() {
  ceres::Problem::EvaluateOptions options;
  options.apply_loss_function = false;
  options.num_threads = 1;
  for (const Datum& datum : data_) options.residual_blocks.push_back(datum.id);
  std::vector<double> residuals;
  if (!problem_.Evaluate(options, nullptr, &residuals, nullptr, nullptr))
    throw std::runtime_error("the refined model cannot be evaluated");
  std::vector<double> result;
  std::size_t row = 0;
  for (const Datum& datum : data_) {
    double sum = 0;
    for (int n = 0; n < datum.num_residuals; ++n, ++row) sum += residuals[row] * residuals[row];
    result.push_back(sum);
  }
  return result;
}

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

void RefinementProblem::solve() {
  // A step for which Cholesky fails is tried again with more damping; glog would tell the user.
  FLAGS_minloglevel = google::GLOG_ERROR;
  ceres::Solver::Options options;
  options.logging_type = ceres::SILENT;
  options.num_threads = 1;
  options.max_num_iterations = 50;
  options.function_tolerance = 1e-9;
  options.gradient_tolerance = 1e-12;
  options.parameter_tolerance = 1e-12;
  const bool eliminates_tags = options_.placements && rig_.has_value();
  options.linear_solver_type =
      root_moves_ || eliminates_tags ? ceres::DENSE_SCHUR : ceres::DENSE_NORMAL_CHOLESKY;
  if (options.linear_solver_type == ceres::DENSE_SCHUR) {
    // Each residual has one root and one tag: either can be eliminated.
    options.linear_solver_ordering = std::make_shared<ceres::ParameterBlockOrdering>();
    const auto eliminated = root_moves_ ? ParameterBlock::Kind::kRoot : ParameterBlock::Kind::kTag;
    for (ParameterBlock* block : blocks())
      options.linear_solver_ordering->AddElementToGroup(memory_of(block),
                                                        block->kind == eliminated ? 0 : 1);
  }
  // Far from the minimum all residuals are large: with the scale that they have none is an outlier.
  std::vector<double> shares;
  const std::vector<double> start = squared_distances();
  for (std::size_t n = 0; n < start.size(); ++n)
    shares.push_back(start[n] / chi_square_median(data_[n].num_residuals));
  scale_.value = std::max(1.0, std::sqrt(median(shares)));
  constexpr int kMaxRounds = 20;
  for (int round = 0; round < kMaxRounds; ++round) {
    ceres::Solver::Summary summary;
    ceres::Solve(options, &problem_, &summary);
    num_iterations_ += static_cast<int>(summary.iterations.size());
    if (!summary.IsSolutionUsable()) throw std::runtime_error("the fit failed: " + summary.message);
    const double scale = std::max(1.0, estimated_scale());
    const double change = std::abs(scale / scale_.value - 1);
    scale_.value = scale;
    if (change < 1e-3) break;
  }
  for (ParameterBlock* block : blocks())
    std::copy_n(memory_of(block), block->values.size(), block->values.begin());
}

}  // namespace bodyschema
