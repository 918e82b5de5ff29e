#include "processes/refiner/refined_schema.h"

#include <Eigen/Eigenvalues>
#include <Eigen/QR>
#include <algorithm>
#include <array>
#include <cmath>

#include "common/kinematics/screw_chain.h"
#include "processes/refiner/calibrated_lens.h"

namespace bodyschema {
namespace {

/// Chosen: the mean of smooth functions of the action.
constexpr std::size_t kMostForMeans = 50;

/// Without the negative eigenvalues of its correlation matrix.
Matrix6d positive_part(const Matrix6d& matrix) {
  const Vector6d unit = matrix.diagonal().cwiseMax(0).cwiseSqrt();
  const Vector6d inverse = unit.unaryExpr([](double x) { return x > 0 ? 1 / x : 0.0; });
  const Matrix6d symmetric = 0.5 * (matrix + matrix.transpose());
  const Eigen::SelfAdjointEigenSolver<Matrix6d> eigen(
      Matrix6d(inverse.asDiagonal() * symmetric * inverse.asDiagonal()));
  const Matrix6d V = unit.asDiagonal() * eigen.eigenvectors();
  return V * eigen.eigenvalues().cwiseMax(0).asDiagonal() * V.transpose();
}

/// Covariances of root and edges as a schema has them, which has none of its bends: what is open of
/// a bend along a joint's line is open of the joint's gain and offset, with what they have in
/// common with it; the rest is one more variance of the offset, its mean over the samples.
class EdgeCovariances {
 public:
  /// All arguments must outlive this. `start`: that of the problem.
  EdgeCovariances(const BodySchema& start, const std::vector<RefinerSample>& samples,
                  const RefinementProblem& problem, const Information& information)
      : information_(information), drive_(problem.drive()) {
    if (!drive_) return;
    const Eigen::MatrixXd weights = information.cross_covariance(drive_, drive_);
    const std::vector<RefinerSample> some = thinned(samples, kMostForMeans);
    for (const ParameterBlock* block : information.blocks())
      if (block->kind == ParameterBlock::Kind::kEdge)
        add(start.edges[block->id], some, problem.drive_model(), weights, block);
  }

  Eigen::MatrixXd between(const ParameterBlock* one, const ParameterBlock* other) const {
    Eigen::MatrixXd result = information_.cross_covariance(one, other);
    if (!drive_) return result;
    const Share mine = share_of(one), others = share_of(other);
    result +=
        mine.by_drive * information_.cross_covariance(drive_, other) +
        information_.cross_covariance(one, drive_) * others.by_drive.transpose() +
        mine.by_drive * information_.cross_covariance(drive_, drive_) * others.by_drive.transpose();
    if (one == other) result += mine.rest;
    return result;
  }

 private:
  struct Share {
    Eigen::MatrixXd by_drive;  // ∂(edge's tangent)/∂(drive), along the joints' lines
    Eigen::MatrixXd rest;
  };

  Share share_of(const ParameterBlock* block) const {
    const auto found = shares_.find(block);
    if (found != shares_.end()) return found->second;
    const int size = block->tangent_size();
    return {Eigen::MatrixXd::Zero(size, drive_->tangent_size()), Eigen::MatrixXd::Zero(size, size)};
  }

  void add(const Edge& edge, const std::vector<RefinerSample>& samples, const DriveModel& model,
           const Eigen::MatrixXd& weights, const ParameterBlock* block) {
    Share share = share_of(block);
    const auto num = std::ssize(samples);
    for (int d = 0; d < std::ssize(edge.joints); ++d) {
      const ScrewJoint& joint = edge.joints[d];
      Eigen::MatrixX2d line(num, 2);  // of the joint's displacement
      Eigen::MatrixXd beyond(num, weights.rows());
      for (Eigen::Index n = 0; n < num; ++n) {
        const Eigen::VectorXd& action = samples[n].sample.action;
        line.row(n) << 1, joint.gain * model.displacements(action)(joint.signal) + joint.offset;
        beyond.row(n) = joint.gain * model.effects(action).row(model.first_joints().at(&edge) + d);
      }
      for (int k = 0; k < weights.rows(); ++k)
        if (!model.is_weight(k)) beyond.col(k).setZero();
      const Eigen::MatrixXd by_line = line.completeOrthogonalDecomposition().solve(beyond);
      beyond -= line * by_line;
      const double variance =
          (beyond * weights).cwiseProduct(beyond).sum() / static_cast<double>(num);
      const Eigen::Map<const Eigen::Vector2d> screw(&block->values[value_of_slide(d)]);
      const int before = ScrewChainLayout::transform(d);
      const std::array<int, 2> offset = {before + 2, before + 5};  // along and about z
      for (int k = 0; k < 2; ++k) {
        share.by_drive.row(offset[k]) += screw(k) * by_line.row(0);
        share.by_drive.row(ScrewChainLayout::slide(d) + k) += screw(k) * by_line.row(1);
      }
      share.rest(offset, offset) += variance * screw * screw.transpose();
    }
    shares_[block] = std::move(share);
  }

  const Information& information_;
  const ParameterBlock* drive_;
  std::map<const ParameterBlock*, Share> shares_;
};

/// The blocks on the way to a part, and how the part's pose depends on each at one sample.
struct ChainAt {
  std::vector<ParameterBlock*> blocks;
  std::vector<PartChain::Jacobian> jacobians;
  Pose X_CB = Pose::Identity();
};

ChainAt chain_at(RefinementProblem& problem, const BodySchema& schema, int part,
                 const ActionPoseSample& sample) {
  ChainAt chain;
  chain.blocks = problem.chain_blocks(part, sample.sample_index);
  std::vector<const double*> values;
  for (const ParameterBlock* block : chain.blocks) values.push_back(block->values.data());
  chain.X_CB = PartChain(problem.paths().at(part), schema.displacements(sample.action))
                   .pose(values.data(), Pose::Identity(), &chain.jacobians);
  return chain;
}

/// Mean over the samples of how a part's frame moves with a block.
struct MeanEffect {
  const ParameterBlock* block = nullptr;
  PartChain::Jacobian by_block;
};

/// Of the last edge on the way to `end`.
MeanEffect mean_effect(RefinementProblem& problem, const BodySchema& schema,
                       const std::vector<RefinerSample>& samples, int end, int part) {
  MeanEffect effect;
  int count = 0;
  for (const RefinerSample& seen : samples) {
    if (!problem.has_root(seen.sample.sample_index)) continue;
    const ChainAt chain = chain_at(problem, schema, end, seen.sample);
    const Pose X_CP = chain_at(problem, schema, part, seen.sample).X_CB;
    const PartChain::Jacobian J = adjoint(X_CP.inverse() * chain.X_CB) * chain.jacobians.back();
    effect.block = chain.blocks.back();
    if (++count == 1) effect.by_block = PartChain::Jacobian::Zero(6, J.cols());
    effect.by_block += (J - effect.by_block) / count;
  }
  return effect;
}

/// −(what the edge to a part and those from it have in common), of their mean errors over the
/// samples: an error of the frame is the same at every action. Joints on one signal in both edges
/// have more in common, which depends on the action: it stays in the predictions' covariances.
std::map<int, Matrix6d> frame_covariances(const BodySchema& schema,
                                          const std::vector<RefinerSample>& samples,
                                          RefinementProblem& problem,
                                          const EdgeCovariances& covariances) {
  std::map<int, Matrix6d> result;
  const std::vector<RefinerSample> some = thinned(samples, kMostForMeans);
  for (const int part : schema.parts) {
    if (!problem.paths().contains(part) || (problem.root_moves() && part == schema.root)) continue;
    std::vector<int> children;
    for (const Edge& edge : schema.edges)
      if (edge.from == part && PartChain::has_block(edge)) children.push_back(edge.to);
    const auto& path = problem.paths().at(part);
    if (children.empty() || (!path.empty() && !PartChain::has_block(*path.back()))) continue;
    const MeanEffect parent = mean_effect(problem, schema, some, part, part);
    if (!parent.block) continue;
    Matrix6d sum = Matrix6d::Zero();
    for (const int to : children) {
      const MeanEffect child = mean_effect(problem, schema, some, to, part);
      sum -= parent.by_block * covariances.between(parent.block, child.block) *
             child.by_block.transpose();
    }
    result[part] = positive_part(sum / static_cast<double>(children.size()));
  }
  return result;
}

}  // namespace

BodySchema refined_schema(const BodySchema& start, const std::vector<RefinerSample>& samples,
                          RefinementProblem& problem, const Information& information) {
  BodySchema schema = start;
  if (problem.drive()) problem.drive_model().set_warps(*problem.drive(), &schema);
  const EdgeCovariances covariances(start, samples, problem, information);
  for (const ParameterBlock* block : problem.blocks()) {
    if (block->kind == ParameterBlock::Kind::kRoot && !problem.root_moves()) {
      schema.X_CR = pose_at(block->values.data());
      schema.X_CR_covariance = covariances.between(block, block);
    } else if (block->kind == ParameterBlock::Kind::kEdge) {
      Edge& edge = schema.edges[block->id];
      edge = edge_from(*block, edge);
      edge.parameter_covariance = covariances.between(block, block);
    }
  }
  schema.frame_covariances = frame_covariances(schema, samples, problem, covariances);
  schema.refined = true;
  schema.base_version = start.version;
  schema.last_sample_index = std::max(start.last_sample_index, samples.back().sample.sample_index);
  schema.version = std::max(start.version, schema.last_sample_index) + 1;
  schema.utime = std::max(start.utime, samples.back().sample.utime);
  schema.num_samples = static_cast<int>(samples.size());
  std::vector<ActionPoseSample> seen;
  for (const RefinerSample& sample : samples) seen.push_back(sample.sample);
  schema.set_covered(seen);
  return schema;
}

void set_scatter(const RefinementProblem& problem, BodySchema* schema) {
  for (Edge& edge : schema->edges)
    if (PartChain::has_block(edge))
      for (ScrewJoint& joint : edge.joints) joint.scatter = 0;
  const Eigen::VectorXd play_sd = problem.shown_play_sd();
  for (std::size_t n = 0; n < problem.plays().size(); ++n) {
    const auto& [e, d] = problem.plays()[n];
    ScrewJoint& joint = schema->edges[e].joints[d];
    joint.scatter = std::abs(joint.gain) * play_sd(static_cast<Eigen::Index>(n));
  }
}

RigCalibration refined_rig(RefinementProblem& problem, RigCalibration rig) {
  for (const ParameterBlock* block : problem.blocks()) {
    if (!block->is_refined) continue;
    if (block->kind == ParameterBlock::Kind::kLens) {
      rig.camera = calibration_with(
          rig.camera,
          Eigen::Map<const Eigen::VectorXd>(block->values.data(), std::ssize(block->values)));
    } else if (block->kind == ParameterBlock::Kind::kTag) {
      const auto tag = std::find_if(rig.markers.tags.begin(), rig.markers.tags.end(),
                                    [&](const TagPlacement& t) { return t.id == block->id; });
      if (tag->X_BM) tag->X_BM = pose_at(block->values.data());
      tag->size_m *= block->values.back();
    }
  }
  return rig;
}

}  // namespace bodyschema
