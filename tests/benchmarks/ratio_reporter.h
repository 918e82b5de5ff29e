#pragma once

#include <benchmark/benchmark.h>

#include <map>
#include <ostream>
#include <string>
#include <vector>

namespace bodyschema::test {

/// Google Benchmark's console table and, below it, each benchmark's median processor time over that
/// of a peer: `{"ours", "peer"}`, with their arguments: `Learn/100`. Compares within one run on one
/// machine, so the ratios hold where the times do not.
class RatioReporter : public benchmark::ConsoleReporter {
 public:
  struct Ratio {
    std::string ours;
    std::string peer;
  };

  explicit RatioReporter(std::vector<Ratio> ratios)
      : ConsoleReporter(OO_Tabular), ratios_(std::move(ratios)) {}

  void ReportRuns(const std::vector<Run>& runs) override {
    ConsoleReporter::ReportRuns(runs);
    for (const Run& run : runs) {
      const bool is_median = run.run_type == Run::RT_Aggregate && run.aggregate_name == "median";
      const bool is_only = run.run_type == Run::RT_Iteration && run.repetitions <= 1;
      const std::string& args = run.run_name.args;
      if (is_median || is_only)
        time_[run.run_name.function_name + (args.empty() ? "" : "/" + args)] =
            run.GetAdjustedCPUTime();
    }
  }

  void Finalize() override {
    ConsoleReporter::Finalize();
    std::ostream& out = GetOutputStream();
    for (const Ratio& ratio : ratios_) {
      if (!time_.contains(ratio.ours) || !time_.contains(ratio.peer)) continue;
      out << ratio.ours << " / " << ratio.peer << " = " << time_[ratio.ours] / time_[ratio.peer]
          << "\n";
    }
  }

 private:
  const std::vector<Ratio> ratios_;
  std::map<std::string, double> time_;
};

}  // namespace bodyschema::test
