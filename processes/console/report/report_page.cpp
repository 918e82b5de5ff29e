#include "processes/console/report/report_page.h"

#include <fmt/chrono.h>
#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <ctime>
#include <utility>
#include <vector>

#include "common/estimation/evaluation.h"
#include "common/geometry/angle.h"
#include "common/plot/plot.h"
#include "common/schema/standard_deviations.h"
#include "processes/console/hint.h"
#include "processes/console/names.h"
#include "processes/console/report/report_figures.h"
#include "processes/console/report/run_sections.h"
#include "processes/console/report/template.h"
#include "processes/console/views/health_view.h"
#include "processes/console/views/structure_view.h"
#include "processes/structure_learner/learn.h"

namespace bodyschema {
namespace {

std::string base64(const std::string& bytes) {
  static const char* const kDigits =
      "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
  std::string text;
  for (std::size_t i = 0; i < bytes.size(); i += 3) {
    std::uint32_t group = 0;
    for (std::size_t j = 0; j < 3; ++j) {
      group <<= 8;
      if (i + j < bytes.size()) group |= static_cast<unsigned char>(bytes[i + j]);
    }
    for (std::size_t j = 0; j < 4; ++j)
      text += i + j > bytes.size() ? '=' : kDigits[group >> (18 - 6 * j) & 63];
  }
  return text;
}

std::string millimetres(double m) { return fmt::format("{:.2f} mm", m * 1e3); }
std::string degrees(double rad) { return fmt::format("{:.2f}°", rad / kDegree); }

std::string edge_name(int from, int to) { return fmt::format("{} → {}", from, to); }

std::string names_of(const BodySchema& schema, const std::vector<int>& signals) {
  return listed(signal_names(schema, signals));
}

/// The schema that the report shows, and where it comes from.
struct Body {
  BodySchema schema;
  std::string origin;
};

std::vector<ActionPoseSample> fitting(std::vector<ActionPoseSample> samples,
                                      std::ptrdiff_t num_signals) {
  std::erase_if(samples, [&](const auto& sample) { return sample.action.size() != num_signals; });
  return samples;
}

std::optional<Body> body_of(const Report& report) {
  const RunRecord& record = *report.record;
  if (const auto& accepted = record.watch().schema())
    return Body{*accepted, fmt::format("version {}, accepted by the monitor", accepted->version)};
  if (const auto& proposal = record.learned())
    return Body{*proposal, "the learner’s newest proposal: the monitor accepted none"};
  Recording recording{.samples = record.watch().samples()};
  if (recording.samples.empty()) return std::nullopt;
  // A log may hold another rig's samples too; the first one decides.
  recording.samples = fitting(recording.samples, recording.samples.front().action.size());
  recording.signals = observed_signals(recording.samples);
  LearnOptions options;
  if (report.measurement) options.measurement = report.measurement();
  return Body{learn(recording.signals, recording.training(), options).schema,
              "learned for this report: the log holds no body schema"};
}

/// The data of report.mustache; plots are drawn together at the end and take the place of their
/// marks.
class Page {
 public:
  explicit Page(const Report& report)
      : report_(report), record_(*report.record), body_(body_of(report)) {
    if (!body_) return;
    const BodySchema& schema = body_->schema;
    held_out_ = fitting(record_.watch().held_out(schema.body_since(schema.last_sample_index)),
                        std::ssize(schema.signals));
    errors_ = judge(schema, held_out_, has_truth() ? held_out_ : std::vector<ActionPoseSample>());
  }

  std::string html(std::string* problem) {
    const std::string content = render(kReportTemplate, data());
    std::string why;
    std::vector<std::string> drawn;
    try {
      drawn = draw_plots(plots_);
    } catch (const PlotError& error) {
      why = error.what();
    }
    if (problem != nullptr) *problem = why;
    return with_plots(content, drawn, why);
  }

 private:
  Json data() {
    Json data = {
        {"reload_s", or_null(report_.reload_s)},
        {"goes_on", report_.goes_on},
        {"title", report_.title},
        {"style", std::string(kReportStyle)},
        {"plot_symbols", plot_symbols()},
        {"wrong", wrong()},
        {"lead", lead()},
        {"flaws", flaws_data(report_)},
        {"is_empty", record_.is_empty()},
        {"version", program_version()},
        {"written", fmt::format("{:%Y-%m-%d %H:%M:%S}", fmt::gmtime(std::time(nullptr)))},
        {"logs", report_.logs.empty() ? "no log" : counted(std::ssize(report_.logs), "log")}};
    if (record_.is_empty()) return data;
    data["numbers"] = numbers();
    data["picture"] = report_.picture ? Json(base64(*report_.picture)) : Json();
    data["body"] = body();
    data["held_out"] = held_out();
    data["local_models"] = local_models();
    data["visibility"] = visibility();
    data["processes"] = processes();
    data["events"] = events_data(record_);
    data["messages"] = messages_data(report_);
    data["configuration"] = configuration_data(record_);
    return data;
  }

  static std::string plot_mark(std::size_t index) { return fmt::format("<!--plot {}-->", index); }
  std::string plot(Plot plot) {
    plots_.push_back(std::move(plot));
    return plot_mark(plots_.size() - 1);
  }
  std::string with_plots(std::string content, const std::vector<std::string>& drawn,
                         const std::string& why_not) const {
    for (std::size_t i = 0; i < plots_.size(); ++i) {
      const std::string mark = plot_mark(i);
      content.replace(content.find(mark), mark.size(),
                      i < drawn.size()
                          ? "<svg class=\"plot\"" + drawn[i].substr(4)
                          : "<p class=\"warn\">No plot: " + escape_html(why_not) + "</p>");
    }
    return content;
  }

  bool has_truth() const { return record_.watch().has_truth(); }
  /// The error that the monitor knows, where the table has the truth.
  Json as_seen() const {
    const auto& health = record_.health();
    if (!has_truth() || !health || health->worst_position_m < 0) return nullptr;
    return fmt::format("{}, {}", millimetres(health->worst_position_m),
                       degrees(health->worst_rotation_rad));
  }
  std::ptrdiff_t num_edges_needed() const {
    return std::max<std::ptrdiff_t>(0, std::ssize(body_->schema.parts) - 1);
  }

  Json lead() const {
    if (!body_) return nullptr;
    const BodySchema& schema = body_->schema;
    const std::string edges = counted(std::ssize(schema.edges), "edge");
    const std::string samples = counted(schema.num_samples, "sample");
    return schema.complete ? fmt::format("{} {} hang together by {}, learned from {}.", headline(),
                                         counted(std::ssize(schema.parts), "part"), edges, samples)
                           : fmt::format("The body is not known yet: {} of {} after {}.", edges,
                                         num_edges_needed(), samples);
  }

  std::string headline() const {
    if (!record_.health()) return "The body is known:";
    const BodyVerdict verdict = verdict_of(*record_.health());
    return verdict.wrong.empty() && !verdict.is_in_doubt ? "The body is known:" : verdict.sentence;
  }

  Json wrong() const {
    if (!record_.health()) return nullptr;
    const BodyVerdict verdict = verdict_of(*record_.health());
    if (verdict.wrong.empty()) return nullptr;
    Json json = {
        {"is_open", verdict.is_schema_wrong}, {"heading", kWhatIsWrong}, {"lines", verdict.wrong}};
    if (!report_.goes_on && record_.watch().num_samples() > 0)
      json["as_of"] = {{"sample", record_.watch().samples().back().sample_index},
                       {"then", kNobodyWatches}};
    return json;
  }

  Json numbers() const {
    Json items = Json::array();
    const auto add = [&](const char* name, const std::string& value, const std::string& more) {
      items.push_back({{"name", name}, {"value", value}, {"more", more}});
    };
    if (body_)
      add("Structure", body_->schema.complete ? "complete" : "incomplete",
          fmt::format("{} of {} edges", body_->schema.edges.size(), num_edges_needed()));
    add("Samples", std::to_string(record_.watch().num_samples()),
        fmt::format("{} held out", held_out_.size()));
    const char* against = has_truth() ? ", against the truth" : ", against what was seen";
    const PartErrors *effector = nullptr, *worst = nullptr;
    for (const PartErrors& part : errors_.parts) {
      if (part.count == 0) continue;
      if (part.part == report_.end_effector) effector = &part;
      if (!worst || part.position_median_m > worst->position_median_m) worst = &part;
    }
    if (effector)
      add("End effector", millimetres(effector->position_median_m),
          degrees(effector->rotation_median_rad) + against);
    if (worst)
      add("Worst part", millimetres(worst->position_median_m),
          fmt::format("part {}, {}{}", worst->part, degrees(worst->rotation_median_rad), against));
    if (const auto begin = record_.begin_utime())
      add("Recorded", duration(record_.duration_s()),
          fmt::format("{:%Y-%m-%d %H:%M}",
                      fmt::gmtime(static_cast<std::time_t>(*begin / 1'000'000))));
    return items;
  }

  Json body() const {
    if (!body_) return nullptr;
    const BodySchema& schema = body_->schema;
    const auto unconnected_row = [](const UnconnectedPart& part) -> Json {
      return {{"part", part.part},
              {"reason", name_in(kUnconnectedReasons, part.reason)},
              {"detail", part.detail}};
    };
    return {{"tree", tree_svg(schema, report_.end_effector)},
            {"origin", body_->origin},
            {"is_complete", schema.complete},
            {"edges", table(array_of(schema.edges, [&](const Edge& e) { return edge_row(e); }))},
            {"deviations", deviations(schema_json(schema))},
            {"unconnected", table(array_of(schema.unconnected, unconnected_row))},
            {"unused", names_of(schema, schema.unused_signals())},
            {"undecided", names_of(schema, schema.undecided_signals)}};
  }

  /// The standard deviations in `schema`, from schema_json(), in mm and degrees.
  static Json deviations(const Json& schema) {
    const auto number = [](const Json& sd, double unit) {
      return sd.is_null() ? "–" : fmt::format("{:.2g}", sd.get<double>() * unit);
    };
    const auto axes = [&](const Json& sd, double unit) {
      return fmt::format("{} {} {}", number(sd[0], unit), number(sd[1], unit), number(sd[2], unit));
    };
    Json rows = Json::array();
    for (const Json& edge : schema["edges"]) {
      for (const Json& joint : edge["joints"]) {
        const Json& sd = joint["sd"];
        if (sd.is_null()) continue;
        rows.push_back({{"edge", edge_name(edge["from"], edge["to"])},
                        {"signal", joint["signal"].get<std::string>() +
                                       (joint["order_group"].is_null() ? "" : ", order open")},
                        {"numbers",
                         {number(sd["axis_position_m"], 1e3), number(sd["axis_tilt_deg"], 1),
                          number(sd["displacement_m"], 1e3), number(sd["displacement_deg"], 1),
                          number(sd["slide_m"], 1e3), number(sd["turn_rad"], 1 / kDegree)}}});
      }
    }
    return {{"root", axes(schema["X_CR"]["position_sd_m"], 1e3) + " mm, " +
                         axes(schema["X_CR"]["rotation_sd_deg"], 1) + "°"},
            {"joints", table(std::move(rows))}};
  }

  Json edge_row(const Edge& edge) const {
    const BodySchema& schema = body_->schema;
    std::string health = name_in(kEdgeStateWords, edge.state), distance = "–";
    if (const edge_health_t* told = health_of(record_.health(), edge.from, edge.to)) {
      health = name_in(kEdgeStateWords, told->edge_state);
      if (told->edge_is_drifting == 1) health += ", drifting";
      if (told->median_mahalanobis2 >= 0)
        distance = fmt::format("{:.1f}", told->median_mahalanobis2);
    }
    const auto turned = [&](double rad) {
      return schema.has_rotation(edge.to) ? degrees(rad) : std::string("–");
    };
    const Noise sd =
        deviations_of(edge.prediction_covariance(schema.displacements(mid_range(schema.signals))));
    return {{"edge", edge_name(edge.from, edge.to)},
            {"kind", edge.kind()},
            {"signals", names_of(schema, edge.signals())},
            {"numbers",
             {millimetres(edge.position_rms_m), turned(edge.rotation_rms_rad),
              millimetres(sd.position_m), turned(sd.rotation_rad), std::to_string(edge.num_samples),
              std::to_string(edge.num_outliers)}},
            {"health", health},
            {"distance", distance}};
  }

  Json held_out() {
    if (held_out_.empty()) return nullptr;
    Json rows = Json::array();
    for (std::size_t i = 0; i < errors_.parts.size(); ++i) rows.push_back(errors_row(i));
    return {{"curve", curve()},
            {"errors", table(std::move(rows))},
            {"judge", has_truth() ? "the simulator’s noise-free truth" : "what the camera saw"},
            {"as_seen", as_seen()},
            {"scale",
             errors_.alignment ? Json(fmt::format("{:.4f}", errors_.alignment->scale)) : Json()}};
  }

  /// Versions of the schema over the run.
  Json curve() {
    const auto all = record_.watch().held_out();
    const std::vector<BodyMark> marks = body_marks(record_);
    const auto versions = version_errors(record_.versions(), all, marks, report_.end_effector);
    const auto drawn = version_plot(versions, marks);
    if (!drawn) return nullptr;
    Json json = {{"plot", plot(*drawn)},
                 {"num_shown", versions.size()},
                 {"num_versions", record_.num_versions()},
                 {"samples", counted(std::ssize(all), "held-out sample")},
                 {"against", has_truth() ? "true" : "seen"},
                 {"marks", nullptr}};
    if (marks.empty()) return json;
    json["marks"] =
        record_.faults().empty() ? "as the monitor found it" : "the simulation’s ground truth";
    json["has_drifted"] = false;
    for (const RunRecord::FaultChange& change : record_.faults())
      for (const std::string& fault : change.faults)
        if (fault.starts_with("drift")) json["has_drifted"] = true;
    return json;
  }

  Json errors_row(std::size_t i) const {
    const PartErrors& part = errors_.parts[i];
    std::vector<std::string> numbers(errors_.alignment ? 8 : 6, "–");
    if (part.count == 0) {
      numbers[0] = "0";
    } else {
      const auto turned = [&](double rad) {
        return part.has_rotation ? degrees(rad) : std::string("–");
      };
      numbers = {std::to_string(part.count),       millimetres(part.position_median_m),
                 turned(part.rotation_median_rad), millimetres(part.position_rms_m),
                 turned(part.rotation_rms_rad),    millimetres(part.position_max_m)};
      if (errors_.alignment) {
        numbers.push_back(millimetres(errors_.aligned_parts[i].position_median_m));
        numbers.push_back(turned(errors_.aligned_parts[i].rotation_median_rad));
      }
    }
    return {{"part", fmt::format("{}{}", part.part,
                                 part.part == report_.end_effector ? ", end effector" : "")},
            {"numbers", numbers}};
  }

  Json local_models() {
    if (!body_) return nullptr;
    const BodySchema& schema = body_->schema;
    Json figures = Json::array();
    for (const Edge& edge : schema.edges) {
      for (const int signal : edge.signals()) {
        const Signal& limits = schema.signals.at(static_cast<std::size_t>(signal));
        if (!(limits.upper > limits.lower)) continue;
        const EdgeSlice slice = edge_slice(schema, edge, signal, record_.watch().samples());
        const EdgePlot drawn = edge_plot(schema, slice);
        std::string caption = fmt::format("{} → {} against {}", edge.from, edge.to, limits.name);
        if (const std::size_t num_signals = edge.signals().size(); num_signals > 1)
          caption +=
              fmt::format(", {}, observations carried there",
                          num_signals == 2 ? "the other signal in the middle of its range"
                                           : "the other signals in the middle of their ranges");
        if (std::isfinite(slice.coverage))
          caption += fmt::format("; {:.0f} % of {} lie within the band", slice.coverage * 100,
                                 counted(std::ssize(slice.observations), "observation"));
        if (drawn.num_beyond > 0) caption += fmt::format("; {} beyond the axes", drawn.num_beyond);
        if (drawn.num_left_out > 0) caption += fmt::format("; {} not drawn", drawn.num_left_out);
        figures.push_back({{"plot", plot(drawn.plot)}, {"caption", caption}});
      }
    }
    return figures.empty() ? Json() : Json{{"figures", figures}};
  }

  Json visibility() const {
    if (!body_) return nullptr;
    std::map<int, double> shares = record_.watch().visibility();
    for (const UnconnectedPart& part : body_->schema.unconnected) shares.try_emplace(part.part, 0);
    if (shares.empty()) return nullptr;
    std::vector<int> parts;
    for (const auto& [part, share] : shares) parts.push_back(part);
    const std::string text = listed(shares, [](const auto& seen) {
      return fmt::format("part {} in {:.0f} %", seen.first, seen.second * 100);
    });
    return {{"strips", visibility_svg(body_->schema.signals, record_.watch().samples(), parts)},
            {"shares", text}};
  }

  Json processes() {
    Json json = processes_data(record_);
    if (json.is_null()) return json;
    const char* const captions[] = {"Processor time, of one core.", "Memory in use."};
    for (const Plot& load : load_plots(record_.processes())) {
      const char* caption = captions[json["loads"].size()];
      json["loads"].push_back({{"plot", plot(load)}, {"caption", caption}});
    }
    return json;
  }

  const Report& report_;
  const RunRecord& record_;
  const std::optional<Body> body_;
  std::vector<ActionPoseSample> held_out_;
  JudgedErrors errors_;
  std::vector<Plot> plots_;
};

}  // namespace

std::string report_page(const Report& report, std::string* problem) {
  return Page(report).html(problem);
}

}  // namespace bodyschema
