#pragma once

#include <filesystem>
#include <functional>
#include <map>
#include <optional>
#include <string>

#include "common/bus/log_summary.h"
#include "processes/console/run_record.h"
#include "processes/structure_learner/recording/recording.h"

namespace bodyschema {

/// The contents of a report.
struct Report {
  std::string title;  ///< of the run
  const RunRecord* record = nullptr;
  std::map<std::filesystem::path, LogSummary> logs;
  /// Asked if the logs hold no schema and the page learns one; see measurement_of().
  std::function<MeasurementModel()> measurement;
  std::optional<int> end_effector;     ///< part id, where the rig's files are at hand
  std::optional<std::string> picture;  ///< a frame with the markers drawn in, JPEG bytes
  bool goes_on = false;                ///< its group runs, logs may end in the middle of an event
  std::optional<int> reload_s;         ///< seconds after which a browser loads the page again
};

/// The page, one file without anything outside it. Where there is nothing to show, it says so.
/// `problem`, if given, is set to why there are no plots, else to "".
std::string report_page(const Report& report, std::string* problem = nullptr);

}  // namespace bodyschema
