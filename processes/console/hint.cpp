#include "processes/console/hint.h"

#include <fmt/format.h>

#include <cstdlib>

namespace bodyschema {

std::string to_type(const std::string& words) {
  const char* command = std::getenv("BODYSCHEMA_COMMAND");
  return std::string(command != nullptr && *command != '\0' ? command : "bodyschema") + " " + words;
}

std::string counted(std::int64_t count, const std::string& noun) {
  return fmt::format("{} {}{}", count, noun, count == 1 ? "" : "s");
}

std::string duration(double s) {
  if (s < 100) return fmt::format("{:.0f} s", s);
  if (s < 6000) return fmt::format("{:.0f} min", s / 60);
  return fmt::format("{:.1f} h", s / 3600);
}

std::string abbreviated(std::string_view text) {
  constexpr std::size_t kMost = 40;
  if (text.size() <= kMost) return std::string(text);
  std::size_t size = kMost;
  // Not in the middle of a character of UTF-8.
  while (size > 0 && (static_cast<unsigned char>(text[size]) & 0xC0) == 0x80) --size;
  return std::string(text.substr(0, size)) + "…";
}

}  // namespace bodyschema
