#include "processes/structure_learner/outlier_attribution.h"

#include <algorithm>
#include <map>
#include <optional>
#include <set>

#include "common/kinematics/kinematic_path.h"

namespace bodyschema {
namespace {

class OutlierAttribution {
 public:
  OutlierAttribution(const BodySchema& schema, const std::vector<ActionPoseSample>& samples,
                     const MeasurementModel& measurement)
      : schema_(schema), samples_(samples), measurement_(measurement) {
    depth_[schema.root] = 0;
    for (const Edge& edge : schema.edges) depth_[edge.to] = depth_[edge.from] + 1;
  }

  // An edge's verdict on one instant.
  struct Judgement {
    const Edge* edge;
    bool outlying;
    bool concerns(int part) const { return edge->from == part || edge->to == part; }
  };

  std::set<int> culprits(int sample, std::vector<Judgement> judgements) const {
    const std::map<int, Count> original = count(judgements);
    std::set<int> culprits;
    while (std::any_of(judgements.begin(), judgements.end(),
                       [](const Judgement& j) { return j.outlying; })) {
      const std::vector<int> suspects = guiltiest(count(judgements), original);
      const int culprit =
          suspects.size() == 1 ? suspects.front() : most_contradicted(suspects, sample, culprits);
      culprits.insert(culprit);
      std::erase_if(judgements, [&](const Judgement& j) { return j.concerns(culprit); });
    }
    return culprits;
  }

 private:
  // The edges of a part.
  struct Count {
    int outlying = 0, all = 0;
  };

  static std::map<int, Count> count(const std::vector<Judgement>& judgements) {
    std::map<int, Count> counts;
    for (const Judgement& j : judgements)
      for (const int part : {j.edge->from, j.edge->to}) {
        counts[part].outlying += j.outlying;
        ++counts[part].all;
      }
    return counts;
  }

  // The parts with the largest share of outlying edges, and of these with most of them at first.
  static std::vector<int> guiltiest(const std::map<int, Count>& counts,
                                    const std::map<int, Count>& original) {
    std::vector<int> guiltiest;
    std::pair<double, int> most{-1, 0};
    for (const auto& [part, count] : counts) {
      if (count.outlying == 0) continue;
      const std::pair<double, int> guilt{static_cast<double>(count.outlying) / count.all,
                                         original.at(part).outlying};
      if (guilt > most) guiltiest.clear();
      if (guilt < most) continue;
      most = guilt;
      guiltiest.push_back(part);
    }
    return guiltiest;
  }

  // The part that most others contradict, then the one farthest from the root.
  int most_contradicted(const std::vector<int>& suspects, int sample,
                        const std::set<int>& culprits) const {
    int result = suspects.front();
    std::pair<double, int> most{-1, -1};
    for (const int part : suspects) {
      const std::pair<double, int> d{disagreement(sample, part, culprits), depth_.at(part)};
      if (d <= most) continue;
      most = d;
      result = part;
    }
    return result;
  }

  // Share of the other visible parts (and of the root's usual pose) that contradict a part's pose.
  double disagreement(int sample, int part, const std::set<int>& culprits) const {
    const ActionPoseSample& s = samples_[sample];
    const PartObservation* o = s.find(part);
    int bad = 0, all = 0;
    const auto judge = [&](const Vector6d& residual, const Matrix6d& covariance,
                           int num_residuals) {
      ++all;
      const double d2 = squared_mahalanobis(residual, covariance);
      if (!(d2 < outlier_threshold(num_residuals))) ++bad;
    };
    for (const PartObservation& other : s.parts) {
      if (other.part == part || culprits.contains(other.part) || !other.has_rotation) continue;
      const auto& path = path_between(other.part, part);
      if (!path) continue;
      const Pose X = path->predict(s.action);
      const auto seen = measurement_.reading(*o, other.X_CB * X);
      const Pose z = other.X_CB.inverse() * seen.X_CB;
      judge(log(X.inverse() * z),
            path->covariance(s.action, Variance::kFirstOrder) +
                relative_covariance(z, measurement_.covariance(other), seen.covariance),
            seen.num_residuals);
    }
    if (const auto& path = path_between(schema_.root, part)) {
      const Pose X = schema_.X_CR * path->predict(s.action);
      const auto seen = measurement_.reading(*o, X);
      judge(log(X.inverse() * seen.X_CB),
            path->covariance(s.action, Variance::kFirstOrder) + seen.covariance,
            seen.num_residuals);
    }
    return all > 0 ? static_cast<double>(bad) / all : 0;
  }

  const std::optional<KinematicPath>& path_between(int from, int to) const {
    const auto [it, is_new] = paths_.try_emplace({from, to});
    if (is_new) it->second = KinematicPath::between(schema_, from, to);
    return it->second;
  }

  const BodySchema& schema_;
  const std::vector<ActionPoseSample>& samples_;
  const MeasurementModel& measurement_;
  std::map<int, int> depth_;
  mutable std::map<std::pair<int, int>, std::optional<KinematicPath>> paths_;  // found so far
};

}  // namespace

std::vector<Outlier> attribute_outliers(const BodySchema& schema,
                                        const std::vector<FittedEdge>& edges,
                                        const std::vector<ActionPoseSample>& samples,
                                        const MeasurementModel& measurement) {
  std::map<int, std::vector<OutlierAttribution::Judgement>> by_sample;
  for (const FittedEdge& f : edges)
    for (std::size_t n = 0; n < f.frames.size(); ++n)
      by_sample[f.frames[n]].push_back({&f.edge, f.outlying[n]});
  const OutlierAttribution attribution(schema, samples, measurement);
  std::vector<Outlier> result;
  for (const auto& [sample, judgements] : by_sample)
    for (const int part : attribution.culprits(sample, judgements))
      result.push_back({samples[sample].sample_index, part});
  return result;
}

}  // namespace bodyschema
