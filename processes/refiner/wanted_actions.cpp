#include "processes/refiner/wanted_actions.h"

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <utility>

#include "processes/refiner/expected_sights.h"

namespace bodyschema {
namespace {

using Kind = ParameterBlock::Kind;
using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

/// Each action is the best of a tenth of them, a spread sequence of its own: a sample of all
/// candidates is enough (Mirzasoleiman et al., Lazier than lazy greedy, 2015). Over five robots "c"
/// and five "d" of the chapter with two joints that hardly moved, ten actions left 0.81 and 0.94 of
/// the worst deviation that ten random ones left, each the best of 48 or of all 240.
constexpr int kNumCandidates = 200;
constexpr int kNumPredicted = 20;  // actions whose predictions are judged
constexpr double kRadian_m = 0.2;  // what a radian weighs, as for `reach`
constexpr double kLeastProbability = 0.01;
constexpr double kInstantPrior = 1;  // m and rad, of a moving root

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

/// Places of the free directions of all blocks: the core (root, edges, lens), then the tags, both
/// in units in which a prior, weak or real, is 1.
struct Layout {
  std::vector<Index> core, tags;                               ///< rows of the information
  std::map<const ParameterBlock*, std::vector<Index>> places;  ///< by free direction; −1: known
  VectorXd units;                                              ///< by row of the information
  VectorXd prior;  ///< information of the weak prior, by place in the core

  Layout(const BodySchema& schema, RefinementProblem& problem, const Information& information);
};

double unit_of(const ParameterBlock& block, int direction, const BodySchema& schema,
               const VectorXd& prior_sd) {
  if (prior_sd.size() > 0) return prior_sd(direction);
  if (block.kind != Kind::kEdge || direction % 8 < 6) return 1;
  const ScrewJoint& joint = schema.edges[static_cast<std::size_t>(block.id)]
                                .joints[static_cast<std::size_t>(direction / 8)];
  const Signal& signal = schema.signals[static_cast<std::size_t>(joint.signal)];
  const double range = signal.upper - signal.lower;
  return 1 / (std::abs(joint.gain) * (range > 0 ? 0.5 * range : 1));
}

Layout::Layout(const BodySchema& schema, RefinementProblem& problem, const Information& information)
    : units(information.curvature().rows()) {
  const std::vector<int> frame_tags = problem.frame_tags();
  std::vector<double> weak;
  for (const ParameterBlock* block : information.blocks()) {
    const VectorXd prior_sd = problem.prior_of(*block);
    std::vector<Index>& at = places[block];
    Index row = information.offset(block);
    for (const int direction : block->free) {
      units(row) = unit_of(*block, direction, schema, prior_sd);
      if (is_frame(frame_tags, *block, direction)) {
        at.push_back(-1);
      } else if (block->kind == Kind::kTag) {
        at.push_back(std::ssize(tags));
        tags.push_back(row);
      } else {
        at.push_back(std::ssize(core));
        core.push_back(row);
        weak.push_back(prior_sd.size() > 0 ? 0 : 1);
      }
      ++row;
    }
  }
  prior = Eigen::Map<const VectorXd>(weak.data(), std::ssize(weak));
}

/// The derivative of what an action is expected to show.
struct Expectation {
  struct TagRows {
    Index row = 0, column = 0;  ///< of the first
    MatrixXd J;
  };
  MatrixXd core;  ///< r × core, rows whitened
  std::vector<TagRows> tags;
  MatrixXd noise;  ///< r × r, with what belongs to the instant
  bool has_instant = false;
};

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

/// Makes Expectations of actions.
class Forecast {
 public:
  Forecast(const Layout& layout, const ExpectedSights& sights, RefinementProblem& problem,
           bool has_corners, double worth)
      : layout_(layout),
        sights_(sights),
        problem_(problem),
        has_corners_(has_corners),
        worth_(worth) {}

  Expectation at(const VectorXd& action) const {
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

 private:
  struct Row {
    RefinementProblem::Cost cost;
    Derivative derivative;
    double weight = 0;  // of the square
  };
  using Rows = std::vector<Row>;

  void add(std::optional<RefinementProblem::Cost> cost, double probability, Rows* rows) const {
    if (!cost || probability < kLeastProbability) return;
    auto derivative = derivative_of(*cost, problem_);
    if (derivative)
      rows->push_back({std::move(*cost), std::move(*derivative), worth_ * probability});
  }

  Expectation assembled(const Rows& rows) const {
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

  void place(const MatrixXd& J, const ParameterBlock& block, const std::vector<Index>& places,
             Index first, Expectation* result) const {
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

  /// Prior deviations of an instant's block: a moving root's pose, then the plays.
  VectorXd instant_sd(Index size) const {
    VectorXd sd = VectorXd::Constant(size, kInstantPrior);
    sd.tail(problem_.play_sd().size()) = problem_.play_sd();
    return sd;
  }

  const Layout& layout_;
  const ExpectedSights& sights_;
  RefinementProblem& problem_;
  const bool has_corners_;
  const double worth_;
};

/// A part's predicted pose in the root at some action: its derivative by some places of the core,
/// translation [m] and rotation, a radian as kRadian_m.
struct Prediction {
  std::vector<Index> places;
  MatrixXd G;
};

std::vector<Prediction> predictions(const BodySchema& schema, const Layout& layout,
                                    RefinementProblem& problem, std::int64_t sample_index,
                                    const std::vector<VectorXd>& actions) {
  std::vector<Prediction> result;
  for (const VectorXd& action : actions) {
    const VectorXd theta = schema.displacements(action);
    for (const auto& [part, path] : problem.paths()) {
      if (part == schema.root || !schema.has_part(part)) continue;
      const std::vector<ParameterBlock*> blocks = problem.chain_blocks(part, sample_index);
      std::vector<const double*> values;
      for (const ParameterBlock* block : blocks) values.push_back(problem.memory_of(block));
      std::vector<PartChain::Jacobian> jacobians;
      PartChain(path, theta).pose(values.data(), Pose::Identity(), &jacobians);
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
  Design(const Layout& layout, const Information& information, std::vector<Prediction> predictions)
      : predictions_(std::move(predictions)) {
    const auto scaled = [&](const MatrixXd& matrix) -> MatrixXd {
      return layout.units.asDiagonal() * matrix * layout.units.asDiagonal();
    };
    const MatrixXd A = scaled(information.curvature());
    core_ = A(layout.core, layout.core);
    core_.diagonal() += layout.prior;
    mixed_ = A(layout.tags, layout.core);
    tags_ = A(layout.tags, layout.tags);
    set_root_of_M();
    set_lasting(layout, scaled(information.lasting_score()));
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

  void set_lasting(const Layout& layout, const MatrixXd& score) {
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
  const Layout layout(refined, problem, information);
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
