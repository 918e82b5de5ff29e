#pragma once

#include <cstdint>
#include <deque>
#include <map>
#include <memory>
#include <optional>
#include <vector>

#include "processes/model_monitor/adaptation.h"

namespace bodyschema {

/// Keeps a complete body schema true while the body changes: a beam of weighted hypotheses.
///
/// A hypothesis is the body as it last settled with changes on it, oldest first. Its weight grows
/// by log p(sample | hypothesis) of the tree filter, beside that of the settled body, which is the
/// hypothesis that nothing changed. CUSUMs of the standing one propose others: a change more, a
/// change of another form or place, a change less. The standing one is what is published; another
/// takes its place when it leads by enough.
class HypothesisTracker {
 public:
  HypothesisTracker(BodySchema schema, AdaptationOptions options);

  std::vector<AdaptationEvent> on_sample(const ActionPoseSample& sample);
  const BodySchema& schema() const { return standing().body; }
  double edge_statistic(int part) const;
  double marker_statistic(int part) const;
  EdgeState edge_state(int part) const { return state_of({part, false}); }
  EdgeState marker_state(int part) const { return state_of({part, true}); }

 private:
  struct Change {
    Replacement what;
    std::int64_t since = 0;    ///< first sample that shows it
    std::int64_t adopted = 0;  ///< sample in which it was found
  };
  struct Hypothesis {
    std::vector<Change> changes;  ///< on the settled body, oldest first
    BodySchema body;
    std::shared_ptr<const TreeFilter> filter;
    double log_odds = 0;  ///< against that nothing changed [nats]
  };
  struct Seen {
    ActionPoseSample sample;
    double settled = 0;  ///< log p under the settled body
  };

  /// The newest change there, which is the one that holds now.
  static const Change* last_at(const std::vector<Change>& changes, const Place& place);
  const Hypothesis& standing() const { return beam_.front(); }
  EdgeState state_of(const Place& place) const;
  Hypothesis made_of(std::vector<Change> changes) const;
  BodySchema composed(const std::vector<Change>& changes, std::size_t without) const;
  /// Σ log priors and log-likelihood ratios of all samples since its first change.
  double log_odds_of(const std::vector<Change>& changes) const;
  std::vector<const ActionPoseSample*> segment(std::int64_t since, int longest) const;
  FoundChanges search(const BodySchema& base, const std::vector<Place>& places,
                      const std::vector<const ActionPoseSample*>& samples,
                      const BodyChange* standing_form);
  void propose_more(std::int64_t now);
  void propose_learned(std::int64_t now);
  void propose_again(std::int64_t now, std::vector<AdaptationEvent>* events);
  /// Fits every young change of a hypothesis again, given the others.
  Hypothesis fitted_again(Hypothesis hypothesis, bool all_forms, int rounds,
                          std::int64_t now);
  void offer(Hypothesis hypothesis);
  void choose(std::int64_t now, std::vector<AdaptationEvent>* events);
  double needed_lead(const Hypothesis& other) const;
  void stand(Hypothesis next, std::int64_t now, std::vector<AdaptationEvent>* events);
  void tell_difference(const Hypothesis& before, const Hypothesis& now, std::int64_t sample,
                       std::vector<AdaptationEvent>* events) const;
  void begin_tests(std::int64_t since);
  void detect(std::int64_t now, std::vector<AdaptationEvent>* events);
  void settle(std::int64_t now, std::vector<AdaptationEvent>* events);
  void remember(const BodySchema& schema);
  void calibrate();
  void watch_noise(const TreeFilter::Judgement& judgement);
  AdaptationEvent event(AdaptationEvent::Kind kind, std::int64_t sample, const Place& place) const;
  void tell(AdaptationEvent::Kind kind, std::int64_t sample, const Change& change, double margin,
            std::vector<AdaptationEvent>* events) const;

  const AdaptationOptions options_;
  MeasurementModel measurement_;
  BodySchema settled_;
  std::shared_ptr<const TreeFilter> settled_filter_;
  std::vector<Hypothesis> beam_;  ///< the standing one first
  std::optional<SequentialTests> tests_;
  std::deque<Seen> recent_;
  std::vector<BodySchema> history_;
  std::optional<Place> detected_;
  bool is_told_ = false;
  double untold_ = 0;
  std::int64_t last_mismatch_ = -1000;
  int num_samples_ = 0;
  int credit_;
  std::vector<double> quiet_distances_;
  int num_quiet_ = 0;
};

}  // namespace bodyschema
