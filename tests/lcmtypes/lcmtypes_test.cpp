#include <gtest/gtest.h>

#include <algorithm>
#include <cctype>
#include <cstdint>
#include <filesystem>
#include <fstream>
#include <iomanip>
#include <map>
#include <regex>
#include <set>
#include <sstream>
#include <string>
#include <type_traits>
#include <vector>

#include "bodyschema/message_fields.h"
#include "common/bus/cause_names.h"
#include "common/bus/codec.h"
#include "tests/lcmtypes/example_messages.h"
#include "tests/lcmtypes/lcm_definitions.h"
#include "tests/support/text_of.h"

namespace bodyschema::test {
namespace {

const std::filesystem::path kSources = LCMTYPES_SOURCES;
const std::filesystem::path kHeaders = LCMTYPES_HEADERS;
const std::filesystem::path kFingerprints = FINGERPRINTS_FILE;

/// By type, the parts of messages included.
std::map<std::string, std::string> fingerprints() {
  std::map<std::string, std::string> hashes;
  for_each_type([&](const auto& message) {
    std::ostringstream hash;
    hash << std::hex << std::setfill('0') << std::setw(16)
         << static_cast<std::uint64_t>(message.getHash());
    hashes[message.getTypeName()] = hash.str();
  });
  return hashes;
}

TEST(LcmTypes, EveryMessageSurvivesARoundTripByteForByte) {
  for_each_channel([](const auto& channel, const auto& message) {
    using Message = std::decay_t<decltype(message)>;
    SCOPED_TRACE(channel.name);
    const std::vector<std::uint8_t> bytes = encode(channel, message);
    const Decoded<Message> decoded = decode<Message>(bytes.data(), bytes.size());
    ASSERT_TRUE(decoded.message) << decoded.problem;
    EXPECT_EQ(encode(channel, *decoded.message), bytes);
    EXPECT_EQ(encode(channel, message), bytes);
  });
}

TEST(LcmTypes, ValuesStandOnTheWireBigEndianAndInTheOrderOfTheDefinition) {
  counter_t counter{};
  counter.counter_name = "ab";
  counter.count = 258;
  std::vector<std::uint8_t> bytes(static_cast<std::size_t>(counter.getEncodedSize()));
  ASSERT_EQ(counter.encode(bytes.data(), 0, static_cast<int>(bytes.size())),
            static_cast<int>(bytes.size()));
  const std::vector<std::uint8_t> body(bytes.begin() + 8, bytes.end());
  EXPECT_EQ(body, (std::vector<std::uint8_t>{0, 0, 0, 3, 'a', 'b', 0, 0, 0, 0, 0, 0, 0, 1, 2}));
}

TEST(LcmTypes, AMessageWithABytePutOnOrTakenOffIsMalformed) {
  for_each_channel([](const auto& channel, const auto& message) {
    using Message = std::decay_t<decltype(message)>;
    SCOPED_TRACE(channel.name);
    std::vector<std::uint8_t> bytes = encode(channel, message);
    EXPECT_TRUE(decode<Message>(bytes.data(), bytes.size() - 1).is_malformed);
    bytes.push_back(0);
    EXPECT_TRUE(decode<Message>(bytes.data(), bytes.size()).is_malformed);
  });
}

TEST(LcmTypes, NoTypeTakesTheBytesOfAnother) {
  std::map<std::string, std::vector<std::uint8_t>> bytes_by_type;
  for_each_channel([&](const auto& channel, const auto& message) {
    bytes_by_type[message.getTypeName()] = encode(channel, message);
  });
  for_each_channel([&](const auto&, const auto& message) {
    using Message = std::decay_t<decltype(message)>;
    for (const auto& [type, bytes] : bytes_by_type) {
      if (type == message.getTypeName()) continue;
      const Decoded<Message> decoded = decode<Message>(bytes.data(), bytes.size());
      EXPECT_TRUE(decoded.is_malformed) << type << " as " << message.getTypeName();
      EXPECT_NE(decoded.problem.find("fingerprint"), std::string::npos) << decoded.problem;
    }
  });
}

TEST(LcmDefinitions, EveryTypeAndEveryFieldHasAComment) {
  for (const auto& [name, type] : read_definitions(kSources)) {
    EXPECT_GE(type.comment.size(), 10U) << name << " has no comment";
    for (const FieldDefinition& field : type.fields) {
      EXPECT_FALSE(field.comment.empty()) << name << "." << field.name << " has no comment";
    }
  }
}

TEST(LcmDefinitions, EveryFloatingPointScalarAndEveryTimeNamesItsUnit) {
  // "[1]" or a range for what has no dimension.
  const std::regex unit(R"(\[[^\]]+\]|command units|0\.\.1)");
  for (const auto& [name, type] : read_definitions(kSources)) {
    for (const FieldDefinition& field : type.fields) {
      const bool is_scalar =
          (field.type == "double" || field.type == "float") && field.dimensions.empty();
      const bool is_time = field.name.ends_with("utime");
      if (!is_scalar && !is_time) continue;
      EXPECT_TRUE(std::regex_search(field.comment, unit))
          << name << "." << field.name << " names no unit: " << field.comment;
    }
  }
}

TEST(LcmDefinitions, EveryTypeHasAFieldNameThatNoOtherTypeHas) {
  // Fingerprints cover names of fields but not of types: two equal types would be confused.
  const auto definitions = read_definitions(kSources);
  std::map<std::string, int> uses;
  for (const auto& [name, type] : definitions) {
    for (const FieldDefinition& field : type.fields) ++uses[field.name];
  }
  for (const auto& [name, type] : definitions) {
    bool has_own = false;
    for (const FieldDefinition& field : type.fields) has_own = has_own || uses[field.name] == 1;
    EXPECT_TRUE(has_own) << name;
  }
}

TEST(LcmDefinitions, EveryMessageOfAChannelBeginsWithItsTime) {
  const auto definitions = read_definitions(kSources);
  for_each_channel([&](const auto&, const auto& message) {
    const FieldDefinition& first = definitions.at(message.getTypeName()).fields.front();
    EXPECT_EQ(first.type + " " + first.name, "int64_t utime") << message.getTypeName();
  });
}

TEST(LcmDefinitions, AnArraysCountStandsBeforeIt) {
  for (const auto& [name, type] : read_definitions(kSources)) {
    std::set<std::string> seen;
    for (const FieldDefinition& field : type.fields) {
      for (const std::string& dimension : field.dimensions) {
        if (std::isdigit(static_cast<unsigned char>(dimension[0])) != 0) continue;
        EXPECT_TRUE(dimension.starts_with("num_")) << name << "." << field.name;
        EXPECT_TRUE(seen.contains(dimension)) << name << "." << field.name;
      }
      seen.insert(field.name);
    }
  }
}

TEST(GeneratedHeaders, EveryAllocationIsPrecededByTheHardenedCheck) {
  // Another version of lcm-gen may write code that harden.sed does not recognise.
  int num_resizes = 0;
  int num_strings = 0;
  for (const auto& [name, type] : read_definitions(kSources)) {
    std::istringstream header(text_of(kHeaders / (name + ".hpp")));
    std::string previous;
    for (std::string line; std::getline(header, line); previous = line) {
      if (line.find(".resize(") != std::string::npos) {
        ++num_resizes;
        EXPECT_NE(previous.find("least_wire_size("), std::string::npos) << name << ": " << line;
      }
      if (line.find(".assign(") != std::string::npos) {
        ++num_strings;
        EXPECT_NE(previous.find(" < 1 || __"), std::string::npos) << name << ": " << line;
      }
    }
  }
  EXPECT_GT(num_resizes, 20);
  EXPECT_GT(num_strings, 10);
}

TEST(GeneratedHeaders, DescribeEveryField) {
  const std::string header = text_of(kHeaders / "message_fields.h");
  for (const auto& [name, type] : read_definitions(kSources)) {
    std::size_t at = header.find("Is<" + name + ">");
    const std::size_t end = header.find("}\n\n", at);
    for (const FieldDefinition& field : type.fields) {
      at = header.find("(\"" + field.name + "\", ", at);
      EXPECT_LT(at, end) << name << "." << field.name;
    }
  }
}

TEST(CauseNames, AreTheConstantsInSmallLetters) {
  const std::string definition = text_of(kSources / "health_event_t.lcm");
  const std::regex constant(R"(CAUSE_([A-Z_]+) = (\d+))");
  std::size_t num_constants = 0;
  for (std::sregex_iterator i(definition.begin(), definition.end(), constant), end; i != end; ++i) {
    std::string name = (*i)[1] == "NONE" ? "" : (*i)[1].str();
    std::ranges::transform(name, name.begin(), [](unsigned char c) { return std::tolower(c); });
    EXPECT_EQ(kCauseNames.at(std::stoul((*i)[2])), name);
    ++num_constants;
  }
  EXPECT_EQ(num_constants, kCauseNames.size());
}

TEST(Fingerprints, AreThoseOfTheCheckedInList) {
  std::map<std::string, std::string> listed;
  std::ifstream file(kFingerprints);
  for (std::string line; std::getline(file, line);) {
    if (line.empty() || line[0] == '#') continue;
    std::istringstream words(line);
    std::string name;
    words >> name >> listed[name];
  }
  std::string wanted;
  for (const auto& [name, hash] : fingerprints()) wanted += name + " " + hash + "\n";
  EXPECT_EQ(listed, fingerprints())
      << "A message definition changed, so old logs of it can no longer be read.\n"
         "Before release 1.0: put this into tests/lcmtypes/fingerprints.txt and say so in the "
         "commit.\nAfter it: leave the type as it was and make a new one on a new channel.\n"
      << wanted;
}

TEST(Fingerprints, CoverEveryDefinition) {
  std::set<std::string> defined;
  for (const auto& [name, type] : read_definitions(kSources)) defined.insert(name);
  std::set<std::string> listed;
  for (const auto& [name, hash] : fingerprints()) listed.insert(name);
  EXPECT_EQ(defined, listed);
}

TEST(Channels, AreThoseOfTheTableInTheReadme) {
  const std::regex row(R"(\| `([A-Z0-9_]+)` \| `(\w+)` \|.*)");
  std::map<std::string, std::string> table;
  std::istringstream readme(text_of(kSources / "README.md"));
  for (std::string line; std::getline(readme, line);) {
    std::smatch match;
    if (std::regex_match(line, match, row)) table[match[1]] = match[2];
  }
  std::map<std::string, std::string> code;
  for_each_channel([&](const auto& channel, const auto& message) {
    code[channel.name] = message.getTypeName();
  });
  EXPECT_EQ(code, table);
}

TEST(Channels, OfTheHeaderAreAllTested) {
  const std::string header = text_of(kSources.parent_path() / "common/bus/channels.h");
  const std::regex constant(R"re(Channel<\w+> k\w+\{"([A-Z0-9_]+)"\})re");
  std::set<std::string> declared;
  for (std::sregex_iterator i(header.begin(), header.end(), constant), end; i != end; ++i) {
    declared.insert((*i)[1]);
  }
  std::set<std::string> tested;
  for_each_channel([&](const auto& channel, const auto&) { tested.insert(channel.name); });
  EXPECT_EQ(declared, tested);
}

}  // namespace
}  // namespace bodyschema::test
