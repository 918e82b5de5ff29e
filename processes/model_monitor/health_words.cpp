#include "processes/model_monitor/health_words.h"

#include <algorithm>
#include <cmath>
#include <cstdio>

#include "common/geometry/angle.h"

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

std::string distance_and_angle(const ChangeSize& size) {
  return measured(size.amounts[0] * 1e3, size.sds[0] < 0 ? -1 : size.sds[0] * 1e3, " mm") + ", " +
         measured(size.amounts[1] / kDegree, size.sds[1] < 0 ? -1 : size.sds[1] / kDegree, "°");
}

std::string counted(int count, const char* noun) {
  return std::to_string(count) + " " + noun + (count == 1 ? "" : "s");
}

/// Of an event or a finding: what is wrong, and how much.
template <class Told>
std::string what(const Told& told, const std::vector<Signal>& signals) {
  using Kind = ChangeSize::Kind;
  const std::string edge = std::to_string(told.from) + "→" + std::to_string(told.to);
  const ChangeSize& size = told.size;
  const bool is_sized = size.kind != Kind::kUnknown;
  std::string signal;
  if (size.signal >= 0 && size.signal < std::ssize(signals))
    signal = signals[static_cast<std::size_t>(size.signal)].name;
  const std::string joint = signal.empty() ? edge : signal + " (" + edge + ")";
  const std::string by =
      size.kind == Kind::kPose ? " by " + distance_and_angle(size) : std::string();
  const std::string part = told.part >= 0 ? " of part " + std::to_string(told.part) : "";
  if (told.tag >= 0) {
    return "tag " + std::to_string(told.tag) + part +
           (told.cause == "marker_moved" ? " elsewhere on it" : " not where it was, or lost");
  }
  if (told.cause == "marker_missing") return "marker" + part + " not seen";
  if (told.cause == "marker_moved") return "marker" + part + " moved" + by;
  if (told.cause == "camera_moved") return "camera moved" + by;
  if (told.from < 0) return "marker" + part + " not as known";
  if (told.cause == "joint_stuck")
    return joint + " stuck" + (is_sized ? " at " + measured(size.amounts[0], size.sds[0], "") : "");
  if (told.cause == "joint_offset")
    return joint + " off" + (is_sized ? " by " + measured(size.amounts[0], size.sds[0], "") : "");
  if (told.cause == "joint_gain")
    return joint + " goes " +
           (is_sized ? measured(size.amounts[0], size.sds[0], "") + " times as far"
                     : "another way");
  if (told.cause == "other_signal")
    return edge + " moved by " + (signal.empty() ? "another signal" : signal);
  if (told.cause == "rigid") return edge + " rigid" + (is_sized ? ", other" + by : "");
  if (told.cause == "joint_nonlinear") return edge + " moves along another curve";
  if (told.cause == "new_model") return edge + " learned anew";
  if (told.cause == "geometry") return edge + " bent or exchanged" + by;
  if (told.cause == "drift")
    return edge + " drifts" +
           (size.kind == Kind::kRate ? " by " + distance_and_angle(size) + " a sample" : "");
  return edge + " not as known";
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
  // What it is now, not what it was.
  const auto place = [&] {
    AdaptationEvent bare = event;
    bare.cause = "";
    bare.size = {};
    std::string text = what(bare, signals);
    if (event.cause == "camera_moved") text = "camera not as known";
    if (event.tag >= 0)
      text = "tag " + std::to_string(event.tag) + " of part " + std::to_string(event.part);
    const std::size_t end = text.find(" not as known");
    return text.substr(0, end);
  };
  const std::string subject = what(event, signals) + since_text(event.since);
  switch (event.kind) {
    case Kind::kMismatch:
    case Kind::kMissing:
      return (event.cause == "camera_moved" ? "camera not as known" + since_text(event.since)
                                            : subject) +
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
      return place() + (is_back ? ": back to normal" : ": as once before, adopted again") +
             since_text(event.since) + evidence;
    case Kind::kReverted:
      return what(event, signals) + ": undone";
    case Kind::kRecovered:
      if (event.cause == "unexplained") return place() + ": back to normal by itself, unexplained";
      if (event.cause == "drift") return place() + ": drifts no more, confirmed";
      if (event.cause == "marker_missing" || event.tag >= 0)
        return place() + " is " + (event.tag >= 0 ? "where it was" : "seen") +
               " again: back to normal";
      return (event.is_normal || event.cause == "stored"
                  ? place() + (event.is_normal ? " normal" : " as once before") +
                        since_text(event.since)
                  : subject) +
             ": confirmed by " + counted(event.num_samples, "sample");
    case Kind::kProbeWanted:
      return place() + ": " + event.cause + "? A probe is asked for";
  }
  return "";
}

std::string text_of(const Finding& finding, const std::vector<Signal>& signals) {
  const bool is_camera_open =
      finding.state == Finding::State::kFound && finding.cause == "camera_moved";
  std::string text =
      (is_camera_open ? std::string("camera not as known") : what(finding, signals)) +
      since_text(finding.since);
  const std::string mended = ", mended at " + std::to_string(finding.adopted);
  switch (finding.state) {
    case Finding::State::kFound:
      return text + ", found at " + std::to_string(finding.found) + ", not explained yet";
    case Finding::State::kAdopted:
      return text + mended + ", not confirmed yet (" + counted(finding.num_confirming, "sample") +
             ")";
    case Finding::State::kConfirmed:
      return text + mended + ", confirmed by " + counted(finding.num_confirming, "sample");
    case Finding::State::kFollowed:
      return text + ", followed";
    case Finding::State::kAside:
      return text + ", found at " + std::to_string(finding.found) + ", left out until it is back";
  }
  return text;
}

}  // namespace bodyschema
