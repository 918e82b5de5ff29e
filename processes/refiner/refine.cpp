#include "processes/refiner/refine.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <Eigen/QR>
#include <algorithm>
#include <chrono>
#include <cmath>
#include <iterator>
#include <memory>
#include <set>
#include <stdexcept>
#include <utility>

#include "common/config/calibration_id.h"
#include "common/estimation/chi_square.h"
#include "common/estimation/quantile.h"
#include "common/geometry/angle.h"
#include "common/kinematics/screw_chain.h"
#include "common/schema/warp_process.h"
#include "processes/refiner/bends.h"
#include "processes/refiner/calibrated_lens.h"
#include "processes/refiner/elasticity.h"
#include "processes/refiner/held_out.h"
#include "processes/refiner/information.h"
#include "processes/refiner/informative_samples.h"
#include "processes/refiner/refined_schema.h"
#include "processes/refiner/refinement_problem.h"
#include "processes/refiner/refinement_warnings.h"
#include "processes/refiner/refinement_words.h"
#include "processes/refiner/root_motion.h"
#include "processes/refiner/sample_selection.h"
#include "processes/refiner/wanted_actions.h"

namespace bodyschema {
namespace {

/// Chosen: what a person reads.
constexpr std::size_t kMostCorrelations = 20;
/// Chosen: degrees are 57 times as many as radians.
constexpr double kAbsurdShare = 10;

/// Slides that hardly turn do not turn then. Returns how many there are.
int make_slides_pure(BodySchema* schema) {
  // Chosen: the likelihood decides. So small an angle is seldom a revolute joint's.
  constexpr double kHardly = 2 * kDegree;
  const Eigen::VectorXd middle = schema->displacements(mid_range(schema->signals));
  int num = 0;
  for (Edge& edge : schema->edges)
    for (ScrewJoint& joint : edge.joints) {
      if (!PartChain::has_block(edge) || joint.slide == 0 || joint.turn == 0 ||
          std::abs(joint.turn) * half_travel(*schema, joint) > kHardly)
        continue;
      Pose turned = Pose::Identity();
      Screw{0, joint.turn}.append_motion(joint.gain * middle(joint.signal) + joint.offset,
                                         turned.linear(), turned.translation());
      joint.X_after = turned * joint.X_after;
      joint.turn = 0;
      ++num;
    }
  return num;
}

/// Solved. With `has_plays`, joints of poses have plays that gain more than BIC's price (Schwarz
/// 1978), each joint's and all together. All arguments must outlive it.
std::unique_ptr<RefinementProblem> solved_problem(const BodySchema& schema,
                                                  const std::vector<RefinerSample>& samples,
                                                  const std::optional<RigCalibration>& rig,
                                                  const RefineOptions& options, bool root_moves,
                                                  bool has_plays) {
  auto exact = std::make_unique<RefinementProblem>(schema, samples, rig, options, root_moves);
  exact->solve();
  if (!has_plays) return exact;
  auto loose = std::make_unique<RefinementProblem>(schema, samples, rig, options, root_moves, true);
  const double price = std::log(exact->num_residuals()) / 2;
  loose->begin_at(*exact);
  if (loose->plays().empty() || loose->play_score() < std::sqrt(2 * price)) return exact;
  do loose->solve();
  while (loose->drop_plays(price));
  // Each joint's plays have paid for themselves.
  const bool is_loose = (loose->shown_play_sd().array() > 0).any();
  const double gain = loose->log_marginal_likelihood() - exact->log_marginal_likelihood();
  return is_loose && gain > price ? std::move(loose) : std::move(exact);
}

/// A solved problem, and the schema that it began with, which it refers to.
struct Fit {
  std::unique_ptr<const BentSchema> start;
  std::unique_ptr<RefinementProblem> problem;
};

/// Whoever gives loads says that droop is elastic: neither bends nor plays are looked for.
Fit fit(const BodySchema& schema, const std::vector<RefinerSample>& samples,
        const std::optional<RigCalibration>& rig, const RefineOptions& options, bool root_moves,
        bool has_loads) {
  const bool has_plays = !rig && !has_loads;
  const auto begun_with = [&](BentSchema start) {
    Fit result{std::make_unique<const BentSchema>(std::move(start)), nullptr};
    result.problem =
        solved_problem(result.start->schema, samples, rig, options, root_moves, has_plays);
    return result;
  };
  if (has_loads) return begun_with({schema, {}, {}});
  Fit bent = begun_with(with_bends(schema, samples, options, root_moves));
  const auto& [_, bends, too_few_positions] = *bent.start;
  if (!has_plays || bends.empty() || bent.problem->plays().empty()) return bent;
  // Bends were the likelier as long as no joint was off its command.
  Fit straight = begun_with({schema, {}, too_few_positions});
  const double gain =
      bent.problem->log_marginal_likelihood() - straight.problem->log_marginal_likelihood();
  return gain < kWarpEvidence * static_cast<double>(bends.size()) ? std::move(straight)
                                                                  : std::move(bent);
}

/// The same where slides that hardly turn do so only if that is likelier than not (BIC): nothing
/// would tell where the axis of so small a turn is.
Fit fit_with_pure_slides(const BodySchema& schema, const std::vector<RefinerSample>& samples,
                         const std::optional<RigCalibration>& rig, const RefineOptions& options,
                         bool root_moves, bool has_loads) {
  BodySchema pure = schema;
  const int num_pure = make_slides_pure(&pure);
  Fit turning = fit(schema, samples, rig, options, root_moves, has_loads);
  if (num_pure == 0) return turning;
  Fit sliding = fit(pure, samples, rig, options, root_moves, has_loads);
  constexpr int kParameters = 3;  // the turn, and where its axis is
  const double gain =
      turning.problem->log_marginal_likelihood() - sliding.problem->log_marginal_likelihood();
  const double price = 0.5 * std::log(turning.problem->num_residuals());
  return gain > kParameters * num_pure * price ? std::move(turning) : std::move(sliding);
}

/// Where revolute joints that slide as they turn, each by a pitch of its own, make poses likelier
/// than bends and plays of pure ones do.
std::optional<std::string> warning_of_pitch(const Fit& fit,
                                            const std::vector<RefinerSample>& samples,
                                            const RefineOptions& options, bool root_moves) {
  constexpr double kSure = 10;  // chosen [nats], beside BIC's price
  BodySchema helical = fit.start->schema;
  int num = 0;
  for (Edge& edge : helical.edges)
    for (ScrewJoint& joint : edge.joints) {
      if (!PartChain::has_block(edge) || joint.slide != 0 || joint.gain == 0) continue;
      joint.slide = 1e-9 * joint.turn;  // free
      ++num;
    }
  if (num == 0) return std::nullopt;
  const std::optional<RigCalibration> no_rig;
  RefinementProblem problem(helical, samples, no_rig, options, root_moves);
  problem.begin_at(*fit.problem);
  problem.solve();
  const double price = 0.5 * std::log(problem.num_residuals());
  if (problem.log_marginal_likelihood() - fit.problem->log_marginal_likelihood() <
      kSure + num * price)
    return std::nullopt;
  double most = 0;
  std::string words;
  for (const ParameterBlock* block : problem.blocks()) {
    if (block->kind != ParameterBlock::Kind::kEdge) continue;
    const Edge edge = edge_from(*block, helical.edges[block->id]);
    for (const ScrewJoint& joint : edge.joints) {
      const double slide = std::abs(joint.slide) * half_travel(helical, joint);
      if (joint.turn == 0 || slide <= most) continue;
      most = slide;
      words = fmt::format("{} slides as it turns, by {:.1f} mm a radian, which the model cannot",
                          joint_name(helical, edge, joint), 1e3 * joint.slide / joint.turn);
    }
  }
  return words;
}

/// All, the farthest first.
std::vector<RefinementOutlier> outliers_of(RefinementProblem& problem) {
  std::vector<RefinementOutlier> result;
  const std::vector<double> squared = problem.squared_distances();
  for (std::size_t n = 0; n < squared.size(); ++n) {
    const auto& datum = problem.data()[n];
    if (squared[n] > chi_square_quantile(datum.num_residuals, 1e-4))
      result.push_back(
          {datum.sample_index, datum.part, datum.tag, datum.utime, std::sqrt(squared[n])});
  }
  std::stable_sort(result.begin(), result.end(),
                   [](const auto& a, const auto& b) { return a.distance > b.distance; });
  return result;
}

/// Edges that nothing tells, joints that rested, bends that could not be told.
std::vector<std::string> undetermined_things(const BentSchema& bent,
                                             const RefinementProblem& problem) {
  const BodySchema& schema = bent.schema;
  std::vector<std::string> result;
  std::set<const Edge*> told;
  for (const auto& datum : problem.data()) {
    const auto& path = problem.paths().at(datum.part);
    told.insert(path.begin(), path.end());
  }
  for (const Edge& edge : schema.edges)
    if (!told.contains(&edge))
      result.push_back(fmt::format("{}→{}: no part beyond it was seen", edge.from, edge.to));
  for (const auto& [e, d] : problem.joints_at_rest())
    result.push_back(fmt::format("axis and gain of {}: it rested",
                                 joint_name(schema, schema.edges[e], schema.edges[e].joints[d])));
  if (!bent.too_few_positions.empty()) {
    std::vector<std::string> names;
    for (const int s : bent.too_few_positions) names.push_back(schema.signals[s].name);
    result.push_back(fmt::format("bends of {}: read at fewer than {} positions",
                                 fmt::join(names, ", "), kFewestWarpPositions));
  }
  return result;
}

std::vector<JointPlay> plays_of(const BodySchema& schema, const RefinementProblem& problem) {
  std::vector<JointPlay> result;
  const Eigen::VectorXd play_sd = problem.shown_play_sd();
  for (std::size_t n = 0; n < problem.plays().size(); ++n) {
    const Edge& edge = schema.edges[problem.plays()[n].edge];
    const ScrewJoint& joint = edge.joints[problem.plays()[n].joint];
    const double sd = std::abs(joint.gain) * play_sd(static_cast<Eigen::Index>(n));
    result.push_back(
        {joint_name(schema, edge, joint), sd * std::abs(joint.slide), sd * std::abs(joint.turn)});
  }
  return result;
}

std::vector<SignalCoverage> coverage_of(const BodySchema& schema,
                                        const std::vector<RefinerSample>& samples) {
  std::vector<SignalCoverage> result;
  for (std::size_t s = 0; s < schema.signals.size(); ++s) {
    const Signal& signal = schema.signals[s];
    double low = samples.front().sample.action(s), high = low;
    for (const RefinerSample& seen : samples) {
      low = std::min(low, seen.sample.action(s));
      high = std::max(high, seen.sample.action(s));
    }
    const double range = signal.upper - signal.lower;
    const double share = range > 0 ? (high - low) / range : 0;
    if (share > kAbsurdShare)
      throw std::invalid_argument(
          fmt::format("{} spans {:.0f} times the range that the schema gives it: another unit?",
                      signal.name, share));
    result.push_back({signal.name, share});
  }
  return result;
}

std::vector<std::string> held_things(const BodySchema& schema, const RefineOptions& options,
                                     bool has_corners) {
  std::vector<std::string> result;
  for (const Edge& edge : schema.edges)
    if (!PartChain::has_block(edge))
      result.push_back(fmt::format("{}→{}: its Gaussian process", edge.from, edge.to));
  for (int s = 0; s < std::ssize(schema.signals); ++s)
    if (!schema.signals[s].warp.empty() && !is_bendable(schema, s))
      result.push_back(fmt::format("{}: the bend of its command", schema.signals[s].name));
  if (has_corners && !options.placements) result.push_back("tags: as the rig's files say");
  if (has_corners && !options.intrinsics) result.push_back("lens: as the rig's files say");
  return result;
}

/// Over the signal's range, from the line that is nearest to its displacements.
RefinedBend told_bend(const Signal& signal, double evidence) {
  constexpr int kPoints = 101;
  const Eigen::VectorXd q = Eigen::VectorXd::LinSpaced(kPoints, signal.lower, signal.upper);
  const Eigen::VectorXd theta = q.unaryExpr([&](double x) { return signal.displacement(x); });
  Eigen::MatrixX2d line(kPoints, 2);
  line << Eigen::VectorXd::Ones(kPoints), q;
  const Eigen::VectorXd left = theta - line * line.colPivHouseholderQr().solve(theta);
  return {signal.name, evidence, left.cwiseAbs().maxCoeff()};
}

/// All that the fit tells of the parameters.
void describe(const BentSchema& start, RefinementProblem& problem,
              const std::vector<RefinerSample>& training, const std::optional<RigCalibration>& rig,
              const RefineOptions& options, Refinement* result) {
  for (const int part : problem.unseen_parts())
    result->held.push_back(fmt::format("the frame of part {}: it was never seen", part));
  std::ranges::move(undetermined_things(start, problem), std::back_inserter(result->held));
  result->outliers = outliers_of(problem);
  std::ranges::move(warnings_of_fit(problem, result->outliers, result->coverage),
                    std::back_inserter(result->warnings));
  result->num_outliers = static_cast<int>(result->outliers.size());
  if (result->outliers.size() > kMostOutliers) result->outliers.resize(kMostOutliers);
  result->serial_correlation = problem.serial_correlation();
  const Information information(problem, options.measurement);
  const RefinementWords words(start.schema, information, problem.frame_tags(), result->coverage);
  result->num_observations = static_cast<int>(problem.data().size());
  result->num_iterations = problem.num_iterations();
  result->noise_scale = problem.scale();
  result->parameters = words.parameters();
  result->undetermined = words.undetermined();
  result->correlations = words.correlations(kMostCorrelations);
  result->plays = plays_of(start.schema, problem);
  result->schema = refined_schema(start.schema, training, problem, information);
  if (!options.joint_loads) set_scatter(problem, &result->schema);
  for (const FoundBend& bend : start.bends)
    result->bends.push_back(told_bend(result->schema.signals[bend.signal], bend.evidence));
  std::optional<RigCalibration> refined;
  if (result->used_corners) {
    refined = result->rig = refined_rig(problem, *rig);
    set_residuals(training, result->rig, &result->schema);
    result->schema.calibration_id = calibration_id(refined->markers, refined->camera);
  } else {
    if (options.measurement.noise) result->schema.noise = *options.measurement.noise;
    // The schema is of the calibration that the poses rest on, whatever it began with.
    result->schema.calibration_id = calibration_of(training);
  }
  result->wanted_actions = wanted_actions(result->schema, refined, training, problem, information);
}

/// By TEST samples, beside the schema that it began with.
void judge(const BodySchema& schema, const std::vector<RefinerSample>& held_out,
           const std::optional<RigCalibration>& rig, const RefineOptions& options,
           Refinement* result) {
  const bool has_corners_of_rig = rig && has_corners(held_out);
  const auto errors = [&](const BodySchema& of, const RigCalibration& seen_through) {
    return held_out_errors(of, held_out,
                           has_corners_of_rig ? std::optional(seen_through) : std::nullopt,
                           options.corner_noise);
  };
  result->before = errors(schema, rig.value_or(RigCalibration()));
  result->after = errors(result->schema, result->rig);
  std::ranges::move(warnings_of_answer(schema, *result, held_out, options.measurement),
                    std::back_inserter(result->warnings));
}

}  // namespace

Refinement refine(const BodySchema& schema, std::vector<RefinerSample> samples,
                  const std::optional<RigCalibration>& claimed, const RefineOptions& options) {
  const auto begin = std::chrono::steady_clock::now();
  std::optional<RigCalibration> rig = claimed;
  if (rig && options.intrinsics) rig->camera = with_all_coefficients(rig->camera);
  Refinement result;
  auto [training, held_out, left_out] = select_samples(schema, std::move(samples), rig, options);
  result.held = std::move(left_out);
  result.used_corners = options.placements || options.intrinsics;
  const std::optional<RigCalibration> used_rig = result.used_corners ? rig : std::nullopt;
  if (rig) result.rig = *rig;
  result.num_available = static_cast<int>(training.size());
  RefineOptions stiff = options;
  stiff.joint_loads = nullptr;
  const auto [moves, step] =
      root_motion(schema, thinned(training, static_cast<std::size_t>(options.config.max_samples)),
                  used_rig, stiff);
  result.root_moves = moves;
  if (step)
    result.warnings.push_back(fmt::format(
        "part {} was seen elsewhere from sample {} on: {}", schema.root, *step,
        result.root_moves ? "the camera, or the robot, moved; each sample has a place of it"
                          : "its marker moved on it; give the samples since then"));
  training = informative(std::move(training), schema, used_rig, stiff, result.root_moves);
  result.num_samples = static_cast<int>(training.size());
  result.coverage = coverage_of(schema, training);
  std::ranges::move(held_things(schema, options, result.used_corners),
                    std::back_inserter(result.held));

  const bool has_loads = options.joint_loads != nullptr;
  const Fit best =
      fit_with_pure_slides(schema, training, used_rig, stiff, result.root_moves, has_loads);
  if (!has_loads && !result.used_corners)
    if (auto warning = warning_of_pitch(best, training, stiff, result.root_moves))
      result.warnings.push_back(std::move(*warning));
  describe(*best.start, *best.problem, training, rig, options, &result);
  if (options.joint_loads && !result.used_corners)
    result.elasticity = fit_elasticity(result.schema, training, held_out, options, *best.problem);
  if (options.joint_loads && !result.elasticity)
    result.held.emplace_back("compliances of joints: no load of them changes");
  judge(schema, held_out, rig, options, &result);
  result.seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();
  return result;
}

}  // namespace bodyschema
