#include "tests/experiments/figures/life.h"

#include <map>
#include <string>

#include "processes/model_monitor/baseline/chapter_adaptation.h"
#include "processes/structure_learner/baseline/fit_matrix_gp.h"
#include "tests/experiments/figures/robots.h"

namespace bodyschema::experiments {
namespace {

using test::adaptation_options;
using test::BrokenArm;
using test::Regime;
using test::Scenario;
using test::thread_seconds;
using test::TrueChange;
using Kind = AdaptationEvent::Kind;

/// Findings of a monitor, from its events.
class Explanations {
  struct Place {
    int part = 0;
    bool is_marker = false;
    auto operator<=>(const Place&) const = default;
  };

 public:
  void follow(const AdaptationEvent& event) {
    const Place place{event.part >= 0 ? event.part : event.to, event.part >= 0};
    if (event.kind == Kind::kCandidate || event.kind == Kind::kRestored ||
        event.kind == Kind::kRefined || event.kind == Kind::kDrift)
      causes_[place] = event.cause;
    if (event.kind == Kind::kReverted) causes_.erase(place);
  }
  void clear() { causes_.clear(); }
  bool empty() const { return causes_.empty(); }
  Life::Named judge(const std::vector<TrueChange>& changes) const {
    return {places_right(changes), causes_right(changes)};
  }

 private:
  /// Every affected place is named, and no other.
  bool places_right(const std::vector<TrueChange>& changes) const {
    const auto is_right = [](const auto& explanation, const TrueChange& change) {
      const Place& place = explanation.first;
      return place.part == change.part && (place.is_marker ? change.at_marker : change.at_edge);
    };
    const bool all_true = std::all_of(causes_.begin(), causes_.end(), [&](const auto& e) {
      return std::any_of(changes.begin(), changes.end(),
                         [&](const TrueChange& c) { return is_right(e, c); });
    });
    const bool all_found = std::all_of(changes.begin(), changes.end(), [&](const TrueChange& c) {
      return std::any_of(causes_.begin(), causes_.end(),
                         [&](const auto& e) { return is_right(e, c); });
    });
    return all_true && !causes_.empty() && all_found;
  }
  bool causes_right(const std::vector<TrueChange>& changes) const {
    return places_right(changes) &&
           std::all_of(causes_.begin(), causes_.end(), [&](const auto& explanation) {
             return explanation.second == "stored" ||
                    std::any_of(changes.begin(), changes.end(), [&](const TrueChange& c) {
                      return c.part == explanation.first.part &&
                             c.causes.contains(explanation.second);
                    });
           });
  }

  std::map<Place, std::string> causes_;
};

}  // namespace

Life live(const Scenario& scenario, Regime regime, double noise_factor, int length, int seed) {
  BrokenArm arm(scenario, regime, length, seed);
  Adaptation adaptation(arm.engineered(), adaptation_options(regime, noise_factor));
  Life life;
  Explanations explanations;
  for (int t = 0; t < arm.num_samples(); ++t) {
    if (t % length == 0) explanations.clear();
    const ActionPoseSample sample = arm.observe(t);
    const double start = thread_seconds();
    const auto events = adaptation.on_sample(sample);
    const double seconds = thread_seconds() - start;
    life.seconds += seconds;
    life.slowest = std::max(life.slowest, seconds);
    life.error.push_back(arm.error(adaptation.schema(), t));
    life.original.push_back(arm.error(arm.engineered(), t));
    bool is_valid = true;
    for (const int part : adaptation.schema().parts)
      is_valid &= adaptation.edge_state(part) != EdgeState::kInvalid &&
                  adaptation.marker_state(part) != EdgeState::kInvalid;
    life.is_valid.push_back(is_valid);
    life.num_sampled.push_back(life.num_sampled.empty() ? 0 : life.num_sampled.back());
    life.statistic.push_back(
        arm.changes().empty() ? 0 : adaptation.edge_statistic(arm.changes().back().part));
    for (const AdaptationEvent& event : events) {
      explanations.follow(event);
      life.events.push_back(event);
      life.num_sampled.back() += event.kind == Kind::kCandidate;
      const int part = event.part >= 0 ? event.part : event.to;
      life.num_wrong_events += t < length || !arm.is_near(part);
      const auto is_there = [&](const TrueChange& change) {
        return change.part == part && (event.part >= 0 ? change.at_marker : change.at_edge);
      };
      life.num_strictly_wrong_events +=
          t < length || std::none_of(arm.changes().begin(), arm.changes().end(), is_there);
    }
    const auto block = static_cast<std::size_t>(t / length);
    if (block == 0) continue;
    auto& at_recovery = life.at_recovery[block];
    if (life.error.back() > limit_m(regime))
      at_recovery.reset();
    else if (!at_recovery && !explanations.empty())
      at_recovery = explanations.judge(arm.changes());
    if ((t + 1) % length == 0) life.in_the_end[block] = explanations.judge(arm.changes());
  }
  return life;
}

Life live_as_the_chapter(const Scenario& scenario, Regime regime, int length, int seed) {
  BrokenArm arm(scenario, regime, length, seed);
  const BaselineOptions noise = baseline_options(regime);
  ChapterAdaptationOptions options;
  options.sigma_position_m = noise.sigma_position_m;
  options.sigma_rotation_rad = noise.sigma_rotation_rad;
  ChapterAdaptation adaptation(arm.engineered(), options, fit_matrix_gp_edge);
  Life life;
  for (int t = 0; t < arm.num_samples(); ++t) {
    const ActionPoseSample sample = arm.observe(t);
    const double start = thread_seconds();
    adaptation.on_sample(sample);
    const double seconds = thread_seconds() - start;
    life.seconds += seconds;
    life.slowest = std::max(life.slowest, seconds);
    life.error.push_back(arm.error(adaptation.schema(), t));
    life.original.push_back(arm.error(arm.engineered(), t));
    life.is_valid.push_back(adaptation.has_valid_tree());
    life.num_sampled.push_back(adaptation.num_sampled());
  }
  return life;
}

Recovery recovery_of(const std::vector<Life>& lives, int block, int length, double limit) {
  Recovery result;
  for (const Life& life : lives) {
    result.without_tree.push_back(life.without_tree(block, length));
    result.until_right.push_back(life.until_right(block, length, limit));
    const double healthy = life.mean_error(0, length);
    result.until_as_good.push_back(life.until_right(block, length, 1.5 * healthy));
    result.sampled.push_back(life.sampled_in(block, length));
  }
  return result;
}

}  // namespace bodyschema::experiments
