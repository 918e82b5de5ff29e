#include "common/scene/scene.h"

#include <tinyxml2.h>

#include <cmath>
#include <cstdio>
#include <cstring>
#include <stdexcept>

#include "common/bus/convert.h"

namespace bodyschema {
namespace {

using tinyxml2::XMLDocument;
using tinyxml2::XMLElement;

constexpr double kBackThickness_m = 0.004;
constexpr double kContactMargin_m = 0.003;
/// [N m s/rad or N s/m]: what a jammed joint yields is less than a microradian a motion.
constexpr double kStuckDamping = 1e7;

std::string text(std::initializer_list<double> values) {
  std::string result;
  for (const double value : values) {
    char buffer[32];
    std::snprintf(buffer, sizeof buffer, "%.17g", value);
    if (!result.empty()) result += ' ';
    result += buffer;
  }
  return result;
}

std::string text(const Eigen::Vector3d& v) { return text({v.x(), v.y(), v.z()}); }

XMLElement* child(XMLElement* parent, const char* name) {
  return parent->InsertNewChildElement(name);
}

void set(XMLElement* element, const char* key, const std::string& value) {
  element->SetAttribute(key, value.c_str());
}

void set_pose(XMLElement* element, const Pose& X) {
  const Eigen::Quaterniond q(X.rotation());
  set(element, "pos", text(X.translation()));
  set(element, "quat", text({q.w(), q.x(), q.y(), q.z()}));
}

void set_grey(XMLElement* element, double grey) {
  set(element, "rgba", text({grey, grey, grey, 1}));
}

/// Without a mass and contacts where `exists` is false: then it only keeps its place among the
/// geoms.
void add_shape(XMLElement* body, const std::string& name, const Shape& shape, bool exists = true) {
  XMLElement* geom = child(body, "geom");
  set(geom, "name", name);
  set_pose(geom, shape.X_LS);
  const Eigen::Vector3d& h = shape.half_size_m;
  switch (shape.kind) {
    case Shape::Kind::kBox:
      set(geom, "type", "box");
      set(geom, "size", text(h));
      break;
    case Shape::Kind::kCylinder:
    case Shape::Kind::kCapsule:
      set(geom, "type", shape.kind == Shape::Kind::kCylinder ? "cylinder" : "capsule");
      set(geom, "size", text({h.x(), h.y()}));
      break;
    case Shape::Kind::kSphere:
      set(geom, "type", "sphere");
      set(geom, "size", text({h.x()}));
      break;
  }
  set(geom, "mass", text({exists ? shape.mass_kg : 0}));
  set(geom, "material", "solid");
  set_grey(geom, shape.grey);
  if (!shape.collides || !exists) {
    set(geom, "contype", "0");
    set(geom, "conaffinity", "0");
  }
}

/// From the marker's frame to the centre of a layer of its plate.
Eigen::Translation3d plate_offset(double front_m, double thickness_m) {
  return Eigen::Translation3d(0, 0, front_m + thickness_m / 2);
}

// A sheet with the tag, its front face in the marker's plane, and a board behind it that shows a
// plain back: MuJoCo projects a 2-D texture through a box, so the sheet alone would show the tag
// mirrored on its back.
void add_plate(XMLElement* body, int id, double size_m, const Pose& X_LM, bool touches) {
  const double half_m = size_m * 10 / 8 / 2;
  const auto add_box = [&](const std::string& name, double front_m, double thickness_m) {
    XMLElement* geom = child(body, "geom");
    set(geom, "name", name);
    set(geom, "type", "box");
    set_pose(geom, X_LM * plate_offset(front_m, thickness_m));
    set(geom, "size", text({half_m, half_m, thickness_m / 2}));
    set(geom, "mass", "0");
    return geom;
  };
  XMLElement* sheet = add_box(tag_name(id), 0, kSheetThickness_m);
  set(sheet, "material", tag_name(id));
  set(sheet, "contype", "0");
  set(sheet, "conaffinity", "0");
  XMLElement* board = add_box(tag_name(id) + "_board", kSheetThickness_m, kBackThickness_m);
  set(board, "material", "solid");
  set_grey(board, 0.35);
  if (!touches) {
    set(board, "contype", "0");
    set(board, "conaffinity", "0");
  }
}

std::string tool_shape_name(int tool, std::size_t shape) {
  return "tool " + std::to_string(tool) + " shape " + std::to_string(shape);
}

void add_light(XMLElement* world, const Eigen::Vector3d& position, const Eigen::Vector3d& direction,
               double diffuse, double ambient, bool shadow) {
  XMLElement* light = child(world, "light");
  set(light, "directional", "true");
  set(light, "castshadow", shadow ? "true" : "false");
  set(light, "pos", text(position));
  set(light, "dir", text(direction));
  set(light, "diffuse", text({diffuse, diffuse, diffuse}));
  set(light, "ambient", text({ambient, ambient, ambient}));
  set(light, "specular", "0.15 0.15 0.15");
}

void add_options(XMLElement* mujoco) {
  XMLElement* compiler = child(mujoco, "compiler");
  set(compiler, "angle", "radian");
  set(compiler, "boundmass", "1e-6");
  set(compiler, "boundinertia", "1e-9");
  set(compiler, "inertiafromgeom", "true");
  XMLElement* option = child(mujoco, "option");
  set(option, "timestep", "0.002");
  set(option, "integrator", "implicit");

  // A configuration that is tried may be deep inside itself.
  set(child(mujoco, "size"), "nconmax", "2000");

  XMLElement* visual = child(mujoco, "visual");
  // The renderer's own lights do it all: a head light would make the brightness of a tag depend on
  // where the camera is.
  XMLElement* headlight = child(visual, "headlight");
  set(headlight, "active", "0");
  XMLElement* quality = child(visual, "quality");
  set(quality, "shadowsize", "4096");
  set(quality, "offsamples", "0");
  set(quality, "numslices", "32");

  XMLElement* defaults = child(child(mujoco, "default"), "geom");
  // A contact is reported from this distance on but pushes from 0 on: motions are refused by it.
  set(defaults, "margin", text({kContactMargin_m}));
  set(defaults, "gap", text({kContactMargin_m}));
  set(defaults, "condim", "1");
}

void add_assets(XMLElement* mujoco, const Robot& robot) {
  XMLElement* asset = child(mujoco, "asset");
  const auto add_texture = [&](const std::string& name, const char* type, const char* builtin,
                               int width, double grey_1, double grey_2) {
    XMLElement* texture = child(asset, "texture");
    if (!name.empty()) set(texture, "name", name);
    set(texture, "type", type);
    set(texture, "builtin", builtin);
    set(texture, "width", std::to_string(width));
    set(texture, "height", std::to_string(width));
    set(texture, "rgb1", text({grey_1, grey_1, grey_1}));
    set(texture, "rgb2", text({grey_2, grey_2, grey_2}));
  };
  const auto add_material = [&](const std::string& name, const std::string& texture,
                                double emission) {
    XMLElement* material = child(asset, "material");
    set(material, "name", name);
    if (!texture.empty()) set(material, "texture", texture);
    set(material, "emission", text({emission}));
    set(material, "specular", texture.empty() ? "0.4" : "0");
    set(material, "shininess", "0.3");
    return material;
  };
  add_texture("", "skybox", "gradient", 256, 0.88, 0.55);
  // Contrast below what the detector takes for an edge between black and white.
  add_texture("floor", "2d", "checker", 256, 0.60, 0.64);
  XMLElement* floor_material = add_material("floor", "floor", 0);
  set(floor_material, "texrepeat", "12 12");
  add_material("solid", "", 0);
  for (const int id : robot.markers.ids()) {
    add_texture(tag_name(id), "2d", "flat", kTagTexels, 1, 1);
    // Paper scatters light; without emission a plate in shade would lose its contrast.
    add_material(tag_name(id), tag_name(id), 0.35);
  }
}

/// Lights and floor.
void add_room(XMLElement* world, const Robot& robot) {
  const Eigen::Vector3d C = robot.X_WC.translation();
  const Eigen::Vector3d toward_camera = Eigen::Vector3d(C.x(), C.y(), 0).normalized();
  const Eigen::Vector3d left = Eigen::Vector3d::UnitZ().cross(toward_camera);
  const Eigen::Vector3d key = 1.2 * toward_camera - 1.0 * left + 2.2 * Eigen::Vector3d::UnitZ();
  const Eigen::Vector3d fill = 1.0 * toward_camera + 1.4 * left + 0.8 * Eigen::Vector3d::UnitZ();
  add_light(world, key, -key, 0.45, 0.22, true);
  add_light(world, fill, -fill, 0.18, 0.08, false);
  XMLElement* floor = child(world, "geom");
  set(floor, "name", "floor");
  set(floor, "type", "plane");
  set(floor, "size", "6 6 0.1");
  set(floor, "material", "floor");
}

void add_joint(XMLElement* body, XMLElement* actuator, const RobotJoint& moving) {
  XMLElement* joint = child(body, "joint");
  set(joint, "name", moving.name);
  set(joint, "type", moving.kind == RobotJoint::Kind::kRevolute ? "hinge" : "slide");
  set(joint, "axis", text(moving.axis));
  set(joint, "armature", text({moving.servo.armature}));
  if (moving.stuck_at) set(joint, "damping", text({kStuckDamping}));
  // <position> of this version has no velocity gain.
  const double kp = moving.servo.stiffness;
  XMLElement* servo = child(actuator, "general");
  set(servo, "joint", moving.name);
  set(servo, "gaintype", "fixed");
  set(servo, "biastype", "affine");
  set(servo, "gainprm", text({kp}));
  set(servo, "biasprm", text({0, -kp, -moving.servo.damping}));
}

/// The shapes of a link, the mounted tool and the others of its changer, and the tags.
void add_geoms(XMLElement* body, const SceneDescription& description, int i) {
  const Robot& robot = description.robot;
  const Link& link = robot.links[static_cast<std::size_t>(i)];
  for (std::size_t k = 0; k < link.shapes.size(); ++k) {
    add_shape(body, link.name + " shape " + std::to_string(k), link.shapes[k]);
  }
  if (robot.tool_changer && robot.tool_changer->link == i) {
    const ToolChanger& changer = *robot.tool_changer;
    for (int t = 0; t < static_cast<int>(changer.tools.size()); ++t) {
      for (std::size_t k = 0; k < changer.tools[t].shapes.size(); ++k) {
        add_shape(body, tool_shape_name(t, k), changer.tools[t].shapes[k], t == changer.mounted);
      }
    }
  }
  for (const PartPlacement& part : robot.parts) {
    if (part.link != i) continue;
    for (const TagPlacement& tag : robot.markers.tags) {
      if (tag.part == part.part) {
        add_plate(body, tag.id, tag.size_m, part.X_LB * tag.X_BM.value_or(Pose::Identity()),
                  !description.fallen_tags.contains(tag.id));
      }
    }
  }
}

std::string make_mjcf(const SceneDescription& description) {
  const Robot& robot = description.robot;
  XMLDocument document;
  XMLElement* mujoco = document.NewElement("mujoco");
  document.InsertEndChild(mujoco);
  set(mujoco, "model", robot.name);

  add_options(mujoco);
  add_assets(mujoco, robot);
  XMLElement* world = child(mujoco, "worldbody");
  add_room(world, robot);
  for (const TargetTag& tag : robot.markers.target_tags)
    add_plate(world, tag.id, tag.size_m, robot.X_WM_targets.at(tag.id), false);
  std::vector<XMLElement*> bodies;
  const auto body_of = [&](const std::string& link) {
    for (std::size_t i = 0; i < robot.links.size(); ++i) {
      if (robot.links[i].name == link) return bodies[i];
    }
    return world;
  };
  XMLElement* contact = child(mujoco, "contact");
  const auto exclude = [&](const std::string& link, const std::string& other) {
    XMLElement* element = child(contact, "exclude");
    set(element, "body1", link);
    set(element, "body2", other);
  };
  XMLElement* actuator = child(mujoco, "actuator");
  for (std::size_t i = 0; i < robot.links.size(); ++i) {
    const Link& link = robot.links[i];
    XMLElement* body = child(body_of(link.parent), "body");
    bodies.push_back(body);
    set(body, "name", link.name);
    set_pose(body, link.X_PL);
    if (link.joint) add_joint(body, actuator, robot.joints[*link.joint]);
    add_geoms(body, description, static_cast<int>(i));
    // MuJoCo ignores contacts of parent and child by itself, but not where the parent is fixed to
    // the world.
    if (link.parent != "world") exclude(link.parent, link.name);
  }
  for (const auto& [link, other] : robot.may_touch) exclude(link, other);

  tinyxml2::XMLPrinter printer;
  document.Print(&printer);
  return printer.CStr();
}

MjModelPtr compile(const std::string& mjcf, const std::string& name) {
  install_mujoco_handlers();
  // mjVFS is 2 MB: not for the stack.
  const auto vfs = std::make_unique<mjVFS>();
  mj_defaultVFS(vfs.get());
  const char* const file = "scene.xml";
  if (mj_makeEmptyFileVFS(vfs.get(), file, static_cast<int>(mjcf.size()) + 1) != 0) {
    throw std::runtime_error("MuJoCo: the virtual file system is full");
  }
  std::memcpy(vfs->filedata[mj_findFileVFS(vfs.get(), file)], mjcf.c_str(), mjcf.size() + 1);
  char error[1000] = "";
  MjModelPtr model(mj_loadXML(file, vfs.get(), error, sizeof error));
  mj_deleteVFS(vfs.get());
  if (!model) throw std::runtime_error(name + ": MuJoCo refuses the model: " + error);
  return model;
}

Pose pose_of(const mjtNum* position, const mjtNum* matrix) {
  Pose X = Pose::Identity();
  X.translation() = Eigen::Map<const Eigen::Vector3d>(position);
  X.linear() = Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(matrix);
  return X;
}

}  // namespace

std::string tag_name(int tag_id) { return "tag_" + std::to_string(tag_id); }

SceneDescription SceneDescription::load(const std::filesystem::path& rig_folder,
                                        std::optional<std::int64_t> seed) {
  SceneDescription description;
  description.signals = load_signals(rig_folder);
  description.robot = load_robot(rig_folder, description.signals, load_markers(rig_folder));
  if (seed) {
    description.robot = with_calibration_error(std::move(description.robot), *seed);
  } else {
    description.robot.calibration_error = {};
  }
  return description;
}

Scene::Scene(const std::filesystem::path& rig_folder) : Scene(SceneDescription::load(rig_folder)) {
  if (const auto problem = collision(*make_data())) {
    throw std::runtime_error(rig_folder.string() + ": at the start pose (home) " + *problem);
  }
}

Scene::Scene(SceneDescription description)
    : description_(std::move(description)),
      mjcf_(make_mjcf(description_)),
      model_(compile(mjcf_, description_.robot.name)) {
  for (const RobotJoint& joint : robot().joints) {
    const int id = mj_name2id(model_.get(), mjOBJ_JOINT, joint.name.c_str());
    qpos_address_.push_back(model_->jnt_qposadr[id]);
    dof_address_.push_back(model_->jnt_dofadr[id]);
  }
  for (const PartPlacement& part : robot().parts) {
    part_body_.push_back(
        mj_name2id(model_.get(), mjOBJ_BODY, robot().links[part.link].name.c_str()));
  }
}

int Scene::tag_geom(int tag_id) const {
  const int geom = mj_name2id(model_.get(), mjOBJ_GEOM, tag_name(tag_id).c_str());
  if (geom < 0) throw std::out_of_range("the scene has no tag " + std::to_string(tag_id));
  return geom;
}

int Scene::board_geom(int tag_id) const {
  return mj_name2id(model_.get(), mjOBJ_GEOM, (tag_name(tag_id) + "_board").c_str());
}

std::vector<int> Scene::plate_geoms(int part) const {
  std::vector<int> geoms;
  for (const TagPlacement& tag : markers().tags) {
    if (tag.part != part) continue;
    geoms.push_back(tag_geom(tag.id));
    geoms.push_back(board_geom(tag.id));
  }
  return geoms;
}

MjDataPtr Scene::make_data() const {
  MjDataPtr data(mj_makeData(model_.get()));
  if (!data) throw std::runtime_error("MuJoCo: no memory for mjData");
  set_joint_positions(*data, robot().joint_positions(robot().home));
  return data;
}

void Scene::set_joint_positions(mjData& data, const Eigen::VectorXd& positions) const {
  if (positions.size() != static_cast<Eigen::Index>(qpos_address_.size())) {
    throw std::invalid_argument("the robot has " + std::to_string(qpos_address_.size()) +
                                " joints, not " + std::to_string(positions.size()));
  }
  // Everything but the time starts anew, so that the motion depends on the positions alone.
  const double time = data.time;
  mj_resetData(model_.get(), &data);
  data.time = time;
  for (std::size_t i = 0; i < qpos_address_.size(); ++i) {
    data.qpos[qpos_address_[i]] = positions[i];
    data.ctrl[i] = positions[i];
  }
  mj_fwdPosition(model_.get(), &data);
}

Eigen::VectorXd Scene::joint_positions(const mjData& data) const {
  Eigen::VectorXd positions(qpos_address_.size());
  for (std::size_t i = 0; i < qpos_address_.size(); ++i) positions[i] = data.qpos[qpos_address_[i]];
  return positions;
}

double Scene::joint_speed(const mjData& data, int joint) const {
  return data.qvel[dof_address_.at(joint)];
}

std::optional<std::string> Scene::collision(const mjData& data) const {
  if (data.ncon == 0) return std::nullopt;
  // Those that may touch are excluded in the model, so any contact is one too many.
  const auto body_name = [&](int geom) {
    const int body = model_->geom_bodyid[geom];
    return body == 0 ? std::string("the floor")
                     : "link " + std::string(mj_id2name(model_.get(), mjOBJ_BODY, body));
  };
  const std::string first = body_name(data.contact[0].geom1);
  const std::string second = body_name(data.contact[0].geom2);
  if (first == "the floor" || second == "the floor") {
    return "collision of " + (first == "the floor" ? second : first) + " with the floor";
  }
  return "self-collision between " + first + " and " + second;
}

Pose Scene::part_pose(const mjData& data, int part_index) const {
  const int body = part_body_.at(part_index);
  return pose_of(data.xpos + 3 * body, data.xmat + 9 * body) * robot().parts[part_index].X_LB;
}

Pose Scene::marker_pose(const mjData& data, int tag_id) const {
  const auto fallen = description_.fallen_tags.find(tag_id);
  if (fallen != description_.fallen_tags.end()) return fallen->second;
  const int geom = tag_geom(tag_id);
  return pose_of(data.geom_xpos + 3 * geom, data.geom_xmat + 9 * geom) *
         Eigen::Translation3d(0, 0, -kSheetThickness_m / 2);
}

sim_state_t Scene::state(const mjData& data) const {
  sim_state_t state{};
  state.utime = std::llround(data.time * 1e6);
  state.action_id = -1;
  state.X_WC = to_message(robot().X_WC);
  std::vector<pose_t> geoms(model_->ngeom);
  for (int i = 0; i < model_->ngeom; ++i) {
    geoms[i] = to_message(pose_of(data.geom_xpos + 3 * i, data.geom_xmat + 9 * i));
  }
  for (const auto& [tag, X_WM] : description_.fallen_tags) {
    geoms[tag_geom(tag)] = to_message(Pose(X_WM * plate_offset(0, kSheetThickness_m)));
    geoms[board_geom(tag)] =
        to_message(Pose(X_WM * plate_offset(kSheetThickness_m, kBackThickness_m)));
  }
  set_array(state.num_geoms, state.X_WG, std::move(geoms));
  state.geom_alpha.assign(model_->ngeom, 1.0F);
  if (robot().tool_changer) {
    const ToolChanger& changer = *robot().tool_changer;
    for (int t = 0; t < static_cast<int>(changer.tools.size()); ++t) {
      if (t == changer.mounted) continue;
      for (std::size_t k = 0; k < changer.tools[t].shapes.size(); ++k) {
        state.geom_alpha[mj_name2id(model_.get(), mjOBJ_GEOM, tool_shape_name(t, k).c_str())] = 0;
      }
    }
  }
  std::vector<std::int32_t> parts;
  for (std::size_t i = 0; i < robot().parts.size(); ++i) {
    parts.push_back(robot().parts[i].part);
    state.X_WB.push_back(to_message(part_pose(data, static_cast<int>(i))));
  }
  set_array(state.num_parts, state.true_part, std::move(parts));
  return state;
}

sim_state_t Scene::state_at(const Eigen::VectorXd& action, std::int64_t seed,
                            std::int64_t action_id) const {
  const MjDataPtr data = make_data();
  set_joint_positions(*data, robot().joint_positions(action));
  sim_state_t result = state(*data);
  result.seed = seed;
  result.action_id = action_id;
  return result;
}

}  // namespace bodyschema
