#pragma once

#include <map>
#include <optional>
#include <string>
#include <vector>

#include "common/plot/plot.h"
#include "common/schema/body_schema.h"
#include "common/schema/sample.h"
#include "processes/console/run_record.h"

namespace bodyschema {

/// The tree of parts from the root (left) outwards as an <svg>, parts without a way to the root
/// below it. `state` of an edge colours it.
std::string tree_svg(const BodySchema& schema, std::optional<int> end_effector);

/// How often each part was seen over the range of each signal, as an <svg>: rows are parts, columns
/// signals, cells strips of kVisibilityBins bins.
inline constexpr int kVisibilityBins = 12;
std::string visibility_svg(const std::vector<Signal>& signals,
                           const std::vector<ActionPoseSample>& samples,
                           const std::vector<int>& parts);

/// A sample at which the body became another one.
struct BodyMark {
  std::int64_t sample = 0;  ///< the first of the new body
  std::string label;        ///< what became of it
};
/// By the simulation's truth where it was recorded, else as the monitor found it; ascending.
std::vector<BodyMark> body_marks(const RunRecord& record);

/// How one version of the body schema does on held-out samples of the body that it was for.
struct VersionErrors {
  std::size_t body = 0;          ///< so many marks came before
  std::int64_t num_samples = 0;  ///< that it rests on; at least those before its body
  int num_edges = 0;
  double median_position_m = 0;          ///< median of the parts' medians
  double worst_position_m = 0;           ///< largest of the parts' medians
  std::optional<double> end_effector_m;  ///< median of the end effector
};

/// At most `most` versions of each body, the last one included, and that which stood before it,
/// each on all held-out samples of that body; without those that connect no part or have other
/// signals.
std::vector<VersionErrors> version_errors(const std::map<std::int64_t, BodySchema>& versions,
                                          const std::vector<ActionPoseSample>& held_out,
                                          const std::vector<BodyMark>& marks,
                                          std::optional<int> end_effector, int most = 30);
/// Their plot, a curve for each body; std::nullopt where there is nothing to draw.
std::optional<Plot> version_plot(const std::vector<VersionErrors>& versions,
                                 const std::vector<BodyMark>& marks);

/// A local model over one of its signals (the chapter's Fig. 5), other signals in the middle of
/// their ranges; observations are carried there by the model, which keeps their residuals. The
/// noise is the mean of the observations' own covariances, else the schema's. Components: x y z
/// [mm] of `to` in `from`, and the rotation vector [deg] from the pose in the middle of the range.
struct EdgeSlice {
  int signal = 0;
  struct Point {
    double q = 0;  ///< command units
    Vector6d mean;
    Vector6d sigma_model;  ///< from the covariance of the parameters
    Vector6d sigma;        ///< with the noise of an observation of both parts
  };
  std::vector<Point> curve;  ///< ascending q
  struct Observation {
    double q = 0;
    Vector6d value;
    bool is_held_out = false;
  };
  std::vector<Observation> observations;
  /// Share of the observations' components within ±2 sigma; NaN without an observation.
  double coverage = 0;
};
EdgeSlice edge_slice(const BodySchema& schema, const Edge& edge, int signal,
                     const std::vector<ActionPoseSample>& samples);
/// Its plot, and how many of its dots lie beyond the axes.
struct EdgePlot {
  Plot plot;
  int num_beyond = 0;
  int num_left_out = 0;  ///< observations not drawn to keep the page small
};
EdgePlot edge_plot(const BodySchema& schema, const EdgeSlice& slice);

/// Processor time and memory of every process over the run; empty where there is nothing to draw.
std::vector<Plot> load_plots(const std::vector<RunRecord::Process>& processes);

}  // namespace bodyschema
