#include "common/bus/process.h"

#include <signal.h>
#include <spdlog/sinks/stdout_color_sinks.h>
#include <spdlog/spdlog.h>
#include <sys/resource.h>
#include <unistd.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <array>
#include <atomic>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <fstream>
#include <iterator>
#include <map>
#include <optional>
#include <sstream>
#include <stdexcept>
#include <tuple>
#include <utility>
#include <vector>

#include "common/bus/check.h"
#include "common/bus/convert.h"
#include "common/text/clock.h"
#include "common/text/text.h"

namespace bodyschema {
namespace {

using SteadyClock = std::chrono::steady_clock;

constexpr std::chrono::milliseconds kTickPeriod{100};
constexpr std::chrono::milliseconds kInfoPeriod{1000};
constexpr std::chrono::milliseconds kShortestInfoPeriod{100};
/// Time for which a starting process listens for another of its name, which answers at its next
/// tick (kTickPeriod), on a busy machine later.
constexpr std::chrono::milliseconds kListening{500};
/// Time for a process that was heard once to be heard again: it repeats at 1 Hz, also when it is
/// too busy to answer.
constexpr std::chrono::milliseconds kListeningAgain{1200};
/// An elder that was busy with its own start is heard twice within this time, at 1 Hz.
constexpr std::chrono::seconds kYouth{3};
/// A message repeated at 1 Hz may be lost four times in a row.
constexpr std::chrono::seconds kNoticeAge{5};

std::atomic<bool> stop_requested{false};
static_assert(std::atomic<bool>::is_always_lock_free, "set by a signal handler");

void request_stop(int) { stop_requested = true; }

/// The first signal ends the loop, a second one the process, should a handler never return. No
/// SA_RESTART: a wait for messages must end early.
void install_signal_handlers() {
  stop_requested = false;
  struct sigaction action {};
  action.sa_handler = &request_stop;
  action.sa_flags = static_cast<int>(SA_RESETHAND);
  sigemptyset(&action.sa_mask);
  ::sigaction(SIGTERM, &action, nullptr);
  ::sigaction(SIGINT, &action, nullptr);
  // A relay that went away is reported by publish(), not by a signal.
  ::signal(SIGPIPE, SIG_IGN);
}

/// Processor time since the start, user and system [us].
std::int64_t processor_time_us() {
  rusage usage{};
  ::getrusage(RUSAGE_SELF, &usage);
  const auto microseconds = [](const timeval& time) {
    return std::int64_t{time.tv_sec} * 1'000'000 + time.tv_usec;
  };
  return microseconds(usage.ru_utime) + microseconds(usage.ru_stime);
}

/// Memory in use; 0 if /proc does not tell.
std::int64_t resident_bytes() {
  std::int64_t size_pages = 0, resident_pages = 0;
  std::ifstream("/proc/self/statm") >> size_pages >> resident_pages;
  return resident_pages * ::sysconf(_SC_PAGESIZE);
}

std::string host_name() {
  std::array<char, 256> name{};
  return ::gethostname(name.data(), name.size() - 1) == 0 ? name.data() : "";
}

std::string read_text(const std::filesystem::path& file) {
  std::ifstream stream(file);
  std::string text{std::istreambuf_iterator<char>(stream), {}};
  if (std::filesystem::is_directory(file) || !stream) {
    throw std::runtime_error(file.string() + ": cannot read the configuration file");
  }
  return text;
}

std::string one_line(std::string text) {
  std::replace(text.begin(), text.end(), '\n', ' ');
  return text;
}

int fail(const std::string& name, const std::string& what) {
  std::fprintf(stderr, "%s: %s\n", name.c_str(), one_line(what).c_str());
  return 1;
}

}  // namespace

struct Process::Impl {
  Impl(std::string process_name, std::filesystem::path config, std::string in, std::string out)
      : config_file(std::move(config)),
        in_url(std::move(in)),
        out_url(std::move(out)),
        bus(in_url, out_url) {
    info.process_name = std::move(process_name);
    info.host = as_text(host_name());
    info.pid = static_cast<std::int32_t>(::getpid());
    info.start_utime = bus.is_replay() ? std::max<std::int64_t>(0, bus.event_utime())
                                       : bodyschema::wall_clock_us();
    info.program_version = BODYSCHEMA_VERSION;
    info.seed = -1;
    info.configuration = as_text(read_text(config_file));
    if (!bus.is_replay() && in_url == out_url) listen_for_twin();
  }

  const std::filesystem::path config_file;
  const std::string in_url, out_url;
  Bus bus;
  process_info_t info{};
  std::string activity;
  struct Notice {
    std::string text;
    SteadyClock::time_point repeated;
  };
  std::map<std::string, Notice> notices;  ///< by subject
  bool info_changed = true;
  bool is_listening = false;
  std::optional<SteadyClock::time_point> running_since;
  /// Processes of the same name, heard while listening or young → time.
  std::map<std::tuple<std::int64_t, std::string, std::int32_t>, std::int64_t> elders;
  const SteadyClock::time_point start = SteadyClock::now();
  SteadyClock::time_point last_info{};
  SteadyClock::time_point last_tick{};
  std::map<std::string, std::int64_t> counters;
  std::vector<std::function<void(std::int64_t)>> tick_handlers;
  std::vector<std::function<void()>> idle_handlers;
  std::vector<std::function<void()>> end_handlers;

  /// Nothing but PROCESS_INFO is sent before it is known that nobody else does this work.
  void listen_for_twin() {
    bus.subscribe(kProcessInfo, [this](const process_info_t& other) { on_process_info(other); });
    is_listening = true;
    auto end = SteadyClock::now() + kListening;
    while (SteadyClock::now() < end && !stop_requested) {
      const std::size_t num_elders = elders.size();
      info_changed = true;  // asked again and again
      publish_info_if_due();
      bus.handle(std::chrono::milliseconds(20));
      // Time to say it again: one message alone may be anybody's.
      if (elders.size() > num_elders) end = SteadyClock::now() + kListeningAgain;
    }
    is_listening = false;
  }

  void on_process_info(const process_info_t& other) {
    const auto identity = [](const process_info_t& process) {
      return std::tuple(process.start_utime, process.host, process.pid);
    };
    if (other.process_name != info.process_name || identity(other) == identity(info) ||
        other.phase == process_info_t::PHASE_ENDED ||
        !is_live(other, bodyschema::wall_clock_us())) {
      return;
    }
    // A starting process gives way to a running one, whatever the clock was when either began.
    const bool is_other_starting = other.phase == process_info_t::PHASE_STARTING;
    if (is_other_starting && !is_listening) {
      info_changed = true;  // answered at once
      return;
    }
    if (is_other_starting && identity(info) < identity(other)) return;
    const std::string who = fmt::format(
        "another {} is on this bus: process {} on {}. End that one (./run stop), or give this "
        "group a port of its own in network.yaml",
        other.process_name, other.pid, other.host);
    const bool is_young = !running_since || SteadyClock::now() - *running_since < kYouth;
    if (is_listening || (is_young && identity(other) < identity(info))) {
      // Enough for a test of many twins; bounds the number that a stranger can invent.
      constexpr std::size_t kMostElders = 16;
      const auto elder = elders.find(identity(other));
      if (elder != elders.end() && other.utime > elder->second) throw std::runtime_error(who);
      if (elder == elders.end() && elders.size() < kMostElders)
        elders.emplace(identity(other), other.utime);
    }
    if (is_listening) return;
    if (++counters["twin PROCESS_INFO"] == 1) spdlog::warn("{}", who);
    set_notice("twin", who);
  }

  void set_notice(const std::string& subject, std::string text) {
    Notice& notice = notices[subject];
    text = as_text(std::move(text));
    info_changed |= notice.text != text;
    notice = {std::move(text), SteadyClock::now()};
  }

  void publish_info() {
    info.utime =
        bus.is_replay() ? std::max<std::int64_t>(0, bus.last_utime()) : bodyschema::wall_clock_us();
    if (!bus.is_replay()) {
      std::erase_if(notices, [now = SteadyClock::now()](const auto& item) {
        return now - item.second.repeated > kNoticeAge;
      });
    }
    info.activity.clear();
    for (const auto& [subject, notice] : notices) info.activity += notice.text + "; ";
    info.activity += activity;
    // A replay writes the same bytes again.
    info.cpu_us = bus.is_replay() ? 0 : processor_time_us();
    info.resident_bytes = bus.is_replay() ? 0 : resident_bytes();
    // std::map: ascending names, as the message wants them.
    std::map<std::string, std::int64_t> all = bus.counters();
    for (const auto& [name, value] : counters) all[name] += value;
    std::vector<counter_t> list;
    for (const auto& [name, value] : all) {
      counter_t& counter = list.emplace_back();
      counter.counter_name = name;
      counter.count = value;
    }
    set_array(info.num_counters, info.counters, std::move(list));
    bus.publish(kProcessInfo, info);
    info_changed = false;
    last_info = SteadyClock::now();
  }

  void publish_info_if_due() {
    if (bus.is_replay()) return;
    const auto age = SteadyClock::now() - last_info;
    if (age >= kInfoPeriod || (info_changed && age >= kShortestInfoPeriod)) publish_info();
  }

  void tick() {
    if (bus.is_replay()) {
      if (bus.last_utime() < 0) return;
      for (const auto& handler : tick_handlers) handler(bus.last_utime());
      return;
    }
    const auto now = SteadyClock::now();
    if (now - last_tick < kTickPeriod) return;
    last_tick = now;
    // Steady, so that no timeout depends on how the clock is set meanwhile.
    const auto since_start = std::chrono::duration_cast<std::chrono::microseconds>(now - start);
    for (const auto& handler : tick_handlers) handler(info.start_utime + since_start.count());
  }
};

Process::Process(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}
Process::~Process() = default;

Bus& Process::bus() { return impl_->bus; }

const std::string& Process::name() const { return impl_->info.process_name; }

const std::filesystem::path& Process::config_file() const { return impl_->config_file; }

const std::string& Process::in_url() const { return impl_->in_url; }

const std::string& Process::out_url() const { return impl_->out_url; }

std::filesystem::path Process::rig_folder() const {
  return impl_->config_file.has_parent_path() ? impl_->config_file.parent_path() : ".";
}

std::int64_t Process::epoch() const { return impl_->info.start_utime; }

std::int64_t Process::wall_clock_us() const {
  return impl_->bus.is_replay() ? -1 : bodyschema::wall_clock_us();
}

void Process::set_activity(std::int8_t phase, std::string activity) {
  activity = as_text(std::move(activity));
  if (phase == impl_->info.phase && activity == impl_->activity) return;
  impl_->info.phase = phase;
  impl_->activity = std::move(activity);
  impl_->info_changed = true;
}

void Process::set_notice(const std::string& subject, std::string text) {
  impl_->set_notice(subject, std::move(text));
}

void Process::set_seed(std::int64_t seed) { impl_->info.seed = seed; }

std::int64_t Process::count(const std::string& name, std::int64_t increment) {
  return impl_->counters[name] += increment;
}

void Process::set_counters(const std::map<std::string, std::int64_t>& counters) {
  for (const auto& [name, value] : counters) impl_->counters[name] = value;
}

void Process::on_tick(std::function<void(std::int64_t)> handler) {
  impl_->tick_handlers.push_back(std::move(handler));
}

void Process::on_idle(std::function<void()> handler) {
  impl_->idle_handlers.push_back(std::move(handler));
}

void Process::on_end(std::function<void()> handler) {
  impl_->end_handlers.push_back(std::move(handler));
}

void Process::run() {
  if (impl_->info.phase == process_info_t::PHASE_STARTING) {
    impl_->info.phase = process_info_t::PHASE_WAITING;
  }
  impl_->running_since = SteadyClock::now();
  std::exception_ptr first_problem;
  const auto guarded = [&](const auto& act) {
    try {
      act();
    } catch (...) {
      if (!first_problem) first_problem = std::current_exception();
    }
  };
  guarded([&] {
    impl_->publish_info_if_due();
    bool has_more = true;
    while (has_more && !stop_requested) {
      has_more = impl_->bus.handle(kTickPeriod);
      impl_->tick();
      for (const auto& handler : impl_->idle_handlers) handler();
      impl_->publish_info_if_due();
    }
  });
  // However the loop ended: among them is the safe command of a driver.
  for (const auto& handler : impl_->end_handlers) guarded(handler);
  impl_->info.phase = process_info_t::PHASE_ENDED;
  guarded([&] { impl_->publish_info(); });
  if (first_problem) std::rethrow_exception(first_problem);
}

bool is_live(const process_info_t& info, std::int64_t now_us) {
  return std::abs(now_us - info.utime) <= kClockTolerance_us;
}

int run_process(const std::string& name, int argc, char** argv,
                const std::function<void(Process&)>& body,
                const std::function<void(Arguments)>& add_options) {
  try {
    // Before anything slow, so that a SIGTERM during start-up also ends in good order.
    install_signal_handlers();
    std::string config;
    std::string in_url;
    std::string out_url;
    std::string log_level = "info";
    CLI::App app("One process of bodyschema.", name);
    app.add_option("--config", config, "its configuration file (YAML)")->type_name("FILE");
    app.add_option("--in", in_url, "bus or log to listen to; default: " + default_url())
        ->type_name("URL");
    CLI::Option* out =
        app.add_option("--out", out_url,
                       "bus or log to publish to; default: the same as --in, nowhere for a log")
            ->type_name("URL");
    app.add_option("--log-level", log_level, "what goes to stderr")
        ->check(CLI::IsMember({"trace", "debug", "info", "warning", "error", "critical", "off"}))
        ->capture_default_str();
    app.set_version_flag("--version", std::string(BODYSCHEMA_VERSION));
    if (add_options) add_options(Arguments(&app));
    try {
      app.parse(argc, argv);
    } catch (const CLI::Success& request) {
      return app.exit(request);
    } catch (const CLI::ParseError& error) {
      return fail(name, std::string(error.what()) + ". Type: " + name + " --help");
    }
    if (config.empty()) {
      return fail(
          name, "--config is missing. Type: " + name + " --config config/<rig>/" + name + ".yaml");
    }
    if (in_url.empty()) in_url = default_url();
    if (out->count() == 0) out_url = in_url.rfind("file://", 0) == 0 ? "" : in_url;

    spdlog::set_default_logger(std::make_shared<spdlog::logger>(
        name, std::make_shared<spdlog::sinks::stderr_color_sink_mt>()));
    spdlog::set_level(spdlog::level::from_str(log_level));
    spdlog::set_pattern("%H:%M:%S.%e %n %^%l%$: %v");

    Process process(std::make_unique<Process::Impl>(name, config, in_url, out_url));
    body(process);
    return 0;
  } catch (const std::exception& error) {
    return fail(name, error.what());
  } catch (...) {
    return fail(name, "ended by an exception of an unknown type");
  }
}

}  // namespace bodyschema
