#include "processes/refiner/refinement_problem.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <stdexcept>
#include <utility>

#include "common/estimation/student_t.h"
#include "common/kinematics/kinematic_tree.h"
#include "common/kinematics/screw_chain.h"
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
                                     const RefineOptions& options, bool root_moves,
                                     bool poses_have_plays)
    : schema_(schema),
      rig_(rig),
      options_(options),
      root_moves_(root_moves),
      poses_have_plays_(poses_have_plays),
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
  for (const RefinerSample& sample : samples) {
    actions_[sample.sample.sample_index] = sample.sample.action;
    rig_ ? add_corners(sample) : add_poses(sample);
  }
  if (data_.empty()) throw std::invalid_argument("the samples show nothing that can be fitted");
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

void RefinementProblem::add_plays() {
  if (!rig_ && !poses_have_plays_) return;
  // Chosen: of poses the search begins wide, for from far too little it takes many rounds.
  const double times = rig_ ? 1 : 10;
  std::vector<double> sd;
  for (int e = 0; e < std::ssize(schema_.edges); ++e) {
    const Edge& edge = schema_.edges[e];
    if (!PartChain::has_block(edge)) continue;
    for (int d = 0; d < std::ssize(edge.joints); ++d) {
      const ScrewJoint& joint = edge.joints[d];
      plays_.push_back({e, d});
      const TagCalibration& play = options_.config.joint_play;
      const double turn = std::abs(joint.gain * joint.turn);
      const double slide = std::abs(joint.gain * joint.slide);
      sd.push_back(times * (turn > 0    ? play.rotation_rad / turn
                            : slide > 0 ? play.position_m / slide
                                        : 1));
    }
  }
  play_sd_ = play_start_ = Eigen::Map<const Eigen::VectorXd>(sd.data(), std::ssize(sd));
  is_exact_.assign(plays_.size(), false);
}

void RefinementProblem::add_drive() {
  ParameterBlock block = drive_model_.block();
  if (!block.free.empty()) drive_ = &storage_.emplace_back(std::move(block));
}

// By the reading of a part that the other parts agree with best: a first one may be flipped.
std::optional<Pose> RefinementProblem::root_seen_in(const ActionPoseSample& sample) const {
  const std::map<int, Pose> X_RB = schema_.predict_all(sample.action);
  std::vector<std::vector<Pose>> readings;  // of the root, by part
  std::vector<Matrix6d> covariances;        // of the part
  for (const PartObservation& seen : sample.parts) {
    if (!seen.has_rotation || !X_RB.contains(seen.part)) continue;
    const Pose X_BR = X_RB.at(seen.part).inverse();
    std::vector<Pose>& of_part = readings.emplace_back();
    of_part.push_back(seen.X_CB * X_BR);
    if (seen.X_CB_other) of_part.push_back(*seen.X_CB_other * X_BR);
    const Matrix6d to_root = adjoint(X_BR.inverse());
    covariances.push_back(to_root * options_.measurement.covariance(seen) * to_root.transpose());
  }
  std::optional<Pose> best;
  double least = std::numeric_limits<double>::infinity();
  for (const std::vector<Pose>& of_part : readings)
    for (const Pose& X_CR : of_part) {
      double cost = 0;
      for (std::size_t n = 0; n < readings.size(); ++n) {
        double nearest = std::numeric_limits<double>::infinity();
        for (const Pose& other : readings[n])
          nearest =
              std::min(nearest, squared_mahalanobis(log(X_CR.inverse() * other), covariances[n]));
        cost += robust_cost(nearest, 6);
      }
      if (cost >= least) continue;
      least = cost;
      best = X_CR;
    }
  return best;
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
      const auto X_CR = root_seen_in(seen.sample);
      if (!X_CR) continue;
      block.add(*X_CR);
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

std::vector<ParameterBlock*> RefinementProblem::chain_blocks(int part, std::int64_t sample_index) {
  std::vector<ParameterBlock*> blocks = {root_moves_ ? instants_.at(sample_index) : root_};
  for (const Edge* edge : paths_.at(part)) {
    const auto block = edges_.find(static_cast<int>(edge - schema_.edges.data()));
    if (block != edges_.end()) blocks.push_back(block->second);
  }
  return blocks;
}

Eigen::VectorXd RefinementProblem::displacements(const Eigen::VectorXd& action) const {
  return drive_ ? drive_model_.displacements(action) : schema_.displacements(action);
}

DriveEffects RefinementProblem::effects(const Eigen::VectorXd& action) {
  if (!drive_) return nullptr;
  if (!last_effects_ || last_action_ != action) {
    last_action_ = action;
    last_effects_ = std::make_shared<const Eigen::MatrixXd>(drive_model_.effects(action));
  }
  return last_effects_;
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
  if (!tag || !paths_.contains(tag->part)) return std::nullopt;
  const Matrix8d covariance = covariance_of(sight, options_.corner_noise);
  std::vector<ParameterBlock*> blocks = chain_blocks(tag->part, sample_index);
  blocks.push_back(tags_.at(sight.tag));
  blocks.push_back(lens_block_);
  if (!plays_.empty() && !root_moves_) blocks.push_back(instants_.at(sample_index));
  if (drive_) blocks.push_back(drive_);
  auto cost = std::make_unique<CornerResidual>(
      PartChain(paths_.at(tag->part), displacements(action), drive_model_.first_joints()),
      std::vector<const ParameterBlock*>(blocks.begin(), blocks.end()), tag->size_m, *lens_, sight,
      covariance, scale_, effects(action));
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
  if (!paths_.contains(part)) return std::nullopt;
  std::vector<ParameterBlock*> blocks = chain_blocks(part, sample_index);
  if (!plays_.empty() && !root_moves_) blocks.push_back(instants_.at(sample_index));
  if (drive_) blocks.push_back(drive_);
  const std::vector<const ParameterBlock*> constant(blocks.begin(), blocks.end());
  PartChain chain(paths_.at(part), displacements(action), drive_model_.first_joints());
  std::unique_ptr<ceres::CostFunction> cost;
  if (observation.has_rotation && schema_.has_rotation(part))
    cost = std::make_unique<PoseResidual>(std::move(chain), constant, observation,
                                          options_.measurement, scale_, effects(action));
  else
    cost = std::make_unique<PositionResidual>(std::move(chain), constant, observation,
                                              options_.measurement, scale_, effects(action));
  return Cost{std::move(cost), std::move(blocks), part};
}

void RefinementProblem::add_corners(const RefinerSample& seen) {
  const std::int64_t index = seen.sample.sample_index;
  if (!has_root(index)) return;
  for (const TagSight& sight : seen.tags)
    if (auto cost = cost_of(sight, seen.sample.action, index))
      add(std::move(*cost), {.sample_index = index, .utime = seen.sample.utime, .tag = sight.tag});
}

void RefinementProblem::add_poses(const RefinerSample& seen) {
  const std::int64_t index = seen.sample.sample_index;
  if (!has_root(index)) return;
  for (const PartObservation& observation : seen.sample.parts)
    if (auto cost = cost_of(observation, seen.sample.action, index))
      add(std::move(*cost),
          {.sample_index = index, .utime = seen.sample.utime, .observation = &observation});
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

double RefinementProblem::weak_sd(const ParameterBlock& block, int direction) const {
  if (block.kind != ParameterBlock::Kind::kEdge || !ScrewChainLayout::is_screw(direction)) return 1;
  const ScrewJoint& joint = schema_.edges[block.id].joints[ScrewChainLayout::screw_of(direction)];
  const double reach = half_travel(schema_, joint);
  return 1 / (reach > 0 ? reach : std::abs(joint.gain));
}

double RefinementProblem::prior_information(const ParameterBlock& block, int direction) const {
  const Eigen::VectorXd sd = prior_of(block);
  if (sd.size() > 0) return std::pow(sd(direction), -2);
  return is_at_rest(block, direction) ? std::pow(weak_sd(block, direction), -2) : 0;
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

void RefinementProblem::evaluate(const ceres::Problem::EvaluateOptions& options,
                                 std::vector<double>* residuals, std::vector<double>* gradient,
                                 ceres::CRSMatrix* jacobian) {
  if (!problem_.Evaluate(options, nullptr, residuals, gradient, jacobian))
    throw std::runtime_error("the refined model cannot be evaluated");
}

std::vector<double> RefinementProblem::squared_distances() {
  ceres::Problem::EvaluateOptions options;
  options.apply_loss_function = false;
  for (const Datum& datum : data_) options.residual_blocks.push_back(datum.id);
  std::vector<double> residuals;
  evaluate(options, &residuals, nullptr, nullptr);
  std::vector<double> result;
  std::size_t row = 0;
  for (const Datum& datum : data_) {
    double sum = 0;
    for (int n = 0; n < datum.num_residuals; ++n, ++row) sum += residuals[row] * residuals[row];
    result.push_back(sum);
  }
  return result;
}

double RefinementProblem::serial_correlation() {
  // Chosen: of white noise one series in a thousand has an axis beyond it.
  constexpr double kSignificant = 3.5, kLargest = 0.98;
  constexpr int kFewest = 20;
  ceres::Problem::EvaluateOptions options;
  options.apply_loss_function = false;
  for (const Datum& datum : data_) options.residual_blocks.push_back(datum.id);
  std::vector<double> residuals;
  evaluate(options, &residuals, nullptr, nullptr);
  struct Last {
    std::int64_t sample_index = 0;
    Eigen::VectorXd influence;
  };
  std::map<std::pair<int, int>, Last> last;  // by part and tag
  Eigen::VectorXd products = Eigen::VectorXd::Zero(12), squares = products;
  double count = 0;
  const double* r = residuals.data();
  for (const Datum& datum : data_) {
    const Eigen::Map<const Eigen::VectorXd> residual(r, datum.num_residuals);
    r += datum.num_residuals;
    Eigen::VectorXd influence =
        robust_weight(residual.squaredNorm(), datum.num_residuals) * residual;
    if (datum.observation && datum.num_residuals == 6) {  // also along the camera's axes
      const Eigen::Matrix3d R_CB = datum.observation->X_CB.linear();
      influence.conservativeResize(12);
      influence.segment<3>(6) = R_CB * influence.head<3>();
      influence.tail<3>() = R_CB * influence.segment<3>(3);
    }
    Last& before = last[{datum.part, datum.tag}];
    if (before.influence.size() == influence.size() &&
        before.sample_index + 1 == datum.sample_index) {
      products.head(influence.size()) += before.influence.cwiseProduct(influence);
      squares.head(influence.size()) +=
          0.5 * (before.influence.cwiseAbs2() + influence.cwiseAbs2());
      ++count;
    }
    before = {datum.sample_index, influence};
  }
  const double seen = products.cwiseQuotient(squares.cwiseMax(1e-300)).maxCoeff();
  return count >= kFewest && seen > kSignificant / std::sqrt(count) ? std::min(seen, kLargest) : 0;
}

double RefinementProblem::num_residuals() const {
  double sum = 0;
  for (const Datum& datum : data_) sum += datum.num_residuals;
  return sum;
}

double RefinementProblem::log_likelihood() {
  const std::vector<double> d2 = squared_distances();
  double sum = 0;
  for (std::size_t n = 0; n < d2.size(); ++n)
    sum -= robust_cost(d2[n], data_[n].num_residuals) +
           data_[n].num_residuals * std::log(scale_.value);
  return sum;
}

Eigen::VectorXd RefinementProblem::score(const std::vector<ParameterBlock*>& blocks) {
  ceres::Problem::EvaluateOptions options;
  for (const ParameterBlock* block : blocks) options.parameter_blocks.push_back(memory_of(block));
  std::vector<double> gradient;  // of −log
  evaluate(options, nullptr, &gradient, nullptr);
  return -Eigen::Map<const Eigen::VectorXd>(gradient.data(), std::ssize(gradient));
}

void RefinementProblem::zero_plays() {
  for (const auto& [index, block] : instants_) {
    const auto num = std::ssize(plays_);
    std::fill_n(memory_of(block) + std::ssize(block->values) - num, num, 0);
  }
}

}  // namespace bodyschema
