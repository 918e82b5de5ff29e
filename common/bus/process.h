#pragma once

#include <cstdint>
#include <filesystem>
#include <functional>
#include <map>
#include <memory>
#include <string>

#include "common/bus/arguments.h"
#include "common/bus/bus.h"

namespace bodyschema {

/// The common part of every process: `--config FILE --in URL --out URL --log-level LEVEL`, a bus, a
/// loop that ends on SIGTERM, SIGINT or at the end of a log, PROCESS_INFO at 1 Hz, an exit code.
///
///   int main(int argc, char** argv) { return run_process<ObserverProcess>("observer", argc, argv); }
///
/// One process of a name per bus: the younger of two ends with exit code 1 and a line that names
/// the elder. At its start it publishes PROCESS_INFO and listens for 0.5 s before it publishes
/// anything else; the elder answers at once, and must be heard again within 1.2 s, with a newer
/// time. An elder that was busy then may still be heard in the first 3 s of the loop. Later no
/// process ends because of another: both report it (set_notice). Only live PROCESS_INFO counts
/// (is_live()), and only a bus that is both input and output.
///
/// `--in` is default_url() unless given. `--out` is then the same bus, but empty if the input is a
/// log: a replay must not reach a robot by accident.
class Process {
 public:
  ~Process();
  Process(const Process&) = delete;
  Process& operator=(const Process&) = delete;

  Bus& bus();
  const std::string& name() const;
  const std::filesystem::path& config_file() const;
  /// The URLs of bus(), defaults resolved.
  const std::string& in_url() const;
  const std::string& out_url() const;
  /// The folder of the configuration file: the rig.
  std::filesystem::path rig_folder() const;
  /// Start of this process, µs since 1970; in a replay the event time of the log's first event, so
  /// that a replay makes the same bytes again.
  std::int64_t epoch() const;
  /// The wall clock, µs since 1970; −1 in a replay, which does not read it.
  std::int64_t wall_clock_us() const;

  /// Phase and activity in PROCESS_INFO. `phase` is process_info_t::PHASE_*. Bytes of `activity`
  /// that are not UTF-8 are replaced by '?'.
  void set_activity(std::int8_t phase, std::string activity);
  /// A notice for people beside the process's own activity, such as messages that it refuses. It
  /// stands before the activity until it was not repeated for 5 s, in a replay to the end. One text
  /// per subject.
  void set_notice(const std::string& subject, std::string text);
  void set_seed(std::int64_t seed);
  /// A counter of the process's own beside those of the bus. Returns its value.
  std::int64_t count(const std::string& name, std::int64_t increment = 1);
  /// Counters that are kept elsewhere, as they stand now.
  void set_counters(const std::map<std::string, std::int64_t>& counters);

  /// Called about every 100 ms (every message in a replay) with the newest message's time in a
  /// replay, else with a time that began as the wall clock's at the start of the process and went
  /// on steadily since, however that clock is set [µs].
  void on_tick(std::function<void(std::int64_t now_us)> handler);
  /// Called after every batch of messages, and at least every 100 ms when live; may publish. Check
  /// here whether a worker has finished.
  void on_idle(std::function<void()> handler);
  /// Called once when the loop ends, in order (SIGTERM, end of the log, an exception of another
  /// handler), for the last answer and the safe command. An exception of one does not keep the
  /// others from being called.
  void on_end(std::function<void()> handler);

  /// Returns after SIGTERM or SIGINT (the message in hand is finished first) or at the end of a
  /// log. A second signal kills. The first exception of a handler ends the loop and is thrown again
  /// after the end handlers. Live, PROCESS_INFO is sent at 1 Hz and on change (at most 10 Hz);
  /// in a replay once, at the end.
  void run();

 private:
  friend int run_process(const std::string&, int, char**, const std::function<void(Process&)>&,
                         const std::function<void(Arguments)>&);
  struct Impl;
  explicit Process(std::unique_ptr<Impl> impl);
  std::unique_ptr<Impl> impl_;
};

/// Largest difference between the clocks of several machines.
inline constexpr std::int64_t kClockTolerance_us = 3'000'000;

/// True if the message is of a process that runs now, not of a recording: its time is within
/// kClockTolerance_us of `now_us`, the wall clock.
bool is_live(const process_info_t& info, std::int64_t now_us);

/// Parses the arguments, constructs a Process, calls `body`, and turns an exception into one line
/// "name: what" on stderr and exit code 1. `add_options` adds a process's own flags. Logs go to
/// stderr; stdout belongs to results.
int run_process(const std::string& name, int argc, char** argv,
                const std::function<void(Process&)>& body,
                const std::function<void(Arguments)>& add_options = nullptr);

/// The same for a class whose constructor takes the Process and subscribes, and whose
/// `Options::add_to(Arguments)` declares its own flags.
template <class Subscriber>
int run_process(const std::string& name, int argc, char** argv) {
  typename Subscriber::Options options;
  return run_process(
      name, argc, argv,
      [&](Process& process) {
        Subscriber subscriber(process, options);
        process.run();
      },
      [&](Arguments app) { options.add_to(app); });
}

}  // namespace bodyschema
