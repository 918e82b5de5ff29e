#include "processes/model_monitor/monitor_memory.h"

#include <stdexcept>

#include "common/bus/event_log.h"
#include "processes/model_monitor/saved_message.h"

namespace bodyschema {
namespace {

std::string text_of(const MonitorMemory& memory) {
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
  return text;
}

}  // namespace

bool MonitorMemory::operator==(const MonitorMemory& other) const {
  return text_of(*this) == text_of(other);
}

std::optional<MonitorMemory> MemoryFile::load(const Objection& objection) {
  if (file_.empty() || !std::filesystem::exists(file_)) return std::nullopt;
  std::string problem;
  try {
    MonitorMemory memory;
    memory.schemas = read_log(file_, kBodySchema);
    const std::vector<model_health_t> health = read_log(file_, kModelHealth);
    if (health.size() != 2) problem = "is not whole";
    for (const body_schema_t& schema : memory.schemas)
      if (problem.empty()) problem = objection(schema);
    if (problem.empty()) {
      memory.at_base = health[0];
      memory.verdicts = health[1];
      saved_ = text_of(memory);
      return memory;
    }
    problem = file_.string() + ": " + problem;
  } catch (const std::runtime_error& error) {
    problem = error.what();
  }
  set_aside(file_, problem);
  return std::nullopt;
}

std::string MemoryFile::save(const MonitorMemory& memory) {
  if (file_.empty()) return "";
  std::string text = text_of(memory);
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
