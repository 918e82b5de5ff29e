#include "processes/structure_learner/structure_search.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <tuple>

#include "processes/structure_learner/tree_fit.h"

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
// A refuted fit that costs less a frame may yet be right (a valid one costs 4 to 7).
constexpr double kMaxHopefulCost = 9;
constexpr double kMaxSmallHopefulCost = 14;
// Two signal sets of one size whose likelihoods differ by less [nats] are not told apart.
constexpr double kAmbiguityMargin = 3;

// The joint that an edge's data must have shown [rad per half range]. Of few sightings the smallest
// there is, of more one that shows after 10 samples in the chapter's noise. Chosen on 30 robots of
// 2, 4 and 7 joints each: with the smallest one for all, most right structures of chapter noise are
// taken back at 10 and 15 samples.
constexpr int kFewSightings = 6;
constexpr double kCommonTurn = 0.65;

class Forest {
 public:
  explicit Forest(int size) : parent_(size) { std::iota(parent_.begin(), parent_.end(), 0); }
  int find(int x) const {
    while (parent_[x] != x) x = parent_[x];
    return x;
  }
  bool connected(int x, int y) const { return find(x) == find(y); }
  void connect(int x, int y) { parent_[std::max(find(x), find(y))] = std::min(find(x), find(y)); }
  bool spans() const {
    for (int x = 1; x < static_cast<int>(parent_.size()); ++x)
      if (!connected(0, x)) return false;
    return true;
  }

 private:
  std::vector<int> parent_;
};

struct Candidate {
  int i = 0, j = 0;  // indices into parts
  LocalModel model;
  double score = 0;
  int num_frames = 0;
  int num_outliers = 0;
  double mean_capped = 0;  // mean of min(d², 2c)
  bool doubtful = false;
  bool on_all_data = false;
  bool is_valid = true;  // on all data, once it was judged there
};

// Beyond what a local fit mends, by the bulk of the frames.
bool is_hopeless(const Start& start, int num_frames) {
  return start.score > kMaxScrewStartCost ||
         (num_frames >= kSomeFrames && start.score > kGoodStartCost &&
          start.median > (num_frames >= kManyFrames ? kMaxStartMedian : kMaxFewFramesMedian));
}

std::set<int> signal_set(const LocalModel& model) {
  return {model.signal.begin(), model.signal.begin() + model.num_joints};
}

class Search {
 public:
  Search(const std::vector<ActionPoseSample>& samples, const NormalizedActions& actions,
         const std::vector<int>& parts, const SearchOptions& options)
      : samples_(samples),
        actions_(actions),
        parts_(parts),
        options_(options),
        forest_(static_cast<int>(parts.size())) {
    const int n = static_cast<int>(parts.size());
    const int num_pairs = std::max(1, n * (n - 1) / 2);
    max_frames_ = std::clamp(40000 / num_pairs, 60, 80);
    max_motions_ = num_pairs > 200 ? 150 : 300;
    pairs_.resize(static_cast<std::size_t>(n) * n);
    motions_.resize(pairs_.size());
    rests_.assign(n, -1);
    for (int i = 0; i < n; ++i)
      for (int j = i + 1; j < n; ++j)
        record(i, j).num_common = count_common(samples, parts[i], parts[j]);
  }

  SearchResult run() {
    constexpr int kMaxRounds = 4;
    for (int round = 0; round < kMaxRounds; ++round) {
      for (int k = round == 0 ? 0 : 1; k <= options_.max_signals && !forest_.spans(); ++k) {
        if (k == 0) layer_rigid();
        if (k == 1) layer_one_joint();
        if (k == 2) layer_two_joints();
      }
      settle_doubtful();
      // What all markers together refute leaves a gap, which other models may fill.
      if (!settle_jointly()) break;
    }
    if (!forest_.spans() && bridge()) settle_jointly();
    take_back_untold();
    return std::move(result_);
  }

 private:
  PairRecord& record(int i, int j) { return result_.records[{parts_[i], parts_[j]}]; }

  void note_undecided(int i, int j, int k, double mean_capped) {
    const auto [it, is_new] = record(i, j).undecided.emplace(k, mean_capped);
    if (!is_new) it->second = std::min(it->second, mean_capped);
  }

  // Is a smaller model between the same components undecided, and not clearly worse than this one?
  bool smaller_undecided(const Candidate& c) {
    const int n = static_cast<int>(parts_.size());
    const int k = c.model.num_joints;
    for (int x = 0; x < n; ++x) {
      if (!forest_.connected(x, c.i)) continue;
      for (int y = 0; y < n; ++y) {
        if (!forest_.connected(y, c.j)) continue;
        for (const auto& [smaller, mean_capped] : record(std::min(x, y), std::max(x, y)).undecided)
          if (smaller < k && (!is_clean_ || c.num_frames * (mean_capped - c.mean_capped) <
                                                6 * (k - smaller) * std::log(6.0 * c.num_frames)))
            return true;
      }
    }
    return false;
  }

  const PairData& pair(int i, int j) {
    auto& slot = pairs_[static_cast<std::size_t>(i) * parts_.size() + j];
    if (!slot)
      slot = make_pair_data(samples_, parts_[i], parts_[j], options_.measurement, max_frames_);
    return *slot;
  }

  const RelativeMotions& motions(int i, int j) {
    auto& slot = motions_[static_cast<std::size_t>(i) * parts_.size() + j];
    if (!slot) slot = relative_motions(pair(i, j), max_motions_);
    return *slot;
  }

  // Fits and tests a start on the pair's subset of the data.
  std::optional<Candidate> try_start(int i, int j, const LocalModel& start) {
    if (refuted_.count({parts_[i], parts_[j], signal_set(start)})) return std::nullopt;
    const PairData& data = pair(i, j);
    const bool all = data.size() == record(i, j).num_common;
    Fit fit = fit_local_model(start, data, actions_, 40, 1e-2);
    last_cost_ = fit.cost / data.size();
    ++result_.num_fits;
    ValidityOptions options = options_.validity;
    options.lenient = !all;
    const Validity validity =
        check_validity(fit, leave_one_out(fit, data, actions_), data, actions_, options);
    if (validity.verdict == Verdict::kNotEnoughData)
      note_undecided(i, j, start.num_joints, validity.mean_capped);
    if (validity.verdict != Verdict::kValid) {
      if (fit.cost < (start.num_joints < 2 ? kMaxSmallHopefulCost : kMaxHopefulCost) * data.size())
        hopefuls_.push_back({i, j, fit.model, fit.cost / data.size()});
      return std::nullopt;
    }
    return Candidate{i,
                     j,
                     fit.model,
                     validity.score,
                     data.size(),
                     validity.num_outliers,
                     validity.mean_capped,
                     validity.doubtful,
                     all};
  }

  bool confirm_on_all_data(Candidate* candidate) {
    if (candidate->on_all_data) return candidate->is_valid;
    const PairData data = make_pair_data(samples_, parts_[candidate->i], parts_[candidate->j],
                                         options_.measurement, std::numeric_limits<int>::max());
    const Fit fit = fit_local_model(candidate->model, data, actions_, 15, 1e-2);
    ++result_.num_fits;
    const Validity validity =
        check_validity(fit, leave_one_out(fit, data, actions_), data, actions_, options_.validity);
    candidate->model = fit.model;
    candidate->on_all_data = true;
    candidate->is_valid = validity.verdict == Verdict::kValid;
    return candidate->is_valid;
  }

  // Keeps a pair's best model, unless another signal set explains the data as well.
  void decide(int i, int j, std::vector<Candidate> valid, std::vector<Candidate>* candidates) {
    if (valid.empty()) return;
    std::stable_sort(valid.begin(), valid.end(),
                     [](const auto& x, const auto& y) { return x.score > y.score; });
    const int frames = pair(i, j).size();
    for (const Candidate& other : valid) {
      if (signal_set(other.model) == signal_set(valid.front().model)) continue;
      if ((valid.front().score - other.score) * frames < kAmbiguityMargin) {
        note_undecided(i, j, other.model.num_joints, other.mean_capped);
        return;
      }
    }
    candidates->push_back(std::move(valid.front()));
  }

  // Kruskal on one layer. Doubtful models wait for settle_doubtful().
  void connect(std::vector<Candidate> candidates) {
    sort_by_quality(&candidates);
    for (const Candidate& c : candidates) {
      num_judged_ += c.num_frames;
      num_outliers_ += c.num_outliers;
    }
    // Fewer outliers in all than the assumed rate would bring: then many on one model speak against
    // it.
    is_clean_ =
        num_outliers_ < binomial_quantile(num_judged_, pair_outlier_rate(options_.validity), 0.02);
    for (Candidate& c : candidates) {
      if (forest_.connected(c.i, c.j)) {
        spare_.push_back(c);
        continue;
      }
      if ((is_clean_ && c.doubtful) || smaller_undecided(c)) {
        note_undecided(c.i, c.j, c.model.num_joints, c.mean_capped);
        doubtful_.push_back(c);
      } else if (confirm_on_all_data(&c)) {
        accept(c);
      }
    }
  }

  // What is still open after the last layer: the simplest doubtful model first.
  void settle_doubtful() {
    sort_by_quality(&doubtful_);
    for (Candidate& c : doubtful_)
      if (!forest_.connected(c.i, c.j) && !smaller_undecided(c) && confirm_on_all_data(&c))
        accept(c);
  }

  struct Tree {
    std::vector<TreeNode> nodes;
    std::vector<int> accepted;  // of each node but the first: index into result_.models
    std::vector<PairData> data;
    bool root_rests = false;
  };

  // The accepted models of one component, outwards from a part that rests if there is one.
  Tree tree_of(int component) {
    std::vector<int> members;
    for (int x = 0; x < static_cast<int>(parts_.size()); ++x)
      if (forest_.connected(component, x)) members.push_back(x);
    Tree tree;
    int root = members.front();
    for (const int x : members)
      if (part_rests(x)) {
        root = x;
        tree.root_rests = true;
        break;
      }
    tree.nodes.push_back({parts_[root], -1, {}});
    tree.accepted.push_back(-1);
    for (std::size_t head = 0; head < tree.nodes.size(); ++head) {
      const int from = tree.nodes[head].part;
      for (int m = 0; m < static_cast<int>(result_.models.size()); ++m) {
        if (m == tree.accepted[head]) continue;
        const AcceptedModel& model = result_.models[m];
        if (model.part_i == from)
          tree.nodes.push_back({model.part_j, static_cast<int>(head), model.model});
        else if (model.part_j == from)
          tree.nodes.push_back({model.part_i, static_cast<int>(head), model.model.inverse()});
        else
          continue;
        tree.accepted.push_back(m);
      }
    }
    for (const TreeNode& node : tree.nodes)
      tree.data.push_back(make_part_data(samples_, node.part, options_.measurement, max_frames_));
    return tree;
  }

  // Does a part keep its pose in the camera's frame?
  bool part_rests(int x) {
    if (rests_[x] < 0) {
      const PairData data = make_part_data(samples_, parts_[x], options_.measurement, max_frames_);
      rests_[x] = is_at_rest(data, actions_, options_.validity);
    }
    return rests_[x] == 1;
  }

  // Joints that only all markers together show: part what moves, until nothing is left to explain.
  // Models that cannot take up the joints they lack are removed: returns true then.
  bool settle_jointly() {
    const int n = static_cast<int>(parts_.size());
    constexpr int kMaxSplits = 12;
    std::vector<std::pair<int, int>> refuted;
    result_.log_likelihood = 0;
    for (int x = 0; x < n; ++x) {
      if (forest_.find(x) != x) continue;
      for (int round = 0; round < kMaxSplits; ++round) {
        const Tree tree = tree_of(x);
        TreeFit fit = fit_tree(tree);
        const auto worst = tree.nodes.size() < 2 ? std::nullopt : missing_joint(&fit);
        if (!worst || round + 1 == kMaxSplits) {
          result_.log_likelihood += fit.log_likelihood();
          break;
        }
        if (exchange(tree, worst->signal, fit.cost())) continue;
        if (const auto edges = fit.with_joint(*worst)) {
          adopt(tree, *edges);
          continue;
        }
        for (const int node : fit.full_edges(*worst))
          refuted.push_back({tree.nodes[node].part, tree.nodes[tree.nodes[node].parent].part});
        result_.log_likelihood += fit.log_likelihood();
        break;
      }
    }
    if (refuted.empty()) return false;
    for (const auto& [a, b] : refuted)
      std::erase_if(result_.models, [&, a = a, b = b](const AcceptedModel& m) {
        const bool is_it = std::minmax(a, b) == std::minmax(m.part_i, m.part_j);
        if (is_it) refuted_.insert({m.part_i, m.part_j, signal_set(m.model)});
        return is_it;
      });
    forest_ = Forest(n);
    for (const AcceptedModel& m : result_.models)
      forest_.connect(index_of(m.part_i), index_of(m.part_j));
    doubtful_.clear();
    return true;
  }

  // Puts a valid model that was spare in the place of one that is not simpler, if all poses then
  // cost less: pairs do not tell two models of one size apart that their markers together do. Of
  // those with the signal of which a joint is missing.
  bool exchange(const Tree& tree, int signal, double cost) {
    const int component = index_of(tree.nodes[0].part);
    const std::vector<AcceptedModel> before = result_.models;
    std::vector<AcceptedModel> best;
    for (Candidate& c : spare_) {
      // What joined its ends may have been refuted since.
      if (!forest_.connected(component, c.i) || !forest_.connected(component, c.j) ||
          !c.model.uses(signal) || refuted_.count({parts_[c.i], parts_[c.j], signal_set(c.model)}))
        continue;
      for (const int node : path_between(tree, parts_[c.i], parts_[c.j])) {
        const AcceptedModel& present = before[tree.accepted[node]];
        if (present.model.num_joints < c.model.num_joints ||
            std::tie(present.part_i, present.part_j) == std::tie(parts_[c.i], parts_[c.j]) ||
            !confirm_on_all_data(&c))
          continue;
        result_.models = before;
        result_.models[tree.accepted[node]] = {parts_[c.i], parts_[c.j], c.model, c.score};
        const double other_cost = fit_tree(tree_of(component)).cost();
        if (other_cost >= cost) continue;
        cost = other_cost;
        best = result_.models;
      }
    }
    result_.models = best.empty() ? before : best;
    return !best.empty();
  }

  // Nodes whose edges to their parents are the path between two parts.
  static std::vector<int> path_between(const Tree& tree, int part_a, int part_b) {
    const auto node_of = [&](int part) {
      return static_cast<int>(
          std::find_if(tree.nodes.begin(), tree.nodes.end(),
                       [&](const TreeNode& node) { return node.part == part; }) -
          tree.nodes.begin());
    };
    std::vector<int> path;
    // Parents come before their children.
    for (int a = node_of(part_a), b = node_of(part_b); a != b;) {
      int& lower = a > b ? a : b;
      path.push_back(lower);
      lower = tree.nodes[lower].parent;
    }
    return path;
  }

  // Connects what is left by models that their own pair could not make valid, if all markers of
  // both sides together find nothing wrong with one. A model that is too small grows by the joints
  // it lacks.
  bool bridge() {
    constexpr int kMaxTried = 12;
    std::stable_sort(hopefuls_.begin(), hopefuls_.end(), [](const Hopeful& x, const Hopeful& y) {
      return std::forward_as_tuple(x.model.num_joints, x.cost) <
             std::forward_as_tuple(y.model.num_joints, y.cost);
    });
    std::set<std::tuple<int, int, std::set<int>>> met;  // the best fit of each comes first
    std::erase_if(hopefuls_, [&met](const Hopeful& h) {
      return !met.insert({h.i, h.j, signal_set(h.model)}).second;
    });
    std::map<std::tuple<int, int, int>, int> tried;  // by components and k
    std::map<int, double> cost_of;                   // of a component's own tree
    const auto own_cost = [&](int x) {
      const auto [it, is_new] = cost_of.emplace(forest_.find(x), 0.0);
      if (is_new) it->second = fit_tree(tree_of(x)).cost();
      return it->second;
    };
    bool any = false;
    for (const Hopeful& h : hopefuls_) {
      if (forest_.connected(h.i, h.j)) continue;
      if (refuted_.count({parts_[h.i], parts_[h.j], signal_set(h.model)})) continue;
      const auto [x, y] = std::minmax({forest_.find(h.i), forest_.find(h.j)});
      if (tried[{x, y, h.model.num_joints}]++ >= kMaxTried) continue;
      const double apart = own_cost(h.i) + own_cost(h.j);
      const Forest forest_before = forest_;
      const std::vector<AcceptedModel> models_before = result_.models;
      const auto cost = join(h, apart);
      if (!cost) continue;
      // Another signal set between the same parts that does as well leaves it open.
      const Forest forest_joined = forest_;
      const std::vector<AcceptedModel> models_joined = result_.models;
      bool is_ambiguous = false;
      for (const Hopeful& other : hopefuls_) {
        if (other.i != h.i || other.j != h.j || other.model.num_joints != h.model.num_joints ||
            signal_set(other.model) == signal_set(h.model))
          continue;
        forest_ = forest_before;
        result_.models = models_before;
        const auto other_cost = join(other, apart);
        is_ambiguous |= other_cost && *other_cost < *cost + 2 * kAmbiguityMargin &&
                        !same_signals(result_.models, models_joined);
      }
      forest_ = is_ambiguous ? forest_before : forest_joined;
      result_.models = is_ambiguous ? models_before : models_joined;
      if (is_ambiguous) continue;
      cost_of.clear();
      any = true;
    }
    return any;
  }

  // Few poses, or poses at which a signal hardly moved, agree with a smaller model by chance.
  void take_back_untold() {
    for (bool is_changed = true; is_changed;) {
      is_changed = false;
      result_.joint_information.clear();
      for (const int signal : actions_.moving())
        result_.joint_information[signal] = std::numeric_limits<double>::infinity();
      for (int x = 0; x < static_cast<int>(parts_.size()); ++x)
        if (forest_.find(x) == x) is_changed |= take_back_least_told(tree_of(x));
    }
  }

  bool take_back_least_told(const Tree& tree) {
    if (tree.nodes.size() < 2) return false;
    const Eigen::MatrixXd information = fit_tree(tree).joint_information();
    double least = kNoticed;
    int least_node = -1, least_signal = -1;
    for (std::size_t k = 1; k < tree.nodes.size(); ++k) {
      const auto parent = static_cast<std::size_t>(tree.nodes[k].parent);
      const int sightings = std::min(tree.data[k].size(), tree.data[parent].size());
      const double turn = sightings < kFewSightings ? kLeastTurn : kCommonTurn;
      for (std::size_t s = 0; s < actions_.moving().size(); ++s) {
        const int signal = actions_.moving()[s];
        if (tree.nodes[k].model.uses(signal)) continue;
        const double told = information(static_cast<Eigen::Index>(k), static_cast<Eigen::Index>(s));
        double& of_signal = result_.joint_information[signal];
        of_signal = std::min(of_signal, told);
        if (turn * turn * told >= least) continue;
        least = turn * turn * told;
        least_node = static_cast<int>(k);
        least_signal = signal;
      }
    }
    if (least_node < 0) return false;
    const auto m = result_.models.begin() + tree.accepted[least_node];
    PairRecord& pair = result_.records[{m->part_i, m->part_j}];
    pair.undecided.emplace(m->model.num_joints, 0.0);
    pair.untold_signals.insert(least_signal);
    result_.models.erase(m);
    forest_ = Forest(static_cast<int>(parts_.size()));
    for (const AcceptedModel& model : result_.models)
      forest_.connect(index_of(model.part_i), index_of(model.part_j));
    return true;
  }

  struct Hopeful {
    int i = 0, j = 0;
    LocalModel model;
    double cost = 0;  // a frame
  };

  static bool same_signals(const std::vector<AcceptedModel>& x,
                           const std::vector<AcceptedModel>& y) {
    const auto all = [](const std::vector<AcceptedModel>& models) {
      std::set<std::tuple<int, int, std::set<int>>> result;
      for (const AcceptedModel& m : models)
        result.insert({m.part_i, m.part_j, signal_set(m.model)});
      return result;
    };
    return all(x) == all(y);
  }

  static int count_joints(const std::vector<AcceptedModel>& models) {
    int sum = 0;
    for (const AcceptedModel& m : models) sum += m.model.num_joints;
    return sum;
  }

  // Makes two components one tree, with the joints that all markers ask for. The tree's cost if
  // that is no worse than noise makes it, else std::nullopt and everything as it was.
  std::optional<double> join(const Hopeful& h, double apart) {
    const Forest forest_before = forest_;
    const std::vector<AcceptedModel> models_before = result_.models;
    result_.models.push_back({parts_[h.i], parts_[h.j], h.model, 0});
    forest_.connect(h.i, h.j);
    for (int added = 0; added <= kMaxJoints; ++added) {
      const Tree tree = tree_of(h.i);
      TreeFit fit = fit_tree(tree);
      if (const auto worst = missing_joint(&fit)) {
        const auto edges = fit.with_joint(*worst);
        if (!edges) break;
        adopt(tree, *edges);
        continue;
      }
      // Tying the one's pose to the other's costs half of χ².
      const int joints = count_joints(result_.models) - count_joints(models_before);
      const double dof = 6.0 * count_ties(tree, forest_before) - 6 - 6 * joints;
      if (dof < 12 || fit.cost() - apart > 0.5 * (dof + 4 * std::sqrt(2 * dof))) break;
      return fit.cost();
    }
    forest_ = forest_before;
    result_.models = models_before;
    return std::nullopt;
  }

  // Frames at which a tree of two components has a free pose less than they had apart: those at
  // which both are seen; where the root rests, and with it all that hangs on it, those at which the
  // other one is seen, if that did not rest too.
  int count_ties(const Tree& tree, const Forest& apart) {
    std::set<int> seen[2];
    const int root = index_of(tree.nodes.front().part);
    for (std::size_t k = 0; k < tree.nodes.size(); ++k) {
      const int x = index_of(tree.nodes[k].part);
      const bool is_other = !apart.connected(root, x);
      if (is_other && part_rests(x)) return 0;
      for (const PairFrame& frame : tree.data[k].frames) seen[is_other].insert(frame.sample);
    }
    if (tree.root_rests) return static_cast<int>(seen[1].size());
    return static_cast<int>(std::count_if(seen[1].begin(), seen[1].end(),
                                          [&](int sample) { return seen[0].count(sample); }));
  }

  TreeFit fit_tree(const Tree& tree) {
    ++result_.num_fits;
    TreeFit fit(tree.nodes, tree.data, actions_, tree.root_rests);
    fit.fit(15, 0.2);
    return fit;
  }

  int index_of(int part) const {
    return static_cast<int>(std::find(parts_.begin(), parts_.end(), part) - parts_.begin());
  }

  // Replaces the accepted models of a component by the edges of its new tree.
  void adopt(const Tree& tree, const std::vector<TreeEdge>& edges) {
    std::vector<int> old(tree.accepted.begin() + 1, tree.accepted.end());
    std::sort(old.rbegin(), old.rend());
    for (const int m : old) result_.models.erase(result_.models.begin() + m);
    for (const TreeEdge& e : edges) {
      AcceptedModel model{tree.nodes[e.a].part, tree.nodes[e.b].part, e.model, 0};
      if (model.part_i > model.part_j) {
        std::swap(model.part_i, model.part_j);
        model.model = model.model.inverse();
      }
      result_.models.push_back(model);
    }
  }

  // The joint that the tree lacks most. What a fit has not settled yet looks like one: only if it
  // remains after more steps.
  std::optional<MissingJoint> missing_joint(TreeFit* fit) const {
    for (bool is_settled = false;; is_settled = true) {
      const auto joints = fit->missing_joints(options_.measurement.systematic);
      const MissingJoint* worst = most_significant(joints, fit->num_frames());
      if (!worst) return std::nullopt;
      if (is_settled) return *worst;
      fit->fit(60, 1e-5);
    }
  }

  // The one that chance explains least, if it is significant (Bonferroni over all that was tried).
  // A signal that moves nothing in a spanning forest is probably somewhere: it has an error rate of
  // its own, spent on fewer hypotheses. The rates are those of few frames; they fall with
  // n^(−dof/2), as the odds do (Schwarz 1978), so that more samples end in fewer errors of both
  // kinds.
  const MissingJoint* most_significant(const std::vector<MissingJoint>& joints,
                                       int num_frames) const {
    constexpr double kErrorRates[2] = {0.003, 0.002};
    constexpr double kFewFrames = 20;
    const double log_frames = std::log(std::max(num_frames / kFewFrames, 1.0));
    std::set<int> used;
    for (const AcceptedModel& m : result_.models)
      for (int d = 0; d < m.model.num_joints; ++d) used.insert(m.model.signal[d]);
    const auto is_used = [&](int signal) { return !forest_.spans() || used.count(signal) > 0; };
    double ways[2] = {0, 0};
    for (const MissingJoint& j : joints) ways[is_used(j.signal)] += std::exp(j.log_ways);
    const MissingJoint* best = nullptr;
    double best_margin = 0;
    for (const MissingJoint& j : joints) {
      const bool elsewhere = is_used(j.signal);
      const double margin = j.log_tail + std::log(2 * ways[elsewhere] / kErrorRates[elsewhere]) +
                            0.5 * (j.slides ? 3 : 6) * log_frames;
      if (margin < best_margin) {
        best = &j;
        best_margin = margin;
      }
    }
    return best;
  }

  static void sort_by_quality(std::vector<Candidate>* candidates) {
    std::stable_sort(candidates->begin(), candidates->end(), [](const auto& x, const auto& y) {
      return std::tie(x.model.num_joints, y.score, x.i, x.j) <
             std::tie(y.model.num_joints, x.score, y.i, y.j);
    });
  }

  void accept(const Candidate& c) {
    forest_.connect(c.i, c.j);
    result_.models.push_back({parts_[c.i], parts_[c.j], c.model, c.score, {}});
  }

  template <typename Visitor>
  void for_each_open_pair(Visitor&& visit) {
    const int n = static_cast<int>(parts_.size());
    for (int i = 0; i < n; ++i)
      for (int j = i + 1; j < n; ++j)
        if (!forest_.connected(i, j) && record(i, j).num_common >= 2) visit(i, j);
  }

  void layer_rigid() {
    std::vector<Candidate> candidates;
    for_each_open_pair([&](int i, int j) {
      ++result_.num_screens;
      const Start start = screen_rigid(pair(i, j), actions_);
      if (start.score > kMaxRigidStartCost) return;
      if (auto c = try_start(i, j, start.model)) candidates.push_back(std::move(*c));
    });
    connect(std::move(candidates));
  }

  void layer_one_joint() {
    constexpr std::size_t kMaxFits = 3;
    std::vector<Candidate> candidates;
    for_each_open_pair([&](int i, int j) {
      const auto regressions = screen_one_joint(motions(i, j), actions_);
      result_.num_screens += static_cast<int>(regressions.size());
      std::vector<Candidate> valid;
      for (std::size_t n = 0; n < std::min(kMaxFits, regressions.size()); ++n) {
        if (n >= 1 && regressions[n].score > 1.5 * regressions[0].score) break;
        const Start start =
            one_joint_start(regressions[n], pair(i, j), actions_, motions(i, j).sigma_rad);
        if (is_hopeless(start, pair(i, j).size())) continue;
        if (auto c = try_start(i, j, start.model)) valid.push_back(std::move(*c));
      }
      decide(i, j, std::move(valid), &candidates);
    });
    connect(std::move(candidates));
  }

  // Joint ranges of the signals where the forest already knows them, else a grid.
  std::vector<std::vector<double>> assumed_turns(bool known_only) const {
    std::vector<std::vector<double>> turns(actions_.num_signals());
    if (known_only)
      for (const AcceptedModel& m : result_.models)
        for (int d = 0; d < m.model.num_joints; ++d)
          if (std::abs(m.model.turn[d]) > 0.1)
            turns[m.model.signal[d]].push_back(std::abs(m.model.turn[d]));
    bool any_known = false;
    for (auto& t : turns) {
      any_known |= !t.empty();
      if (t.empty()) t = default_turns();
    }
    if (known_only && !any_known) turns.clear();
    return turns;
  }

  void layer_two_joints() {
    // What the forest knows of a signal's range may not hold for its other joints: so a second pass
    // without it, where the first leaves gaps.
    for (const bool known_only : {true, false}) {
      const auto turns = assumed_turns(known_only);
      if (turns.empty() || forest_.spans()) continue;
      two_joints_pass(turns);
    }
    // So few frames leave the fits narrow valleys: a finer grid of ranges, where pairs are few.
    constexpr std::size_t kMaxPairs = 100;
    if (samples_.size() < 12 && !forest_.spans() && pairs_.size() <= 2 * kMaxPairs) {
      std::vector<double> fine;
      for (double turn = 0.25; turn < 3.1; turn *= 1.15) fine.push_back(turn);
      two_joints_pass(std::vector<std::vector<double>>(actions_.num_signals(), fine));
    }
  }

  // Fits of two components that stay above this cost a frame, in a row, before the rest is given
  // up.
  static constexpr double kHopelessCost = 16;
  static constexpr int kMaxHopeless = 12;

  void two_joints_pass(const std::vector<std::vector<double>>& turns) {
    struct Screened {
      int i, j;
      Start start;
    };
    std::map<std::pair<int, int>, std::vector<Screened>> by_components;
    for_each_open_pair([&](int i, int j) {
      auto& list = by_components[std::minmax(forest_.find(i), forest_.find(j))];
      for (const auto& t : turns) result_.num_screens += static_cast<int>(2 * t.size());
      for (Start& start : screen_two_joints(pair(i, j), actions_, motions(i, j), turns, 10))
        list.push_back({i, j, std::move(start)});
    });
    std::vector<Candidate> candidates;
    for (auto& [components, list] : by_components) {
      std::stable_sort(list.begin(), list.end(),
                       [](const auto& x, const auto& y) { return x.start.score < y.start.score; });
      std::map<std::pair<int, int>, std::vector<Candidate>> valid;
      std::size_t num_tried = 0;
      int num_hopeless = 0;  // in a row
      for (const Screened& s : list) {
        const std::size_t max_fits = std::clamp(1200 / std::max(pair(s.i, s.j).size(), 1), 8, 40);
        if (num_tried++ >= max_fits || num_hopeless >= kMaxHopeless) break;
        if (auto c = try_start(s.i, s.j, s.start.model)) valid[{s.i, s.j}].push_back(*c);
        const bool is_hopeless = last_cost_ > kHopelessCost && pair(s.i, s.j).size() >= kManyFrames;
        num_hopeless = is_hopeless ? num_hopeless + 1 : 0;
      }
      for (auto& [ij, of_pair] : valid)
        decide(ij.first, ij.second, std::move(of_pair), &candidates);
    }
    connect(std::move(candidates));
  }

  const std::vector<ActionPoseSample>& samples_;
  const NormalizedActions& actions_;
  const std::vector<int>& parts_;
  const SearchOptions& options_;
  Forest forest_;
  int max_frames_ = 0;
  int max_motions_ = 0;
  std::vector<std::optional<PairData>> pairs_;
  std::vector<std::optional<RelativeMotions>> motions_;
  std::set<std::tuple<int, int, std::set<int>>> refuted_;  // by all markers together
  std::vector<int> rests_;                                 // a part: 1 yes, 0 no, -1 not yet known
  double last_cost_ = 0;                                   // a frame, of the latest fit
  std::vector<Hopeful> hopefuls_;
  std::vector<Candidate> doubtful_;
  std::vector<Candidate> spare_;  // valid, between parts that were connected already
  int num_judged_ = 0;  // frames of the valid models found so far, and the outliers among them
  int num_outliers_ = 0;
  bool is_clean_ = false;
  SearchResult result_;
};

}  // namespace

SearchResult search_structure(const std::vector<ActionPoseSample>& samples,
                              const NormalizedActions& actions, const std::vector<int>& parts,
                              const SearchOptions& options) {
  return Search(samples, actions, parts, options).run();
}

}  // namespace bodyschema
