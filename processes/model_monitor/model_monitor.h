#pragma once

#include <cstdint>
#include <filesystem>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "bodyschema/body_schema_t.hpp"
#include "bodyschema/model_health_t.hpp"
#include "bodyschema/sample_t.hpp"
#include "common/schema/body_schema.h"
#include "common/schema/sample.h"

namespace bodyschema {

struct ModelMonitorConfig {
  double max_mahalanobis2 = 0;   ///< d² above which a TEST observation counts as refuting
  double max_outlier_share = 0;  ///< an edge is refuted if more than this share of its tests refute
  Noise model_error;             ///< added to every Σ_z: the view-dependent bias of real markers

  /// Reads model_monitor.yaml. @throws ConfigError.
  static ModelMonitorConfig load(const std::filesystem::path& file);
};

/// The only publisher of BODY_SCHEMA. A proposal of the learner becomes the body schema when none
/// of its edges is refuted by the TEST samples up to the proposal's last sample, data that it was
/// not trained on, and when it is not a step back from a complete schema to an incomplete one. An
/// edge that no TEST sample could judge yet is marked provisional.
///
/// Version n+1 rests on the samples 0..n, so that a replay gives the same bytes. Before the first
/// accepted proposal nothing is published; when inputs stop, the last schema stands.
class ModelMonitor {
 public:
  explicit ModelMonitor(ModelMonitorConfig config);

  /// What an earlier run of this process saved: the schema, and the health with its history. Saved
  /// one after the other, so the health may be one judgement ahead of the schema; that judgement is
  /// then made again.
  void reload(const std::optional<body_schema_t>& schema,
              const std::optional<model_health_t>& health = std::nullopt);

  /// Returns true if a proposal that was waiting for this sample was judged: schema() and health()
  /// may have changed.
  bool on_sample(const sample_t& sample);
  /// Returns true if the proposal was judged: only those whose last sample is a TEST sample are. The
  /// learner leaves none of them out, so the body schema does not depend on its speed.
  bool on_learned_schema(const body_schema_t& proposal);

  /// The body schema; std::nullopt before the first.
  const std::optional<body_schema_t>& schema() const { return schema_message_; }
  const model_health_t& health() const { return health_; }

 private:
  struct EdgeTest {
    int num_tests = 0;
    int num_refuting = 0;
    double median_mahalanobis2 = -1;
  };

  /// Whether the sample has one value per signal of the schema: a reloaded one may be another
  /// rig's.
  bool fits(const ActionPoseSample& sample) const;
  bool is_test(std::int64_t sample_index) const;
  EdgeTest test(const Edge& edge, std::int64_t up_to_sample) const;
  void judge(const body_schema_t& proposal);
  void assess(std::int64_t up_to_sample);
  void add_event(std::int8_t kind, std::int64_t sample_index, std::int64_t utime, std::string text);

  const ModelMonitorConfig config_;
  std::vector<ActionPoseSample> tests_;
  std::map<int, std::vector<std::int64_t>> seen_in_;  ///< part → indices of samples that show it
  std::int64_t last_sample_index_ = -1;
  /// Proposals that are ahead of the samples heard here, by their last sample.
  std::map<std::int64_t, body_schema_t> waiting_;
  BodySchema schema_;
  std::optional<body_schema_t> schema_message_;
  model_health_t health_{};
  std::int64_t num_events_ = 0;
};

}  // namespace bodyschema
