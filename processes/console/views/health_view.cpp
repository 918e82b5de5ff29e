#include "processes/console/views/health_view.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <cmath>

#include "common/bus/cause_names.h"
#include "common/geometry/angle.h"
#include "processes/console/names.h"

namespace bodyschema {
namespace {

using nlohmann::ordered_json;

ordered_json id(std::int32_t part) { return part < 0 ? ordered_json() : ordered_json(part); }

/// `are_sds`: −1 is not known. A joint may well stand at −1.
ordered_json amounts_json(std::int8_t kind, const std::vector<double>& amounts, bool are_sds) {
  const auto known = [&](std::size_t i, double unit = 1) {
    return are_sds && amounts.at(i) == -1 ? ordered_json() : ordered_json(amounts.at(i) * unit);
  };
  const bool is_rate = kind == change_size_t::SIZE_RATE;
  if (kind == change_size_t::SIZE_COMMAND) return {{"command", known(0)}};
  if (kind == change_size_t::SIZE_FACTOR) return {{"factor", known(0)}};
  if (kind == change_size_t::SIZE_UNKNOWN) return nullptr;
  return {{is_rate ? "position_m_per_sample" : "position_m", known(0)},
          {is_rate ? "rotation_deg_per_sample" : "rotation_deg", known(1, 1 / kDegree)}};
}

}  // namespace

void add_size(const change_size_t& size, std::int64_t since,
              const std::vector<std::string>& signals, ordered_json* json) {
  const bool has_signal = size.size_signal >= 0 && size.size_signal < std::ssize(signals);
  (*json)["signal"] = has_signal ? ordered_json(signals[static_cast<std::size_t>(size.size_signal)])
                                 : ordered_json();
  (*json)["amount"] = amounts_json(size.size_kind, size.amount, false);
  (*json)["amount_sd"] = amounts_json(size.size_kind, size.amount_sd, true);
  (*json)["since"] = since < 0 ? ordered_json() : ordered_json(since);
}

ordered_json event_json(const health_event_t& event, const std::vector<std::string>& signals) {
  ordered_json json = {{"number", event.event_number},
                       {"sample", event.event_sample},
                       {"event", name_in(kHealthEvents, event.event_kind)},
                       {"from", id(event.event_from)},
                       {"to", id(event.event_to)},
                       {"part", id(event.event_part)},
                       {"tag", id(event.event_tag)},
                       {"cause", cause_text(event.event_cause, event.event_other_cause)}};
  add_size(event.event_size, event.event_since, signals, &json);
  json["margin"] = event.event_margin;
  json["samples_used"] = event.samples_used;
  json["text"] = event.event_text;
  return json;
}

ordered_json finding_json(const finding_t& finding, const std::vector<std::string>& signals) {
  ordered_json json = {{"state", name_in(kFindingStates, finding.finding_state)},
                       {"from", id(finding.finding_from)},
                       {"to", id(finding.finding_to)},
                       {"part", id(finding.finding_part)},
                       {"tag", id(finding.finding_tag)},
                       {"cause", cause_text(finding.finding_cause)}};
  add_size(finding.finding_size, finding.finding_since, signals, &json);
  json["found"] = finding.finding_found;
  json["adopted"] =
      finding.finding_adopted < 0 ? ordered_json() : ordered_json(finding.finding_adopted);
  json["confirming"] = finding.num_confirming;
  json["text"] = finding.finding_text;
  return json;
}

BodyVerdict verdict_of(const model_health_t& health) {
  const std::vector<finding_t>& findings = health.findings;
  BodyVerdict verdict;
  int num_open = 0;
  for (const finding_t& finding : findings) {
    verdict.wrong.push_back(finding.finding_text);
    num_open += finding.finding_state == finding_t::FINDING_FOUND;
  }
  verdict.is_schema_wrong = num_open > 0;
  const auto places = [](std::ptrdiff_t num) {
    return fmt::format("{} place{}", num, num == 1 ? "" : "s");
  };
  if (findings.empty()) {
    std::vector<std::string> doubted;
    for (const edge_health_t& edge : health.edge_health)
      if (edge.edge_state == schema_edge_t::EDGE_SUSPECT ||
          edge.edge_state == schema_edge_t::EDGE_INVALID)
        doubted.push_back(fmt::format("{}→{}", edge.health_from, edge.health_to));
    verdict.is_in_doubt = !doubted.empty();
    verdict.sentence =
        doubted.empty() ? "Nothing is known to be wrong with the body."
                        : fmt::format("Nothing is known to be wrong with the body; in doubt: {}.",
                                      fmt::join(doubted, ", "));
  } else if (num_open > 0)
    verdict.sentence = fmt::format("The body is not as the schema says in {}.", places(num_open));
  else
    verdict.sentence = fmt::format("The body is not as it was in {}, and the schema knows.",
                                   places(std::ssize(findings)));
  return verdict;
}

}  // namespace bodyschema
