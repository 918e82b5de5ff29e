#pragma once

#include <filesystem>
#include <map>
#include <string>
#include <vector>

namespace bodyschema::test {

/// One field of an .lcm file.
struct FieldDefinition {
  std::string type;
  std::string name;
  /// Sizes of an array: a number or the name of the field that counts.
  std::vector<std::string> dimensions;
  std::string comment;
};

struct TypeDefinition {
  std::string name;
  std::string comment;
  std::vector<FieldDefinition> fields;
};

/// Reads every .lcm file of a folder, by type. Supports the part of the language that our files
/// use: one struct a file, one field a line, comments with //.
/// @throws std::runtime_error naming file and line of anything else.
std::map<std::string, TypeDefinition> read_definitions(const std::filesystem::path& folder);

}  // namespace bodyschema::test
