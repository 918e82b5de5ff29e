#include "processes/console/way_points.h"

#include <fmt/format.h>

#include <algorithm>
#include <charconv>
#include <cmath>
#include <sstream>

#include "common/text/text.h"

namespace bodyschema {
namespace {

constexpr double kFarthest_m = 1000;  // what POSE_TARGET carries
constexpr double kUnitTolerance = 1e-2;
constexpr double kTurn_rad = 0.1;
constexpr std::size_t kMostSteps = 1'000'000;

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
  if (error != std::errc() || end != cell.data() + cell.size() || !(std::abs(value) <= kFarthest_m))
    throw WayPointError(fmt::format("{}: expected a number within ±{}, found '{}'", where,
                                    kFarthest_m, abbreviated(cell)));
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
  std::istringstream stream(text);
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

std::vector<PoseTarget> straight_line(const PoseTarget& from, const PoseTarget& to, double step_m) {
  double num_steps = std::ceil((to.p_RT - from.p_RT).norm() / step_m);
  if (to.q_RT)
    num_steps = std::max(num_steps, std::ceil(from.q_RT->angularDistance(*to.q_RT) / kTurn_rad));
  const auto n = std::clamp<std::size_t>(static_cast<std::size_t>(num_steps), 1, kMostSteps);
  std::vector<PoseTarget> line;
  for (std::size_t i = 1; i <= n; ++i) {
    const double share = static_cast<double>(i) / static_cast<double>(n);
    PoseTarget step{.p_RT = from.p_RT + share * (to.p_RT - from.p_RT)};
    if (to.q_RT) step.q_RT = from.q_RT->slerp(share, *to.q_RT);
    line.push_back(step);
  }
  return line;
}

double leaves_line_by_m(const BodySchema& schema, int part, const Eigen::VectorXd& from,
                        const Eigen::VectorXd& to, const Eigen::Vector3d& end) {
  const auto position_at = [&](double share) -> Eigen::Vector3d {
    return schema.predict(schema.root, part, from + share * (to - from))->X_AB.translation();
  };
  const Eigen::Vector3d begin = position_at(0), along = end - begin;
  double farthest = 0;
  for (const double share : {0.25, 0.5, 0.75}) {
    const Eigen::Vector3d off = position_at(share) - begin;
    const double done = std::clamp(off.dot(along) / std::max(along.squaredNorm(), 1e-12), 0.0, 1.0);
    farthest = std::max(farthest, (off - done * along).norm());
  }
  return farthest;
}

}  // namespace bodyschema
