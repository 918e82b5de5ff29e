#include "processes/model_monitor/health/findings.h"

#include <algorithm>

#include "processes/model_monitor/hypotheses/schema_difference.h"

namespace bodyschema {
namespace {

using State = Finding::State;
using Kind = AdaptationEvent::Kind;

ElementId element_of(const Finding& finding, const BodySchema& schema) {
  if (finding.from >= 0) return edge_element(finding.to, schema.root);
  return finding.part == schema.root ? edge_element(finding.part, schema.root)
                                     : tag_element(finding.part);
}

/// All that predicts there is as it was, to the bit.
bool is_as_at_first(const Finding& finding, const BodySchema& schema, const BodySchema& first) {
  if (finding.from >= 0) return !differ_at(schema, first, finding.to);
  return !differ_at(schema, first, finding.part) &&
         std::ranges::none_of(schema.edges, [&](const Edge& edge) {
           return edge.from == finding.part && differ_at(schema, first, edge.to);
         });
}

EdgeState state_at(const Adaptation& adaptation, const Finding& finding) {
  const auto worse = [](EdgeState a, EdgeState b) {
    return a == EdgeState::kInvalid || b == EdgeState::kOk ? a : b;
  };
  if (finding.from >= 0) return adaptation.edge_state(finding.to);
  const EdgeState marker = adaptation.marker_state(finding.part);
  return finding.part == adaptation.schema().root
             ? worse(marker, adaptation.edge_state(finding.part))
             : marker;
}

Finding finding_of(const AdaptationEvent& event) {
  Finding finding;
  finding.from = event.from;
  finding.to = event.to;
  finding.part = event.part;
  finding.tag = event.tag;
  finding.cause = event.cause;
  finding.size = event.size;
  finding.found = event.sample_index;
  finding.since = event.since >= 0 ? event.since : event.sample_index;
  return finding;
}

/// Cause and size of what no event tells.
void tell_difference(const Adaptation& adaptation, Finding* finding) {
  const FoundDifference difference = difference_at(
      adaptation.history().front(), adaptation.schema(), element_of(*finding, adaptation.schema()));
  finding->cause = difference.cause;
  finding->size = difference.size;
}

}  // namespace

Finding* Findings::newest(const AdaptationEvent& event, State state) {
  const auto it = std::find_if(findings_.rbegin(), findings_.rend(), [&](const Finding& finding) {
    return finding.state == state && finding.is_at(event);
  });
  return it == findings_.rend() ? nullptr : &*it;
}

void Findings::update(const Adaptation& adaptation, const std::vector<AdaptationEvent>& events,
                      std::int64_t sample_index) {
  for (Finding& finding : findings_)
    finding.num_confirming +=
        finding.state == State::kConfirmed && state_at(adaptation, finding) == EdgeState::kOk;
  for (const AdaptationEvent& event : events) hear(adaptation, event);
  agree_with(adaptation, sample_index);
  if (findings_.size() > kMost)
    findings_.erase(findings_.begin(), findings_.end() - static_cast<std::ptrdiff_t>(kMost));
}

void Findings::forget(const AdaptationEvent& event, State state) {
  std::erase_if(findings_,
                [&](const Finding& known) { return known.state == state && known.is_at(event); });
}

void Findings::adopt(const AdaptationEvent& event, Finding finding) {
  if (const Finding* found = newest(event, State::kFound)) finding.found = found->found;
  forget(event, State::kFound);
  finding.state = State::kAdopted;
  finding.adopted = event.sample_index;
  Finding* adopted = newest(event, State::kAdopted);
  if (!adopted) {
    findings_.push_back(finding);
    return;
  }
  finding.found = adopted->found;
  finding.adopted = adopted->adopted;
  *adopted = finding;
}

void Findings::confirm(const Adaptation& adaptation, const AdaptationEvent& event) {
  if (Finding* followed = newest(event, State::kFollowed)) {
    followed->state = State::kConfirmed;
    tell_difference(adaptation, followed);
    followed->adopted = event.sample_index;
    followed->num_confirming = event.num_samples;
  } else if (Finding* adopted = newest(event, State::kAdopted)) {
    adopted->state = State::kConfirmed;
    adopted->num_confirming = event.num_samples;
    if (event.size.kind != ChangeSize::Kind::kUnknown) adopted->size = event.size;
  }
}

void Findings::hear(const Adaptation& adaptation, const AdaptationEvent& event) {
  Finding finding = finding_of(event);
  const bool is_aside = event.tag >= 0 || event.cause == "marker_missing";
  // Some other form may turn out to be a body of before.
  const bool is_restored =
      event.kind == Kind::kRefined && (event.is_normal || event.cause == "stored");
  switch (is_restored ? Kind::kRestored : event.kind) {
    case Kind::kMismatch:
      forget(event, State::kFound);
      findings_.push_back(finding);
      break;
    case Kind::kMissing:
    case Kind::kCandidate:
    case Kind::kRefined:
      if (is_aside) {
        forget(event, State::kAside);
        finding.state = State::kAside;
        findings_.push_back(finding);
      } else {
        adopt(event, finding);
      }
      break;
    case Kind::kRestored:
      std::erase_if(findings_, [&](const Finding& known) { return known.is_at(event); });
      if (is_aside || event.is_normal) break;
      // Another body of before: what that was is not in the event.
      tell_difference(adaptation, &finding);
      finding.state = State::kAdopted;
      finding.adopted = event.sample_index;
      findings_.push_back(finding);
      break;
    case Kind::kReverted:
      if (const Finding* adopted = newest(event, State::kAdopted))
        findings_.erase(findings_.begin() + (adopted - findings_.data()));
      break;
    case Kind::kDrift:
      finding.state = State::kFollowed;
      findings_.push_back(finding);
      break;
    case Kind::kRecovered:
      if (is_aside)
        forget(event, State::kAside);
      else
        confirm(adaptation, event);
      break;
    case Kind::kProbeWanted:
      break;
  }
}

void Findings::agree_with(const Adaptation& adaptation, std::int64_t sample_index) {
  const BodySchema& schema = adaptation.schema();
  const BodySchema& first = adaptation.history().front();
  const std::vector<int> missing = adaptation.missing_parts();
  std::erase_if(findings_, [&](const Finding& finding) {
    switch (finding.state) {
      case State::kFound:
        return state_at(adaptation, finding) != EdgeState::kInvalid;
      case State::kAside:
        if (finding.tag < 0) return std::ranges::find(missing, finding.part) == missing.end();
        return std::ranges::none_of(schema.moved_tags, [&](const MovedTag& moved) {
          return moved.tag == finding.tag && moved.until < 0;
        });
      case State::kFollowed:
        return !adaptation.is_followed(finding.to >= 0 ? finding.to : finding.part);
      default:
        return is_as_at_first(finding, schema, first);
    }
  });
  for (Finding& finding : findings_) {
    if (finding.state != State::kAdopted) continue;
    finding.num_confirming = static_cast<int>(sample_index - finding.adopted);
    // Another change came while it was young; it is kept as it is.
    if (adaptation.is_settled() && state_at(adaptation, finding) == EdgeState::kOk)
      finding.state = State::kConfirmed;
  }
  // Known to be wrong, though not where: an event comes once that is clear.
  const auto add = [&](Finding finding) {
    finding.since = finding.found = sample_index;
    const bool is_known = std::ranges::any_of(findings_, [&](const Finding& known) {
      return known.state == State::kFound && known.from == finding.from && known.to == finding.to &&
             known.part == finding.part;
    });
    if (!is_known && state_at(adaptation, finding) == EdgeState::kInvalid)
      findings_.push_back(finding);
  };
  for (const Edge& edge : schema.edges) add({.from = edge.from, .to = edge.to});
  for (const int part : schema.parts) add({.part = part});
  for (const MovedTag& moved : schema.moved_tags) {
    const auto is_it = [&](const Finding& known) { return known.tag == moved.tag; };
    if (moved.until >= 0 || std::ranges::any_of(findings_, is_it)) continue;
    // Of a schema whose findings were lost.
    findings_.push_back({.state = State::kAside,
                         .tag = moved.tag,
                         .cause = "marker_missing",
                         .since = moved.since,
                         .found = moved.found});
  }
}

}  // namespace bodyschema
