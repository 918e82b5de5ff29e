#include <fmt/format.h>
#include <unistd.h>

#include <filesystem>
#include <iostream>
#include <stdexcept>
#include <string>

#include "common/bus/channels.h"
#include "common/bus/event_log.h"
#include "common/text/text.h"
#include "processes/console/adoption.h"
#include "processes/console/commands/commands.h"
#include "processes/console/hint.h"
#include "processes/console/rig_check.h"
#include "processes/console/views/adoption_view.h"

namespace bodyschema {
namespace {

using std::filesystem::path;

struct AdoptArguments {
  std::string run, rig;
  bool yes = false;
};

path rig_of(const AdoptArguments& arguments) {
  if (!arguments.rig.empty()) return find_rig(arguments.rig);
  const path file = path(arguments.run) / "result.json";
  const std::string name = rig_name_of(arguments.run);
  if (name.empty())
    throw std::runtime_error(file.string() + ": does not tell the run's rig; give --rig");
  const path folder = rigs_folder() / name;
  // Of a rig in another place the run knows the name alone.
  if (rigs_folder().empty() || !std::filesystem::exists(folder / "signals.yaml"))
    throw std::runtime_error(
        fmt::format("{}: the run's rig '{}' is not in config/; give --rig", file.string(), name));
  return folder;
}

bool is_confirmed(const AdoptArguments& arguments, const path& rig) {
  if (arguments.yes) return true;
  if (::isatty(STDIN_FILENO) != 1 || ::isatty(STDERR_FILENO) != 1) {
    std::cout << fmt::format("Nothing was written; to write these into {} give --yes\n",
                             rig.string());
    return false;
  }
  std::cerr << "Write these into " << rig.string() << "? [y/N] " << std::flush;
  std::string answer;
  std::getline(std::cin, answer);
  if (answer == "y" || answer == "Y" || answer == "yes") return true;
  std::cout << "Nothing was written.\n";
  return false;
}

/// The words for the next run: with the refined schema, where that goes with the adopted files.
std::string next_run(const path& run, const path& rig, std::int64_t calibration) {
  const path refined = run / "refined.lcmlog";
  if (!std::filesystem::exists(refined)) return "";
  const auto schemas = read_log(refined, kBodySchema);
  if (schemas.empty() || schemas.back().calibration_id != calibration) return "";
  const bool is_of_config = rig.parent_path() == rigs_folder();
  return fmt::format(", or with what was refined: ./run --rig {} --initial {}",
                     is_of_config ? rig.filename().string() : rig.string(), refined.string());
}

void run_adopt(const AdoptArguments& arguments) {
  const path run = arguments.run;
  if (!std::filesystem::is_directory(run))
    throw std::runtime_error(run.string() + ": there is no such folder of a run");
  const path rig = rig_of(arguments);
  const Adoption adoption = plan_adoption(run, rig);
  if (adoption.files.empty()) {
    std::cout << rig.string() << " is as proposed already\n";
    return;
  }
  std::cout << fmt::format("{}, as found in {}:\n", rig.string(), run.string())
            << adoption_text(adoption.before, adoption.after) << std::flush;
  if (!is_confirmed(arguments, rig)) return;
  adopt(adoption);
  std::cout << fmt::format(
      "Written: {}; beside {}: {}.\n"
      "Samples of runs before were seen through the old calibration and are not mixed with new "
      "ones: from now on they are refused. A new run begins anew{}\n",
      listed(adoption.files, [](const auto& file) { return file.path.string(); }),
      adoption.files.size() == 1 ? "it the old file" : "them the old files",
      listed(adoption.files,
             [](const auto& file) { return file.path.filename().string() + kReplacedSuffix; }),
      next_run(run, rig, calibration_id(adoption.after)));
}

}  // namespace

void add_adopt_command(Arguments console) {
  auto [adopt, arguments] = console.add_command(
      "adopt", "Write the tags and the lens that a run proposes into its rig, after showing them",
      run_adopt);
  adopt.add_option("RUN", arguments.run, "Folder of the run, e.g. logs/current").required();
  adopt.add_option("--rig", arguments.rig,
                   "Folder of the rig, or name of one in config/; the run's if not given");
  adopt.add_flag("--yes", arguments.yes, "Do not ask before writing");
}

}  // namespace bodyschema
