#include "processes/console/hint.h"

#include <sys/ioctl.h>
#include <unistd.h>

#include <algorithm>
#include <cstdlib>
#include <sstream>

namespace bodyschema {

std::string to_type(const std::string& words) {
  const char* command = std::getenv("BODYSCHEMA_COMMAND");
  return std::string(command != nullptr && *command != '\0' ? command : "bodyschema") + " " + words;
}

std::string duration(double s) {
  if (s < 100) return fmt::format("{:.0f} s", s);
  if (s < 6000) return fmt::format("{:.0f} min", s / 60);
  return fmt::format("{:.1f} h", s / 3600);
}

std::string wrap(const std::string& text, int width, int indent) {
  const auto columns = [](const std::string& word) {
    return static_cast<int>(std::ranges::count_if(
        word, [](char c) { return (static_cast<unsigned char>(c) & 0xC0) != 0x80; }));
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
