#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <set>
#include <utility>

#include "processes/console/names.h"
#include "processes/console/report/report_figures.h"
#include "processes/console/report/template.h"

namespace bodyschema {
namespace {

std::string label(const BodySchema& schema, const Edge& edge) {
  std::string names;
  for (const int signal : edge.signals())
    names += (names.empty() ? "" : ", ") + schema.signals.at(static_cast<std::size_t>(signal)).name;
  return names.empty() ? "rigid" : names;
}

/// How often a signal was in each bin of its range, and each part seen then.
struct Bins {
  std::vector<int> count;
  std::map<int, std::vector<int>> seen;
};

Bins bins_of(std::size_t index, const Signal& signal,
             const std::vector<ActionPoseSample>& samples) {
  Bins bins;
  bins.count.resize(kVisibilityBins);
  const auto i = static_cast<Eigen::Index>(index);
  const double range = signal.upper - signal.lower;
  for (const ActionPoseSample& sample : samples) {
    if (sample.action.size() <= i || !(range > 0)) continue;
    const double share = (sample.action[i] - signal.lower) / range;
    if (!std::isfinite(share)) continue;
    const auto bin =
        static_cast<std::size_t>(std::clamp(share * kVisibilityBins, 0.0, kVisibilityBins - 1.0));
    ++bins.count[bin];
    for (const PartObservation& part : sample.parts) {
      std::vector<int>& seen = bins.seen[part.part];
      seen.resize(kVisibilityBins);
      ++seen[bin];
    }
  }
  return bins;
}

/// Places of the parts of a tree: leaves get rows of their own in order, a part stands beside its
/// first child, and below the root's tree stands what hangs together without reaching it.
class TreeLayout {
 public:
  struct Spot {
    int depth = 0;
    double row = 0;
  };

  explicit TreeLayout(const BodySchema& schema) {
    for (const Edge& edge : schema.edges) children_[edge.from].push_back(&edge);
    if (schema.root >= 0) place(schema.root, 0);
    for (const Edge& edge : schema.edges) {
      if (spots_.contains(edge.from)) continue;
      place(edge.from, 0);
      loose_roots_.insert(edge.from);
    }
    // Columns as wide as the page allows.
    width_ = std::max(760.0, 2 * 30 + 78.0 * deepest_);
    if (deepest_ > 0) column_ = std::min(120.0, (width_ - 60) / static_cast<double>(deepest_));
  }

  const std::map<int, Spot>& spots() const { return spots_; }
  bool is_loose_root(int part) const { return loose_roots_.contains(part); }
  double width() const { return width_; }
  double column() const { return column_; }
  double x(const Spot& spot) const { return 30 + column_ * spot.depth; }
  double y(const Spot& spot) const { return kTop + kRow * spot.row; }
  /// Below all spots.
  double bottom() const { return kTop + next_row_ * kRow; }

 private:
  static constexpr double kRow = 58, kTop = 46;

  /// Returns the row of the part.
  double place(int part, int depth) {
    if (spots_.contains(part)) return spots_[part].row;
    spots_[part] = {depth, next_row_};
    deepest_ = std::max(deepest_, depth);
    const auto below = children_.find(part);
    double row = next_row_;
    if (below == children_.end()) {
      next_row_ += 1;
    } else {
      // The longest branch first, so that the arm is a straight line.
      bool is_first = true;
      for (const Edge* edge : below->second) {
        const double child_row = place(edge->to, depth + 1);
        if (std::exchange(is_first, false)) row = child_row;
      }
    }
    spots_[part].row = row;
    return row;
  }

  std::map<int, std::vector<const Edge*>> children_;
  std::map<int, Spot> spots_;
  std::set<int> loose_roots_;
  double next_row_ = 0;
  int deepest_ = 0;
  double width_ = 0, column_ = 0;
};

constexpr double kRadius = 17;  // of a part in the tree

std::string edge_svg(const BodySchema& schema, const Edge& edge, const TreeLayout& layout) {
  const TreeLayout::Spot& from = layout.spots().at(edge.from);
  const TreeLayout::Spot& to = layout.spots().at(edge.to);
  const double x_from = layout.x(from), y_from = layout.y(from);
  const double x_to = layout.x(to), y_to = layout.y(to);
  const std::string kind = edge.joints.empty() ? "rigid" : "screw";
  const char* state = name_in(kEdgeStateClasses, edge.state);
  std::string svg;
  if (from.row == to.row) {
    svg = fmt::format("<path class=\"{} {}\" d=\"M{:.1f},{:.1f} H{:.1f}\"/>\n", kind, state,
                      x_from + kRadius, y_from, x_to - kRadius);
  } else {
    const double x_bend = x_from + 0.4 * layout.column();
    svg = fmt::format(
        "<path class=\"{} {}\" d=\"M{:.1f},{:.1f} C{:.1f},{:.1f} {:.1f},{:.1f} "
        "{:.1f},{:.1f}\"/>\n",
        kind, state, x_from + kRadius * 0.6, y_from + kRadius * 0.8, x_bend, y_to, x_bend, y_to,
        x_to - kRadius, y_to);
  }
  return svg + fmt::format("<text class=\"signal\" x=\"{:.1f}\" y=\"{:.1f}\">{}</text>\n",
                           x_to - 0.5 * layout.column(), y_to - 7,
                           escape_html(label(schema, edge)));
}

std::string part_svg(const BodySchema& schema, int part, std::optional<int> end_effector,
                     const TreeLayout& layout) {
  const bool is_root = part == schema.root, is_effector = part == end_effector;
  const double x = layout.x(layout.spots().at(part)), y = layout.y(layout.spots().at(part));
  std::string svg = fmt::format(
      "<circle class=\"{}\" cx=\"{:.1f}\" cy=\"{:.1f}\" r=\"{}\"/>"
      "<text class=\"id\" x=\"{:.1f}\" y=\"{:.1f}\">{}</text>\n",
      is_root       ? "root"
      : is_effector ? "effector"
                    : "part",
      x, y, kRadius, x, y + 4.5, part);
  if (!is_root && !is_effector && !layout.is_loose_root(part)) return svg;
  return svg + fmt::format("<text class=\"role\" x=\"{:.1f}\" y=\"{:.1f}\">{}</text>\n", x, y - 24,
                           is_root       ? "root"
                           : is_effector ? "end effector"
                                         : "no way to the root");
}

}  // namespace

std::string tree_svg(const BodySchema& schema, std::optional<int> end_effector) {
  const TreeLayout layout(schema);
  std::vector<const UnconnectedPart*> lone;
  for (const UnconnectedPart& part : schema.unconnected) {
    if (!layout.spots().contains(part.part)) lone.push_back(&part);
  }
  const double height =
      layout.bottom() + (lone.empty() ? -12 : 24.0 * static_cast<double>(lone.size()));
  std::string svg = fmt::format(
      "<svg class=\"tree\" viewBox=\"0 0 {:.0f} {:.0f}\" role=\"img\" aria-label=\"Tree of the "
      "parts\">\n",
      layout.width(), std::max(height, 60.0));
  for (const Edge& edge : schema.edges) svg += edge_svg(schema, edge, layout);
  for (const auto& [part, spot] : layout.spots())
    svg += part_svg(schema, part, end_effector, layout);
  double y = layout.bottom();
  for (const UnconnectedPart* part : lone) {
    svg += fmt::format(
        "<circle class=\"lone\" cx=\"30\" cy=\"{:.1f}\" r=\"10\"/><text class=\"id small\" "
        "x=\"30\" y=\"{:.1f}\">{}</text><text class=\"reason\" x=\"50\" y=\"{:.1f}\">not "
        "connected: {}</text>\n",
        y, y + 3.5, part->part, y + 4, name_in(kUnconnectedReasons, part->reason));
    y += 24;
  }
  return svg + "</svg>\n";
}

std::string visibility_svg(const std::vector<Signal>& signals,
                           const std::vector<ActionPoseSample>& samples,
                           const std::vector<int>& parts) {
  constexpr double kLabel = 52, kRow = 19, kTop = 42, kGap = 10, kWidth = 760;
  if (signals.empty() || parts.empty()) return "";
  const auto num_signals = static_cast<double>(signals.size());
  const double column = (kWidth - kLabel - kGap * (num_signals - 1)) / num_signals;
  const double bin_width = column / kVisibilityBins;
  const double height = kTop + kRow * static_cast<double>(parts.size()) + 4;
  std::string svg = fmt::format(
      "<svg class=\"visibility\" viewBox=\"0 0 {:.0f} {:.0f}\" role=\"img\" "
      "aria-label=\"Visibility "
      "of the parts over the signals\">\n",
      kWidth, height);
  for (std::size_t p = 0; p < parts.size(); ++p) {
    svg += fmt::format("<text class=\"row\" x=\"{:.1f}\" y=\"{:.1f}\">{}</text>\n", kLabel - 10,
                       kTop + kRow * static_cast<double>(p) + 13, parts[p]);
  }
  svg += fmt::format("<text class=\"row\" x=\"{:.1f}\" y=\"{:.1f}\">part</text>\n", kLabel - 10,
                     kTop - 22.0);
  for (std::size_t s = 0; s < signals.size(); ++s) {
    const double left = kLabel + static_cast<double>(s) * (column + kGap);
    svg += fmt::format(
        "<text class=\"head\" x=\"{:.1f}\" y=\"14\">{}</text>"
        "<text class=\"limit\" x=\"{:.1f}\" y=\"32\">{:g}</text>"
        "<text class=\"limit end\" x=\"{:.1f}\" y=\"32\">{:g}</text>\n",
        left + column / 2, escape_html(signals[s].name), left, signals[s].lower, left + column,
        signals[s].upper);
    const auto [count, seen] = bins_of(s, signals[s], samples);
    for (std::size_t p = 0; p < parts.size(); ++p) {
      const double top = kTop + kRow * static_cast<double>(p);
      svg += fmt::format(
          "<rect class=\"strip\" x=\"{:.1f}\" y=\"{:.1f}\" width=\"{:.1f}\" height=\"15\"/>", left,
          top, column);
      const auto of_part = seen.find(parts[p]);
      for (std::size_t b = 0; b < kVisibilityBins; ++b) {
        const double x = left + bin_width * static_cast<double>(b);
        if (count[b] == 0) {
          svg += fmt::format("<path class=\"unknown\" d=\"M{:.1f},{:.1f} l{:.1f},-15\"/>", x,
                             top + 15, bin_width);
          continue;
        }
        const int num_seen = of_part == seen.end() ? 0 : of_part->second[b];
        if (num_seen == 0) continue;
        svg += fmt::format(
            "<rect class=\"seen\" x=\"{:.2f}\" y=\"{:.1f}\" width=\"{:.2f}\" height=\"15\" "
            "fill-opacity=\"{:.2f}\"><title>part {}: seen in {} of {} samples</title></rect>",
            x, top, bin_width, static_cast<double>(num_seen) / count[b], parts[p], num_seen,
            count[b]);
      }
      svg += "\n";
    }
  }
  return svg + "</svg>\n";
}

}  // namespace bodyschema
