#include <fmt/format.h>

#include <algorithm>
#include <cctype>
#include <charconv>
#include <cmath>
#include <map>
#include <optional>
#include <set>
#include <string_view>
#include <utility>

#include "common/geometry/angle.h"
#include "common/text/text.h"
#include "processes/structure_learner/recording/recording.h"
#include "processes/structure_learner/told_noise.h"

namespace bodyschema {
namespace {

/// Of the norm: numbers with two decimals are off by 0.01. It is normalized.
constexpr double kUnitTolerance = 0.02;
/// Largest number of any column. Squares, sums and microseconds of what is larger would overflow.
constexpr double kLargest = 1e12;
const std::vector<std::string> kPoseColumns = {"x", "y", "z", "qw", "qx", "qy", "qz"};

/// One line of a CSV file, cut into fields, that can point at each of them.
class Row {
 public:
  Row(std::string_view line, std::size_t number, const std::string& file)
      : number_(number), file_(file) {
    std::size_t begin = 0;
    for (;;) {
      const std::size_t comma = line.find(',', begin);
      std::string_view field = line.substr(begin, comma - begin);
      while (!field.empty() && field.front() == ' ') field.remove_prefix(1), ++begin;
      while (!field.empty() && (field.back() == ' ' || field.back() == '\r'))
        field.remove_suffix(1);
      fields_.push_back(field);
      columns_.push_back(begin + 1);
      if (comma == std::string_view::npos) break;
      begin = comma + 1;
    }
  }

  std::size_t size() const { return fields_.size(); }
  std::string_view operator[](std::size_t i) const { return fields_[i]; }

  RecordingError error(std::size_t i, std::string expected, bool tells_field = false) const {
    if (tells_field) expected += ", found '" + abbreviated(fields_[i]) + "'";
    const std::size_t column = i < columns_.size() ? columns_[i] : columns_.back();
    return RecordingError(fmt::format("{}:{}:{}: {}", file_, number_, column, expected));
  }

  double number(std::size_t i, const std::string& name,
                const std::string& what = "a number") const {
    const auto value = parsed<double>(i);
    if (!value || !std::isfinite(*value)) throw error(i, name + ": expected a finite number", true);
    if (std::abs(*value) > kLargest)
      throw error(i, name + ": expected " + what + " within ±1e12", true);
    return *value;
  }

  int integer(std::size_t i, const std::string& name) const {
    const auto value = parsed<int>(i);
    if (!value || *value < 0) throw error(i, name + ": expected a whole number from 0", true);
    return *value;
  }

 private:
  template <class Value>
  std::optional<Value> parsed(std::size_t i) const {
    Value value{};
    const char *begin = fields_[i].data(), *end = begin + fields_[i].size();
    const auto [stop, problem] = std::from_chars(begin, end, value);
    return problem == std::errc() && stop == end ? std::optional(value) : std::nullopt;
  }

  std::size_t number_;
  const std::string& file_;
  std::vector<std::string_view> fields_;
  std::vector<std::size_t> columns_;
};

/// The columns of a CSV recording.
struct Header {
  std::vector<std::string> signals;
  std::size_t part = 0;  ///< column of `part`; the pose follows it
  bool has_noise = false;

  std::size_t size() const { return part + 1 + kPoseColumns.size() + (has_noise ? 2 : 0); }
};

/// "" or what another separator than ',' the fields of a line seem to have.
std::string separator_hint(std::string_view line) {
  for (const auto& [separator, name] :
       {std::pair{';', "';'"}, std::pair{'\t', "tabs"}, std::pair{' ', "blanks"}}) {
    if (std::count(line.begin(), line.end(), separator) >= 7)
      return std::string("; fields look separated by ") + name + ", expected ','";
  }
  return "";
}

/// "" or that numbers of a line look like 0,125: commas between digits, nowhere a point.
std::string decimal_comma_hint(std::string_view line) {
  const auto is_digit = [&](std::size_t i) {
    return i < line.size() && std::isdigit(static_cast<unsigned char>(line[i])) != 0;
  };
  int num_between_digits = 0;
  bool has_fraction = false;
  for (std::size_t i = 1; i < line.size(); ++i) {
    if (line[i] != ',' || !is_digit(i - 1) || !is_digit(i + 1)) continue;
    ++num_between_digits;
    has_fraction |= is_digit(i + 2);
  }
  const bool is_likely =
      num_between_digits > 2 && has_fraction && line.find('.') == std::string_view::npos;
  return is_likely ? "; numbers look as if they had decimal commas, expected points" : "";
}

Header parse_header(const Row& row, const std::string& hint) {
  Header header;
  if (row[0] != "t")
    throw row.error(
        0, fmt::format("expected the header t,q1,...,qm,part,x,y,z,qw,qx,qy,qz[,sp_m,sr_deg], "
                       "found '{}'{}",
                       abbreviated(row[0]), hint));
  std::size_t i = 1;
  std::set<std::string> names;
  for (; i < row.size() && row[i] != "part"; ++i) {
    if (row[i].empty()) throw row.error(i, "expected the name of an action signal");
    if (as_text(std::string(row[i])) != row[i])
      throw row.error(i, "expected the name of an action signal in UTF-8");
    if (!names.insert(std::string(row[i])).second)
      throw row.error(i, fmt::format("the name '{}' stands twice", row[i]));
    header.signals.emplace_back(row[i]);
  }
  if (i == row.size()) throw row.error(i, "expected a column 'part' after the action signals");
  header.part = i++;
  for (const std::string& name : kPoseColumns) {
    if (i == row.size() || row[i] != name) {
      std::string what = "expected the column '" + name + "'";
      if (i < row.size() && name == "qw" && row[i] == "qx")
        what += "; quaternions are w x y z: put qw first";
      else if (name == "qw")
        what += "; rotations are unit quaternions";
      if (i < row.size() && row[i].find("mm") != std::string_view::npos)
        what += "; positions are in metres";
      throw row.error(i, what);
    }
    ++i;
  }
  if (i < row.size()) {
    for (const char* name : {"sp_m", "sr_deg"}) {
      if (i == row.size() || row[i] != name)
        throw row.error(i, fmt::format("expected the column '{}' or nothing", name));
      ++i;
    }
    header.has_noise = true;
    if (i < row.size()) throw row.error(i, "expected no further column");
  }
  return header;
}

PartObservation parse_observation(const Row& row, const Header& header) {
  PartObservation observation;
  std::size_t i = header.part;
  observation.part = row.integer(i++, "part");
  const auto begin = header.part + 4, end = header.part + 8;  // of the quaternion
  std::size_t num_empty = 0;
  for (std::size_t k = begin; k < end; ++k) num_empty += row[k].empty();
  observation.has_rotation = num_empty < end - begin;
  double pose[7] = {0, 0, 0, 1, 0, 0, 0};
  for (std::size_t k = 0; k < (observation.has_rotation ? 7 : 3); ++k)
    pose[k] = row.number(i++, kPoseColumns[k]);
  i = end;
  const Eigen::Quaterniond q(pose[3], pose[4], pose[5], pose[6]);
  if (std::abs(q.norm() - 1) > kUnitTolerance)
    throw row.error(
        header.part + 4,
        fmt::format("qw,qx,qy,qz: expected a unit quaternion, found norm {:f}", q.norm()));
  observation.X_CB = make_pose(q, {pose[0], pose[1], pose[2]});
  if (header.has_noise) {
    Noise noise;
    noise.position_m = row.number(i, "sp_m");
    if (noise.position_m <= 0) throw row.error(i, "sp_m: expected a standard deviation above 0");
    if (observation.has_rotation) {
      noise.rotation_rad = row.number(++i, "sr_deg") * kDegree;
      if (noise.rotation_rad <= 0)
        throw row.error(i, "sr_deg: expected a standard deviation above 0");
    }
    observation.covariance = isotropic(noise);
  }
  return observation;
}

/// The sample of an instant and its first line. Rows may come part by part as well as
/// instant by instant.
struct Instant {
  std::size_t sample = 0, line = 0;
};
using Instants = std::map<double, Instant>;  ///< by t

bool is_same(const PartObservation& a, const PartObservation& b) {
  return a.has_rotation == b.has_rotation && a.X_CB.matrix() == b.X_CB.matrix();
}

void add_row(const Row& row, std::size_t number, const Header& header, Instants& instants,
             Recording& recording) {
  const double t = row.number(0, "t", "seconds");
  Eigen::VectorXd action(header.signals.size());
  for (std::size_t i = 0; i < header.signals.size(); ++i) {
    action[i] = row.number(i + 1, header.signals[i]);
  }
  PartObservation observation = parse_observation(row, header);
  const auto [known, is_new] = instants.try_emplace(t, recording.samples.size(), number);
  const Instant& instant = known->second;
  if (is_new) {
    ActionPoseSample sample;
    sample.utime = std::llround(t * 1e6);
    sample.sample_index = static_cast<std::int64_t>(recording.samples.size());
    sample.action = action;
    recording.samples.push_back(std::move(sample));
  }
  const Eigen::VectorXd& first = recording.samples[instant.sample].action;
  for (std::size_t i = 0; i < header.signals.size(); ++i) {
    if (action[i] == first[i]) continue;
    throw row.error(i + 1, fmt::format("{}: expected the value of line {}, which has the same t: "
                                       "one instant has one action",
                                       header.signals[i], instant.line));
  }
  auto& parts = recording.samples[instant.sample].parts;
  if (const PartObservation* known_part =
          recording.samples[instant.sample].find(observation.part)) {
    if (is_same(*known_part, observation)) return;  // a row written twice
    throw row.error(header.part,
                    fmt::format("part {} stands twice at this instant", observation.part));
  }
  parts.push_back(std::move(observation));
}

}  // namespace

Recording parse_csv(const std::string& text, const std::string& name) {
  Recording recording;
  std::optional<Header> header;
  std::string_view rest = text;
  if (rest.starts_with("\xEF\xBB\xBF")) rest.remove_prefix(3);  // a byte order mark
  Instants instants;
  for (std::size_t number = 1; !rest.empty(); ++number) {
    const std::size_t end = rest.find('\n');
    const std::string_view line = rest.substr(0, end);
    rest = end == std::string_view::npos ? std::string_view() : rest.substr(end + 1);
    if (line.find_first_not_of(" \r") == std::string_view::npos) continue;
    const Row row(line, number, name);
    if (!header) {
      std::string hint = separator_hint(line);
      if (!hint.empty()) hint += decimal_comma_hint(rest.substr(0, rest.find('\n')));
      header = parse_header(row, hint);
      for (const std::string& signal : header->signals)
        recording.signals.push_back({.name = signal});
      recording.has_noise = header->has_noise;
      continue;
    }
    // At the first field too many, or at the last one there is.
    if (row.size() != header->size())
      throw row.error(header->size(),
                      fmt::format("expected {} fields, found {}{}{}", header->size(), row.size(),
                                  separator_hint(line),
                                  row.size() > header->size() ? decimal_comma_hint(line) : ""));
    add_row(row, number, *header, instants, recording);
  }
  if (!header) throw RecordingError(name + ":1:1: expected a header line, found an empty file");
  if (recording.samples.empty()) throw RecordingError(name + ":2:1: expected at least one row");
  // Whatever the order of the rows: by t, and by part.
  std::vector<ActionPoseSample> ascending;
  for (const auto& [t, instant] : instants) {
    ActionPoseSample& sample = ascending.emplace_back(std::move(recording.samples[instant.sample]));
    sample.sample_index = std::ssize(ascending) - 1;
    std::sort(sample.parts.begin(), sample.parts.end(),
              [](const auto& a, const auto& b) { return a.part < b.part; });
  }
  recording.samples = std::move(ascending);
  const std::vector<Signal> observed = observed_signals(recording.samples);
  for (std::size_t i = 0; i < observed.size(); ++i) {
    recording.signals[i].lower = observed[i].lower;
    recording.signals[i].upper = observed[i].upper;
  }
  recording.measurement.fixed_parts = fixed_parts(recording.samples);
  recording.hints = hints_of(recording);
  add_mixture_hint(recording);
  return recording;
}

}  // namespace bodyschema
