#include "processes/model_monitor/monitor_memory.h"

#include <sstream>
#include <stdexcept>
#include <utility>

#include "common/bus/event_log.h"
#include "common/bus/saved_message.h"

namespace bodyschema {
namespace {

constexpr char kMarksChannel[] = "SAMPLES_CHECKSUM";

std::string text_of(const MonitorMemory& memory, const std::vector<SampleMark>& marks) {
  std::string text;
  std::int64_t number = 0;
  const auto add = [&](const auto& channel, const auto& message) {
    const auto event =
        encode_event(channel.name, encode(channel, message), message.utime, number++);
    text.append(event.begin(), event.end());
  };
  for (const body_schema_t& schema : memory.schemas) add(kBodySchema, schema);
  add(kModelHealth, memory.at_base);
  add(kModelHealth, memory.verdicts);
  std::string lines;
  for (const SampleMark& mark : marks)
    lines += fmt::format("{} {:08x}\n", mark.sample_index, mark.checksum);
  const auto* bytes = reinterpret_cast<const std::uint8_t*>(lines.data());
  const auto event =
      encode_event(kMarksChannel, {bytes, lines.size()}, memory.verdicts.utime, number);
  return text.append(event.begin(), event.end());
}

std::vector<SampleMark> marks_in(const std::filesystem::path& file) {
  std::vector<SampleMark> marks;
  for_each_event(file, [&](const LogEvent& event) {
    if (event.channel != kMarksChannel) return;
    std::istringstream lines(std::string(event.data.begin(), event.data.end()));
    SampleMark mark;
    while (lines >> std::dec >> mark.sample_index >> std::hex >> mark.checksum)
      marks.push_back(mark);
  });
  return marks;
}

}  // namespace

bool MonitorMemory::operator==(const MonitorMemory& other) const {
  return text_of(*this, {}) == text_of(other, {});
}

std::optional<MonitorMemory> MemoryFile::load(const Objection& objection,
                                              const std::filesystem::path& samples_file) {
  MonitorMemory memory;
  std::vector<SampleMark> marks;
  const bool is_of_use = use_or_set_aside(file_, [&]() -> std::string {
    LogReport report;
    memory.schemas = read_log(file_, kBodySchema, &report);
    const std::vector<model_health_t> health = read_log(file_, kModelHealth);
    // It is replaced as a whole, so no writer tears its tail.
    if (report.truncated_at_byte || health.size() != 2) return "is not whole";
    for (const body_schema_t& schema : memory.schemas)
      if (std::string problem = objection(schema); !problem.empty()) return problem;
    memory.at_base = health[0];
    memory.verdicts = health[1];
    marks = marks_in(file_);
    std::string problem = contradiction(samples_file, memory.verdicts.judged_sample, marks);
    rests_on_other_samples_ = !problem.empty();
    return problem;
  });
  if (!is_of_use) return std::nullopt;
  marks_ = std::move(marks);
  saved_ = text_of(memory, marks_);
  return memory;
}

std::string MemoryFile::save(const MonitorMemory& memory, const std::vector<SampleMark>& marks) {
  if (file_.empty()) return "";
  std::string text = text_of(memory, marks);
  if (text == saved_) return "";
  try {
    write_file_atomically(file_, text);
  } catch (const std::runtime_error& error) {
    return error.what();
  }
  saved_ = std::move(text);
  return "";
}

}  // namespace bodyschema
