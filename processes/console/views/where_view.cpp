#include "processes/console/views/where_view.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <stdexcept>

#include "processes/controller/reachable_box.h"

namespace bodyschema {
namespace {

// Signals that move one of the parts, with how far each is from the nearer end of its range.
struct Distance {
  int signal = 0;
  double value = 0, to_limit = 0;  // command units
};

std::vector<Distance> distances(const BodySchema& schema, const Whereabouts& where) {
  std::set<int> moving;
  for (const Whereabouts::Part& p : where.parts) moving.merge(moving_signals(schema, p.part));
  std::vector<Distance> result;
  for (const int s : moving) {
    const Signal& signal = schema.signals[static_cast<std::size_t>(s)];
    const double value = (*where.action)(s);
    result.push_back({s, value, std::min(value - signal.lower, signal.upper - value)});
  }
  return result;
}

Json vector_json(const Eigen::Vector3d& p) { return {p.x(), p.y(), p.z()}; }

// Never "-0.000".
double to_mm(double metres) { return std::round(1e3 * metres) / 1e3 + 0.0; }

std::string interval(double lower, double upper) {
  return fmt::format("{:6.3f} … {:6.3f}", to_mm(lower), to_mm(upper));
}

}  // namespace

Whereabouts whereabouts_of(const BodySchema& schema, std::optional<int> part,
                           const std::optional<Eigen::VectorXd>& action) {
  Whereabouts where;
  where.action = action;
  std::vector<PartPrediction> now;
  if (action) now = predict_parts(schema, *action);
  for (const int candidate : schema.parts) {
    if (part && candidate != *part) continue;
    const Eigen::AlignedBox3d box = reachable_box(schema, candidate);
    if (candidate == schema.root || box.isEmpty()) continue;
    Whereabouts::Part& p = where.parts.emplace_back();
    p.part = candidate;
    p.reachable = box;
    const auto predicted =
        std::ranges::find_if(now, [&](const PartPrediction& n) { return n.part == candidate; });
    if (predicted != now.end()) p.now = *predicted;
  }
  if (part && where.parts.empty()) throw std::invalid_argument(no_way_text(schema, *part));
  return where;
}

Json where_json(const BodySchema& schema, const Whereabouts& where) {
  Json json = {
      {"root", schema.root},
      {"parts", array_of(where.parts,
                         [&](const Whereabouts::Part& p) {
                           Json part = p.now ? part_json(schema, *p.now) : Json{{"part", p.part}};
                           part["lowest_m"] = vector_json(p.reachable.min());
                           part["highest_m"] = vector_json(p.reachable.max());
                           return part;
                         })},
      {"signals", Json()}};
  if (!where.action) return json;
  json["signals"] = array_of(distances(schema, where), [&](const Distance& d) {
    const Signal& signal = schema.signals[static_cast<std::size_t>(d.signal)];
    return Json{{"name", signal.name},
                {"value", d.value},
                {"lower", signal.lower},
                {"upper", signal.upper},
                {"to_limit", d.to_limit}};
  });
  return json;
}

std::string where_text(const BodySchema& schema, const Whereabouts& where) {
  const auto row = [&](const std::string& part, const std::string& now,
                       const std::array<std::string, 3>& box) {
    return fmt::format("  {:<5}", part) + (where.action ? fmt::format("{:<36}", now) : "") +
           fmt::format("{:<18}{:<18}{}\n", box[0], box[1], box[2]);
  };
  std::string text = fmt::format(
      "By the schema, in the frame of part {} [m]: {}the box that holds all\n"
      "positions of a part; not every point of it can be reached.\n",
      schema.root, where.action ? "where parts are, ± per axis, and " : "");
  text +=
      row("part", fmt::format("{:>7} {:>7} {:>7}  {:>8}", "x", "y", "z", "± mm"), {"x", "y", "z"});
  for (const Whereabouts::Part& p : where.parts) {
    std::string now;
    if (p.now) {
      const Eigen::Vector3d at = p.now->X_RB.translation();
      now = fmt::format("{:7.3f} {:7.3f} {:7.3f}", to_mm(at.x()), to_mm(at.y()), to_mm(at.z()));
      if (p.now->sd.position_m > 0) now += fmt::format("  {:8.2f}", 1e3 * p.now->sd.position_m);
    }
    std::array<std::string, 3> box;
    for (int axis = 0; axis < 3; ++axis)
      box[axis] = interval(p.reachable.min()(axis), p.reachable.max()(axis));
    text += row(std::to_string(p.part), now, box);
  }
  if (!where.action) return text;
  text += fmt::format("  {:<12} {:>10}   {:<20} {}\n", "signal", "now", "range", "to its limit");
  for (const Distance& d : distances(schema, where)) {
    const Signal& signal = schema.signals[static_cast<std::size_t>(d.signal)];
    text += fmt::format("  {:<12} {:>10.4g}   {:<20} {:.4g}, {:.0f} % of the range\n", signal.name,
                        d.value, fmt::format("{:.4g} … {:.4g}", signal.lower, signal.upper),
                        d.to_limit, 100 * d.to_limit / (signal.upper - signal.lower));
  }
  return text;
}

}  // namespace bodyschema
