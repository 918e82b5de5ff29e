#include <poll.h>
#include <sys/resource.h>

#include <algorithm>
#include <chrono>
#include <filesystem>
#include <iostream>
#include <stdexcept>
#include <vector>

#include "common/config/rig.h"
#include "processes/console/commands/commands.h"
#include "processes/console/interruption.h"
#include "processes/console/log_follower.h"
#include "processes/console/picture.h"
#include "processes/console/report/report_page.h"
#include "processes/console/rig_check.h"
#include "processes/console/run_record.h"
#include "processes/structure_learner/recording/recording.h"

namespace bodyschema {
namespace {

namespace fs = std::filesystem;
using Clock = std::chrono::steady_clock;

constexpr std::chrono::seconds kShortestPeriod{10};
constexpr int kPoll_ms = 1000;

struct ReportArguments {
  std::string source;
  std::string out;
  bool follow = false;
  bool grows = false;
};

/// A run folder or a single log, read as it grows.
class Source {
 public:
  /// `grows`: whoever writes it is still at it, so that a torn event at its end is no damage.
  Source(const std::string& path, bool grows) : path_(path), grows_(grows) {
    if (!fs::exists(path_)) throw std::runtime_error(path + ": no such run folder or log");
    is_folder_ = fs::is_directory(path_);
  }

  fs::path default_out() const {
    return is_folder_ ? path_ / "report.html" : fs::path(path_).concat(".html");
  }

  /// Returns whether there was anything new.
  bool read() {
    const auto visit = [this](const LogEvent& event, const fs::path& file, std::int64_t byte) {
      record_.on_event(event, file, byte);
    };
    bool is_new = false;
    for (const fs::path& log : logs()) is_new |= follower_.read(log, visit);
    if (!is_folder_) {
      const auto summary = follower_.summaries().find(path_);
      if (summary == follower_.summaries().end())
        throw std::runtime_error(path_.string() + ": is empty");
      if (summary->second.events == 0 && summary->second.damage.starts_with("is not"))
        throw std::runtime_error(path_.string() + ": " + summary->second.damage);
    }
    return is_new;
  }

  /// Counts for whose change a page is rewritten: samples, versions, decisions, processes that come
  /// and go.
  std::tuple<std::int64_t, std::int64_t, std::size_t, std::size_t> state() const {
    return {record_.watch().num_samples(), record_.num_versions(), record_.events().size(),
            record_.faults().size() + record_.processes().size()};
  }

  /// Writes the page of a run that `goes_on`; returns what keeps it from having its plots, "" if
  /// nothing does.
  std::string write(const fs::path& out, bool goes_on, std::optional<int> reload_s) const {
    Report report;
    report.title = title();
    report.record = &record_;
    report.logs = follower_.summaries();
    for (auto& [file, summary] : report.logs)
      if (grows_ && summary.damage.starts_with("is cut off")) summary.damage.clear();
    report.measurement = [log = is_folder_ ? path_ / "run.lcmlog" : path_] {
      return measurement_of(log);
    };
    report.goes_on = goes_on;
    report.reload_s = reload_s;
    report.picture = picture();
    if (is_folder_ && fs::exists(path_ / "config" / "signals.yaml")) {
      try {
        report.end_effector = load_signals(path_ / "config").end_effector_part;
      } catch (const std::exception&) {
        // The report does without.
      }
    }
    std::string problem;
    write_file_atomically(out, report_page(report, &problem));
    return problem;
  }

 private:
  /// The samples first: they are whole, whatever a logger lost.
  std::vector<fs::path> logs() const {
    if (!is_folder_) return {path_};
    std::vector<fs::path> found;
    std::error_code error;
    for (const auto& entry : fs::directory_iterator(path_, error)) {
      const std::string name = entry.path().filename().string();
      if (name.starts_with("run.lcmlog") || name.starts_with("images.lcmlog"))
        found.push_back(entry.path());
    }
    // images.lcmlog.NN before run.lcmlog.NN; each in the order of its numbers.
    std::ranges::sort(found);
    found.insert(found.begin(), path_ / "samples.lcmlog");
    return found;
  }

  std::string title() const {
    const std::string name = fs::canonical(path_).filename().string();
    // Written at the end of a run; a report does without.
    const std::string rig = is_folder_ ? rig_name_of(path_) : "";
    return rig.empty() ? name : rig + " · " + name;
  }

  std::optional<std::string> picture() const {
    if (!record_.camera_info()) return std::nullopt;
    for (const RunRecord::Picture& picture : record_.pictures()) {
      try {
        LogReader reader(picture.image.file, OnDamage::kThrow, picture.image.byte);
        if (!reader.next()) continue;
        if (const auto image = message_of(reader.event(), kCameraImage))
          return draw_detections(*image, picture.markers, *record_.camera_info(), ".jpg");
      } catch (const std::exception&) {
        // Another frame may do.
      }
    }
    return std::nullopt;
  }

  const fs::path path_;
  bool is_folder_ = false;
  const bool grows_;
  LogFollower follower_;
  RunRecord record_;
};

void run_report(const ReportArguments& arguments) {
  Source source(arguments.source, arguments.follow || arguments.grows);
  const fs::path out = arguments.out.empty() ? source.default_out() : fs::path(arguments.out);
  if (!arguments.follow) {
    source.read();
    const std::string problem = source.write(out, arguments.grows, std::nullopt);
    if (!problem.empty()) throw std::runtime_error(out.string() + " has no plots: " + problem);
    std::cout << out.string() << std::endl;
    return;
  }

  catch_interruption();
  // The processes that move the arm come first.
  ::setpriority(PRIO_PROCESS, 0, 10);
  auto write = [&, last = std::string()](std::optional<int> reload_s) mutable {
    std::string problem;
    try {
      problem = source.write(out, reload_s.has_value(), reload_s);
    } catch (const std::exception& error) {
      problem = error.what();  // a full disk, say: the next page may succeed
    }
    // A full disk may have taken the words before: std::cerr would be silent from then on.
    std::cerr.clear();
    if (problem != last && !problem.empty()) std::cerr << "bodyschema: " << problem << std::endl;
    last = problem;
  };
  constexpr auto kReload_s = static_cast<int>(kShortestPeriod.count());
  source.read();
  auto written_state = source.state();
  auto written = Clock::now();
  write(kReload_s);
  while (!is_interrupted()) {
    ::poll(nullptr, 0, kPoll_ms);
    source.read();
    if (source.state() == written_state || Clock::now() - written < kShortestPeriod) continue;
    written_state = source.state();
    written = Clock::now();
    write(kReload_s);
  }
  source.read();
  // The group that starts this program ends it when the run ends.
  write(std::nullopt);
}

}  // namespace

void add_report_command(Arguments console) {
  auto [report, arguments] = console.add_command(
      "report", "What a run tells, as one HTML file that needs no network", run_report);
  report.add_option("RUN", arguments.source, "Run folder, or an LCM log with SAMPLEs")
      .envname("BODYSCHEMA_RUN")
      .required();
  report.add_option("--out", arguments.out, "The file; default: report.html in the run folder");
  report.add_flag("--follow", arguments.follow,
                  "Write it again while the run goes on, until SIGTERM");
  report.add_flag("--growing", arguments.grows,
                  "The run goes on: an event that is cut off at the end is still being written");
}

}  // namespace bodyschema
