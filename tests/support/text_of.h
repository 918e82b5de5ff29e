#pragma once

#include <filesystem>
#include <fstream>
#include <sstream>
#include <string>

namespace bodyschema::test {

/// All bytes of a file; none where there is no such file, or where it cannot be read.
inline std::string text_of(const std::filesystem::path& file) {
  std::ostringstream text;
  text << std::ifstream(file, std::ios::binary).rdbuf();
  return text.str();
}

}  // namespace bodyschema::test
