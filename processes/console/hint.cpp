#include "processes/console/hint.h"

#include <fmt/format.h>
#include <sys/ioctl.h>
#include <unistd.h>

#include <algorithm>
#include <cstdlib>
#include <sstream>

#include "common/bus/check.h"

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
  constexpr int kMost = 40;
  // Of four bytes each at most.
  return fit(as_text(std::string(text.substr(0, 5 * kMost))), kMost + 1);
}

std::string fit(const std::string& text, int width) {
  std::string line;
  int columns = 0;
  for (std::size_t i = 0; i < text.size();) {
    std::size_t size = 1;
    while (i + size < text.size() && (static_cast<unsigned char>(text[i + size]) & 0xC0) == 0x80)
      ++size;
    const auto byte = static_cast<unsigned char>(text[i]);
    // U+0080 … U+009F are control characters too.
    const bool is_control =
        byte < 0x20 || byte == 0x7F ||
        (byte == 0xC2 && size == 2 && static_cast<unsigned char>(text[i + 1]) < 0xA0);
    if (columns == width) {
      while (!line.empty() && (static_cast<unsigned char>(line.back()) & 0xC0) == 0x80)
        line.pop_back();
      if (!line.empty()) line.pop_back();
      return line + "…";
    }
    line += is_control ? " " : text.substr(i, size);
    ++columns;
    i += size;
  }
  return line;
}

std::string wrap(const std::string& text, int width, int indent) {
  const auto columns = [](const std::string& word) {
    return static_cast<int>(std::count_if(word.begin(), word.end(), [](char c) {
      return (static_cast<unsigned char>(c) & 0xC0) != 0x80;
    }));
  };
  std::string result, line(static_cast<std::size_t>(indent), ' ');
  bool is_begun = false;
  std::istringstream words(text);
  for (std::string word; words >> word;) {
    if (is_begun && columns(line) + 1 + columns(word) > width) {
      result += fit(line, width) + "\n";
      line = std::string(static_cast<std::size_t>(indent) + 2, ' ');
      is_begun = false;
    }
    line += (is_begun ? " " : "") + word;
    is_begun = true;
  }
  return result + fit(line, width) + "\n";
}

std::optional<int> terminal_width(int file) {
  winsize size{};
  if (::isatty(file) != 1 || ::ioctl(file, TIOCGWINSZ, &size) != 0 || size.ws_col == 0)
    return std::nullopt;
  return size.ws_col;
}

std::string in_place(const std::string& line, int terminal) {
  return "\r\x1b[2K" + fit(line, terminal_width(terminal).value_or(1000));
}

}  // namespace bodyschema
