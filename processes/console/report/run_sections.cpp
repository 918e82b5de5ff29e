#include "processes/console/report/run_sections.h"

#include <fmt/format.h>

#include <algorithm>
#include <string>
#include <utility>
#include <vector>

#include "processes/console/names.h"

namespace bodyschema {
namespace {

Json latency_rows(const RunRecord& record) {
  Json rows = Json::array();
  for (const RunRecord::Latency& latency : record.latencies()) {
    const auto ms = [&](double q) {
      return fmt::format("{:.1f} ms", quantile(latency.seconds, q) * 1e3);
    };
    rows.push_back(
        {{"between", latency.name},
         {"numbers", {std::to_string(latency.seconds.size()), ms(0.5), ms(0.95), ms(1)}}});
  }
  return rows;
}

}  // namespace

Json table(Json rows) { return rows.empty() ? Json() : Json{{"rows", std::move(rows)}}; }

Json flaws_data(const Report& report) {
  Json lines = Json::array();
  for (const auto& [file, summary] : report.logs) {
    // A file that is being written often ends in the middle of an event.
    if (report.goes_on && summary.unreadable() == 0) continue;
    for (std::string text = flaws_text(summary); !text.empty();) {
      const std::size_t end = text.find('\n');
      lines.push_back(file.filename().string() + ": " + text.substr(0, end));
      text.erase(0, end + 1);
    }
  }
  return lines;
}

Json processes_data(const RunRecord& record) {
  const auto processes = record.processes();
  Json resources = Json::array(), counters = Json::array();
  for (const RunRecord::Process& process : processes) {
    const process_info_t& info = process.newest;
    const double age_s = static_cast<double>(info.utime - info.start_utime) * 1e-6;
    const double used_s = static_cast<double>(info.cpu_us) * 1e-6;
    resources.push_back(
        {{"process", info.process_name},
         {"host", info.host},
         {"numbers",
          {std::to_string(info.pid), fmt::format("{:.1f} s", used_s),
           age_s > 0.1 ? fmt::format("{:.0f} %", 100 * used_s / age_s) : "–",
           fmt::format("{:.0f} MB", static_cast<double>(info.resident_bytes) * 1e-6)}},
         {"at_the_end", fmt::format("{}: {}", name_in(kPhases, info.phase), info.activity)}});
    for (const counter_t& counter : info.counters) {
      const std::string& name = counter.counter_name;
      if (counter.count == 0 || name.starts_with("received ") || name.starts_with("published "))
        continue;
      counters.push_back(
          {{"process", info.process_name}, {"counter", name}, {"count", counter.count}});
    }
  }
  Json latencies = latency_rows(record);
  if (processes.empty() && latencies.empty()) return nullptr;
  return {{"loads", Json::array()},
          {"resources", table(std::move(resources))},
          {"latencies", table(std::move(latencies))},
          {"counters", table(std::move(counters))}};
}

Json events_data(const RunRecord& record) {
  const auto& samples = record.watch().samples();
  // The arm's clock, a simulated one of a simulated arm.
  const auto time = [&](std::int64_t utime) {
    if (samples.empty()) return std::string("–");
    return fmt::format("{:.1f} s", static_cast<double>(utime - samples.front().utime) * 1e-6);
  };
  Json faults = Json::array(), decisions = Json::array();
  for (const RunRecord::FaultChange& change : record.faults()) {
    const auto first = std::find_if(samples.begin(), samples.end(), [&](const auto& sample) {
      return sample.utime >= change.utime;
    });
    faults.push_back(
        {{"sample", first == samples.end() ? "–" : std::to_string(first->sample_index)},
         {"time", time(change.utime)},
         {"broken", change.faults.empty() ? "nothing: repaired"
                                          : fmt::format("{}", fmt::join(change.faults, ", "))}});
  }
  constexpr std::size_t kMost = 200;
  const std::vector<health_event_t> all = record.events();
  for (std::size_t i = all.size() - std::min(all.size(), kMost); i < all.size(); ++i) {
    decisions.push_back({{"sample", all[i].event_sample},
                         {"time", time(all[i].utime)},
                         {"text", all[i].event_text}});
  }
  if (faults.empty() && decisions.empty()) return nullptr;
  return {{"faults", table(std::move(faults))},
          {"decisions", table(std::move(decisions))},
          {"left_out", all.size() > kMost ? Json{{"newest", kMost}, {"all", all.size()}} : Json()}};
}

Json messages_data(const Report& report) {
  if (report.logs.empty()) return nullptr;
  Json rows = Json::array();
  for (const auto& [file, summary] : report.logs) {
    for (const auto& [name, channel] : summary.channels) {
      const double s = static_cast<double>(channel.last_utime - channel.first_utime) * 1e-6;
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
