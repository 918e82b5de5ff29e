// experiments: the figures of the chapter's Sections 3 to 5, measured again: the chapter's
// value, the chapter's own method (baseline) and ours beside each other, over many robots.
//
//   experiments [NAME…] [--quick] [--out FOLDER] [--jobs N]
//   experiments --list
//
// Tables on stdout and, with the plots, in FOLDER (all.md: of all experiments, where all were run);
// progress on stderr. Ends with 1 if something that must come out does not.

#include <fmt/format.h>
#include <unistd.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <chrono>
#include <cstdio>
#include <fstream>
#include <set>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#include "common/config/yaml.h"
#include "tests/experiments/figures/experiment.h"

namespace bodyschema::experiments {
namespace {

const std::vector<Experiment> kExperiments = {
    {"local_model", "Fig. 5: a good and a bad local model", local_model},
    {"spherical", "Fig. 6: a spherical joint, first one signal, then both", spherical},
    {"chain", "Fig. 7: 4-DOF chain", chain},
    {"occluded", "Fig. 8: the same with x3 never seen", occluded},
    {"two_dof_noise", "Fig. 10: 2-DOF robot, prediction and control in noise", two_dof_noise},
    {"two_dof_free", "Section 5.1: 2-DOF robot without noise", two_dof_free},
    {"seven_dof", "Fig. 11: 7-DOF robot, ten parts, x4 never seen", seven_dof},
    {"trees", "Beyond the chapter: random trees", trees},
    {"adaptation", "Table 1, Figs. 9, 12 and 13: a body that breaks, is repaired, breaks again",
     adaptation},
    {"drift", "Beyond the chapter: a link that bends all the time", drift},
    {"false_alarms", "Section 4: how often a healthy body is found broken", false_alarms},
};

std::vector<Experiment> chosen(const std::vector<std::string>& names) {
  if (names.empty()) return kExperiments;
  std::vector<Experiment> result;
  std::set<std::string> known;
  std::string list;
  for (const Experiment& e : kExperiments) {
    known.insert(e.name);
    list += (list.empty() ? "" : ", ") + std::string(e.name);
  }
  for (const std::string& name : names) {
    if (!known.contains(name))
      throw std::invalid_argument("there is no experiment '" + name + "'" +
                                  did_you_mean(name, known) + " There are: " + list);
    for (const Experiment& e : kExperiments)
      if (e.name == name) result.push_back(e);
  }
  return result;
}

void write(const std::filesystem::path& file, const std::string& text) {
  std::ofstream stream(file);
  stream << text;
  stream.close();
  if (!stream) throw std::runtime_error(file.string() + ": cannot be written");
}

void show_progress(const std::string& name, const std::string& part, double share) {
  if (isatty(STDERR_FILENO))
    fmt::print(stderr, "\r\033[K{}: {} {:.0f} %", name, part, 100 * share);
  else if (share >= 1)
    fmt::print(stderr, "{}: {}\n", name, part);
}

int run(const std::vector<Experiment>& experiments, Setup setup) {
  std::filesystem::create_directories(setup.out);
  // An unwritable folder must be found now, not after minutes.
  write(setup.out / ".probe", "");
  std::filesystem::remove(setup.out / ".probe");
  std::string all = "# The chapter's figures, measured again\n";
  bool is_reached = true;
  for (const Experiment& experiment : experiments) {
    setup.progress = [&experiment](const std::string& part, double share) {
      show_progress(experiment.name, part, share);
    };
    const auto start = std::chrono::steady_clock::now();
    const Findings findings = experiment.run(setup);
    const std::chrono::duration<double> duration = std::chrono::steady_clock::now() - start;
    if (isatty(STDERR_FILENO)) fmt::print(stderr, "\r\033[K");
    std::string text =
        fmt::format("## {}\n`./run experiments {}{}`, {:.0f} s with {} thread{}. {}",
                    experiment.title, experiment.name, setup.quick ? " --quick" : "",
                    duration.count(), setup.jobs, setup.jobs == 1 ? "" : "s", findings.markdown);
    if (!findings.musts.empty()) {
      Table table({"must", "measured", ""});
      for (const Must& must : findings.musts) {
        table.add({must.what, must.measured, must.is_reached ? "reached" : "**missed**"});
        is_reached &= must.is_reached;
      }
      text += "\n" + table.markdown();
    }
    write(setup.out / (std::string(experiment.name) + ".md"), text);
    all += "\n" + text;
    fmt::print("{}\n", text);
    std::fflush(stdout);
  }
  if (experiments.size() == kExperiments.size()) write(setup.out / "all.md", all);
  fmt::print(stderr, "tables and plots are in {}\n", setup.out.string());
  if (!is_reached) fmt::print(stderr, "experiments: something that must come out did not\n");
  return is_reached ? 0 : 1;
}

}  // namespace
}  // namespace bodyschema::experiments

int main(int argc, char** argv) {
  using namespace bodyschema::experiments;
  Setup setup;
  setup.out = "logs/experiments";
  setup.jobs = std::max(1, static_cast<int>(std::thread::hardware_concurrency()));
  std::vector<std::string> names;
  bool list = false;
  CLI::App app("The chapter's figures, measured again");
  app.add_option("NAME", names, "Experiments; all of them if none is named");
  app.add_flag("--quick", setup.quick, "Few robots and sizes: all in a few minutes");
  app.add_option("--out", setup.out, "Folder of tables and plots")->capture_default_str();
  app.add_option("--jobs", setup.jobs, "Threads; the results do not depend on it")
      ->check(CLI::Range(1, 256))
      ->capture_default_str();
  app.add_flag("--list", list, "List the experiments");
  CLI11_PARSE(app, argc, argv);
  try {
    if (list) {
      for (const Experiment& e : chosen(names)) fmt::print("{:14} {}\n", e.name, e.title);
      return 0;
    }
    return run(chosen(names), setup);
  } catch (const std::exception& e) {
    fmt::print(stderr, "experiments: {}\n", e.what());
    return 2;
  }
}
