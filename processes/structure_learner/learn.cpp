#include "processes/structure_learner/learn.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <set>
#include <stdexcept>

#include "common/kinematics/kinematic_path.h"
#include "processes/structure_learner/command_warp.h"
#include "processes/structure_learner/noise_estimate.h"
#include "processes/structure_learner/residual_fit.h"
#include "processes/structure_learner/search/withdrawal.h"
#include "processes/structure_learner/soft_parts.h"
#include "processes/structure_learner/structure_search.h"
#include "processes/structure_learner/tree_fit.h"

namespace bodyschema {
namespace {

// Share of the variance of a marker's noise that near-identical views have in common: SAMPLE tells
// one frame's covariance for the mean of two. None where no systematic error is told either.
double view_share(const MeasurementModel& measurement) {
  // Over the ideal rigs d² of X_CR has the mean 5.3 (`./run experiment rig_table`): one draw a rig,
  // for their roots rest.
  constexpr double kOfTags = 0.1;
  const Noise& systematic = measurement.systematic;
  return systematic.position_m > 0 || systematic.rotation_rad > 0 ? kOfTags : 0;
}

bool has_covariances(const std::vector<ActionPoseSample>& samples) {
  for (const auto& sample : samples)
    for (const auto& o : sample.parts)
      if (!o.covariance.isZero(0)) return true;
  return false;
}

Noise typical_noise(const std::vector<ActionPoseSample>& samples) {
  double position = 0, rotation = 0;
  int count = 0;
  for (const auto& sample : samples) {
    for (const auto& o : sample.parts) {
      position += o.covariance.topLeftCorner<3, 3>().trace() / 3;
      rotation += o.covariance.bottomRightCorner<3, 3>().trace() / 3;
      ++count;
    }
  }
  if (count == 0) return {};
  return {std::sqrt(position / count), std::sqrt(rotation / count)};
}

// The same model over command units: Exp(ŝ (q − centre)/half_range).
Edge to_edge(const LocalModel& model, const NormalizedActions& actions) {
  Edge edge;
  edge.left = model.A[0];
  for (int d = 0; d < model.num_joints; ++d) {
    ScrewJoint joint;
    joint.signal = model.signal[d];
    joint.offset = -actions.centre(joint.signal);
    joint.slide = model.slide[d] / actions.half_range(joint.signal);
    joint.turn = model.turn[d] / actions.half_range(joint.signal);
    joint.X_after = model.A[d + 1];
    edge.joints.push_back(joint);
  }
  return edge;
}

// The covariance of a model's parameters, for to_edge().
Eigen::MatrixXd in_command_units(const ParameterMatrix& covariance, const LocalModel& model,
                                 const NormalizedActions& actions) {
  Eigen::VectorXd units = Eigen::VectorXd::Ones(model.num_parameters());
  for (int d = 0; d < model.num_joints; ++d)
    units.segment<2>(6 + 8 * d).setConstant(1 / actions.half_range(model.signal[d]));
  return units.asDiagonal() * covariance * units.asDiagonal();
}

// The model over actions that are scaled otherwise.
LocalModel rescaled(LocalModel model, const NormalizedActions& from, const NormalizedActions& to) {
  for (int d = 0; d < model.num_joints; ++d) {
    const int s = model.signal[d];
    const double ratio = to.half_range(s) / from.half_range(s);
    const double shift = (to.centre(s) - from.centre(s)) / from.half_range(s);
    Vector6d screw = Vector6d::Zero();
    screw(2) = model.slide[d] * shift;
    screw(5) = model.turn[d] * shift;
    model.A[d] = model.A[d] * exp(screw);
    model.slide[d] *= ratio;
    model.turn[d] *= ratio;
  }
  return model;
}

struct FittedEdge {
  Edge edge;
  std::vector<int> frames;  // samples at which it was judged
  std::vector<bool> outlying;
  bool is_valid = true;  // as far as that was asked
  LocalModel model;      // what of the edge is screws
};

// The final fit of a soft edge in its direction. The screws stay as they are: the process says what
// they leave, and its variance is that of the whole.
FittedEdge fit_soft_edge(const LocalModel& screws, const std::vector<int>& signals, int from,
                         int to, const PairData& pair, const NormalizedActions& actions,
                         const ValidityOptions& validity, bool must_be_valid) {
  const LocalModel start = fit_local_model(screws, pair, actions, 30, 1e-3).model;
  const auto fit = fit_soft_model(start, pair, actions, validity, signals);
  FittedEdge result;
  result.edge = to_edge(start, actions);
  result.edge.from = from;
  result.edge.to = to;
  result.edge.num_samples = pair.size();
  result.is_valid = fit && (!must_be_valid || fit->verdict == Verdict::kValid);
  if (!fit) {  // what the search's part of the data carried, all of them refuse
    result.edge.num_outliers = pair.size();
    result.edge.confidence = 0;
    return result;
  }
  result.edge.residual_gp = fit->model.residual_gp;
  double position = 0, rotation = 0;
  for (int t = 0; t < pair.size(); ++t) {
    const bool outlying = fit->squared_distance[t] > kOutlierThreshold;
    result.frames.push_back(pair.frames[t].sample);
    result.outlying.push_back(outlying);
    result.edge.num_outliers += outlying;
    if (outlying) continue;
    position += fit->residual[t].head<3>().squaredNorm();
    rotation += fit->residual[t].tail<3>().squaredNorm();
  }
  const int inliers = pair.size() - result.edge.num_outliers;
  if (inliers > 0) {
    result.edge.position_rms_m = std::sqrt(position / inliers);
    result.edge.rotation_rms_rad = std::sqrt(rotation / inliers);
    result.edge.confidence = static_cast<double>(inliers) / pair.size();
  }
  return result;
}

// The final fit of an edge in its direction, on all data, with everything the schema says about it.
FittedEdge fit_edge(const AcceptedModel& accepted, int from, int to,
                    const std::vector<ActionPoseSample>& samples, const NormalizedActions& actions,
                    const MeasurementModel& measurement, const ValidityOptions& validity,
                    bool must_be_valid) {
  const LocalModel start = accepted.part_i == from ? accepted.model : accepted.model.inverse();
  const PairData pair =
      make_pair_data(samples, from, to, measurement, std::numeric_limits<int>::max());
  if (!accepted.soft_signals.empty())
    return fit_soft_edge(start, accepted.soft_signals, from, to, pair, actions, validity,
                         must_be_valid);
  const Fit fit = fit_local_model(start, pair, actions, 60, 1e-6);
  const LeaveOneOut loo = leave_one_out(fit, pair, actions);

  FittedEdge result;
  if (must_be_valid) {
    result.is_valid = check_validity(fit, loo, pair, actions, validity).verdict == Verdict::kValid;
    if (!result.is_valid) return result;
  }
  result.model = fit.model;
  result.edge = to_edge(fit.model, actions);
  result.edge.from = from;
  result.edge.to = to;
  result.edge.num_samples = pair.size();
  double position = 0, rotation = 0, weight = 0;
  for (int t = 0; t < pair.size(); ++t) {
    const bool outlying = loo.squared_distance[t] > kOutlierThreshold;
    result.frames.push_back(pair.frames[t].sample);
    result.outlying.push_back(outlying);
    if (outlying) {
      ++result.edge.num_outliers;
    } else {
      weight += robust_weight(fit.frames[t].squared_distance);
      position += loo.residual[t].head<3>().squaredNorm();
      rotation += loo.residual[t].tail<3>().squaredNorm();
    }
  }
  const int inliers = pair.size() - result.edge.num_outliers;
  if (inliers > 0) {
    result.edge.position_rms_m = std::sqrt(position / inliers);
    result.edge.rotation_rms_rad = std::sqrt(rotation / inliers);
    // The robust weights are relative: an inlier counts as one measurement, on the average.
    result.edge.parameter_covariance =
        weight / inliers * in_command_units(loo.parameter_covariance, fit.model, actions);
    result.edge.confidence = static_cast<double>(inliers) / pair.size();
  }
  return result;
}

// The edges of the root's component fitted to all of its markers at once: a root that rests and
// everything on the way from it are witnesses too, beside the two markers that each edge was fitted
// to before.
void fit_jointly(const std::vector<ActionPoseSample>& samples, const NormalizedActions& actions,
                 const MeasurementModel& measurement, const ValidityOptions& validity,
                 std::vector<FittedEdge>* fitted, BodySchema* schema) {
  // More instants than this are thinned; so many more that thinning costs what the joint fit gains
  // are left to the pairs.
  constexpr int kMaxFrames = 2500;
  constexpr std::size_t kTooMany = 6000;
  if (samples.size() > kTooMany) return;
  std::vector<TreeNode> nodes{{schema->root, -1, {}}};
  std::vector<PairData> data{make_part_data(samples, schema->root, measurement, kMaxFrames)};
  if (data[0].size() < 2 || !is_at_rest(data[0], actions, validity)) return;
  for (const FittedEdge& f : *fitted) {
    const auto parent = std::find_if(
        nodes.begin(), nodes.end(), [&](const TreeNode& node) { return node.part == f.edge.from; });
    if (parent == nodes.end()) continue;  // another component
    if (f.edge.residual_gp) return;       // no chain of screws
    nodes.push_back({f.edge.to, static_cast<int>(parent - nodes.begin()), f.model});
    data.push_back(make_part_data(samples, f.edge.to, measurement, kMaxFrames));
  }
  if (nodes.size() < 2) return;
  TreeFit fit(std::move(nodes), std::move(data), actions, true);
  fit.fit(20, 1e-6);
  const auto covariance =
      fit.covariance(measurement.systematic_covariance(), view_share(measurement));
  for (std::size_t k = 1; k < fit.nodes().size(); ++k) {
    const TreeNode& node = fit.nodes()[k];
    for (FittedEdge& f : *fitted) {
      if (f.edge.to != node.part) continue;
      const Edge moved = to_edge(node.model, actions);
      f.edge.left = moved.left;
      f.edge.joints = moved.joints;
      if (covariance)
        f.edge.parameter_covariance = in_command_units(covariance->models[k], node.model, actions);
    }
  }
  schema->X_CR = fit.root_pose();
  if (!covariance) return;
  schema->X_CR_covariance = covariance->root;
  for (std::size_t k = 0; k < fit.nodes().size(); ++k)
    if (!covariance->frames[k].isZero(0))
      schema->frame_covariances[fit.nodes()[k].part] = covariance->frames[k];
}

// Which part is to blame where edges disagree with the data at one instant.
//
// A part that is outlying in most of its edges is the culprit; its edges then speak no longer. Ties
// (an edge between two parts that nothing else judges) go by the other visible parts: the one that
// disagrees with more of them along the tree; then the one farther from the root.
class OutlierAttribution {
 public:
  OutlierAttribution(const BodySchema& schema, const std::vector<FittedEdge>& edges,
                     const std::vector<ActionPoseSample>& samples,
                     const MeasurementModel& measurement)
      : schema_(schema), edges_(edges), samples_(samples), measurement_(measurement) {
    depth_[schema.root] = 0;
    for (const Edge& edge : schema.edges) depth_[edge.to] = depth_[edge.from] + 1;
  }

  std::vector<Outlier> run() const {
    struct Judgement {
      int edge;
      bool outlying;
    };
    std::map<int, std::vector<Judgement>> by_sample;
    std::set<int> suspicious;
    for (std::size_t e = 0; e < edges_.size(); ++e) {
      for (std::size_t n = 0; n < edges_[e].frames.size(); ++n) {
        by_sample[edges_[e].frames[n]].push_back({static_cast<int>(e), edges_[e].outlying[n]});
        if (edges_[e].outlying[n]) suspicious.insert(edges_[e].frames[n]);
      }
    }
    std::vector<Outlier> result;
    for (const int sample : suspicious) {
      std::map<int, std::pair<int, int>> count;  // part → (outlying edges, edges)
      std::vector<const Edge*> outlying;
      for (const Judgement& j : by_sample[sample]) {
        const Edge& edge = edges_[j.edge].edge;
        for (const int part : {edge.from, edge.to}) {
          count[part].first += j.outlying;
          ++count[part].second;
        }
        if (j.outlying) outlying.push_back(&edge);
      }
      const auto original = count;
      std::set<int> culprits;
      while (!outlying.empty()) {
        std::set<int> suspects;
        for (const Edge* edge : outlying) suspects.insert({edge->from, edge->to});
        // (share of its edges that are outlying, their number), then the costlier questions.
        std::vector<int> worst;
        std::pair<double, int> worst_guilt{-1, 0};
        for (const int part : suspects) {
          const auto [bad, all] = count[part];
          const std::pair<double, int> guilt{static_cast<double>(bad) / all,
                                             original.at(part).first};
          if (guilt > worst_guilt) worst.clear();
          if (guilt >= worst_guilt) {
            worst_guilt = guilt;
            worst.push_back(part);
          }
        }
        int culprit = worst.front();
        if (worst.size() > 1) {
          std::pair<double, int> most{-1, -1};
          for (const int part : worst) {
            const std::pair<double, int> d{disagreement(sample, part, culprits), depth_.at(part)};
            if (d > most) {
              most = d;
              culprit = part;
            }
          }
        }
        culprits.insert(culprit);
        for (const Judgement& j : by_sample[sample]) {
          const Edge& edge = edges_[j.edge].edge;
          if (edge.from != culprit && edge.to != culprit) continue;
          for (const int part : {edge.from, edge.to}) {
            count[part].first -= j.outlying;
            --count[part].second;
          }
        }
        std::erase_if(outlying, [culprit](const Edge* edge) {
          return edge->from == culprit || edge->to == culprit;
        });
      }
      for (const int part : culprits) result.push_back({samples_[sample].sample_index, part});
    }
    return result;
  }

 private:
  // Share of the other visible parts (and of the root's usual pose) that contradict a part's pose.
  double disagreement(int sample, int part, const std::set<int>& culprits) const {
    const ActionPoseSample& s = samples_[sample];
    const PartObservation* o = s.find(part);
    int bad = 0, all = 0;
    const auto judge = [&](const Vector6d& residual, const Matrix6d& covariance) {
      ++all;
      const double d2 = squared_mahalanobis(residual, covariance);
      if (!(d2 < kOutlierThreshold)) ++bad;
    };
    for (const PartObservation& other : s.parts) {
      if (other.part == part || culprits.count(other.part)) continue;
      const auto& path = path_between(other.part, part);
      if (!path) continue;
      const Pose z = other.X_CB.inverse() * o->X_CB;
      judge(
          log(path->predict(s.action).inverse() * z),
          path->covariance(s.action, Variance::kFirstOrder) +
              relative_covariance(z, measurement_.covariance(other), measurement_.covariance(*o)));
    }
    if (const auto& path = path_between(schema_.root, part))
      judge(log((schema_.X_CR * path->predict(s.action)).inverse() * o->X_CB),
            path->covariance(s.action, Variance::kFirstOrder) + measurement_.covariance(*o));
    return all > 0 ? static_cast<double>(bad) / all : 0;
  }

  const std::optional<KinematicPath>& path_between(int from, int to) const {
    const auto [it, is_new] = paths_.try_emplace({from, to});
    if (is_new) it->second = KinematicPath::between(schema_, from, to);
    return it->second;
  }

  const BodySchema& schema_;
  const std::vector<FittedEdge>& edges_;
  const std::vector<ActionPoseSample>& samples_;
  const MeasurementModel& measurement_;
  std::map<int, int> depth_;
  mutable std::map<std::pair<int, int>, std::optional<KinematicPath>> paths_;  // found so far
};

// Why `part` is not connected to the root's component.
UnconnectedPart explain(int part, int num_seen, const std::set<int>& connected,
                        const LearnedStructure& structure, int max_signals) {
  UnconnectedPart result;
  result.part = part;
  if (num_seen == 0) {
    result.reason = Unconnected::kNeverSeen;
    result.detail = "never seen";
    return result;
  }
  int common = 0, partner = -1;
  bool undecided = false, was_soft_tried = false;
  std::set<int> untold;
  for (const auto& [pair, record] : structure.search.records) {
    if (pair.first != part && pair.second != part) continue;
    const int other = pair.first == part ? pair.second : pair.first;
    if (!connected.count(other)) continue;
    undecided |= !record.undecided.empty();
    untold.insert(record.untold_signals.begin(), record.untold_signals.end());
    was_soft_tried |= record.was_soft_tried;
    if (record.num_common > common) {
      common = record.num_common;
      partner = other;
    }
  }
  // With fewer numbers than five a parameter of the largest model, its refusal says little.
  const int parameters = 6 + 6 * max_signals;
  const std::string seen = "seen " + std::to_string(num_seen) + " times, at most " +
                           std::to_string(common) + " of them together with one connected part" +
                           (partner >= 0 ? " (" + std::to_string(partner) + ")" : "");
  if (undecided || 6 * common < 5 * parameters) {
    result.reason = Unconnected::kNotEnoughData;
    result.detail = seen + "; more samples are needed to trust a model";
    for (const int s : untold) {
      const char* before = s == *untold.begin() ? ": too few yet to tell what moves with " : ", ";
      result.detail += before + structure.signals[static_cast<std::size_t>(s)].name;
    }
  } else {
    result.reason = Unconnected::kNoValidModel;
    result.detail = seen + "; no model with up to " + std::to_string(max_signals) +
                    " signals is valid to any connected part" +
                    (was_soft_tried ? ", nor any with a Gaussian process beside its joints" : "");
  }
  return result;
}

// Signals that no edge uses although one may have to: they moved too little for a joint of
// kLeastTurn (over their limits, where these are known) to show, or a part waits for its edge.
std::vector<int> undecided_signals(const BodySchema& schema, const LearnedStructure& structure) {
  std::vector<int> result;
  for (const int s : schema.unused_signals()) {
    const auto information = structure.search.joint_information.find(s);
    if (schema.complete && information != structure.search.joint_information.end()) {
      const Signal& signal = schema.signals[static_cast<std::size_t>(s)];
      const double range = signal.upper - signal.lower;
      const double share =
          range > 0 ? std::min(1.0, 2 * structure.actions.half_range(s) / range) : 1;
      const double turn = share * kLeastTurn;
      if (turn * turn * information->second >= kNoticed) continue;
    }
    result.push_back(s);
  }
  return result;
}

int check_actions(const std::vector<ActionPoseSample>& samples, std::size_t num_signals) {
  for (const auto& sample : samples)
    if (sample.action.size() != static_cast<Eigen::Index>(num_signals))
      throw std::invalid_argument("sample " + std::to_string(sample.sample_index) + " has " +
                                  std::to_string(sample.action.size()) + " action values, not " +
                                  std::to_string(num_signals));
  return static_cast<int>(num_signals);
}

std::map<int, int> count_seen(const std::vector<ActionPoseSample>& samples) {
  std::map<int, int> num_seen;
  for (const auto& sample : samples)
    for (const auto& o : sample.parts) ++num_seen[o.part];
  return num_seen;
}

std::vector<int> parts_of(const std::map<int, int>& num_seen) {
  std::vector<int> parts;
  for (const auto& [part, count] : num_seen) parts.push_back(part);
  return parts;
}

SearchOptions search_options_of(const LearnOptions& options) {
  SearchOptions result;
  result.max_signals = options.max_signals;
  result.validity.outlier_rate = options.outlier_rate;
  result.measurement.systematic = options.systematic;
  result.measurement.max_error_ratio = options.max_error_ratio;
  return result;
}

LearnResult fit_tree(const LearnedStructure& structure,
                     const std::vector<ActionPoseSample>& samples, const LearnOptions& options,
                     bool must_be_valid) {
  const int num_signals = check_actions(samples, structure.signals.size());
  const SearchResult& search = structure.search;
  const MeasurementModel& measurement = structure.measurement;
  const ValidityOptions validity = search_options_of(options).validity;

  LearnResult result;
  result.noise_source = structure.noise_source;
  result.num_screens = search.num_screens;
  result.num_fits = search.num_fits;
  BodySchema& schema = result.schema;
  schema.signals = structure.signals;
  schema.num_samples = static_cast<int>(samples.size());
  for (const auto& sample : samples)
    schema.last_sample_index = std::max(schema.last_sample_index, sample.sample_index);
  if (!samples.empty()) schema.calibration_id = samples.back().calibration_id;
  const std::map<int, int> num_seen = count_seen(samples);
  schema.parts = parts_of(num_seen);
  if (!schema.parts.empty()) schema.root = schema.parts.front();
  if (options.root) schema.root = *options.root;

  // Everything that is fitted sees displacements.
  const std::vector<ActionPoseSample> moved = displaced(samples, structure.signals);
  const NormalizedActions actions(moved, num_signals);
  schema.noise = measurement.noise ? *measurement.noise : typical_noise(samples);
  // Orient the forest outwards: breadth first from the root, then from the lowest part of every
  // other component.
  std::vector<FittedEdge> fitted;
  std::set<int> reached, connected_to_root;
  const auto grow_from = [&](int start) {
    std::vector<int> queue{start};
    reached.insert(start);
    for (std::size_t head = 0; head < queue.size(); ++head) {
      for (const AcceptedModel& m : search.models) {
        if (m.part_i != queue[head] && m.part_j != queue[head]) continue;
        const int to = m.part_i == queue[head] ? m.part_j : m.part_i;
        if (!reached.insert(to).second) continue;
        AcceptedModel start = m;
        start.model = rescaled(m.model, structure.actions, actions);
        FittedEdge edge =
            fit_edge(start, queue[head], to, moved, actions, measurement, validity, must_be_valid);
        if (!edge.is_valid) {
          reached.erase(to);
          continue;
        }
        fitted.push_back(std::move(edge));
        queue.push_back(to);
      }
    }
  };
  if (schema.has_part(schema.root)) grow_from(schema.root);
  connected_to_root = reached;
  for (const int part : schema.parts)
    if (!reached.count(part)) grow_from(part);
  estimate_root_pose(samples, measurement, &schema);
  if (schema.has_part(schema.root))
    fit_jointly(moved, actions, measurement, validity, &fitted, &schema);
  for (const FittedEdge& f : fitted) schema.edges.push_back(f.edge);

  std::set<int> expected(options.expected_parts.begin(), options.expected_parts.end());
  expected.insert(schema.parts.begin(), schema.parts.end());
  if (options.root) expected.insert(*options.root);
  for (const int part : expected) {
    if (connected_to_root.count(part)) continue;
    const auto seen = num_seen.find(part);
    schema.unconnected.push_back(explain(part, seen == num_seen.end() ? 0 : seen->second,
                                         connected_to_root, structure, options.max_signals));
  }
  if (schema.parts.size() == 1 && connected_to_root.count(schema.parts.front()))
    schema.unconnected.push_back({schema.parts.front(), Unconnected::kNotEnoughData, kOnlyPart});
  // A part that was never seen is reported, but a tree over all the others is complete (Fig. 8,
  // 11).
  schema.complete = schema.parts.size() > 1 &&
                    std::all_of(schema.parts.begin(), schema.parts.end(),
                                [&](int part) { return connected_to_root.count(part) > 0; });

  schema.undecided_signals = undecided_signals(schema, structure);

  result.outliers = OutlierAttribution(schema, fitted, samples, measurement).run();
  return result;
}

}  // namespace

void estimate_root_pose(const std::vector<ActionPoseSample>& samples,
                        const MeasurementModel& measurement, BodySchema* schema) {
  struct Reading {
    Pose X;
    Matrix6d information;
  };
  std::vector<Reading> readings;
  for (const auto& sample : samples) {
    const PartObservation* o = sample.find(schema->root);
    if (!o) continue;
    readings.push_back({o->X_CB, measurement.covariance(*o).inverse()});
  }
  if (readings.empty()) return;
  const auto cost = [&](const Pose& X) {
    double sum = 0;
    for (const Reading& r : readings) {
      const Vector6d e = log(X.inverse() * r.X);
      sum += std::log1p(e.dot(r.information * e) / kStudentNu);
    }
    return sum;
  };
  Pose mean = readings.front().X;
  double best = std::numeric_limits<double>::infinity();
  const std::size_t candidates = std::min<std::size_t>(readings.size(), 16);
  for (std::size_t n = 0; n < candidates; ++n) {
    const Pose& X = readings[n * readings.size() / candidates].X;
    const double c = cost(X);
    if (c < best) {
      best = c;
      mean = X;
    }
  }
  Matrix6d H;
  double weight = 1;  // mean of the inliers'
  for (int iteration = 0; iteration < 30; ++iteration) {
    H.setZero();
    Vector6d g = Vector6d::Zero();
    double sum = 0;
    int inliers = 0;
    for (const Reading& r : readings) {
      const Vector6d e = log(mean.inverse() * r.X);
      const Vector6d Ie = r.information * e;
      const double d2 = e.dot(Ie), w = robust_weight(d2);
      if (d2 < kOutlierThreshold) {
        sum += w;
        ++inliers;
      }
      H += w * r.information;
      g += w * Ie;
    }
    if (inliers > 0) weight = sum / inliers;
    const Vector6d step = H.llt().solve(g);
    if (!step.allFinite()) break;
    mean = mean * exp(step);
    if (step.norm() < 1e-13) break;
  }
  schema->X_CR = mean;
  const double views = 1 + view_share(measurement) * static_cast<double>(readings.size());
  schema->X_CR_covariance = views * weight * H.inverse() + measurement.systematic_covariance();
}

SourcedNoise marker_noise(const std::vector<ActionPoseSample>& samples, int num_signals,
                          const LearnOptions& options) {
  if (options.noise)
    return {{std::max(options.noise->position_m, kNoiseFloor.position_m),
             std::max(options.noise->rotation_rad, kNoiseFloor.rotation_rad)},
            NoiseSource::kGiven};
  if (has_covariances(samples)) return {typical_noise(samples), NoiseSource::kCovariances};
  return estimate_noise(samples, num_signals, options.max_signals)
      .value_or(SourcedNoise{kNoiseFloor, NoiseSource::kAssumed});
}

LearnedStructure find_structure(const std::vector<Signal>& signals,
                                const std::vector<ActionPoseSample>& samples,
                                const LearnOptions& options) {
  if (options.max_signals < 0 || options.max_signals > kMaxJoints)
    throw std::invalid_argument("max_signals must be 0 to " + std::to_string(kMaxJoints));
  const int num_signals = check_actions(samples, signals.size());
  const std::vector<int> parts = parts_of(count_seen(samples));
  SearchOptions search_options = search_options_of(options);
  MeasurementModel& measurement = search_options.measurement;
  NoiseSource noise_source = NoiseSource::kCovariances;
  const auto set_noise = [&](const std::vector<ActionPoseSample>& of) {
    if (!options.noise && has_covariances(of)) return;
    const SourcedNoise noise = marker_noise(of, num_signals, options);
    measurement.noise = noise;
    noise_source = noise.source;
  };
  set_noise(samples);
  NormalizedActions actions(samples, num_signals);
  SearchResult search = search_structure(samples, actions, parts, search_options);
  LearnedStructure result{signals,           parts,       measurement, std::move(actions),
                          std::move(search), noise_source};
  // Everything that is fitted sees displacements; which commands are bent shows only by a model.
  constexpr int kMaxWarpRounds = 3;
  for (int round = 0; round < kMaxWarpRounds; ++round) {
    std::vector<Signal> bent = result.signals;
    if (!estimate_warps(samples, parts, result.search, search_options, &bent)) break;
    const std::vector<ActionPoseSample> again = displaced(samples, bent);
    set_noise(again);
    NormalizedActions actions_again(again, num_signals);
    SearchResult found = search_structure(again, actions_again, parts, search_options);
    found.num_screens += result.search.num_screens;
    found.num_fits += result.search.num_fits;
    const bool was_spanning = result.spans();
    // What bends a command must be worth it to all markers together, not only to the models that
    // asked for it.
    const bool is_worth_it =
        found.models.size() >= result.search.models.size() &&
        (!was_spanning || found.log_likelihood >= result.search.log_likelihood + kWarpEvidence);
    if (!is_worth_it) {
      result.search.num_screens = found.num_screens;
      result.search.num_fits = found.num_fits;
      break;
    }
    result = {std::move(bent),  parts,       measurement, std::move(actions_again),
              std::move(found), noise_source};
    if (was_spanning) break;
  }
  measurement = result.measurement;
  connect_soft_parts(displaced(samples, result.signals), result.actions, parts, search_options,
                     &result.search);
  return result;
}

LearnResult fit_structure(const LearnedStructure& structure,
                          const std::vector<ActionPoseSample>& samples,
                          const LearnOptions& options) {
  return fit_tree(structure, samples, options, false);
}

LearnResult relearn(const LearnedStructure& structure, const std::vector<ActionPoseSample>& samples,
                    const LearnOptions& options) {
  return fit_tree(structure, samples, options, true);
}

LearnResult learn(const std::vector<Signal>& signals, const std::vector<ActionPoseSample>& samples,
                  const LearnOptions& options) {
  return fit_structure(find_structure(signals, samples, options), samples, options);
}

}  // namespace bodyschema
