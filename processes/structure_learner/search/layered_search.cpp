#include "processes/structure_learner/search/layered_search.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <tuple>

#include "processes/structure_learner/turn_scan.h"

namespace bodyschema {
namespace {

// Starts whose mean robust cost a frame is above these are beyond repair by a local fit. (A frame
// at the squared distance d² costs 5 log(1 + d²/4).)
constexpr double kMaxScrewStartCost = 26;
// Starts that cost more than this are taken only if the bulk of the frames is near them: by their
// median squared distance (χ²₆ has 5.35), from kSomeFrames on. A start's error is that of the
// typical frame: where a few frames are known much better, a right one has a median of 100.
constexpr double kGoodStartCost = 20;
constexpr double kMaxStartMedian = 30;
constexpr double kMaxFewFramesMedian = 100;
constexpr int kSomeFrames = 10;
constexpr int kManyFrames = 20;

// With 60 % of wild readings a true start costs so much. (At 1 m from where it should be, with 3 mm
// of noise, a frame costs 48.)
constexpr double kMaxWildStartCost = 34;

// Beyond what a local fit mends, by the bulk of the frames.
bool is_hopeless(const Start& start, int num_frames, const ValidityOptions& options) {
  if (options.allows_far_outliers) return start.score > kMaxWildStartCost;
  return start.score > kMaxScrewStartCost ||
         (num_frames >= kSomeFrames && start.score > kGoodStartCost &&
          start.median > (num_frames >= kManyFrames ? kMaxStartMedian : kMaxFewFramesMedian));
}

void sort_by_quality(std::vector<Candidate>* candidates) {
  std::stable_sort(candidates->begin(), candidates->end(), [](const auto& x, const auto& y) {
    return std::tuple(x.model.num_joints(), y.score, x.part_i, x.part_j) <
           std::tuple(y.model.num_joints(), x.score, y.part_i, y.part_j);
  });
}

}  // namespace

std::vector<std::vector<double>> known_turns(const ModelForest& forest, int num_signals,
                                             const std::vector<double>& grid) {
  std::vector<std::vector<double>> turns(static_cast<std::size_t>(num_signals));
  for (const AcceptedModel& m : forest.models())
    for (int d = 0; d < m.model.num_joints(); ++d)
      if (std::abs(m.model.joints[d].turn) > 0.1)
        turns[m.model.joints[d].signal].push_back(std::abs(m.model.joints[d].turn));
  for (auto& t : turns)
    if (t.empty()) t = grid;
  return turns;
}

void LayeredSearch::run(int first_layer) {
  doubtful_.clear();
  for (int k = first_layer;
       k <= std::min(pairs_.options().max_signals, kMaxScreenedJoints) && !forest_.spans(); ++k) {
    if (k == 0) layer_rigid();
    if (k == 1) layer_one_joint();
    if (k == 2) layer_two_joints();
  }
  sort_by_quality(&doubtful_);
  for (Candidate& c : doubtful_)
    if (!forest_.connected(c.part_i, c.part_j) && !is_smaller_undecided(c) &&
        pairs_.confirm_on_all_data(&c))
      forest_.add(c);
}

void LayeredSearch::decide(std::vector<Candidate> valid, std::vector<Candidate>* candidates) {
  if (valid.empty()) return;
  std::stable_sort(valid.begin(), valid.end(),
                   [](const auto& x, const auto& y) { return x.score > y.score; });
  const Candidate& best = valid.front();
  for (const Candidate& other : valid) {
    if (signal_set(other.model) == signal_set(best.model)) continue;
    if ((best.score - other.score) * best.num_frames < kAmbiguityMargin) {
      pairs_.record(best.part_i, best.part_j)
          .note_undecided(other.model.num_joints(), other.mean_capped);
      pairs_.note_look_alikes(best, other);
      return;
    }
  }
  candidates->push_back(best);
}

void LayeredSearch::connect(std::vector<Candidate> candidates) {
  sort_by_quality(&candidates);
  for (const Candidate& c : candidates) {
    num_judged_ += c.num_frames;
    num_outliers_ += c.num_outliers;
  }
  // Fewer outliers in all than the assumed rate would bring: then many on one model speak against
  // it.
  is_clean_ = num_outliers_ <
              binomial_quantile(num_judged_, pair_outlier_rate(pairs_.options().validity), 0.02);
  for (Candidate& c : candidates) {
    if (forest_.connected(c.part_i, c.part_j)) {
      spare_.push_back(c);
    } else if ((is_clean_ && c.doubtful) || is_smaller_undecided(c)) {
      pairs_.record(c.part_i, c.part_j).note_undecided(c.model.num_joints(), c.mean_capped);
      doubtful_.push_back(c);
    } else if (pairs_.confirm_on_all_data(&c)) {
      forest_.add(c);
    }
  }
}

// Is a smaller model between the same components undecided, and not clearly worse than this one?
bool LayeredSearch::is_smaller_undecided(const Candidate& c) {
  const int k = c.model.num_joints();
  for (const int x : forest_.members(c.part_i))
    for (const int y : forest_.members(c.part_j))
      for (const auto& [smaller, mean_capped] : pairs_.record(x, y).undecided)
        if (smaller < k && (!is_clean_ || c.num_frames * (mean_capped - c.mean_capped) <
                                              6 * (k - smaller) * std::log(6.0 * c.num_frames)))
          return true;
  return false;
}

template <typename Visitor>
void LayeredSearch::for_each_open_pair(Visitor&& visit) {
  for (const auto& [ij, record] : pairs_.records())
    if (!forest_.connected(ij.first, ij.second) && record.num_common >= 2)
      visit(ij.first, ij.second);
}

void LayeredSearch::layer_rigid() {
  std::vector<Candidate> candidates;
  for_each_open_pair([&](int i, int j) {
    ++pairs_.num_screens;
    const Start start = screen_rigid(pairs_.pair(i, j), pairs_.actions());
    if (pairs_.options().validity.allows_far_outliers ? start.score > kMaxWildStartCost
                                                      : start.score > kMaxRigidStartCost)
      return;
    if (const auto c = pairs_.try_start(i, j, start.model)) candidates.push_back(*c);
  });
  connect(std::move(candidates));
}

void LayeredSearch::layer_one_joint() {
  constexpr std::size_t kMaxFits = 3;
  std::vector<Candidate> candidates;
  for_each_open_pair([&](int i, int j) {
    const PairData& pair = pairs_.pair(i, j);
    const RelativeMotions& motions = pairs_.motions(i, j);
    const auto regressions = screen_one_joint(motions, pairs_.actions());
    pairs_.num_screens += static_cast<int>(regressions.size());
    if (!regressions.empty()) one_joint_score_[{i, j}] = regressions.front().score;
    std::vector<Candidate> valid;
    for (std::size_t n = 0; n < std::min(kMaxFits, regressions.size()); ++n) {
      if (n >= 1 && regressions[n].score > 1.5 * regressions[0].score) break;
      const Start start =
          one_joint_start(regressions[n], pair, pairs_.actions(), motions.sigma_rad);
      if (is_hopeless(start, pair.size(), pairs_.options().validity)) continue;
      if (const auto c = pairs_.try_start(i, j, start.model)) valid.push_back(*c);
    }
    if (valid.empty()) {
      for (const Start& start : screen_wide_joint(pair, pairs_.actions(), motions)) {
        ++pairs_.num_screens;
        if (is_hopeless(start, pair.size(), pairs_.options().validity)) continue;
        if (const auto c = pairs_.try_start(i, j, start.model)) valid.push_back(*c);
      }
    }
    decide(std::move(valid), &candidates);
  });
  connect(std::move(candidates));
}

void LayeredSearch::layer_two_joints() {
  const Turns grid(pairs_.actions().num_signals(), default_turns());
  const Turns known = known_turns(forest_, pairs_.actions().num_signals(), default_turns());
  // Where parts are many, few pairs of each component first.
  constexpr std::size_t kMaxParts = 14, kNearPairs = 12, kFarPairs = 300;
  constexpr std::size_t kAllPairs = std::numeric_limits<std::size_t>::max();
  const bool is_large = forest_.parts().size() > kMaxParts;
  for (const std::size_t most :
       {is_large ? kNearPairs : kAllPairs, is_large ? kFarPairs : kAllPairs}) {
    bool is_all = true;
    // Where the near pairs have found a model that waits, the others are not searched for more.
    const bool skips_doubtful = is_large && most == kFarPairs;
    if (known != grid) is_all = two_joints_pass(known, most, skips_doubtful);
    // A signal's range in the forest may not hold for its other joints.
    if (!forest_.spans()) is_all = two_joints_pass(grid, most, skips_doubtful);
    if (is_all || forest_.spans()) break;
  }
  if (forest_.spans() || is_large) return;
  // So few frames leave the fits narrow valleys: a finer grid of ranges, where parts are few. More
  // tell joints that turn more than once.
  if (pairs_.actions().num_samples() >= kFewestScanFrames) {
    two_joints_pass(known_turns(forest_, pairs_.actions().num_signals(), wide_turns()), kAllPairs,
                    false);
  } else {
    std::vector<double> fine;
    for (double turn = 0.25; turn < 3.1; turn *= 1.15) fine.push_back(turn);
    two_joints_pass(Turns(pairs_.actions().num_signals(), fine), kAllPairs, false);
  }
}

// By what one joint leaves, for the fewer joints are between two parts, the less that is: a pair is
// left out where both components have `most` better ones.
std::vector<std::pair<int, int>> LayeredSearch::open_pairs(std::size_t most, bool* is_all) {
  std::vector<std::pair<int, int>> pairs;
  for_each_open_pair([&](int i, int j) { pairs.emplace_back(i, j); });
  const auto score_of = [this](const std::pair<int, int>& ij) {
    const auto score = one_joint_score_.find(ij);
    return score == one_joint_score_.end() ? std::numeric_limits<double>::infinity()
                                           : score->second;
  };
  std::stable_sort(pairs.begin(), pairs.end(),
                   [&](const auto& x, const auto& y) { return score_of(x) < score_of(y); });
  std::map<int, std::size_t> taken;  // by component
  std::vector<std::pair<int, int>> result;
  for (const auto& [i, j] : pairs) {
    std::size_t& of_i = taken[forest_.component(i)];
    std::size_t& of_j = taken[forest_.component(j)];
    if (of_i >= most && of_j >= most) continue;
    ++of_i;
    ++of_j;
    result.emplace_back(i, j);
  }
  *is_all = result.size() == pairs.size();
  std::sort(result.begin(), result.end());
  return result;
}

bool LayeredSearch::two_joints_pass(const Turns& turns, std::size_t most_pairs,
                                    bool skips_doubtful) {
  // Fits of two components that stay above this cost a frame, in a row, before the rest is given
  // up.
  constexpr double kHopelessCost = 16;
  constexpr int kMaxHopeless = 12;
  struct Screened {
    int i, j;
    Start start;
  };
  const auto components_of = [this](int i, int j) -> std::pair<int, int> {
    return std::minmax({forest_.component(i), forest_.component(j)});
  };
  std::map<std::pair<int, int>, std::vector<std::pair<int, int>>> by_components;
  bool is_all = true;
  for (const auto& [i, j] : open_pairs(most_pairs, &is_all))
    by_components[components_of(i, j)].emplace_back(i, j);
  if (skips_doubtful)
    for (const Candidate& c : doubtful_) by_components.erase(components_of(c.part_i, c.part_j));
  std::vector<Candidate> candidates;
  for (const auto& [components, open] : by_components) {
    std::vector<Screened> list;
    for (const auto& [i, j] : open) {
      for (const auto& t : turns) pairs_.num_screens += static_cast<int>(2 * t.size());
      for (Start& start :
           screen_two_joints(pairs_.pair(i, j), pairs_.actions(), pairs_.motions(i, j), turns, 10))
        list.push_back({i, j, std::move(start)});
    }
    std::stable_sort(list.begin(), list.end(),
                     [](const auto& x, const auto& y) { return x.start.score < y.start.score; });
    std::map<std::pair<int, int>, std::vector<Candidate>> valid;
    int num_tried = 0;
    int num_hopeless = 0;  // in a row
    for (const Screened& s : list) {
      const int num_frames = pairs_.pair(s.i, s.j).size();
      const int max_fits = std::clamp(1200 / std::max(num_frames, 1), 8, 40);
      if (num_tried++ >= max_fits || num_hopeless >= kMaxHopeless) break;
      if (const auto c = pairs_.try_start(s.i, s.j, s.start.model)) valid[{s.i, s.j}].push_back(*c);
      const bool is_far = pairs_.last_cost() > kHopelessCost && num_frames >= kManyFrames;
      num_hopeless = is_far ? num_hopeless + 1 : 0;
    }
    for (auto& [ij, of_pair] : valid) decide(std::move(of_pair), &candidates);
  }
  connect(std::move(candidates));
  return is_all;
}

}  // namespace bodyschema
