#include "processes/structure_learner/long_chain/long_chain.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <random>

#include "common/estimation/chi_square.h"
#include "common/estimation/quantile.h"
#include "processes/structure_learner/long_chain/chain_positions.h"
#include "processes/structure_learner/long_chain/chain_rotations.h"
#include "processes/structure_learner/placed_screw.h"
#include "processes/structure_learner/screen.h"

namespace bodyschema {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

constexpr int kSearchFrames = 40;
constexpr int kSearchPositions = 60;
constexpr int kHeldStarts = 8;
constexpr int kFitIterations = 60;
// The median angle of three axes is 1.54 σ; heavy tails and what is systematic are above that.
constexpr double kGoal = 3;
// Turn of all joints at half range [rad]: of ranges of 60° to 240°, 12 of 12 random arms of seven
// joints with gains of their own were found from it in unknown order, 1.5 likewise.
constexpr double kTypicalTurn = 1.2;
// Turns below which a joint may slide [rad per half range].
constexpr double kMaySlide = 0.12;
// Nats between two orders that are told apart.
constexpr double kSettledMargin = 3;
// Nats below which an order is open. Chosen: of a range check with two poses of all joints, which
// are wrong in both orders, these differ by 1 to 9.5.
constexpr double kOpenMargin = 10;
// Nats a sight.
constexpr double kLeastPay = 0.5;

Pose translation(const Vector3d& p) {
  Pose X = Pose::Identity();
  X.translation() = p;
  return X;
}

Pose rotation(const Matrix3d& R) {
  Pose X = Pose::Identity();
  X.linear() = R;
  return X;
}

// The links (links_design()) by re-weighted least squares; slides take the place of turns.
LocalModel place(const ChainAxes& chain, const std::vector<bool>& slides, const PairData& pair,
                 const NormalizedActions& actions, double sigma_m) {
  constexpr int kRounds = 8;
  const int m = static_cast<int>(chain.signals.size()), n = pair.size();
  Eigen::MatrixXd q(actions.num_signals(), n);
  Eigen::VectorXd positions(3 * n);
  for (int t = 0; t < n; ++t) {
    for (const int s : chain.signals) q(s, t) = actions(pair.frames[t].sample, s);
    positions.segment<3>(3 * t) = pair.primary(t).z.translation();
  }
  const Eigen::MatrixXd design = links_design(chain, slides, q);
  Eigen::VectorXd x, weights = Eigen::VectorXd::Ones(3 * n);
  for (int round = 0; round < kRounds; ++round) {
    Eigen::MatrixXd H = design.transpose() * weights.asDiagonal() * design;
    H.diagonal().array() += std::pow(sigma_m / kLongestLink, 2);
    x = H.ldlt().solve(design.transpose() * weights.cwiseProduct(positions));
    const Eigen::VectorXd residual = positions - design * x;
    for (int t = 0; t < n; ++t)
      weights.segment<3>(3 * t).setConstant(
          1 / std::max(1.0, residual.segment<3>(3 * t).norm() / (2 * sigma_m)));
  }
  LocalModel model;
  model.is_position = pair.num_residuals() == 3;
  model.first = translation(x.head<3>());
  int slide_at = 3 * (m + 1);
  for (int j = 0; j < m; ++j) {
    Vector6d xi = Vector6d::Zero();
    if (slides[j]) {
      xi.head<3>() = x.segment<3>(slide_at);
      slide_at += 3;
    } else {
      xi.tail<3>() = chain.axes[j];
    }
    const PlacedScrew placed = PlacedScrew::of(xi, slides[j]);
    model.transform(j) = model.transform(j) * placed.X;
    model.joints.push_back(
        {.signal = chain.signals[j],
         .slide = placed.screw.slide,
         .turn = placed.screw.turn,
         .X_after = placed.X.inverse() * translation(x.segment<3>(3 * (j + 1)))});
  }
  model.transform(m) = model.transform(m) * rotation(chain.R_end);
  return model;
}

std::vector<bool> sliding(const ChainAxes& chain) {
  std::vector<bool> slides;
  for (const Vector3d& axis : chain.axes) slides.push_back(axis.norm() < kMaySlide);
  return slides;
}

// All together, from the better of: joints that hardly turn slide; they turn.
Fit refined(const ChainAxes& chain, const PairData& pair, const NormalizedActions& actions,
            double sigma_m) {
  std::optional<Fit> best;
  std::vector<bool> slides = sliding(chain);
  for (const bool any_slides : {true, false}) {
    if (!any_slides && std::count(slides.begin(), slides.end(), true) == 0) break;
    if (!any_slides) slides.assign(slides.size(), false);
    Fit fit = fit_local_model(place(chain, slides, pair, actions, sigma_m), pair, actions,
                              kFitIterations, 1e-2);
    if (!best || fit.cost < best->cost) best = std::move(fit);
  }
  return *std::move(best);
}

// Rotations do not order joints with parallel axes, nor those that slide: moves one joint at a time
// to the place at which the positions, linear in the links, fit best.
ChainAxes ordered_by_positions(ChainAxes chain, const RotationSearch& search, const PairData& pair,
                               const NormalizedActions& actions, double sigma_m) {
  constexpr int kMaxSweeps = 3;
  constexpr double kSameRotations = 1.2;  // of the cost
  const auto cost_of = [&](const ChainAxes& c) {
    return evaluate(place(c, sliding(c), pair, actions, sigma_m), pair, actions).cost;
  };
  double cost = cost_of(chain);
  const int m = static_cast<int>(chain.signals.size());
  for (int sweep = 0; sweep < kMaxSweeps; ++sweep) {
    const double before = cost;
    for (int from = 0; from < m; ++from)
      for (int to = 0; to < m; ++to) {
        if (to == from || to == from - 1) continue;  // the neighbours' exchange once
        ChainAxes moved = chain;
        move_element(&moved.signals, from, to);
        move_element(&moved.axes, from, to);
        moved = search.fit(std::move(moved), false, 10);
        if (moved.cost > kSameRotations * chain.cost) continue;
        const double other = cost_of(moved);
        if (other >= cost) continue;
        cost = other;
        chain = std::move(moved);
      }
    if (cost >= before - 1) break;
  }
  return chain;
}

// |w_j| if every joint turned by `gain` per command unit.
std::vector<double> lengths_of(const std::vector<int>& signals, const NormalizedActions& actions,
                               double gain) {
  std::vector<double> result;
  for (const int s : signals) result.push_back(gain * actions.half_range(s));
  return result;
}

// Lengths |w_j| to hold: of 1 rad and of 1° per command unit, where joints then turn at all and not
// many times; and the same turn for all, whatever their units.
std::vector<std::vector<double>> held_lengths(const std::vector<int>& signals,
                                              const NormalizedActions& actions) {
  constexpr double kLeast = 0.2, kMost = 7;
  std::vector<std::vector<double>> result;
  for (const double gain : {1.0, M_PI / 180}) {
    std::vector<double> lengths = lengths_of(signals, actions, gain);
    const double largest = *std::max_element(lengths.begin(), lengths.end());
    if (largest > kLeast && largest < kMost) result.push_back(std::move(lengths));
  }
  result.push_back(std::vector<double>(signals.size(), kTypicalTurn));
  return result;
}

ChainAxes find_axes(ChainSearch* search, const NormalizedActions& actions,
                    const std::vector<int>& listed, JointOrder order, double goal) {
  ChainAxes best;
  const auto is_found_by = [&](ChainAxes found) {
    found = search->fit(std::move(found), false, kFitIterations);
    if (best.signals.empty() || found.cost < best.cost) best = std::move(found);
    return best.median_left < goal;
  };
  const std::vector<int> reversed(listed.rbegin(), listed.rend());
  for (const std::vector<int>& signals : {listed, reversed})
    for (const std::vector<double>& lengths : held_lengths(signals, actions))
      if (is_found_by(search->best_of(signals, lengths, kHeldStarts))) return best;
  if (is_found_by(search->best_of(listed, {}, search->free_starts()))) return best;
  if (order == JointOrder::kListed) return best;
  if (best.median_left < search->nearly_nothing()) return search->with_joints_moved(best);
  for (int restart = 0; restart < search->num_orders(static_cast<int>(listed.size())); ++restart)
    for (const std::vector<double>& lengths : held_lengths(listed, actions))
      if (is_found_by(search->best_order(listed, lengths, goal))) return best;
  return best;
}

LocalModel without_joint(const LocalModel& model, int d) {
  LocalModel result = model;
  result.transform(d) = result.transform(d) * model.joints[d].X_after;
  result.joints.erase(result.joints.begin() + d);
  return result;
}

Pose screw_pose(const LocalModel::Joint& joint, double q) {
  return Eigen::Translation3d(0, 0, joint.slide * q) *
         Eigen::AngleAxisd(joint.turn * q, Vector3d::UnitZ());
}

// Joints d and d + 1 in the other order, each about its own axis as it is where both signals have
// the values `rest`: the same motion as long as one of them does.
LocalModel with_exchanged(const LocalModel& model, int d, const Eigen::Vector2d& rest) {
  LocalModel result = model;
  const LocalModel::Joint &one = model.joints[d], &other = model.joints[d + 1];
  const Pose between = screw_pose(one, rest(0)) * one.X_after;
  result.transform(d) = result.transform(d) * between;
  std::swap(result.joints[d], result.joints[d + 1]);
  result.joints[d].X_after = screw_pose(other, -rest(1)) * between.inverse();
  result.joints[d + 1].X_after =
      screw_pose(one, -rest(0)) * between * screw_pose(other, rest(1)) * other.X_after;
  return result;
}

// What a signal is at most frames.
double usual_value(int signal, const PairData& pair, const NormalizedActions& actions) {
  std::vector<double> values;
  for (const PairFrame& frame : pair.frames) values.push_back(actions(frame.sample, signal));
  return median(std::move(values));
}

// By how much one fit costs more than another where either has the pose: by how far both are off at
// the others they are not told apart.
double excess_cost(const Fit& one, const Fit& other) {
  double sum = 0;
  for (std::size_t t = 0; t < one.frames.size(); ++t) {
    const FrameFit &a = one.frames[t], &b = other.frames[t];
    if (std::min(a.squared_distance, b.squared_distance) < outlier_threshold(a.num_residuals))
      sum += a.cost() - b.cost();
  }
  return sum;
}

// Whether two models of the same signals are one wherever these move within their ranges, as far as
// a marker's noise tells.
bool predict_alike(const LocalModel& one, const LocalModel& other, const PairData& pair) {
  constexpr int kActions = 64;
  std::mt19937 rng(1);
  std::vector<ActionPoseSample> samples(kActions);
  int num_signals = 0;
  for (const LocalModel::Joint& joint : one.joints)
    num_signals = std::max(num_signals, joint.signal + 1);
  for (int n = 0; n < kActions; ++n) {
    samples[n].action.resize(num_signals);
    // The ends first: they are the range that NormalizedActions scales by.
    for (double& value : samples[n].action)
      value = n < 2 ? 2 * n - 1 : 2.0 * static_cast<double>(rng()) / std::mt19937::max() - 1;
  }
  const NormalizedActions actions(samples, num_signals);
  const RelativeMotions noise = relative_motions(pair, 1);
  double sum = 0;
  for (int n = 0; n < kActions; ++n) {
    const Vector6d apart = log(one.predict(actions, n).inverse() * other.predict(actions, n));
    sum += (apart.head<3>() / noise.sigma_m).squaredNorm() / 3;
    if (!one.is_position) sum += (apart.tail<3>() / noise.sigma_rad).squaredNorm() / 3;
  }
  constexpr double kAlike = 2;  // standard deviations; chosen
  return sum < kAlike * kAlike * (one.is_position ? 1 : 2) * kActions;
}

// Joint d without its turn, in the direction in which it moves what follows it.
LocalModel with_slide(const LocalModel& model, int d) {
  LocalModel result = model;
  LocalModel::Joint& joint = result.joints[d];
  const Vector3d p = joint.X_after.translation();
  const Vector3d v = joint.slide * Vector3d::UnitZ() + joint.turn * Vector3d::UnitZ().cross(p);
  Vector6d xi = Vector6d::Zero();
  xi.head<3>() = v;
  const PlacedScrew placed = PlacedScrew::of(xi, true);
  result.transform(d) = result.transform(d) * translation(p) * placed.X;
  joint.X_after = placed.X.inverse() * rotation(joint.X_after.linear());
  joint.slide = v.norm();
  joint.turn = 0;
  joint.slides = true;
  return result;
}

// What so many parameters must explain [nats]: more than chance (Schwarz 1978), and more than what
// is below the noise of every single sight.
double price(int num_parameters, const PairData& pair) {
  return std::max(0.5 * num_parameters * std::log(6.0 * pair.size()), kLeastPay * pair.size());
}

}  // namespace

std::optional<Fit> fit_long_chain(const PairData& pair, const NormalizedActions& actions,
                                  const std::vector<int>& signals, JointOrder order, double noise) {
  const int m = static_cast<int>(signals.size());
  if (m == 0 || m > kMaxChainJoints || pair.size() < 2 * m) return std::nullopt;
  const double sigma_m = relative_motions(pair, 1).sigma_m;
  if (pair.num_residuals() == 3) {
    PositionSearch search(pair, actions, kSearchPositions, sigma_m);
    return refined(find_axes(&search, actions, signals, order, kGoal * noise), pair, actions,
                   sigma_m);
  }
  RotationSearch search(pair, actions, kSearchFrames);
  const ChainAxes axes = find_axes(&search, actions, signals, order, kGoal * noise);
  Fit fit = refined(axes, pair, actions, sigma_m);
  if (fit.cost < kRightCost * pair.size()) return fit;
  Fit ordered =
      refined(ordered_by_positions(axes, search, pair, actions, sigma_m), pair, actions, sigma_m);
  return ordered.cost < fit.cost ? ordered : fit;
}

double price_of_joint(const PairData& pair) { return price(6, pair); }

Fit without_idle_joints(Fit fit, const PairData& pair, const NormalizedActions& actions) {
  while (fit.model.num_joints() > 0) {
    std::optional<Fit> best;
    for (int d = 0; d < fit.model.num_joints(); ++d) {
      Fit without = fit_local_model(without_joint(fit.model, d), pair, actions, 15, 1e-1);
      if (!best || without.cost < best->cost) best = std::move(without);
    }
    if (best->cost - fit.cost > price_of_joint(pair)) break;
    fit = fit_local_model(best->model, pair, actions, kFitIterations, 1e-2);
  }
  return fit;
}

Fit with_pure_slides(Fit fit, const PairData& pair, const NormalizedActions& actions) {
  for (int d = 0; d < fit.model.num_joints(); ++d) {
    if (fit.model.joints[d].slides || std::abs(fit.model.joints[d].turn) > kMaySlide) continue;
    Fit sliding = fit_local_model(with_slide(fit.model, d), pair, actions, kFitIterations, 1e-2);
    if (sliding.cost - fit.cost > price(3, pair)) continue;
    fit = std::move(sliding);
    d = -1;  // one that it was mixed up with may slide now
  }
  return fit;
}

Fit with_settled_order(Fit fit, const PairData& pair, const NormalizedActions& actions) {
  const int last = fit.model.num_joints() - 1;
  std::vector<bool> is_open(std::max(last, 0));
  for (int d = 0; d < last; ++d) {
    const int one = fit.model.joints[d].signal, other = fit.model.joints[d + 1].signal;
    if (one == other) continue;
    const LocalModel exchanged = with_exchanged(
        fit.model, d, {usual_value(one, pair, actions), usual_value(other, pair, actions)});
    // Joints that commute have no order.
    if (predict_alike(fit.model, exchanged, pair)) continue;
    Fit rival = fit_local_model(exchanged, pair, actions, kFitIterations, 1e-2);
    const double excess = std::min(rival.cost - fit.cost, excess_cost(rival, fit));
    if (rival.cost < fit.cost - kSettledMargin) {
      fit = std::move(rival);
      d = std::max(d - 2, -1);  // what is in front may have to move on
      continue;
    }
    is_open[d] = excess < kOpenMargin && !predict_alike(fit.model, rival.model, pair);
  }
  for (LocalModel::Joint& joint : fit.model.joints) joint.order_group = -1;
  int group = -1;
  for (int d = 0; d < last; ++d) {
    if (!is_open[d]) continue;
    if (d == 0 || !is_open[d - 1]) ++group;
    fit.model.joints[d].order_group = fit.model.joints[d + 1].order_group = group;
  }
  return fit;
}

}  // namespace bodyschema
