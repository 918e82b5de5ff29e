#include "common/schema/visibility.h"

#include <algorithm>
#include <cmath>

#include "common/geometry/angle.h"

namespace bodyschema {
namespace {

constexpr double kViewWidth_rad = 15 * kDegree;
constexpr double kSignalWidth = 0.4;  // rms over the signals, of half ranges
constexpr double kPriorCount = 1;     // past actions that the overall share counts for

}  // namespace

VisibilityModel::VisibilityModel(const BodySchema& schema, const std::vector<SeenAction>& past)
    : schema_(schema) {
  for (const SeenAction& seen : past) {
    past_.push_back(view_at(seen.action));
    past_.back().parts = seen.parts;
  }
}

VisibilityModel::View VisibilityModel::view_at(const Eigen::VectorXd& action) const {
  View view;
  view.x = normalized(schema_.signals, action);
  for (const auto& [part, X_RB] : schema_.predict_all(action))
    view.directions[part] = (schema_.X_CR * X_RB).inverse().translation().normalized();
  return view;
}

std::map<int, double> VisibilityModel::probabilities(const Eigen::VectorXd& action) const {
  const View here = view_at(action);
  std::set<int> parts(schema_.parts.begin(), schema_.parts.end());
  for (const UnconnectedPart& part : schema_.unconnected) parts.insert(part.part);
  std::map<int, double> result;
  for (const int part : parts) {
    const auto direction = here.directions.find(part);
    double num_seen = 0, seen = 0, all = 0;
    for (const View& before : past_) {
      double distance2 = 0;
      if (direction != here.directions.end()) {
        const double cosine = direction->second.dot(before.directions.at(part));
        distance2 = std::pow(std::acos(std::clamp(cosine, -1.0, 1.0)) / kViewWidth_rad, 2);
      } else if (here.x.size() > 0) {
        distance2 = (here.x - before.x).squaredNorm() /
                    (static_cast<double>(here.x.size()) * kSignalWidth * kSignalWidth);
      }
      const double weight = std::exp(-0.5 * distance2);
      const bool is_seen = before.parts.contains(part);
      all += weight;
      seen += is_seen ? weight : 0;
      num_seen += is_seen;
    }
    // Without similar actions: the share overall, with one seen and one unseen added.
    const double share = (num_seen + 1) / (static_cast<double>(past_.size()) + 2);
    result[part] = (seen + kPriorCount * share) / (all + kPriorCount);
  }
  return result;
}

}  // namespace bodyschema
