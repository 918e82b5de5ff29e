#include "processes/refiner/refinement_problem.h"

#include <ceres/crs_matrix.h>
#include <ceres/solver.h>
#include <glog/logging.h>

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <memory>
#include <stdexcept>
#include <utility>

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
      drive_model_(schema, options.joint_loads, samples),
      problem_(problem_options()) {
  add_paths();
  add_plays();
  add_drive();
  add_instants(samples);
  if (rig_) {
    add_tags();
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
  if (root_) hold(root_, 0, schema_.root);
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

// Poses have errors of joints in their covariances.
void RefinementProblem::add_plays() {
  if (!rig_) return;
  std::vector<double> sd;
  for (const Edge& edge : schema_.edges) {
    if (!PartChain::has_block(edge) || edge.joints.empty()) continue;
    first_play_[&edge] = static_cast<int>(plays_.size());
    for (const ScrewJoint& joint : edge.joints) {
      plays_.push_back({&edge, static_cast<int>(sd.size()) - first_play_[&edge]});
      const TagCalibration& play = options_.config.joint_play;
      const double turn = std::abs(joint.gain * joint.turn);
      const double slide = std::abs(joint.gain * joint.slide);
      sd.push_back(turn > 0 ? play.rotation_rad / turn : slide > 0 ? play.position_m / slide : 1);
    }
  }
  play_sd_ = play_start_ = Eigen::Map<const Eigen::VectorXd>(sd.data(), std::ssize(sd));
}

void RefinementProblem::add_drive() {
  if (rig_) return;
  ParameterBlock block = drive_model_.block();
  if (!block.free.empty()) drive_ = &storage_.emplace_back(std::move(block));
}

// Of a root that moves: where its parts say that it was.
void RefinementProblem::add_instants(const std::vector<RefinerSample>& samples) {
  if (!root_moves_) {
    root_ = &storage_.emplace_back();
    root_->add(schema_.X_CR);
    root_->free = {0, 1, 2, 3, 4, 5};
    if (plays_.empty()) return;
  }
  for (const RefinerSample& seen : samples) {
    ParameterBlock block;
    block.kind = ParameterBlock::Kind::kInstant;
    if (root_moves_) {
      const std::map<int, Pose> X_RB = schema_.predict_all(seen.sample.action);
      const auto& parts = seen.sample.parts;
      const auto witness = std::find_if(parts.begin(), parts.end(), [&](const auto& observation) {
        return observation.has_rotation && X_RB.contains(observation.part);
      });
      if (witness == parts.end()) continue;
      block.add(Pose(witness->X_CB * X_RB.at(witness->part).inverse()));
    }
    for (std::size_t n = 0; n < plays_.size(); ++n) block.add(0.0);
    for (int n = 0; n < block.tangent_size(); ++n) block.free.push_back(n);
    instants_[seen.sample.sample_index] = &storage_.emplace_back(std::move(block));
  }
}

void RefinementProblem::add_tags() {
  for (const TagPlacement& tag : rig_->markers.tags) {
    ParameterBlock& block = storage_.emplace_back();
    block.kind = ParameterBlock::Kind::kTag;
    block.id = tag.id;
    block.add(tag.X_BM.value_or(Pose::Identity()));
    block.add(1.0);
    // Without a placement the tag is the part's frame.
    if (tag.X_BM)
      block.free = {0, 1, 2, 3, 4, 5, 6};
    else
      block.free = {6};
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
  std::vector<ParameterBlock*> blocks = {root_moves_ ? instants_.at(sample_index) : root_};
  for (const Edge* edge : paths_.at(part)) {
    const auto block = edges_.find(static_cast<int>(edge - schema_.edges.data()));
    if (block != edges_.end()) blocks.push_back(block->second);
  }
  return blocks;
}

void RefinementProblem::add(Cost cost, Datum datum) {
  std::vector<double*> values;
  for (ParameterBlock* block : cost.blocks) {
    values.push_back(memory_of(block));
    used_.insert(block);
  }
  datum.part = cost.part;
  datum.num_residuals = cost.function->num_residuals();
  StudentTLoss& loss = datum.num_residuals == 8   ? loss_of_corners_
                       : datum.num_residuals == 6 ? loss_of_poses_
                                                  : loss_of_positions_;
  datum.id = problem_.AddResidualBlock(cost.function.release(), &loss, values);
  data_.push_back(datum);
}

std::optional<RefinementProblem::Cost> RefinementProblem::cost_of(const TagSight& sight,
                                                                  const Eigen::VectorXd& action,
                                                                  std::int64_t sample_index) {
  const TagPlacement* tag = rig_->markers.find(sight.tag);
  if (!tag || !is_usable(tag->part, sample_index) ||
      has_moved(schema_.moved_tags, sight.tag, sample_index))
    return std::nullopt;
  const Matrix8d covariance = covariance_of(sight, options_.corner_noise);
  std::vector<ParameterBlock*> blocks = chain_blocks(tag->part, sample_index);
  blocks.push_back(tags_.at(sight.tag));
  blocks.push_back(lens_block_);
  if (!plays_.empty() && !root_moves_) blocks.push_back(instants_.at(sample_index));
  auto cost = std::make_unique<CornerResidual>(
      PartChain(paths_.at(tag->part), schema_.displacements(action), first_play_),
      std::vector<const ParameterBlock*>(blocks.begin(), blocks.end()), tag->size_m, *lens_, sight,
      covariance, scale_);
  // Predicted behind the camera: nothing to start from.
  std::vector<const double*> values;
  for (const ParameterBlock* block : blocks) values.push_back(block->values.data());
  Eigen::Matrix<double, 8, 1> residuals;
  if (!cost->Evaluate(values.data(), residuals.data(), nullptr)) return std::nullopt;
  return Cost{std::move(cost), std::move(blocks), tag->part};
}

std::optional<RefinementProblem::Cost> RefinementProblem::cost_of(
    const PartObservation& observation, const Eigen::VectorXd& action, std::int64_t sample_index) {
  const int part = observation.part;
  if (!is_usable(part, sample_index)) return std::nullopt;
  std::vector<ParameterBlock*> blocks = chain_blocks(part, sample_index);
  if (drive_) blocks.push_back(drive_);
  const std::vector<const ParameterBlock*> constant(blocks.begin(), blocks.end());
  PartChain chain(paths_.at(part),
                  drive_ ? drive_model_.displacements(action) : schema_.displacements(action),
                  drive_model_.first_joints());
  const Eigen::MatrixXd effects = drive_ ? drive_model_.effects(action) : Eigen::MatrixXd();
  std::unique_ptr<ceres::CostFunction> cost;
  if (observation.has_rotation && schema_.has_rotation(part))
    cost = std::make_unique<PoseResidual>(std::move(chain), constant, observation,
                                          options_.measurement, scale_, effects);
  else
    cost = std::make_unique<PositionResidual>(std::move(chain), constant, observation,
                                              options_.measurement, scale_, effects);
  return Cost{std::move(cost), std::move(blocks), part};
}

void RefinementProblem::add_corners(const RefinerSample& seen) {
  const std::int64_t index = seen.sample.sample_index;
  if (!has_root(index)) return;
  for (const TagSight& sight : seen.tags)
    if (auto cost = cost_of(sight, seen.sample.action, index))
      add(std::move(*cost), {.sample_index = index, .tag = sight.tag});
}

void RefinementProblem::add_poses(const RefinerSample& seen) {
  const std::int64_t index = seen.sample.sample_index;
  if (!has_root(index)) return;
  for (const PartObservation& observation : seen.sample.parts)
    if (auto cost = cost_of(observation, seen.sample.action, index))
      add(std::move(*cost), {.sample_index = index, .observation = &observation});
}

std::vector<ParameterBlock*> RefinementProblem::blocks() {
  std::vector<ParameterBlock*> result;
  const auto add_all = [&](const auto& blocks) {
    for (const auto& [id, block] : blocks)
      if (used_.contains(block)) result.push_back(block);
  };
  add_all(instants_);
  if (root_ && used_.contains(root_)) result.push_back(root_);
  add_all(edges_);
  if (drive_) result.push_back(drive_);
  add_all(tags_);
  if (lens_block_) result.push_back(lens_block_);
  return result;
}

std::vector<int> RefinementProblem::frame_tags() const {
  std::map<int, std::map<int, int>> num_seen;  // by part and tag
  for (const Datum& datum : data_)
    if (datum.tag >= 0) ++num_seen[datum.part][datum.tag];
  std::vector<int> result;
  for (const auto& [part, tags] : num_seen)
    result.push_back(std::max_element(tags.begin(), tags.end(), [](const auto& a, const auto& b) {
                       return a.second < b.second;
                     })->first);
  return result;
}

bool is_frame(const std::vector<int>& frame_tags, const ParameterBlock& block, int direction) {
  return block.kind == ParameterBlock::Kind::kTag &&
         std::find(frame_tags.begin(), frame_tags.end(), block.id) != frame_tags.end() &&
         (direction < 6 || block.id == frame_tags.back());
}

Eigen::VectorXd RefinementProblem::prior_of(const ParameterBlock& block) const {
  const RefinerConfig& config = options_.config;
  if (block.kind == ParameterBlock::Kind::kTag) {
    Eigen::VectorXd sd(7);
    sd << Eigen::Vector3d::Constant(config.tags.position_m),
        Eigen::Vector3d::Constant(config.tags.rotation_rad), config.tags.size_share;
    return sd;
  }
  if (block.kind == ParameterBlock::Kind::kDrive) return drive_model_.prior_sd();
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
    if (block->kind == ParameterBlock::Kind::kInstant && !plays_.empty())
      problem_.AddResidualBlock(new PlayResidual(*block, play_sd_), nullptr, memory_of(block));
    const Eigen::VectorXd sd = prior_of(*block);
    if (sd.size() == 0) continue;
    ParameterBlock mean = *block;
    if (block->kind == ParameterBlock::Kind::kDrive) std::ranges::fill(mean.start, 0);
    problem_.AddResidualBlock(new PriorResidual(mean, sd), nullptr, memory_of(block));
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

double RefinementProblem::log_likelihood() {
  const std::vector<double> d2 = squared_distances();
  double sum = 0;
  for (std::size_t n = 0; n < d2.size(); ++n)
    sum -= robust_cost(d2[n], data_[n].num_residuals) +
           data_[n].num_residuals * std::log(scale_.value);
  return sum;
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

// Evidence (MacKay 1992): the sum of squares of a joint's plays over the number of them that the
// data determine. Returns the largest change, a share.
double RefinementProblem::estimate_play() {
  if (plays_.empty()) return 0;
  std::vector<ParameterBlock*> instants;
  for (ParameterBlock* block : blocks())
    if (block->kind == ParameterBlock::Kind::kInstant) instants.push_back(block);
  ceres::Problem::EvaluateOptions options;
  options.num_threads = 1;
  for (ParameterBlock* block : instants) options.parameter_blocks.push_back(memory_of(block));
  ceres::CRSMatrix J;  // of all residuals, also the priors', with the loss's weights
  if (!problem_.Evaluate(options, nullptr, nullptr, nullptr, &J))
    throw std::runtime_error("the refined model cannot be evaluated");
  const int size = instants.front()->num_free();
  const auto num = static_cast<int>(plays_.size());
  std::vector<Eigen::MatrixXd> information(instants.size(), Eigen::MatrixXd::Zero(size, size));
  for (int row = 0; row < J.num_rows; ++row) {
    const int begin = J.rows[row], end = J.rows[row + 1];
    if (begin == end) continue;
    const Eigen::Map<const Eigen::VectorXd> values(&J.values[begin], end - begin);
    information[J.cols[begin] / size] += values * values.transpose();
  }
  Eigen::ArrayXd squares = Eigen::ArrayXd::Zero(num), determined = Eigen::ArrayXd::Zero(num);
  for (std::size_t n = 0; n < instants.size(); ++n) {
    const double* play = memory_of(instants[n]) + instants[n]->values.size() - num;
    const Eigen::MatrixXd covariance =
        information[n].llt().solve(Eigen::MatrixXd::Identity(size, size));
    squares += Eigen::Map<const Eigen::ArrayXd>(play, num).square();
    determined += 1 - covariance.diagonal().tail(num).array() / play_sd_.array().square();
  }
  // Of no play at all, a hundredth of what it began with.
  const Eigen::ArrayXd next = (squares / determined.max(1e-6))
                                  .sqrt()
                                  .max(play_start_.array() / 100)
                                  .min(play_start_.array() * 100);
  const double change = (next / play_sd_.array()).log().abs().maxCoeff();
  play_sd_ = next;
  return change;
}

void RefinementProblem::leave_out_play() {
  for (const auto& [index, block] : instants_) {
    const auto num = std::ssize(plays_);
    std::fill_n(memory_of(block) + std::ssize(block->values) - num, num, 0);
  }
}

ceres::Solver::Options RefinementProblem::solver_options() {
  // A step for which Cholesky fails is tried again with more damping; glog would tell the user.
  FLAGS_minloglevel = google::GLOG_ERROR;
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

void RefinementProblem::solve() {
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
  constexpr int kMaxRounds = 20;
  for (int round = 0; round < kMaxRounds; ++round) {
    run(1e-5, 10);
    const double scale = std::max(1.0, estimated_scale());
    const double change = std::abs(scale / scale_.value - 1);
    scale_.value = scale;
    const double change_of_play = estimate_play();
    if (change < 0.01 && change_of_play < 0.2) break;
  }
  run(1e-9, 200);
  for (ParameterBlock* block : blocks())
    std::copy_n(memory_of(block), block->values.size(), block->values.begin());
}

}  // namespace bodyschema
