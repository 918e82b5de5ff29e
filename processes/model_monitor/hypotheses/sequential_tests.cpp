#include "processes/model_monitor/hypotheses/sequential_tests.h"

#include <algorithm>
#include <cmath>
#include <functional>
#include <iterator>
#include <utility>

namespace bodyschema {
namespace {

/// Squared distance of every marker below which a sample cannot raise a CUSUM that is at zero.
constexpr double kClear = 14;
constexpr double kInflations[] = {3, 10};
constexpr double kLargestRatio = 600;  // e to it is finite
constexpr std::size_t kMostSuspects = 4;

}  // namespace

double alarm_threshold(int num_nodes, double false_alarm_rate) {
  return std::log(2.0 * num_nodes / false_alarm_rate);
}

SequentialTests::SequentialTests(const TreeFilter& filter, double false_alarm_rate, double loudest)
    : alarm_(alarm_threshold(filter.num_nodes(), false_alarm_rate)),
      loudest_(loudest),
      edges_(static_cast<std::size_t>(filter.num_nodes())),
      markers_(edges_) {}

TreeFilter::Judgement SequentialTests::update(const TreeFilter& filter,
                                              const TreeFilter::Instant& instant,
                                              std::int64_t sample_index) {
  const TreeFilter::Judgement now = filter.judge(instant);
  const auto is_zero = [](const Cusum& c) { return c.value == 0; };
  const bool is_clear =
      std::ranges::all_of(now.squared_distance, [](double d2) { return d2 < kClear; });
  if (is_clear && std::ranges::all_of(edges_, is_zero) && std::ranges::all_of(markers_, is_zero))
    return now;
  const auto ratio = [&](const Alternative& alternative) {
    return filter.judge(instant, alternative).log_likelihood - now.log_likelihood;
  };
  const auto add = [&](Cusum* cusum, double log_ratio) {
    if (cusum->value == 0) cusum->since = sample_index;
    cusum->value = std::max(0.0, std::min(cusum->value, ceiling()) + log_ratio);
  };
  for (int node = 0; node < filter.num_nodes(); ++node) {
    const auto n = static_cast<std::size_t>(node);
    double wrong = 0;
    for (const double inflation : kInflations)
      wrong +=
          std::exp(std::min(ratio({.inflated_edge = node, .inflation = inflation}), kLargestRatio));
    wrong += std::exp(std::min(ratio({.cut_edges = {node}}), kLargestRatio));
    add(&edges_[n], std::min(std::log(wrong / (std::size(kInflations) + 1)), loudest_));
    if (instant.seen[n]) add(&markers_[n], ratio({.detached_node = node}));
  }
  return now;
}

void SequentialTests::clear(int node) {
  edges_[static_cast<std::size_t>(node)] = markers_[static_cast<std::size_t>(node)] = {};
}

SequentialTests::Highest SequentialTests::highest() const {
  Highest result;
  for (std::size_t n = 0; n < edges_.size(); ++n)
    for (const Cusum* cusum : {&edges_[n], &markers_[n]}) {
      result.second = std::max(result.second, std::min(cusum->value, result.cusum.value));
      if (cusum->value > result.cusum.value) result.cusum = *cusum;
    }
  return result;
}

std::vector<ElementId> SequentialTests::suspects(const TreeFilter& filter, double suspicion) const {
  std::vector<std::pair<double, ElementId>> scored;
  for (int node = 0; node < filter.num_nodes(); ++node) {
    scored.emplace_back(edge(node).value, edge_element(filter.part(node), filter.part(0)));
    scored.emplace_back(marker(node).value, tag_element(filter.part(node)));
  }
  std::erase_if(scored, [suspicion](const auto& s) { return !(s.first > suspicion); });
  std::ranges::stable_sort(scored, std::greater(), [](const auto& s) { return s.first; });
  if (scored.size() > kMostSuspects) scored.resize(kMostSuspects);
  std::vector<ElementId> elements;
  for (const auto& [value, element] : scored) elements.push_back(element);
  if (elements.empty()) return elements;
  for (const ElementId& element : elements_around(filter, elements.front().id))
    if (std::ranges::find(elements, element) == elements.end()) elements.push_back(element);
  return elements;
}

std::vector<ElementId> elements_around(const TreeFilter& filter, int part) {
  const auto edge = [&filter](int of) { return edge_element(of, filter.part(0)); };
  std::vector<ElementId> elements{edge(part), tag_element(part)};
  const int node = filter.node_of(part);
  if (const int parent = filter.parent(node); parent >= 0) {
    elements.push_back(edge(filter.part(parent)));
    elements.push_back(tag_element(filter.part(parent)));
  }
  for (const int child : filter.children(node)) elements.push_back(edge(filter.part(child)));
  return elements;
}

}  // namespace bodyschema
