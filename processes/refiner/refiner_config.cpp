#include "processes/refiner/refiner_config.h"

#include "common/config/refinement_schedule.h"
#include "common/config/yaml.h"

namespace bodyschema {

RefinerConfig RefinerConfig::load(const std::filesystem::path& file) {
  const Yaml yaml = Yaml::load(file);
  RefinerConfig config;
  config.enabled = yaml.boolean("enabled");
  config.refine_every = bodyschema::refine_every(yaml);
  config.placements = yaml.boolean("placements");
  config.intrinsics = yaml.boolean("intrinsics");
  if (!config.placements && !config.intrinsics)
    throw yaml.error("intrinsics", "is false, and so is placements: nothing is left to refine");
  config.tags.position_m = yaml.number("tag_position_m", 1e-6, 1);
  config.tags.rotation_rad = yaml.number("tag_rotation_deg", 1e-3, 90) * kDegree;
  config.tags.size_share = yaml.number("tag_size_share", 1e-6, 0.5);
  config.focal_length_share = yaml.number("focal_length_share", 1e-6, 0.5);
  config.centre_px = yaml.number("centre_px", 1e-3, 1e4);
  config.distortion = yaml.number("distortion", 1e-6, 10);
  config.joint_play.position_m = yaml.number("joint_play_m", 1e-7, 1);
  config.joint_play.rotation_rad = yaml.number("joint_play_deg", 1e-4, 90) * kDegree;
  config.max_samples = static_cast<int>(yaml.integer("max_samples", 10, 100'000));
  yaml.finish();
  return config;
}

}  // namespace bodyschema
