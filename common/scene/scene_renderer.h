#pragma once

#include <filesystem>
#include <memory>
#include <opencv2/core/mat.hpp>

#include "bodyschema/sim_state_t.hpp"
#include "common/config/camera_calibration.h"
#include "common/scene/image_effects.h"
#include "common/scene/scene.h"

namespace bodyschema {

/// The simulated camera: SIM_STATE in, grey image out, of the size and with the intrinsics and
/// distortion of robot.yaml's lens. Poses and visibility of all geoms come from the state;
/// the joints are unknown here. Two renderings of one (state, frame) are equal bit by bit on one
/// machine. Headless; 1280×960 takes about 15 ms on one core with one sample a pixel and without
/// distortion and shadows.
///
/// To be used from one thread at a time.
class SceneRenderer {
 public:
  /// The ideal robot's lens and tags. @throws ConfigError on the rig's files; std::runtime_error
  /// where OpenGL does not work.
  explicit SceneRenderer(const std::filesystem::path& rig_folder, ImageEffects effects = {});
  /// Lens and tags of this robot, e.g. with calibration errors.
  SceneRenderer(const SceneDescription& description, ImageEffects effects);
  /// The ideal robot behind another lens.
  SceneRenderer(const std::filesystem::path& rig_folder, CameraCalibration calibration,
                ImageEffects effects);
  ~SceneRenderer();
  SceneRenderer(const SceneRenderer&) = delete;
  SceneRenderer& operator=(const SceneRenderer&) = delete;

  const CameraCalibration& calibration() const;

  /// CV_8UC1. Blur and noise differ from frame to frame, the scene does not.
  /// @throws std::invalid_argument if the state is not of this rig's scene.
  cv::Mat render(const sim_state_t& state, int frame);

 private:
  struct Implementation;
  std::unique_ptr<Implementation> implementation_;
};

}  // namespace bodyschema
