#include "processes/console/views/status_view.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <utility>

#include "common/geometry/angle.h"
#include "processes/console/hint.h"
#include "processes/console/names.h"
#include "processes/console/views/health_view.h"

namespace bodyschema {
namespace {

/// An edge of the schema with its health.
struct EdgeStatus {
  const schema_edge_t& edge;
  const edge_health_t* health;
  std::vector<std::string> signals;  ///< names, each once, in the order of the chain

  const char* kind() const { return name_in(kEdgeKinds, edge.base_kind); }
  const char* state() const {
    return name_in(kEdgeStates, health ? health->edge_state : edge.state);
  }
};

std::vector<EdgeStatus> edges_of(const GroupStatus& status) {
  std::vector<EdgeStatus> edges;
  for (const schema_edge_t& edge : status.schema->edges) {
    EdgeStatus& item = edges.emplace_back(
        EdgeStatus{edge, health_of(status.health, edge.from_part, edge.to_part), {}});
    for (const screw_joint_t& joint : edge.joints) {
      const std::string& name = status.schema->signals.at(joint.signal_index).signal_name;
      if (std::ranges::find(item.signals, name) == item.signals.end()) item.signals.push_back(name);
    }
  }
  return edges;
}

std::vector<std::string> flags_of(const part_health_t& part) {
  std::vector<std::string> flags;
  if (part.is_unseen == 1) flags.push_back("unseen");
  if (part.is_flipping == 1) flags.push_back("flipping");
  return flags;
}

class StatusText {
 public:
  StatusText(const GroupStatus& status, int width) : status_(status), width_(width) {}

  std::string text() {
    headline();
    processes();
    channels();
    text_ += "\n";
    arm();
    schema();
    parts();
    events();
    return std::move(text_);
  }

 private:
  void line(std::string content) {
    while (content.ends_with(' ')) content.pop_back();
    text_ += fit(content, width_) + "\n";
  }

  /// These lines are not cut: they are what one came for.
  void headline() {
    const bool is_judged =
        status_.health && status_.is_accepted && status_.schema->is_complete == 1;
    const BodyVerdict verdict = is_judged ? verdict_of(*status_.health) : BodyVerdict();
    if (!verdict.wrong.empty()) {
      text_ += std::string(kWhatIsWrong) + "\n";
      for (const std::string& wrong : verdict.wrong) text_ += wrap(wrong, width_, 2);
      text_ += "\n";
    }
    text_ += fit(status_.headline, 1 << 20) + "\n";
    if (is_judged) text_ += wrap(verdict.sentence, width_, 0);
    text_ += "\n";
  }

  void processes() {
    std::size_t host_width = 4;
    for (const GroupStatus::Process& process : status_.processes)
      host_width = std::clamp(process.info.host.size(), host_width, std::size_t{12});
    if (!status_.processes.empty())
      line(fmt::format("  {:<17} {:<{}} {:>6} {:<8} {:>6} {:>5} {:>6}  {}", "process", "host",
                       host_width, "pid", "phase", "up", "cpu", "memory", "activity"));
    for (const GroupStatus::Process& process : status_.processes) {
      const process_info_t& info = process.info;
      line(fmt::format("  {:<17} {:<{}} {:>6} {:<8} {:>6} {:>3.0f} % {:>3.0f} MB  {}",
                       fit(info.process_name, 17), fit(info.host, static_cast<int>(host_width)),
                       host_width, info.pid, name_in(kPhases, info.phase), duration(process.age_s),
                       process.cpu_percent, static_cast<double>(info.resident_bytes) * 1e-6,
                       info.activity));
    }
    for (const std::string& warning : status_.warnings) line("! " + warning);
    text_ += "\n";
  }

  void channels() {
    line(fmt::format("  {:<18} {:>9} {:>9}  {}", "channel", "rate", "newest",
                     "dropped since the start, by whom it hit most"));
    for (const GroupStatus::ChannelUse& channel : status_.channels) {
      const std::string losses = listed(channel.dropped, [](const auto& dropped) {
        return fmt::format("{} {}", dropped.second, dropped.first);
      });
      line(channel.age_s
               ? fmt::format("  {:<18} {:>7.1f}/s {:>7.1f} s  {}", channel.name, channel.rate_hz,
                             *channel.age_s, losses)
               : fmt::format("  {:<18} {:>9} {:>9}  {}", channel.name, "", "none", losses));
    }
    for (const GroupStatus::Process& process : status_.processes) {
      const std::string others = listed(process.other_counters, [](const counter_t& counter) {
        return fmt::format("{} {}", counter.count, counter.counter_name);
      });
      if (!others.empty()) line(fmt::format("  {} counted {}", process.info.process_name, others));
    }
  }

  void arm() {
    if (const auto& motion = status_.motion) {
      std::string arm = "arm      ";
      if (motion->action_id < 0) {
        arm += "no action yet";
      } else {
        arm += fmt::format("action {} of {}: {}", motion->action_id, motion->source,
                           name_in(kMotionStates, motion->state));
        if (!motion->reason.empty()) arm += " (" + motion->reason + ")";
      }
      arm += motion->rest_since_utime >= 0 ? ", at rest" : ", moves";
      if (motion->stop_latched == 1) arm += ", halted";
      line(arm);
    }
    if (const auto& control = status_.control) {
      std::string text = fmt::format("control  {}; {} has the arm",
                                     name_in(kControlStates, control->control_state),
                                     control->owns_arm == 1 ? "the controller" : "the babbler");
      if (control->predicted_error_m >= 0)
        text +=
            fmt::format("; predicted {:.1f} mm from the target", control->predicted_error_m * 1e3);
      if (control->observed_error_m >= 0)
        text += fmt::format(", seen {:.1f} mm", control->observed_error_m * 1e3);
      if (!control->why.empty()) text += "; " + control->why;
      line(text);
    }
    if (status_.sample)
      line(fmt::format("sample   {}: {} parts seen", status_.sample->sample_index,
                       status_.sample->num_parts));
    if (status_.sim_state) {
      const std::vector<std::string>& faults = status_.sim_state->faults;
      line(fmt::format("faults   {}   (ground truth of the simulation)",
                       faults.empty() ? "none" : listed(faults)));
    }
  }

  void schema() {
    if (!status_.schema) return line("schema   none yet");
    const body_schema_t& schema = *status_.schema;
    line(fmt::format("schema   {}, {}: {} parts, {} edges, from {} samples",
                     status_.is_accepted ? fmt::format("version {}", schema.schema_version)
                                         : "none accepted yet; proposal",
                     schema.is_complete == 1 ? "complete" : "incomplete", schema.num_parts,
                     schema.num_edges, schema.num_samples_seen));
    if (const auto& health = status_.health; health && health->worst_position_m >= 0)
      line(
          fmt::format("         worst part off by {} (median, as the camera sees it) in {} "
                      "held-out samples",
                      pose_text(health->worst_position_m, health->worst_rotation_rad, 1),
                      health->num_test_samples));
    for (const moved_tag_t& tag : schema.moved_tags)
      if (tag.moved_until_sample < 0)
        line(fmt::format("         tag {} is set aside since sample {}: not where it was, or lost",
                         tag.moved_tag_id, tag.moved_found_sample));
    line("");
    // Health comes first: a narrow terminal cuts what stands last.
    line(fmt::format("  {:<9} {:<11}  {:<6} {:<12} {:>9} {:>7} {:>5} {:>9}", "edge", "health",
                     "kind", "signals", "residual", "", "tests", "median d²"));
    for (const EdgeStatus& edge : edges_of(status_)) line(edge_row(edge));
    for (const unconnected_part_t& part : schema.unconnected) {
      const std::string reason = name_in(kUnconnectedReasons, part.reason);
      line(fmt::format("  {:>3}       not connected: {}{}", part.unconnected_part, reason,
                       part.detail.empty() || part.detail == reason ? "" : ": " + part.detail));
    }
  }

  static std::string edge_row(const EdgeStatus& item) {
    const schema_edge_t& edge = item.edge;
    std::string row =
        fmt::format("  {:>3} → {:<3} {:<11}  {:<6} {:<12} {:6.2f} mm {:6.2f}°", edge.from_part,
                    edge.to_part, item.state(), item.kind(), in_braces(item.signals),
                    edge.position_rms_m * 1e3, edge.rotation_rms_rad / kDegree);
    if (const edge_health_t* health = item.health) {
      row += fmt::format(" {:>5} {:>9}", health->num_tests,
                         health->median_mahalanobis2 < 0
                             ? "–"
                             : fmt::format("{:.1f}", health->median_mahalanobis2));
      if (health->edge_is_drifting == 1) row += "  drifting";
      if (health->edge_cusum > 0) row += fmt::format("  {:.1f} nats against", health->edge_cusum);
    }
    return row;
  }

  void parts() {
    if (!status_.health || status_.health->part_health.empty()) return;
    line("");
    line(fmt::format("  {:<9} {:<11}  {:>5}  {:>18}", "part", "health", "seen", "held-out error"));
    for (const part_health_t& part : status_.health->part_health) {
      std::string row = fmt::format(
          "  {:<9} {:<11}  {:>3.0f} %  {:>18}", part.health_part,
          name_in(kEdgeStates, part.part_state), part.visibility * 100,
          part.position_median_m < 0 ? "–"
                                     : pose_text(part.position_median_m, part.rotation_median_rad));
      for (const std::string& flag : flags_of(part)) row += "  " + flag;
      line(row);
    }
  }

  /// The newest first.
  void events() {
    if (!status_.health || status_.health->events.empty()) return;
    const std::vector<health_event_t>& events = status_.health->events;
    line("");
    constexpr std::size_t kShown = 8;
    const std::size_t first = events.size() - std::min(kShown, events.size());
    for (std::size_t i = events.size(); i-- > first;) {
      // In samples: the arm's clock may be a simulated one.
      const std::int64_t ago =
          status_.sample ? status_.sample->sample_index - events[i].event_sample : -1;
      const std::string age = ago < 0 ? "" : fmt::format(", {} ago", counted(ago, "sample"));
      text_ +=
          wrap(fmt::format("sample {}{}: {}", events[i].event_sample, age, events[i].event_text),
               width_, 2);
    }
  }

  const GroupStatus& status_;
  const int width_;
  std::string text_;
};

Json process_json(const GroupStatus::Process& process) {
  const process_info_t& info = process.info;
  Json json = {{"name", info.process_name},
               {"host", info.host},
               {"pid", info.pid},
               {"phase", name_in(kPhases, info.phase)},
               {"activity", info.activity},
               {"age_s", process.age_s},
               {"cpu_percent", process.cpu_percent},
               {"resident_bytes", info.resident_bytes},
               {"version", info.program_version},
               {"counters", Json::object()}};
  for (const counter_t& counter : info.counters)
    json["counters"][counter.counter_name] = counter.count;
  return json;
}

Json channel_json(const GroupStatus::ChannelUse& channel) {
  return {{"count", channel.count},
          {"rate_hz", channel.rate_hz},
          {"age_s", or_null(channel.age_s)},
          {"dropped", channel.dropped}};
}

Json arm_json(const std::optional<motion_status_t>& motion) {
  if (!motion) return nullptr;
  return {{"state", name_in(kMotionStates, motion->state)},
          {"source", motion->source},
          {"action_id", known(motion->action_id)},
          {"reason", motion->reason},
          {"at_rest", motion->rest_since_utime >= 0},
          {"stop_latched", motion->stop_latched == 1}};
}

Json control_json(const std::optional<control_status_t>& control) {
  if (!control) return nullptr;
  return {{"state", name_in(kControlStates, control->control_state)},
          {"owns_arm", control->owns_arm == 1},
          {"why", control->why},
          {"target_part", known(control->target_part)},
          {"predicted_error_m", known(control->predicted_error_m)},
          {"observed_error_m", known(control->observed_error_m)},
          {"way_point", control->way_point},
          {"way_points", control->num_way_points}};
}

Json edge_json(const EdgeStatus& item) {
  const edge_health_t* health = item.health;
  return {{"from", item.edge.from_part},
          {"to", item.edge.to_part},
          {"kind", item.kind()},
          {"signals", item.signals},
          {"position_rms_m", item.edge.position_rms_m},
          {"rotation_rms_deg", item.edge.rotation_rms_rad / kDegree},
          {"state", item.state()},
          {"drifting", health && health->edge_is_drifting == 1},
          {"cusum", health ? known(health->edge_cusum) : nullptr},
          {"tests", health ? health->num_tests : 0},
          {"median_mahalanobis2", health ? known(health->median_mahalanobis2) : nullptr}};
}

Json schema_status_json(const GroupStatus& status) {
  if (!status.schema) return nullptr;
  const body_schema_t& schema = *status.schema;
  return {{"accepted", status.is_accepted},
          {"version", schema.schema_version},
          {"complete", schema.is_complete == 1},
          {"samples", schema.num_samples_seen},
          {"last_sample", schema.last_sample_index},
          {"parts", schema.part_ids},
          {"edges", array_of(edges_of(status), edge_json)},
          {"unconnected", array_of(schema.unconnected, [](const unconnected_part_t& part) -> Json {
             return {{"part", part.unconnected_part},
                     {"reason", name_in(kUnconnectedReasons, part.reason)},
                     {"detail", part.detail}};
           })}};
}

Json part_json(const part_health_t& part) {
  const bool is_tested = part.position_median_m >= 0;
  return {{"part", part.health_part},
          {"visibility", part.visibility},
          {"state", name_in(kEdgeStates, part.part_state)},
          {"flags", flags_of(part)},
          {"tests", part.num_predicted},
          {"position_median_m", known(part.position_median_m)},
          {"rotation_median_deg", is_tested ? Json(part.rotation_median_rad / kDegree) : nullptr}};
}

}  // namespace

std::string status_text(const GroupStatus& status, int width) {
  return StatusText(status, width).text();
}

Json status_json(const GroupStatus& status) {
  Json channels = Json::object();
  for (const auto& channel : status.channels) channels[channel.name] = channel_json(channel);
  Json json = {{"headline", status.headline},
               {"missing", status.missing},
               {"twins", status.twins},
               {"warnings", status.warnings},
               {"processes", array_of(status.processes, process_json)},
               {"channels", channels},
               {"arm", arm_json(status.motion)},
               {"control", control_json(status.control)},
               {"newest_sample", status.sample ? Json(status.sample->sample_index) : nullptr},
               // Ground truth: the simulator alone knows.
               {"faults", status.sim_state ? Json(status.sim_state->faults) : nullptr},
               {"schema", schema_status_json(status)},
               {"wrong", nullptr},
               {"events", nullptr},
               {"parts", nullptr}};
  if (!status.health) return json;
  std::vector<std::string> signals;
  if (status.is_accepted)
    for (const signal_t& signal : status.schema->signals) signals.push_back(signal.signal_name);
  const auto named = [&](auto to_json) {
    return [&signals, to_json](const auto& item) { return to_json(item, signals); };
  };
  json["parts"] = array_of(status.health->part_health, part_json);
  json["events"] = array_of(status.health->events, named(event_json));
  json["wrong"] = array_of(status.health->findings, named(finding_json));
  return json;
}

}  // namespace bodyschema
