#pragma once

#include <cstdint>
#include <deque>
#include <map>
#include <optional>
#include <vector>

#include "bodyschema/finding_t.hpp"
#include "bodyschema/health_event_t.hpp"
#include "bodyschema/model_health_t.hpp"
#include "common/schema/body_schema.h"
#include "common/schema/sample.h"
#include "processes/model_monitor/adaptation.h"
#include "processes/model_monitor/health/findings.h"

namespace bodyschema {

/// The body schema from a complete and confirmed one on, the base: what Adaptation finds, with what
/// the wire says of it: versions, states, since when an edge holds. A pure function of what it was
/// made with and the samples.
class LiveSchema {
 public:
  /// `past`: the newest samples up to the base's last. `findings`: what was wrong by then.
  LiveSchema(BodySchema base, AdaptationOptions options, std::vector<BodySchema> history,
             const std::vector<ActionPoseSample>& past,
             const std::vector<finding_t>& findings = {});

  /// What was decided at this sample.
  /// @throws std::invalid_argument if the action does not have one value per signal.
  std::vector<AdaptationEvent> on_sample(const ActionPoseSample& sample);

  /// Version s + 1 if it changed last at sample s; base_version is that of the base.
  const BodySchema& schema() const { return schema_; }
  const BodySchema& base() const { return base_; }
  const std::vector<BodySchema>& history() const { return adaptation_.history(); }
  /// What is wrong with the body now.
  std::vector<finding_t> findings() const;
  /// A change of the body is suspected, or found and not settled, or a marker is missing.
  bool is_in_doubt() const;
  /// The first sample that all of the schema holds for.
  std::int64_t body_since() const;
  /// The same for the way from the camera to a part.
  std::int64_t holds_since(int part) const;
  /// Samples judged that were no repetitions of others.
  std::int64_t num_judged() const { return adaptation_.num_samples(); }
  /// Of these samples another schema over this one, and over the base before `since` [nats].
  double log_likelihood_ratio(const BodySchema& other,
                              const std::vector<const ActionPoseSample*>& samples,
                              std::int64_t since = 0) const;
  /// What was decided up to this sample was held back, and is known from the next one on.
  void tell(std::int64_t sample_index, std::int64_t utime);

  /// States, flags and statistics of health->edge_health and part_health, whose ids are set; noise,
  /// probe and findings.
  void describe(model_health_t* health) const;

 private:
  /// Nothing that is in the schema was known before known_from_.
  void stamp(BodySchema* schema) const;
  void watch_flips(const ActionPoseSample& sample);
  EdgeState state_of(const Edge& edge) const;
  /// State and confidence of an edge that changed or is suspected.
  void rate(std::int64_t sample_index, Edge* edge) const;
  void update(const ActionPoseSample& sample, std::optional<std::int64_t> changed_since,
              std::optional<int> unchanged_part, std::optional<int> drifting_part);

  const BodySchema base_;
  Adaptation adaptation_;
  Findings findings_;
  BodySchema schema_;
  std::int64_t camera_since_ = 0;  ///< first sample that X_CR holds for
  std::int64_t known_from_ = 0;
  std::int64_t probe_sample_ = -1;
  Eigen::VectorXd probe_;
  std::map<int, std::deque<bool>> flipped_;  ///< part → newest sightings: the other pose was right
};

/// As the wire has it, without its number.
health_event_t to_message(const AdaptationEvent& event, const std::vector<Signal>& signals,
                          std::int64_t utime);

}  // namespace bodyschema
