#include "processes/structure_learner/second_place.h"

#include <algorithm>
#include <iterator>
#include <limits>
#include <set>
#include <vector>

#include "common/estimation/quantile.h"
#include "processes/structure_learner/screen.h"

namespace bodyschema {
namespace {

// Chosen: wild readings of fewer samples, or of a smaller share, cost a model little.
constexpr int kFewest = 5;
constexpr double kLeastShare = 0.08;
// Of the outliers that are in the place, and most of the other samples that may be there by chance.
constexpr double kLeastInPlace = 0.5, kMostByChance = 0.1;
// Standard deviations of its position from which on it is another place, and no turn of the tag.
constexpr double kApart = 5;

PairData pair_of(int part, int other, const EdgeData& data) {
  return make_pair_data(data.samples, part, other, data.measurement,
                        std::numeric_limits<int>::max());
}

const PairHypothesis& reading(const PairData& pair, int frame) {
  return pair.hypotheses[static_cast<std::size_t>(
      pair.frames[static_cast<std::size_t>(frame)].first_hypothesis)];
}

// Frames among these that are where one of them is, as far as noise tells: the most there are.
std::vector<int> largest_group(const PairData& pair, const std::vector<int>& frames,
                               const std::vector<int>& among) {
  std::vector<int> largest;
  for (const int centre : among) {
    std::vector<int> group;
    for (const int frame : frames) {
      const PairHypothesis& h = reading(pair, frame);
      const Pose inverse = reading(pair, centre).z.inverse();
      // Both have noise.
      if (h.whitened(h.error(inverse), inverse.inverse()).squaredNorm() <
          2 * outlier_threshold(h.num_residuals))
        group.push_back(frame);
    }
    if (group.size() > largest.size()) largest = std::move(group);
  }
  return largest;
}

}  // namespace

bool keeps_to_second_place(const FittedEdge& fitted, const EdgeData& data) {
  std::set<int> outlying;  // samples
  for (std::size_t t = 0; t < fitted.frames.size(); ++t)
    if (fitted.outlying[t]) outlying.insert(fitted.frames[t]);
  const auto num = static_cast<double>(outlying.size());
  if (num < kFewest || num < kLeastShare * static_cast<double>(fitted.frames.size()) ||
      data.actions.blocks().is_stream())
    return false;
  const Edge& edge = fitted.edge;
  const PairData own = pair_of(edge.from, edge.to, data);
  const double apart_m = kApart * relative_motions(own, 1).sigma_m;
  std::set<int> elsewhere;  // of the outliers, by their positions
  for (int t = 0; t < own.size(); ++t) {
    const int sample = own.frames[static_cast<std::size_t>(t)].sample;
    const Pose X = edge.predict(data.samples[static_cast<std::size_t>(sample)].action);
    if (outlying.contains(sample) &&
        (X.translation() - reading(own, t).z.translation()).norm() > apart_m)
      elsewhere.insert(sample);
  }
  for (const int part : seen_parts(data.samples)) {
    if (part == edge.to) continue;
    const PairData pair = part == edge.from ? own : pair_of(part, edge.to, data);
    std::vector<int> wrong, right;
    for (int t = 0; t < pair.size(); ++t) {
      const int sample = pair.frames[static_cast<std::size_t>(t)].sample;
      if (elsewhere.contains(sample)) wrong.push_back(t);
      if (!outlying.contains(sample)) right.push_back(t);
    }
    const std::vector<int> group = largest_group(pair, wrong, wrong);
    if (static_cast<double>(group.size()) < std::max<double>(kFewest, kLeastInPlace * num))
      continue;
    const std::vector<int> by_chance = largest_group(pair, right, {group.front()});
    if (static_cast<double>(by_chance.size()) < kMostByChance * static_cast<double>(right.size()))
      return true;
  }
  return false;
}

}  // namespace bodyschema
