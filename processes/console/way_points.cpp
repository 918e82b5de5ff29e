#include "processes/console/way_points.h"

#include <fmt/format.h>

#include <algorithm>
#include <charconv>
#include <cmath>
#include <sstream>
#include <string_view>

#include "common/text/text.h"

namespace bodyschema {
namespace {

constexpr double kUnitTolerance = 1e-2;

std::vector<std::string> cells_of(const std::string& line) {
  std::vector<std::string> cells;
  std::istringstream stream(line);
  for (std::string cell; std::getline(stream, cell, ',');) {
    const auto first = cell.find_first_not_of(" \t\r");
    const auto last = cell.find_last_not_of(" \t\r");
    cells.push_back(first == std::string::npos ? "" : cell.substr(first, last - first + 1));
  }
  return cells;
}

double number_in(const std::string& cell, const std::string& where) {
  double value = 0;
  const auto [end, error] = std::from_chars(cell.data(), cell.data() + cell.size(), value);
  if (error != std::errc() || end != cell.data() + cell.size() ||
      !(std::abs(value) <= kFarthestTarget_m))
    throw WayPointError(fmt::format("{}: expected a number within ±{}, found '{}'", where,
                                    kFarthestTarget_m, abbreviated(cell)));
  return value;
}

PoseTarget way_point(const std::vector<std::string>& cells, const std::string& where) {
  std::vector<double> values;
  for (const std::string& cell : cells) values.push_back(number_in(cell, where));
  PoseTarget target{.p_RT = Eigen::Vector3d::Map(values.data())};
  if (values.size() == 3) return target;
  target.q_RT = Eigen::Quaterniond(values[3], values[4], values[5], values[6]);
  if (std::abs(target.q_RT->norm() - 1) > kUnitTolerance)
    throw WayPointError(where + ": qw,qx,qy,qz is no unit quaternion");
  target.q_RT->normalize();
  return target;
}

}  // namespace

std::vector<PoseTarget> parse_way_points(const std::string& text, const std::string& name) {
  constexpr std::string_view kByteOrderMark = "\xEF\xBB\xBF";
  std::istringstream stream(
      text.substr(text.starts_with(kByteOrderMark) ? kByteOrderMark.size() : 0));
  std::vector<PoseTarget> way_points;
  std::size_t num_columns = 0;
  int number = 0;
  for (std::string line; std::getline(stream, line);) {
    ++number;
    const std::string where = fmt::format("{}: line {}", name, number);
    const std::vector<std::string> cells = cells_of(line);
    if (std::ranges::all_of(cells, &std::string::empty)) continue;
    if (num_columns == 0) {
      const std::string header = fmt::format("{}", fmt::join(cells, ","));
      if (header != "x,y,z" && header != "x,y,z,qw,qx,qy,qz")
        throw WayPointError(where + ": expected the header x,y,z or x,y,z,qw,qx,qy,qz, found '" +
                            abbreviated(header) + "'");
      num_columns = cells.size();
      continue;
    }
    if (cells.size() != num_columns)
      throw WayPointError(
          fmt::format("{}: {} numbers, the header has {}", where, cells.size(), num_columns));
    way_points.push_back(way_point(cells, where));
  }
  if (way_points.empty()) throw WayPointError(name + ": no way point");
  return way_points;
}

}  // namespace bodyschema
