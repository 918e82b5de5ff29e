#pragma once

#include <filesystem>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "common/estimation/measurement_model.h"
#include "common/geometry/pose.h"
#include "common/schema/signal.h"

namespace bodyschema {

class Yaml;

/// One tag of a rig's markers.yaml, or of its robot.yaml as it truly is.
struct TagPlacement {
  int id = 0;
  double size_m = 0;  ///< side of the black square
  int part = 0;
  /// Pose of the marker on its part; std::nullopt where it was never measured: then the part may
  /// carry no other tag, and its frame is the marker's.
  std::optional<Pose> X_BM;
};

/// A tag on no part of the robot: a part can be brought to it (pose_target_t::KIND_TAG).
struct TargetTag {
  int id = 0;
  double size_m = 0;  ///< side of the black square
};

/// markers.yaml: which tags there are and which body part each belongs to.
struct Markers {
  std::string family;                       ///< AprilTag family, e.g. "tag36h11"
  std::vector<TagPlacement> tags;           ///< ascending id
  std::vector<TargetTag> target_tags = {};  ///< ascending id, none of `tags`
  std::vector<int> parts() const;           ///< ascending, each once
  const TagPlacement* find(int tag_id) const;
  bool is_target(int tag_id) const;
  /// Of a part's tag or a target; none: there is no such tag.
  std::optional<double> size_m(int tag_id) const;
  /// Of all tags: those of parts, then targets.
  std::vector<int> ids() const;
};

/// signals.yaml: the action signals and their limits, and what the rig calls its root and its end
/// effector.
struct Signals {
  std::vector<Signal> signals;
  std::optional<int> root_part;
  int end_effector_part = 0;
};

/// noise.yaml: the errors of observed poses, for every process that uses them.
struct RigNoise {
  double corner_noise_px = 0;     ///< AprilTag's own corners: see CornerNoise
  double small_tag_noise_px = 0;  ///< see CornerNoise
  MeasurementModel measurement;   ///< of poses of parts
};

/// network.yaml: the bus of a rig's process group.
struct Network {
  bool is_private = true;  ///< in a network namespace of its own, else on the host's network
  int port = 0;            ///< UDP port of the bus; images use port + 1
  int ttl = 0;
  /// Which processes run on which host, by the host's name; empty: all on one machine.
  std::map<std::string, std::vector<std::string>> hosts;

  std::string bus_url() const;
  /// True if the group is split over hosts: then images never leave their host. With lost packets
  /// their fragments would fill every other host's memory for incomplete datagrams, for 30 s each
  /// time, and small messages would be lost with them.
  std::string images_url() const;
  /// The processes of `host`, in the order of hosts.
  /// @throws std::invalid_argument if there is no such host.
  std::vector<std::string> share_of(const std::string& host) const;
};

/// The list `tags` of a mapping, as markers.yaml has it, ascending id. @throws ConfigError.
std::vector<TagPlacement> load_tags(const Yaml& yaml);
/// The list `target_tags` of a mapping, which may be missing, ascending id; `tags` are those of the
/// parts. `X_CM`: where robot.yaml has their poses. @throws ConfigError.
std::vector<TargetTag> load_target_tags(const Yaml& yaml, const std::vector<TagPlacement>& tags,
                                        std::map<int, Pose>* X_CM = nullptr);
/// @throws ConfigError.
Markers load_markers(const std::filesystem::path& rig_folder);
Signals load_signals(const std::filesystem::path& rig_folder);
/// `file`: also ideal_noise.yaml, which stands in for it in `./run --ideal`.
RigNoise load_noise(const std::filesystem::path& rig_folder,
                    const std::string& file = "noise.yaml");
/// `group`: all processes of the rig's group. If there are any, each must run on exactly one host.
Network load_network(const std::filesystem::path& rig_folder,
                     const std::vector<std::string>& group = {});

}  // namespace bodyschema
