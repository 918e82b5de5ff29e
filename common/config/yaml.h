#pragma once

#include <Eigen/Core>
#include <filesystem>
#include <limits>
#include <memory>
#include <set>
#include <stdexcept>
#include <string>
#include <vector>

#include "common/geometry/pose.h"

namespace YAML {
class Node;
}

namespace bodyschema {

/// Error in a configuration file: "FILE:LINE: key: what was expected".
class ConfigError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// "; did you mean 'X'?" with the one of `known` nearest to `word`; "" if there is none.
std::string did_you_mean(const std::string& word, const std::set<std::string>& known);

/// A mapping of a strict YAML file: a key that is missing, of the wrong type or out of range is an
/// error, and so is a key that nobody asked for (finish()). Every error is a ConfigError with file,
/// line and key, and names the nearest known key where one is unknown.
///
///   const Yaml yaml = Yaml::load("config/arm7/observer.yaml");
///   config.max_shift_m = yaml.number("max_shift_m", 0, 0.1);
///   for (const Yaml& tag : yaml.list("tags")) ids.push_back(tag.integer("id", 0, 586));
///   yaml.finish();
class Yaml {
 public:
  static Yaml load(const std::filesystem::path& file);
  static Yaml parse(const std::string& text, const std::string& name = "<text>");

  bool has(const std::string& key) const;
  /// All keys, in the file's order, for a mapping whose keys are names of the user's own.
  std::vector<std::string> keys() const;

  double number(const std::string& key, double lowest = std::numeric_limits<double>::lowest(),
                double highest = std::numeric_limits<double>::max()) const;
  std::int64_t integer(const std::string& key,
                       std::int64_t lowest = std::numeric_limits<std::int64_t>::min(),
                       std::int64_t highest = std::numeric_limits<std::int64_t>::max()) const;
  bool boolean(const std::string& key) const;
  std::string text(const std::string& key) const;
  /// One of `choices`.
  std::string choice(const std::string& key, const std::vector<std::string>& choices) const;
  /// A list of numbers; exactly `count` of them unless count < 0.
  std::vector<double> numbers(const std::string& key, int count = -1,
                              double lowest = std::numeric_limits<double>::lowest(),
                              double highest = std::numeric_limits<double>::max()) const;
  std::vector<std::int64_t> integers(const std::string& key) const;
  std::vector<std::string> texts(const std::string& key) const;
  Eigen::Vector3d vector3(const std::string& key) const;
  /// {position_m: [x, y, z], rotation_wxyz: [w, x, y, z]} or {position_m: …, rpy_deg: [r, p, y]}
  /// with R = Rz(y) Ry(p) Rx(r); a missing rotation is the identity. Positions are within 1 km.
  Pose pose(const std::string& key) const;

  Yaml section(const std::string& key) const;
  std::vector<Yaml> list(const std::string& key) const;

  /// @throws ConfigError if this mapping or one below it has a key that nobody asked for.
  void finish() const;

  /// A ConfigError that points at `key` of this mapping.
  ConfigError error(const std::string& key, const std::string& what) const;
  /// The text of the whole file.
  const std::string& file_text() const;
  std::filesystem::path file() const;

 private:
  struct File;
  Yaml(std::shared_ptr<File> file, const YAML::Node& node, std::string path);
  const YAML::Node child(const std::string& key) const;
  Yaml below(const YAML::Node& node, const std::string& name) const;

  std::shared_ptr<File> file_;
  std::shared_ptr<YAML::Node> node_;
  std::string path_;
  struct Usage;
  std::shared_ptr<Usage> usage_;
};

/// The only YAML document of `text`; null if it is empty. `name` stands in errors.
/// @throws ConfigError also where a second document begins, which a reader would pass over.
YAML::Node only_document(const std::string& text, const std::string& name);

// For state files that a process writes and Yaml reads again: `text` in YAML's double quoted style
// (control characters become spaces), and [a, b, …] with exact numbers.
std::string yaml_quoted(const std::string& text);
std::string yaml_list(const std::vector<double>& values);

}  // namespace bodyschema
