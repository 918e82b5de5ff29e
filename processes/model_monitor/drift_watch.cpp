#include "processes/model_monitor/drift_watch.h"

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <cmath>

#include "common/statistics/student_t.h"
#include "processes/model_monitor/body_change.h"

namespace bodyschema {
namespace {

constexpr std::size_t kWindow = 44;
/// Of the mean that tells whether an edge moved.
constexpr std::size_t kMean = 36;
constexpr std::size_t kFewest = 16;
/// Of a straight line through the newest measurements.
constexpr std::size_t kFollowed = 40;

struct Reading {
  double time;  // samples, 0 is the newest
  Vector6d xi;
  Matrix6d information;
};

/// ξ(t) = a + b t by robust least squares.
struct Line {
  Eigen::Matrix<double, 12, 1> ab;
  Eigen::Matrix<double, 12, 12> covariance;
  double cost = 0;
};

Line fit_line(const std::vector<Reading>& readings) {
  Line line;
  line.ab.setZero();
  for (int round = 0; round < 6; ++round) {
    Eigen::Matrix<double, 12, 12> H = 1e-9 * Eigen::Matrix<double, 12, 12>::Identity();
    Eigen::Matrix<double, 12, 1> g = Eigen::Matrix<double, 12, 1>::Zero();
    line.cost = 0;
    for (const Reading& r : readings) {
      const Vector6d e = r.xi - line.ab.head<6>() - r.time * line.ab.tail<6>();
      const double d2 = e.dot(r.information * e);
      line.cost += (kStudentNu + 6) / 2 * std::log1p(d2 / kStudentNu);
      const Matrix6d I = (round == 0 ? 1 : robust_weight(d2)) * r.information;
      H.topLeftCorner<6, 6>() += I;
      H.topRightCorner<6, 6>() += r.time * I;
      H.bottomRightCorner<6, 6>() += r.time * r.time * I;
      const Vector6d Ix = I * r.xi;
      g.head<6>() += Ix;
      g.tail<6>() += r.time * Ix;
    }
    H.bottomLeftCorner<6, 6>() = H.topRightCorner<6, 6>().transpose();
    const Eigen::LDLT<Eigen::Matrix<double, 12, 12>> ldlt(H);
    line.ab = ldlt.solve(g);
    line.covariance = ldlt.solve(Eigen::Matrix<double, 12, 12>::Identity());
  }
  return line;
}

/// Squared Mahalanobis distance of the readings' robust mean from 0; `model` is common to them all.
double mean_offset(const std::vector<Reading>& readings, const Matrix6d& model) {
  Matrix6d H;
  Vector6d mean = Vector6d::Zero();
  for (int round = 0; round < 4; ++round) {
    H.setZero();
    Vector6d g = Vector6d::Zero();
    for (const Reading& r : readings) {
      const Vector6d e = r.xi - mean;
      const Matrix6d I = robust_weight(e.dot(r.information * e)) * r.information;
      H += I;
      g += I * r.xi;
    }
    mean = H.ldlt().solve(g);
  }
  return mean.dot(Matrix6d(H.inverse() + model).ldlt().solve(mean));
}

/// A symmetric matrix without its negative eigenvalues.
Matrix6d positive_part(const Matrix6d& symmetric) {
  const Eigen::SelfAdjointEigenSolver<Matrix6d> solver(symmetric);
  return solver.eigenvectors() * solver.eigenvalues().cwiseMax(0).asDiagonal() *
         solver.eigenvectors().transpose();
}

}  // namespace

DriftWatch::DriftWatch(double false_alarm_rate)
    // Tail of χ²₆ beyond x: e^(−x/2) (1 + x/2 + x²/8); solved for a hundredth of the rate, since
    // windows overlap and there are many edges.
    : threshold_([&] {
        const double tail = false_alarm_rate / 100;
        double x = 20;
        for (int n = 0; n < 100; ++n) x = 2 * (std::log1p(x / 2 + x * x / 8) - std::log(tail));
        return x;
      }()) {}

void DriftWatch::add(const TreeFilter& filter, const TreeFilter::Instant& instant,
                     const Eigen::VectorXd& displacements, std::int64_t sample_index) {
  TreeFilter::Instant exact = instant;
  for (Matrix6d& covariance : exact.edge_covariance) covariance = 1e-12 * Matrix6d::Identity();
  for (int node = 0; node < filter.num_nodes(); ++node) {
    const auto of = filter.measure_edge(instant, node);
    const auto with_exact_models = filter.measure_edge(exact, node);
    if (!of || !with_exact_models) continue;
    // Exact models believe fewer markers: what they know less does not make the others surer.
    const Matrix6d systematic = positive_part(of->covariance - with_exact_models->covariance);
    auto& queue = measured_[filter.part(node)];
    queue.push_back({sample_index, displacements, *of, systematic});
    if (queue.size() > kWindow) queue.pop_front();
  }
}

void DriftWatch::forget(int part, std::int64_t before) {
  auto& queue = measured_[part];
  while (!queue.empty() && queue.front().sample_index < before) queue.pop_front();
}

void DriftWatch::forget_all() { measured_.clear(); }

const std::deque<DriftWatch::Measured>* DriftWatch::find(int part) const {
  const auto it = measured_.find(part);
  return it == measured_.end() || it->second.size() < kFewest ? nullptr : &it->second;
}

std::optional<int> DriftWatch::moved_part(const BodySchema& schema) const {
  std::optional<int> moved;
  double most = threshold_;
  for (const auto& [part, unused] : measured_) {
    const auto* queue = find(part);
    if (!queue) continue;
    const Edge* edge = edge_to(schema, part);
    if (!edge && part != schema.root) continue;
    // Mean offset on either side, as far as the model's own uncertainty does not explain it.
    std::vector<Reading> right, left;
    Matrix6d model_right = Matrix6d::Zero(), model_left = Matrix6d::Zero();
    const std::size_t begin = queue->size() > kMean ? queue->size() - kMean : 0;
    const double share = 1 / static_cast<double>(queue->size() - begin);
    for (std::size_t n = begin; n < queue->size(); ++n) {
      const Measured& m = (*queue)[n];
      const Pose X = edge ? edge->predict(m.displacements) : schema.X_CR;
      const Matrix6d model =
          m.systematic + (edge ? model_covariance(*edge, m.displacements) : schema.X_CR_covariance);
      const Vector6d xi = log(X.inverse() * m.of.z);
      const Matrix6d information = m.of.covariance.inverse();
      right.push_back({0, xi, information});
      model_right += share * model;
      if (!edge || edge->joints.empty()) continue;
      const Matrix6d A = adjoint(X), B = adjoint(X.inverse());
      left.push_back({0, A * xi, B.transpose() * information * B});
      model_left += share * A * model * A.transpose();
    }
    for (const bool is_left : {false, true}) {
      const std::vector<Reading>& readings = is_left ? left : right;
      if (readings.empty()) continue;
      const double d2 = mean_offset(readings, is_left ? model_left : model_right);
      if (d2 <= most) continue;
      most = d2;
      moved = part;
    }
  }
  return moved;
}

std::optional<Drift> DriftWatch::follow(const BodySchema& schema, int part) const {
  const auto* queue = find(part);
  if (!queue) return std::nullopt;
  const Edge* edge = edge_to(schema, part);
  std::optional<Drift> best;
  double least = 0;
  const std::int64_t now = queue->back().sample_index;
  for (const bool left : {false, true}) {
    if (left && (!edge || edge->joints.empty())) continue;
    std::vector<Pose> T;
    std::vector<Reading> readings;
    for (std::size_t n = queue->size() > kFollowed ? queue->size() - kFollowed : 0;
         n < queue->size(); ++n) {
      const Measured& m = (*queue)[n];
      const Pose X = edge ? edge->predict(m.displacements) : schema.X_CR;
      Matrix6d covariance = m.of.covariance;
      if (left) {
        const Matrix6d A = adjoint(X);
        covariance = A * covariance * A.transpose();
      }
      T.push_back(left ? m.of.z * X.inverse() : X.inverse() * m.of.z);
      readings.push_back(
          {static_cast<double>(m.sample_index - now), Vector6d::Zero(), covariance.inverse()});
    }
    // About the reading nearest to all others, in the end about the line's own value of now.
    Pose reference = T[T.size() / 2];
    Line line;
    for (int round = 0; round < 3; ++round) {
      for (std::size_t n = 0; n < T.size(); ++n) readings[n].xi = log(reference.inverse() * T[n]);
      line = fit_line(readings);
      reference = reference * exp(line.ab.head<6>());
    }
    if (best && line.cost >= least) continue;
    least = line.cost;
    Drift drift;
    drift.part = part;
    drift.left = left;
    drift.T = reference;
    drift.covariance = line.covariance.topLeftCorner<6, 6>();
    drift.rate = line.ab.tail<6>();
    drift.rate_covariance = line.covariance.bottomRightCorner<6, 6>();
    drift.significance = drift.rate.dot(drift.rate_covariance.ldlt().solve(drift.rate));
    best = drift;
  }
  return best;
}

}  // namespace bodyschema
