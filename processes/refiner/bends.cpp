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

const std::optional<RigCalibration> kNoRig;

/// A schema, and the problem of poses that begins with it.
struct FitToPoses {
  FitToPoses(BodySchema start, const std::vector<RefinerSample>& samples,
             const RefineOptions& options, bool root_moves)
      : schema(std::move(start)), problem(schema, samples, kNoRig, options, root_moves) {}
  BodySchema schema;
  RefinementProblem problem;
};

double half_range(const Signal& signal) { return 0.5 * (signal.upper - signal.lower); }

bool moves(const Edge& edge, int signal) {
  return std::ranges::any_of(edge.joints, [&](const ScrewJoint& joint) {
    return joint.signal == signal && joint.gain != 0 && (joint.slide != 0 || joint.turn != 0);
  });
}

/// Linear signals whose joints moved parts that were seen, by at how many positions.
struct Candidates {
  std::vector<int> well_read, too_few_positions;
};

Candidates candidates(const FitToPoses& fit, const std::vector<RefinerSample>& samples) {
  std::map<std::int64_t, VectorXd> positions;  // by sample
  for (const RefinerSample& seen : samples)
    positions[seen.sample.sample_index] = normalized(fit.schema.signals, seen.sample.action);
  Candidates result;
  for (int s = 0; s < std::ssize(fit.schema.signals); ++s) {
    const Signal& signal = fit.schema.signals[s];
    if (!signal.warp.empty() || !(half_range(signal) > 0) || !is_bendable(fit.schema, s)) continue;
    std::vector<double> read;
    for (const auto& datum : fit.problem.data())
      if (std::ranges::any_of(fit.problem.paths().at(datum.part),
                              [&](const Edge* edge) { return moves(*edge, s); }))
        read.push_back(positions.at(datum.sample_index)(s));
    const int num_positions = num_positions_apart(std::move(read));
    if (num_positions >= kFewestWarpPositions)
      result.well_read.push_back(s);
    else if (num_positions > 1)
      result.too_few_positions.push_back(s);
  }
  return result;
}

/// A log likelihood bᵀx − ½ xᵀAx.
struct Quadratic {
  MatrixXd A;
  VectorXd b;
};

/// That of the kept parameters, the others free (Schur complement). Directions that nothing tells
/// have the information 0, not what rounding makes of it.
Quadratic without(const std::vector<Index>& others, const std::vector<Index>& kept,
                  const Quadratic& all) {
  constexpr double kLeast = 1e-9;  // of a unit diagonal; rounding leaves 1e-14
  const VectorXd unit =
      all.A.diagonal().unaryExpr([](double x) { return x > 0 ? 1 / std::sqrt(x) : 1.0; });
  const MatrixXd A = unit.asDiagonal() * all.A * unit.asDiagonal();
  const VectorXd b = unit.cwiseProduct(all.b);
  const Eigen::SelfAdjointEigenSolver<MatrixXd> of_others(A(others, others));
  const MatrixXd root_of_inverse =
      of_others.eigenvalues()
          .unaryExpr([](double x) { return x > kLeast ? 1 / std::sqrt(x) : 0.0; })
          .asDiagonal() *
      of_others.eigenvectors().transpose();
  const MatrixXd mixed = root_of_inverse * A(others, kept);
  const Eigen::SelfAdjointEigenSolver<MatrixXd> rest(
      MatrixXd(A(kept, kept) - mixed.transpose() * mixed));
  const auto num_told = (rest.eigenvalues().array() > kLeast).count();
  const MatrixXd V = rest.eigenvectors().rightCols(num_told);
  const MatrixXd back = unit(kept).cwiseInverse().asDiagonal() * V;
  return {back * rest.eigenvalues().tail(num_told).asDiagonal() * back.transpose(),
          back * (V.transpose() * (b(kept) - mixed.transpose() * (root_of_inverse * b(others))))};
}

struct Candidate {
  FoundBend found;
  WarpProcess process;  ///< [half ranges]
};

/// What a solved fit tells of the weights of linear commands, were they free.
class FreeWeights {
 public:
  FreeWeights(FitToPoses& fit, const std::vector<int>& linear,
              const std::vector<RefinerSample>& samples, const RefineOptions& options) {
    BodySchema bendable = fit.schema;
    for (const int s : linear) bendable.signals[s].warp.assign(kWarpSize, 0.0);
    RefinementProblem problem(bendable, samples, kNoRig, options, fit.problem.root_moves());
    problem.begin_at(fit.problem);
    const ParameterBlock& drive = *problem.drive();
    std::map<int, std::vector<int>> free;  // the drive's scalars, by linear signal
    int num_free = 0;
    for (int n = 0; n < drive.num_free(); ++n) {
      const int s = problem.drive_model().signal_of(drive.free[n]);
      if (std::ranges::find(linear, s) == linear.end()) continue;
      free[s].push_back(n);
      ++num_free;
    }
    std::vector<ParameterBlock*> blocks = problem.blocks();
    std::erase_if(blocks, [](const ParameterBlock* block) {
      return block->kind == ParameterBlock::Kind::kInstant;
    });
    all_.b = problem.score(blocks);
    const Information information(problem, options.measurement, num_free);
    all_.A = information.curvature();
    const VectorXd prior_sd = problem.prior_of(drive);
    std::vector<bool> is_weight(static_cast<std::size_t>(all_.A.rows()), false);
    for (const auto& [s, places] : free) {
      Weights& weights = weights_[s];
      weights.half_range = half_range(bendable.signals[s]);
      for (const int n : places) {
        const Index row = information.offset(&drive) + n;
        weights.rows.push_back(row);
        is_weight[static_cast<std::size_t>(row)] = true;
        // Of the data alone.
        all_.A(row, row) -= std::pow(prior_sd(drive.free[n]), -2);
      }
    }
    for (Index row = 0; row < all_.A.rows(); ++row)
      if (!is_weight[static_cast<std::size_t>(row)]) others_.push_back(row);
  }

  /// Nothing if no signal beats its line by kWarpEvidence.
  std::optional<Candidate> likeliest() const {
    std::optional<Candidate> best;
    for (const auto& [s, weights] : weights_) {
      const double half = weights.half_range;
      const Quadratic told = without(others_, weights.rows, all_);
      for (WarpProcess& process : warp_processes(half * half * told.A, half * told.b, 0))
        if (process.evidence > (best ? best->process.evidence : kWarpEvidence))
          best = Candidate{{s, process.evidence}, std::move(process)};
    }
    return best;
  }

  /// From now on its weights are free, by its process.
  void add(const Candidate& bend) {
    const Weights& weights = weights_.at(bend.found.signal);
    for (std::size_t k = 0; k < weights.rows.size(); ++k) {
      const Index row = weights.rows[k];
      all_.A(row, row) += 1 / (std::pow(weights.half_range, 2) *
                               bend.process.prior_variance(static_cast<Index>(k)));
      others_.push_back(row);
    }
    weights_.erase(bend.found.signal);
  }

 private:
  struct Weights {
    std::vector<Index> rows;
    double half_range = 1;
  };
  Quadratic all_;
  std::map<int, Weights> weights_;  // by signal
  std::vector<Index> others_;
};

std::vector<Candidate> likely_bends(FreeWeights weights) {
  std::vector<Candidate> result;
  while (auto bend = weights.likeliest()) {
    weights.add(*bend);
    result.push_back(std::move(*bend));
  }
  return result;
}

BodySchema bent(BodySchema schema, const std::vector<Candidate>& bends) {
  for (const auto& [found, process] : bends) {
    Signal& signal = schema.signals[found.signal];
    signal.warp.assign(kWarpSize, 0.0);
    for (Index k = 0; k < process.mean.size(); ++k)
      signal.warp[static_cast<std::size_t>(k)] = half_range(signal) * process.mean(k);
  }
  return schema;
}

}  // namespace

BentSchema with_bends(const BodySchema& schema, const std::vector<RefinerSample>& samples,
                      const RefineOptions& options, bool root_moves) {
  BentSchema result{schema, {}, {}};
  const bool has_poses = std::ranges::any_of(
      samples, [](const RefinerSample& seen) { return !seen.sample.parts.empty(); });
  if (!has_poses) return result;
  auto fit = std::make_unique<FitToPoses>(schema, samples, options, root_moves);
  auto [linear, too_few_positions] = candidates(*fit, samples);
  result.too_few_positions = std::move(too_few_positions);
  if (!linear.empty()) fit->problem.solve();
  while (!linear.empty()) {
    std::vector<Candidate> bends = likely_bends(FreeWeights(*fit, linear, samples, options));
    std::unique_ptr<FitToPoses> next;
    const auto is_likelier_with_bends = [&] {
      next = std::make_unique<FitToPoses>(bent(fit->schema, bends), samples, options, root_moves);
      next->problem.solve();
      const double gain = next->problem.log_likelihood() - fit->problem.log_likelihood();
      return gain > kWarpEvidence * static_cast<double>(bends.size());
    };
    if (bends.empty()) break;
    const int likeliest = bends.front().found.signal;
    bool is_likelier = is_likelier_with_bends();
    if (!is_likelier && bends.size() > 1) {
      bends.resize(1);
      is_likelier = is_likelier_with_bends();
    }
    if (!is_likelier) {
      std::erase(linear, likeliest);
      continue;
    }
    fit = std::move(next);
    for (const Candidate& bend : bends) {
      result.bends.push_back(bend.found);
      std::erase(linear, bend.found.signal);
    }
  }
  result.schema = fit->schema;
  return result;
}

}  // namespace bodyschema
