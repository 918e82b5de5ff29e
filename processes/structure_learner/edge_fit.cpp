#include "processes/structure_learner/edge_fit.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "processes/structure_learner/joint_scatter.h"
#include "processes/structure_learner/residual_fit.h"
#include "processes/structure_learner/root_pose.h"
#include "processes/structure_learner/tree_fit.h"
#include "processes/structure_learner/wrong_commands.h"

namespace bodyschema {
namespace {

// The same model over command units: Exp(ŝ (q − centre)/half_range).
Edge to_edge(const LocalModel& model, const NormalizedActions& actions) {
  Edge edge;
  edge.left = model.first;
  for (int d = 0; d < model.num_joints(); ++d) {
    ScrewJoint joint;
    joint.signal = model.joints[d].signal;
    joint.offset = -actions.centre(joint.signal);
    joint.slide = model.joints[d].slide / actions.half_range(joint.signal);
    joint.turn = model.joints[d].turn / actions.half_range(joint.signal);
    joint.X_after = model.joints[d].X_after;
    joint.order_group = model.joints[d].order_group;
    edge.joints.push_back(joint);
  }
  return edge;
}

// `scatter` [half ranges] by joint.
void set_scatter(const Eigen::VectorXd& scatter, const NormalizedActions& actions, Edge* edge) {
  for (Eigen::Index d = 0; d < scatter.size(); ++d) {
    ScrewJoint& joint = edge->joints[static_cast<std::size_t>(d)];
    joint.scatter = scatter(d) * actions.half_range(joint.signal);
  }
}

// [half ranges], of the joints of `nodes` in their order.
Eigen::VectorXd scatter_of(const std::vector<FittedEdge>& fitted,
                           const std::vector<TreeNode>& nodes, const NormalizedActions& actions) {
  std::vector<double> result;
  for (std::size_t k = 1; k < nodes.size(); ++k)
    for (const FittedEdge& f : fitted)
      if (f.edge.to == nodes[k].part)
        for (const ScrewJoint& joint : f.edge.joints)
          result.push_back(joint.scatter / actions.half_range(joint.signal));
  return Eigen::Map<const Eigen::VectorXd>(result.data(), static_cast<Eigen::Index>(result.size()));
}

// The covariance of a model's parameters, for to_edge().
Eigen::MatrixXd in_command_units(const ParameterMatrix& covariance, const LocalModel& model,
                                 const NormalizedActions& actions) {
  Eigen::VectorXd units = Eigen::VectorXd::Ones(model.num_parameters());
  for (int d = 0; d < model.num_joints(); ++d)
    units.segment<2>(ScrewChainLayout::slide(d))
        .setConstant(1 / actions.half_range(model.joints[d].signal));
  return units.asDiagonal() * covariance * units.asDiagonal();
}

// Sets an edge's outliers and mean residuals from the leave-one-out residuals of its frames.
// Returns the number of inliers.
int judge(const PairData& pair, const std::vector<double>& squared_distance,
          const std::vector<Vector6d>& residual, FittedEdge* result) {
  Edge& edge = result->edge;
  edge.num_samples = pair.size();
  double position = 0, rotation = 0;
  for (int t = 0; t < pair.size(); ++t) {
    const bool outlying = squared_distance[t] > outlier_threshold(pair.num_residuals());
    result->frames.push_back(pair.frames[t].sample);
    result->outlying.push_back(outlying);
    edge.num_outliers += outlying;
    if (outlying) continue;
    position += residual[t].head<3>().squaredNorm();
    rotation += residual[t].tail<3>().squaredNorm();
  }
  const int inliers = pair.size() - edge.num_outliers;
  if (inliers > 0) {
    edge.position_rms_m = std::sqrt(position / inliers);
    edge.rotation_rms_rad = std::sqrt(rotation / inliers);
    edge.confidence = static_cast<double>(inliers) / pair.size();
  }
  return inliers;
}

// The screws of a soft edge stay as they are: the process says what they leave, and its variance is
// that of the whole.
void fit_soft_edge(const LocalModel& screws, const std::vector<int>& signals, const PairData& pair,
                   const EdgeData& data, bool must_be_valid, FittedEdge* result) {
  const LocalModel start = fit_local_model(screws, pair, data.actions, 30, 1e-3).model;
  const auto fit = fit_soft_model(start, pair, data.actions, data.validity, signals);
  result->edge = to_edge(start, data.actions);
  result->is_valid = fit && (!must_be_valid || fit->verdict == Verdict::kValid);
  if (fit) {
    result->edge.residual_gp = fit->model.residual_gp;
    judge(pair, fit->squared_distance, fit->residual, result);
  } else {  // what the search's part of the data carried, all of them refuse
    result->edge.num_samples = result->edge.num_outliers = pair.size();
    result->edge.confidence = 0;
  }
}

SerialCorrelation series_of(const Fit& fit, const PairData& pair) {
  SerialCorrelation series;
  for (int t = 1; t < pair.size(); ++t)
    if (pair.frames[t].sample == pair.frames[t - 1].sample + 1)
      series.add(fit.frames[t - 1], fit.frames[t]);
  return series;
}

void fit_screw_edge(const LocalModel& start, const PairData& pair, const EdgeData& data,
                    bool must_be_valid, FittedEdge* result) {
  const Fit fit = fit_local_model(start, pair, data.actions, 60, 1e-6);
  const LeaveOneOut loo = leave_one_out(fit, pair, data.actions);
  result->is_valid =
      !must_be_valid ||
      check_validity(fit, loo, pair, data.actions, data.validity).verdict == Verdict::kValid;
  if (!result->is_valid) return;
  result->model = fit.model;
  result->edge = to_edge(fit.model, data.actions);
  const PairData told = make_pair_data(data.samples, pair.part_i, pair.part_j, data.told,
                                       std::numeric_limits<int>::max());
  set_scatter(joint_scatter(fit, loo, pair, told, data.actions), data.actions, &result->edge);
  const int inliers = judge(pair, loo.squared_distance, loo.residual, result);
  double weight = 0;
  for (int t = 0; t < pair.size(); ++t)
    if (!result->outlying[t]) weight += fit.frames[t].weight();
  const bool is_stream = data.actions.blocks().is_stream();
  if (!is_stream) result->series = series_of(fit, pair);
  const double lasting =
      is_stream || result->series.coefficient(pair.size()) > 0
          ? correlation_time(scores(fit, pair, data.actions), loo.parameter_covariance)
          : 1;
  // The robust weights are relative: an inlier counts as one measurement, on the average.
  if (inliers > 0)
    result->edge.parameter_covariance =
        lasting * weight / inliers *
        in_command_units(loo.parameter_covariance, fit.model, data.actions);
}

template <class IsRefused>
bool drop(IsRefused&& is_refused, Refusal why, std::vector<FittedEdge>* fitted, Refusals* refused) {
  return std::erase_if(*fitted, [&](const FittedEdge& f) {
           const bool is = is_refused(f);
           if (is) (*refused)[std::minmax(f.edge.from, f.edge.to)] = why;
           return is;
         }) > 0;
}

// Edges whose parts are elsewhere than the joint fit has them at most instants: they were accepted
// from a few instants that their own two parts share, which any model fits. Chosen: "elsewhere" is
// ten times as far as an outlier, beyond any noise that is told wrongly.
bool drop_contradicted(const TreeFit& fit, std::vector<FittedEdge>* fitted, Refusals* refused) {
  const auto is_contradicted = [&](const FittedEdge& edge) {
    for (int k = 1; k < static_cast<int>(fit.nodes().size()); ++k) {
      if (fit.nodes()[k].part != edge.edge.to) continue;
      int readings = 0, elsewhere = 0;
      for (int t = 0; t < fit.num_frames(); ++t) {
        const FrameFit* reading = fit.reading(t, k);
        if (!reading) continue;
        ++readings;
        elsewhere += reading->squared_distance > 10 * outlier_threshold(reading->num_residuals);
      }
      return 2 * elsewhere > readings;
    }
    return false;
  };
  return drop(is_contradicted, Refusal::kContradicted, fitted, refused);
}

// Edges that the joint fit has wrong at one end of a command's range, or in between.
bool drop_wrong_at_some_commands(const TreeFit& fit, std::vector<FittedEdge>* fitted,
                                 Refusals* refused) {
  const auto is_wrong = [&](const FittedEdge& edge) {
    for (int k = 1; k < static_cast<int>(fit.nodes().size()); ++k) {
      if (fit.nodes()[k].part != edge.edge.to) continue;
      std::vector<int> samples;
      std::vector<bool> outlying;
      for (int t = 0; t < fit.num_frames(); ++t)
        if (const FrameFit* reading = fit.reading(t, k)) {
          samples.push_back(fit.sample(t));
          outlying.push_back(reading->squared_distance > outlier_threshold(reading->num_residuals));
        }
      return is_wrong_at_some_commands(samples, outlying, fit.actions());
    }
    return false;
  };
  return drop(is_wrong, Refusal::kWrongAtSomeCommands, fitted, refused);
}

// Without the joint that is told least from none, if that is by no more than what another joint of
// its edge scatters by makes of it: the search took that for a joint.
bool drop_weak_joint(const TreeFit& fit, const TreeFit::Covariance& covariance,
                     const Eigen::VectorXd& scatter, const EdgeData& data,
                     std::vector<FittedEdge>* fitted) {
  constexpr double kLeastSigmas = 4;
  double least = kLeastSigmas * kLeastSigmas;
  int weak_node = -1, weak_joint = -1;
  Eigen::Index first = 0;
  for (int k = 1; k < static_cast<int>(fit.nodes().size()); ++k) {
    const LocalModel& model = fit.nodes()[k].model;
    const Eigen::VectorXd of_edge = scatter.segment(first, model.num_joints());
    first += model.num_joints();
    for (int d = 0; d < model.num_joints(); ++d) {
      if (!(of_edge.sum() > of_edge(d))) continue;
      const Eigen::Vector2d motion(model.joints[d].slide, model.joints[d].turn);
      const int at = ScrewChainLayout::slide(d);
      const Eigen::Matrix2d C = covariance.models[k].block<2, 2>(at, at);
      const double sigmas2 = motion.dot(C.ldlt().solve(motion));
      if (!(sigmas2 < least)) continue;
      least = sigmas2;
      weak_node = k;
      weak_joint = d;
    }
  }
  if (weak_node < 0) return false;
  const TreeNode& node = fit.nodes()[weak_node];
  AcceptedModel rest;
  rest.model = node.model;
  rest.model.transform(weak_joint) =
      rest.model.transform(weak_joint) * rest.model.joints[weak_joint].X_after;
  rest.model.joints.erase(rest.model.joints.begin() + weak_joint);
  for (FittedEdge& f : *fitted) {
    if (f.edge.to != node.part) continue;
    rest.part_i = f.edge.from;
    rest.part_j = f.edge.to;
    f = fit_edge(rest, f.edge.from, f.edge.to, data, false);
  }
  return true;
}

}  // namespace

LocalModel rescaled(LocalModel model, const NormalizedActions& from, const NormalizedActions& to) {
  for (int d = 0; d < model.num_joints(); ++d) {
    const int s = model.joints[d].signal;
    const double ratio = to.half_range(s) / from.half_range(s);
    const double shift = (to.centre(s) - from.centre(s)) / from.half_range(s);
    Vector6d screw = Vector6d::Zero();
    screw(2) = model.joints[d].slide * shift;
    screw(5) = model.joints[d].turn * shift;
    model.transform(d) = model.transform(d) * exp(screw);
    model.joints[d].slide *= ratio;
    model.joints[d].turn *= ratio;
  }
  return model;
}

bool is_wrong_at_some_commands(const FittedEdge& fitted, const NormalizedActions& actions) {
  return is_wrong_at_some_commands(fitted.frames, fitted.outlying, actions);
}

bool is_wrong_at_an_end(const FittedEdge& fitted, const TimeBlocks& blocks) {
  constexpr int kFewest = 3;
  constexpr double kLeastChance = 1e-4;
  std::vector<bool> outlying;  // by block that was seen: at all of its instants
  int previous = -1;
  for (std::size_t t = 0; t < fitted.frames.size(); ++t) {
    const int block = blocks.block_of(fitted.frames[t]);
    if (block != previous) outlying.push_back(true);
    if (!fitted.outlying[t]) outlying.back() = false;
    previous = block;
  }
  const auto n = static_cast<double>(outlying.size());
  const auto num_outliers = static_cast<double>(std::count(outlying.begin(), outlying.end(), true));
  const auto begins_wrong = [&](auto first, auto last) {
    const auto run = static_cast<double>(std::find(first, last, false) - first);
    const double rate = (num_outliers - run + 1) / (n - run + 2);  // the rule of succession
    return run >= kFewest && std::pow(rate, run) < kLeastChance;
  };
  return begins_wrong(outlying.begin(), outlying.end()) ||
         begins_wrong(outlying.rbegin(), outlying.rend());
}

FittedEdge fit_edge(const AcceptedModel& accepted, int from, int to, const EdgeData& data,
                    bool must_be_valid) {
  const LocalModel start = accepted.part_i == from ? accepted.model : accepted.model.inverse();
  const PairData pair =
      make_pair_data(data.samples, from, to, data.measurement, std::numeric_limits<int>::max());
  FittedEdge result;
  if (accepted.soft_signals.empty())
    fit_screw_edge(start, pair, data, must_be_valid, &result);
  else
    fit_soft_edge(start, accepted.soft_signals, pair, data, must_be_valid, &result);
  result.edge.from = from;
  result.edge.to = to;
  return result;
}

double fit_jointly(const EdgeData& data, std::vector<FittedEdge>* fitted, BodySchema* schema,
                   Refusals* refused) {
  // More instants than this are thinned; so many more that thinning costs what the joint fit gains
  // are left to the pairs.
  constexpr int kMaxFrames = 2500;
  constexpr std::size_t kTooMany = 6000;
  SerialCorrelation series;
  for (const FittedEdge& f : *fitted) series.add(f.series);
  const double of_edges = series.coefficient(static_cast<int>(data.samples.size()));
  if (data.samples.size() > kTooMany) return of_edges;
  std::vector<PairData> told;
  const auto seen = [&](int part) {
    told.push_back(make_part_data(data.samples, part, data.told, kMaxFrames));
    return make_part_data(data.samples, part, data.measurement, kMaxFrames);
  };
  std::vector<TreeNode> nodes{{schema->root, -1, {}}};
  std::vector<PairData> poses{seen(schema->root)};
  if (poses[0].size() < 2 || !is_at_rest(poses[0], data.actions, data.validity)) return of_edges;
  for (const FittedEdge& f : *fitted) {
    const auto parent = std::find_if(
        nodes.begin(), nodes.end(), [&](const TreeNode& node) { return node.part == f.edge.from; });
    if (parent == nodes.end()) continue;      // another component
    if (f.edge.residual_gp) return of_edges;  // no chain of screws
    nodes.push_back({f.edge.to, static_cast<int>(parent - nodes.begin()), f.model});
    poses.push_back(seen(f.edge.to));
  }
  if (nodes.size() < 2) return of_edges;
  const Eigen::VectorXd of_pairs = scatter_of(*fitted, nodes, data.actions);
  TreeFit fit(std::move(nodes), std::move(poses), data.actions, true);
  fit.fit(20, 1e-6);
  if (drop_contradicted(fit, fitted, refused) || drop_wrong_at_some_commands(fit, fitted, refused))
    return fit_jointly(data, fitted, schema, refused);
  const Eigen::VectorXd scatter = joint_scatter(fit, told, of_pairs);
  const auto covariance = fit.covariance(data.measurement, view_share(data.measurement), scatter);
  if (covariance && drop_weak_joint(fit, *covariance, scatter, data, fitted))
    return fit_jointly(data, fitted, schema, refused);
  Eigen::Index next = 0;
  for (std::size_t k = 1; k < fit.nodes().size(); ++k) {
    const TreeNode& node = fit.nodes()[k];
    const Eigen::VectorXd of_node = scatter.segment(next, node.model.num_joints());
    next += node.model.num_joints();
    for (FittedEdge& f : *fitted) {
      if (f.edge.to != node.part) continue;
      const Edge moved = to_edge(node.model, data.actions);
      f.edge.left = moved.left;
      f.edge.joints = moved.joints;
      set_scatter(of_node, data.actions, &f.edge);
      if (covariance)
        f.edge.parameter_covariance =
            in_command_units(covariance->models[k], node.model, data.actions);
    }
  }
  schema->X_CR = fit.root_pose();
  if (covariance) {
    schema->X_CR_covariance = covariance->root;
    for (std::size_t k = 0; k < fit.nodes().size(); ++k)
      if (!covariance->frames[k].isZero(0))
        schema->frame_covariances[fit.nodes()[k].part] = covariance->frames[k];
  }
  return fit.serial_correlation();
}

}  // namespace bodyschema
