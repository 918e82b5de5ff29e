#include "processes/refiner/refiner_settings.h"

namespace bodyschema {

RefinerSettings RefinerSettings::load(const std::filesystem::path& rig_folder,
                                      const RefinerConfig& config) {
  RefinerSettings settings;
  settings.options.config = config;
  settings.options.placements = config.placements;
  settings.options.intrinsics = config.intrinsics;
  const RigNoise noise = load_noise(rig_folder);
  settings.options.corner_noise = {noise.corner_noise_px, noise.small_tag_noise_px};
  settings.options.measurement = noise.measurement;
  settings.rig = load_calibration(rig_folder);
  return settings;
}

}  // namespace bodyschema
