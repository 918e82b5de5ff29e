#include "processes/refiner/wanted_actions.h"

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <utility>

#include "processes/refiner/expected_information.h"
#include "processes/refiner/expected_sights.h"

namespace bodyschema {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

/// Each action is the best of a tenth of them, a spread sequence of its own: a sample of all
/// candidates is enough (Mirzasoleiman et al., Lazier than lazy greedy, 2015). Over five robots "c"
/// and five "d" of the chapter with two joints that hardly moved, ten actions left 0.81 and 0.94 of
/// the worst deviation that ten random ones left, each the best of 48 or of all 240.
constexpr int kNumCandidates = 200;
constexpr int kNumPredicted = 20;  // actions whose predictions are judged
constexpr double kRadian_m = 0.2;  // what a radian weighs, as for `reach`

constexpr double kInfinite = std::numeric_limits<double>::infinity();
constexpr double kManyTimes = 100;  // as Refinement says; more would be lost in rounding

double fraction(double x) { return x - std::floor(x); }

std::vector<int> primes(std::size_t num) {
  std::vector<int> result;
  for (int n = 2; result.size() < num; ++n)
    if (std::all_of(result.begin(), result.end(), [&](int prime) { return n % prime != 0; }))
      result.push_back(n);
  return result;
}

/// Signals that move a joint that is refined, and have a range.
std::vector<Index> moving_signals(const BodySchema& schema) {
  std::vector<Index> result;
  for (std::size_t s = 0; s < schema.signals.size(); ++s) {
    const bool moves = std::any_of(schema.edges.begin(), schema.edges.end(), [&](const Edge& edge) {
      return PartChain::has_block(edge) &&
             std::any_of(edge.joints.begin(), edge.joints.end(), [&](const ScrewJoint& joint) {
               return joint.signal == static_cast<int>(s) && joint.gain != 0 &&
                      (joint.slide != 0 || joint.turn != 0);
             });
    });
    if (moves && schema.signals[s].upper > schema.signals[s].lower)
      result.push_back(static_cast<Index>(s));
  }
  return result;
}

/// Points first … first + num − 1 of the sequence; other signals as in `still`.
std::vector<VectorXd> spread_actions(const std::vector<Signal>& signals,
                                     const std::vector<Index>& moving, const VectorXd& still,
                                     int first, int num) {
  const std::vector<int> roots = primes(moving.size());
  std::vector<VectorXd> result;
  for (int n = first; n < first + num; ++n) {
    VectorXd& action = result.emplace_back(still);
    for (std::size_t d = 0; d < moving.size(); ++d) {
      const Signal& signal = signals[static_cast<std::size_t>(moving[d])];
      const double phase = M_PI * fraction((n + 1) * std::sqrt(static_cast<double>(roots[d])));
      const double share = 0.5 * (1 - std::cos(phase));
      action(moving[d]) = signal.lower + share * (signal.upper - signal.lower);
    }
  }
  return result;
}

/// A part's predicted pose in the root at some action: its derivative by some places of the core,
/// translation [m] and rotation, a radian as kRadian_m.
struct Prediction {
  std::vector<Index> places;
  MatrixXd G;
};

/// The chain to a part at an action, and how its pose depends on its blocks, that of the drive
/// last.
struct Dependence {
  std::vector<ParameterBlock*> blocks;
  std::vector<PartChain::Jacobian> jacobians;
};

Dependence dependence(const BodySchema& schema, RefinementProblem& problem, int part,
                      std::int64_t sample_index, const VectorXd& action) {
  Dependence result;
  result.blocks = problem.chain_blocks(part, sample_index);
  std::vector<const double*> values;
  for (const ParameterBlock* block : result.blocks) values.push_back(problem.memory_of(block));
  const MatrixXd effects = problem.drive_model().effects(action);
  const VectorXd no_play = VectorXd::Zero(effects.rows());
  PartChain::Jacobian by_play = PartChain::Jacobian::Zero(6, effects.rows());
  PartChain(problem.paths().at(part), schema.displacements(action),
            problem.drive_model().first_joints())
      .pose(values.data(), Pose::Identity(), &result.jacobians, no_play.data(), &by_play);
  if (!problem.drive()) return result;
  result.blocks.push_back(problem.drive());
  result.jacobians.emplace_back(by_play * effects);
  return result;
}

std::vector<Prediction> predictions(const BodySchema& schema, const InformationLayout& layout,
                                    RefinementProblem& problem, std::int64_t sample_index,
                                    const std::vector<VectorXd>& actions) {
  std::vector<Prediction> result;
  for (const VectorXd& action : actions) {
    for (const auto& [part, path] : problem.paths()) {
      if (part == schema.root || !schema.has_part(part)) continue;
      const auto [blocks, jacobians] = dependence(schema, problem, part, sample_index, action);
      Prediction& prediction = result.emplace_back();
      const Index num_rows = schema.has_rotation(part) ? 6 : 3;
      std::vector<VectorXd> columns;
      for (std::size_t b = 1; b < blocks.size(); ++b) {
        const auto places = layout.places.find(blocks[b]);
        if (places == layout.places.end()) continue;
        for (int n = 0; n < blocks[b]->num_free(); ++n) {
          const Index at = places->second[static_cast<std::size_t>(n)];
          prediction.places.push_back(at);
          VectorXd column = jacobians[b].col(blocks[b]->free[static_cast<std::size_t>(n)]);
          column.tail<3>() *= kRadian_m;
          columns.push_back(layout.units(layout.core[at]) * column.head(num_rows));
        }
      }
      prediction.G.resize(num_rows, std::ssize(columns));
      for (std::size_t c = 0; c < columns.size(); ++c)
        prediction.G.col(static_cast<Index>(c)) = columns[c];
    }
  }
  return result;
}

/// The information of the samples and of the actions added, and what predictions owe to it.
class Design {
 public:
  Design(const InformationLayout& layout, const Information& information,
         std::vector<Prediction> predictions)
      : predictions_(std::move(predictions)) {
    const MatrixXd A = layout.scaled(information.curvature());
    core_ = A(layout.core, layout.core);
    core_.diagonal() += layout.prior;
    mixed_ = A(layout.tags, layout.core);
    tags_ = A(layout.tags, layout.tags);
    set_root_of_M();
    set_lasting(layout, layout.scaled(information.lasting_score()));
  }

  /// tr(M A⁻¹) with what an action is expected to show: the mean variance of predictions, what no
  /// sample averages out left out [m²]; infinite if it cannot be computed.
  double mean_variance_with(const Expectation& expected) const {
    MatrixXd J = expected.core;
    if (!expected.tags.empty() || expected.has_instant) {
      MatrixXd R = expected.noise;  // the lower triangle
      for (std::size_t t = 0; t < expected.tags.size(); ++t) {
        const auto& tag = expected.tags[t];
        const Index rows = tag.J.rows(), columns = tag.J.cols();
        J.middleRows(tag.row, rows) -= tag.J * effect_.middleRows(tag.column, columns);
        const MatrixXd by_all = tag.J * tags_inverse_.middleRows(tag.column, columns);
        for (std::size_t u = 0; u <= t; ++u) {
          const auto& other = expected.tags[u];
          R.block(tag.row, other.row, rows, other.J.rows()).noalias() +=
              by_all.middleCols(other.column, other.J.cols()) * other.J.transpose();
        }
      }
      Eigen::LLT<MatrixXd>(R).matrixL().solveInPlace(J);
    }
    MatrixXd A = reduced_;
    A.selfadjointView<Eigen::Lower>().rankUpdate(J.transpose());
    const Eigen::LLT<MatrixXd> llt(A);  // reads the lower triangle
    if (llt.info() != Eigen::Success) return kInfinite;
    return llt.matrixL().solve(root_of_M_).squaredNorm();
  }

  /// As if it was taken so many times.
  void add(const Expectation& expected, double times = 1) {
    MatrixXd J = MatrixXd::Zero(expected.core.rows(), core_.rows() + tags_.rows());
    J.leftCols(core_.rows()) = expected.core;
    for (const auto& tag : expected.tags)
      J.block(tag.row, core_.rows() + tag.column, tag.J.rows(), tag.J.cols()) = tag.J;
    expected.noise.llt().matrixL().solveInPlace(J);
    const auto by_core = J.leftCols(core_.rows()), by_tags = J.rightCols(tags_.rows());
    core_ += times * by_core.transpose() * by_core;
    mixed_ += times * by_tags.transpose() * by_core;
    tags_ += times * by_tags.transpose() * by_tags;
  }

  /// Variance of each prediction by what the samples and the actions tell [m²]; infinite if it
  /// cannot be computed. Brings mean_variance_with() up to date.
  VectorXd variances() {
    eliminate_tags();
    VectorXd result = VectorXd::Constant(std::ssize(predictions_), kInfinite);
    const Eigen::LLT<MatrixXd> llt(reduced_);
    if (llt.info() != Eigen::Success) return result;
    const MatrixXd inverse = llt.solve(MatrixXd::Identity(core_.rows(), core_.rows()));
    return variances_of(inverse);
  }
  /// What no sample averages out, by the samples.
  VectorXd lasting_variances() const { return lasting_; }

 private:
  // M = N Nᵀ.
  void set_root_of_M() {
    MatrixXd M = MatrixXd::Zero(core_.rows(), core_.rows());
    for (const auto& [places, G] : predictions_) {
      const MatrixXd product = G.transpose() * G / static_cast<double>(predictions_.size());
      for (std::size_t r = 0; r < places.size(); ++r)
        for (std::size_t c = 0; c < places.size(); ++c)
          M(places[r], places[c]) += product(static_cast<Index>(r), static_cast<Index>(c));
    }
    const Eigen::SelfAdjointEigenSolver<MatrixXd> eigen(M);
    const VectorXd& values = eigen.eigenvalues();
    const Index rank = (values.array() > 1e-14 * values(values.size() - 1)).count();
    root_of_M_ = eigen.eigenvectors().rightCols(rank) * values.tail(rank).cwiseSqrt().asDiagonal();
  }

  void set_lasting(const InformationLayout& layout, const MatrixXd& score) {
    lasting_ = VectorXd::Zero(std::ssize(predictions_));
    if (score.isZero(0)) return;
    std::vector<Index> rows = layout.core;
    rows.insert(rows.end(), layout.tags.begin(), layout.tags.end());
    MatrixXd A(std::ssize(rows), std::ssize(rows));
    A << core_, mixed_.transpose(), mixed_, tags_;
    const MatrixXd inverse = A.llt().solve(MatrixXd::Identity(A.rows(), core_.rows()));
    lasting_ = variances_of(inverse.transpose() * score(rows, rows) * inverse);
  }

  VectorXd variances_of(const MatrixXd& covariance) const {
    VectorXd result(std::ssize(predictions_));
    for (std::size_t n = 0; n < predictions_.size(); ++n) {
      const auto& [places, G] = predictions_[n];
      const MatrixXd of_places = covariance(places, places);
      result(static_cast<Index>(n)) = (G * of_places).cwiseProduct(G).sum();
    }
    return result;
  }

  void eliminate_tags() {
    reduced_ = core_;
    if (tags_.rows() == 0) return;
    // The tags' own information is nearly all of what the core loses: as a square, or the little
    // that stays would be lost in rounding.
    const Eigen::LLT<MatrixXd> llt(tags_);
    const MatrixXd half = llt.matrixL().solve(mixed_);
    reduced_ -= half.transpose() * half;
    effect_ = llt.matrixU().solve(half);
    tags_inverse_ = llt.solve(MatrixXd::Identity(tags_.rows(), tags_.rows()));
  }

  const std::vector<Prediction> predictions_;
  MatrixXd core_, mixed_, tags_;  // mixed: tags × core
  MatrixXd root_of_M_;
  VectorXd lasting_;  // by prediction
  MatrixXd reduced_, effect_, tags_inverse_;
};

/// Share by which the worst deviation is lower after `n` actions, with more variance beside that of
/// each prediction. It never grows but for rounding.
double fall_of(const std::vector<VectorXd>& variances, std::size_t n, const VectorXd& more) {
  double least = 1;
  const double at_first = (variances.front() + more).maxCoeff();
  for (std::size_t k = 1; k <= n; ++k) {
    const double now = std::max((variances[k] + more).maxCoeff(), 0.0);
    if (now < least * at_first) least = now / at_first;
  }
  return 1 - std::sqrt(least);
}

}  // namespace

std::vector<WantedAction> wanted_actions(const BodySchema& refined,
                                         const std::optional<RigCalibration>& rig,
                                         const std::vector<RefinerSample>& samples,
                                         RefinementProblem& problem,
                                         const Information& information) {
  const std::vector<Index> moving = moving_signals(refined);
  if (moving.empty()) return {};
  const ExpectedSights sights(refined, rig, samples, problem);
  const InformationLayout layout(problem, information);
  const auto spread = [&](int first, int num) {
    return spread_actions(refined.signals, moving, sights.last_action(), first, num);
  };
  Design design(layout, information,
                predictions(refined, layout, problem, sights.sample_index(),
                            spread(kNumCandidates, kNumPredicted)));
  const Forecast forecast(layout, sights, problem, rig.has_value(), information.worth());
  struct Candidate {
    VectorXd action;
    Expectation expected;
  };
  std::vector<Candidate> taken;
  std::vector<VectorXd> variances = {design.variances()};
  const std::vector<VectorXd> actions = spread(0, kNumCandidates);
  for (int k = 0; k < kMostWantedActions; ++k) {
    std::optional<Candidate> best;
    double least = kInfinite;
    for (int n = k; n < kNumCandidates; n += kMostWantedActions) {
      Expectation expected = forecast.at(actions[n]);
      if (expected.core.rows() == 0) continue;  // it shows nothing
      const double variance = design.mean_variance_with(expected);
      if (!(variance < least)) continue;
      least = variance;
      best = Candidate{actions[n], std::move(expected)};
    }
    if (!best) break;
    design.add(best->expected);
    variances.push_back(design.variances());
    taken.push_back(std::move(*best));
  }
  for (const Candidate& candidate : taken) design.add(candidate.expected, kManyTimes);
  const VectorXd all = design.lasting_variances(), without_rest = -design.variances();
  std::vector<WantedAction> result;
  for (std::size_t n = 0; n < taken.size(); ++n)
    result.push_back(
        {taken[n].action, fall_of(variances, n + 1, all), fall_of(variances, n + 1, without_rest)});
  return result;
}

}  // namespace bodyschema
