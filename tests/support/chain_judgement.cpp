#include "tests/support/chain_judgement.h"

#include <algorithm>
#include <cmath>
#include <set>

namespace bodyschema::test {
namespace {

constexpr std::size_t kLong = 3;
constexpr double kMaxGainError = 0.05;
constexpr double kCommuting = 1e-9;  // [rad, m] of twists of unit turn or slide: numerical zero

std::vector<int> word_of(const Edge& edge) {
  std::vector<int> word;
  for (const ScrewJoint& joint : edge.joints) word.push_back(joint.signal);
  return word;
}

/// Of every joint in the frame of `from`, all displacements 0, scaled to turn (or slide) by 1.
std::vector<Vector6d> unit_twists(const Edge& edge) {
  std::vector<Vector6d> twists;
  Pose X = edge.left;
  for (const ScrewJoint& joint : edge.joints) {
    Vector6d screw;
    screw << 0, 0, joint.slide, 0, 0, joint.turn;
    twists.push_back(adjoint(X) * screw / (joint.turn != 0 ? joint.turn : joint.slide));
    X = X * joint.X_after;
  }
  return twists;
}

/// Pairs of signals with joints whose order matters.
std::set<std::pair<int, int>> ordered_pairs(const Edge& truth) {
  const std::vector<Vector6d> twists = unit_twists(truth);
  std::set<std::pair<int, int>> pairs;
  for (std::size_t i = 0; i < twists.size(); ++i)
    for (std::size_t j = 0; j < i; ++j)
      if ((little_adjoint(twists[i]) * twists[j]).norm() > kCommuting)
        pairs.insert(std::minmax({truth.joints[i].signal, truth.joints[j].signal}));
  return pairs;
}

std::vector<int> restricted(std::vector<int> word, const std::pair<int, int>& letters) {
  std::erase_if(word, [&](int s) { return s != letters.first && s != letters.second; });
  return word;
}

bool is_open(const Edge& edge, const std::pair<int, int>& signals) {
  std::set<int> groups[2];
  for (const ScrewJoint& joint : edge.joints) {
    if (joint.order_group < 0) continue;
    if (joint.signal == signals.first) groups[0].insert(joint.order_group);
    if (joint.signal == signals.second) groups[1].insert(joint.order_group);
  }
  return std::any_of(groups[0].begin(), groups[0].end(),
                     [&](int group) { return groups[1].contains(group); });
}

/// Over the range of its signal [rad], or [m] of a joint that only slides.
double travel(const ScrewJoint& joint, const Signal& signal, bool is_turning) {
  const double way = signal.displacement(signal.upper) - signal.displacement(signal.lower);
  return std::abs((is_turning ? joint.turn : joint.slide) * joint.gain * way);
}

/// The signal of a joint whose gain is off; "" if there is none.
std::string wrong_gain(const Edge& edge, const Edge& truth, const std::vector<Signal>& signals) {
  const bool has_gains = std::any_of(edge.joints.begin(), edge.joints.end(), [](const auto& joint) {
    return joint.turn != 0 || joint.slide != 0;
  });
  if (!has_gains) return "";
  std::set<std::size_t> told;
  for (const ScrewJoint& joint : edge.joints) {
    const Signal& signal = signals.at(static_cast<std::size_t>(joint.signal));
    if (!signal.warp.empty()) continue;
    bool is_found = false;
    for (std::size_t d = 0; d < truth.joints.size() && !is_found; ++d) {
      const ScrewJoint& of_truth = truth.joints[d];
      if (of_truth.signal != joint.signal || told.contains(d)) continue;
      const bool is_turning = of_truth.turn != 0;
      const double expected = travel(of_truth, signal, is_turning);
      is_found = std::abs(travel(joint, signal, is_turning) - expected) <= kMaxGainError * expected;
      if (is_found) told.insert(d);
    }
    if (!is_found) return signal.name;
  }
  return "";
}

}  // namespace

void TrueChain::move(const Pose& X) {
  Pose& last = edge_.joints.empty() ? edge_.left : edge_.joints.back().X_after;
  last = last * X;
}

void TrueChain::add(int signal, double slide, double turn, double zero) {
  edge_.joints.push_back({.signal = signal, .offset = -zero, .slide = slide, .turn = turn});
}

ChainVerdict judge_chain(const Edge& edge, const Edge& truth, const std::vector<Signal>& signals) {
  if (truth.joints.size() < kLong) return {};
  std::vector<int> found = word_of(edge), expected = word_of(truth);
  const bool has_signals =
      std::is_permutation(found.begin(), found.end(), expected.begin(), expected.end());
  if (!has_signals) return {Rightness::kWrong, "has the wrong joints"};
  std::string open;
  for (const auto& pair : ordered_pairs(truth)) {
    const std::string names = signals.at(static_cast<std::size_t>(pair.first)).name + " and " +
                              signals.at(static_cast<std::size_t>(pair.second)).name;
    if (is_open(edge, pair))
      open = "leaves the order of " + names + " open";
    else if (restricted(found, pair) != restricted(expected, pair))
      return {Rightness::kWrong, "has " + names + " in the wrong order"};
  }
  if (const std::string signal = wrong_gain(edge, truth, signals); !signal.empty())
    return {Rightness::kWrong, "has a wrong gain of " + signal};
  return open.empty() ? ChainVerdict{} : ChainVerdict{Rightness::kIncomplete, open};
}

}  // namespace bodyschema::test
