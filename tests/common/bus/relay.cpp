// relay: SAMPLE, MOTION_STATUS -> MOTION_STATUS
// The smallest process, for tests of the common part of every process: passes MOTION_STATUS on,
// answers each SAMPLE with a MOTION_STATUS, and reports its progress on stdout.

#include <cstdio>
#include <memory>
#include <stdexcept>

#include "common/bus/process.h"

int main(int argc, char** argv) {
  using namespace bodyschema;
  bool fails = false;
  bool fails_at_end = false;
  bool tells_ticks = false;
  bool only_answers = false;
  const auto body = [&](Process& process) {
    std::int64_t num_ticks = 0;
    if (!only_answers)
      process.bus().subscribe(kMotionStatus, [&](const motion_status_t& status) {
        if (fails) throw std::runtime_error("the handler\nfailed");
        process.set_activity(process_info_t::PHASE_WORKING, "relays");
        process.count("relayed");
        process.bus().publish(kMotionStatus, status);
      });
    process.bus().subscribe(kSample, [&](const sample_t& sample) {
      motion_status_t status{};
      status.utime = sample.utime;
      status.epoch = process.epoch();
      status.action_id = sample.action_id;
      process.bus().publish(kMotionStatus, status);
    });
    process.on_tick([&](std::int64_t now_us) {
      if (tells_ticks) {
        std::printf("tick %lld\n", static_cast<long long>(now_us));
        std::fflush(stdout);
      }
      if (++num_ticks > 1) return;
      std::puts("ready");
      std::fflush(stdout);
    });
    process.on_end([&] {
      std::puts("first end");
      if (fails_at_end) throw std::runtime_error("the end failed");
    });
    process.on_end([] { std::puts("second end"); });
    process.run();
    std::puts("ended");
  };
  return run_process("relay", argc, argv, body, [&](Arguments app) {
    app.add_flag("--fail", fails, "throw in a handler");
    app.add_flag("--fail-at-end", fails_at_end, "throw in the first end handler");
    app.add_flag("--only-answer", only_answers, "pass no MOTION_STATUS on");
    app.add_flag("--ticks", tells_ticks, "print the time of every tick");
  });
}
