// What DriftWatch says of means, spreads and correlations of its measurements.

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>

#include "common/estimation/chi_square.h"
#include "common/estimation/student_t.h"
#include "processes/model_monitor/changes/change_family.h"
#include "processes/model_monitor/hypotheses/drift_watch.h"
#include "processes/model_monitor/hypotheses/schema_difference.h"

namespace bodyschema {
namespace {

/// Squared distance of a measurement beyond which noise does not explain it.
const double kExplained = chi_square_quantile(6, 0.001);
/// Variance of a model that claims to be exact.
constexpr double kExact = 1e-12;
/// Newest measurements whose mean tells whether an edge moved: so many, and each so many more.
/// All that follow are chosen; small_faults and false_alarms measure them.
constexpr std::size_t kFewest = 12, kMostNewest = 40, kEach = 4;
/// Means that count as independent: while one of the longest fills anew, over all edges.
constexpr double kNumMeans = 10;
/// Measurements from before, of which the mean tells what the model is off by there.
constexpr std::size_t kFewestBefore = 30;
/// Of the measurements whose spread is taken, one in so many, the farthest, may be an outlier.
constexpr std::size_t kEachFarthest = 10;
/// Samples between residuals whose correlations are looked at, the fewest pairs that tell them to
/// 0.1, and a pair's weight one sample later. Smaller correlations than kNoCorrelation, and than
/// three standard deviations of none, are not told from none.
constexpr std::array<std::int64_t, 2> kLags{1, 5};
constexpr double kFewestProducts = 20, kFading = 0.99;
constexpr double kNoCorrelation = 0.15;
/// An edge that may have moved is looked at by what explains it, this much before it surely has
/// [nats].
constexpr double kHalfSure = 6;

}  // namespace

DriftWatch::DriftWatch(double false_alarm_rate)
    : log_sure_(std::log(false_alarm_rate / kNumMeans)) {}

void DriftWatch::Mean::add(const Reading& reading) {
  const double d2 = reading.xi.dot(reading.information * reading.xi);
  const Matrix6d I = robust_weight(d2) * reading.information;
  information += I;
  sum += I * reading.xi;
  model += reading.model;
  ++size;
}

std::vector<DriftWatch::Reading> DriftWatch::readings(const BodySchema& schema,
                                                      const ElementId& element, const Measured& m) {
  if (element.is_tag()) return {{log(m.of.z), m.of.covariance.inverse(), m.systematic}};
  const Edge* edge = edge_to(schema, element.id);
  const Pose X = edge ? edge->predict(m.displacements) : schema.X_CR;
  const Matrix6d model =
      m.systematic + (edge ? model_covariance(*edge, m.displacements) : schema.X_CR_covariance);
  const Vector6d xi = log(X.inverse() * m.of.z);
  const Matrix6d information = m.of.covariance.inverse();
  std::vector<Reading> result;
  for (const Pose& at : link_poses(edge, m.displacements, X)) {
    const Pose rest = at.inverse() * X;
    const Matrix6d A = adjoint(rest), B = adjoint(rest.inverse());
    result.push_back({A * xi, B.transpose() * information * B, A * model * A.transpose()});
  }
  return result;
}

double DriftWatch::log_chance(const Mean& newest, const Mean* before, double worth,
                              double discrepancy, const std::optional<Vector6d>& twist) {
  const Matrix6d model =
      newest.model / static_cast<double>(newest.size) + kExact * Matrix6d::Identity();
  const Matrix6d spread = newest.information.inverse();
  Vector6d offset = spread * newest.sum;
  Matrix6d covariance = spread / worth;
  if (before) {
    // What the model is off by is known from before, but for what differs with the action; where
    // samples tell less than one each, so do their actions.
    const Matrix6d known = (model.inverse() + worth * before->information).inverse();
    offset -= worth * known * before->sum;
    covariance += known + std::min(discrepancy / worth, 1.0) * model;
  } else {
    covariance += model;
  }
  const Eigen::LDLT<Matrix6d> ldlt(covariance);
  const Vector6d weighted = ldlt.solve(offset);
  const double d2 = offset.dot(weighted);
  if (!std::isfinite(d2)) return 0;
  double log_chance = log_chi_square_tail(std::max(d2, 0.0), 6);
  if (twist) {
    const double along = std::pow(twist->dot(weighted), 2) / twist->dot(ldlt.solve(*twist));
    if (std::isfinite(along)) log_chance = std::min(log_chance, log_chi_square_tail(along, 1));
  }
  return log_chance;
}

std::optional<DriftWatch::Moved> DriftWatch::moved(const BodySchema& schema) const {
  const std::optional<double> worth = this->worth();
  if (!worth) return std::nullopt;
  std::optional<Moved> moved;
  double least = log_sure_ + kHalfSure;
  // The schema may have changed with the newest sample.
  const bool has_before = is_same(schema, schema_);
  for (const auto& [element, unused] : measured_) {
    const auto* queue = find(element, kFewest);
    if (!queue) continue;
    const Edge* edge = element.is_tag() ? nullptr : edge_to(schema, element.id);
    if (!edge && !element.is_tag() && element.id != schema.root) continue;
    std::vector<std::vector<Reading>> all;  // the newest last
    for (const Measured& m : *queue) all.push_back(readings(schema, element, m));
    const std::size_t num_links = all.back().size();
    const auto popped = before_.find(element);
    for (std::size_t link = 0; link < num_links; ++link) {
      // A joint's displacement is an offset of its own twist before the link that it carries.
      std::optional<Vector6d> twist;
      if (edge && link < edge->joints.size()) {
        twist = screw_twist(edge->joints[link]);
        if (link == 0) twist = adjoint(edge->left) * *twist;
      }
      std::vector<Mean> older{has_before && popped != before_.end() ? popped->second[link]
                                                                    : Mean{}};
      for (const std::vector<Reading>& of : all) {
        older.push_back(older.back());
        older.back().add(of[link]);
      }
      Mean newest;
      for (std::size_t n = all.size(); n-- > 0 && newest.size < kMostNewest;) {
        newest.add(all[n][link]);
        if (newest.size < kFewest || newest.size % kEach != 0) continue;
        // What is off from the first sample on is no change, unless by much.
        double chance = 0;
        if (queue->size() >= kMostNewest) chance = log_chance(newest, nullptr, *worth, 1, twist);
        if (has_before && older[n].size >= kFewestBefore)
          chance = std::min(chance, log_chance(newest, &older[n], *worth,
                                               actions_.since((*queue)[n].sample_index), twist));
        if (chance >= least) continue;
        least = chance;
        moved = Moved{element, (*queue)[n].sample_index, chance < log_sure_};
      }
    }
  }
  return moved;
}

DriftWatch::Spread DriftWatch::spread(const BodySchema& schema, int part) const {
  const ElementId element = edge_element(part, schema.root);
  Spread spread;
  const auto* queue = find(element, 1);
  if (!queue) return spread;
  std::vector<std::pair<double, Vector6d>> offsets;  // d², ξ
  for (auto m = queue->rbegin(); m != queue->rend() && offsets.size() < kMostNewest; ++m) {
    const Reading reading = readings(schema, element, *m).back();
    offsets.emplace_back(reading.xi.dot(reading.information * reading.xi), reading.xi);
    spread.num_off += offsets.back().first > kExplained;
  }
  spread.size = offsets.size();
  std::ranges::sort(offsets, {}, [](const auto& offset) { return offset.first; });
  offsets.resize(offsets.size() - offsets.size() / kEachFarthest);
  for (const auto& [unused, xi] : offsets)
    spread.second_moment += xi * xi.transpose() / static_cast<double>(offsets.size());
  return spread;
}

void DriftWatch::Products::add(const Vector6d& residual, const Vector6d& earlier) {
  products = kFading * products + residual.dot(earlier);
  squares = kFading * squares + residual.squaredNorm();
  sum = kFading * sum + residual;
  size = kFading * size + 1;
}

void DriftWatch::rescale_noise(double factor) {
  for (auto& [tag, lags] : products_)
    for (Products& of : lags) {
      of.sum /= factor;
      of.products /= factor * factor;
      of.squares /= factor * factor;
    }
}

void DriftWatch::correlate(const ElementId& tag) {
  const std::deque<Measured>& queue = measured_[tag];
  const auto whitened = [](const Measured& m) -> Vector6d {
    return Eigen::LLT<Matrix6d>(m.of.covariance).matrixL().solve(log(m.of.z));
  };
  const Vector6d residual = whitened(queue.back());
  if (!(residual.squaredNorm() <= kExplained)) return;  // nor what is no number
  for (std::size_t lag = 0; lag < kLags.size(); ++lag)
    for (auto m = queue.rbegin(); m != queue.rend(); ++m) {
      const std::int64_t apart = queue.back().sample_index - m->sample_index;
      if (apart > kLags[lag]) break;
      if (apart < kLags[lag]) continue;
      const Vector6d earlier = whitened(*m);
      if (earlier.squaredNorm() < kExplained) products_[tag][lag].add(residual, earlier);
    }
}

std::optional<double> DriftWatch::worth() const {
  double no_correlation = 0, largest_variance = 0;
  std::array<double, kLags.size()> correlation{};
  for (std::size_t lag = 0; lag < kLags.size(); ++lag) {
    double products = 0, squares = 0, size = 0;
    for (const auto& [tag, lags] : products_) {
      const Products& of = lags[lag];
      if (of.size >= kFewestProducts)
        largest_variance = std::max(largest_variance, of.squares / (6 * of.size));
      // What the model is off by all the time is no noise.
      const double constant = of.size > 0 ? of.sum.squaredNorm() / of.size : 0;
      products += of.products - constant;
      squares += of.squares - constant;
      size += of.size;
    }
    if (size < kFewestProducts || squares <= 0) return std::nullopt;
    correlation[lag] = products / squares;
    no_correlation = std::max(kNoCorrelation, 3 / std::sqrt(6 * size));
  }
  const auto [near, far] = correlation;
  if (near < no_correlation) return 1;
  const double ratio = std::clamp(far / near, 1e-3, 0.99);
  const double phi = std::pow(ratio, 1.0 / static_cast<double>(kLags[1] - kLags[0]));
  // More than is assumed is for the scale of the noise.
  const double variance = largest_variance > 0 ? std::min(largest_variance, 1.0) : 1;
  return std::min(1.0, 1 / (variance * (1 + 2 * near / (1 - phi))));
}

}  // namespace bodyschema
