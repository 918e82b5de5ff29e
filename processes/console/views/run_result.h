#pragma once

#include <cstdint>
#include <filesystem>
#include <map>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "bodyschema/model_health_t.hpp"
#include "common/estimation/evaluation.h"
#include "common/schema/body_schema.h"
#include "processes/console/views/json.h"
#include "processes/structure_learner/learn.h"

namespace bodyschema {

/// The outcome of a run.
struct RunResult {
  std::string rig;
  std::optional<std::int64_t> seed;  ///< none of a replay
  std::string replay_of;             ///< "": no replay
  std::string replay_from;           ///< the channel that is played
  std::int64_t num_samples = 0;
  double seconds = 0;
  int end_effector = 0;
  /// The monitor's where it accepted one, else the newest proposal.
  BodySchema schema;
  std::vector<Outlier> outliers;
  bool is_accepted = false;
  std::optional<model_health_t> health;
  int num_held_out = 0;
  std::int64_t held_out_since = 0;  ///< sample at which the body last changed
  bool has_truth = false;           ///< of a simulator, to judge by; else what the camera saw
  JudgedErrors held_out;
  std::map<int, double> visibility;  ///< share of the samples by part
  std::vector<std::pair<std::int64_t, std::int64_t>> lost_samples;  ///< first and last index
  std::int64_t lost_frames = 0;  ///< of a replay: played and not heard
};

/// result.json.
Json run_result_json(const RunResult& result);

/// For people, with the files that are in `folder`.
std::string run_result_text(const RunResult& result, const std::filesystem::path& folder);

}  // namespace bodyschema
