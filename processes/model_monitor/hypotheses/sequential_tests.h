#pragma once

#include <cstdint>
#include <vector>

#include "processes/model_monitor/changes/body_change.h"
#include "processes/model_monitor/likelihood/tree_filter.h"

namespace bodyschema {

/// One CUSUM for every edge and every marker of a schema: the sum of the log-likelihood ratios of
/// "this one is wrong" over "all is right", never below zero (Page 1954). The ratios are proper, so
/// that ln(2n/α) is the threshold for α false alarms a sample over the 2n tests together.
class SequentialTests {
 public:
  /// `loudest`: of one sample's ratio for an edge [nats].
  SequentialTests(const TreeFilter& filter, double false_alarm_rate, double loudest);

  /// Returns the judgement under the schema as it stands.
  TreeFilter::Judgement update(const TreeFilter& filter, const TreeFilter::Instant& instant,
                               std::int64_t sample_index);

  struct Cusum {
    double value = 0;        ///< [nats]
    std::int64_t since = 0;  ///< first sample of the present rise
  };
  const Cusum& edge(int node) const { return edges_[static_cast<std::size_t>(node)]; }
  const Cusum& marker(int node) const { return markers_[static_cast<std::size_t>(node)]; }
  void clear(int node);

  /// The highest CUSUM, and the value of the next.
  struct Highest {
    Cusum cusum;
    double second = 0;
  };
  Highest highest() const;
  /// The elements whose CUSUMs are above `suspicion`, four at most, the highest first, and what is
  /// next to that one.
  std::vector<ElementId> suspects(const TreeFilter& filter, double suspicion) const;

  /// CUSUM above which something is wrong even if nothing explains it [nats].
  double alarm() const { return alarm_; }
  /// What is not explained is not suspected for as long again once it is over: earlier samples
  /// count up to this [nats].
  double ceiling() const { return 2 * alarm_; }

 private:
  double alarm_;
  double loudest_;
  std::vector<Cusum> edges_, markers_;  ///< by node
};

/// ln(2n/α) for n nodes and α false alarms a sample [nats].
double alarm_threshold(int num_nodes, double false_alarm_rate);

/// A part's elements and those next to it.
std::vector<ElementId> elements_around(const TreeFilter& filter, int part);

}  // namespace bodyschema
