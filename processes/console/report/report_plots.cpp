#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "common/estimation/evaluation.h"
#include "common/estimation/measurement_model.h"
#include "common/geometry/angle.h"
#include "common/geometry/pose.h"
#include "processes/console/hint.h"
#include "processes/console/report/report_figures.h"

namespace bodyschema {
namespace {

// Seen on white and on black.
constexpr char kBlue[] = "#4a86c5", kOrange[] = "#dd8a3a", kGreen[] = "#5aa469", kRed[] = "#cf5f5f";
const char* const kColours[] = {kBlue,     kOrange,   kGreen,    kRed,
                                "#9a77bd", "#4fa8a8", "#a3794f", "#b0a03c"};
constexpr std::size_t kMostDots = 150;

/// Numbers for a gnuplot data block: what is not finite becomes a gap.
std::string number(double value) {
  return std::isfinite(value) ? fmt::format("{:.6g}", value) : "NaN";
}

/// Components as EdgeSlice has them.
Vector6d components(const Pose& X, const Pose& X_middle) {
  Vector6d result;
  result << X.translation() * 1e3, log_so3(X_middle.linear().transpose() * X.linear()) / kDegree;
  return result;
}

/// Standard deviations of components() from a covariance of X (right perturbation).
Vector6d component_sigmas(const Pose& X, const Pose& X_middle, const Matrix6d& covariance) {
  Vector6d turned = Vector6d::Zero();
  turned.tail<3>() = log_so3(X_middle.linear().transpose() * X.linear());
  Matrix6d J = Matrix6d::Zero();
  J.topLeftCorner<3, 3>() = X.linear() * 1e3;
  J.bottomRightCorner<3, 3>() = right_jacobian_inverse(turned).bottomRightCorner<3, 3>() / kDegree;
  return (J * covariance * J.transpose()).diagonal().cwiseMax(0).cwiseSqrt();
}

/// Mean covariance of the observed poses of edge.to in edge.from, right perturbation.
Matrix6d observation_noise(const BodySchema& schema, const Edge& edge,
                           const std::vector<ActionPoseSample>& samples) {
  Matrix6d sum = Matrix6d::Zero();
  int count = 0;
  for (const ActionPoseSample& sample : samples) {
    const PartObservation* from = sample.find(edge.from);
    const PartObservation* to = sample.find(edge.to);
    if (!from || !to || !from->has_rotation) continue;
    sum += relative_covariance(from->X_CB.inverse() * to->X_CB, from->covariance, to->covariance);
    ++count;
  }
  if (count > 0 && !sum.isZero(0)) return sum / count;
  return 2 * isotropic(schema.noise);
}

/// The largest round step that gives at least `least` intervals over `span`.
double tic_step(double span, double least) {
  const double widest = span / least;
  const double power = std::pow(10, std::floor(std::log10(widest)));
  return widest >= 5 * power ? 5 * power : widest >= 2 * power ? 2 * power : power;
}

using Limits = std::vector<std::pair<double, double>>;  ///< of each component's axis

/// Axes for the band, not for the wildest outlier.
Limits limits_of(const EdgeSlice& slice) {
  Limits limits;
  for (int c = 0; c < 6; ++c) {
    double low = std::numeric_limits<double>::infinity(), high = -low;
    for (const EdgeSlice::Point& point : slice.curve) {
      low = std::min(low, point.mean[c] - 4 * point.sigma[c]);
      high = std::max(high, point.mean[c] + 4 * point.sigma[c]);
    }
    if (!(high > low)) low -= 1, high += 1;
    if (!std::isfinite(low) || !std::isfinite(high)) low = -1, high = 1;
    limits.emplace_back(low, high);
  }
  return limits;
}

std::string curve_block(const EdgeSlice& slice) {
  std::string block = "$curve << EOD\n";
  for (const EdgeSlice::Point& point : slice.curve) {
    block += number(point.q);
    for (int c = 0; c < 6; ++c)
      block += fmt::format(" {} {} {}", number(point.mean[c]), number(2 * point.sigma_model[c]),
                           number(2 * point.sigma[c]));
    block += "\n";
  }
  return block + "EOD\n";
}

/// At most kMostDots of the observations.
std::string dots_blocks(const EdgeSlice& slice, const Limits& limits, EdgePlot* result) {
  std::string dots[2];
  const std::size_t step = (slice.observations.size() + kMostDots - 1) / kMostDots;
  result->num_left_out = static_cast<int>(slice.observations.size());
  for (std::size_t i = 0; i < slice.observations.size(); i += std::max<std::size_t>(1, step)) {
    const EdgeSlice::Observation& observation = slice.observations[i];
    --result->num_left_out;
    std::string& row = dots[observation.is_held_out ? 1 : 0];
    row += number(observation.q);
    bool is_beyond = false;
    for (int c = 0; c < 6; ++c) {
      const auto [low, high] = limits[static_cast<std::size_t>(c)];
      row += " " + number(observation.value[c]);
      is_beyond |= observation.value[c] < low || observation.value[c] > high;
    }
    row += "\n";
    result->num_beyond += is_beyond ? 1 : 0;
  }
  // A block without a row would be an error of gnuplot's.
  for (std::string& rows : dots)
    if (rows.empty()) rows = "NaN NaN NaN NaN NaN NaN NaN\n";
  return "$learned << EOD\n" + dots[0] + "EOD\n$held_out << EOD\n" + dots[1] + "EOD\n";
}

}  // namespace

std::vector<BodyMark> body_marks(const RunRecord& record) {
  std::vector<BodyMark> marks;
  const auto add = [&](std::int64_t sample, const std::string& label) {
    while (!marks.empty() && marks.back().sample >= sample) marks.pop_back();
    if (sample > 0) marks.push_back({sample, label});
  };
  if (!record.faults().empty()) {
    std::vector<std::string> before;
    for (const RunRecord::FaultChange& change : record.faults()) {
      for (const ActionPoseSample& sample : record.watch().samples()) {
        if (sample.utime < change.utime) continue;
        std::vector<std::string> added = change.faults;
        std::erase_if(added, [&](const std::string& fault) {
          return std::ranges::find(before, fault) != before.end();
        });
        add(sample.sample_index, added.empty() ? "repair" : listed(added));
        break;
      }
      before = change.faults;
    }
  } else if (record.watch().schema()) {
    // One that was taken back, or is told better, is known from an earlier sample on.
    for (const KnownChange& change : record.watch().schema()->changes) add(change.since, "found");
  }
  return marks;
}

std::vector<VersionErrors> version_errors(const std::map<std::int64_t, BodySchema>& versions,
                                          const std::vector<ActionPoseSample>& held_out,
                                          const std::vector<BodyMark>& marks,
                                          std::optional<int> end_effector, int most) {
  std::vector<VersionErrors> result;
  for (std::size_t body = 0; body <= marks.size(); ++body) {
    const std::int64_t begin = body == 0 ? 0 : marks[body - 1].sample;
    const std::int64_t end =
        body == marks.size() ? std::numeric_limits<std::int64_t>::max() : marks[body].sample;
    const BodySchema* standing = nullptr;
    std::vector<const BodySchema*> all;
    for (const auto& [version, schema] : versions) {
      if (schema.last_sample_index < begin)
        standing = &schema;
      else if (schema.last_sample_index < end)
        all.push_back(&schema);
    }
    std::vector<const BodySchema*> chosen;
    if (standing) chosen.push_back(standing);
    const int num_chosen = std::min(most, static_cast<int>(all.size()));
    for (int i = 0; i < num_chosen; ++i) {
      // From the last one backwards, in equal steps.
      const auto index = static_cast<std::size_t>(
          std::lround((i + 1.0) * static_cast<double>(all.size()) / num_chosen) - 1);
      chosen.push_back(all[index]);
    }
    for (const BodySchema* schema : chosen) {
      std::vector<ActionPoseSample> fitting;
      for (const ActionPoseSample& sample : held_out) {
        if (sample.sample_index >= begin && sample.sample_index < end &&
            sample.action.size() == static_cast<Eigen::Index>(schema->signals.size()))
          fitting.push_back(sample);
      }
      std::vector<double> medians;
      VersionErrors errors;
      errors.body = body;
      errors.num_samples = std::max(begin, schema->last_sample_index + 1);
      errors.num_edges = static_cast<int>(schema->edges.size());
      for (const PartErrors& part : evaluate(*schema, fitting)) {
        if (part.count == 0) continue;
        medians.push_back(part.position_median_m);
        if (part.part == end_effector) errors.end_effector_m = part.position_median_m;
      }
      if (medians.empty()) continue;
      errors.median_position_m = quantile(medians, 0.5);
      errors.worst_position_m = *std::ranges::max_element(medians);
      result.push_back(errors);
    }
  }
  return result;
}

std::optional<Plot> version_plot(const std::vector<VersionErrors>& versions,
                                 const std::vector<BodyMark>& marks) {
  if (versions.size() < 2) return std::nullopt;
  std::string data = "$errors << EOD\n";
  bool has_effector = false;
  int most_edges = 1;
  double lowest = 1, highest = 1e-5;
  std::size_t body = versions.front().body;
  for (const VersionErrors& version : versions) {
    // An empty line ends a curve.
    if (std::exchange(body, version.body) != version.body) data += "\n";
    lowest = std::clamp(version.median_position_m, 1e-5, lowest);
    lowest = std::clamp(version.end_effector_m.value_or(lowest), 1e-5, lowest);
    highest = std::max(highest, version.worst_position_m);
    has_effector |= version.end_effector_m.has_value();
    most_edges = std::max(most_edges, version.num_edges);
    data += fmt::format(
        "{} {} {} {} {}\n", version.num_samples, number(version.median_position_m * 1e3),
        number(version.worst_position_m * 1e3),
        number(version.end_effector_m.value_or(std::numeric_limits<double>::quiet_NaN()) * 1e3),
        version.num_edges);
  }
  data += "EOD\n";
  const std::string dots = "with linespoints pt 7 ps 0.35 lw 1.6";
  std::string script = data;
  script += fmt::format(
      "set xrange [0:{}]\nset multiplot\nset lmargin at screen 0.075\nset rmargin at screen 0.985\n"
      "set tmargin at screen 0.90\nset bmargin at screen 0.42\n"
      "set logscale y\nset yrange [{}:{}]\nset format x ''\n"
      "set label 1 'error [mm]' at screen 0.014,0.66 rotate center\n"
      "set ytics (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, "
      "2000)\n"
      "set key outside top right horizontal samplen 1.5 textcolor rgb 'black'\n",
      versions.back().num_samples + 1, number(lowest * 0.7e3), number(highest * 1.4e3));
  for (std::size_t i = 0; i < marks.size(); ++i)
    script += fmt::format(
        "set arrow {0} from {1}, graph 0 to {1}, graph 1 nohead lw 0.8 dt 2 lc rgb '{2}'\n"
        "set label {3} {4} at {1}, graph 0.97 right rotate by 90 offset 0.6,0 font ',8' "
        "textcolor rgb '{2}'\n",
        i + 1, marks[i].sample, kRed, i + 2, gnuplot_string(marks[i].label));
  script += fmt::format(
      "plot $errors using 1:3 {0} lc rgb '{1}' title 'worst part', "
      "$errors using 1:2 {0} lc rgb '{2}' title 'median of the parts'",
      dots, kOrange, kBlue);
  if (has_effector)
    script += fmt::format(", $errors using 1:4 {} lc rgb '{}' title 'end effector'", dots, kGreen);
  script += fmt::format(
      "\nunset label\nset tmargin at screen 0.36\nset bmargin at screen 0.17\nunset logscale "
      "y\nset format x "
      "'%g'\nset label 1 'edges' at screen 0.014,0.265 rotate center\nset xlabel 'samples' offset "
      "0,0.3\n"
      "set yrange [0:{0}]\nset ytics {1}\nunset key\n"
      "plot $errors using 1:5 with steps lw 1.6 lc rgb 'black'\nunset multiplot\n",
      most_edges + 1, std::max(1, (most_edges + 2) / 3));
  return Plot{.height_px = 330, .script = script};
}

std::vector<Plot> load_plots(const std::vector<RunRecord::Process>& processes) {
  std::string data;
  std::vector<std::string> names;
  for (const RunRecord::Process& process : processes) {
    if (process.load.size() < 2) continue;
    data += fmt::format("$p{} << EOD\n", names.size());
    for (const RunRecord::Load& load : process.load)
      data += fmt::format("{} {} {}\n", number(load.at_s), number(load.cpu_percent),
                          number(load.memory_mb));
    data += "EOD\n";
    names.push_back(process.newest.process_name);
  }
  if (names.empty()) return {};
  std::string script = data +
                       "set xrange [0:*]\nset yrange [0:*]\nset xlabel 's' offset 0,0.5\n"
                       "set lmargin 7\nset rmargin 22\n"
                       "set key outside right top Left reverse samplen 1.2 textcolor rgb 'black'\n";
  std::vector<Plot> plots;
  for (int column = 2; column <= 3; ++column) {
    std::string plot =
        fmt::format("set ylabel '{}' offset 1\nplot ", column == 2 ? "% of a core" : "memory [MB]");
    for (std::size_t i = 0; i < names.size(); ++i)
      plot += fmt::format("{}$p{} using 1:{} with lines lw 1.5 lc rgb '{}' dt {} title {}",
                          i ? ", " : "", i, column, kColours[i % std::size(kColours)],
                          i < std::size(kColours) ? 1 : 2, gnuplot_string(names[i]));
    plots.push_back({.height_px = 220, .script = script + plot + "\n"});
  }
  return plots;
}

EdgeSlice edge_slice(const BodySchema& schema, const Edge& edge, int signal,
                     const std::vector<ActionPoseSample>& samples) {
  constexpr int kPoints = 60;
  const Eigen::VectorXd middle = mid_range(schema.signals);
  const Pose X_middle = edge.predict(schema.displacements(middle));
  const Matrix6d noise = observation_noise(schema, edge, samples);
  const auto point_at = [&](const Eigen::VectorXd& action) {
    const Eigen::VectorXd theta = schema.displacements(action);
    const Pose X = edge.predict(theta);
    const Matrix6d of_model = edge.prediction_covariance(theta);
    EdgeSlice::Point point;
    point.q = action[signal];
    point.mean = components(X, X_middle);
    point.sigma_model = component_sigmas(X, X_middle, of_model);
    point.sigma = component_sigmas(X, X_middle, of_model + noise);
    return point;
  };

  EdgeSlice slice;
  slice.signal = signal;
  const Signal& range = schema.signals[static_cast<std::size_t>(signal)];
  for (int i = 0; i <= kPoints; ++i) {
    Eigen::VectorXd action = middle;
    action[signal] = range.lower + (range.upper - range.lower) * i / kPoints;
    slice.curve.push_back(point_at(action));
  }
  int num_within = 0, num_components = 0;
  for (const ActionPoseSample& sample : samples) {
    const PartObservation* from = sample.find(edge.from);
    const PartObservation* to = sample.find(edge.to);
    if (!from || !from->has_rotation || !to || sample.action.size() != middle.size()) continue;
    Pose observed = from->X_CB.inverse() * to->X_CB;
    Eigen::VectorXd action = middle;
    action[signal] = sample.action[signal];
    EdgeSlice::Observation& observation = slice.observations.emplace_back();
    observation.q = sample.action[signal];
    const Pose X = edge.predict(schema.displacements(action));
    const Pose X_sample = edge.predict(schema.displacements(sample.action));
    if (!to->has_rotation) observed.linear() = X_sample.linear();
    observation.value = components(X * X_sample.inverse() * observed, X_middle);
    observation.is_held_out = sample.purpose == Purpose::kTest;
    const EdgeSlice::Point expected = point_at(action);
    for (int c = 0; c < 6; ++c) {
      ++num_components;
      num_within += std::abs(observation.value[c] - expected.mean[c]) <= 2 * expected.sigma[c];
    }
  }
  slice.coverage = num_components > 0 ? static_cast<double>(num_within) / num_components
                                      : std::numeric_limits<double>::quiet_NaN();
  return slice;
}

EdgePlot edge_plot(const BodySchema& schema, const EdgeSlice& slice) {
  static const char* const kTitles[] = {"x [mm]",      "y [mm]",      "z [mm]",
                                        "about x [°]", "about y [°]", "about z [°]"};
  EdgePlot result;
  result.plot.height_px = 320;
  const Limits limits = limits_of(slice);
  std::string& script = result.plot.script;
  script = curve_block(slice) + dots_blocks(slice, limits, &result);
  const Signal& signal = schema.signals.at(static_cast<std::size_t>(slice.signal));
  script += fmt::format(
      "set multiplot layout 2,3 margins 0.055,0.978,0.15,0.925 spacing 0.08,0.21\n"
      "unset key\nset xrange [{}:{}]\nset xtics {}\n",
      number(signal.lower), number(signal.upper), number(tic_step(signal.upper - signal.lower, 3)));
  for (int c = 0; c < 6; ++c) {
    const auto [low, high] = limits[static_cast<std::size_t>(c)];
    script += fmt::format("set title {} offset 0,-0.6\nset yrange [{}:{}]\nset ytics {}\n",
                          gnuplot_string(kTitles[c]), number(low), number(high),
                          number(tic_step(high - low, 2.2)));
    script += c == 4 ? fmt::format("set xlabel {} offset 0,0.6\n", gnuplot_string(signal.name))
                     : "unset xlabel\n";
    const int mean = 2 + 3 * c;
    const auto band = [&](int column, double alpha) {
      return fmt::format(
          "$curve using 1:(${0}-${1}):(${0}+${1}) with filledcurves lc rgb '{2}' fs transparent "
          "solid {3} noborder",
          mean, column, kBlue, alpha);
    };
    script += fmt::format(
        "plot {}, {}, $curve using 1:{} with lines lw 1.3 lc rgb '{}', "
        "$learned using 1:{} with points pt 7 ps 0.26 lc rgb 'black', "
        "$held_out using 1:{} with points pt 7 ps 0.32 lc rgb '{}'\n",
        band(mean + 2, 0.18), band(mean + 1, 0.35), mean, kBlue, 2 + c, 2 + c, kOrange);
  }
  script += "unset multiplot\n";
  return result;
}

}  // namespace bodyschema
