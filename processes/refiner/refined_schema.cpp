#include "processes/refiner/refined_schema.h"

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>

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

/// −(what the edge to a part and an edge from it have in common), as errors of the part's frame.
Matrix6d shared_at(const ChainAt& parent, const ChainAt& child, const Information& information) {
  const Matrix6d to_parent = adjoint(parent.X_CB.inverse() * child.X_CB);
  return -parent.jacobians.back() *
         information.cross_covariance(parent.blocks.back(), child.blocks.back()) *
         (to_parent * child.jacobians.back()).transpose();
}

std::map<int, Matrix6d> frame_covariances(const BodySchema& schema,
                                          const std::vector<RefinerSample>& samples,
                                          RefinementProblem& problem,
                                          const Information& information) {
  std::map<int, Matrix6d> result;
  for (const int part : schema.parts) {
    if (!problem.paths().contains(part) || (problem.root_moves() && part == schema.root)) continue;
    std::vector<int> children;
    for (const Edge& edge : schema.edges)
      if (edge.from == part && PartChain::has_block(edge)) children.push_back(edge.to);
    const auto& path = problem.paths().at(part);
    if (children.empty() || (!path.empty() && !PartChain::has_block(*path.back()))) continue;
    Matrix6d sum = Matrix6d::Zero();
    int count = 0;
    for (const RefinerSample& seen : thinned(samples, kMostForMeans)) {
      if (!problem.has_root(seen.sample.sample_index)) continue;
      const ChainAt parent = chain_at(problem, schema, part, seen.sample);
      for (const int child : children)
        sum += shared_at(parent, chain_at(problem, schema, child, seen.sample), information);
      count += static_cast<int>(children.size());
    }
    if (count > 0) result[part] = positive_part(sum / count);
  }
  return result;
}

}  // namespace

BodySchema refined_schema(const BodySchema& start, const std::vector<RefinerSample>& samples,
                          RefinementProblem& problem, const Information& information) {
  BodySchema schema = start;
  for (const ParameterBlock* block : problem.blocks()) {
    if (block->kind == ParameterBlock::Kind::kRoot && !problem.root_moves()) {
      schema.X_CR = pose_at(block->values.data());
      schema.X_CR_covariance = information.cross_covariance(block, block);
    } else if (block->kind == ParameterBlock::Kind::kEdge) {
      Edge& edge = schema.edges[block->id];
      edge = edge_from(*block, edge);
      edge.parameter_covariance = information.cross_covariance(block, block);
    }
  }
  if (problem.drive()) problem.drive_model().set_warps(*problem.drive(), &schema);
  schema.frame_covariances = frame_covariances(schema, samples, problem, information);
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

RigCalibration refined_rig(RefinementProblem& problem, RigCalibration rig) {
  for (const ParameterBlock* block : problem.blocks()) {
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
