#include <fmt/chrono.h>
#include <fmt/format.h>

#include <algorithm>
#include <iostream>
#include <list>
#include <map>
#include <set>
#include <stdexcept>
#include <tuple>
#include <utility>
#include <vector>

#include "common/bus/all_channels.h"
#include "common/bus/log_summary.h"
#include "common/bus/rig_door.h"
#include "common/text/clock.h"
#include "processes/console/commands/commands.h"
#include "processes/console/commands/files.h"
#include "processes/console/hint.h"

namespace bodyschema {
namespace {

struct LogArguments {
  std::string file;
  bool json = false;
  bool check = false;
  bool replay_from = false;
  std::string rigs;
  std::string thin;
  std::vector<std::string> channels;
  std::string copy;
};

/// The channel from which a replay starts: MARKER_POSES or SAMPLE.
std::string replay_start(const LogSummary& summary, const std::string& file) {
  const auto has = [&](const std::string& channel) {
    const auto found = summary.channels.find(channel);
    return found != summary.channels.end() && found->second.events > found->second.unreadable;
  };
  if (has(kMarkerPoses.name) && has(kMotionStatus.name) && has(kCameraInfo.name))
    return kMarkerPoses.name;
  if (has(kSample.name)) return kSample.name;
  throw std::runtime_error(file +
                           ": holds nothing to learn from: neither SAMPLE, nor MARKER_POSES with "
                           "MOTION_STATUS and CAMERA_INFO, that can be read");
}

/// Events of a log for another one.
class Copy {
 public:
  void add(const LogEvent& event) {
    const auto encoded = encode_event(event.channel, event.data, event.event_utime, num_events_++);
    bytes_.append(encoded.begin(), encoded.end());
  }
  void write(const std::filesystem::path& file) const {
    write_file_atomically(file, bytes_);
    std::cout << num_events_ << " events in " << file.string() << std::endl;
  }

 private:
  std::string bytes_;
  std::int64_t num_events_ = 0;
};

/// The messages of these channels that can be read, up to where the log is damaged.
void copy_channels(const std::string& file, const std::vector<std::string>& channels,
                   const std::string& to) {
  std::error_code none;
  if (std::filesystem::equivalent(file, to, none))
    throw std::invalid_argument("--to: " + to + " is the log that is read");
  Copy copy;
  const std::int64_t num_good = summarize_log(file).events;
  LogReader reader(file);
  for (std::int64_t i = 0; i < num_good && reader.next(); ++i) {
    const LogEvent& event = reader.event();
    if (std::ranges::count(channels, event.channel) > 0 && problem_of(event).empty())
      copy.add(event);
  }
  copy.write(to);
}

/// The one rig folder below `rigs` to which all that the log tells may belong: cameras, tags,
/// signals, parts. @throws std::runtime_error if there is none or several.
std::filesystem::path rig_of(const std::filesystem::path& log, const std::filesystem::path& rigs) {
  struct Candidate {
    std::filesystem::path folder;
    RigDoor door;
  };
  std::list<Candidate> candidates;
  std::string against;  // one line for each rig that it is not
  const auto rule_out = [&](const std::filesystem::path& folder, const std::string& why) {
    against += fmt::format("\n  {}: {}", folder.filename().string(), why);
  };
  std::set<std::filesystem::path> folders;
  for (const auto& entry : std::filesystem::directory_iterator(rigs))
    if (entry.is_directory()) folders.insert(entry.path());
  for (const std::filesystem::path& folder : folders) {
    try {
      candidates.push_back({folder, RigDoor(folder)});
    } catch (const std::exception& error) {
      rule_out(folder, error.what());
    }
  }
  // Repetitions say nothing new, and a log may be long.
  constexpr int kEnough = 1000;
  int num_judged = 0;
  LogReader reader(log, OnDamage::kSkip);
  while (num_judged < kEnough && reader.next()) {
    const LogEvent& event = reader.event();
    const auto judge_by = [&]<class Message>(const Channel<Message>& channel) {
      const auto message = message_of(event, channel);
      if (!message) return;
      ++num_judged;
      std::erase_if(candidates, [&](const Candidate& candidate) {
        const std::string why_not = candidate.door.objection(*message);
        if (!why_not.empty())
          rule_out(candidate.folder, std::string(channel.name) + ": " + why_not);
        return !why_not.empty();
      });
    };
    judge_by(kCameraInfo);
    judge_by(kMarkerPoses);
    judge_by(kMotionStatus);
    judge_by(kSample);
    judge_by(kBodySchema);
  }
  if (num_judged == 0)
    throw std::runtime_error(log.string() + ": says nothing of its rig; type --rig RIG");
  if (candidates.empty())
    throw std::runtime_error(fmt::format("{}: of none of the rigs in {}; type --rig RIG{}",
                                         log.string(), rigs.string(), against));
  if (candidates.size() > 1) {
    const std::string names =
        listed(candidates, [](const Candidate& one) { return one.folder.filename().string(); });
    throw std::runtime_error(log.string() + ": may be of several rigs: " + names +
                             "; type --rig RIG");
  }
  return candidates.front().folder;
}

Json log_json(const LogSummary& summary) {
  Json json = {{"sound", summary.is_sound()},        {"events", summary.events},
               {"first_utime", summary.first_utime}, {"last_utime", summary.last_utime},
               {"bytes", summary.file_bytes},        {"unread_bytes", summary.unread_bytes},
               {"damage", summary.damage},           {"unreadable", summary.unreadable()},
               {"versions", summary.versions},       {"channels", Json::object()}};
  for (const auto& [name, channel] : summary.channels)
    json["channels"][name] = {
        {"events", channel.events},         {"bytes", channel.bytes},
        {"known", channel.is_known},        {"unreadable", channel.unreadable},
        {"problem", channel.first_problem}, {"first_utime", channel.first_utime},
        {"last_utime", channel.last_utime}};
  return json;
}

/// A table of the channels, and a line for every flaw.
std::string log_text(const LogSummary& summary) {
  std::string text;
  if (summary.events > 0) {
    text += fmt::format("{} events in {:.1f} s from {:%Y-%m-%d %H:%M:%S} UTC, {:.1f} MB\n",
                        summary.events, seconds(summary.last_utime - summary.first_utime),
                        fmt::gmtime(static_cast<std::time_t>(summary.first_utime / 1'000'000)),
                        static_cast<double>(summary.file_bytes) * 1e-6);
    text += "  channel            events  unreadable       kB   first    last\n";
  }
  for (const auto& [name, channel] : summary.channels)
    text +=
        fmt::format("  {:<18} {:>6}  {:>10} {:>8.0f} {:>6.1f}s {:>6.1f}s\n", name, channel.events,
                    channel.is_known ? std::to_string(channel.unreadable) : "not ours",
                    static_cast<double>(channel.bytes) * 1e-3,
                    seconds(channel.first_utime - summary.first_utime),
                    seconds(channel.last_utime - summary.first_utime));
  const std::string flaws = flaws_text(summary);
  return text + (flaws.empty() ? "whole, and every message can be read\n" : flaws);
}

/// Writes a small copy of a log, enough to replay and to report it: without images, ground truth
/// (SIM_STATE) and channels that are not ours, every message once however often it was repeated, of
/// PROCESS_INFO each process' first and last.
/// @throws std::runtime_error; nothing is left of the copy then.
void thin_log(const std::filesystem::path& file, const std::filesystem::path& to) {
  std::set<std::string> kept_channels;
  for_each_channel([&](const auto& channel) { kept_channels.insert(channel.name); });
  kept_channels.erase(kCameraImage.name);
  kept_channels.erase(kSimState.name);
  // Which PROCESS_INFO is a process' last is known at the end only.
  std::map<std::tuple<std::string, std::string, int>, std::pair<std::int64_t, std::int64_t>> infos;
  std::int64_t index = 0;
  for_each_event(file, [&](const LogEvent& event) {
    ++index;
    const auto info = message_of(event, kProcessInfo);
    if (!info) return;
    const auto [place, is_first] =
        infos.try_emplace({info->host, info->process_name, info->pid}, index, index);
    place->second.second = index;
  });
  std::set<std::int64_t> kept_infos;
  for (const auto& [process, first_last] : infos)
    kept_infos.insert({first_last.first, first_last.second});

  Copy copy;
  std::set<std::pair<std::string, std::vector<std::uint8_t>>> seen;
  index = 0;
  for_each_event(file, [&](const LogEvent& event) {
    ++index;
    if (!kept_channels.contains(event.channel)) return;
    if (event.channel == kProcessInfo.name && !kept_infos.contains(index)) return;
    if (seen.emplace(event.channel, event.data).second) copy.add(event);
  });
  copy.write(to);
}

void run_log(const LogArguments& arguments) {
  const std::string& file = arguments.file;
  if (!arguments.thin.empty()) return thin_log(file, arguments.thin);
  if (!arguments.rigs.empty()) {
    std::cout << rig_of(file, arguments.rigs).filename().string() << std::endl;
    return;
  }
  if (!arguments.copy.empty()) return copy_channels(file, arguments.channels, arguments.copy);
  const LogSummary summary = summarize_log(file);
  const std::string flaws = flaws_text(summary);
  if (arguments.replay_from) {
    if (!flaws.empty()) std::cerr << file << ": " << flaws << std::flush;
    std::cout << replay_start(summary, file) << std::endl;
  } else {
    print(arguments.json, log_json(summary), log_text(summary));
  }
  if (arguments.check && !summary.is_sound())
    throw std::runtime_error(file + ": " + flaws.substr(0, flaws.find('\n')));
}

}  // namespace

void add_log_command(Arguments console) {
  auto [log, arguments] =
      console.add_command("log", "What an LCM log holds, and what is wrong with it", run_log);
  log.add_option("FILE", arguments.file, "LCM log").required();
  log.add_flag("--json", arguments.json, "Print JSON");
  log.add_flag("--check", arguments.check,
               "Fail unless it is whole and every message of ours can be read");
  log.add_flag("--replay-from", arguments.replay_from,
               "Print the channel from which a replay can learn: MARKER_POSES or SAMPLE");
  log.add_option("--rig-of", arguments.rigs,
                 "Print the name of the rig in this folder that was recorded")
      .type_name("FOLDER");
  log.add_option("--thin", arguments.thin,
                 "Write a small copy: no images, no ground truth, nothing twice")
      .type_name("FILE");
  const Argument to = log.add_option("--to", arguments.copy, "Copy to a new log …");
  log.add_option("--copy", arguments.channels, "… the messages of these channels that can be read")
      .needs(to);
}

}  // namespace bodyschema
