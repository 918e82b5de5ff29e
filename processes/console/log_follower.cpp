#include "processes/console/log_follower.h"

#include <fmt/format.h>

#include <stdexcept>
#include <system_error>

#include "common/text/text.h"

namespace bodyschema {

bool LogFollower::read(const std::filesystem::path& file, const Visit& visit) {
  std::error_code error;
  const auto size = static_cast<std::int64_t>(std::filesystem::file_size(file, error));
  if (error || size == 0) return false;
  Progress& progress = progress_[file];
  if (progress.is_damaged || size == progress.seen_size) return false;
  progress.seen_size = size;

  LogSummary& summary = summaries_[file];
  const std::int64_t events_before = summary.events;
  summary.damage.clear();
  try {
    LogReader reader(file, OnDamage::kThrow, progress.position, Pieces::kAsRecorded);
    try {
      while (reader.next()) {
        LogEvent event = reader.event();
        if (progress.joiner.join(&event)) {
          summary.add(event);
          visit(event, file, progress.position);
        }
        progress.position = reader.position();
      }
      if (reader.report().truncated_at_byte)
        summary.damage =
            fmt::format("is cut off in the middle of an event at byte {}", progress.position);
    } catch (const std::runtime_error& error) {
      progress.is_damaged = true;
      const std::string& damage = reader.report().damage;
      summary.damage = damage.empty() ? as_text(error.what()) : damage;
    }
  } catch (const std::runtime_error& unreadable) {
    summary.damage = as_text(unreadable.what());
  }
  summary.file_bytes = size;
  summary.unread_bytes = size - progress.position;
  return summary.events > events_before;
}

}  // namespace bodyschema
