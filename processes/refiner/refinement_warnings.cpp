#include "processes/refiner/refinement_warnings.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <iterator>
#include <map>
#include <numbers>
#include <optional>

#include "common/geometry/angle.h"
#include "common/kinematics/screw_chain.h"
#include "processes/refiner/elasticity.h"
#include "processes/refiner/held_out.h"

namespace bodyschema {
namespace {

/// Share of a part's observations above which they refute the model; chosen: with 35 % of wild
/// poses arms are still refined right, and models of another body leave more than half.
constexpr double kRefutedShare = 0.4;
/// Chosen: with fewer numbers a parameter, fits to as many numbers as parameters were up to ten
/// times worse than the model that they began with.
constexpr double kFewNumbers = 2;
/// Of held-out poses, medians; chosen: of ten right ones it is below with 99.9 %.
constexpr double kSurprising = 1.5;
/// Of the noise; chosen: noise that is told by hand is hardly right to half of it.
constexpr double kLargeScale = 3;
/// Chosen: degrees are 57 times as many as radians.
constexpr double kTinyShare = 1.0 / 30;  ///< of limits in degrees, of commands in radians

/// Limits in degrees, commands in radians.
std::optional<std::string> warning_of_units(const std::vector<SignalCoverage>& coverage) {
  double most = 0;
  for (const SignalCoverage& signal : coverage) most = std::max(most, signal.share);
  if (!(most > 0 && most < kTinyShare)) return std::nullopt;
  return fmt::format(
      "the commands span at most {:.1f} % of the ranges that the schema gives them: another unit?",
      100 * most);
}

/// Parts that held-out samples refute the refined model of more than the one before.
std::vector<std::string> warnings_of_worse(const HeldOutErrors& before,
                                           const HeldOutErrors& after) {
  // Chosen: chance makes either better by some per cent, and three standard errors of a median,
  // which is known to its value over the root of as many samples.
  constexpr double kWorse = 1.2, kSure = 3, kLeast_m = 1e-6;
  std::vector<std::string> result;
  for (const PartErrors& now : after.parts) {
    const auto then = std::ranges::find(before.parts, now.part, &PartErrors::part);
    if (then == before.parts.end()) continue;
    const double chance = kSure * now.position_median_m / std::sqrt(now.count);
    if (now.position_median_m > kWorse * then->position_median_m + kLeast_m &&
        now.position_median_m - then->position_median_m > chance)
      result.push_back(fmt::format(
          "held-out positions of part {} are off by {:.2f} mm, by the model before by {:.2f} mm "
          "(medians): more samples, and over more of the range of each joint",
          now.part, 1e3 * now.position_median_m, 1e3 * then->position_median_m));
  }
  return result;
}

/// How a joint moves by its command in the frame of the part that its edge begins at, the others in
/// the middle of their ranges.
Vector6d joint_twist(const BodySchema& schema, const Edge& edge, std::size_t joint) {
  Pose X = edge.left;
  for (std::size_t d = 0; d < joint; ++d) {
    const ScrewJoint& before = edge.joints[d];
    const Signal& signal = schema.signals[before.signal];
    const double middle = signal.displacement(0.5 * (signal.lower + signal.upper));
    Screw{before.slide, before.turn}.append_motion(before.gain * middle + before.offset, X.linear(),
                                                   X.translation());
    X = X * before.X_after;
  }
  Vector6d twist = Vector6d::Zero();
  twist(2) = edge.joints[joint].gain * edge.joints[joint].slide;
  twist(5) = edge.joints[joint].gain * edge.joints[joint].turn;
  return adjoint(X) * twist;
}

/// Joints that another robot has: of the other sense, another axis, or none.
std::vector<std::string> warnings_of_axes(const BodySchema& before, const BodySchema& after) {
  // Chosen: no arm is built so badly.
  constexpr double kOtherAxis = 30 * kDegree, kStill = 0.1;
  std::vector<std::string> result;
  for (std::size_t e = 0; e < before.edges.size(); ++e)
    for (std::size_t d = 0; d < before.edges[e].joints.size(); ++d) {
      const ScrewJoint& joint = before.edges[e].joints[d];
      const Vector6d then = joint_twist(before, before.edges[e], d),
                     now = joint_twist(after, after.edges[e], d);
      const bool turns = std::abs(joint.turn) > std::abs(joint.slide);  // a metre a radian
      const ScrewJoint& refined = after.edges[e].joints[d];
      if (turns && refined.turn == 0 && refined.slide != 0) continue;  // about an axis far away
      const int part = turns ? 3 : 0;
      const Eigen::Vector3d axis = then.segment<3>(part), other = now.segment<3>(part);
      const double angle = std::atan2(axis.cross(other).norm(), axis.dot(other));
      const std::string name = joint_name(before, before.edges[e], joint);
      if (other.norm() < kStill * axis.norm())
        result.push_back(name + " hardly moves by its command");
      else if (angle > std::numbers::pi - kOtherAxis)
        result.push_back(name + " goes the other way round than in the model before");
      else if (angle > kOtherAxis)
        result.push_back(fmt::format("the axis of {} is {:.0f}° from that of the model before",
                                     name, angle / kDegree));
    }
  return result;
}

/// The share of y's sum of squares that x explains, both about their means.
double explained_share(Eigen::VectorXd x, Eigen::VectorXd y) {
  x.array() -= x.mean();
  y.array() -= y.mean();
  const double squares = x.squaredNorm() * y.squaredNorm();
  return squares > 0 ? std::pow(x.dot(y), 2) / squares : 0;
}

/// How far a joint is off its command over the samples, and what that goes with.
struct PlayCause {
  double share = 0;   ///< of its sum of squares
  std::string words;  ///< "" where it is chance
};

/// A command, or the time. `off`: by sample; `commands`: samples × signals.
PlayCause cause_of(const Eigen::VectorXd& off, const Eigen::MatrixXd& commands, int own_signal,
                   const std::vector<Signal>& signals, const std::vector<std::int64_t>& indices,
                   double worth) {
  // Chosen: [nats] over chance, with the price of the sample at which it may have changed, and what
  // is worth a word.
  constexpr double kSure = 10, kMuch = 0.3;
  const auto num = off.size();
  PlayCause result;
  const auto consider = [&](const Eigen::VectorXd& x, double price, const std::string& words) {
    const double share = explained_share(x, off);
    const double gain = -0.5 * worth * static_cast<double>(num) * std::log1p(-share);
    if (share > std::max(kMuch, result.share) && gain > kSure + price) result = {share, words};
  };
  for (Eigen::Index s = 0; s < commands.cols(); ++s)
    if (s != own_signal)
      consider(commands.col(s), 0,
               fmt::format("goes with the command of {}: a coupling, or joints of another kind or "
                           "order",
                           signals[s].name));
  Eigen::VectorXd later = Eigen::VectorXd::Ones(num);
  for (Eigen::Index t = 1; t < num; ++t) {
    later(t - 1) = 0;
    consider(later, std::log(num),
             fmt::format("changes at sample {}: something moved then", indices[t]));
  }
  return result;
}

/// What is no chance the model lacks.
std::vector<std::string> warnings_of_plays(RefinementProblem& problem) {
  constexpr double kLargeShare = 0.1;  // chosen: no joint misses its command so
  std::vector<std::string> result;
  const BodySchema& schema = problem.schema();
  const std::map<std::int64_t, Eigen::VectorXd> plays = problem.plays_by_sample();
  const auto num = std::ssize(plays);
  Eigen::MatrixXd off(num, std::ssize(problem.plays())), commands(num, std::ssize(schema.signals));
  std::vector<std::int64_t> indices;
  for (const auto& [index, play] : plays) {
    off.row(std::ssize(indices)) = play;
    commands.row(std::ssize(indices)) = problem.action_of(index);
    indices.push_back(index);
  }
  const double correlation = problem.serial_correlation();
  const double worth = (1 - correlation) / (1 + correlation);
  const Eigen::VectorXd sd = problem.shown_play_sd();
  for (Eigen::Index n = 0; n < off.cols(); ++n) {
    if (sd(n) == 0) continue;
    const auto [e, d] = problem.plays()[static_cast<std::size_t>(n)];
    const ScrewJoint& joint = schema.edges[e].joints[d];
    const std::string name = joint_name(schema, schema.edges[e], joint);
    const Signal& signal = schema.signals[joint.signal];
    if (const double half = 0.5 * (signal.upper - signal.lower); sd(n) > kLargeShare * half)
      result.push_back(
          fmt::format("{} is off its command by {:.0f} % of half its range: another "
                      "body, or columns in another order",
                      name, 100 * sd(n) / half));
    if (const PlayCause cause =
            cause_of(off.col(n), commands, joint.signal, schema.signals, indices, worth);
        cause.share > 0)
      result.push_back(fmt::format("{:.0f} % of how far {} is off its command {}",
                                   100 * cause.share, name, cause.words));
  }
  return result;
}

}  // namespace

std::vector<std::string> warnings_of_fit(RefinementProblem& problem,
                                         const std::vector<RefinementOutlier>& outliers,
                                         const std::vector<SignalCoverage>& coverage) {
  std::vector<std::string> result;
  std::map<int, int> num_seen, num_refuted;  // by part
  double num_numbers = problem.num_residuals(), num_parameters = 0;
  for (const auto& datum : problem.data()) ++num_seen[datum.part];
  for (const RefinementOutlier& outlier : outliers) ++num_refuted[outlier.part];
  for (const auto& [part, num] : num_refuted)
    if (num > kRefutedShare * num_seen.at(part))
      result.push_back(fmt::format(
          "{} of {} observations of part {} refute the refined model: another body, columns in "
          "another order, other units, or joints that are off their commands",
          num, num_seen.at(part), part));
  if (!problem.has_converged())
    result.emplace_back(
        "the fit has not come to an end: deviations may be wrong; refine the refined schema again");
  if (problem.scale() > kLargeScale)
    result.push_back(fmt::format(
        "residuals are {:.1f} times as large as the noise is told to be: another body, columns in "
        "another order, a base that moves, or too small a --noise",
        problem.scale()));
  // Plays have priors; a moving root's pose takes numbers of its own sample, which more samples
  // have, too.
  constexpr int kPoseNumbers = 6;
  for (const ParameterBlock* block : problem.blocks()) {
    if (block->kind == ParameterBlock::Kind::kInstant)
      num_numbers -= problem.root_moves() ? kPoseNumbers : 0;
    else if (block->is_refined && problem.prior_of(*block).size() == 0)
      num_parameters += problem.num_fitted(*block);
  }
  if (num_numbers < kFewNumbers * num_parameters)
    result.push_back(fmt::format(
        "{:.0f} numbers are fitted by {:.0f} parameters: the model may be worse than before, and "
        "deviations are told too small: more samples",
        num_numbers, num_parameters));
  if (auto warning = warning_of_units(coverage)) result.push_back(std::move(*warning));
  // To corners all joints are fitted so, and what gravity makes of them is no surprise.
  if (!problem.fits_corners())
    std::ranges::move(warnings_of_plays(problem), std::back_inserter(result));
  return result;
}

std::vector<std::string> warnings_of_answer(const BodySchema& start, const Refinement& answer,
                                            const std::vector<RefinerSample>& held_out,
                                            const MeasurementModel& measurement) {
  std::vector<std::string> result = warnings_of_axes(start, answer.schema);
  for (std::string& warning : warnings_of_worse(answer.before, answer.after))
    result.push_back(std::move(warning));
  if (answer.used_corners) return result;
  for (const auto& [part, times] :
       normalized_held_out_errors(answer.schema, held_out, measurement, answer.noise_scale))
    if (times > kSurprising)
      result.push_back(
          fmt::format("held-out poses of part {} are {:.1f} times as far off as is told: the "
                      "deviations are too small, the model lacks something",
                      part, times));
  return result;
}

}  // namespace bodyschema
