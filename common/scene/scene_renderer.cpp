#include "common/scene/scene_renderer.h"

#include <algorithm>
#include <cmath>
#include <opencv2/calib3d.hpp>
#include <opencv2/imgproc.hpp>
#include <stdexcept>
#include <string>
#include <vector>

#include "common/bus/convert.h"
#include "common/scene/egl_context.h"
#include "common/scene/image_lookup.h"
#include "common/scene/scene.h"
#include "common/scene/tag_bitmap.h"

namespace bodyschema {
namespace {

constexpr float kNear_m = 0.05F;
constexpr float kFar_m = 30.0F;
constexpr int kMaxSide_px = 4096;
constexpr int kMaxDrawn_px = 16384;  // of OpenGL
// Ink and paper: no printed black is black, and white must not saturate where light adds up.
constexpr int kInk = 18;
constexpr int kPaper = 235;

/// A pinhole camera without distortion, axes of pixels as in CameraCalibration.
struct Pinhole {
  int width, height;
  double fx, fy, cx, cy;
};

cv::Matx33d matrix_of(const CameraCalibration& c) {
  return {c.fx, 0, c.cx, 0, c.fy, c.cy, 0, 0, 1};
}

/// For every pixel of the distorted image where the undistorted ray meets z = 1.
cv::Mat undistorted_rays(const CameraCalibration& calibration) {
  cv::Mat pixels(calibration.height * calibration.width, 1, CV_64FC2);
  for (int v = 0; v < calibration.height; ++v) {
    for (int u = 0; u < calibration.width; ++u) {
      pixels.at<cv::Vec2d>(v * calibration.width + u) = cv::Vec2d(u, v);
    }
  }
  const cv::TermCriteria precise(cv::TermCriteria::COUNT | cv::TermCriteria::EPS, 40, 1e-10);
  cv::Mat rays;
  if (calibration.model == CameraCalibration::Model::kFisheye) {
    cv::fisheye::undistortPoints(pixels, rays, matrix_of(calibration), calibration.distortion);
  } else {
    cv::undistortPoints(pixels, rays, matrix_of(calibration), calibration.distortion, cv::noArray(),
                        cv::noArray(), precise);
  }
  return rays.reshape(2, calibration.height);
}

}  // namespace

struct SceneRenderer::Implementation {
  Implementation(SceneDescription description, CameraCalibration calibration_given,
                 ImageEffects effects_given)
      : scene(std::move(description)),
        calibration(std::move(calibration_given)),
        effects(effects_given),
        noise(effects.noise_sd) {
    pinhole = {calibration.width, calibration.height, calibration.fx,
               calibration.fy,    calibration.cx,     calibration.cy};
    const bool is_distorted =
        std::any_of(calibration.distortion.begin(), calibration.distortion.end(),
                    [](double k) { return k != 0; });
    if (is_distorted) make_remap();

    if (std::max(drawn_size().width, drawn_size().height) > kMaxDrawn_px) {
      throw std::runtime_error(
          "camera " + calibration.camera_name + ": " + std::to_string(effects.pixel_samples) +
          " samples along each side of a pixel are too many for " + std::to_string(pinhole.width) +
          " × " + std::to_string(pinhole.height) + " px");
    }
    // The renderer owns a copy of the model: it changes buffer size and textures.
    model.reset(mj_copyModel(nullptr, &scene.model()));
    model->vis.global.offwidth = drawn_size().width;
    model->vis.global.offheight = drawn_size().height;
    model->vis.quality.offsamples = 0;
    paint_tags();

    egl.make_current();
    mjv_defaultScene(&abstract_scene);
    mjv_makeScene(model.get(), &abstract_scene, model->ngeom + 10);
    mjr_defaultContext(&context);
    mjr_makeContext(model.get(), &context, mjFONTSCALE_100);
    mjr_setBuffer(mjFB_OFFSCREEN, &context);
    if (context.currentBuffer != mjFB_OFFSCREEN) {
      throw std::runtime_error("rendering without a display: OpenGL has no frame buffer objects");
    }
    make_templates();
    floor_geom = mj_name2id(model.get(), mjOBJ_GEOM, "floor");
  }

  ~Implementation() {
    egl.make_current();
    mjr_freeContext(&context);
    mjv_freeScene(&abstract_scene);
  }

  // The distorted image is looked up in a larger pinhole image of the same focal length, so that
  // resolution is kept in the centre.
  void make_remap() {
    const cv::Mat rays = undistorted_rays(calibration);
    std::vector<cv::Mat> xy;
    cv::split(rays, xy);
    double lower[2], upper[2];
    for (int i = 0; i < 2; ++i) cv::minMaxLoc(xy[i], &lower[i], &upper[i]);
    const int left = static_cast<int>(std::floor(lower[0] * calibration.fx)) - 5;
    const int right = static_cast<int>(std::ceil(upper[0] * calibration.fx)) + 5;
    const int top = static_cast<int>(std::floor(lower[1] * calibration.fy)) - 5;
    const int bottom = static_cast<int>(std::ceil(upper[1] * calibration.fy)) + 5;
    if (!(upper[0] < 5 && upper[1] < 5 && lower[0] > -5 && lower[1] > -5) ||
        right - left > kMaxSide_px || bottom - top > kMaxSide_px) {
      throw std::runtime_error("camera " + calibration.camera_name +
                               ": the distortion cannot be inverted over the whole image");
    }
    pinhole.width = right - left + 1;
    pinhole.height = bottom - top + 1;
    pinhole.cx = -left;
    pinhole.cy = -top;
    distort = ImageLookup(xy[0] * pinhole.fx + pinhole.cx, xy[1] * pinhole.fy + pinhole.cy,
                          pinhole.width, pinhole.height);
  }

  void paint_tags() const {
    for (const int id : scene.markers().ids()) {
      const int texture = mj_name2id(model.get(), mjOBJ_TEXTURE, tag_name(id).c_str());
      const cv::Mat bitmap = tag_bitmap(id, kTagTexels / 10);
      mjtByte* texel = model->tex_rgb + model->tex_adr[texture];
      // MuJoCo's texture has its first row at −y of the box, which is the tag's upper edge (y of
      // the marker points down), and its columns along +x, as the tag's.
      for (int v = 0; v < kTagTexels; ++v) {
        for (int u = 0; u < kTagTexels; ++u, texel += 3) {
          const int value = bitmap.at<std::uint8_t>(kTagTexels - 1 - v, u) > 127 ? kPaper : kInk;
          std::fill_n(texel, 3, static_cast<mjtByte>(value));
        }
      }
    }
  }

  void make_templates() {
    const MjDataPtr data(mj_makeData(model.get()));
    mj_forward(model.get(), data.get());
    mjvOption option;
    mjv_defaultOption(&option);
    // Every geom, whatever its group.
    std::fill(std::begin(option.geomgroup), std::end(option.geomgroup), mjtByte{1});
    mjvCamera camera;
    mjv_defaultCamera(&camera);
    mjv_updateScene(model.get(), data.get(), &option, nullptr, &camera, mjCAT_ALL, &abstract_scene);
    for (int i = 0; i < abstract_scene.ngeom; ++i) {
      if (abstract_scene.geoms[i].objtype == mjOBJ_GEOM) {
        templates.push_back(abstract_scene.geoms[i]);
      }
    }
    abstract_scene.flags[mjRND_SHADOW] = effects.shadows;
    abstract_scene.flags[mjRND_REFLECTION] = 0;
  }

  void place_camera(const Pose& X_WC) {
    const double fy = pinhole.fy;
    mjvGLCamera camera{};
    const Eigen::Vector3f position = X_WC.translation().cast<float>();
    const Eigen::Vector3f forward = X_WC.linear().col(2).cast<float>();
    const Eigen::Vector3f up = -X_WC.linear().col(1).cast<float>();
    std::copy_n(position.data(), 3, camera.pos);
    std::copy_n(forward.data(), 3, camera.forward);
    std::copy_n(up.data(), 3, camera.up);
    camera.frustum_near = kNear_m;
    camera.frustum_far = kFar_m;
    // The image's edges are half a pixel outside the centres of the outermost pixels. Both are
    // divided by fy: place_geoms() has stretched the scene by fx / fy.
    camera.frustum_center =
        static_cast<float>(kNear_m * ((pinhole.width - 1) / 2.0 - pinhole.cx) / fy);
    camera.frustum_top = static_cast<float>(kNear_m * (pinhole.cy + 0.5) / fy);
    camera.frustum_bottom = static_cast<float>(kNear_m * (pinhole.cy + 0.5 - pinhole.height) / fy);
    abstract_scene.camera[0] = camera;
    abstract_scene.camera[1] = camera;
  }

  enum class Layer { kAll, kBackdrop, kForeground };

  cv::Mat draw(const sim_state_t& state, const Pose& X_WC, Layer layer) {
    place_geoms(state, X_WC, layer);
    abstract_scene.flags[mjRND_SKYBOX] = layer != Layer::kForeground;
    const mjrRect viewport{0, 0, drawn_size().width, drawn_size().height};
    mjr_render(viewport, &abstract_scene, &context);
    return read_pixels(viewport);
  }

  // Sky and floor fill the image and cost three quarters of the time, but change only with the
  // camera's pose; so they are kept, and the robot is drawn over them. OpenGL leaves pixels without
  // robot as black as a cleared buffer, which no lit solid is. Shadows need everything in one go.
  cv::Mat draw(const sim_state_t& state) {
    const Pose X_WC = from_message(state.X_WC);
    place_camera(X_WC);
    if (effects.shadows) return exposed(draw(state, X_WC, Layer::kAll));
    if (backdrop.empty() || X_WC.matrix() != backdrop_X_WC.matrix() ||
        state.geom_alpha[floor_geom] != backdrop_alpha) {
      backdrop = draw(state, X_WC, Layer::kBackdrop);
      exposed_backdrop = exposed(backdrop);
      backdrop_X_WC = X_WC;
      backdrop_alpha = state.geom_alpha[floor_geom];
    }
    const cv::Mat robot = draw(state, X_WC, Layer::kForeground);
    // Where the robot is and its blur reaches, and what blurs into that [px].
    const int n = effects.pixel_samples,
              reach = static_cast<int>(std::ceil(4 * effects.blur_sd_px)) + 1;
    const cv::Rect drawn = cv::boundingRect(robot);
    if (drawn.empty()) return exposed_backdrop;
    const auto grown = [&](int margin) {
      const cv::Point low(drawn.x / n - margin, drawn.y / n - margin);
      const cv::Point high(drawn.br().x / n + 1 + margin, drawn.br().y / n + 1 + margin);
      return cv::Rect(low, high) & cv::Rect(0, 0, pinhole.width, pinhole.height);
    };
    const cv::Rect changed = grown(reach), around = grown(2 * reach);
    const cv::Rect around_drawn(n * around.x, n * around.y, n * around.width, n * around.height);
    cv::Mat both = backdrop(around_drawn).clone();
    robot(around_drawn).copyTo(both, robot(around_drawn));
    cv::Mat image = exposed_backdrop.clone();
    exposed(both)(changed - around.tl()).copyTo(image(changed));
    return image;
  }

  /// Pixels of the drawing, before they are integrated to the camera's.
  cv::Size drawn_size() const {
    return {effects.pixel_samples * pinhole.width, effects.pixel_samples * pinhole.height};
  }

  /// CV_32FC1: blurred at the drawing's resolution, then each pixel's mean. With one sample a pixel
  /// an edge along rows or columns is up to 0.02 px off.
  cv::Mat exposed(const cv::Mat& drawn) const {
    cv::Mat image;
    constexpr double kFine = 256;
    drawn.convertTo(image, CV_16U, kFine);
    if (effects.blur_sd_px > 0)
      cv::GaussianBlur(image, image, {}, effects.pixel_samples * effects.blur_sd_px);
    image.convertTo(image, CV_32F, 1 / kFine);
    if (effects.pixel_samples > 1)
      cv::resize(image, image, drawn.size() / effects.pixel_samples, 0, 0, cv::INTER_AREA);
    return image;
  }

  // MuJoCo's frustum has square pixels. fx ≠ fy is made by stretching the scene along the camera's
  // x axis, about its centre: the projection is the same, exactly.
  void place_geoms(const sim_state_t& state, const Pose& X_WC, Layer layer) {
    const Eigen::Vector3d x = X_WC.linear().col(0);
    const Eigen::Vector3d C = X_WC.translation();
    const Eigen::Matrix3d stretch =
        Eigen::Matrix3d::Identity() + (pinhole.fx / pinhole.fy - 1) * x * x.transpose();
    abstract_scene.ngeom = 0;
    for (const mjvGeom& geom : templates) {
      if (layer != Layer::kAll && (layer == Layer::kBackdrop) != (geom.objid == floor_geom))
        continue;
      const float alpha = state.geom_alpha[geom.objid];
      if (alpha <= 0) continue;
      const Pose X_WG = from_message(state.X_WG[geom.objid]);
      const Eigen::Vector3f position = (C + stretch * (X_WG.translation() - C)).cast<float>();
      const Eigen::Matrix<float, 3, 3, Eigen::RowMajor> matrix =
          (stretch * X_WG.linear()).cast<float>();
      mjvGeom& placed = abstract_scene.geoms[abstract_scene.ngeom++];
      placed = geom;
      std::copy_n(position.data(), 3, placed.pos);
      std::copy_n(matrix.data(), 9, placed.mat);
      placed.rgba[3] *= alpha;
    }
  }

  cv::Mat read_pixels(const mjrRect& viewport) {
    rgb.create(drawn_size(), CV_8UC3);
    mjr_readPixels(rgb.data, nullptr, viewport, &context);
    // Every colour of the scene is grey, and OpenGL's first row is the lowest.
    cv::Mat grey, upright;
    cv::extractChannel(rgb, grey, 0);
    cv::flip(grey, upright, 0);
    return upright;
  }

  Scene scene;
  CameraCalibration calibration;
  ImageEffects effects;
  SensorNoise noise;
  Pinhole pinhole{};
  ImageLookup distort;  // empty without distortion
  MjModelPtr model;
  EglContext egl;
  mjvScene abstract_scene{};
  mjrContext context{};
  std::vector<mjvGeom> templates;
  int floor_geom = -1;
  cv::Mat backdrop;
  Pose backdrop_X_WC = Pose::Identity();
  float backdrop_alpha = 1;
  cv::Mat exposed_backdrop;
  cv::Mat image;  // without noise, of the last state
  std::vector<std::uint8_t> scene_of_image;
  cv::Mat rgb;
};

SceneRenderer::SceneRenderer(const std::filesystem::path& rig_folder, ImageEffects effects)
    : SceneRenderer(SceneDescription::load(rig_folder), effects) {}

SceneRenderer::SceneRenderer(const SceneDescription& description, ImageEffects effects)
    : implementation_(
          std::make_unique<Implementation>(description, description.robot.lens, effects)) {}

SceneRenderer::SceneRenderer(const std::filesystem::path& rig_folder, CameraCalibration calibration,
                             ImageEffects effects)
    : implementation_(std::make_unique<Implementation>(SceneDescription::load(rig_folder),
                                                       std::move(calibration), effects)) {}

SceneRenderer::~SceneRenderer() = default;

const CameraCalibration& SceneRenderer::calibration() const { return implementation_->calibration; }

cv::Mat SceneRenderer::render(const sim_state_t& state, int frame) {
  Implementation& self = *implementation_;
  const std::size_t num_geoms = self.scene.model().ngeom;
  if (state.X_WG.size() != num_geoms || state.geom_alpha.size() != num_geoms) {
    throw std::invalid_argument("SIM_STATE has " + std::to_string(state.X_WG.size()) +
                                " geoms, the rig's scene " + std::to_string(num_geoms) +
                                ": is the simulator running another rig?");
  }
  // The frames of a rest differ in their noise alone.
  std::vector<std::uint8_t> scene(static_cast<std::size_t>(state.getEncodedSize()));
  state.encode(scene.data(), 0, static_cast<int>(scene.size()));
  if (self.image.empty() || scene != self.scene_of_image) {
    self.egl.make_current();
    cv::Mat image = self.draw(state);
    // After the blur: an image that is interpolated must not have detail finer than its pixels.
    if (!self.distort.empty()) image = self.distort(image);
    self.image = image;
    self.scene_of_image = std::move(scene);
  }
  return self.noise.read(self.image, state.seed, state.action_id, frame);
}

}  // namespace bodyschema
