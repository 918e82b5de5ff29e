#pragma once

#include <cstdint>
#include <deque>
#include <filesystem>
#include <map>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "bodyschema/body_schema_t.hpp"
#include "bodyschema/model_health_t.hpp"
#include "bodyschema/sample_t.hpp"
#include "common/bus/awaited_answer.h"
#include "common/camera/lens.h"
#include "common/camera/tag_sight.h"
#include "common/config/refinement_schedule.h"
#include "common/config/rig.h"
#include "common/schema/body_schema.h"
#include "common/schema/sample.h"
#include "processes/model_monitor/health/baseline_youth.h"
#include "processes/model_monitor/live_schema.h"
#include "processes/model_monitor/monitor_memory.h"

namespace bodyschema {

/// What the rig's files say of how tags are seen.
struct TagView {
  Markers markers;
  Lens lens;
  CornerNoise corner_noise;

  /// @throws ConfigError.
  static TagView load(const std::filesystem::path& rig_folder);
};

struct ModelMonitorConfig {
  double max_mahalanobis2 = 0;   ///< d² above which a TEST observation counts as refuting
  double max_outlier_share = 0;  ///< an edge is refuted if more than this share of its tests refute
  MeasurementModel measurement;  ///< of noise.yaml
  /// Wished false alarms a sample once a complete schema stands; 0: nothing is adapted.
  double false_alarm_rate = 1e-5;
  /// A refiner answers the complete proposals on the TEST samples of this RefinementSchedule; 0:
  /// there is none.
  std::int64_t refine_every = 0;
  /// What refined schemas are judged by; none: they are not taken.
  std::optional<TagView> view;

  /// Reads model_monitor.yaml and the noise.yaml beside it. @throws ConfigError.
  static ModelMonitorConfig load(const std::filesystem::path& file);
};

/// The only publisher of BODY_SCHEMA.
///
/// A proposal of the learner becomes the body schema when the TEST samples up to its last sample,
/// which it was not trained on, refute none of its edges, and when it is no step back from a
/// complete schema to an incomplete one. Edges that no TEST sample judged yet are provisional.
///
/// From the first complete one on every sample is judged at once (LiveSchema), and a change of the
/// body changes the schema. Until one is found or suspected, later proposals replace the schema.
/// After a change they must rest on the samples since it alone, have the same tree and predict its
/// TEST samples better.
///
/// As long as the schema is young (BaselineYouth), that it was wrong from the start is likelier
/// than that the body changed: a change is held back and competes with each proposal of the
/// learner, which goes on with all samples. The proposal becomes the base, or the change is told,
/// or both wait.
///
/// The schema after sample n is a pure function of the samples 0..n, however fast the learner is: a
/// proposal on samples up to t, a TEST sample, is judged by the state after t, which is kept until
/// then, and the samples since are gone through again. What was published for these in between was
/// provisional. Version n+1 changed last at sample n.
///
/// A proposal that a refiner answers is judged once its answer is there; a silent refiner is waited
/// for half a minute, once. The actions that the answer wants are passed on as long as the body
/// schema is of the same tree and body. The refined schema takes the place of the proposal where it
/// predicts the corners of the TEST samples better (is_likelier()) by the rig's own tags and lens;
/// where those are worse than its own, they must be adopted first. Until the body changes, only
/// what predicts these corners better still may replace it.
///
/// Before the first accepted proposal nothing is published; when inputs stop, the last schema
/// stands.
class ModelMonitor {
 public:
  explicit ModelMonitor(ModelMonitorConfig config);

  /// Before the samples are gone through again: the state after them is as if there was no restart.
  void restore(const MonitorMemory& memory);
  /// Begins with a schema of this run whose memory was lost: it holds for the samples after its
  /// last. Of another run's, or an engineered one, last_sample_index must be −1.
  void start_from(const body_schema_t& schema);

  /// Returns true if schema() or memory() may have changed.
  bool on_sample(const sample_t& sample);
  /// Returns true if the proposal was judged: only those whose last sample is a TEST sample are.
  bool on_learned_schema(const body_schema_t& proposal);
  /// The refiner's answer to a proposal. Returns true if schema() or health() may have changed.
  bool on_refined_schema(const body_schema_t& refined);
  /// `now_us`: the clock. Returns true if a silent refiner is given up.
  bool on_tick(std::int64_t now_us);
  /// Last sample of the proposal that waits for the refiner; −1: none does.
  std::int64_t awaited_refinement() const {
    return refinements_.is_waiting() ? refinements_.question() : -1;
  }

  /// The body schema; std::nullopt before the first.
  const std::optional<body_schema_t>& schema() const { return schema_message_; }
  /// As of the newest sample; what TEST samples say is as of the newest judged one.
  const model_health_t& health() const;
  /// What a restart needs beside the samples.
  const MonitorMemory& memory() const { return memory_; }

 private:
  struct EdgeTest {
    int num_tests = 0;
    int num_refuting = 0;
    double median_mahalanobis2 = -1;
  };
  /// All there is after a sample. A value: copies share what none of them changes.
  struct Standing {
    std::int64_t sample_index = -1;
    std::optional<BodySchema> proposed;      ///< accepted, while the learner leads
    std::shared_ptr<const LiveSchema> live;  ///< afterwards
    BaselineYouth youth;                     ///< of live's base
    std::vector<health_event_t> events;      ///< the newest
    std::int64_t num_events = 0;

    /// Changes are found and held back.
    bool is_holding_back() const { return live && youth.has_story(); }
    const BodySchema* schema() const {
      if (live) return is_holding_back() ? &live->base() : &live->schema();
      return proposed ? &*proposed : nullptr;
    }
    void add(health_event_t event);
    /// The body did change.
    void tell(std::int64_t utime);
  };

  static bool fits(const BodySchema& schema, const ActionPoseSample& sample);
  bool is_test(std::int64_t sample_index) const;
  /// TEST samples up to this one.
  std::int64_t num_tests(std::int64_t last) const;
  /// The newest of these TEST samples, oldest first; both ends included.
  std::vector<const ActionPoseSample*> tests_between(std::int64_t first, std::int64_t last) const;
  /// Edges between the same parts, by the same signals.
  static bool has_same_tree(const BodySchema& a, const BodySchema& b);
  static constexpr std::size_t kMaxEvents = 32;   ///< told at once
  static constexpr std::size_t kMaxWaiting = 32;  ///< proposals, and answers
  /// Chosen: a fit of 32 parts to 400 samples takes 30 s of an idle core.
  static constexpr std::int64_t kRefinerTimeout_us = 120'000'000;
  /// What a sample shows of a part, unless it rests on tags that had moved.
  static const PartObservation* sighting(const ActionPoseSample& sample, int part,
                                         const std::vector<MovedTag>& moved);
  EdgeTest test(const BodySchema& schema, const Edge& edge, std::int64_t first,
                std::int64_t last) const;
  /// `standing` one sample later. Verdicts that a restart remembers are spoken again.
  void advance(Standing* standing, const ActionPoseSample& sample) const;
  Standing standing_after(std::int64_t sample_index) const;
  /// From the state after a judged sample, which is final. `is_changed`, by the verdict: later
  /// samples are gone through again.
  void go_on_from(Standing standing, bool is_changed);
  void keep(const Standing& standing);
  std::shared_ptr<const LiveSchema> begin(BodySchema base, std::vector<BodySchema> history,
                                          std::int64_t up_to_sample) const;
  /// "" or why the proposal is not better than what stands; sets the states of its edges.
  std::string objection(BodySchema* proposal, const Standing& standing, bool* was_tested) const;
  /// It rests, or may rest, on samples of an earlier body, or explains less than what stands.
  bool is_passed_over(const BodySchema& proposal, const Standing& standing) const;
  void judge(const body_schema_t& proposal);
  void remember_refusal(const health_event_t& event);
  /// Those whose samples, and whose refinement, are there. Returns true if there were any.
  bool judge_waiting();
  bool waits_for_refiner(const body_schema_t& proposal);
  /// Those whose samples are there, and which were asked for. Returns true if there were any.
  bool take_answers();
  /// The wanted actions are of the same body.
  bool are_wanted_for(const BodySchema& schema) const;
  static std::int64_t body_since(const BodySchema& proposal);
  /// The proposal, or the refiner's answer to it if that predicts corners better.
  BodySchema better_one(BodySchema learned) const;
  /// The proposal shows no part that the refined schema lacks, nor predicts corners better.
  bool is_defended(const BodySchema& refined, const BodySchema& proposal) const;
  /// Those of the parts of both, in the TEST samples of the body of `schema`, up to `last`.
  bool predicts_corners_better(const BodySchema& schema, const BodySchema& other,
                               std::int64_t last) const;
  /// −log likelihood of each TEST sample that shows tags.
  std::vector<double> corner_costs(const BodySchema& schema, const BodySchema& other,
                                   std::int64_t first, std::int64_t last) const;
  void set_base(Standing* standing, BodySchema base);
  void publish();
  void assess(const BodySchema& schema) const;

  const ModelMonitorConfig config_;
  AdaptationOptions options_;
  /// Indices of samples, of which those up to the judged one are only counted.
  struct Tally {
    std::int64_t num_judged = 0;
    std::deque<std::int64_t> later;

    std::int64_t up_to(std::int64_t judged_sample);
  };
  mutable Tally test_indices_;                            ///< of TEST samples
  std::deque<ActionPoseSample> tests_;                    ///< the newest
  std::map<std::int64_t, std::vector<TagSight>> sights_;  ///< of tests_, by index
  std::deque<ActionPoseSample> samples_;  ///< the newest, back to where anything may begin again
  mutable std::map<int, Tally> seen_in_;  ///< part → samples that show it
  std::int64_t last_sample_index_ = -1;
  std::int64_t judged_sample_ = -1;
  std::int64_t judged_utime_ = 0;
  std::int64_t restored_sample_ = -1;  ///< where what was restored begins
  /// Proposals that are ahead of the samples heard here or of the refiner, by their last sample.
  std::map<std::int64_t, body_schema_t> waiting_;
  RefinementSchedule schedule_;
  std::set<std::int64_t> due_;  ///< samples whose complete proposals the refiner answers
  AwaitedAnswer refinements_;
  /// Answers that are ahead of the samples heard here, by their last sample.
  std::map<std::int64_t, body_schema_t> answers_;
  std::optional<BodySchema> refined_;  ///< the newest answer
  std::vector<wanted_action_t> wanted_;
  Standing now_;
  /// After TEST samples: the newest judged one and those that wait for a verdict.
  std::map<std::int64_t, Standing> kept_;
  std::optional<body_schema_t> schema_message_;
  MonitorMemory memory_;
  bool is_rewound_ = false;  ///< versions may come again with another content
  mutable model_health_t health_{};
  mutable bool is_assessed_ = false;
};

}  // namespace bodyschema
