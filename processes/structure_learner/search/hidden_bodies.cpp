#include "processes/structure_learner/search/hidden_bodies.h"

#include <algorithm>
#include <iterator>
#include <limits>
#include <utility>

#include "processes/structure_learner/search/layered_search.h"
#include "processes/structure_learner/search/long_chains.h"

namespace bodyschema {
namespace {

// Of two components, those whose best joint leaves least.
constexpr std::size_t kMaxScreened = 8;
constexpr int kMaxFits = 24;
constexpr std::size_t kOneJointStarts = 3;
constexpr int kTwoJointStarts = 6;

// A body by the way to it from a part that is seen.
struct Body {
  int part = 0;
  LocalModel way = {};
  bool is_hidden() const { return way.num_joints() > 0; }
};

void append(LocalModel* way, const LocalModel& further) {
  way->transform(way->num_joints()) = way->transform(way->num_joints()) * further.first;
  way->joints.insert(way->joints.end(), further.joints.begin(), further.joints.end());
}

// The parts of a component, and the bodies between the joints of its models from either end.
std::vector<Body> bodies_of(const ModelForest& forest, int component) {
  std::vector<Body> bodies;
  for (const int part : forest.members(component)) bodies.push_back({part});
  for (const AcceptedModel& m : forest.models()) {
    if (forest.component(m.part_i) != component || !m.soft_signals.empty()) continue;
    for (int d = 1; d < m.model.num_joints(); ++d) {
      LocalModel before = m.model, after;
      before.joints.resize(static_cast<std::size_t>(d));
      after.joints.assign(m.model.joints.begin() + d, m.model.joints.end());
      bodies.push_back({m.part_i, std::move(before)});
      bodies.push_back({m.part_j, after.inverse()});
    }
  }
  return bodies;
}

// The poses of body b in body a, whose part is the lower one.
PairData between(const Body& a, const Body& b, PairModels* pairs) {
  PairData data = pairs->pair(a.part, b.part);
  for (const PairFrame& frame : data.frames) {
    const Pose from_a = a.way.predict(pairs->actions(), frame.sample).inverse();
    const Pose from_b = b.way.predict(pairs->actions(), frame.sample);
    const Matrix6d carried = adjoint(from_b);
    for (int h = 0; h < frame.num_hypotheses; ++h) {
      PairHypothesis& hypothesis =
          data.hypotheses[static_cast<std::size_t>(frame.first_hypothesis + h)];
      hypothesis.z = from_a * hypothesis.z * from_b;
      hypothesis.whitening = hypothesis.whitening * carried;
    }
  }
  return data;
}

// Two bodies, the lower part's first, with their poses and the joints that may be between them.
struct Screened {
  const Body *a, *b;
  PairData data;
  RelativeMotions motions;
  std::vector<ScrewRegression> regressions;
  double score() const {
    return regressions.empty() ? std::numeric_limits<double>::infinity() : regressions[0].score;
  }
};

class HiddenBodySearch {
 public:
  HiddenBodySearch(PairModels* pairs, const ModelForest& forest)
      : pairs_(*pairs),
        turns_(known_turns(forest, pairs->actions().num_signals(), default_turns())) {}

  // The best model between a body of each, if it is the only good one.
  std::optional<Candidate> best(const std::vector<Body>& of_x, const std::vector<Body>& of_y) {
    std::vector<Candidate> valid;
    int num_fits = 0;
    for (const auto& [score, part_i, part_j, start] : starts(screened(of_x, of_y))) {
      if (num_fits++ >= kMaxFits) break;
      auto c = pairs_.try_start(part_i, part_j, start);
      if (c && !c->doubtful) valid.push_back(*std::move(c));
    }
    const std::optional<Candidate> best = pairs_.only_best(valid);
    return best ? settled(*best) : std::nullopt;
  }

 private:
  // In the order that the poses prefer, or with the joints numbered whose order they leave open.
  std::optional<Candidate> settled(const Candidate& c) {
    const PairData& pair = pairs_.pair(c.part_i, c.part_j);
    const Fit fit = fit_local_model(c.model, pair, pairs_.actions(), 15, 1e-2);
    const auto ordered =
        pairs_.try_start(c.part_i, c.part_j, with_settled_order(fit, pair, pairs_.actions()).model);
    if (!ordered) return std::nullopt;
    return with_searched_order(*ordered, &pairs_);
  }

  struct WholeStart {
    double score;
    int part_i, part_j;
    LocalModel model;
  };

  std::vector<Screened> screened(const std::vector<Body>& of_x, const std::vector<Body>& of_y) {
    std::vector<Screened> list;
    for (const Body& x : of_x) {
      for (const Body& y : of_y) {
        if (!x.is_hidden() && !y.is_hidden()) continue;
        const Body &a = x.part < y.part ? x : y, &b = x.part < y.part ? y : x;
        const PairData& pair = pairs_.pair(a.part, b.part);
        const int num_joints = a.way.num_joints() + b.way.num_joints() + 1;
        if (pair.num_residuals() < 6 || num_joints > pairs_.options().max_signals ||
            pair.size() < kPosesPerJoint * num_joints)
          continue;
        Screened s{&a, &b, between(a, b, &pairs_), {}, {}};
        s.motions = relative_motions(s.data, 300);
        s.regressions = screen_one_joint(s.motions, pairs_.actions());
        pairs_.num_screens += static_cast<int>(s.regressions.size());
        list.push_back(std::move(s));
      }
    }
    std::ranges::stable_sort(list, {}, &Screened::score);
    if (list.size() > kMaxScreened) list.resize(kMaxScreened);
    return list;
  }

  // Models between the seen parts, the best first.
  std::vector<WholeStart> starts(const std::vector<Screened>& list) {
    std::vector<WholeStart> result;
    const NormalizedActions& actions = pairs_.actions();
    for (const Screened& s : list) {
      std::vector<Start> parts;
      for (std::size_t n = 0; n < std::min(kOneJointStarts, s.regressions.size()); ++n)
        parts.push_back(one_joint_start(s.regressions[n], s.data, actions, s.motions.sigma_rad));
      for (const auto& t : turns_) pairs_.num_screens += static_cast<int>(2 * t.size());
      std::ranges::move(screen_two_joints(s.data, actions, s.motions, turns_, kTwoJointStarts),
                        std::back_inserter(parts));
      for (const Start& start : parts) {
        LocalModel whole = s.a->way;
        append(&whole, start.model);
        append(&whole, s.b->way.inverse());
        const int k = whole.num_joints();
        if (k > pairs_.options().max_signals || static_cast<int>(signal_set(whole).size()) < k)
          continue;
        result.push_back({start.score, s.a->part, s.b->part, std::move(whole)});
      }
    }
    std::ranges::stable_sort(result, {}, &WholeStart::score);
    return result;
  }

  PairModels& pairs_;
  const std::vector<std::vector<double>> turns_;
};

}  // namespace

bool connect_hidden_bodies(PairModels* pairs, ModelForest* forest) {
  if (pairs->actions().blocks().is_stream()) return false;
  bool any = false;
  for (bool is_new = true; is_new && !forest->spans(); any |= is_new) {
    is_new = false;
    std::set<int> components;
    for (const int part : forest->parts()) components.insert(forest->component(part));
    if (components.size() > kMaxChainedComponents) break;
    HiddenBodySearch search(pairs, *forest);
    std::vector<Candidate> found;
    for (const int x : components)
      for (const int y : components)
        if (x < y)
          if (auto c = search.best(bodies_of(*forest, x), bodies_of(*forest, y)))
            found.push_back(*std::move(c));
    std::ranges::stable_sort(found, {}, rank);
    for (Candidate& c : found) {
      if (forest->connected(c.part_i, c.part_j) || !pairs->confirm_on_all_data(&c)) continue;
      forest->add(c);
      is_new = true;
    }
  }
  return any;
}

}  // namespace bodyschema
