#include "common/bus/log_summary.h"

#include <spdlog/fmt/fmt.h>

#include <algorithm>
#include <stdexcept>
#include <system_error>

#include "common/bus/all_channels.h"
#include "common/bus/check.h"
#include "common/text/text.h"

namespace bodyschema {
namespace {

/// Problem of the event's bytes; "" if there is none.
using Check = std::string (*)(const LogEvent&, std::set<std::string>& versions);

template <class Message>
std::string check_event(const LogEvent& event, std::set<std::string>& versions) {
  const Decoded<Message> decoded = decode<Message>(event.data.data(), event.data.size());
  if constexpr (std::is_same_v<Message, process_info_t>) {
    if (decoded.message) versions.insert(decoded.message->program_version);
  }
  return decoded.problem;
}

const std::map<std::string, Check>& checks() {
  static const std::map<std::string, Check> kChecks = [] {
    std::map<std::string, Check> all;
    for_each_channel([&]<class Message>(const Channel<Message>& channel) {
      all[channel.name] = &check_event<Message>;
    });
    return all;
  }();
  return kChecks;
}

}  // namespace

void LogSummary::add(const LogEvent& event) {
  if (events++ == 0) first_utime = event.event_utime;
  last_utime = std::max(last_utime, event.event_utime);
  // A foreign name may hold any bytes.
  ChannelSummary& channel = channels[as_text(event.channel)];
  if (channel.events++ == 0) channel.first_utime = event.event_utime;
  channel.last_utime = std::max(channel.last_utime, event.event_utime);
  channel.bytes += static_cast<std::int64_t>(event.data.size());
  const auto check = checks().find(event.channel);
  channel.is_known = check != checks().end();
  if (!channel.is_known) return;
  const std::string problem = check->second(event, versions);
  if (!problem.empty() && channel.unreadable++ == 0) channel.first_problem = as_text(problem);
}

std::int64_t LogSummary::unreadable() const {
  std::int64_t sum = 0;
  for (const auto& [name, channel] : channels) sum += channel.unreadable;
  return sum;
}

LogSummary summarize_log(const std::filesystem::path& file) {
  LogSummary summary;
  LogReader reader(file);
  try {
    while (reader.next()) summary.add(reader.event());
    if (reader.report().truncated_at_byte) {
      summary.damage = fmt::format("is cut off in the middle of an event at byte {}",
                                   *reader.report().truncated_at_byte);
    }
  } catch (const std::runtime_error& error) {
    if (reader.position() == 0) throw;
    const std::string& damage = reader.report().damage;
    summary.damage = damage.empty() ? as_text(error.what()) : damage;
  }
  summary.incomplete = reader.report().incomplete;
  std::error_code error;
  const auto size = std::filesystem::file_size(file, error);
  summary.file_bytes = error ? reader.position() : static_cast<std::int64_t>(size);
  summary.unread_bytes = std::max<std::int64_t>(0, summary.file_bytes - reader.position());
  return summary;
}

std::string problem_of(const LogEvent& event) {
  std::set<std::string> versions;
  const auto check = checks().find(event.channel);
  return check == checks().end() ? "" : check->second(event, versions);
}

std::string program_version() { return BODYSCHEMA_VERSION; }

std::string flaws_text(const LogSummary& summary) {
  std::string text;
  if (summary.events == 0 && summary.damage.empty()) text += "holds no event\n";
  if (!summary.damage.empty()) {
    text += fmt::format("{}; the {} events before it are good, {} bytes after it are lost\n",
                        summary.damage, summary.events, summary.unread_bytes);
  }
  for (const auto& [name, channel] : summary.channels) {
    if (channel.unreadable == 0) continue;
    text += fmt::format("{}: {} of {} messages cannot be read: {}\n", name, channel.unreadable,
                        channel.events, channel.first_problem);
  }
  if (summary.incomplete > 0) {
    text +=
        fmt::format("{} messages are incomplete: pieces of them were lost\n", summary.incomplete);
  }
  const std::string own = program_version();
  for (const std::string& version : summary.versions) {
    if (version == own) continue;
    text += fmt::format("recorded with version {}, this is {}{}\n", version, own,
                        summary.unreadable() > 0 ? ": read it with that version" : "");
  }
  return text;
}

}  // namespace bodyschema
