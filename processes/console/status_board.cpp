#include "processes/console/status_board.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <set>
#include <sstream>
#include <utility>

#include "common/geometry/angle.h"
#include "processes/console/health_view.h"
#include "processes/console/hint.h"
#include "processes/console/run_record.h"

namespace bodyschema {
namespace {

using nlohmann::ordered_json;

const char* const kPhases[] = {"starting", "waiting", "working", "done", "ended"};
const char* const kMotions[] = {"idle",     "accepted", "moving",  "settled",
                                "rejected", "stopped",  "expired", "holding"};
const char* const kControls[] = {"idle",    "waiting", "moving", "reached",
                                 "refused", "holding", "lent",   "released"};
const char* const kEdgeStates[] = {"OK", "SUSPECT", "INVALID", "PROVISIONAL"};
const char* const kReasons[] = {"never seen", "not enough data yet", "no valid model"};
/// Counters of a bus that say that something did not get through.
const char* const kLosses[] = {"malformed", "senseless", "skipped", "refused", "dropped", "lost"};

double seconds(std::int64_t from_us, std::int64_t to_us) {
  return static_cast<double>(to_us - from_us) * 1e-6;
}

/// Names, each once, in the order of the chain.
std::vector<std::string> signals_of(const body_schema_t& schema, const schema_edge_t& edge) {
  std::vector<std::string> names;
  for (const screw_joint_t& joint : edge.joints) {
    const std::string& name = schema.signals.at(joint.signal_index).signal_name;
    if (std::find(names.begin(), names.end(), name) == names.end()) names.push_back(name);
  }
  return names;
}

std::vector<std::string> flags_of(const part_health_t& part) {
  std::vector<std::string> flags;
  if (part.is_unseen == 1) flags.push_back("unseen");
  if (part.is_flipping == 1) flags.push_back("flipping");
  return flags;
}

const edge_health_t* find_health(const std::optional<model_health_t>& health,
                                 const schema_edge_t& edge) {
  if (!health) return nullptr;
  for (const edge_health_t& item : health->edge_health) {
    if (item.health_from == edge.from_part && item.health_to == edge.to_part) return &item;
  }
  return nullptr;
}

std::string kind_of(const schema_edge_t& edge) {
  static const char* const kKinds[] = {"rigid", "screw", "screw_gp", "matrix_gp"};
  return kKinds[edge.base_kind];
}

/// A counter that tells of normal traffic.
bool is_traffic(const std::string& counter) {
  return counter.starts_with("received ") || counter.starts_with("published ");
}

}  // namespace

std::string fit(const std::string& text, int width) {
  std::string line;
  int columns = 0;
  for (std::size_t i = 0; i < text.size();) {
    std::size_t size = 1;
    while (i + size < text.size() && (static_cast<unsigned char>(text[i + size]) & 0xC0) == 0x80)
      ++size;
    const auto byte = static_cast<unsigned char>(text[i]);
    // U+0080 … U+009F are control characters too.
    const bool is_control =
        byte < 0x20 || byte == 0x7F ||
        (byte == 0xC2 && size == 2 && static_cast<unsigned char>(text[i + 1]) < 0xA0);
    if (columns == width) {
      while (!line.empty() && (static_cast<unsigned char>(line.back()) & 0xC0) == 0x80)
        line.pop_back();
      if (!line.empty()) line.pop_back();
      return line + "…";
    }
    line += is_control ? " " : text.substr(i, size);
    ++columns;
    i += size;
  }
  return line;
}

std::string wrap(const std::string& text, int width, int indent) {
  const auto columns = [](const std::string& word) {
    return static_cast<int>(std::count_if(word.begin(), word.end(), [](char c) {
      return (static_cast<unsigned char>(c) & 0xC0) != 0x80;
    }));
  };
  std::string result, line(static_cast<std::size_t>(indent), ' ');
  bool is_begun = false;
  std::istringstream words(text);
  for (std::string word; words >> word;) {
    if (is_begun && columns(line) + 1 + columns(word) > width) {
      result += fit(line, width) + "\n";
      line = std::string(static_cast<std::size_t>(indent) + 2, ' ');
      is_begun = false;
    }
    line += (is_begun ? " " : "") + word;
    is_begun = true;
  }
  return result + fit(line, width) + "\n";
}

double StatusBoard::Heard::age_s() const {
  return std::max(0.0, seconds(newest.start_utime, newest.utime));
}

double StatusBoard::Heard::cpu_percent() const {
  const bool has_window = newest.utime - first.utime >= 500'000;
  const double used_us = static_cast<double>(newest.cpu_us - (has_window ? first.cpu_us : 0));
  const double of_us = has_window ? static_cast<double>(newest.utime - first.utime) : age_s() * 1e6;
  // One that began just now used its time before it said so.
  return of_us > 1e5 ? 100 * std::max(0.0, used_us) / of_us : 0;
}

StatusBoard::StatusBoard(std::set<std::string> expected, std::string own_version)
    : expected_(std::move(expected)), own_version_(std::move(own_version)) {}

void StatusBoard::begin(std::int64_t now_us) { begin_us_ = end_us_ = now_us; }

void StatusBoard::on_arrival(const std::string& channel, std::int64_t now_us) {
  Arrivals& arrivals = arrivals_[channel];
  ++arrivals.count;
  arrivals.last_us = now_us;
}

void StatusBoard::on_message(const process_info_t& info) {
  const auto [heard, is_new] = processes_.try_emplace({info.host, info.process_name, info.pid});
  if (is_new) heard->second.first = info;
  heard->second.newest = info;
}

void StatusBoard::on_own_counters(const std::map<std::string, std::int64_t>& counters) {
  for (const auto& [name, count] : counters) own_counters_[name] += count;
}

std::int64_t StatusBoard::num_dropped_here() const {
  std::int64_t sum = 0;
  for (const auto& [name, count] : own_counters_) {
    if (name.starts_with("malformed ") || name.starts_with("senseless ")) sum += count;
  }
  return sum;
}

const StatusBoard::Heard* StatusBoard::find(const std::string& name) const {
  const Heard* found = nullptr;
  for (const auto& [key, heard] : processes_) {
    if (heard.newest.process_name == name && (!found || found->has_ended())) found = &heard;
  }
  return found;
}

std::vector<std::string> StatusBoard::missing() const {
  std::vector<std::string> names;
  for (const std::string& name : expected_) {
    const Heard* heard = find(name);
    if (heard && !heard->has_ended()) continue;
    if (name == "robot_simulator" && motion_) continue;  // a lab's own driver
    names.push_back(name);
  }
  return names;
}

std::vector<std::string> StatusBoard::twins() const {
  std::map<std::string, int> alive;
  for (const auto& [key, heard] : processes_) {
    if (!heard.has_ended()) ++alive[heard.newest.process_name];
  }
  std::vector<std::string> names;
  for (const auto& [name, count] : alive) {
    if (count > 1) names.push_back(name);
  }
  return names;
}

std::vector<std::string> StatusBoard::warnings() const {
  std::vector<std::string> lines;
  const std::vector<std::string> silent = missing();
  if (!silent.empty()) lines.push_back(fmt::format("not heard: {}", fmt::join(silent, ", ")));
  for (const std::string& name : twins()) {
    std::string where;
    for (const auto& [key, heard] : processes_) {
      if (heard.newest.process_name != name || heard.has_ended()) continue;
      where += fmt::format("{}{} on {}", where.empty() ? "pid " : ", pid ", heard.newest.pid,
                           heard.newest.host);
    }
    lines.push_back(fmt::format("{} runs more than once ({}): end all but one", name, where));
  }
  for (const auto& [key, heard] : processes_) {
    if (heard.newest.program_version == own_version_) continue;
    lines.push_back(fmt::format("{} on {} is of version {}, this command of {}: build both alike",
                                heard.newest.process_name, heard.newest.host,
                                heard.newest.program_version, own_version_));
  }
  return lines;
}

std::set<std::string> StatusBoard::channels() const {
  std::set<std::string> names;
  for (const auto& [name, arrivals] : arrivals_) names.insert(name);
  for (const auto& [name, count] : own_counters_) {
    if (count > 0 && (name.starts_with("malformed ") || name.starts_with("senseless ")))
      names.insert(name.substr(name.find(' ') + 1));
  }
  return names;
}

std::map<std::string, std::int64_t> StatusBoard::dropped(const std::string& channel) const {
  std::map<std::string, std::int64_t> most;
  const auto look_at = [&](const std::string& name, std::int64_t count) {
    for (const char* loss : kLosses) {
      if (count > 0 && name == std::string(loss) + " " + channel)
        most[loss] = std::max(most[loss], count);
    }
  };
  for (const auto& [name, count] : own_counters_) look_at(name, count);
  for (const auto& [key, heard] : processes_) {
    for (const counter_t& counter : heard.newest.counters)
      look_at(counter.counter_name, counter.count);
  }
  return most;
}

std::string StatusBoard::headline() const {
  if (arrivals_.empty()) {
    return is_silent() ? "Nothing on the bus."
                       : "Nothing but garbage on the bus: is it another program's?";
  }
  std::string line;
  const Heard* babbler = find("motor_babbler");
  if (!motion_) {
    line = "Waits for a driver: nobody sends MOTION_STATUS.";
  } else if (motion_->stop_latched == 1) {
    line = "Halted: nothing moves until `" + to_type("resume") + "`.";
  } else if (control_ && control_->owns_arm == 1) {
    line = fmt::format("The controller has the arm, {}: {}", kControls[control_->control_state],
                       control_->why);
  } else if (babbler && !babbler->has_ended()) {
    const process_info_t& info = babbler->newest;
    const bool is_done = info.phase == process_info_t::PHASE_DONE;
    const bool is_working = info.phase == process_info_t::PHASE_WORKING;
    line = fmt::format("{}: {}",
                       is_done      ? "Done"
                       : is_working ? "Learning"
                                    : "Waits",
                       info.activity);
  } else {
    for (const auto& [key, heard] : processes_) {
      if (heard.newest.phase != process_info_t::PHASE_WORKING) continue;
      line += fmt::format("{}{}: {}", line.empty() ? "" : "; ", heard.newest.process_name,
                          heard.newest.activity);
    }
    line = line.empty() ? "Nobody works: no babbler moves the arm."
                        : "No babbler moves the arm; " + line;
  }
  if (!line.ends_with('.')) line += '.';
  if (babbler && babbler->newest.phase == process_info_t::PHASE_DONE && line.starts_with("Done"))
    line += std::string(" ") + kNobodyWatches;
  // At first all wait for each other, and a controller waits for a target.
  for (const auto& [key, heard] : processes_) {
    const process_info_t& info = heard.newest;
    if (schema_ && info.phase == process_info_t::PHASE_WAITING &&
        info.process_name != "motor_babbler" && info.process_name != "controller")
      line += fmt::format(" {} waits: {}.", info.process_name, info.activity);
  }
  if (const auto silent = missing(); !silent.empty())
    line += fmt::format(" Not heard: {}.", fmt::join(silent, ", "));
  return line;
}

std::string StatusBoard::text(int width) const {
  const double window_s = std::max(1e-3, seconds(begin_us_, end_us_));
  std::string text;
  const auto line = [&](std::string content) {
    while (content.ends_with(' ')) content.pop_back();
    text += fit(content, width) + "\n";
  };

  // These are not cut: they are what one came for.
  const std::optional<BodyVerdict> verdict = health_ && schema_ && schema_->is_complete == 1
                                                 ? std::optional(verdict_of(*health_))
                                                 : std::nullopt;
  if (verdict && !verdict->wrong.empty()) {
    text += std::string(kWhatIsWrong) + "\n";
    for (const std::string& wrong : verdict->wrong) text += wrap(wrong, width, 2);
    text += "\n";
  }
  text += fit(headline(), 1 << 20) + "\n";
  if (verdict) text += wrap(verdict->sentence, width, 0);
  text += "\n";
  std::size_t host_width = 4;
  for (const auto& [key, heard] : processes_)
    host_width = std::clamp(heard.newest.host.size(), host_width, std::size_t{12});
  if (!processes_.empty()) {
    line(fmt::format("  {:<17} {:<{}} {:>6} {:<8} {:>6} {:>5} {:>6}  {}", "process", "host",
                     host_width, "pid", "phase", "up", "cpu", "memory", "activity"));
  }
  for (const auto& [key, heard] : processes_) {
    const process_info_t& info = heard.newest;
    line(fmt::format("  {:<17} {:<{}} {:>6} {:<8} {:>6} {:>3.0f} % {:>3.0f} MB  {}",
                     fit(info.process_name, 17), fit(info.host, static_cast<int>(host_width)),
                     host_width, info.pid, kPhases[info.phase], duration(heard.age_s()),
                     heard.cpu_percent(), static_cast<double>(info.resident_bytes) * 1e-6,
                     info.activity));
  }
  for (const std::string& warning : warnings()) line("! " + warning);

  text += "\n";
  line(fmt::format("  {:<18} {:>9} {:>9}  {}", "channel", "rate", "newest",
                   "dropped since the start, by whom it hit most"));
  const std::set<std::string> all_channels = channels();
  for (const std::string& name : all_channels) {
    std::string losses;
    for (const auto& [loss, count] : dropped(name))
      losses += fmt::format("{}{} {}", losses.empty() ? "" : ", ", count, loss);
    const auto arrivals = arrivals_.find(name);
    if (arrivals == arrivals_.end()) {
      line(fmt::format("  {:<18} {:>9} {:>9}  {}", name, "", "none", losses));
      continue;
    }
    line(fmt::format("  {:<18} {:>7.1f}/s {:>7.1f} s  {}", name,
                     static_cast<double>(arrivals->second.count) / window_s,
                     seconds(arrivals->second.last_us, end_us_), losses));
  }
  for (const auto& [key, heard] : processes_) {
    std::string others;
    for (const counter_t& counter : heard.newest.counters) {
      const std::string& name = counter.counter_name;
      const bool is_channel_loss =
          std::any_of(std::begin(kLosses), std::end(kLosses), [&](const std::string& loss) {
            return name.starts_with(loss + " ") &&
                   all_channels.contains(name.substr(loss.size() + 1));
          });
      if (counter.count == 0 || is_traffic(name) || is_channel_loss) continue;
      others += fmt::format("{}{} {}", others.empty() ? "" : ", ", counter.count, name);
    }
    if (!others.empty()) line(fmt::format("  {} counted {}", heard.newest.process_name, others));
  }

  text += "\n";
  if (motion_) {
    std::string arm = "arm      ";
    if (motion_->action_id < 0) {
      arm += "no action yet";
    } else {
      arm += fmt::format("action {} of {}: {}", motion_->action_id, motion_->source,
                         kMotions[motion_->state]);
      if (!motion_->reason.empty()) arm += " (" + motion_->reason + ")";
    }
    arm += motion_->rest_since_utime >= 0 ? ", at rest" : ", moves";
    if (motion_->stop_latched == 1) arm += ", STOP is latched";
    line(arm);
  }
  if (control_) {
    std::string control =
        fmt::format("control  {}; {} has the arm", kControls[control_->control_state],
                    control_->owns_arm == 1 ? "the controller" : "the babbler");
    if (control_->predicted_error_m >= 0)
      control +=
          fmt::format("; predicted {:.1f} mm from the target", control_->predicted_error_m * 1e3);
    if (control_->observed_error_m >= 0)
      control += fmt::format(", seen {:.1f} mm", control_->observed_error_m * 1e3);
    if (!control_->why.empty()) control += "; " + control_->why;
    line(control);
  }
  if (sample_) {
    line(fmt::format("sample   {}: {} parts seen", sample_->sample_index, sample_->num_parts));
  }
  if (sim_state_) {
    line(fmt::format("faults   {}   (ground truth of the simulation)",
                     sim_state_->faults.empty()
                         ? "none"
                         : fmt::format("{}", fmt::join(sim_state_->faults, ", "))));
  }

  const body_schema_t* schema = schema_ ? &*schema_ : proposal_ ? &*proposal_ : nullptr;
  if (!schema) {
    line("schema   none yet");
  } else {
    line(fmt::format(
        "schema   {}, {}: {} parts, {} edges, from {} samples",
        schema_ ? fmt::format("version {}", schema->schema_version) : "none accepted yet; proposal",
        schema->is_complete == 1 ? "complete" : "incomplete", schema->num_parts, schema->num_edges,
        schema->num_samples_seen));
    if (health_ && health_->worst_position_m >= 0) {
      line(fmt::format(
          "         worst part off by {:.1f} mm {:.2f}° (median, as the camera sees it) in {} "
          "held-out samples",
          health_->worst_position_m * 1e3, health_->worst_rotation_rad / kDegree,
          health_->num_test_samples));
    }
    for (const moved_tag_t& tag : schema->moved_tags)
      if (tag.moved_until_sample < 0)
        line(fmt::format("         tag {} is set aside since sample {}: not where it was, or lost",
                         tag.moved_tag_id, tag.moved_found_sample));
    line("");
    // Health comes first: a narrow terminal cuts what stands last.
    line(fmt::format("  {:<9} {:<11}  {:<6} {:<12} {:>9} {:>7} {:>5} {:>9}", "edge", "health",
                     "kind", "signals", "residual", "", "tests", "median d²"));
    for (const schema_edge_t& edge : schema->edges) {
      const edge_health_t* health = find_health(health_, edge);
      std::string row = fmt::format(
          "  {:>3} → {:<3} {:<11}  {:<6} {:<12} {:6.2f} mm {:6.2f}°", edge.from_part, edge.to_part,
          kEdgeStates[health ? health->edge_state : edge.state], kind_of(edge),
          fmt::format("{{{}}}", fmt::join(signals_of(*schema, edge), ",")),
          edge.position_rms_m * 1e3, edge.rotation_rms_rad / kDegree);
      if (health) {
        row += fmt::format(" {:>5} {:>9}", health->num_tests,
                           health->median_mahalanobis2 < 0
                               ? "–"
                               : fmt::format("{:.1f}", health->median_mahalanobis2));
        if (health->edge_is_drifting == 1) row += "  drifting";
        if (health->edge_cusum > 0) row += fmt::format("  {:.1f} nats against", health->edge_cusum);
      }
      line(row);
    }
    for (const unconnected_part_t& part : schema->unconnected) {
      const std::string reason = kReasons[part.reason];
      line(fmt::format("  {:>3}       not connected: {}{}", part.unconnected_part, reason,
                       part.detail.empty() || part.detail == reason ? "" : ": " + part.detail));
    }
  }
  if (health_ && !health_->part_health.empty()) {
    line("");
    line(fmt::format("  {:<9} {:<11}  {:>5}  {:>18}", "part", "health", "seen", "held-out error"));
    for (const part_health_t& part : health_->part_health) {
      std::string row =
          fmt::format("  {:<9} {:<11}  {:>3.0f} %  {:>18}", part.health_part,
                      kEdgeStates[part.part_state], part.visibility * 100,
                      part.position_median_m < 0
                          ? "–"
                          : fmt::format("{:.2f} mm {:.2f}°", part.position_median_m * 1e3,
                                        part.rotation_median_rad / kDegree));
      for (const std::string& flag : flags_of(part)) row += "  " + flag;
      line(row);
    }
  }
  if (health_ && !health_->events.empty()) {
    line("");
    constexpr std::size_t kShown = 8;
    const std::size_t first = health_->events.size() - std::min(kShown, health_->events.size());
    for (std::size_t i = health_->events.size(); i-- > first;) {
      const health_event_t& event = health_->events[i];
      // In samples: the arm's clock may be a simulated one.
      const std::int64_t ago = sample_ ? sample_->sample_index - event.event_sample : -1;
      const std::string age =
          ago < 0 ? "" : fmt::format(", {} sample{} ago", ago, ago == 1 ? "" : "s");
      text +=
          wrap(fmt::format("sample {}{}: {}", event.event_sample, age, event.event_text), width, 2);
    }
  }
  return text;
}

namespace {

/// -1 on the wire says that nothing is known.
template <class Number>
ordered_json known(Number value) {
  return value < 0 ? ordered_json() : ordered_json(value);
}

}  // namespace

ordered_json StatusBoard::json() const {
  const double window_s = std::max(1e-3, seconds(begin_us_, end_us_));
  ordered_json json = {{"headline", headline()},
                       {"missing", missing()},
                       {"twins", twins()},
                       {"warnings", warnings()},
                       {"processes", ordered_json::array()},
                       {"channels", ordered_json::object()}};
  for (const auto& [key, heard] : processes_) {
    const process_info_t& info = heard.newest;
    ordered_json item = {{"name", info.process_name},
                         {"host", info.host},
                         {"pid", info.pid},
                         {"phase", kPhases[info.phase]},
                         {"activity", info.activity},
                         {"age_s", heard.age_s()},
                         {"cpu_percent", heard.cpu_percent()},
                         {"resident_bytes", info.resident_bytes},
                         {"version", info.program_version},
                         {"counters", ordered_json::object()}};
    for (const counter_t& counter : info.counters)
      item["counters"][counter.counter_name] = counter.count;
    json["processes"].push_back(std::move(item));
  }
  for (const std::string& name : channels()) {
    const auto arrivals = arrivals_.find(name);
    const bool has_any = arrivals != arrivals_.end();
    const std::int64_t count = has_any ? arrivals->second.count : 0;
    ordered_json& item = json["channels"][name];
    item["count"] = count;
    item["rate_hz"] = static_cast<double>(count) / window_s;
    item["age_s"] = has_any ? ordered_json(seconds(arrivals->second.last_us, end_us_)) : nullptr;
    item["dropped"] = dropped(name);
  }
  json["arm"] = nullptr;
  if (motion_) {
    json["arm"] = {
        {"state", kMotions[motion_->state]},         {"source", motion_->source},
        {"action_id", known(motion_->action_id)},    {"reason", motion_->reason},
        {"at_rest", motion_->rest_since_utime >= 0}, {"stop_latched", motion_->stop_latched == 1}};
  }
  json["control"] = nullptr;
  if (control_) {
    json["control"] = {{"state", kControls[control_->control_state]},
                       {"owns_arm", control_->owns_arm == 1},
                       {"why", control_->why},
                       {"target_part", known(control_->target_part)},
                       {"predicted_error_m", known(control_->predicted_error_m)},
                       {"observed_error_m", known(control_->observed_error_m)}};
  }
  json["newest_sample"] = sample_ ? ordered_json(sample_->sample_index) : nullptr;
  // Ground truth: the simulator alone knows.
  json["faults"] = sim_state_ ? ordered_json(sim_state_->faults) : nullptr;
  const body_schema_t* schema = schema_ ? &*schema_ : proposal_ ? &*proposal_ : nullptr;
  json["schema"] = nullptr;
  if (schema) {
    ordered_json& item = json["schema"];
    item = {{"accepted", schema_.has_value()},          {"version", schema->schema_version},
            {"complete", schema->is_complete == 1},     {"samples", schema->num_samples_seen},
            {"last_sample", schema->last_sample_index}, {"parts", schema->part_ids},
            {"edges", ordered_json::array()},           {"unconnected", ordered_json::array()}};
    for (const schema_edge_t& edge : schema->edges) {
      const edge_health_t* health = find_health(health_, edge);
      item["edges"].push_back(
          {{"from", edge.from_part},
           {"to", edge.to_part},
           {"kind", kind_of(edge)},
           {"signals", signals_of(*schema, edge)},
           {"position_rms_m", edge.position_rms_m},
           {"rotation_rms_deg", edge.rotation_rms_rad / kDegree},
           {"state", kEdgeStates[health ? health->edge_state : edge.state]},
           {"drifting", health && health->edge_is_drifting == 1},
           {"cusum",
            health && health->edge_cusum >= 0 ? ordered_json(health->edge_cusum) : nullptr},
           {"tests", health ? health->num_tests : 0},
           {"median_mahalanobis2", health && health->median_mahalanobis2 >= 0
                                       ? ordered_json(health->median_mahalanobis2)
                                       : nullptr}});
    }
    for (const unconnected_part_t& part : schema->unconnected) {
      item["unconnected"].push_back({{"part", part.unconnected_part},
                                     {"reason", kReasons[part.reason]},
                                     {"detail", part.detail}});
    }
  }
  json["parts"] = json["events"] = json["wrong"] = nullptr;
  if (health_) {
    json["parts"] = json["events"] = json["wrong"] = ordered_json::array();
    std::vector<std::string> signals;
    if (schema_)
      for (const signal_t& signal : schema_->signals) signals.push_back(signal.signal_name);
    for (const part_health_t& part : health_->part_health) {
      const bool is_tested = part.position_median_m >= 0;
      json["parts"].push_back(
          {{"part", part.health_part},
           {"visibility", part.visibility},
           {"state", kEdgeStates[part.part_state]},
           {"flags", flags_of(part)},
           {"tests", part.num_predicted},
           {"position_median_m", is_tested ? ordered_json(part.position_median_m) : nullptr},
           {"rotation_median_deg",
            is_tested ? ordered_json(part.rotation_median_rad / kDegree) : nullptr}});
    }
    for (const health_event_t& event : health_->events)
      json["events"].push_back(event_json(event, signals));
    for (const finding_t& finding : health_->findings)
      json["wrong"].push_back(finding_json(finding, signals));
  }
  return json;
}

}  // namespace bodyschema
