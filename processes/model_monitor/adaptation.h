#pragma once

#include <cstdint>
#include <optional>
#include <utility>
#include <vector>

#include "processes/model_monitor/health/adaptation_event.h"
#include "processes/model_monitor/health/fallen_markers.h"
#include "processes/model_monitor/health/misreadings.h"
#include "processes/model_monitor/health/moved_tags.h"
#include "processes/model_monitor/health/visibility_watch.h"
#include "processes/model_monitor/hypotheses/alternations.h"
#include "processes/model_monitor/hypotheses/drift_watch.h"
#include "processes/model_monitor/hypotheses/hypothesis_tracker.h"
#include "processes/model_monitor/sample_stream.h"

namespace bodyschema {

/// Keeps a complete body schema true while the body changes (Section 4 of the chapter).
///
/// A sample is first cleaned of what no change of the body explains: markers that fell, tags that
/// moved on their part (FallenMarkers, MovedTags). HypothesisTracker finds which changes the body
/// made. A drift looks like one step after another: it competes with the steps by its evidence
/// (begun_drifts), and is then followed by DriftWatch until it moves no more. Steps and drifts too
/// small for the CUSUMs are found by DriftWatch's means over many samples. An edge that comes and
/// goes (Alternations) is told once, and cut until it is over.
///
/// The noise is taken as it is seen: its size, the rate of outliers, where they lie (Misreadings),
/// and how many independent samples one is worth where it is correlated. Repetitions of a sample
/// (SampleStream) are neither looked at nor counted.
///
/// A soft edge may be wrong by many standard deviations in a bend that was never shown: then
/// noise_scale() stays at 1 or above, and nothing is found out from fewer than three samples.
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
  EdgeState edge_state(int part) const { return state_of(edge_element(part, schema_.root)); }
  EdgeState marker_state(int part) const { return state_of(tag_element(part)); }
  /// True over assumed standard deviation of the markers, as the residuals of quiet samples show
  /// it.
  double noise_scale() const { return measurement_.scale; }
  const MeasurementModel& measurement() const { return measurement_; }
  /// Parts whose markers have not been seen for longer than chance explains.
  std::vector<int> missing_parts() const { return visibility_.missing_parts(); }
  bool is_drifting(int part) const { return drifting_ == part; }
  /// Its edge drifts, or comes and goes.
  bool is_followed(int part) const { return drifting_ == part || intermittent_ == part; }
  /// First sample with the body as the newest change left it.
  std::int64_t since() const;
  const std::vector<BodySchema>& history() const { return tracker_.history(); }
  const AdaptationOptions& options() const { return options_; }
  /// Samples that were judged, and those that the noise was estimated from.
  std::int64_t num_samples() const { return num_samples_; }
  bool is_settled() const {
    return tracker_.changes().empty() && !tracker_.detected() && !drifting_ && !intermittent_;
  }

 private:
  /// Of what is no repetition; its index is SampleStream::count().
  std::vector<AdaptationEvent> on_new_sample(ActionPoseSample sample);
  EdgeState state_of(const ElementId& element) const;
  void calibrate(const std::vector<ActionPoseSample>& samples);
  void set_noise_scale(double scale);
  void watch_noise(const TreeFilter::Judgement& judgement);
  /// As the told one and those counted make it.
  double outlier_rate() const;
  void count_outliers(const TreeFilter::Judgement& judgement);
  /// How rare outliers are, and how much correlated samples are worth, as seen so far.
  void update_measurement();
  void watch_misreadings(const ActionPoseSample& sample,
                         const std::vector<AdaptationEvent>& events);
  /// The same small change again soon after, or beside it, is a drift that was not understood yet.
  void watch_small_changes(std::int64_t sample_index, std::vector<AdaptationEvent>* events);
  /// An edge in trouble may drift.
  void try_drift(std::int64_t sample_index, std::vector<AdaptationEvent>* events);
  /// What is too small for the CUSUMs: a step, or a drift.
  void watch_small_means(std::int64_t sample_index, std::vector<AdaptationEvent>* events);
  void begin_drift(int part, std::int64_t since, std::int64_t sample_index,
                   std::vector<AdaptationEvent>* events);
  void end_drift(std::int64_t since, const Drift& drift, std::int64_t sample_index,
                 std::vector<AdaptationEvent>* events);
  /// An edge that comes and goes is told once; until it is over its model is as uncertain as it
  /// goes far, and nothing is adopted for it.
  void watch_alternations(std::int64_t sample_index, std::vector<AdaptationEvent>* events);
  void begin_intermittence(const Alternations::Found& found, std::int64_t sample_index,
                           std::vector<AdaptationEvent>* events);
  void watch_drift(std::int64_t sample_index, std::vector<AdaptationEvent>* events);
  void drop_turned_over(ActionPoseSample* sample) const;
  void drop_fallen(ActionPoseSample* sample, std::vector<AdaptationEvent>* events);
  /// `used`: without what is not believed.
  void watch_visibility(const ActionPoseSample& sample, const ActionPoseSample& used,
                        std::vector<AdaptationEvent>* events);
  void set_aside(int tag, std::int64_t since, std::int64_t found);
  void watch_tags(ActionPoseSample* sample, std::vector<AdaptationEvent>* events);
  void take_back(const MovedTags::Finding& moved, std::int64_t sample_index,
                 std::vector<AdaptationEvent>* events);
  /// What an event says of the samples as they are numbered outside, and of what stands after it.
  void complete(std::int64_t sample_index, AdaptationEvent* event) const;

  const bool is_soft_;  ///< some edge has a residual GP
  const AdaptationOptions options_;
  MeasurementModel measurement_;
  int num_samples_ = 0;
  std::vector<double> quiet_distances_;  ///< d² of believed markers since the noise was last set
  int num_quiet_ = 0;
  double num_read_ = 0, num_outliers_ = 0;  ///< readings of markers lately, with fading weights
  HypothesisTracker tracker_;
  VisibilityWatch visibility_;
  FallenMarkers fallen_;
  Misreadings misreadings_;
  MovedTags tags_;
  /// Tags that moved, or were lost, where others of their part stayed: what rests on them is left
  /// out until they are seen in their places again. schema_ has them, too.
  std::vector<MovedTag> moved_tags_;
  BodySchema schema_;  ///< the tracker's, with the moved tags
  SampleStream stream_;
  DriftWatch drift_watch_;
  std::optional<int> drifting_;  ///< the edge to this part
  BodySchema before_;            ///< the schema without the drift, or without what comes and goes
  Alternations alternations_;
  std::optional<int> intermittent_;      ///< the edge to this part
  std::int64_t intermittent_since_ = 0;  ///< the sample at which that was found
  int num_still_ = 0;                    ///< samples since the drift last moved
  /// The place of the last small change, and when.
  std::optional<std::pair<int, std::int64_t>> last_small_;
};

}  // namespace bodyschema
