#include "processes/console/report_page.h"

#include <fmt/chrono.h>
#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <ctime>
#include <utility>
#include <vector>

#include "common/geometry/angle.h"
#include "common/plot/plot.h"
#include "common/schema/standard_deviations.h"
#include "processes/console/evaluation.h"
#include "processes/console/health_view.h"
#include "processes/console/hint.h"
#include "processes/console/recording.h"
#include "processes/console/report_figures.h"
#include "processes/structure_learner/learn.h"

namespace bodyschema {
namespace {

const char* const kStyle = R"(
:root{color-scheme:light dark;--ink:#1d2125;--paper:#fff;--muted:#626b75;--line:#dfe3e8;--soft:#f4f6f8;
--blue:#2d6cb0;--fill:#4a86c5;--orange:#dd8a3a;--red:#c03d3d}
@media (prefers-color-scheme:dark){:root{--ink:#dfe3e8;--paper:#15181c;--muted:#97a1ac;--line:#30363d;
--soft:#1d2126;--blue:#7fb2ea;--fill:#5b96d4;--orange:#e79a4f;--red:#e98080}}
*{box-sizing:border-box}
body{margin:0 auto;padding:3rem 1.25rem 4rem;max-width:50rem;background:var(--paper);color:var(--ink);
font:16px/1.55 system-ui,-apple-system,"Segoe UI",Roboto,"Helvetica Neue",Arial,sans-serif}
h1{font-size:1.9rem;line-height:1.2;margin:.1rem 0 .6rem;letter-spacing:-.015em}
h2{font-size:1.2rem;margin:3rem 0 .6rem;padding-top:1.1rem;border-top:1px solid var(--line)}
h3{font-size:1rem;margin:1.8rem 0 .2rem}
p{margin:.5rem 0 .8rem}
.over,.quiet,figcaption,.note{color:var(--muted);font-size:.875rem}
.over{margin:0}.lead{font-size:1.08rem}
.warn{color:var(--red)}
.wrong{border-left:4px solid var(--orange);background:var(--soft);padding:.7rem 1rem;margin:1rem 0}
.wrong.open{border-color:var(--red)}
.wrong h2{margin:0;padding:0;border:0}.wrong ul{margin:.4rem 0;padding-left:1.2rem}.wrong p{margin:.3rem 0 0}
dl.numbers{display:flex;flex-wrap:wrap;gap:1px;margin:1.4rem 0;
background:var(--line);border:1px solid var(--line);border-radius:6px;overflow:hidden}
dl.numbers div{flex:1 1 8rem;background:var(--paper);padding:.65rem .8rem}
dl.numbers dt{color:var(--muted);font-size:.8rem}
dl.numbers dd{margin:0;font-size:1.25rem;font-weight:600;font-variant-numeric:tabular-nums}
dl.numbers small{font-weight:400;font-size:.8rem;color:var(--muted);display:block}
figure{margin:1rem 0 1.2rem}
figure img,figure svg{display:block;width:100%;height:auto}
figure img{border-radius:4px}
figcaption{margin-top:.45rem}
.scroll{overflow-x:auto}
table{border-collapse:collapse;width:100%;font-size:.9rem;font-variant-numeric:tabular-nums;margin:.6rem 0 1rem}
th{text-align:left;font-weight:500;color:var(--muted);font-size:.8rem;vertical-align:bottom}
th,td{padding:.28rem .9rem .28rem 0;border-bottom:1px solid var(--line)}
td{vertical-align:top}
.n{text-align:right;white-space:nowrap}
th:last-child,td:last-child{padding-right:0}
details{border-bottom:1px solid var(--line)}
summary{padding:.45rem 0;cursor:pointer}
pre{background:var(--soft);padding:.8rem 1rem;border-radius:6px;overflow-x:auto;font-size:.8rem;line-height:1.45}
code{font-size:.9em}
svg text{font-family:inherit}
svg.plot{color:var(--ink)}
.tree path{fill:none;stroke:var(--fill);stroke-width:2.5}
.tree path.rigid{stroke:var(--muted);stroke-width:5}
.tree path.provisional{stroke-dasharray:5 4}.tree path.suspect{stroke:var(--orange)}.tree path.invalid{stroke:var(--red)}
.tree circle{fill:var(--soft);stroke:var(--ink);stroke-width:1.5}
.tree circle.root{fill:var(--ink)}.tree circle.effector{fill:var(--fill);stroke:var(--fill)}
.tree circle.lone{stroke-dasharray:3 3;stroke:var(--red)}
.tree text{fill:var(--ink);font-size:13px;text-anchor:middle}
.tree circle.root+.id{fill:var(--paper)}.tree circle.effector+.id{fill:#fff}
.tree .id{font-weight:600}.tree .small{font-size:11px}
.tree .signal{font-size:12px}.tree .role{font-size:11px;fill:var(--muted)}
.tree .reason{text-anchor:start;fill:var(--red);font-size:13px}
.visibility text{fill:var(--muted);font-size:11px}
.visibility .head{fill:var(--ink);font-size:12px;font-weight:600;text-anchor:middle}
.visibility .row{text-anchor:end;fill:var(--ink);font-size:12px}
.visibility .end{text-anchor:end}
.visibility .strip{fill:none;stroke:var(--line)}
.visibility .seen{fill:var(--fill)}
.visibility .unknown{stroke:var(--line)}
footer{margin-top:3.5rem;border-top:1px solid var(--line);padding-top:.8rem}
@media print{body{max-width:none}h2{break-after:avoid}figure,tr{break-inside:avoid}}
)";

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

/// A table; columns whose head begins with '#' hold numbers. Cells are HTML.
class Table {
 public:
  explicit Table(std::vector<std::string> heads) : heads_(std::move(heads)) {
    html_ = "<div class=\"scroll\"><table><thead><tr>";
    for (const std::string& head : heads_) {
      html_ += is_number(head) ? "<th class=\"n\">" + head.substr(1) : "<th>" + head;
      html_ += "</th>";
    }
    html_ += "</tr></thead><tbody>\n";
  }
  void row(const std::vector<std::string>& cells) {
    html_ += "<tr>";
    for (std::size_t i = 0; i < cells.size(); ++i)
      html_ += (is_number(heads_.at(i)) ? "<td class=\"n\">" : "<td>") + cells[i] + "</td>";
    html_ += "</tr>\n";
    is_empty_ = false;
  }
  std::string html() const { return is_empty_ ? "" : html_ + "</tbody></table></div>\n"; }

 private:
  static bool is_number(const std::string& head) { return head.starts_with('#'); }
  const std::vector<std::string> heads_;
  std::string html_;
  bool is_empty_ = true;
};

std::string millimetres(double m) { return fmt::format("{:.2f} mm", m * 1e3); }
std::string degrees(double rad) { return fmt::format("{:.2f}°", rad / kDegree); }

std::string figure(const std::string& content, const std::string& caption) {
  return fmt::format("<figure>{}<figcaption>{}</figcaption></figure>\n", content, caption);
}

/// The schema that the report shows, and where it comes from.
struct Body {
  BodySchema schema;
  std::string origin;
};

std::optional<Body> body_of(const RunRecord& record, const Noise& systematic) {
  if (const auto& accepted = record.watch().schema()) {
    return Body{*accepted, fmt::format("version {}, accepted by the monitor", accepted->version)};
  }
  if (const auto& proposal = record.learned()) {
    return Body{*proposal, "the learner’s newest proposal: the monitor accepted none"};
  }
  Recording recording;
  for (const ActionPoseSample& sample : record.watch().samples()) {
    // A log may hold another rig's samples too; the first one decides.
    if (recording.samples.empty() ||
        sample.action.size() == recording.samples.front().action.size())
      recording.samples.push_back(sample);
  }
  if (recording.samples.empty()) return std::nullopt;
  recording.signals = observed_signals(recording.samples);
  LearnOptions options;
  options.systematic = systematic;
  return Body{learn(recording.signals, recording.training(), options).schema,
              "learned for this report: the log holds no body schema"};
}

std::vector<ActionPoseSample> fitting(const std::vector<ActionPoseSample>& samples,
                                      const BodySchema& schema) {
  std::vector<ActionPoseSample> result;
  for (const ActionPoseSample& sample : samples) {
    if (sample.action.size() == static_cast<Eigen::Index>(schema.signals.size()))
      result.push_back(sample);
  }
  return result;
}

/// Everything of one page; `plots` are drawn together at the end and take the place of their marks.
class Page {
 public:
  explicit Page(const Report& report)
      : report_(report),
        record_(*report.record),
        body_(body_of(*report.record, report.systematic)) {
    if (body_) {
      held_out_ = fitting(
          record_.watch().held_out(body_->schema.body_since(body_->schema.last_sample_index)),
          body_->schema);
      errors_ = bodyschema::judge(
          body_->schema, held_out_,
          record_.watch().has_truth() ? held_out_ : std::vector<ActionPoseSample>());
    }
  }

  std::string html(std::string* problem) {
    std::string content = header() + flaws();
    if (record_.is_empty()) {
      content += "<p class=\"lead\">Nothing was recorded yet: no sample, no schema, no process. ";
      content += report_.reload_s ? "This page is written again as soon as there is.</p>\n"
                                  : "Is this the folder of a run, and did its group start?</p>\n";
    } else {
      content += numbers() + picture() + tree() + held_out() + local_models() + visibility() +
                 processes() + events() + messages() + configuration();
    }
    content += footer();
    std::string why;
    std::vector<std::string> drawn;
    try {
      drawn = draw_plots(plots_);
    } catch (const PlotError& error) {
      why = error.what();
    }
    for (std::size_t i = 0; i < plots_.size(); ++i) {
      const std::string mark = plot_mark(i);
      const std::string svg = i < drawn.size()
                                  ? "<svg class=\"plot\"" + drawn[i].substr(4)
                                  : "<p class=\"warn\">No plot: " + escape_html(why) + "</p>";
      content.replace(content.find(mark), mark.size(), svg);
    }
    if (problem != nullptr) *problem = why;
    return content + "</body></html>\n";
  }

 private:
  static std::string plot_mark(std::size_t index) { return fmt::format("<!--plot {}-->", index); }
  std::string plot(Plot plot) {
    plots_.push_back(std::move(plot));
    return plot_mark(plots_.size() - 1);
  }
  /// Whom the held-out errors are measured against.
  std::string judge() const {
    return record_.watch().has_truth() ? "the simulator’s noise-free truth" : "what the camera saw";
  }
  /// What the monitor can know, where the table knows better.
  std::string as_seen() const {
    if (!record_.watch().has_truth() || !record_.health() || record_.health()->worst_position_m < 0)
      return "";
    return fmt::format(
        " Progress and <code>status</code> go by what the camera sees, noise and bias of the "
        "markers included: worst part {}, {}.",
        millimetres(record_.health()->worst_position_m),
        degrees(record_.health()->worst_rotation_rad));
  }
  const PartErrors* errors_of(std::optional<int> part) const {
    for (const PartErrors& errors : errors_.parts) {
      if (errors.part == part && errors.count > 0) return &errors;
    }
    return nullptr;
  }
  const PartErrors* worst() const {
    const PartErrors* worst = nullptr;
    for (const PartErrors& errors : errors_.parts) {
      if (errors.count > 0 && (!worst || errors.position_median_m > worst->position_median_m))
        worst = &errors;
    }
    return worst;
  }

  std::string header() const {
    std::string html =
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">"
        "<meta name=\"viewport\" content=\"width=device-width,initial-scale=1\">";
    if (report_.reload_s)
      html += fmt::format("<meta http-equiv=\"refresh\" content=\"{}\">", *report_.reload_s);
    html += fmt::format("<title>{}</title><style>{}</style></head><body>\n{}",
                        escape_html(report_.title), kStyle, plot_symbols());
    html += fmt::format("<header><p class=\"over\">Body schema report{}</p><h1>{}</h1>",
                        report_.reload_s ? " · the run goes on" : "", escape_html(report_.title));
    html += wrong();
    if (body_) {
      const BodySchema& schema = body_->schema;
      html += fmt::format(
          "<p class=\"lead\">{}</p>",
          schema.complete ? fmt::format("{} {} hang together by {}, learned from {}.", headline(),
                                        counted(std::ssize(schema.parts), "part"),
                                        counted(std::ssize(schema.edges), "edge"),
                                        counted(schema.num_samples, "sample"))
                          : fmt::format("The body is not known yet: {} of {} after {}.",
                                        counted(std::ssize(schema.edges), "edge"),
                                        std::max<std::ptrdiff_t>(0, std::ssize(schema.parts) - 1),
                                        counted(schema.num_samples, "sample")));
    }
    return html + "</header>\n";
  }

  std::string headline() const {
    if (!record_.health()) return "The body is known:";
    const BodyVerdict verdict = verdict_of(*record_.health());
    return verdict.wrong.empty() && !verdict.is_in_doubt ? "The body is known:" : verdict.sentence;
  }

  std::string wrong() const {
    if (!record_.health()) return "";
    const BodyVerdict verdict = verdict_of(*record_.health());
    if (verdict.wrong.empty()) return "";
    std::string html = fmt::format("<section class=\"wrong{}\"><h2>{}</h2><ul>",
                                   verdict.is_schema_wrong ? " open" : "", kWhatIsWrong);
    for (const std::string& line : verdict.wrong) html += "<li>" + escape_html(line) + "</li>";
    html += "</ul>";
    if (!report_.reload_s && record_.watch().num_samples() > 0)
      html += fmt::format("<p class=\"quiet\">As of sample {}, the last. {}</p>",
                          record_.watch().samples().back().sample_index, kNobodyWatches);
    return html + "</section>\n";
  }

  /// What is wrong with the logs stands first: the rest may be told from half of them.
  std::string flaws() const {
    std::string html;
    for (const auto& [file, summary] : report_.logs) {
      std::string text = flaws_text(summary);
      // A file that is being written often ends in the middle of an event.
      if (report_.reload_s && summary.unreadable() == 0) continue;
      while (!text.empty()) {
        const std::size_t end = text.find('\n');
        html +=
            fmt::format("<p class=\"warn\">{}: {}.</p>\n", escape_html(file.filename().string()),
                        escape_html(text.substr(0, end)));
        text.erase(0, end + 1);
      }
    }
    return html;
  }

  std::string numbers() const {
    std::string html = "<dl class=\"numbers\">";
    const auto item = [&](const std::string& name, const std::string& value,
                          const std::string& more) {
      html += fmt::format("<div><dt>{}</dt><dd>{}<small>{}</small></dd></div>", name, value, more);
    };
    if (body_) {
      const BodySchema& schema = body_->schema;
      item("Structure", schema.complete ? "complete" : "incomplete",
           fmt::format("{} of {} edges", schema.edges.size(),
                       std::max<std::ptrdiff_t>(0, std::ssize(schema.parts) - 1)));
    }
    item("Samples", std::to_string(record_.watch().num_samples()),
         fmt::format("{} held out", held_out_.size()));
    const std::string against =
        record_.watch().has_truth() ? ", against the truth" : ", against what was seen";
    if (const PartErrors* effector = errors_of(report_.end_effector)) {
      item("End effector", millimetres(effector->position_median_m),
           degrees(effector->rotation_median_rad) + against);
    }
    if (const PartErrors* part = worst()) {
      item("Worst part", millimetres(part->position_median_m),
           fmt::format("part {}, {}{}", part->part, degrees(part->rotation_median_rad), against));
    }
    if (const auto begin = record_.begin_utime()) {
      item("Recorded", duration(record_.duration_s()),
           fmt::format("{:%Y-%m-%d %H:%M}",
                       fmt::gmtime(static_cast<std::time_t>(*begin / 1'000'000))));
    }
    return html + "</dl>\n";
  }

  std::string picture() const {
    if (!report_.picture)
      return "<p class=\"note\">No camera frame was recorded with its markers.</p>\n";
    return figure(
        "<img alt=\"A camera frame with the markers found in it\" "
        "src=\"data:image/jpeg;base64," +
            base64(*report_.picture) + "\">",
        "A frame in which many markers were found: outline, id, and axes of each (x red, y "
        "green, z blue, into the marker).");
  }

  std::string tree() const {
    std::string html = "<section><h2>The body</h2>\n";
    if (!body_) return html + "<p>No sample yet, so no body.</p></section>\n";
    const BodySchema& schema = body_->schema;
    html += figure(
        tree_svg(schema, report_.end_effector),
        fmt::format("The parts from the root outwards, and the signals that move each edge: "
                    "{}. Thick grey edges are rigid{}.",
                    body_->origin, schema.complete ? "" : "; red parts have no way to the root"));
    static const char* const kStates[] = {"OK", "suspect", "invalid", "provisional"};
    Table table({"edge", "kind", "signals", "#residual", "#", "#±", "#", "#seen in", "#outliers",
                 "health", "#median d²"});
    const Eigen::VectorXd middle = schema.displacements(mid_range(schema.signals));
    for (const Edge& edge : schema.edges) {
      std::string signals;
      for (const int signal : edge.signals()) {
        signals += (signals.empty() ? "" : ", ") +
                   escape_html(schema.signals.at(static_cast<std::size_t>(signal)).name);
      }
      std::string health = kStates[static_cast<int>(edge.state)], distance = "–";
      if (record_.health()) {
        for (const edge_health_t& item : record_.health()->edge_health) {
          if (item.health_from != edge.from || item.health_to != edge.to) continue;
          health = kStates[item.edge_state];
          if (item.edge_is_drifting == 1) health += ", drifting";
          if (item.median_mahalanobis2 >= 0)
            distance = fmt::format("{:.1f}", item.median_mahalanobis2);
        }
      }
      const Noise sd = deviations_of(edge.prediction_covariance(middle));
      table.row({fmt::format("{} → {}", edge.from, edge.to), edge.kind(), signals,
                 millimetres(edge.position_rms_m), degrees(edge.rotation_rms_rad),
                 millimetres(sd.position_m), degrees(sd.rotation_rad),
                 std::to_string(edge.num_samples), std::to_string(edge.num_outliers), health,
                 distance});
    }
    html += table.html();
    html +=
        "<p class=\"note\">Residual: root mean square, each observation predicted without itself, "
        "outliers left out. ±: standard deviation per axis of the model itself, joints in "
        "mid-range; <code>bodyschema show --json</code> has that of each axis, offset and rate. "
        "Health and d²: the monitor’s, on held-out samples, d² in units of the assumed "
        "covariance. That has the systematic error of a pose in it, which is mostly common "
        "to all samples and learned with the edge: the median of a right model is below 5.3, "
        "that of χ² with 6 degrees of freedom (0.1 to 2 of an ideal rig’s tags). Above 5.3 the "
        "edge is wrong.</p>\n";
    static const char* const kReasons[] = {"never seen", "not enough data yet", "no valid model"};
    Table lone({"not connected", "why", "detail"});
    for (const UnconnectedPart& part : schema.unconnected) {
      lone.row({fmt::format("part {}", part.part), kReasons[static_cast<int>(part.reason)],
                escape_html(part.detail)});
    }
    html += lone.html();
    const auto names = [&](const std::vector<int>& signals) {
      std::string text;
      for (const int signal : signals) {
        text += (text.empty() ? "" : ", ") +
                escape_html(schema.signals.at(static_cast<std::size_t>(signal)).name);
      }
      return text;
    };
    if (const std::string unused = names(schema.unused_signals()); !unused.empty())
      html += fmt::format("<p>Signals that no edge depends on: {}.</p>\n", unused);
    if (const std::string undecided = names(schema.undecided_signals); !undecided.empty())
      html += fmt::format("<p>Signals whose effect is not told yet: {}.</p>\n", undecided);
    return html + "</section>\n";
  }

  std::string held_out() {
    std::string html = "<section><h2>Held-out error</h2>\n";
    if (held_out_.empty())
      return html +
             "<p>No held-out sample yet of the body as it is, so nothing to judge "
             "by.</p></section>\n";
    const auto all = record_.watch().held_out();
    const std::vector<BodyMark> marks = body_marks(record_);
    const auto versions = version_errors(record_.versions(), all, marks, report_.end_effector);
    const bool has_drifted =
        std::any_of(record_.faults().begin(), record_.faults().end(), [](const auto& change) {
          return std::any_of(change.faults.begin(), change.faults.end(),
                             [](const std::string& fault) { return fault.starts_with("drift"); });
        });
    if (const auto curve = version_plot(versions, marks)) {
      html += figure(
          plot(*curve),
          fmt::format(
              "Versions of the body schema ({} of {}) on the {}, from none of which anything was "
              "ever learned: distance of the predicted from the {} origin of a part, relative to "
              "the root, median over the samples; against {}. {}A version is judged on the parts "
              "it connects, so a line may rise when a part is added.",
              versions.size(), record_.num_versions(), counted(std::ssize(all), "held-out sample"),
              record_.watch().has_truth() ? "true" : "seen", judge(),
              marks.empty()
                  ? ""
                  : fmt::format("Where the body became another (dashed; {}) a new curve begins: "
                                "every version is judged on samples of the body that it was for, "
                                "the first point is the schema that stood before. {}",
                                record_.faults().empty() ? "as the monitor found it"
                                                         : "the simulation’s ground truth",
                                has_drifted ? "While a link drifts, every sample is of another "
                                              "body: the error shows how far it drifts, not how "
                                              "well it is followed. "
                                            : "")));
    }
    std::vector<std::string> head = {"part", "#seen in", "#median", "#", "#rms", "#", "#largest"};
    if (errors_.alignment) head.insert(head.end(), {"#aligned median", "#"});
    Table table(head);
    for (std::size_t i = 0; i < errors_.parts.size(); ++i) {
      const PartErrors& part = errors_.parts[i];
      const std::string name =
          fmt::format("{}{}", part.part, part.part == report_.end_effector ? ", end effector" : "");
      if (part.count == 0) {
        std::vector<std::string> row(head.size(), "–");
        row[0] = name;
        row[1] = "0";
        table.row(row);
        continue;
      }
      std::vector<std::string> row = {name,
                                      std::to_string(part.count),
                                      millimetres(part.position_median_m),
                                      degrees(part.rotation_median_rad),
                                      millimetres(part.position_rms_m),
                                      degrees(part.rotation_rms_rad),
                                      millimetres(part.position_max_m)};
      if (errors_.alignment) {
        const PartErrors& aligned = errors_.aligned_parts[i];
        row.push_back(millimetres(aligned.position_median_m));
        row.push_back(degrees(aligned.rotation_median_rad));
      }
      table.row(row);
    }
    html += table.html();
    return html + fmt::format(
                      "<p class=\"note\">The schema above on the held-out samples, each part "
                      "relative to the root, against {}.{}{}</p></section>\n",
                      judge(), as_seen(), alignment());
  }

  std::string alignment() {
    if (!errors_.alignment) return "";
    return fmt::format(
        " Aligned to these samples: with the frames of the parts and the unit of length of the "
        "truth "
        "(scale {:.4f}), which tags that are not where the rig says displace.",
        errors_.alignment->scale);
  }

  std::string local_models() {
    if (!body_) return "";
    const BodySchema& schema = body_->schema;
    std::string html;
    for (const Edge& edge : schema.edges) {
      for (const int signal : edge.signals()) {
        const Signal& limits = schema.signals.at(static_cast<std::size_t>(signal));
        if (!(limits.upper > limits.lower)) continue;
        const EdgeSlice slice = edge_slice(schema, edge, signal, record_.watch().samples());
        const EdgePlot drawn = edge_plot(schema, slice);
        std::string caption =
            fmt::format("{} → {} against {}", edge.from, edge.to, escape_html(limits.name));
        if (edge.signals().size() > 1)
          caption += ", the other signal in the middle of its range, observations carried there";
        if (std::isfinite(slice.coverage)) {
          caption += fmt::format("; {:.0f} % of {} lie within the band", slice.coverage * 100,
                                 counted(std::ssize(slice.observations), "observation"));
        }
        if (drawn.num_beyond > 0) caption += fmt::format("; {} beyond the axes", drawn.num_beyond);
        if (drawn.num_left_out > 0) caption += fmt::format("; {} not drawn", drawn.num_left_out);
        html += figure(plot(drawn.plot), caption + ".");
      }
    }
    if (html.empty()) return "";
    return "<section><h2>Local models</h2>\n"
           "<p>The pose of the outer part in the inner one: position, and rotation vector from the "
           "middle "
           "of the range. Line: the learned model; bands: ±2σ of its parameters (dark) and of an "
           "observation (light). Dots: observations that were learned from; <span "
           "style=\"color:var(--orange)\">held out</span>.</p>\n" +
           html + "</section>\n";
  }

  std::string visibility() const {
    if (!body_) return "";
    const auto shares = record_.watch().visibility();
    std::vector<int> parts;
    Table table({"part", "#seen in"});
    for (const auto& [part, share] : shares) parts.push_back(part);
    for (const UnconnectedPart& part : body_->schema.unconnected) {
      if (!shares.contains(part.part)) parts.push_back(part.part);
    }
    std::sort(parts.begin(), parts.end());
    if (parts.empty()) return "";
    std::string text;
    for (const int part : parts) {
      const auto share = shares.find(part);
      text += fmt::format("{}part {} in {:.0f} %", text.empty() ? "" : ", ", part,
                          share == shares.end() ? 0 : share->second * 100);
    }
    return "<section><h2>Visibility</h2>\n" +
           figure(
               visibility_svg(body_->schema.signals, record_.watch().samples(), parts),
               "In how many of the samples each part was seen, over the range of each signal: full "
               "colour is always, none is never, a stroke is a place without a sample.") +
           "<p class=\"note\">Over all samples: " + text + ".</p></section>\n";
  }

  std::string processes() {
    const auto processes = record_.processes();
    const auto latencies = record_.latencies();
    if (processes.empty() && latencies.empty()) return "";
    std::string html = "<section><h2>Processes</h2>\n";
    const char* const captions[] = {"Processor time, of one core.", "Memory in use."};
    const std::vector<Plot> loads = load_plots(processes);
    for (std::size_t i = 0; i < loads.size(); ++i) html += figure(plot(loads[i]), captions[i]);
    static const char* const kPhases[] = {"starting", "waiting", "working", "done", "ended"};
    Table table({"process", "host", "#pid", "#cpu", "#", "#memory", "at the end"});
    for (const RunRecord::Process& process : processes) {
      const process_info_t& info = process.newest;
      const double age_s = static_cast<double>(info.utime - info.start_utime) * 1e-6;
      const double used_s = static_cast<double>(info.cpu_us) * 1e-6;
      table.row({escape_html(info.process_name), escape_html(info.host), std::to_string(info.pid),
                 fmt::format("{:.1f} s", used_s),
                 age_s > 0.1 ? fmt::format("{:.0f} %", 100 * used_s / age_s) : "–",
                 fmt::format("{:.0f} MB", static_cast<double>(info.resident_bytes) * 1e-6),
                 fmt::format("{}: {}", kPhases[info.phase], escape_html(info.activity))});
    }
    html += table.html();
    if (!latencies.empty()) {
      Table times({"how long it took", "#count", "#median", "#95 %", "#longest"});
      for (const RunRecord::Latency& latency : latencies) {
        const auto ms = [](double s) { return fmt::format("{:.1f} ms", s * 1e3); };
        times.row({escape_html(latency.name), std::to_string(latency.seconds.size()),
                   ms(quantile(latency.seconds, 0.5)), ms(quantile(latency.seconds, 0.95)),
                   ms(quantile(latency.seconds, 1))});
      }
      html += times.html();
      html += "<p class=\"note\">Between the first receipts of the messages by the loggers.</p>\n";
    }
    Table counters({"counted by", "what", "#count"});
    for (const RunRecord::Process& process : processes) {
      for (const counter_t& counter : process.newest.counters) {
        const std::string& name = counter.counter_name;
        if (counter.count == 0 || name.starts_with("received ") || name.starts_with("published "))
          continue;
        counters.row({escape_html(process.newest.process_name), escape_html(name),
                      std::to_string(counter.count)});
      }
    }
    const std::string counted = counters.html();
    html += counted.empty() ? "<p>No process dropped, skipped or refused anything.</p>\n" : counted;
    return html + "</section>\n";
  }

  std::string events() const {
    std::string html;
    const auto& samples = record_.watch().samples();
    // Of the arm: simulated where it is.
    const auto time = [&](std::int64_t utime) {
      if (samples.empty()) return std::string("–");
      return fmt::format("{:.1f} s", static_cast<double>(utime - samples.front().utime) * 1e-6);
    };
    Table faults({"#from sample", "#time", "broken from then on: ground truth of the simulation"});
    for (const RunRecord::FaultChange& change : record_.faults()) {
      std::string list;
      for (const std::string& fault : change.faults)
        list += (list.empty() ? "" : ", ") + escape_html(fault);
      const auto first = std::find_if(samples.begin(), samples.end(), [&](const auto& sample) {
        return sample.utime >= change.utime;
      });
      faults.row({first == samples.end() ? "–" : std::to_string(first->sample_index),
                  time(change.utime), list.empty() ? "nothing: repaired" : list});
    }
    html += faults.html();
    constexpr std::size_t kMost = 200;
    const std::vector<health_event_t> all = record_.events();
    Table table({"#sample", "#time", "what the monitor decided"});
    for (std::size_t i = all.size() - std::min(all.size(), kMost); i < all.size(); ++i) {
      table.row({std::to_string(all[i].event_sample), time(all[i].utime),
                 escape_html(all[i].event_text)});
    }
    html += table.html();
    if (all.size() > kMost)
      html += fmt::format("<p class=\"note\">The newest {} of {}.</p>\n", kMost, all.size());
    return html.empty() ? ""
                        : "<section><h2>Events</h2>\n" + html +
                              "<p class=\"note\">Times are those of the arm, from its first "
                              "sample on.</p></section>\n";
  }

  std::string messages() const {
    if (report_.logs.empty()) return "";
    std::string html = "<section><h2>Messages recorded</h2>\n";
    Table table({"log", "channel", "#messages", "#size", "#rate", "#unreadable"});
    for (const auto& [file, summary] : report_.logs) {
      for (const auto& [name, channel] : summary.channels) {
        const double s = static_cast<double>(channel.last_utime - channel.first_utime) * 1e-6;
        table.row({escape_html(file.filename().string()), escape_html(name),
                   std::to_string(channel.events),
                   fmt::format("{:.0f} kB", static_cast<double>(channel.bytes) * 1e-3),
                   s > 0 ? fmt::format("{:.1f}/s", static_cast<double>(channel.events) / s) : "–",
                   channel.is_known ? std::to_string(channel.unreadable) : "not ours"});
      }
    }
    return html + table.html() + "</section>\n";
  }

  std::string configuration() const {
    std::string html;
    std::string previous;
    for (const RunRecord::Process& process : record_.processes()) {
      const process_info_t& info = process.newest;
      if (info.process_name == previous) continue;  // the same process, started again
      previous = info.process_name;
      html += fmt::format(
          "<details><summary>{}{}</summary><pre>{}</pre></details>\n",
          escape_html(info.process_name),
          info.seed >= 0 ? fmt::format(" <span class=\"quiet\">seed {}</span>", info.seed) : "",
          escape_html(info.configuration));
    }
    return html.empty() ? "" : "<section><h2>Configuration</h2>\n" + html + "</section>\n";
  }

  std::string footer() const {
    return fmt::format(
        "<footer class=\"quiet\">Written by <code>bodyschema report</code>, version {}, {:%Y-%m-%d "
        "%H:%M:%S} "
        "UTC, from {}.</footer>\n",
        program_version(), fmt::gmtime(std::time(nullptr)),
        report_.logs.empty() ? "no log" : counted(std::ssize(report_.logs), "log"));
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
