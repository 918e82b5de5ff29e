#include "processes/driver_test/conformance.h"

#include <fmt/format.h>

#include <algorithm>
#include <optional>
#include <stdexcept>

#include "processes/driver_test/driver_probe.h"
#include "processes/driver_test/driver_rules.h"

namespace bodyschema {

ConformancePlan plan_conformance(const DriverLink& link, const ConformanceOptions& options) {
  using Status = motion_status_t;
  DriverProbe probe(link, options);
  const auto first = probe.await(0, 5, [](const Status&) { return true; });
  if (!first) {
    throw std::runtime_error(
        "no MOTION_STATUS within 5 s: does the driver run, and on this bus (--in)?");
  }
  if (first->stop_latched) {
    throw std::runtime_error("the driver is stopped: RESUME it first, once the arm is clear");
  }
  const auto rest =
      probe.await(0, options.motion_s, [](const Status& s) { return s.rest_since_utime >= 0; });
  if (!rest) {
    throw std::runtime_error(fmt::format("the arm does not come to rest within {} s; {}",
                                         options.motion_s, text_of(probe.newest())));
  }
  // HOLD moves nothing and says where the arm is.
  action_command_t hold = probe.make(action_command_t::KIND_HOLD);
  hold.epoch -= 1;
  probe.send(hold);
  const auto held = probe.await(0, options.answer_s, [&](const Status& s) {
    return is_answer(s, hold) && s.rest_since_utime >= 0;
  });
  const std::vector<Signal>& signals = options.signals.signals;
  ConformancePlan plan;
  plan.is_from_middle = !held || held->commanded.size() != signals.size();
  for (std::size_t i = 0; i < signals.size(); ++i) {
    const double range = signals[i].upper - signals[i].lower;
    const double middle = 0.5 * (signals[i].lower + signals[i].upper);
    const double here = plan.is_from_middle ? middle : held->commanded[i];
    plan.here.push_back(std::clamp(here, signals[i].lower, signals[i].upper));
    plan.there.push_back(plan.here[i] +
                         (plan.here[i] > middle ? -1 : 1) * options.step_share * range);
  }
  return plan;
}

namespace {

void test_rule(DriverRules& rules, const DriverRule& rule, RuleResult& result) {
  try {
    (rules.*rule.test)();
  } catch (const RuleBroken& broken) {
    result.outcome = RuleResult::Outcome::kFailed;
    result.note = broken.note;
  } catch (const RuleSkipped& skipped) {
    result.outcome = RuleResult::Outcome::kSkipped;
    result.note = skipped.note;
  }
}

}  // namespace

std::vector<RuleResult> test_conformance(const DriverLink& link, const ConformanceOptions& options,
                                         const ConformancePlan& plan,
                                         const std::function<void(const std::string&)>& progress) {
  using Outcome = RuleResult::Outcome;
  DriverProbe probe(link, options);
  if (!probe.await(0, 5, [](const motion_status_t&) { return true; })) {
    throw std::runtime_error("the driver fell silent before the test began");
  }
  DriverRules rules(probe, options, plan, link.restart != nullptr);
  std::vector<RuleResult> results;
  bool is_ready = true;
  int blamed = 0;
  for (const DriverRule& rule : DriverRules::all()) {
    RuleResult& result = results.emplace_back(RuleResult{rule.number, rule.name, Outcome::kOk, ""});
    if (is_ready && !probe.recover()) {
      is_ready = false;
      blamed = probe.newest().stop_latched ? 14 : rule.number;
    }
    if (!is_ready) {
      const bool is_blamed = blamed == rule.number;
      result.outcome = is_blamed ? Outcome::kFailed : Outcome::kSkipped;
      result.note =
          (is_blamed ? "expected the arm at rest after RESUME, came " : "the arm is not ready: ") +
          text_of(probe.newest());
      continue;
    }
    if (progress) progress(fmt::format("{:2} {}", rule.number, rule.name));
    test_rule(rules, rule, result);
  }
  if (is_ready) probe.recover();
  RuleResult time{3, "time never runs backwards", Outcome::kOk, ""};
  if (probe.time_ran_backwards()) {
    time.outcome = Outcome::kFailed;
    time.note = *probe.time_ran_backwards();
  }
  results.insert(results.begin() + 2, time);
  return results;
}

}  // namespace bodyschema
