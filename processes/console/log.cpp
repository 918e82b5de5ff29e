#include "processes/console/log.h"

#include <fmt/chrono.h>
#include <fmt/format.h>

#include <CLI/CLI.hpp>
#include <iostream>
#include <memory>
#include <stdexcept>

namespace bodyschema {
namespace {

double seconds(std::int64_t from_us, std::int64_t to_us) {
  return static_cast<double>(to_us - from_us) * 1e-6;
}

void run_log(const std::string& file, bool json, bool check) {
  const LogSummary summary = summarize_log(file);
  if (json) {
    std::cout << log_json(summary).dump(2) << std::endl;
  } else {
    std::cout << log_text(summary) << std::flush;
  }
  if (check && !summary.is_sound()) {
    const std::string flaws = flaws_text(summary);
    throw std::runtime_error(file + ": " + flaws.substr(0, flaws.find('\n')));
  }
}

}  // namespace

nlohmann::ordered_json log_json(const LogSummary& summary) {
  nlohmann::ordered_json json = {
      {"sound", summary.is_sound()},        {"events", summary.events},
      {"first_utime", summary.first_utime}, {"last_utime", summary.last_utime},
      {"bytes", summary.file_bytes},        {"unread_bytes", summary.unread_bytes},
      {"damage", summary.damage},           {"unreadable", summary.unreadable()},
      {"versions", summary.versions},       {"channels", nlohmann::ordered_json::object()}};
  for (const auto& [name, channel] : summary.channels) {
    json["channels"][name] = {
        {"events", channel.events},         {"bytes", channel.bytes},
        {"known", channel.is_known},        {"unreadable", channel.unreadable},
        {"problem", channel.first_problem}, {"first_utime", channel.first_utime},
        {"last_utime", channel.last_utime}};
  }
  return json;
}

std::string log_text(const LogSummary& summary) {
  std::string text;
  if (summary.events > 0) {
    text += fmt::format("{} events in {:.1f} s from {:%Y-%m-%d %H:%M:%S} UTC, {:.1f} MB\n",
                        summary.events, seconds(summary.first_utime, summary.last_utime),
                        fmt::gmtime(static_cast<std::time_t>(summary.first_utime / 1'000'000)),
                        static_cast<double>(summary.file_bytes) * 1e-6);
    text += "  channel            events  unreadable       kB   first    last\n";
  }
  for (const auto& [name, channel] : summary.channels) {
    text +=
        fmt::format("  {:<18} {:>6}  {:>10} {:>8.0f} {:>6.1f}s {:>6.1f}s\n", name, channel.events,
                    channel.is_known ? std::to_string(channel.unreadable) : "not ours",
                    static_cast<double>(channel.bytes) * 1e-3,
                    seconds(summary.first_utime, channel.first_utime),
                    seconds(summary.first_utime, channel.last_utime));
  }
  const std::string flaws = flaws_text(summary);
  return text + (flaws.empty() ? "whole, and every message can be read\n" : flaws);
}

void add_log_command(CLI::App& console) {
  struct Arguments {
    std::string file;
    bool json = false;
    bool check = false;
  };
  const auto arguments = std::make_shared<Arguments>();
  CLI::App* log = console.add_subcommand("log", "What an LCM log holds, and what is wrong with it");
  log->add_option("FILE", arguments->file, "LCM log")->required();
  log->add_flag("--json", arguments->json, "Print JSON");
  log->add_flag("--check", arguments->check,
                "Fail unless it is whole and every message of ours can be read");
  log->callback([arguments] { run_log(arguments->file, arguments->json, arguments->check); });
}

}  // namespace bodyschema
