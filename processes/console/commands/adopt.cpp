#include <fmt/format.h>
#include <unistd.h>

#include <filesystem>
#include <fstream>
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>
#include <sstream>
#include <stdexcept>
#include <string>

#include "common/bus/event_log.h"
#include "common/config/calibration_id.h"
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

struct Calibration {
  Markers markers;
  CameraCalibration camera;
  std::int64_t id() const { return calibration_id(markers, camera); }
};

std::string text_of(const path& file) {
  std::ifstream stream(file);
  std::ostringstream text;
  text << stream.rdbuf();
  if (!stream) throw std::runtime_error(file.string() + ": cannot be read");
  return text.str();
}

Calibration of_rig(const path& folder) {
  return {load_markers(folder), load_camera_calibration(calibration_file(folder))};
}

/// What a refiner proposed in this run.
Calibration proposed_in(const path& run) {
  const path folder = run / "proposed";
  if (!std::filesystem::exists(folder / "markers.yaml") ||
      !std::filesystem::exists(folder / "camera_info.yaml"))
    throw std::runtime_error(fmt::format(
        "{}: there are no proposed markers.yaml and camera_info.yaml: a group's refiner writes "
        "them (refiner.yaml: enabled: true), or `{}`",
        folder.string(),
        to_type(fmt::format("refine SCHEMA LOG --placements --intrinsics --out SCHEMA2 --proposed "
                            "{}",
                            folder.string()))));
  return {load_markers(folder), load_camera_calibration(folder / "camera_info.yaml")};
}

path rig_of(const AdoptArguments& arguments) {
  if (!arguments.rig.empty()) return find_rig(arguments.rig);
  const path file = path(arguments.run) / "result.json";
  std::string name;
  if (std::filesystem::exists(file)) {
    const auto result = nlohmann::json::parse(text_of(file), nullptr, false);
    if (result.is_object()) name = result.value("rig", "");
  }
  const path folder = name.empty() ? path() : rigs_folder() / name;
  if (folder.empty() || !std::filesystem::exists(folder / "signals.yaml"))
    throw std::runtime_error(arguments.run + ": does not tell its rig; give --rig");
  return folder;
}

/// Why the proposal is not one for the run's rig; "" if it is.
std::string mismatch(const Calibration& proposed, const Calibration& recorded) {
  if (proposed.markers.family != recorded.markers.family) return "another family of tags";
  if (proposed.markers.tags.size() != recorded.markers.tags.size()) return "other tags";
  for (const TagPlacement& tag : recorded.markers.tags) {
    const TagPlacement* other = proposed.markers.find(tag.id);
    if (!other || other->part != tag.part || other->X_BM.has_value() != tag.X_BM.has_value())
      return fmt::format("another tag {}", tag.id);
  }
  if (proposed.camera.width != recorded.camera.width ||
      proposed.camera.height != recorded.camera.height ||
      proposed.camera.model != recorded.camera.model)
    return "another camera";
  return "";
}

/// The rig's files are the run's, or those proposed: an adoption that was cut short.
bool is_between(const Calibration& now, const Calibration& recorded, const Calibration& proposed) {
  const auto has_markers = [&](const Calibration& other) {
    return calibration_id(now.markers, recorded.camera) ==
           calibration_id(other.markers, recorded.camera);
  };
  const auto has_lens = [&](const Calibration& other) {
    return calibration_id(recorded.markers, now.camera) ==
           calibration_id(recorded.markers, other.camera);
  };
  return (has_markers(recorded) || has_markers(proposed)) &&
         (has_lens(recorded) || has_lens(proposed));
}

/// Writes the new text, and keeps the old one beside it.
void replace(const path& file, const std::string& text) {
  const std::string old = text_of(file);
  if (old == text) return;
  write_file_atomically(file.string() + ".before", old);
  write_file_atomically(file, text);
}

bool is_confirmed(const AdoptArguments& arguments, const path& rig) {
  if (arguments.yes) return true;
  if (isatty(STDIN_FILENO) != 1) {
    std::cout << "Nothing was written: --yes writes it into " << rig.string() << "\n";
    return false;
  }
  std::cout << "Write this into " << rig.string() << "? [y/N] " << std::flush;
  std::string answer;
  std::getline(std::cin, answer);
  if (answer == "y" || answer == "yes") return true;
  std::cout << "Nothing was written.\n";
  return false;
}

void run_adopt(const AdoptArguments& arguments) {
  const path run = arguments.run;
  const Calibration proposed = proposed_in(run);
  const Calibration recorded = of_rig(run / "config");
  const path rig = rig_of(arguments);
  const Calibration now = of_rig(rig);
  if (const std::string why = mismatch(proposed, recorded); !why.empty())
    throw std::runtime_error(
        fmt::format("{}/proposed: {} than in {}/config", run.string(), why, run.string()));
  if (now.id() == proposed.id()) {
    std::cout << rig.string() << " is as proposed already\n";
    return;
  }
  const path lens_file = calibration_file(rig);
  if (!is_between(now, recorded, proposed))
    throw std::runtime_error(fmt::format(
        "{}: its markers.yaml or {} is not what the run {} was made with, so what was found there "
        "does not hold for it",
        rig.string(), lens_file.filename().string(), run.string()));
  std::cout << fmt::format("{}, as found in {}:\n", rig.string(), run.string())
            << adoption_text(now.markers, proposed.markers, now.camera, proposed.camera);
  if (!is_confirmed(arguments, rig)) return;
  const bool is_of_config = rig.parent_path() == rigs_folder();
  replace(rig / "markers.yaml", text_of(run / "proposed" / "markers.yaml"));
  replace(lens_file, text_of(run / "proposed" / "camera_info.yaml"));
  std::cout << fmt::format(
      "Written; the old files are markers.yaml.before and {}.before.\n"
      "Samples from before were seen through the old calibration: from now on they are refused, "
      "and a new run begins anew",
      lens_file.filename().string());
  if (std::filesystem::exists(run / "refined.lcmlog"))
    std::cout << fmt::format(", or with what was refined: ./run --rig {} --initial {}",
                             is_of_config ? rig.filename().string() : rig.string(),
                             (run / "refined.lcmlog").string());
  std::cout << "\n";
}

}  // namespace

void add_adopt_command(Arguments console) {
  const auto arguments = std::make_shared<AdoptArguments>();
  Arguments adopt = console.add_subcommand(
      "adopt", "Write the tags and the lens that a run's refiner found into the rig");
  adopt.add_option("RUN", arguments->run, "Folder of the run, e.g. logs/current").required();
  adopt.add_option("--rig", arguments->rig,
                   "Folder of the rig, or name of one in config/; the run's if not given");
  adopt.add_flag("--yes", arguments->yes, "Do not ask before writing");
  adopt.callback([arguments] { run_adopt(*arguments); });
}

}  // namespace bodyschema
