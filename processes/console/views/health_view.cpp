#include "processes/console/views/health_view.h"

#include <fmt/format.h>

#include <algorithm>

#include "bodyschema/schema_edge_t.hpp"
#include "common/bus/cause_names.h"
#include "common/geometry/angle.h"
#include "processes/console/hint.h"
#include "processes/console/names.h"

namespace bodyschema {
namespace {

/// `are_sds`: −1 is not known. A joint may well stand at −1.
Json amounts_json(std::int8_t kind, const std::vector<double>& amounts, bool are_sds) {
  const auto amount = [&](std::size_t i, double unit = 1) {
    return are_sds && amounts.at(i) == -1 ? Json() : Json(amounts.at(i) * unit);
  };
  const bool is_rate = kind == change_size_t::SIZE_RATE;
  if (kind == change_size_t::SIZE_COMMAND) return {{"command", amount(0)}};
  if (kind == change_size_t::SIZE_FACTOR) return {{"factor", amount(0)}};
  if (kind == change_size_t::SIZE_UNKNOWN) return nullptr;
  return {{is_rate ? "position_m_per_sample" : "position_m", amount(0)},
          {is_rate ? "rotation_deg_per_sample" : "rotation_deg", amount(1, 1 / kDegree)}};
}

/// What an event and a finding both tell of a change, after their own `first` keys.
Json change_json(Json first, int from, int to, int part, int tag, const std::string& cause,
                 const change_size_t& size, std::int64_t since,
                 const std::vector<std::string>& signals) {
  const bool has_signal = size.size_signal >= 0 && size.size_signal < std::ssize(signals);
  first.update({{"from", known(from)},
                {"to", known(to)},
                {"part", known(part)},
                {"tag", known(tag)},
                {"cause", cause},
                {"signal", has_signal ? Json(signals.at(size.size_signal)) : Json()},
                {"amount", amounts_json(size.size_kind, size.amount, false)},
                {"amount_sd", amounts_json(size.size_kind, size.amount_sd, true)},
                {"since", known(since)}});
  return first;
}

}  // namespace

Json event_json(const health_event_t& event, const std::vector<std::string>& signals) {
  Json json = change_json({{"number", event.event_number},
                           {"sample", event.event_sample},
                           {"event", name_in(kHealthEvents, event.event_kind)}},
                          event.event_from, event.event_to, event.event_part, event.event_tag,
                          cause_text(event.event_cause, event.event_other_cause), event.event_size,
                          event.event_since, signals);
  json["margin"] = event.event_margin;
  json["samples_used"] = event.samples_used;
  json["text"] = event.event_text;
  return json;
}

Json finding_json(const finding_t& finding, const std::vector<std::string>& signals) {
  Json json = change_json({{"state", name_in(kFindingStates, finding.finding_state)}},
                          finding.finding_from, finding.finding_to, finding.finding_part,
                          finding.finding_tag, cause_text(finding.finding_cause),
                          finding.finding_size, finding.finding_since, signals);
  json["found"] = finding.finding_found;
  json["adopted"] = known(finding.finding_adopted);
  json["confirming"] = finding.num_confirming;
  json["text"] = finding.finding_text;
  return json;
}

const edge_health_t* health_of(const std::optional<model_health_t>& health, int from, int to) {
  if (!health) return nullptr;
  const auto found = std::ranges::find_if(health->edge_health, [&](const auto& edge) {
    return edge.health_from == from && edge.health_to == to;
  });
  return found == health->edge_health.end() ? nullptr : &*found;
}

BodyVerdict verdict_of(const model_health_t& health) {
  BodyVerdict verdict;
  int num_open = 0;
  for (const finding_t& finding : health.findings) {
    verdict.wrong.push_back(finding.finding_text);
    num_open += finding.finding_state == finding_t::FINDING_FOUND;
  }
  verdict.is_schema_wrong = num_open > 0;
  if (num_open > 0) {
    verdict.sentence =
        fmt::format("The body is not as the schema says in {}.", counted(num_open, "place"));
  } else if (!verdict.wrong.empty()) {
    verdict.sentence = fmt::format("The body is not as it was in {}, and the schema knows.",
                                   counted(std::ssize(verdict.wrong), "place"));
  } else {
    std::vector<edge_health_t> doubted = health.edge_health;
    std::erase_if(doubted, [](const edge_health_t& edge) {
      return edge.edge_state != schema_edge_t::EDGE_SUSPECT &&
             edge.edge_state != schema_edge_t::EDGE_INVALID;
    });
    verdict.is_in_doubt = !doubted.empty();
    verdict.sentence = "Nothing is known to be wrong with the body";
    if (verdict.is_in_doubt)
      verdict.sentence += "; in doubt: " + listed(doubted, [](const edge_health_t& edge) {
                            return fmt::format("{}→{}", edge.health_from, edge.health_to);
                          });
    verdict.sentence += ".";
  }
  return verdict;
}

}  // namespace bodyschema
