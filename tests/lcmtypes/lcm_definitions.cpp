#include "tests/lcmtypes/lcm_definitions.h"

#include <cstdint>
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

class Walk {
 public:
  Walk(const std::map<std::string, TypeDefinition>& definitions,
       const std::vector<std::uint8_t>& bytes)
      : definitions_(definitions), bytes_(bytes) {}

  void message(const std::string& type, const std::string& path) {
    std::map<std::string, std::size_t> counts;
    for (const FieldDefinition& field : definitions_.at(type).fields) {
      std::size_t elements = 1;
      for (const std::string& dimension : field.dimensions) {
        const bool is_number = std::isdigit(static_cast<unsigned char>(dimension[0])) != 0;
        elements *= is_number ? std::stoul(dimension) : counts.at(dimension);
      }
      if (field.type == "int32_t" && field.dimensions.empty()) counts[field.name] = read_size();
      for (std::size_t i = 0; i < elements; ++i) element(field.type, path + field.name);
    }
  }

  std::size_t position() const { return position_; }
  void skip(std::size_t size) { position_ += size; }
  const std::vector<FloatPlace>& floats() const { return floats_; }

 private:
  void element(const std::string& type, const std::string& path) {
    static const std::map<std::string, std::size_t> kSizes = {
        {"byte", 1},    {"boolean", 1}, {"int8_t", 1}, {"int16_t", 2},
        {"int32_t", 4}, {"int64_t", 8}, {"float", 4},  {"double", 8}};
    if (type == "string") {
      position_ += 4 + read_size();
    } else if (kSizes.count(type) == 0) {
      message(type, path + ".");
    } else {
      if (type == "float" || type == "double") {
        floats_.push_back({path, position_, kSizes.at(type)});
      }
      position_ += kSizes.at(type);
    }
  }

  std::size_t read_size() const {
    std::size_t size = 0;
    for (std::size_t i = 0; i < 4; ++i) size = (size << 8) | bytes_.at(position_ + i);
    return size;
  }

  const std::map<std::string, TypeDefinition>& definitions_;
  const std::vector<std::uint8_t>& bytes_;
  std::size_t position_ = 0;
  std::vector<FloatPlace> floats_;
};

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

std::vector<FloatPlace> find_floats(const std::map<std::string, TypeDefinition>& definitions,
                                    const std::string& type,
                                    const std::vector<std::uint8_t>& bytes) {
  Walk walk(definitions, bytes);
  walk.skip(8);
  walk.message(type, "");
  if (walk.position() != bytes.size()) {
    throw std::runtime_error(type + ": its definition does not describe its bytes");
  }
  return walk.floats();
}

}  // namespace bodyschema::test
