#include "processes/console/report/run_sections.h"

#include <fmt/format.h>

#include <algorithm>
#include <span>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

#include "common/text/clock.h"
#include "processes/console/hint.h"
#include "processes/console/names.h"

namespace bodyschema {
namespace {

Json latency_row(const RunRecord::Latency& latency) {
  const auto ms = [&](double q) {
    return fmt::format("{:.1f} ms", quantile(latency.seconds, q) * 1e3);
  };
  return {{"between", latency.name},
          {"numbers", {std::to_string(latency.seconds.size()), ms(0.5), ms(0.95), ms(1)}}};
}

Json resources_row(const RunRecord::Process& process) {
  const process_info_t& info = process.newest;
  const double age_s = seconds(info.utime - info.start_utime), used_s = seconds(info.cpu_us);
  return {{"process", info.process_name},
          {"host", info.host},
          {"numbers",
           {std::to_string(info.pid), fmt::format("{:.1f} s", used_s),
            age_s > 0.1 ? fmt::format("{:.0f} %", 100 * used_s / age_s) : "–",
            fmt::format("{:.0f} MB", static_cast<double>(info.resident_bytes) * 1e-6)}},
          {"at_the_end", fmt::format("{}: {}", name_in(kPhases, info.phase), info.activity)}};
}

}  // namespace

Json table(Json rows) { return rows.empty() ? Json() : Json{{"rows", std::move(rows)}}; }

Json flaws_data(const Report& report) {
  Json lines = Json::array();
  for (const auto& [file, summary] : report.logs) {
    // A file that is being written often ends in the middle of an event.
    if (report.goes_on && summary.unreadable() == 0) continue;
    std::istringstream flaws(flaws_text(summary));
    for (std::string flaw; std::getline(flaws, flaw);)
      lines.push_back(file.filename().string() + ": " + flaw);
  }
  return lines;
}

Json processes_data(const RunRecord& record) {
  const auto processes = record.processes();
  const auto latencies = record.latencies();
  if (processes.empty() && latencies.empty()) return nullptr;
  Json counters = Json::array();
  for (const RunRecord::Process& process : processes) {
    for (const counter_t& counter : process.newest.counters)
      if (counter.count != 0 && !is_traffic(counter.counter_name))
        counters.push_back({{"process", process.newest.process_name},
                            {"counter", counter.counter_name},
                            {"count", counter.count}});
  }
  return {{"loads", Json::array()},
          {"resources", table(array_of(processes, resources_row))},
          {"latencies", table(array_of(latencies, latency_row))},
          {"counters", table(std::move(counters))}};
}

Json events_data(const RunRecord& record) {
  const auto& samples = record.watch().samples();
  // The arm's clock, a simulated one of a simulated arm.
  const auto time = [&](std::int64_t utime) {
    if (samples.empty()) return std::string("–");
    return fmt::format("{:.1f} s", seconds(utime - samples.front().utime));
  };
  const auto fault_row = [&](const RunRecord::FaultChange& change) -> Json {
    const auto first = std::ranges::find_if(
        samples, [&](const auto& sample) { return sample.utime >= change.utime; });
    return {{"sample", first == samples.end() ? "–" : std::to_string(first->sample_index)},
            {"time", time(change.utime)},
            {"broken", change.faults.empty() ? "nothing: repaired" : listed(change.faults)}};
  };
  const auto decision_row = [&](const health_event_t& event) -> Json {
    return {
        {"sample", event.event_sample}, {"time", time(event.utime)}, {"text", event.event_text}};
  };
  constexpr std::size_t kMost = 200;
  const std::vector<health_event_t> all = record.events();
  if (record.faults().empty() && all.empty()) return nullptr;
  const std::span newest = std::span(all).last(std::min(all.size(), kMost));
  return {{"faults", table(array_of(record.faults(), fault_row))},
          {"decisions", table(array_of(newest, decision_row))},
          {"left_out", all.size() > kMost ? Json{{"newest", kMost}, {"all", all.size()}} : Json()}};
}

Json messages_data(const Report& report) {
  if (report.logs.empty()) return nullptr;
  Json rows = Json::array();
  for (const auto& [file, summary] : report.logs) {
    for (const auto& [name, channel] : summary.channels) {
      const double s = seconds(channel.last_utime - channel.first_utime);
      rows.push_back(
          {{"log", file.filename().string()},
           {"channel", name},
           {"numbers",
            {std::to_string(channel.events),
             fmt::format("{:.0f} kB", static_cast<double>(channel.bytes) * 1e-3),
             s > 0 ? fmt::format("{:.1f}/s", static_cast<double>(channel.events) / s) : "–",
             channel.is_known ? std::to_string(channel.unreadable) : "not ours"}}});
    }
  }
  return {{"channels", table(std::move(rows))}};
}

Json configuration_data(const RunRecord& record) {
  Json files = Json::array();
  std::string previous;
  for (const RunRecord::Process& process : record.processes()) {
    const process_info_t& info = process.newest;
    if (info.process_name == previous) continue;  // the same process, started again
    previous = info.process_name;
    files.push_back({{"process", info.process_name},
                     {"seed", info.seed >= 0 ? Json(info.seed) : Json()},
                     {"text", info.configuration}});
  }
  return files.empty() ? Json() : Json{{"files", files}};
}

}  // namespace bodyschema
