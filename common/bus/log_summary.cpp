#include "common/bus/log_summary.h"

#include <spdlog/fmt/fmt.h>

#include <stdexcept>
#include <utility>

#include "common/bus/channels.h"

namespace bodyschema {
namespace {

using Judge = std::string (*)(const LogEvent&);

template <class Message>
std::pair<std::string, Judge> judge_of(const Channel<Message>& channel) {
  return {channel.name, [](const LogEvent& event) {
            return decode<Message>(event.data.data(), event.data.size()).problem;
          }};
}

/// For every channel of ours, what is wrong with an event of it.
const std::map<std::string, Judge>& judges() {
  static const std::map<std::string, Judge> judges = {
      judge_of(kActionCommand), judge_of(kMotionStatus),  judge_of(kSimState),
      judge_of(kCameraImage),   judge_of(kCameraInfo),    judge_of(kMarkerPoses),
      judge_of(kSample),        judge_of(kSampleRequest), judge_of(kLearnedSchema),
      judge_of(kBodySchema),    judge_of(kModelHealth),   judge_of(kPoseTarget),
      judge_of(kControlStatus), judge_of(kFaultCommand),  judge_of(kProcessInfo)};
  return judges;
}

}  // namespace

bool LogSummary::has_readable(const std::string& channel) const {
  const auto found = channels.find(channel);
  return found != channels.end() && found->second.is_readable();
}

std::string problem_of(const LogEvent& event) {
  const auto judge = judges().find(event.channel);
  return judge == judges().end() ? "" : judge->second(event);
}

LogSummary summarize_log(const std::filesystem::path& path) {
  LogSummary summary;
  LogReader reader(path);
  std::int64_t first_utime = 0;
  const auto next = [&] {
    try {
      return reader.next();
    } catch (const std::runtime_error& error) {
      if (reader.position() == 0) throw;
      summary.ending =
          fmt::format("{}; the {} events before it are good", error.what(), reader.report().events);
      return false;
    }
  };
  while (next()) {
    const LogEvent& event = reader.event();
    if (summary.num_events++ == 0) first_utime = event.event_utime;
    summary.duration_s = static_cast<double>(event.event_utime - first_utime) * 1e-6;
    LogSummary::Channel& channel = summary.channels[event.channel];
    ++channel.num_events;
    const std::string problem = problem_of(event);
    if (!problem.empty() && channel.num_unreadable++ == 0) channel.problem = problem;
  }
  if (const auto byte = reader.report().truncated_at_byte) {
    summary.ending =
        fmt::format("{}: is cut off in the event at byte {}; the {} events before it are good",
                    path.string(), *byte, summary.num_events);
  }
  return summary;
}

}  // namespace bodyschema
