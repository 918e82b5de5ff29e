#include "common/config/yaml.h"

#include <yaml-cpp/eventhandler.h>
#include <yaml-cpp/yaml.h>

#include <algorithm>
#include <cmath>
#include <fstream>
#include <iomanip>
#include <limits>
#include <sstream>

#include "common/geometry/angle.h"
#include "common/text/text.h"

namespace bodyschema {
namespace {

/// Levenshtein distance, for "did you mean".
std::size_t edit_distance(const std::string& a, const std::string& b) {
  std::vector<std::size_t> row(b.size() + 1);
  for (std::size_t j = 0; j <= b.size(); ++j) row[j] = j;
  for (std::size_t i = 1; i <= a.size(); ++i) {
    std::size_t diagonal = row[0]++;
    for (std::size_t j = 1; j <= b.size(); ++j) {
      const std::size_t substituted = diagonal + (a[i - 1] != b[j - 1]);
      diagonal = row[j];
      row[j] = std::min({row[j] + 1, row[j - 1] + 1, substituted});
    }
  }
  return row[b.size()];
}

bool same_mapping(const YAML::Node& a, const YAML::Node& b) { return a.is(b); }

/// Counted from 1. An empty file's node stands nowhere.
int line_of(const YAML::Node& node) { return std::max(node.Mark().line, 0) + 1; }

/// Position of the newest document.
class DocumentMark : public YAML::EventHandler {
 public:
  int line() const { return line_; }

  void OnDocumentStart(const YAML::Mark& mark) override { line_ = mark.line; }
  void OnDocumentEnd() override {}
  void OnNull(const YAML::Mark&, YAML::anchor_t) override {}
  void OnAlias(const YAML::Mark&, YAML::anchor_t) override {}
  void OnScalar(const YAML::Mark&, const std::string&, YAML::anchor_t,
                const std::string&) override {}
  void OnSequenceStart(const YAML::Mark&, const std::string&, YAML::anchor_t,
                       YAML::EmitterStyle::value) override {}
  void OnSequenceEnd() override {}
  void OnMapStart(const YAML::Mark&, const std::string&, YAML::anchor_t,
                  YAML::EmitterStyle::value) override {}
  void OnMapEnd() override {}

 private:
  int line_ = 0;
};

std::string outside(double value, double lowest, double highest) {
  std::ostringstream text;
  text << value << " is outside " << lowest << " … " << highest;
  return text.str();
}

/// `line` counts from 0.
bool is_indented_by_tab(const std::string& text, int line) {
  std::istringstream stream(text);
  std::string found;
  while (line-- >= 0 && std::getline(stream, found)) {
  }
  const std::size_t first = found.find_first_not_of(" \t");
  return found.find('\t') < first;
}

}  // namespace

std::string did_you_mean(const std::string& word, const std::set<std::string>& known) {
  const auto best = std::min_element(known.begin(), known.end(), [&](const auto& a, const auto& b) {
    return edit_distance(word, a) < edit_distance(word, b);
  });
  if (best == known.end()) return "";
  return "; did you mean '" + *best + "'?";
}

YAML::Node only_document(const std::string& text, const std::string& name) {
  try {
    const YAML::Node document = YAML::Load(text);
    // Not YAML::LoadAll(), which takes some damaged files for endlessly many documents.
    std::istringstream stream(text);
    YAML::Parser parser(stream);
    DocumentMark mark;
    if (parser.HandleNextDocument(mark) && parser.HandleNextDocument(mark)) {
      throw ConfigError(name + ":" + std::to_string(mark.line() + 1) +
                        ": expected one YAML document, found a second one");
    }
    return document;
  } catch (const YAML::Exception& problem) {
    throw ConfigError(name + ":" + std::to_string(problem.mark.line + 1) + ":" +
                      std::to_string(problem.mark.column + 1) + ": " + problem.msg +
                      (is_indented_by_tab(text, problem.mark.line)
                           ? "; the line begins with a tab, YAML wants spaces"
                           : ""));
  }
}

struct Yaml::File {
  std::filesystem::path name;
  std::string text;
};

/// The keys of a mapping that were read, shared by all copies of its Yaml, so that finish() finds
/// those that were not.
struct Yaml::Usage {
  std::set<std::string> asked;
  std::vector<Yaml> below;
};

Yaml::Yaml(std::shared_ptr<File> file, const YAML::Node& node, std::string path)
    : file_(std::move(file)),
      node_(std::make_shared<YAML::Node>(node)),
      path_(std::move(path)),
      usage_(std::make_shared<Usage>()) {
  const auto refuse = [&](const YAML::Node& where, const std::string& what) {
    throw ConfigError(file_->name.string() + ":" + std::to_string(line_of(where)) + ": " +
                      (path_.empty() ? "" : path_ + ": ") + what);
  };
  if (!node.IsMap()) refuse(node, "expected a mapping 'key: value'");
  std::set<std::string> keys;
  for (const auto& entry : node) {
    if (!entry.first.IsScalar()) refuse(entry.first, "expected a key that is a text");
    const auto key = entry.first.as<std::string>();
    if (!keys.insert(key).second) throw error(key, "this key stands twice");
  }
}

Yaml Yaml::load(const std::filesystem::path& file) {
  std::ifstream stream(file);
  if (!stream) throw ConfigError(file.string() + ": cannot be read: no such file or no permission");
  std::stringstream text;
  text << stream.rdbuf();
  if (!stream || stream.bad()) throw ConfigError(file.string() + ": cannot be read");
  return parse(text.str(), file.string());
}

Yaml Yaml::parse(const std::string& text, const std::string& name) {
  auto file = std::make_shared<File>(File{name, text});
  return Yaml(file, only_document(text, name), "");
}

ConfigError Yaml::error(const std::string& key, const std::string& what) const {
  int line = line_of(*node_);
  for (const auto& entry : *node_) {
    if (entry.first.as<std::string>() == key) line = line_of(entry.first);
  }
  const std::string path = path_.empty() ? key : path_ + "." + key;
  return ConfigError(file_->name.string() + ":" + std::to_string(line) + ": " + path + ": " + what);
}

const std::string& Yaml::file_text() const { return file_->text; }
std::filesystem::path Yaml::file() const { return file_->name; }

bool Yaml::has(const std::string& key) const {
  usage_->asked.insert(key);
  return (*node_)[key].IsDefined();
}

std::vector<std::string> Yaml::keys() const {
  std::vector<std::string> keys;
  for (const auto& entry : *node_) keys.push_back(entry.first.as<std::string>());
  return keys;
}

// One that is not const makes the keys that it is asked for.
// NOLINTNEXTLINE(readability-const-return-type)
const YAML::Node Yaml::child(const std::string& key) const {
  if (has(key)) return (*node_)[key];
  // A key that nobody knows yet may be this one misspelt.
  std::set<std::string> others;
  for (const auto& entry : *node_) {
    const auto name = entry.first.as<std::string>();
    if (!usage_->asked.contains(name) && edit_distance(name, key) <= 1 + key.size() / 3) {
      others.insert(name);
    }
  }
  throw error(key, others.empty() ? "this key is missing"
                                  : "this key is missing; is '" + *others.begin() + "' meant?");
}

double Yaml::number(const std::string& key, double lowest, double highest) const {
  double value = 0;
  try {
    value = child(key).as<double>();
  } catch (const YAML::Exception&) {
    const YAML::Node node = child(key);
    const bool has_comma = node.IsScalar() && node.Scalar().find(',') != std::string::npos;
    throw error(
        key, has_comma ? "expected a number, with a point and not a comma" : "expected a number");
  }
  if (!std::isfinite(value)) throw error(key, "expected a finite number");
  if (value < lowest || value > highest) throw error(key, outside(value, lowest, highest));
  return value;
}

std::int64_t Yaml::integer(const std::string& key, std::int64_t lowest,
                           std::int64_t highest) const {
  std::int64_t value = 0;
  try {
    value = child(key).as<std::int64_t>();
  } catch (const YAML::Exception&) {
    throw error(key, "expected an integer");
  }
  if (value < lowest || value > highest) {
    throw error(key, std::to_string(value) + " is outside " + std::to_string(lowest) + " … " +
                         std::to_string(highest));
  }
  return value;
}

bool Yaml::boolean(const std::string& key) const {
  try {
    return child(key).as<bool>();
  } catch (const YAML::Exception&) {
    throw error(key, "expected true or false");
  }
}

std::string Yaml::text(const std::string& key) const {
  const YAML::Node node = child(key);
  if (!node.IsScalar()) throw error(key, "expected a text");
  return node.as<std::string>();
}

std::string Yaml::choice(const std::string& key, const std::vector<std::string>& choices) const {
  const std::string value = text(key);
  if (std::find(choices.begin(), choices.end(), value) != choices.end()) return value;
  throw error(key, "'" + value + "' is none of: " + listed(choices));
}

std::vector<double> Yaml::numbers(const std::string& key, int count, double lowest,
                                  double highest) const {
  std::vector<double> values;
  try {
    values = child(key).as<std::vector<double>>();
  } catch (const YAML::Exception&) {
    throw error(key, "expected a list of numbers");
  }
  if (count >= 0 && values.size() != static_cast<std::size_t>(count)) {
    throw error(key, "expected " + std::to_string(count) + " numbers, found " +
                         std::to_string(values.size()));
  }
  for (const double value : values) {
    if (!std::isfinite(value)) throw error(key, "expected finite numbers");
    if (value < lowest || value > highest) throw error(key, outside(value, lowest, highest));
  }
  return values;
}

std::vector<std::int64_t> Yaml::integers(const std::string& key) const {
  try {
    return child(key).as<std::vector<std::int64_t>>();
  } catch (const YAML::Exception&) {
    throw error(key, "expected a list of integers");
  }
}

std::vector<std::string> Yaml::texts(const std::string& key) const {
  try {
    return child(key).as<std::vector<std::string>>();
  } catch (const YAML::Exception&) {
    throw error(key, "expected a list of texts");
  }
}

Eigen::Vector3d Yaml::vector3(const std::string& key) const {
  return Eigen::Vector3d(numbers(key, 3).data());
}

Pose Yaml::pose(const std::string& key) const {
  const Yaml yaml = section(key);
  const Eigen::Vector3d position(yaml.numbers("position_m", 3, -1000, 1000).data());
  if (yaml.has("rotation_wxyz")) {
    const auto wxyz = yaml.numbers("rotation_wxyz", 4);
    const Eigen::Quaterniond q(wxyz[0], wxyz[1], wxyz[2], wxyz[3]);
    if (std::abs(q.norm() - 1) > 1e-3)
      throw yaml.error("rotation_wxyz", "is not a unit quaternion");
    return make_pose(q, position);
  }
  if (!yaml.has("rpy_deg")) return make_pose(Eigen::Quaterniond::Identity(), position);
  const Eigen::Vector3d rpy =
      Eigen::Vector3d(yaml.numbers("rpy_deg", 3, -3600, 3600).data()) * kDegree;
  using Eigen::AngleAxisd;
  using Eigen::Vector3d;
  return make_pose(AngleAxisd(rpy.z(), Vector3d::UnitZ()) * AngleAxisd(rpy.y(), Vector3d::UnitY()) *
                       AngleAxisd(rpy.x(), Vector3d::UnitX()),
                   position);
}

Yaml Yaml::below(const YAML::Node& node, const std::string& name) const {
  // A second reader of the mapping adds to the same usage.
  for (const Yaml& known : usage_->below) {
    if (same_mapping(*known.node_, node)) return known;
  }
  Yaml below(file_, node, path_.empty() ? name : path_ + "." + name);
  usage_->below.push_back(below);
  return below;
}

Yaml Yaml::section(const std::string& key) const {
  const YAML::Node node = child(key);
  if (!node.IsMap()) throw error(key, "expected a mapping 'key: value'");
  return below(node, key);
}

std::vector<Yaml> Yaml::list(const std::string& key) const {
  const YAML::Node node = child(key);
  if (!node.IsSequence()) throw error(key, "expected a list");
  std::vector<Yaml> items;
  for (std::size_t i = 0; i < node.size(); ++i) {
    items.push_back(below(node[i], key + "[" + std::to_string(i) + "]"));
  }
  return items;
}

void Yaml::finish() const {
  for (const auto& entry : *node_) {
    const auto key = entry.first.as<std::string>();
    if (!usage_->asked.contains(key)) {
      throw error(key, "this key is unknown" + did_you_mean(key, usage_->asked));
    }
  }
  for (const Yaml& below : usage_->below) below.finish();
}

std::string yaml_quoted(const std::string& text) {
  std::string result = "\"";
  for (const char c : text) {
    if (c == '"' || c == '\\') result += '\\';
    result += static_cast<unsigned char>(c) < 0x20 ? ' ' : c;
  }
  return result + '"';
}

std::string yaml_list(const std::vector<double>& values) {
  std::ostringstream result;
  result << std::setprecision(std::numeric_limits<double>::max_digits10) << '[';
  for (std::size_t i = 0; i < values.size(); ++i) result << (i ? ", " : "") << values[i];
  result << ']';
  return result.str();
}

}  // namespace bodyschema
