#include "processes/console/adoption.h"

#include <fmt/format.h>

#include <optional>
#include <stdexcept>

#include "common/bus/channels.h"
#include "common/bus/event_log.h"
#include "common/config/proposed_calibration.h"
#include "common/text/text.h"
#include "processes/console/hint.h"
#include "processes/console/views/adoption_view.h"

namespace bodyschema {
namespace {

using std::filesystem::path;

/// What RUN/proposed holds of the two files, with the text that was parsed.
struct Proposal {
  std::optional<std::string> markers_text, camera_text;
  RigCalibration calibration;  ///< the run's where nothing is proposed
};

/// The first line where it says which refinement a file is of, else "".
std::string mark_of(const std::string& text) {
  return text.starts_with(kProposalMark) ? text.substr(0, text.find('\n')) : "";
}

Proposal proposal_of(const path& folder, const RigCalibration& recorded) {
  const path markers = folder / "markers.yaml", camera = folder / "camera_info.yaml";
  Proposal proposal{{}, {}, recorded};
  if (std::filesystem::exists(markers)) {
    proposal.markers_text = read_file(markers);
    proposal.calibration.markers = load_markers(folder);
  }
  if (std::filesystem::exists(camera)) {
    proposal.camera_text = read_file(camera);
    proposal.calibration.camera = load_camera_calibration(camera);
  }
  if (!proposal.markers_text && !proposal.camera_text)
    throw std::runtime_error(fmt::format(
        "{}: there is no proposed markers.yaml or camera_info.yaml: a group's refiner writes "
        "them (refiner.yaml: enabled: true), or `{}`",
        folder.string(),
        to_type(fmt::format("refine SCHEMA LOG --placements --intrinsics --out SCHEMA2 --proposed "
                            "{}",
                            folder.string()))));
  if (proposal.markers_text && proposal.camera_text &&
      mark_of(*proposal.markers_text) != mark_of(*proposal.camera_text))
    throw std::runtime_error(
        fmt::format("{}: the two files are of two refinements: the refiner was stopped between "
                    "them; refine again",
                    folder.string()));
  // A group's refiner may replace them at any time.
  if ((proposal.markers_text && read_file(markers) != *proposal.markers_text) ||
      (proposal.camera_text && read_file(camera) != *proposal.camera_text))
    throw std::runtime_error(folder.string() + ": is being written; ask again");
  return proposal;
}

/// What the run's samples say that they were seen through; 0: nothing.
std::int64_t calibration_of_samples(const path& run) {
  const path samples = run / "samples.lcmlog";
  if (!std::filesystem::exists(samples) || std::filesystem::file_size(samples) == 0) return 0;
  LogReader reader(samples);
  while (reader.next())
    if (const auto sample = message_of(reader.event(), kSample)) return sample->calibration_id;
  return 0;
}

/// The reasons not to adopt a proposal, for people.
class Refusal {
 public:
  void add(const path& file, const std::string& why) {
    if (!why.empty()) text_ += (text_.empty() ? "" : "\n") + file.string() + ": " + why;
  }
  void throw_if_any() const {
    if (!text_.empty()) throw std::runtime_error(text_);
  }

 private:
  std::string text_;
};

/// In what a rig's file is neither the run's nor the proposed one; "" where it is one of them.
std::string drift(const path& run_file, const std::string& from_run,
                  const std::string& from_proposal) {
  if (from_run.empty() || from_proposal.empty()) return "";
  return fmt::format(
      "is no longer that of the run, {} ({}), nor the proposed one ({}): what was found there does "
      "not hold for it",
      run_file.string(), from_run, from_proposal);
}

}  // namespace

Adoption plan_adoption(const path& run, const path& rig) {
  const path own = run / "config", folder = run / "proposed";
  if (!std::filesystem::is_directory(own))
    throw std::runtime_error(own.string() + ": the run has no copy of its rig: is it a run?");
  if (std::filesystem::equivalent(own, rig))
    throw std::runtime_error(rig.string() +
                             ": is the rig as the run had it, which stays as it was");
  const RigCalibration recorded = load_calibration(own);
  const Proposal proposal = proposal_of(folder, recorded);
  const RigCalibration& proposed = proposal.calibration;

  Adoption adoption;
  adoption.before = load_calibration(rig);
  adoption.after = proposed;
  const path lens_file = calibration_file(rig);
  const std::string other_tags = tags_that_differ(adoption.before.markers, proposed.markers);
  const std::string other_lens = lens_values_that_differ(adoption.before.camera, proposed.camera);
  if (other_tags.empty() && other_lens.empty()) return adoption;

  Refusal refusal;
  refusal.add(folder / "markers.yaml", other_tags_text(recorded.markers, proposed.markers));
  refusal.add(folder / "camera_info.yaml", other_camera_text(recorded.camera, proposed.camera));
  refusal.add(rig / "markers.yaml",
              drift(own / "markers.yaml",
                    tags_that_differ(recorded.markers, adoption.before.markers), other_tags));
  refusal.add(lens_file,
              drift(calibration_file(own),
                    lens_values_that_differ(recorded.camera, adoption.before.camera), other_lens));
  // A calibration with an absolute path has no copy in the run.
  const std::int64_t seen_through = calibration_of_samples(run);
  if (seen_through != 0 && seen_through != calibration_id(recorded))
    refusal.add(run / "samples.lcmlog",
                fmt::format("the samples were not seen through {} and {}: one of them was changed "
                            "since",
                            (own / "markers.yaml").string(), calibration_file(own).string()));
  refusal.throw_if_any();

  const auto add = [&](const path& file, const std::string& after) {
    const path target = std::filesystem::canonical(file);
    adoption.files.push_back({target, read_file(target), after});
  };
  if (!other_tags.empty()) add(rig / "markers.yaml", *proposal.markers_text);
  if (!other_lens.empty()) add(lens_file, *proposal.camera_text);
  return adoption;
}

void adopt(const Adoption& adoption) {
  for (const Adoption::File& file : adoption.files)
    if (read_file(file.path) != file.before)
      throw std::runtime_error(file.path.string() +
                               ": was changed in the meantime; nothing was written");
  for (const Adoption::File& file : adoption.files)
    write_file_atomically(file.path.string() + kReplacedSuffix, file.before);
  for (const Adoption::File& file : adoption.files) write_file_atomically(file.path, file.after);
}

}  // namespace bodyschema
