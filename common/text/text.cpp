#include "common/text/text.h"

#include <algorithm>
#include <fstream>
#include <sstream>
#include <stdexcept>

namespace bodyschema {
namespace {

/// Length of the UTF-8 character (RFC 3629) that begins at `i`; 0 if none does. A zero byte is
/// none, because the wire ends strings with it. JSON refuses text that is not UTF-8.
std::size_t character_size(std::string_view text, std::size_t i) {
  const auto byte = [&](std::size_t k) {
    return k < text.size() ? static_cast<unsigned char>(text[k]) : 0U;
  };
  const unsigned lead = byte(i);
  if (lead == 0) return 0;
  if (lead < 0x80) return 1;
  const std::size_t size = lead >= 0xC2 && lead <= 0xDF   ? 2
                           : lead >= 0xE0 && lead <= 0xEF ? 3
                           : lead >= 0xF0 && lead <= 0xF4 ? 4
                                                          : 0;
  const unsigned second = byte(i + 1);
  // Overlong forms, surrogates, beyond U+10FFFF.
  if ((lead == 0xE0 && second < 0xA0) || (lead == 0xED && second > 0x9F) ||
      (lead == 0xF0 && second < 0x90) || (lead == 0xF4 && second > 0x8F)) {
    return 0;
  }
  for (std::size_t k = 1; k < size; ++k) {
    if ((byte(i + k) & 0xC0U) != 0x80U) return 0;
  }
  return size;
}

}  // namespace

bool is_text(std::string_view text) {
  for (std::size_t i = 0; i < text.size();) {
    const std::size_t size = character_size(text, i);
    if (size == 0) return false;
    i += size;
  }
  return true;
}

std::string as_text(std::string text) {
  for (std::size_t i = 0; i < text.size();) {
    const std::size_t size = character_size(text, i);
    if (size == 0) text[i] = '?';
    i += std::max<std::size_t>(size, 1);
  }
  return text;
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

std::string read_file(const std::filesystem::path& file) {
  std::ifstream stream(file);
  std::ostringstream text;
  text << stream.rdbuf();
  if (!stream) throw std::runtime_error(file.string() + ": cannot be read");
  return text.str();
}

}  // namespace bodyschema
