#include "processes/refiner/bends.h"

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <map>
#include <memory>
#include <optional>
#include <utility>

#include "common/schema/warp_process.h"
#include "processes/refiner/information.h"
#include "processes/refiner/refinement_problem.h"

namespace bodyschema {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

double half_range(const Signal& signal) { return 0.5 * (signal.upper - signal.lower); }

/// Linear signals of joints that were read at enough positions.
std::vector<int> candidates(const BodySchema& schema, const std::vector<RefinerSample>& samples) {
  const bool has_poses = std::ranges::any_of(
      samples, [](const RefinerSample& seen) { return !seen.sample.parts.empty(); });
  if (!has_poses || !std::ranges::all_of(schema.edges, PartChain::has_block)) return {};
  std::vector<int> result;
  for (int s = 0; s < std::ssize(schema.signals); ++s) {
    const Signal& signal = schema.signals[s];
    const bool moves = std::ranges::any_of(schema.edges, [&](const Edge& edge) {
      return std::ranges::any_of(edge.joints,
                                 [&](const ScrewJoint& joint) { return joint.signal == s; });
    });
    if (!moves || !signal.warp.empty() || !(half_range(signal) > 0)) continue;
    std::vector<double> positions;
    for (const RefinerSample& seen : samples)
      positions.push_back(normalized(schema.signals, seen.sample.action)(s));
    if (num_positions_apart(std::move(positions)) >= kFewestWarpPositions) result.push_back(s);
  }
  return result;
}

/// A quadratic log likelihood of a signal's weights: bᵀx − ½ xᵀAx.
struct Quadratic {
  MatrixXd A;
  VectorXd b;
};

/// That of the kept parameters where bᵀx − ½ xᵀAx is that of all, the others eliminated (Schur
/// complement), without the information `known` of the kept ones. Left out is what rounding leaves
/// of directions that nothing tells.
Quadratic eliminated(const MatrixXd& A, const VectorXd& b, const std::vector<Index>& kept,
                     const std::vector<Index>& others, const VectorXd& known) {
  constexpr double kLeast = 1e-9;  // of a unit diagonal; rounding leaves 1e-14
  const VectorXd unit =
      A.diagonal().unaryExpr([](double x) { return x > 0 ? 1 / std::sqrt(x) : 1.0; });
  const MatrixXd scaled = unit.asDiagonal() * A * unit.asDiagonal();
  const VectorXd score = unit.cwiseProduct(b);
  const Eigen::SelfAdjointEigenSolver<MatrixXd> of_others(scaled(others, others));
  const MatrixXd half = of_others.eigenvalues()
                            .unaryExpr([](double x) { return x > kLeast ? 1 / std::sqrt(x) : 0.0; })
                            .asDiagonal() *
                        of_others.eigenvectors().transpose();
  const MatrixXd mixed = half * scaled(others, kept);
  const VectorXd of_kept = unit(kept);
  MatrixXd left = scaled(kept, kept) - mixed.transpose() * mixed;
  left.diagonal() -= known.cwiseProduct(of_kept.cwiseAbs2());
  const Eigen::SelfAdjointEigenSolver<MatrixXd> eigen(left);
  const auto num_told = (eigen.eigenvalues().array() > kLeast).count();
  const MatrixXd V = eigen.eigenvectors().rightCols(num_told);
  const MatrixXd back = of_kept.cwiseInverse().asDiagonal() * V;
  return {back * eigen.eigenvalues().tail(num_told).asDiagonal() * back.transpose(),
          back * (V.transpose() * (score(kept) - mixed.transpose() * (half * score(others))))};
}

const std::optional<RigCalibration> kNoRig;

/// A problem of poses that begins with its schema, solved.
struct Solved {
  Solved(BodySchema start, const std::vector<RefinerSample>& samples, const RefineOptions& options,
         bool root_moves)
      : schema(std::move(start)), problem(schema, samples, kNoRig, options, root_moves) {
    problem.solve();
  }
  BodySchema schema;
  RefinementProblem problem;
};

struct Candidate {
  FoundBend found;
  std::vector<double> warp;  // Signal::warp
};

/// Of these signals the one whose command is most surely bent.
std::optional<Candidate> likeliest_bend(Solved& straight, const std::vector<int>& signals,
                                        const std::vector<RefinerSample>& samples,
                                        const RefineOptions& options) {
  if (signals.empty()) return std::nullopt;
  BodySchema bendable = straight.schema;
  for (const int s : signals) bendable.signals[s].warp.assign(kWarpSize, 0.0);
  RefinementProblem problem(bendable, samples, kNoRig, options, straight.problem.root_moves());
  problem.begin_at(straight.problem);
  const ParameterBlock& drive = *problem.drive();
  std::vector<ParameterBlock*> blocks = problem.blocks();
  std::erase_if(blocks, [](const ParameterBlock* block) {
    return block->kind == ParameterBlock::Kind::kInstant || !block->is_refined;
  });
  const VectorXd score = problem.score(blocks);
  std::map<int, std::vector<int>> free;  // of the drive's free scalars, by signal
  int num_free = 0;
  for (int n = 0; n < drive.num_free(); ++n) {
    const int signal = problem.drive_model().signal_of(drive.free[n]);
    if (std::ranges::find(signals, signal) == signals.end()) continue;
    free[signal].push_back(n);
    ++num_free;
  }
  const Information information(problem, options.measurement, num_free);
  const VectorXd prior_sd = problem.prior_of(drive);
  const Index first = information.offset(&drive);
  std::vector<Index> others;  // that are free beside the weights of one signal
  for (Index row = 0; row < information.curvature().rows(); ++row) {
    const Index n = row - first;
    if (n < 0 || n >= drive.num_free() ||
        !free.contains(problem.drive_model().signal_of(drive.free[n])))
      others.push_back(row);
  }
  std::optional<Candidate> best;
  for (const auto& [s, places] : free) {
    const double half = half_range(bendable.signals[s]);
    std::vector<Index> rows;
    VectorXd known(std::ssize(places));
    for (const int place : places) {
      known(std::ssize(rows)) = std::pow(prior_sd(drive.free[place]), -2);
      rows.push_back(first + place);
    }
    const auto [A, b] = eliminated(information.curvature(), score, rows, others, known);
    for (const WarpProcess& process : warp_processes(half * half * A, half * b, 0)) {
      if (process.evidence <= (best ? best->found.evidence : kWarpEvidence)) continue;
      best = Candidate{{s, process.evidence}, std::vector<double>(kWarpSize, 0.0)};
      for (Index k = 0; k < process.mean.size(); ++k)
        best->warp[static_cast<std::size_t>(k)] = half * process.mean(k);
    }
  }
  return best;
}

}  // namespace

BentSchema with_bends(const BodySchema& schema, const std::vector<RefinerSample>& samples,
                      const RefineOptions& options, bool root_moves) {
  BentSchema result{schema, {}};
  std::vector<int> linear = candidates(schema, samples);
  if (linear.empty()) return result;
  auto now = std::make_unique<Solved>(schema, samples, options, root_moves);
  while (const auto bend = likeliest_bend(*now, linear, samples, options)) {
    BodySchema bent = now->schema;
    bent.signals[bend->found.signal].warp = bend->warp;
    auto next = std::make_unique<Solved>(std::move(bent), samples, options, root_moves);
    const double gain = next->problem.log_likelihood() - now->problem.log_likelihood();
    if (!(gain > kWarpEvidence)) break;
    now = std::move(next);
    result.bends.push_back(bend->found);
    std::erase(linear, bend->found.signal);
  }
  result.schema = now->schema;
  return result;
}

}  // namespace bodyschema
