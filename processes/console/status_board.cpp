#include "processes/console/status_board.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <utility>

#include "common/text/clock.h"
#include "processes/console/hint.h"
#include "processes/console/names.h"
#include "processes/console/views/health_view.h"

namespace bodyschema {
namespace {

/// Counters of a bus that say that something did not get through.
const char* const kLosses[] = {"malformed", "senseless", "skipped", "refused", "dropped", "lost"};

bool is_loss_on(const std::string& counter, const std::set<std::string>& channels) {
  return std::ranges::any_of(kLosses, [&](const std::string& loss) {
    return counter.starts_with(loss + " ") && channels.contains(counter.substr(loss.size() + 1));
  });
}

/// Of a bus's counters: that a message was dropped.
bool is_drop(const std::string& counter) {
  return counter.starts_with("malformed ") || counter.starts_with("senseless ");
}

}  // namespace

double StatusBoard::Heard::age_s() const {
  return std::max(0.0, seconds(newest.utime - newest.start_utime));
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

void StatusBoard::on_body_schema(const body_schema_t& schema) {
  newest_.schema = schema;
  newest_.is_accepted = true;
}

void StatusBoard::on_learned_schema(const body_schema_t& schema) {
  if (!newest_.is_accepted) newest_.schema = schema;
}

void StatusBoard::on_own_counters(const std::map<std::string, std::int64_t>& counters) {
  for (const auto& [name, count] : counters) own_counters_[name] += count;
}

std::int64_t StatusBoard::num_dropped_here() const {
  std::int64_t sum = 0;
  for (const auto& [name, count] : own_counters_) sum += is_drop(name) ? count : 0;
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
    if (name == "robot_simulator" && newest_.motion) continue;  // a lab's own driver
    names.push_back(name);
  }
  return names;
}

std::vector<std::string> StatusBoard::twins() const {
  std::set<std::string> alive, twins;
  for (const auto& [key, heard] : processes_) {
    const std::string& name = heard.newest.process_name;
    if (!heard.has_ended() && !alive.insert(name).second) twins.insert(name);
  }
  return {twins.begin(), twins.end()};
}

std::vector<std::string> StatusBoard::warnings() const {
  std::vector<std::string> lines;
  const std::vector<std::string> silent = missing();
  if (!silent.empty()) lines.push_back("not heard: " + listed(silent));
  for (const std::string& name : twins()) {
    std::vector<std::string> where;
    for (const auto& [key, heard] : processes_)
      if (heard.newest.process_name == name && !heard.has_ended())
        where.push_back(fmt::format("pid {} on {}", heard.newest.pid, heard.newest.host));
    lines.push_back(
        fmt::format("{} runs more than once ({}): end all but one", name, listed(where)));
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
  for (const auto& [name, count] : own_counters_)
    if (count > 0 && is_drop(name)) names.insert(name.substr(name.find(' ') + 1));
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

std::string StatusBoard::activity() const {
  const Heard* babbler = find("motor_babbler");
  const auto& motion = newest_.motion;
  const auto& control = newest_.control;
  if (!motion) return "Waits for a driver: nobody sends MOTION_STATUS.";
  if (motion->stop_latched == 1) return "Halted: nothing moves until `" + to_type("resume") + "`.";
  if (control && control->owns_arm == 1)
    return fmt::format("The controller has the arm, {}: {}",
                       name_in(kControlStates, control->control_state), control->why);
  if (babbler && !babbler->has_ended()) {
    const process_info_t& info = babbler->newest;
    if (info.phase == process_info_t::PHASE_DONE) return "Done: " + info.activity;
    return (info.phase == process_info_t::PHASE_WORKING ? "Learning: " : "Waits: ") + info.activity;
  }
  std::vector<std::string> working;
  for (const auto& [key, heard] : processes_)
    if (heard.newest.phase == process_info_t::PHASE_WORKING)
      working.push_back(heard.newest.process_name + ": " + heard.newest.activity);
  return working.empty() ? "Nobody works: no babbler moves the arm."
                         : fmt::format("No babbler moves the arm; {}", fmt::join(working, "; "));
}

std::string StatusBoard::headline() const {
  if (arrivals_.empty())
    return is_silent() ? "Nothing on the bus."
                       : "Nothing but garbage on the bus: is it another program's?";
  const Heard* babbler = find("motor_babbler");
  std::string line = activity();
  if (!line.ends_with('.')) line += '.';
  if (babbler && babbler->newest.phase == process_info_t::PHASE_DONE && line.starts_with("Done"))
    line += std::string(" ") + kNobodyWatches;
  // At first all wait for each other, and a controller waits for a target.
  for (const auto& [key, heard] : processes_) {
    const process_info_t& info = heard.newest;
    if (newest_.is_accepted && info.phase == process_info_t::PHASE_WAITING &&
        info.process_name != "motor_babbler" && info.process_name != "controller")
      line += fmt::format(" {} {}{}.", info.process_name,
                          info.activity.starts_with("waits") ? "" : "waits: ", info.activity);
  }
  if (const auto silent = missing(); !silent.empty()) line += " Not heard: " + listed(silent) + ".";
  return line;
}

GroupStatus StatusBoard::status() const {
  GroupStatus status = newest_;
  status.headline = headline();
  status.missing = missing();
  status.twins = twins();
  status.warnings = warnings();
  const double window_s = std::max(1e-3, seconds(end_us_ - begin_us_));
  const std::set<std::string> names = channels();
  for (const std::string& name : names) {
    GroupStatus::ChannelUse& channel = status.channels.emplace_back();
    channel.name = name;
    channel.dropped = dropped(name);
    const auto arrivals = arrivals_.find(name);
    if (arrivals == arrivals_.end()) continue;
    channel.count = arrivals->second.count;
    channel.rate_hz = static_cast<double>(channel.count) / window_s;
    channel.age_s = seconds(end_us_ - arrivals->second.last_us);
  }
  for (const auto& [key, heard] : processes_) {
    GroupStatus::Process& process = status.processes.emplace_back();
    process.info = heard.newest;
    process.age_s = heard.age_s();
    process.cpu_percent = heard.cpu_percent();
    for (const counter_t& counter : heard.newest.counters) {
      if (counter.count != 0 && !is_traffic(counter.counter_name) &&
          !is_loss_on(counter.counter_name, names))
        process.other_counters.push_back(counter);
    }
  }
  return status;
}

}  // namespace bodyschema
