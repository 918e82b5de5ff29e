#pragma once

#include <fmt/format.h>

#include <cstdint>
#include <optional>
#include <string>
#include <string_view>

#include "common/geometry/angle.h"

namespace bodyschema {

/// The words that the user types for a command of this program: "./run WORDS" where the launcher
/// says so (BODYSCHEMA_COMMAND), else "bodyschema WORDS".
std::string to_type(const std::string& words);

/// "1 sample", "2 samples".
std::string counted(std::int64_t count, const std::string& noun);

/// The texts of `text_of` each item, "a, b, c".
template <class Items, class TextOf>
std::string listed(const Items& items, TextOf text_of, std::string_view separator = ", ") {
  std::string text;
  for (const auto& item : items) {
    if (!text.empty()) text += separator;
    text += text_of(item);
  }
  return text;
}
template <class Items>
std::string listed(const Items& items) {
  return fmt::format("{}", fmt::join(items, ", "));
}
/// "{a,b,c}".
template <class Items>
std::string in_braces(const Items& items) {
  return fmt::format("{{{}}}", fmt::join(items, ","));
}

/// "3.21 mm 0.41°".
inline std::string pose_text(double position_m, double rotation_rad, int decimals_mm = 2) {
  return fmt::format("{:.{}f} mm {:.2f}°", position_m * 1e3, decimals_mm, rotation_rad / kDegree);
}

/// A time for people: "95 s", "12 min", "2.5 h".
std::string duration(double seconds);

/// `text` for an error: fit() for 41 characters, with "?" for what is not UTF-8.
std::string abbreviated(std::string_view text);

/// `text` as lines of at most `width` characters, broken between words where there are any; the
/// first begins with `indent` spaces, the others with two more.
std::string wrap(const std::string& text, int width, int indent);

/// `text` as one line of at most `width` characters: longer ones end in "…", control characters
/// (a terminal would obey them) become spaces.
std::string fit(const std::string& text, int width);

/// Columns of the terminal that a file descriptor is; none if it is no terminal.
std::optional<int> terminal_width(int file);

/// A line that takes the place of the last one on a terminal: cut, because a row that it begins
/// anew could not be erased.
std::string in_place(const std::string& line, int terminal);

}  // namespace bodyschema
