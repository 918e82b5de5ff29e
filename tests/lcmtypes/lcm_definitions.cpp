#include "tests/lcmtypes/lcm_definitions.h"

#include <fstream>
#include <regex>
#include <stdexcept>

namespace bodyschema::test {
namespace {

TypeDefinition read_definition(const std::filesystem::path& file) {
  static const std::regex kStruct(R"(struct (\w+) \{)");
  static const std::regex kField(R"( *(\w+) (\w+)((?:\[\w+\])*); *(?://\s*(.*))?)");
  static const std::regex kDimension(R"(\[(\w+)\])");
  TypeDefinition type;
  std::ifstream stream(file);
  int number = 0;
  for (std::string line; std::getline(stream, line);) {
    ++number;
    std::smatch match;
    if (line.empty() || line == "}" || line.rfind("package ", 0) == 0 ||
        line.find("  const ") == 0) {
      continue;
    }
    if (line.rfind("//", 0) == 0) {
      type.comment += line.substr(2);
    } else if (std::regex_match(line, match, kStruct)) {
      type.name = match[1];
    } else if (std::regex_match(line, match, kField)) {
      FieldDefinition field{match[1], match[2], {}, match[4]};
      const std::string dimensions = match[3];
      for (std::sregex_iterator i(dimensions.begin(), dimensions.end(), kDimension), end; i != end;
           ++i) {
        field.dimensions.push_back((*i)[1]);
      }
      type.fields.push_back(field);
    } else {
      throw std::runtime_error(file.string() + ":" + std::to_string(number) +
                               ": not understood: " + line);
    }
  }
  return type;
}

}  // namespace

std::map<std::string, TypeDefinition> read_definitions(const std::filesystem::path& folder) {
  std::map<std::string, TypeDefinition> definitions;
  for (const auto& entry : std::filesystem::directory_iterator(folder)) {
    if (entry.path().extension() != ".lcm") continue;
    TypeDefinition type = read_definition(entry.path());
    if (type.name != entry.path().stem()) {
      throw std::runtime_error(entry.path().string() + ": does not define the type of its name");
    }
    definitions[type.name] = std::move(type);
  }
  return definitions;
}

}  // namespace bodyschema::test
