#pragma once

#include <Eigen/Core>
#include <sstream>
#include <string>

#include "bodyschema/motion_status_t.hpp"
#include "bodyschema/pose_target_t.hpp"
#include "bodyschema/sample_t.hpp"

// What the files of class Controller share.

namespace bodyschema {

inline constexpr char kHalted[] = "the arm is halted; first: ./run resume (or bodyschema resume)";

inline std::string seconds(std::int64_t us) {
  std::ostringstream text;
  text << static_cast<double>(us) / 1e6 << " s";
  return text.str();
}

inline std::string name_of(std::int64_t action_id, const std::string& source) {
  return "action " + std::to_string(action_id) + " of " + source;
}

inline Eigen::Vector3d position_of(const pose_target_t& target) {
  return Eigen::Map<const Eigen::Vector3d>(target.position_m);
}

inline bool is_same_action(const motion_status_t& motion, const sample_t& sample) {
  return motion.source == sample.source && motion.epoch == sample.epoch &&
         motion.action_id == sample.action_id;
}

inline bool is_same_action(const sample_t& a, const sample_t& b) {
  return a.source == b.source && a.epoch == b.epoch && a.action_id == b.action_id;
}

}  // namespace bodyschema
