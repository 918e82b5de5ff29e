#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <set>

#include "processes/console/hint.h"
#include "processes/console/names.h"
#include "processes/console/report/report_figures.h"
#include "processes/console/report/template.h"
#include "processes/console/views/structure_view.h"

namespace bodyschema {
namespace {

/// `css`: class of the style sheet.
std::string text_svg(const char* css, double x, double y, const std::string& text) {
  return fmt::format("<text class=\"{}\" x=\"{:.1f}\" y=\"{:.1f}\">{}</text>", css, x, y,
                     escape_html(text));
}
std::string circle_svg(const char* css, double x, double y, double radius) {
  return fmt::format("<circle class=\"{}\" cx=\"{:.1f}\" cy=\"{:.1f}\" r=\"{}\"/>", css, x, y,
                     radius);
}
std::string figure_svg(const char* css, double width, double height, const char* label,
                       const std::string& content) {
  return fmt::format(
      "<svg class=\"{}\" viewBox=\"0 0 {:.0f} {:.0f}\" role=\"img\" aria-label=\"{}\">\n{}</svg>\n",
      css, width, height, label, content);
}

/// How often a signal was in each bin of its range, and each part seen then.
struct Bins {
  std::vector<int> count = std::vector<int>(kVisibilityBins);
  std::map<int, std::vector<int>> seen;
};

Bins bins_of(Eigen::Index signal, const Signal& limits,
             const std::vector<ActionPoseSample>& samples) {
  Bins bins;
  for (const ActionPoseSample& sample : samples) {
    if (sample.action.size() <= signal || !(limits.upper > limits.lower)) continue;
    const double share = (sample.action[signal] - limits.lower) / (limits.upper - limits.lower);
    if (!std::isfinite(share)) continue;
    const auto bin =
        static_cast<std::size_t>(std::clamp(share * kVisibilityBins, 0.0, kVisibilityBins - 1.0));
    ++bins.count[bin];
    for (const PartObservation& part : sample.parts) {
      const auto seen = bins.seen.try_emplace(part.part, kVisibilityBins).first;
      ++seen->second[bin];
    }
  }
  return bins;
}

constexpr double kRadius = 17;        // of a part in the tree
constexpr double kLetterWidth = 6.5;  // upper bound of the mean at .signal's 12 px

/// The signals of an edge, as they stand above it.
std::string signals_of(const BodySchema& schema, const Edge& edge) {
  const std::string signals = listed(signal_names(schema, edge.signals()));
  return signals.empty() ? "rigid" : signals;
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
    for (const Edge& edge : schema.edges) children_[edge.from].push_back(edge.to);
    if (schema.root >= 0) place(schema.root, 0);
    for (const Edge& edge : schema.edges) {
      if (spots_.contains(edge.from)) continue;
      place(edge.from, 0);
      loose_roots_.insert(edge.from);
    }
    // Columns as wide as the page allows, or wider for an edge of many signals.
    width_ = std::max(760.0, 2 * 30 + 78.0 * deepest_);
    if (deepest_ > 0) column_ = std::min(120.0, (width_ - 60) / static_cast<double>(deepest_));
    for (const Edge& edge : schema.edges) {
      const auto num_letters = static_cast<double>(signals_of(schema, edge).size());
      column_ = std::max(column_, 2 * kRadius + kLetterWidth * num_letters);
    }
    width_ = std::max(width_, 60 + column_ * deepest_);
  }

  const std::map<int, Spot>& spots() const { return spots_; }
  bool is_loose_root(int part) const { return loose_roots_.contains(part); }
  double width() const { return width_; }
  double column() const { return column_; }
  double x(int part) const { return 30 + column_ * spots_.at(part).depth; }
  double y(int part) const { return kTop + kRow * spots_.at(part).row; }
  /// Below all spots.
  double bottom() const { return kTop + next_row_ * kRow; }

 private:
  static constexpr double kRow = 58, kTop = 46;

  /// Returns the row of the part.
  double place(int part, int depth) {
    const auto [spot, is_new] = spots_.try_emplace(part, Spot{depth, next_row_});
    if (!is_new) return spot->second.row;
    deepest_ = std::max(deepest_, depth);
    // The longest branch first, so that the arm is a straight line.
    std::optional<double> first_row;
    for (const int child : children_[part]) {
      const double row = place(child, depth + 1);
      if (!first_row) first_row = row;
    }
    return spot->second.row = first_row ? *first_row : next_row_++;
  }

  std::map<int, std::vector<int>> children_;
  std::map<int, Spot> spots_;
  std::set<int> loose_roots_;
  double next_row_ = 0;
  int deepest_ = 0;
  double width_ = 0, column_ = 0;
};

std::string edge_svg(const BodySchema& schema, const Edge& edge, const TreeLayout& layout) {
  const double x_from = layout.x(edge.from), y_from = layout.y(edge.from);
  const double x_to = layout.x(edge.to), y_to = layout.y(edge.to);
  const double x_bend = x_from + 0.4 * layout.column();
  const std::string way =
      y_from == y_to
          ? fmt::format("M{:.1f},{:.1f} H{:.1f}", x_from + kRadius, y_from, x_to - kRadius)
          : fmt::format("M{:.1f},{:.1f} C{:.1f},{:.1f} {:.1f},{:.1f} {:.1f},{:.1f}",
                        x_from + kRadius * 0.6, y_from + kRadius * 0.8, x_bend, y_to, x_bend, y_to,
                        x_to - kRadius, y_to);
  return fmt::format("<path class=\"{} {}\" d=\"{}\"/>\n", edge.joints.empty() ? "rigid" : "screw",
                     name_in(kEdgeStateClasses, edge.state), way) +
         text_svg("signal", x_to - 0.5 * layout.column(), y_to - 7, signals_of(schema, edge)) +
         "\n";
}

std::string part_svg(int part, const char* css, const char* role, const TreeLayout& layout) {
  const double x = layout.x(part), y = layout.y(part);
  const std::string svg =
      circle_svg(css, x, y, kRadius) + text_svg("id", x, y + 4.5, std::to_string(part)) + "\n";
  return *role == '\0' ? svg : svg + text_svg("role", x, y - 24, role) + "\n";
}

}  // namespace

std::string tree_svg(const BodySchema& schema, std::optional<int> end_effector) {
  const TreeLayout layout(schema);
  std::string svg;
  for (const Edge& edge : schema.edges) svg += edge_svg(schema, edge, layout);
  for (const auto& [part, spot] : layout.spots())
    svg += part == schema.root          ? part_svg(part, "root", "root", layout)
           : part == end_effector       ? part_svg(part, "effector", "end effector", layout)
           : layout.is_loose_root(part) ? part_svg(part, "part", "no way to the root", layout)
                                        : part_svg(part, "part", "", layout);
  double y = layout.bottom();
  for (const UnconnectedPart& part : schema.unconnected) {
    if (layout.spots().contains(part.part)) continue;
    svg += circle_svg("lone", 30, y, 10) +
           text_svg("id small", 30, y + 3.5, std::to_string(part.part)) +
           text_svg("reason", 50, y + 4,
                    std::string("not connected: ") + name_in(kUnconnectedReasons, part.reason)) +
           "\n";
    y += 24;
  }
  const double height = y > layout.bottom() ? y : y - 12;
  return figure_svg("tree", layout.width(), std::max(height, 60.0), "Tree of the parts", svg);
}

std::string visibility_svg(const std::vector<Signal>& signals,
                           const std::vector<ActionPoseSample>& samples,
                           const std::vector<int>& parts) {
  constexpr double kLabel = 52, kRow = 19, kTop = 42, kGap = 10, kWidth = 760;
  if (signals.empty() || parts.empty()) return "";
  const auto num_signals = static_cast<double>(signals.size());
  const double column = (kWidth - kLabel - kGap * (num_signals - 1)) / num_signals;
  const double bin_width = column / kVisibilityBins;
  std::string svg;
  double top = kTop;
  for (const int part : parts) {
    svg += text_svg("row", kLabel - 10, top + 13, std::to_string(part)) + "\n";
    top += kRow;
  }
  const double height = top + 4;
  svg += text_svg("row", kLabel - 10, kTop - 22, "part") + "\n";
  for (std::size_t s = 0; s < signals.size(); ++s) {
    const double left = kLabel + static_cast<double>(s) * (column + kGap);
    svg += text_svg("head", left + column / 2, 14, signals[s].name) +
           text_svg("limit", left, 32, fmt::format("{:g}", signals[s].lower)) +
           text_svg("limit end", left + column, 32, fmt::format("{:g}", signals[s].upper)) + "\n";
    Bins bins = bins_of(static_cast<Eigen::Index>(s), signals[s], samples);
    top = kTop;
    for (const int part : parts) {
      svg += fmt::format(
          "<rect class=\"strip\" x=\"{:.1f}\" y=\"{:.1f}\" width=\"{:.1f}\" height=\"15\"/>", left,
          top, column);
      const std::vector<int>& seen = bins.seen.try_emplace(part, kVisibilityBins).first->second;
      for (std::size_t b = 0; b < kVisibilityBins; ++b) {
        const double x = left + bin_width * static_cast<double>(b);
        const int count = bins.count[b];
        if (count == 0)
          svg += fmt::format("<path class=\"unknown\" d=\"M{:.1f},{:.1f} l{:.1f},-15\"/>", x,
                             top + 15, bin_width);
        else if (seen[b] > 0)
          svg += fmt::format(
              "<rect class=\"seen\" x=\"{:.2f}\" y=\"{:.1f}\" width=\"{:.2f}\" height=\"15\" "
              "fill-opacity=\"{:.2f}\"><title>part {}: seen in {} of {} samples</title></rect>",
              x, top, bin_width, static_cast<double>(seen[b]) / count, part, seen[b], count);
      }
      svg += "\n";
      top += kRow;
    }
  }
  return figure_svg("visibility", kWidth, height, "Visibility of the parts over the signals", svg);
}

}  // namespace bodyschema
