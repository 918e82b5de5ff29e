#include "processes/structure_learner/learn.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <set>
#include <stdexcept>

#include "processes/structure_learner/command_warp.h"
#include "processes/structure_learner/noise_estimate.h"
#include "processes/structure_learner/structure_search.h"

namespace bodyschema {
namespace {

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

struct FittedEdge {
  Edge edge;
  std::vector<int> frames;  // samples at which it was judged
  std::vector<bool> outlying;
};

// The final fit of an edge in its direction, on all data, with everything the schema says about it.
FittedEdge fit_edge(const AcceptedModel& accepted, int from, int to,
                    const std::vector<ActionPoseSample>& samples, const NormalizedActions& actions,
                    const MeasurementModel& measurement) {
  const LocalModel start = accepted.part_i == from ? accepted.model : accepted.model.inverse();
  const PairData pair =
      make_pair_data(samples, from, to, measurement, std::numeric_limits<int>::max());
  const Fit fit = fit_local_model(start, pair, actions, 60, 1e-6);
  const LeaveOneOut loo = leave_one_out(fit, pair, actions);

  FittedEdge result;
  result.edge = to_edge(fit.model, actions);
  result.edge.from = from;
  result.edge.to = to;
  Eigen::VectorXd units = Eigen::VectorXd::Ones(fit.model.num_parameters());
  for (int d = 0; d < fit.model.num_joints; ++d)
    units.segment<2>(6 + 8 * d).setConstant(1 / actions.half_range(fit.model.signal[d]));
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
        weight / inliers * (units.asDiagonal() * loo.parameter_covariance * units.asDiagonal());
    result.edge.confidence = static_cast<double>(inliers) / pair.size();
  }
  return result;
}

// Robust mean of the root's pose in the camera's frame, Student-t weights.
void estimate_root_pose(const std::vector<ActionPoseSample>& samples,
                        const MeasurementModel& measurement, BodySchema* schema) {
  struct Reading {
    Pose X;
    Matrix6d information;
  };
  std::vector<Reading> readings;
  Vector6d floor;
  floor.head<3>().setConstant(std::pow(measurement.model_error.position_m, 2) + 1e-10);
  floor.tail<3>().setConstant(std::pow(measurement.model_error.rotation_rad, 2) + 1e-10);
  Vector6d variances = Vector6d::Zero();
  if (measurement.noise) {
    variances.head<3>().setConstant(std::pow(measurement.noise->position_m, 2));
    variances.tail<3>().setConstant(std::pow(measurement.noise->rotation_rad, 2));
  }
  for (const auto& sample : samples) {
    const PartObservation* o = sample.find(schema->root);
    if (!o) continue;
    Matrix6d covariance = measurement.noise ? Matrix6d(variances.asDiagonal()) : o->covariance;
    covariance.diagonal() += floor;
    readings.push_back({o->X_CB, covariance.inverse()});
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
  schema->X_CR_covariance = weight * H.inverse();
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
      const double d2 = residual.dot(covariance.ldlt().solve(residual));
      if (!(d2 < kOutlierThreshold)) ++bad;
    };
    for (const PartObservation& other : s.parts) {
      if (other.part == part || culprits.count(other.part)) continue;
      const auto prediction = schema_.predict(other.part, part, s.action);
      if (!prediction) continue;
      const Pose z = other.X_CB.inverse() * o->X_CB;
      judge(
          log(prediction->X_AB.inverse() * z),
          prediction->covariance + relative_covariance(z, covariance_of(other), covariance_of(*o)));
    }
    if (const auto prediction = schema_.predict(schema_.root, part, s.action))
      judge(log((schema_.X_CR * prediction->X_AB).inverse() * o->X_CB),
            prediction->covariance + covariance_of(*o));
    return all > 0 ? static_cast<double>(bad) / all : 0;
  }

  Matrix6d covariance_of(const PartObservation& o) const {
    Matrix6d covariance = o.covariance;
    Vector6d extra;
    extra.head<3>().setConstant(std::pow(measurement_.model_error.position_m, 2) + 1e-10);
    extra.tail<3>().setConstant(std::pow(measurement_.model_error.rotation_rad, 2) + 1e-10);
    if (measurement_.noise) {
      covariance.setZero();
      extra.head<3>().array() += std::pow(measurement_.noise->position_m, 2);
      extra.tail<3>().array() += std::pow(measurement_.noise->rotation_rad, 2);
    }
    covariance.diagonal() += extra;
    return covariance;
  }

  const BodySchema& schema_;
  const std::vector<FittedEdge>& edges_;
  const std::vector<ActionPoseSample>& samples_;
  const MeasurementModel& measurement_;
  std::map<int, int> depth_;
};

// Why `part` is not connected to the root's component.
UnconnectedPart explain(int part, int num_seen, const std::set<int>& connected,
                        const SearchResult& search, int max_signals) {
  UnconnectedPart result;
  result.part = part;
  if (num_seen == 0) {
    result.reason = Unconnected::kNeverSeen;
    result.detail = "never seen";
    return result;
  }
  int common = 0, partner = -1;
  bool undecided = false;
  for (const auto& [pair, record] : search.records) {
    if (pair.first != part && pair.second != part) continue;
    const int other = pair.first == part ? pair.second : pair.first;
    if (!connected.count(other)) continue;
    undecided |= !record.undecided.empty();
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
  } else {
    result.reason = Unconnected::kNoValidModel;
    result.detail = seen + "; no model with up to " + std::to_string(max_signals) +
                    " signals is valid to any connected part";
  }
  return result;
}

}  // namespace

LearnResult learn(const std::vector<Signal>& signals, const std::vector<ActionPoseSample>& samples,
                  const LearnOptions& options) {
  if (options.max_signals < 0 || options.max_signals > kMaxJoints)
    throw std::invalid_argument("max_signals must be 0 to " + std::to_string(kMaxJoints));
  const int num_signals = static_cast<int>(signals.size());
  for (const auto& sample : samples)
    if (sample.action.size() != num_signals)
      throw std::invalid_argument("sample " + std::to_string(sample.sample_index) + " has " +
                                  std::to_string(sample.action.size()) + " action values, not " +
                                  std::to_string(num_signals));

  LearnResult result;
  BodySchema& schema = result.schema;
  schema.signals = signals;
  schema.num_samples = static_cast<int>(samples.size());
  std::map<int, int> num_seen;
  for (const auto& sample : samples) {
    schema.last_sample_index = std::max(schema.last_sample_index, sample.sample_index);
    for (const auto& o : sample.parts) ++num_seen[o.part];
  }
  for (const auto& [part, count] : num_seen) schema.parts.push_back(part);
  if (!schema.parts.empty()) schema.root = schema.parts.front();
  if (options.root) schema.root = *options.root;

  SearchOptions search_options;
  search_options.max_signals = options.max_signals;
  search_options.validity.outlier_rate = options.outlier_rate;
  MeasurementModel& measurement = search_options.measurement;
  measurement.model_error = options.model_error;
  measurement.max_error_ratio = options.max_error_ratio;
  const auto set_noise = [&](const std::vector<ActionPoseSample>& of) {
    if (options.noise) {
      measurement.noise = Noise{std::max(options.noise->position_m, kNoiseFloor.position_m),
                                std::max(options.noise->rotation_rad, kNoiseFloor.rotation_rad)};
    } else if (!has_covariances(of)) {
      measurement.noise =
          estimate_noise(of, num_signals, options.max_signals).value_or(kNoiseFloor);
    }
  };
  // Everything that is fitted sees displacements; which commands are bent shows only by a model.
  std::vector<ActionPoseSample> moved = samples;
  set_noise(moved);
  std::optional<NormalizedActions> actions(std::in_place, moved, num_signals);
  SearchResult search = search_structure(moved, *actions, schema.parts, search_options);
  result.num_screens = search.num_screens;
  result.num_fits = search.num_fits;
  constexpr int kMaxWarpRounds = 3;
  for (int round = 0; round < kMaxWarpRounds; ++round) {
    std::vector<Signal> bent = schema.signals;
    if (!estimate_warps(samples, schema.parts, search, search_options, &bent)) break;
    std::vector<ActionPoseSample> again = displaced(samples, bent);
    const auto noise_before = measurement.noise;
    set_noise(again);
    const NormalizedActions actions_again(again, num_signals);
    SearchResult found = search_structure(again, actions_again, schema.parts, search_options);
    result.num_screens += found.num_screens;
    result.num_fits += found.num_fits;
    if (found.models.size() < search.models.size()) {
      measurement.noise = noise_before;
      break;
    }
    const bool was_spanning = search.models.size() + 1 >= schema.parts.size();
    // What bends a command must be worth it to all markers together, not only to the models that
    // asked for it.
    if (was_spanning && found.log_likelihood < search.log_likelihood + kWarpEvidence) {
      measurement.noise = noise_before;
      break;
    }
    schema.signals = std::move(bent);
    moved = std::move(again);
    actions.emplace(actions_again);
    search = std::move(found);
    if (was_spanning) break;
  }
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
        fitted.push_back(fit_edge(m, queue[head], to, moved, *actions, measurement));
        queue.push_back(to);
      }
    }
  };
  if (schema.has_part(schema.root)) grow_from(schema.root);
  connected_to_root = reached;
  for (const int part : schema.parts)
    if (!reached.count(part)) grow_from(part);
  for (const FittedEdge& f : fitted) schema.edges.push_back(f.edge);

  std::set<int> expected(options.expected_parts.begin(), options.expected_parts.end());
  expected.insert(schema.parts.begin(), schema.parts.end());
  if (options.root) expected.insert(*options.root);
  for (const int part : expected) {
    if (connected_to_root.count(part)) continue;
    const auto seen = num_seen.find(part);
    schema.unconnected.push_back(explain(part, seen == num_seen.end() ? 0 : seen->second,
                                         connected_to_root, search, options.max_signals));
  }
  // A part that was never seen is reported, but a tree over all the others is complete (Fig. 8,
  // 11).
  schema.complete = !schema.parts.empty() &&
                    std::all_of(schema.parts.begin(), schema.parts.end(),
                                [&](int part) { return connected_to_root.count(part) > 0; });

  estimate_root_pose(samples, measurement, &schema);
  result.outliers = OutlierAttribution(schema, fitted, samples, measurement).run();
  return result;
}

}  // namespace bodyschema
