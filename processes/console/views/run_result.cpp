#include "processes/console/views/run_result.h"

#include <fmt/format.h>

#include <cmath>

#include "processes/console/hint.h"
#include "processes/console/views/health_view.h"
#include "processes/console/views/structure_view.h"

namespace bodyschema {
namespace {

std::string losses_text(const RunResult& result) {
  std::string text;
  for (const auto& [first, last] : result.lost_samples)
    text += fmt::format("lost SAMPLE {}{}\n", first, first == last ? "" : fmt::format("…{}", last));
  if (result.lost_frames > 0)
    text += fmt::format("{} of the played {} were not heard: play it slower, or at --speed 0\n",
                        result.lost_frames, result.replay_from);
  return text;
}

std::string held_out_text(const RunResult& result) {
  if (result.num_held_out == 0) return "";
  std::string text = fmt::format(
      "\nHeld-out error of each part relative to the root, against {}{}\n{}",
      result.has_truth ? "the simulator's noise-free truth" : "what the camera saw",
      result.held_out_since > 0
          ? fmt::format(", since the body last changed (sample {})", result.held_out_since)
          : "",
      errors_text(result.held_out));
  if (result.has_truth && result.health && result.health->worst_position_m >= 0)
    text += fmt::format(
        "(The line of progress and `status` go by what the camera sees, noise and bias of the "
        "markers included: worst part {}.)\n",
        pose_text(result.health->worst_position_m, result.health->worst_rotation_rad, 1));
  return text;
}

std::string files_text(const std::filesystem::path& folder) {
  std::string text = "\nFiles in " + folder.string() + "\n";
  // On one of several hosts, or in a replay, not all of them are here.
  const std::pair<const char*, const char*> files[] = {
      {"result.json", "this table"},
      {"report.html", "the same with pictures and plots, for a browser"},
      {"detections.png", "a camera frame with the markers found in it"},
      {"schema.lcmlog", "the body schema: ./run show FILE"},
      {"refined.lcmlog",
       "fitted to the tags' corners, with other tags and lens: ./run adopt FOLDER"},
      {"samples.lcmlog", "the samples: ./run learn FILE"},
      {"run.lcmlog.00", "everything on the bus but images"}};
  for (const auto& [name, what] : files) {
    if (std::filesystem::exists(folder / name)) text += fmt::format("  {:<18} {}\n", name, what);
  }
  return text;
}

}  // namespace

Json run_result_json(const RunResult& result) {
  Json json = {
      {"rig", result.rig},
      {"seed", or_null(result.seed)},
      {"samples", result.num_samples},
      {"seconds", std::round(result.seconds * 10) / 10},
      {"end_effector", result.end_effector},
      {"accepted", result.is_accepted},
      {"structure", structure_json(result.schema, result.outliers)},
      {"held_out", result.has_truth ? errors_json(result.num_held_out, result.held_out)
                                    : errors_json(result.num_held_out, result.held_out.parts)},
      {"held_out_since", result.held_out_since},
      {"held_out_against", result.has_truth ? "noise-free simulator" : "observations"},
      {"visibility", Json::object()}};
  for (const auto& [part, share] : result.visibility)
    json["visibility"][std::to_string(part)] = share;
  if (!result.replay_of.empty()) {
    json["replay_of"] = result.replay_of;
    json["lost_frames"] = result.lost_frames;
  }
  json["lost_samples"] = result.lost_samples;
  json["wrong"] =
      array_of(result.health.value_or(model_health_t{}).findings,
               [&](const finding_t& f) { return finding_json(f, signal_names(result.schema)); });
  return json;
}

std::string run_result_text(const RunResult& result, const std::filesystem::path& folder) {
  std::string text = fmt::format(
      "\n{} · {} · {} samples, {} of them held out · {:.0f} s\n\n", result.rig,
      result.seed ? fmt::format("seed {}", *result.seed) : "replay of " + result.replay_of,
      result.num_samples, result.num_held_out, result.seconds);
  const BodyVerdict verdict = verdict_of(result.health.value_or(model_health_t{}));
  if (!verdict.wrong.empty()) {
    text += fmt::format("{}\n", kWhatIsWrong);
    for (const std::string& wrong : verdict.wrong) text += "  " + wrong + "\n";
    text += fmt::format("{}\n{}\n\n", verdict.sentence, kNobodyWatches);
  } else if (verdict.is_in_doubt) {
    text += verdict.sentence + "\n\n";
  }
  text += losses_text(result);
  if (!result.is_accepted)
    text +=
        "The monitor accepted no body schema: too few samples, or each proposal was refuted. The "
        "newest proposal:\n";
  return text + structure_text(result.schema) + held_out_text(result) + files_text(folder);
}

}  // namespace bodyschema
