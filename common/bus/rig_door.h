#pragma once

#include <filesystem>
#include <functional>
#include <map>
#include <string>
#include <type_traits>
#include <utility>

#include "common/bus/process.h"
#include "common/config/calibration_id.h"
#include "common/config/camera_calibration.h"
#include "common/config/rig.h"

namespace bodyschema {

/// Refuses messages of another rig: of a second group on the same bus, of a recording that is
/// played there. It knows this rig's signals.yaml, markers.yaml and the calibration that
/// camera.yaml names. A foreign message that agrees with all of them is not recognised: a bus is
/// for one robot.
class RigDoor {
 public:
  /// @throws ConfigError.
  explicit RigDoor(const std::filesystem::path& rig_folder)
      : RigDoor(rig_folder, bodyschema::calibration_file(rig_folder)) {}

  // "" if the message may be of this rig, else the reason why not, for people.

  /// The rig's own calibration: of this camera, this image size, these intrinsics.
  std::string objection(const camera_info_t& info) const;
  /// camera_name and calibration are the rig's, tags those of markers.yaml with their sizes.
  std::string objection(const marker_poses_t& poses) const;
  /// One value per signal; none if no MOVE is answered.
  std::string objection(const motion_status_t& status) const;
  /// The calibration is the rig's. One value per signal; parts of markers.yaml with their tags.
  std::string objection(const sample_t& sample) const;
  /// The calibration is the rig's, so are signals by name and limits, and parts of markers.yaml.
  std::string objection(const body_schema_t& schema) const;
  /// Parts of markers.yaml.
  std::string objection(const model_health_t& health) const;
  std::string objection(const sim_state_t& state) const;

  /// The newest BODY_SCHEMA of a file, to begin with. A schema that was learned from a recording
  /// has the recording's limits of the signals: the rig's replace them, unless a warp is defined on
  /// them.
  /// @throws std::runtime_error if there is none or it is of another rig.
  body_schema_t load_initial_schema(const std::filesystem::path& file) const;

  /// The calibration is that of the rig's tags and lens, or unknown (0).
  std::int64_t calibration_id() const { return calibration_id_; }

  /// False for a refused message: it is counted as "refused CHANNEL", logged once per channel and
  /// reported with the process's activity.
  template <class Message>
  bool lets_in(Process& process, const Channel<Message>& channel, const Message& message) const {
    const std::string why_not = objection(message);
    if (!why_not.empty()) refuse(process, channel.name, why_not);
    return why_not.empty();
  }

  /// Admits each SAMPLE that a process uses, once; false if it is refused. Counts parts that are
  /// left out ("position alone").
  bool takes(Process& process, const sample_t& sample) const;

  /// Subscribes behind the door: refused messages are not handled. The door must outlive the bus's
  /// use of it.
  template <class Message>
  void subscribe(Process& process, const Channel<Message>& channel,
                 std::type_identity_t<std::function<void(const Message&)>> handler) const {
    process.bus().subscribe(
        channel, [this, &process, channel, handler = std::move(handler)](const Message& message) {
          if (lets_in(process, channel, message)) handler(message);
        });
  }

 private:
  RigDoor(const std::filesystem::path& rig_folder, const std::filesystem::path& calibration);
  static void refuse(Process& process, const std::string& channel, const std::string& why);
  std::string objection_to_calibration(std::int64_t id, const char* what_to_do) const;
  std::string objection_to_part(int part) const;
  std::string objection_to_signals(std::size_t num_signals) const;

  const Signals signals_;
  const Markers markers_;
  const std::string calibration_file_;  ///< its name
  const CameraCalibration camera_;
  const std::int64_t calibration_id_;
};

}  // namespace bodyschema
