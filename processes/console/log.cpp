#include "processes/console/log.h"

#include <fmt/format.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>
#include <stdexcept>

#include "common/bus/channels.h"
#include "common/bus/event_log.h"
#include "common/bus/log_summary.h"

namespace bodyschema {
namespace {

struct LogArguments {
  std::string log;
  bool json = false;
  bool replay_from = false;
  std::vector<std::string> channels;
  std::string copy;
};

/// Where a replay starts: MARKER_POSES, from which the observer makes the samples again, or SAMPLE.
std::string replay_start(const LogSummary& summary, const std::string& log) {
  const bool has_poses = summary.has_readable(kMarkerPoses.name) &&
                         summary.has_readable(kMotionStatus.name) &&
                         summary.has_readable(kCameraInfo.name);
  if (has_poses) return kMarkerPoses.name;
  if (summary.has_readable(kSample.name)) return kSample.name;
  throw std::runtime_error(log +
                           ": holds nothing to learn from: neither SAMPLE, nor MARKER_POSES with "
                           "MOTION_STATUS and CAMERA_INFO, that can be read");
}

nlohmann::ordered_json to_json(const LogSummary& summary) {
  nlohmann::ordered_json json = {{"events", summary.num_events},
                                 {"seconds", summary.duration_s},
                                 {"ending", summary.ending},
                                 {"channels", nlohmann::ordered_json::object()}};
  for (const auto& [name, channel] : summary.channels) {
    json["channels"][name] = {{"events", channel.num_events},
                              {"unreadable", channel.num_unreadable},
                              {"problem", channel.problem}};
  }
  return json;
}

void run_log(const LogArguments& arguments) {
  const LogSummary summary = summarize_log(arguments.log);
  if (!summary.ending.empty()) std::cerr << summary.ending << std::endl;
  for (const auto& [name, channel] : summary.channels) {
    if (channel.num_unreadable == 0) continue;
    std::cerr << fmt::format("{}: {} of {} {} cannot be read, the first because: {}\n",
                             arguments.log, channel.num_unreadable, channel.num_events, name,
                             channel.problem);
  }
  if (!arguments.copy.empty()) {
    std::error_code none;
    if (std::filesystem::equivalent(arguments.log, arguments.copy, none))
      throw std::invalid_argument("--to: " + arguments.copy + " is the log that is read");
    LogAppender copy(arguments.copy, LogAppender::Mode::kOverwrite,
                     LogAppender::Durability::kToKernel);
    LogReader reader(arguments.log);
    // Up to where the summary found the log to be good.
    for (std::int64_t i = 0; i < summary.num_events && reader.next(); ++i) {
      const LogEvent& event = reader.event();
      const bool is_wanted =
          std::count(arguments.channels.begin(), arguments.channels.end(), event.channel) > 0;
      if (is_wanted && problem_of(event).empty())
        copy.append_bytes(event.channel, event.data, event.event_utime);
    }
  } else if (arguments.replay_from) {
    std::cout << replay_start(summary, arguments.log) << std::endl;
  } else if (arguments.json) {
    std::cout << to_json(summary).dump(2) << std::endl;
  } else {
    std::cout << fmt::format("{} events in {:.1f} s\n", summary.num_events, summary.duration_s);
    for (const auto& [name, channel] : summary.channels)
      std::cout << fmt::format("  {:<16} {:>8}\n", name, channel.num_events);
    std::cout << std::flush;
  }
}

}  // namespace

void add_log_command(CLI::App& console) {
  const auto arguments = std::make_shared<LogArguments>();
  CLI::App* log = console.add_subcommand(
      "log", "What an LCM log holds, where it is cut off, what cannot be read");
  log->add_option("LOG", arguments->log, "LCM log")->required();
  log->add_flag("--json", arguments->json, "Print JSON");
  log->add_flag("--replay-from", arguments->replay_from,
                "Print the channel from which a replay can learn: MARKER_POSES or SAMPLE");
  CLI::Option* to = log->add_option("--to", arguments->copy, "Copy to a new log …");
  log->add_option("--copy", arguments->channels,
                  "… the messages of these channels that can be read")
      ->needs(to);
  log->callback([arguments] { run_log(*arguments); });
}

}  // namespace bodyschema
