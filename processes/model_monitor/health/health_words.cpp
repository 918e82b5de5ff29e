#include "processes/model_monitor/health/health_words.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <string_view>

#include "common/geometry/angle.h"
#include "common/text/text.h"

namespace bodyschema {
namespace {

/// With a true minus sign.
std::string number(double value, int decimals) {
  char text[64];
  std::snprintf(text, sizeof text, "%.*f", decimals, std::abs(value));
  const bool is_zero = std::string(text).find_first_of("123456789") == std::string::npos;
  return (value < 0 && !is_zero ? "−" : "") + std::string(text);
}

/// "57.1 ± 0.3 mm": as many decimals as the standard deviation tells, two where it is not known.
std::string measured(double value, double sd, const std::string& unit) {
  const double log_sd = sd > 0 ? std::floor(std::log10(sd)) : -2;
  const int decimals = std::clamp(-static_cast<int>(log_sd), 0, 4);
  return number(value, decimals) + (sd > 0 ? " ± " + number(sd, decimals) : "") + unit;
}

std::string text_of(const ChangeSize& size) {
  if (size.amounts.size() == 1) return measured(size.amounts[0], size.sds[0], "");
  return measured(size.amounts[0] * 1e3, size.sds[0] < 0 ? -1 : size.sds[0] * 1e3, " mm") + ", " +
         measured(size.amounts[1] / kDegree, size.sds[1] < 0 ? -1 : size.sds[1] / kDegree, "°");
}

/// A cause in words: `sized` where the size is of that kind.
struct Words {
  std::string_view cause;
  bool is_of_edge;
  ChangeSize::Kind kind;
  std::string_view text, sized;
};
using enum ChangeSize::Kind;
constexpr Words kWords[] = {
    {"marker_missing", false, kUnknown, "{place} not seen", ""},
    {"marker_moved", false, kPose, "{place} moved", "{place} moved by {size}"},
    {"camera_moved", false, kPose, "{place} moved", "{place} moved by {size}"},
    {"joint_stuck", true, kCommand, "{joint} stuck", "{joint} stuck at {size}"},
    {"joint_offset", true, kCommand, "{joint} off", "{joint} off by {size}"},
    {"joint_gain", true, kFactor, "{joint} goes another way", "{joint} goes {size} times as far"},
    {"other_signal", true, kUnknown, "{place} moved by {signal}", ""},
    {"rigid", true, kPose, "{place} rigid", "{place} rigid, other by {size}"},
    {"joint_nonlinear", true, kUnknown, "{place} moves along another curve", ""},
    {"new_model", true, kUnknown, "{place} learned anew", ""},
    {"geometry", true, kPose, "{place} bent or exchanged{behind}",
     "{place} bent or exchanged{behind} by {size}"},
    {"intermittent", true, kPose, "{place} comes and goes", "{place} comes and goes by {size}"},
    {"drift", true, kRate, "{place} drifts{behind}", "{place} drifts{behind} by {size} a sample"},
};

/// The tag, marker, camera or edge that an event or a finding is about.
template <class Told>
std::string place_of(const Told& told) {
  const std::string part = told.part >= 0 ? " of part " + std::to_string(told.part) : "";
  if (told.tag >= 0) return "tag " + std::to_string(told.tag) + part;
  if (told.cause == "camera_moved") return "camera";
  if (told.from < 0) return "marker" + part;
  return std::to_string(told.from) + "→" + std::to_string(told.to);
}

/// What is wrong there, and by how much.
template <class Told>
std::string what(const Told& told, const std::vector<Signal>& signals) {
  const std::string place = place_of(told);
  if (told.tag >= 0) {
    const bool is_on_part = told.cause == "marker_moved";
    return place + (is_on_part ? " elsewhere on it" : " not where it was, or lost");
  }
  const auto words = std::ranges::find_if(kWords, [&told](const Words& w) {
    return w.cause == told.cause && w.is_of_edge == (told.from >= 0);
  });
  if (words == std::end(kWords)) return place + " not as known";
  const ChangeSize& size = told.size;
  const bool is_sized = size.kind != kUnknown && size.kind == words->kind;
  std::string signal;
  if (size.signal >= 0 && size.signal < std::ssize(signals))
    signal = signals[static_cast<std::size_t>(size.signal)].name;
  std::string text(is_sized ? words->sized : words->text);
  const auto fill = [&text](std::string_view name, const std::string& value) {
    if (const std::size_t at = text.find(name); at != std::string::npos)
      text.replace(at, name.size(), value);
  };
  fill("{place}", place);
  fill("{joint}", signal.empty() ? place : signal + " (" + place + ")");
  fill("{behind}", signal.empty() ? "" : " behind " + signal);
  fill("{signal}", signal.empty() ? "another signal" : signal);
  if (is_sized) fill("{size}", text_of(size));
  return text;
}

std::string since_text(std::int64_t since) {
  return since >= 0 ? " since sample " + std::to_string(since) : "";
}

}  // namespace

std::string text_of(const AdaptationEvent& event, const std::vector<Signal>& signals) {
  using Kind = AdaptationEvent::Kind;
  std::string evidence;
  if (event.num_samples > 0) evidence += " after " + counted(event.num_samples, "sample");
  if (event.margin > 0) evidence += ", by " + number(event.margin, 1) + " nats";
  const bool is_back = event.is_normal || event.tag >= 0;
  const std::string place = place_of(event);
  const std::string subject = what(event, signals) + since_text(event.since);
  switch (event.kind) {
    case Kind::kMismatch:
    case Kind::kMissing:
      return (place == "camera" ? "camera not as known" + since_text(event.since) : subject) +
             ": found" + evidence;
    case Kind::kDrift:
      return subject + ": found";
    case Kind::kCandidate:
      if (event.tag >= 0) return subject + ": found" + evidence;
      return subject + ": adopted" + evidence;
    case Kind::kRefined:
      if (!event.is_normal) return subject + ": adopted instead" + evidence;
      [[fallthrough]];
    case Kind::kRestored:
      return place + (is_back ? ": back to normal" : ": as once before, adopted again") +
             since_text(event.since) + evidence;
    case Kind::kReverted:
      return what(event, signals) + ": undone";
    case Kind::kRecovered:
      if (event.cause == "unexplained") return place + ": back to normal by itself, unexplained";
      if (event.cause == "drift") return place + ": drifts no more, confirmed";
      if (event.cause == "intermittent") return place + ": comes and goes no more";
      if (event.cause == "marker_missing" || event.tag >= 0)
        return place + " is " + (event.tag >= 0 ? "where it was" : "seen") +
               " again: back to normal";
      return (event.is_normal || event.cause == "stored"
                  ? place + (event.is_normal ? " normal" : " as once before") +
                        since_text(event.since)
                  : subject) +
             ": confirmed by " + counted(event.num_samples, "sample");
    case Kind::kProbeWanted:
      return place + ": " + event.cause +
             (event.other_cause.empty() ? "" : " or " + event.other_cause) +
             "? A probe is asked for";
  }
  return "";
}

std::string text_of(const Finding& finding, const std::vector<Signal>& signals) {
  const bool is_camera_open =
      finding.state == Finding::State::kFound && finding.cause == "camera_moved";
  std::string text =
      (is_camera_open ? std::string("camera not as known") : what(finding, signals)) +
      since_text(finding.since);
  const std::string adopted = ", in the schema since " + std::to_string(finding.adopted);
  switch (finding.state) {
    case Finding::State::kFound:
      return text + ", found at " + std::to_string(finding.found) + ", not explained yet";
    case Finding::State::kAdopted:
      return text + adopted + ", not confirmed yet (" + counted(finding.num_confirming, "sample") +
             ")";
    case Finding::State::kConfirmed:
      return text + adopted + ", confirmed by " + counted(finding.num_confirming, "sample");
    case Finding::State::kFollowed:
      return text + ", followed";
    case Finding::State::kAside:
      return text + ", found at " + std::to_string(finding.found) + ", left out until it is back";
  }
  return text;
}

}  // namespace bodyschema
