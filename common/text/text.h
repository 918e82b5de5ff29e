#pragma once

#include <cstdint>
#include <filesystem>
#include <string>
#include <string_view>

namespace bodyschema {

// Texts from outside, which may hold any bytes.

/// Whether it is UTF-8 without a zero byte, which the wire and JSON demand.
bool is_text(std::string_view text);

/// `text` with every byte that is no UTF-8, or zero, replaced by '?'. For texts from outside:
/// files, host names, a camera's error messages.
std::string as_text(std::string text);

/// `text` as one line of at most `width` characters: longer ones end in "…", control characters
/// (a terminal would obey them) become spaces.
std::string fit(const std::string& text, int width);

/// `text` for an error: fit() for 41 characters, with "?" for what is not UTF-8.
std::string abbreviated(std::string_view text);

/// The bytes of a file. @throws std::runtime_error if it cannot be read.
std::string read_file(const std::filesystem::path& file);

// Texts for people.

/// "1 sample", "2 samples".
inline std::string counted(std::int64_t count, const std::string& noun) {
  return std::to_string(count) + " " + noun + (count == 1 ? "" : "s");
}

/// The texts of `text_of` each item, "a, b, c".
template <class Items, class TextOf>
std::string listed(const Items& items, TextOf text_of) {
  std::string text;
  for (const auto& item : items) text += (text.empty() ? "" : ", ") + std::string(text_of(item));
  return text;
}
template <class Items>
std::string listed(const Items& items) {
  return listed(items, [](const std::string& item) { return item; });
}

}  // namespace bodyschema
