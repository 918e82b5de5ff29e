#pragma once

#include <cstdint>
#include <deque>
#include <map>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "processes/model_monitor/body_change.h"
#include "processes/model_monitor/change_search.h"
#include "processes/model_monitor/change_size.h"
#include "processes/model_monitor/drift_watch.h"
#include "processes/model_monitor/fallen_markers.h"
#include "processes/model_monitor/moved_tags.h"
#include "processes/model_monitor/sample_stream.h"
#include "processes/model_monitor/sequential_tests.h"
#include "processes/model_monitor/tree_filter.h"
#include "processes/model_monitor/visibility_watch.h"

namespace bodyschema {

struct AdaptationOptions {
  MeasurementModel measurement;
  /// Wished false alarms a sample, over all tests together.
  double false_alarm_rate = 1e-5;
  /// Below it noise_scale() does not go. 1 where the assumed noise has room for rare errors that a
  /// median does not see, as the view-dependent bias of real markers.
  double least_noise_scale = 0.2;
  double suspicion = 1.5;  ///< CUSUM above which candidates are tried [nats]
  double acceptance = 12;  ///< evidence over the schema that stands [nats]
  double ambiguity = 6;    ///< a runner-up nearer than this asks for a probe [nats]
  /// Disagreement of two explanations, anywhere in reach, that is worth a motion.
  Noise tolerance{0.02, 0.1};
  /// Samples at the start from which the noise is estimated before anything is judged.
  int calibration_samples = 8;
  int longest_segment = 40;  ///< samples since a change that are looked at
  int settled_after = 40;    ///< samples until a replacement is kept for good
  /// Samples of the changed body from which its parameters are estimated in the end: what has
  /// settled is still fitted anew now and then. (96 samples are remembered.)
  int matured_after = 90;
  std::size_t history = 8;  ///< schemas kept beside the first
};

/// Something that the adaptation decided at one sample.
struct AdaptationEvent {
  enum class Kind {
    kMismatch,
    kCandidate,
    kRefined,
    kRestored,
    kReverted,
    kRecovered,
    kDrift,
    kMissing,
    kProbeWanted
  };
  Kind kind = Kind::kMismatch;
  std::int64_t sample_index = 0;
  int from = -1;  ///< parts of an edge; −1 for a part alone or the camera
  int to = -1;
  int part = -1;  ///< of a marker; −1 for an edge
  int tag = -1;   ///< the one of the part's tags that it is about; −1: all
  std::string cause;
  ChangeSize size;
  std::int64_t since = -1;  ///< first sample that shows it; −1: not told
  bool is_normal = false;   ///< of what was stored: the place is as in the first schema again
  /// Evidence over the schema that stood before; kProbeWanted: between the explanations [nats].
  double margin = 0;
  int num_samples = 0;
  /// kProbeWanted: the action at which the two likeliest explanations disagree most; else empty.
  Eigen::VectorXd probe;
};
const char* name_of(AdaptationEvent::Kind kind);

/// Keeps a complete body schema true while the body changes (Section 4 of the chapter).
///
/// Every sample is judged by a tree filter under the schema and, for every edge and every marker,
/// under the hypothesis that this one is wrong. The log-likelihood ratios are summed by one CUSUM
/// each; since they are proper, ln(2n/α) is the threshold for α false alarms a sample. From a
/// suspicion on, replacements are fitted to the samples since its beginning: what is in the
/// history, then changes of the old model from simple to complex. The one with the most evidence
/// replaces the old one as soon as it leads by `acceptance`; it is refitted as samples come,
/// reverted if it falls behind, kept in the history once it has settled, and its parameters (those
/// of small changes apart, which may be drifts) are estimated anew until there are `matured_after`
/// samples.
///
/// What changes all the time looks like one step after another. An edge that stays suspicious, or
/// one beside it, may therefore have drifted since the first of them: at a constant rate, from
/// nothing (begun_drifts). If that has `acceptance` more evidence than the steps, they are undone
/// and the edge is followed by DriftWatch until it moves no more. A drift too slow for the CUSUMs
/// is found by DriftWatch itself.
///
/// What repeats another sample (SampleStream) is neither looked at nor counted. Where an edge is
/// soft the assumed noise has room for what its model leaves, so noise_scale() stays at 1 or above,
/// and nothing is found out from fewer than three samples, however loud: a bend that was never
/// shown may be wrong by many standard deviations.
class Adaptation {
 public:
  Adaptation(BodySchema schema, AdaptationOptions options);
  /// Begins with what is remembered: schemas of an earlier time, the first pinned, and samples from
  /// before, of which those that are TEST tell the noise and all tell how often a part is seen. No
  /// sample is then spent on calibration.
  Adaptation(BodySchema schema, AdaptationOptions options, std::vector<BodySchema> history,
             const std::vector<ActionPoseSample>& past);

  /// The events of this sample. A pure function of the samples so far. Parts that the schema does
  /// not know are ignored.
  /// @throws std::invalid_argument, and is as it was, if the action does not have one value per
  /// signal or a number is not finite.
  std::vector<AdaptationEvent> on_sample(const ActionPoseSample& sample);
  const BodySchema& schema() const { return schema_; }
  /// CUSUM of the edge to a part (root: the camera's) and of the part's marker [nats].
  double edge_statistic(int part) const;
  double marker_statistic(int part) const;
  /// Of the edge to a part (root: of the camera's pose) and of the part's marker: kSuspect while a
  /// CUSUM is up, kInvalid from detection to replacement, kProvisional until that has settled, or
  /// while it drifts.
  EdgeState edge_state(int part) const { return state_of({part, false}); }
  EdgeState marker_state(int part) const { return state_of({part, true}); }
  /// True over assumed standard deviation of the markers, as the residuals of quiet samples show
  /// it.
  double noise_scale() const { return measurement_.scale; }
  const MeasurementModel& measurement() const { return measurement_; }
  /// Parts whose markers have not been seen for longer than chance explains.
  std::vector<int> missing_parts() const { return visibility_.missing_parts(); }
  bool is_drifting(int part) const { return drifting_ == part; }
  /// First sample with the body as changed by the replacements that have not settled.
  std::int64_t since() const { return stream_.sample_index_of(since_); }
  const std::vector<BodySchema>& history() const { return history_; }
  const AdaptationOptions& options() const { return options_; }
  /// Samples that were judged, and those that the noise was estimated from.
  std::int64_t num_samples() const { return num_samples_; }
  bool is_settled() const { return replacements_.empty() && !detected_ && !drifting_; }

 private:
  /// Of what is no repetition; its index is SampleStream::count().
  std::vector<AdaptationEvent> on_new_sample(ActionPoseSample sample);
  EdgeState state_of(const Place& place) const;
  void calibrate();
  /// What changes all the time looks like one step after another: an edge in trouble may drift.
  void try_drift(std::int64_t sample_index, std::vector<AdaptationEvent>* events);
  /// Evidence of what stands for these samples: each under what stood then, with the priors of all
  /// that was adopted since the trouble began.
  double standing_evidence(const std::vector<const ActionPoseSample*>& samples) const;
  void begin_drift(int part, std::int64_t since, std::int64_t sample_index,
                   std::vector<AdaptationEvent>* events);
  void end_drift(std::int64_t since, const Drift& drift, std::int64_t sample_index,
                 std::vector<AdaptationEvent>* events);
  void watch_drift(std::int64_t sample_index, std::vector<AdaptationEvent>* events);
  void watch_noise(const TreeFilter::Judgement& judgement);
  std::vector<const ActionPoseSample*> segment(std::int64_t since, int longest) const;
  std::vector<Place> suspects() const { return tests_->suspects(*filter_, options_.suspicion); }
  FoundChanges search(const BodySchema& standing, const std::vector<Place>& places,
                      const std::vector<const ActionPoseSample*>& samples,
                      const BodyChange* standing_form = nullptr);
  /// before_ with the replacements; of those in one place one may have taken the joint of another,
  /// which is then left out.
  BodySchema composed(int without = -1) const;
  void drop_impossible(std::int64_t sample_index, std::vector<AdaptationEvent>* events);
  /// Evidence that a change must have over the schema that stands [nats]: more where changes were
  /// taken back lately.
  double required_margin(const Place& place, std::int64_t sample_index) const;
  void try_changes(std::int64_t sample_index, std::vector<AdaptationEvent>* events);
  void note_trouble(const AdaptationEvent& mismatch, std::int64_t since);
  /// Learns an edge anew of which no family of changes was right.
  void try_learning(std::int64_t sample_index, std::vector<AdaptationEvent>* events);
  void reconsider(std::int64_t sample_index, bool all_forms, std::vector<AdaptationEvent>* events);
  /// In its first samples a change may turn out to be one of what is next to its place.
  bool reconsider_place(const std::vector<const ActionPoseSample*>& samples,
                        std::int64_t sample_index, std::vector<AdaptationEvent>* events);
  void want_probe(const BodySchema& standing, const FoundChanges& choice, std::int64_t sample_index,
                  std::vector<AdaptationEvent>* events);
  void drop_turned_over(ActionPoseSample* sample) const;
  void drop_fallen(ActionPoseSample* sample, std::vector<AdaptationEvent>* events);
  /// `used`: without what is not believed.
  void watch_visibility(const ActionPoseSample& sample, const ActionPoseSample& used,
                        std::vector<AdaptationEvent>* events);
  void set_aside(int tag, std::int64_t since, std::int64_t found);
  void watch_tags(ActionPoseSample* sample, std::vector<AdaptationEvent>* events);
  void take_back(const MovedTags::Finding& moved, std::int64_t sample_index,
                 std::vector<AdaptationEvent>* events);
  void follow(std::int64_t sample_index, std::vector<AdaptationEvent>* events);
  void mature(std::int64_t sample_index, std::vector<AdaptationEvent>* events);
  void remember(const BodySchema& schema);
  void install(const BodySchema& schema);
  AdaptationEvent event(AdaptationEvent::Kind kind, std::int64_t sample_index,
                        const Place& place) const;
  /// Against what stands without it.
  ChangeSize size_of(const Replacement& replacement) const;
  /// What an event says of the samples as they are numbered outside, and of what stands after it.
  void complete(std::int64_t sample_index, AdaptationEvent* event) const;
  /// Tells the same of every place of a replacement.
  void tell(AdaptationEvent::Kind kind, std::int64_t sample_index, const Replacement& replacement,
            double margin, int num_samples, std::vector<AdaptationEvent>* events) const;

  const bool is_soft_;  ///< some edge has a residual GP
  const AdaptationOptions options_;
  MeasurementModel measurement_;
  int num_samples_ = 0;
  int credit_;                           ///< work that may be done now; see kWorkPerSample
  std::vector<double> quiet_distances_;  ///< d² of believed markers since the noise was last set
  int num_quiet_ = 0;
  BodySchema schema_;
  std::optional<TreeFilter> filter_;
  std::deque<ActionPoseSample> recent_;
  VisibilityWatch visibility_;
  FallenMarkers fallen_;
  MovedTags tags_;
  /// Tags that moved, or were lost, where others of their part stayed: what rests on them is left
  /// out until they are seen in their places again. schema_ has them, too.
  std::vector<MovedTag> moved_tags_;
  BodySchema trusted_;  ///< what settled last
  SampleStream stream_;
  std::optional<SequentialTests> tests_;
  std::optional<Place> detected_;
  bool is_told_ = false;  ///< that and where something was detected
  double untold_ = 0;     ///< the highest CUSUM when it was not told yet
  struct Reversions {
    int num = 0;
    std::int64_t last = 0;
  };
  std::map<Place, Reversions> reversions_;  ///< changes that were taken back
  /// A mismatch that came up again and again, or that nothing was accepted for.
  struct Trouble {
    std::int64_t since = 0, last = 0;  ///< first sample; newest mismatch
    int last_part = -1;                ///< of that
    struct Edge {
      int num_mismatches = 0;
      std::int64_t since = 0;  ///< the first
    };
    std::map<int, Edge> edges;         ///< by the part that they lead to
    BodySchema before;                 ///< what stood when it began
    std::vector<Replacement> adopted;  ///< since, and taken as they are
    struct Stage {
      BodySchema schema;
      std::int64_t until = 0;
    };
    std::vector<Stage> stages;  ///< what stood, one after the other, until before_ did
  };
  std::optional<Trouble> trouble_;
  BodySchema before_;                      ///< what stood before the present replacements
  std::vector<Replacement> replacements_;  ///< not settled yet, in the order they came
  std::vector<Replacement> maturing_;      ///< settled, on before_, and fitted anew now and then
  std::int64_t since_ = 0;                 ///< first sample with the changed body, as counted
  std::int64_t reformed_at_ = -1;          ///< sample in which one of them took another form
  struct Ambiguity {
    Place place;
    BodyChange one, other;
    bool is(const Ambiguity& a) const {
      return place == a.place &&
             ((one == a.one && other == a.other) || (one == a.other && other == a.one));
    }
  };
  std::vector<Ambiguity> asked_;  ///< for which a probe was wanted since since_
  DriftWatch drift_watch_;
  std::optional<int> drifting_;  ///< the edge to this part; before_ is the schema without the drift
  /// The place of the last small change, and when: the same again soon after is a drift.
  std::optional<std::pair<int, std::int64_t>> last_small_;
  int num_still_ = 0;                ///< samples since the drift last moved
  int age_ = 0;                      ///< samples since the newest replacement
  std::vector<BodySchema> history_;  ///< the first is pinned
};

}  // namespace bodyschema
