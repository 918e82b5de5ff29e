#pragma once

#include <fmt/format.h>

#include <optional>
#include <string>

#include "common/text/pose_text.h"
#include "common/text/text.h"

namespace bodyschema {

/// The words that the user types for a command of this program: "./run WORDS" where the launcher
/// says so (BODYSCHEMA_COMMAND), else "bodyschema WORDS".
std::string to_type(const std::string& words);

/// "{a,b,c}".
template <class Items>
std::string in_braces(const Items& items) {
  return fmt::format("{{{}}}", fmt::join(items, ","));
}

/// A time for people: "95 s", "12 min", "2.5 h".
std::string duration(double seconds);

/// `text` as lines of at most `width` characters, broken between words where there are any; the
/// first begins with `indent` spaces, the others with two more.
std::string wrap(const std::string& text, int width, int indent);

/// Columns of the terminal that a file descriptor is; none if it is no terminal.
std::optional<int> terminal_width(int file);

/// A line that takes the place of the last one on a terminal: cut, because a row that it begins
/// anew could not be erased.
std::string in_place(const std::string& line, int terminal);

}  // namespace bodyschema
