#pragma once

#include <cstdint>
#include <deque>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <vector>

#include "processes/model_monitor/health/adaptation_event.h"
#include "processes/model_monitor/hypotheses/change_search.h"
#include "processes/model_monitor/hypotheses/sequential_tests.h"
#include "processes/model_monitor/likelihood/tree_filter.h"

namespace bodyschema {

/// Which changes the body made since it settled last: a beam of weighted hypotheses.
///
/// A hypothesis is the settled body with changes on it, oldest first, or none. Its weight are log
/// odds against the one without: priors of its changes, and of every sample the log-likelihood
/// ratio of the tree filter. CUSUMs of the standing hypothesis propose others: one change more,
/// another form or element of one, one less, an edge learned anew. Another takes the place of the
/// standing one when it leads by enough, fitted to all its samples: by `acceptance` for what is
/// new, by nothing for what is less; events are the difference of the two. What has stood unchanged
/// for `settled_after` samples is the settled body, and joins the history.
class HypothesisTracker {
 public:
  /// A change of the settled body.
  struct Change {
    Replacement what;
    std::int64_t since = 0;    ///< first sample that shows it
    std::int64_t adopted = 0;  ///< sample since which it stands
  };
  using Filter = std::function<void(ActionPoseSample*)>;
  /// Samples without an explanation after which an edge is learned anew.
  static constexpr std::int64_t kUnexplained = 8;

  /// `is_soft`: some edge has a residual GP, so that nothing is found from one loud sample.
  HypothesisTracker(BodySchema settled, const MeasurementModel& measurement,
                    const AdaptationOptions& options, bool is_soft);

  /// One more sample, numbered without gaps. Returns its judgement by the standing hypothesis.
  TreeFilter::Judgement on_sample(const ActionPoseSample& sample,
                                  std::vector<AdaptationEvent>* events);
  /// Samples before the first that is judged.
  void add_silently(const ActionPoseSample& sample);

  const BodySchema& schema() const { return standing().body; }
  const BodySchema& settled() const { return settled_; }
  const TreeFilter& filter() const { return *standing().filter; }
  const std::vector<Change>& changes() const { return standing().changes; }
  const std::optional<ElementId>& detected() const { return detected_; }
  const SequentialTests& tests() const { return *tests_; }
  std::vector<ElementId> suspects() const;
  /// The first sample that shows any of what is thought to have changed, or is suspected.
  std::int64_t trouble_since() const;
  /// Of the standing hypothesis over that nothing changed [nats].
  double log_odds() const { return standing().log_odds; }
  /// The most of any hypothesis.
  double most_log_odds() const;
  bool was_adopted_at(std::int64_t sample) const;
  const std::vector<BodySchema>& history() const { return history_; }
  void set_history(std::vector<BodySchema> history);
  void remember(const BodySchema& schema);
  std::vector<const ActionPoseSample*> segment(std::int64_t since, int longest) const;
  std::vector<ActionPoseSample> recent() const;

  /// A change of one of `elements` since a sample that explains the samples best, and by how much
  /// better than what stands [nats].
  struct Explanation {
    Replacement what;
    std::int64_t since = 0;
    double lead = 0;
  };
  std::optional<Explanation> explain(const std::vector<ElementId>& elements, std::int64_t since);
  /// It stands beside what stood, and is told.
  void adopt(Explanation explanation, std::int64_t now, std::vector<AdaptationEvent>* events);

  /// Nothing has changed since the body became this one; CUSUMs are at zero.
  void begin(const BodySchema& settled, const MeasurementModel& measurement);
  /// The settled body goes on changing at the edge to `part` alone: the other CUSUMs stay.
  void follow(const BodySchema& settled, int part);
  /// `change` of `base` made the settled body: its parameters go on being fitted for a while.
  void go_on_fitting(BodySchema base, Change change);
  void stop_fitting() { maturing_.reset(); }
  /// What stands is kept as it is, and remembered.
  void keep_all();
  /// What stands is taken back, and told; the settled body is what there is.
  void take_back_all(std::int64_t sample, std::vector<AdaptationEvent>* events);
  /// What stands or is detected of these elements, if it began no earlier than `since`, is taken
  /// back, and told; `clean` takes from the samples since what was wrong.
  void take_back(const std::function<bool(const ElementId&)>& is_at, std::int64_t since,
                 const Filter& clean, std::int64_t sample, std::vector<AdaptationEvent>* events);

  AdaptationEvent event(AdaptationEvent::Kind kind, std::int64_t sample,
                        const ElementId& element) const;

 private:
  struct Hypothesis {
    std::vector<Change> changes;
    BodySchema body;
    std::shared_ptr<const TreeFilter> filter;
    double log_odds = 0;
  };
  struct Seen {
    ActionPoseSample sample;
    double settled = 0;  ///< log p under the settled body
  };
  /// What settled, on what, and since when: its parameters go on being fitted for a while.
  struct Maturing {
    BodySchema base;
    std::vector<Change> changes;
    std::int64_t adopted = 0;
  };

  /// The same explanation since the same sample.
  static bool is_same_change(const Change& a, const Change& b);
  /// The newest change there, which is the one that holds now.
  static const Change* last_at(const std::vector<Change>& changes, const ElementId& element);
  const Hypothesis& standing() const { return beam_.front(); }
  /// The same explanation, whatever its parameters.
  bool is_standing(const std::vector<Change>& changes) const;
  std::int64_t newest_adopted() const;
  Hypothesis made_of(std::vector<Change> changes) const;
  BodySchema composed(const std::vector<Change>& changes, std::size_t without) const;
  /// Σ log priors and log-likelihood ratios of all samples since its first change.
  double log_odds_of(const std::vector<Change>& changes) const;
  FoundChanges search(const BodySchema& base, const std::vector<ElementId>& elements,
                      const std::vector<const ActionPoseSample*>& samples,
                      const BodyChange* standing_form);
  void offer(Hypothesis hypothesis);
  void propose_more(std::int64_t now);
  void propose_learned(std::int64_t now);
  void propose_again(std::int64_t now, std::vector<AdaptationEvent>* events);
  /// Fits every young change again, given the others; with `all_forms` each may become another.
  Hypothesis fitted_again(Hypothesis hypothesis, bool all_forms, int longest, std::int64_t now);
  void refit(const BodySchema& others, int longest, Change* change) const;
  /// Another form, or element, of a change; std::nullopt if there is none.
  std::optional<Replacement> best_form(const Hypothesis& of, const Change& change,
                                       const BodySchema& others, std::int64_t now);
  /// Of the parts that it moves no more outliers, since then, than come in a row by chance.
  bool may_be_outliers(const ElementId& element, std::int64_t since) const;
  double needed_lead(const Hypothesis& other, std::int64_t now) const;
  void choose(std::int64_t now, std::vector<AdaptationEvent>* events);
  void stand(Hypothesis next, std::int64_t now, std::vector<AdaptationEvent>* events);
  void tell_difference(const Hypothesis& before, const Hypothesis& after, std::int64_t sample,
                       std::vector<AdaptationEvent>* events) const;
  void tell(AdaptationEvent::Kind kind, std::int64_t sample, const Hypothesis& of,
            const Change& change, double margin, std::vector<AdaptationEvent>* events) const;
  void want_probe(std::int64_t now, std::vector<AdaptationEvent>* events);
  void detect(std::int64_t now, std::vector<AdaptationEvent>* events);
  void drop_stale();
  void note_mismatch(const ElementId& element, std::int64_t now);
  void settle(std::int64_t now, std::vector<AdaptationEvent>* events);
  void mature(std::int64_t now);
  /// CUSUMs of `filter` over the kept samples from `since` on.
  SequentialTests tests_of(const TreeFilter& filter, std::int64_t since) const;
  void begin_tests(std::int64_t since);
  /// Suspected under the settled body by the samples from `since` on.
  std::vector<ElementId> suspects_of_settled(std::int64_t since) const;
  /// The samples from `since` on are judged by it.
  void set_settled(const BodySchema& settled, std::int64_t since = 0);

  const AdaptationOptions options_;
  const bool is_soft_;
  MeasurementModel measurement_;
  BodySchema settled_;
  std::shared_ptr<const TreeFilter> settled_filter_;
  std::vector<Hypothesis> beam_;  ///< the standing one first
  std::optional<SequentialTests> tests_;
  std::deque<Seen> recent_;
  std::vector<BodySchema> history_;  ///< the first is pinned
  std::optional<Maturing> maturing_;
  std::optional<ElementId> detected_;
  bool is_told_ = false;   ///< that and where something was detected
  double unreported_ = 0;  ///< CUSUM at the latest detection [nats]
  std::int64_t last_mismatch_ = -1000;
  std::map<ElementId, std::int64_t> mismatched_;  ///< in the present trouble → the newest
  std::vector<std::pair<Replacement, Replacement>> asked_;  ///< a probe was wanted for
  int work_budget_;  ///< work that may be done now; see kWorkPerSample
};

}  // namespace bodyschema
