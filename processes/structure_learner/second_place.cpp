#include "processes/structure_learner/second_place.h"

#include <algorithm>
#include <iterator>
#include <limits>
#include <set>
#include <vector>

#include "common/kinematics/screw_chain.h"
#include "processes/structure_learner/screen.h"

namespace bodyschema {
namespace {

// Chosen: wild readings of fewer samples, or of a smaller share, cost a model little.
constexpr int kFewest = 5;
constexpr double kLeastShare = 0.03;
// Of the outliers that are in the place, and most of the other samples that may be there by chance.
constexpr double kLeastInPlace = 0.5, kMostByChance = 0.1;
// Standard deviations of its position from which on it is another place, and no turn of the tag.
constexpr double kApart = 5;

constexpr int kAll = std::numeric_limits<int>::max();
// Turn [rad] of a tag that is read turned over, at least: of one that is seen 20° from its normal.
constexpr double kLeastFlip = 0.7;
// Sights among which it is looked for where a part rests: a test for each two.
constexpr int kSearched = 200;

// A part as seen from something, at a sample.
struct Sight {
  int sample = 0;
  Pose X;
  const PairHypothesis* reading = nullptr;
  Pose X_SB = Pose::Identity();  // of the part in the frame that X ends in
};

Matrix6d covariance_of(const Sight& sight) {
  const Matrix6d& W = sight.reading->whitening;
  const Matrix6d Ad = adjoint(sight.X_SB);
  return Ad * (W.transpose() * W).inverse() * Ad.transpose();
}

// As far as noise tells, both having it.
bool is_same_place(const Sight& one, const Sight& other) {
  const Vector6d apart = log(one.X.inverse() * other.X);
  const int num_residuals = other.reading->num_residuals;
  if (num_residuals == 6 && one.reading->num_residuals == 6)
    return squared_mahalanobis(apart, covariance_of(one) + covariance_of(other)) <
           outlier_threshold(6);
  return other.reading->whitened(apart, one.X).squaredNorm() < 2 * outlier_threshold(num_residuals);
}

// By what each link of an edge but the last would have to be off for the part to be where it was
// seen, Δ in X = B Δ X_SB; of the first where no tag is read turned over: that of the part that it
// begins at is `confirmed`, that beyond is turned too little. `beside`: the same of the last.
std::vector<std::vector<Sight>> changes_of_links(const Edge& edge, const EdgeData& data,
                                                 const std::vector<Sight>& beside,
                                                 const std::set<int>& confirmed) {
  std::vector<std::vector<Sight>> result(edge.joints.size(), beside);
  for (std::size_t n = 0; n < beside.size(); ++n) {
    const Eigen::VectorXd& theta = data.samples[static_cast<std::size_t>(beside[n].sample)].action;
    const Pose X = edge.predict(theta);
    Pose B = edge.left;
    for (std::size_t d = 0; d < edge.joints.size(); ++d) {
      Sight& sight = result[d][n];
      sight.X_SB = B.inverse() * X;
      sight.X = sight.X_SB * beside[n].X * sight.X_SB.inverse();
      const ScrewJoint& joint = edge.joints[d];
      Screw{joint.slide, joint.turn}.append_motion(joint.gain * theta(joint.signal) + joint.offset,
                                                   B.linear(), B.translation());
      B = B * joint.X_after;
    }
  }
  if (!result.empty())
    std::erase_if(result.front(), [&](const Sight& sight) {
      return !confirmed.contains(sight.sample) || log(sight.X).tail<3>().norm() > kLeastFlip;
    });
  return result;
}

// The most of these that are in one place.
std::vector<Sight> largest_group(const std::vector<Sight>& sights) {
  std::vector<Sight> largest;
  for (const Sight& centre : sights) {
    std::vector<Sight> group;
    std::ranges::copy_if(sights, std::back_inserter(group),
                         [&](const Sight& sight) { return is_same_place(centre, sight); });
    if (group.size() > largest.size()) largest = std::move(group);
  }
  return largest;
}

// They point to what is read in the pair.
std::vector<Sight> sights_of(const PairData& pair) {
  std::vector<Sight> sights;
  for (const PairFrame& frame : pair.frames) {
    const PairHypothesis& h = pair.hypotheses[static_cast<std::size_t>(frame.first_hypothesis)];
    sights.push_back({frame.sample, h.z, &h});
  }
  return sights;
}

// The samples at which an edge to the part has it right, or at which it is where it mostly is.
std::set<int> confirmed_samples(int part, const EdgeData& data,
                                const std::vector<FittedEdge>& before) {
  std::set<int> result;
  for (const FittedEdge& fitted : before)
    for (std::size_t t = 0; fitted.edge.to == part && t < fitted.frames.size(); ++t)
      if (!fitted.outlying[t]) result.insert(fitted.frames[t]);
  const PairData some = make_part_data(data.samples, part, data.measurement, kSearched);
  const std::vector<Sight> resting = largest_group(sights_of(some));
  if (2 * std::ssize(resting) <= some.size()) return result;
  const PairData all = make_part_data(data.samples, part, data.measurement, kAll);
  for (const Sight& sight : sights_of(all))
    if (is_same_place(resting.front(), sight)) result.insert(sight.sample);
  return result;
}

}  // namespace

bool keeps_to_second_place(const FittedEdge& fitted, const EdgeData& data,
                           const std::vector<FittedEdge>& before) {
  std::set<int> outlying;  // samples
  for (std::size_t t = 0; t < fitted.frames.size(); ++t)
    if (fitted.outlying[t]) outlying.insert(fitted.frames[t]);
  const auto num = static_cast<double>(outlying.size());
  if (num < kFewest || num < kLeastShare * static_cast<double>(fitted.frames.size()) ||
      data.actions.blocks().is_stream())
    return false;
  const Edge& edge = fitted.edge;
  std::set<int> elsewhere;  // of the outliers, by their positions
  const auto has_second_place = [&](const std::vector<Sight>& sights) {
    std::vector<Sight> wrong, right;
    for (const Sight& sight : sights) {
      if (elsewhere.contains(sight.sample)) wrong.push_back(sight);
      if (!outlying.contains(sight.sample)) right.push_back(sight);
    }
    const std::vector<Sight> group = largest_group(wrong);
    if (static_cast<double>(group.size()) < std::max<double>(kFewest, kLeastInPlace * num))
      return false;
    const auto by_chance = std::ranges::count_if(
        right, [&](const Sight& sight) { return is_same_place(group.front(), sight); });
    return static_cast<double>(by_chance) < kMostByChance * static_cast<double>(right.size());
  };
  const PairData own = make_pair_data(data.samples, edge.from, edge.to, data.measurement, kAll);
  const double apart_m = kApart * relative_motions(own, 1).sigma_m;
  // As seen from where the model has it.
  std::vector<Sight> beside = sights_of(own);
  for (Sight& sight : beside) {
    const Pose X = edge.predict(data.samples[static_cast<std::size_t>(sight.sample)].action);
    sight.X = X.inverse() * sight.X;
    if (outlying.contains(sight.sample) && sight.X.translation().norm() > apart_m)
      elsewhere.insert(sight.sample);
  }
  if (has_second_place(beside)) return true;
  const std::set<int> confirmed = confirmed_samples(edge.from, data, before);
  if (own.num_residuals() == 6 &&
      std::ranges::any_of(changes_of_links(edge, data, beside, confirmed), has_second_place))
    return true;
  for (const int part : seen_parts(data.samples)) {
    if (part == edge.to) continue;
    const PairData pair = make_pair_data(data.samples, part, edge.to, data.measurement, kAll);
    if (has_second_place(sights_of(pair))) return true;
  }
  return false;
}

}  // namespace bodyschema
