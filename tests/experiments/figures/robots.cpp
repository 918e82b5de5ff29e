#include "tests/experiments/figures/robots.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <memory>
#include <numeric>

#include "common/geometry/angle.h"
#include "common/text/text.h"
#include "processes/structure_learner/baseline/fit_matrix_gp.h"
#include "tests/experiments/figures/statistics.h"

namespace bodyschema::experiments {

using test::Regime;
using test::Rightness;
using test::Rng;

std::vector<ActionPoseSample> Trial::first(int num_samples) const {
  return {samples.begin(), samples.begin() + num_samples};
}

Trial make_trial(const std::string& kind, Regime regime, int num_samples, int seed, double bend) {
  Rng rng(static_cast<Rng::result_type>(seed));
  Trial trial;
  trial.regime = regime;
  if (kind.starts_with("tree")) {
    test::RandomTreeOptions options;
    if (kind == "tree3") options.adjacent_hidden = true;
    if (kind == "tree40") {
      options.num_parts = 40;
      options.num_hidden = 3;
      options.share_fixed = 0.25;
    }
    trial.robot = test::random_tree(options, rng);
  } else {
    trial.robot = test::chapter_robot(kind, rng);
  }
  trial.robot.bend = bend;
  test::ObservationOptions observation;
  observation.regime = regime;
  observation.with_covariances = true;
  trial.samples = test::babble(trial.robot, num_samples, observation, rng);
  // A random stream of their own, so that they do not depend on the observations.
  Rng test_rng(0x7e57'0000u + static_cast<Rng::result_type>(seed));
  for (int n = 0; n < kTestPoses; ++n)
    trial.test_actions.push_back(trial.robot.random_action(test_rng));
  return trial;
}

std::optional<PoseErrors> end_effector_errors(const BodySchema& schema, const Trial& trial) {
  PoseErrors errors;
  const int from = trial.root(), to = trial.end_effector();
  for (const Eigen::VectorXd& q : trial.test_actions) {
    const auto predicted = schema.predict(from, to, q);
    if (!predicted) return std::nullopt;
    const auto truth = trial.robot.poses_in_camera(q);
    const Pose X_FT = truth.at(from).inverse() * truth.at(to);
    const double distance = (predicted->X_AB.translation() - X_FT.translation()).norm();
    errors.position_mean_m += distance / kTestPoses;
    errors.position_rms_m += distance * distance / kTestPoses;
    errors.rotation_mean_rad += rotation_angle(X_FT.inverse() * predicted->X_AB) / kTestPoses;
  }
  errors.position_rms_m = std::sqrt(errors.position_rms_m);
  return errors;
}

BaselineOptions baseline_options(Regime regime) {
  BaselineOptions options;
  if (regime == Regime::kChapter) return options;
  Noise noise = test::nominal_noise(regime);
  noise.position_m = std::max(noise.position_m, 0.001);
  noise.rotation_rad = std::max(noise.rotation_rad, 0.3 * kDegree);
  options.set_noise(noise);
  return options;
}

BodySchema baseline_on_true_structure(const Trial& trial,
                                      const std::vector<ActionPoseSample>& samples) {
  const test::SyntheticRobot& robot = trial.robot;
  BodySchema schema;
  schema.signals = robot.signals;
  schema.parts = robot.visible_parts();
  schema.root = trial.root();
  std::vector<int> reached{schema.root};
  std::vector<int> missing(schema.parts.begin() + 1, schema.parts.end());
  // Prim: always the part that the fewest joints separate from what is connected.
  while (!missing.empty()) {
    std::size_t fewest = SIZE_MAX;
    Edge edge;
    for (const int from : reached) {
      for (const int to : missing) {
        const std::size_t joints = robot.path_joints(from, to).size();
        if (joints >= fewest) continue;
        fewest = joints;
        edge.from = from;
        edge.to = to;
      }
    }
    reached.push_back(edge.to);
    std::erase(missing, edge.to);
    const std::set<int> on_path = robot.path_signals(edge.from, edge.to);
    const std::vector<int> signals(on_path.begin(), on_path.end());
    std::vector<Eigen::VectorXd> inputs;
    std::vector<Pose> poses;
    for (const ActionPoseSample& sample : samples) {
      const PartObservation *from = sample.find(edge.from), *to = sample.find(edge.to);
      if (!from || !to) continue;
      inputs.push_back(sample.action(signals));
      poses.push_back(from->X_CB.inverse() * to->X_CB);
    }
    if (poses.size() < 2) continue;
    Eigen::MatrixXd columns(signals.size(), inputs.size());
    for (std::size_t t = 0; t < inputs.size(); ++t)
      columns.col(static_cast<Eigen::Index>(t)) = inputs[t];
    edge.matrix_gp = std::make_shared<const MatrixGp>(fit_matrix_gp(signals, columns, poses));
    schema.edges.push_back(edge);
  }
  schema.complete = schema.edges.size() + 1 == schema.parts.size();
  return schema;
}

void Judgements::add(Rightness rightness) {
  right += rightness == Rightness::kRight;
  incomplete += rightness == Rightness::kIncomplete;
  wrong += rightness == Rightness::kWrong;
}

std::string Judgements::text() const {
  if (total() == 0) return "–";
  const auto share = [&](int count) { return short_number(100.0 * count / total()); };
  return fmt::format("{} / {} / {}", percentage(right, total()), share(incomplete), share(wrong));
}

std::string structure_of(const BodySchema& schema) {
  const auto name_of = [&](int signal) { return schema.signals.at(signal).name; };
  const std::string result = listed(schema.edges, [&](const Edge& edge) {
    return fmt::format("{}–{} {{{}}}", edge.from, edge.to, listed(edge.signals(), name_of));
  });
  return result.empty() ? "nothing" : result;
}

}  // namespace bodyschema::experiments
