#include "processes/model_monitor/hypotheses/drift_watch.h"

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <ranges>
#include <utility>

#include "common/estimation/student_t.h"
#include "processes/model_monitor/changes/change_family.h"
#include "processes/model_monitor/changes/drift.h"
#include "processes/model_monitor/hypotheses/change_fit.h"

namespace bodyschema {
namespace {

constexpr std::size_t kWindow = 44;
/// Of the mean that tells whether an edge moved.
constexpr std::size_t kMean = 36;
constexpr std::size_t kFewest = 16;
/// Of a straight line through the newest measurements.
constexpr std::size_t kFollowed = 40;
constexpr std::size_t kFewestFollowed = 4;

/// A drift of 0.1° a sample is suspected about 20 samples after its begin.
constexpr std::int64_t kLongestUnseen = 28;
constexpr std::int64_t kCoarse = 4;
/// Measurements since its begin by which a drift is told.
constexpr int kFewestMoved = 4;
/// χ²₆(0.999) and the share of the measurements that must be below it: outliers are rarer.
constexpr double kExplained = 22.5;
constexpr double kMostlyExplained = 0.75;

/// Probability that a drift ends at a given sample; and how many samples ago at most it is looked
/// for. Chosen: drifts last for hundreds of samples.
constexpr double kEnds = 0.005;
constexpr int kLatestEnd = 20;

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

Matrix6d rate_information() {
  Vector6d sigma;
  sigma << Eigen::Vector3d::Constant(kDriftRateSigma.position_m),
      Eigen::Vector3d::Constant(kDriftRateSigma.rotation_rad);
  return sigma.cwiseAbs2().cwiseInverse().asDiagonal();
}

/// `ended`: it stands still since this time.
Line fit_line(const std::vector<Reading>& readings, double ended = 0, int rounds = 6) {
  Line line;
  line.ab.setZero();
  for (int round = 0; round < rounds; ++round) {
    Eigen::Matrix<double, 12, 12> H = 1e-9 * Eigen::Matrix<double, 12, 12>::Identity();
    H.bottomRightCorner<6, 6>() += rate_information();
    Eigen::Matrix<double, 12, 1> g = Eigen::Matrix<double, 12, 1>::Zero();
    line.cost = 0;
    for (const Reading& r : readings) {
      const double time = std::min(r.time - ended, 0.0);
      const Vector6d e = r.xi - line.ab.head<6>() - time * line.ab.tail<6>();
      const double d2 = e.dot(r.information * e);
      line.cost += robust_cost(d2);
      const Matrix6d I = (round == 0 ? 1 : robust_weight(d2)) * r.information;
      H.topLeftCorner<6, 6>() += I;
      H.topRightCorner<6, 6>() += time * I;
      H.bottomRightCorner<6, 6>() += time * time * I;
      const Vector6d Ix = I * r.xi;
      g.head<6>() += Ix;
      g.tail<6>() += time * Ix;
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
  return squared_mahalanobis(mean, H.inverse() + model);
}

TreeFilter::Instant with_exact_models(TreeFilter::Instant instant) {
  for (Matrix6d& covariance : instant.edge_covariance) covariance = 1e-12 * Matrix6d::Identity();
  return instant;
}

/// What a measurement shows of T where X_d · T · X_d⁻¹ · X is seen, `at` = X_d, and its information
/// in a right perturbation.
std::pair<Pose, Matrix6d> displaced(const Pose& at, const Pose& X, const VirtualMeasurement& of) {
  const Pose rest = at.inverse() * X;
  const Matrix6d A = adjoint(rest);
  return {at.inverse() * of.z * rest.inverse(), (A * of.covariance * A.transpose()).inverse()};
}

std::size_t num_links(const Edge* edge) { return edge ? edge->joints.size() + 1 : 1; }

/// ξ(t) = rate · (t − begin) from `begin` on, and 0 before.
struct BegunLine {
  Vector6d rate = Vector6d::Zero();
  Matrix6d covariance;
  double log_prior = 0, gain = 0;  // as in BegunDrift
  bool is_good = false;
};

/// std::nullopt if too little of it was seen. From time `since` on it is to explain the readings.
std::optional<BegunLine> fit_begun(const std::vector<Reading>& readings, double begin,
                                   double since) {
  int num_moved = 0;
  for (const Reading& r : readings) num_moved += r.time > begin;
  if (num_moved < kFewestMoved) return std::nullopt;
  const Matrix6d prior = rate_information();
  BegunLine line;
  Matrix6d H;
  for (int round = 0; round < 6; ++round) {
    H = prior;
    Vector6d g = -prior * line.rate;
    for (const Reading& r : readings) {
      const double elapsed = r.time - begin;
      if (elapsed <= 0) continue;
      // T is far from 1 where it drifted for long: exact residuals, and Jacobians of small ones.
      const Vector6d e = round == 0 ? r.xi : log(exp(-elapsed * line.rate) * exp(r.xi));
      const Matrix6d I = (round == 0 ? 1 : robust_weight(e.dot(r.information * e))) * r.information;
      H += elapsed * elapsed * I;
      g += elapsed * I * e;
    }
    line.rate += H.ldlt().solve(g);
  }
  line.covariance = H.inverse();
  const Eigen::LLT<Matrix6d> llt(H), of_prior(prior);
  if (llt.info() != Eigen::Success || !line.rate.allFinite()) return std::nullopt;
  line.log_prior = kSmallLogOdds - 0.5 * line.rate.dot(prior * line.rate) +
                   of_prior.matrixLLT().diagonal().array().log().sum() -
                   llt.matrixLLT().diagonal().array().log().sum() -
                   std::log(static_cast<double>(kLongestUnseen));
  line.gain = line.log_prior;
  int num = 0, num_explained = 0;
  bool is_newest_explained = false;
  for (const Reading& r : readings) {
    const double elapsed = r.time - begin;
    if (elapsed <= 0) continue;
    const Vector6d e = log(exp(-elapsed * line.rate) * exp(r.xi));
    const double d2 = e.dot(r.information * e);
    line.gain += robust_cost(r.xi.dot(r.information * r.xi)) - robust_cost(d2);
    if (r.time < since) continue;
    is_newest_explained = d2 < kExplained;
    num_explained += is_newest_explained;
    ++num;
  }
  line.is_good = is_newest_explained && num_explained >= kMostlyExplained * num;
  return line;
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

std::optional<DriftWatch::Measured> DriftWatch::measure(const TreeFilter& filter,
                                                        const TreeFilter::Instant& instant,
                                                        const TreeFilter::Instant& exact,
                                                        int node) {
  const auto of = filter.measure_edge(instant, node);
  const auto with_exact_models = filter.measure_edge(exact, node);
  if (!of || !with_exact_models) return std::nullopt;
  // Exact models believe fewer markers: what they know less does not make the others surer.
  return Measured{0, {}, *of, positive_part(of->covariance - with_exact_models->covariance)};
}

void DriftWatch::add(const TreeFilter& filter, const TreeFilter::Instant& instant,
                     const Eigen::VectorXd& displacements, std::int64_t sample_index) {
  const TreeFilter::Instant exact = with_exact_models(instant);
  for (int node = 0; node < filter.num_nodes(); ++node) {
    auto measured = measure(filter, instant, exact, node);
    if (!measured) continue;
    measured->sample_index = sample_index;
    measured->displacements = displacements;
    auto& queue = measured_[filter.part(node)];
    queue.push_back(std::move(*measured));
    if (queue.size() > kWindow) queue.pop_front();
  }
}

void DriftWatch::look_again(const BodySchema& schema, const MeasurementModel& measurement, int part,
                            const std::vector<const ActionPoseSample*>& samples) {
  forget_all();
  const TreeFilter filter(schema, measurement);
  const int node = filter.node_of(part);
  if (node < 0) return;
  for (const ActionPoseSample* sample : samples) {
    const TreeFilter::Instant instant = filter.prepare(*sample);
    auto measured = measure(filter, instant, with_exact_models(instant), node);
    if (!measured) continue;
    measured->sample_index = sample->sample_index;
    measured->displacements = schema.displacements(sample->action);
    auto& queue = measured_[part];
    queue.push_back(std::move(*measured));
    if (queue.size() > kWindow) queue.pop_front();
  }
}

void DriftWatch::forget(int part, std::int64_t before) {
  auto& queue = measured_[part];
  while (!queue.empty() && queue.front().sample_index < before) queue.pop_front();
}

void DriftWatch::forget_all() { measured_.clear(); }

const std::deque<DriftWatch::Measured>* DriftWatch::find(int part, std::size_t fewest) const {
  const auto it = measured_.find(part);
  return it == measured_.end() || it->second.size() < fewest ? nullptr : &it->second;
}

std::optional<int> DriftWatch::moved_part(const BodySchema& schema) const {
  std::optional<int> moved;
  double most = threshold_;
  for (const auto& [part, unused] : measured_) {
    const auto* queue = find(part, kFewest);
    if (!queue) continue;
    const Edge* edge = edge_to(schema, part);
    if (!edge && part != schema.root) continue;
    // Mean offset in each link, as far as the model's own uncertainty does not explain it.
    struct Link {
      std::vector<Reading> readings;
      Matrix6d model = Matrix6d::Zero();
    };
    std::vector<Link> links(num_links(edge));
    const std::size_t begin = queue->size() > kMean ? queue->size() - kMean : 0;
    const double share = 1 / static_cast<double>(queue->size() - begin);
    for (std::size_t n = begin; n < queue->size(); ++n) {
      const Measured& m = (*queue)[n];
      const Pose X = edge ? edge->predict(m.displacements) : schema.X_CR;
      const Matrix6d model =
          m.systematic + (edge ? model_covariance(*edge, m.displacements) : schema.X_CR_covariance);
      const Vector6d xi = log(X.inverse() * m.of.z);
      const Matrix6d information = m.of.covariance.inverse();
      const std::vector<Pose> poses = link_poses(edge, m.displacements, X);
      for (std::size_t link = 0; link < links.size(); ++link) {
        const Pose rest = poses[link].inverse() * X;
        const Matrix6d A = adjoint(rest), B = adjoint(rest.inverse());
        links[link].readings.push_back({0, A * xi, B.transpose() * information * B});
        links[link].model += share * A * model * A.transpose();
      }
    }
    for (const Link& link : std::views::reverse(links)) {
      const double d2 = mean_offset(link.readings, link.model);
      if (d2 <= most) continue;
      most = d2;
      moved = part;
    }
  }
  return moved;
}

std::optional<Drift> DriftWatch::follow(const BodySchema& schema, int part) const {
  const auto* queue = find(part, kFewestFollowed);
  if (!queue) return std::nullopt;
  const Edge* edge = edge_to(schema, part);
  std::optional<Drift> best;
  double most = 0;
  const std::int64_t now = queue->back().sample_index;
  for (std::size_t link = num_links(edge); link-- > 0;) {
    std::vector<Pose> T;
    std::vector<Reading> readings;
    for (std::size_t n = queue->size() > kFollowed ? queue->size() - kFollowed : 0;
         n < queue->size(); ++n) {
      const Measured& m = (*queue)[n];
      const Pose X = edge ? edge->predict(m.displacements) : schema.X_CR;
      const auto [seen, information] =
          displaced(link_poses(edge, m.displacements, X)[link], X, m.of);
      T.push_back(seen);
      readings.push_back(
          {static_cast<double>(m.sample_index - now), Vector6d::Zero(), information});
    }
    // About the reading nearest to all others, in the end about the line's own value of now.
    Pose reference = T[T.size() / 2];
    Line line;
    for (int round = 0; round < 3; ++round) {
      for (std::size_t n = 0; n < T.size(); ++n) readings[n].xi = log(reference.inverse() * T[n]);
      line = fit_line(readings);
      reference = reference * exp(line.ab.head<6>());
    }
    for (std::size_t n = 0; n < T.size(); ++n) readings[n].xi = log(reference.inverse() * T[n]);
    line.ab.head<6>().setZero();
    struct Course {
      Line line;
      int ended;  // samples ago
      double log_weight;
    };
    std::vector<Course> courses{{line, 0, -line.cost}};
    for (int ended = 1; ended <= kLatestEnd; ++ended) {
      const auto num_before = std::count_if(readings.begin(), readings.end(),
                                            [ended](const Reading& r) { return r.time <= -ended; });
      if (num_before < static_cast<std::ptrdiff_t>(kFewestFollowed)) break;
      const Line stopped = fit_line(readings, -ended, 3);
      courses.push_back({stopped, ended, std::log(kEnds) - stopped.cost});
    }
    double highest = courses.front().log_weight, sum = 0;
    for (const Course& course : courses) highest = std::max(highest, course.log_weight);
    for (const Course& course : courses) sum += std::exp(course.log_weight - highest);
    if (best && highest + std::log(sum) <= most) continue;
    most = highest + std::log(sum);
    Vector6d mean = Vector6d::Zero();
    Drift drift;
    double likeliest_end = 0;
    for (const Course& course : courses) {
      const double p = std::exp(course.log_weight - most);
      mean += p * course.line.ab.head<6>();
      if (course.ended == 0) continue;
      drift.has_ended += p;
      if (p <= likeliest_end) continue;
      likeliest_end = p;
      drift.last_moved = now - course.ended;
    }
    for (const Course& course : courses) {
      const Vector6d off = course.line.ab.head<6>() - mean;
      drift.covariance += std::exp(course.log_weight - most) *
                          (course.line.covariance.topLeftCorner<6, 6>() + off * off.transpose());
    }
    drift.part = part;
    drift.link = static_cast<int>(link);
    drift.T = reference * exp(mean);
    drift.rate = line.ab.tail<6>();
    drift.rate_covariance = line.covariance.bottomRightCorner<6, 6>();
    drift.significance = squared_mahalanobis(drift.rate, drift.rate_covariance);
    best = drift;
  }
  return best;
}

BodySchema Drift::applied_to(const BodySchema& before) const {
  // `covariance` is that of a right perturbation of T: near enough to that of θ.
  return changed(before, drift_step(before, part, link), coordinates(T),
                 covariance + (1 - has_ended) * rate * rate.transpose());
}

double BegunDrift::log_likelihood(const BodySchema& before, const MeasurementModel& measurement,
                                  const std::vector<const ActionPoseSample*>& samples) const {
  const BodyChange change = drift_step(before, drift.part, drift.link);
  std::vector<const ActionPoseSample*> unmoved;
  double sum = 0;
  for (const ActionPoseSample* sample : samples) {
    if (sample->sample_index <= begin) {
      unmoved.push_back(sample);
      continue;
    }
    const auto elapsed = static_cast<double>(sample->sample_index - begin);
    sum += bodyschema::log_likelihood(
        changed(before, change, coordinates(exp(elapsed * drift.rate))), measurement, {sample});
  }
  return sum + bodyschema::log_likelihood(before, measurement, unmoved);
}

std::vector<BegunDrift> begun_drifts(const BodySchema& before, const MeasurementModel& measurement,
                                     const std::vector<int>& parts,
                                     const std::vector<const ActionPoseSample*>& samples,
                                     std::int64_t since) {
  const TreeFilter filter(before, measurement);
  struct Places {
    int part, node;
    const Edge* edge;
    std::vector<std::vector<Reading>> links;
  };
  std::vector<Places> places;
  for (const int part : parts)
    if (const int node = filter.node_of(part); node >= 0)
      places.push_back({part, node, edge_to(before, part), {}});
  std::vector<BegunDrift> result;
  if (samples.empty()) return result;
  for (const ActionPoseSample* sample : samples) {
    const TreeFilter::Instant instant = filter.prepare(*sample);
    const Eigen::VectorXd displacements = before.displacements(sample->action);
    for (Places& place : places) {
      const auto of = filter.measure_edge(instant, place.node);
      if (!of) continue;
      const Pose X = place.edge ? place.edge->predict(displacements) : before.X_CR;
      place.links.resize(num_links(place.edge));
      const std::vector<Pose> poses = link_poses(place.edge, displacements, X);
      for (std::size_t link = 0; link < poses.size(); ++link) {
        const auto [T, information] = displaced(poses[link], X, *of);
        place.links[link].push_back(
            {static_cast<double>(sample->sample_index), log(T), information});
      }
    }
  }
  const std::int64_t now = samples.back()->sample_index;
  const std::int64_t earliest = std::max(since - kLongestUnseen, samples.front()->sample_index - 1);
  for (const Places& place : places) {
    std::optional<BegunDrift> best;
    for (std::size_t link = place.links.size(); link-- > 0;) {
      const std::vector<Reading>& readings = place.links[link];
      const auto try_begin = [&](std::int64_t begin) -> std::optional<double> {
        const auto line =
            fit_begun(readings, static_cast<double>(begin), static_cast<double>(since));
        if (!line) return std::nullopt;
        if (best && line->gain <= best->gain) return line->gain;
        best.emplace();
        best->drift.part = place.part;
        best->drift.link = static_cast<int>(link);
        best->drift.rate = line->rate;
        best->drift.rate_covariance = line->covariance;
        best->drift.significance = squared_mahalanobis(line->rate, line->covariance);
        const auto elapsed = static_cast<double>(now - begin);
        best->drift.T = exp(elapsed * line->rate);
        best->drift.covariance = elapsed * elapsed * line->covariance;
        best->begin = begin;
        best->now = now;
        best->log_prior = line->log_prior;
        best->gain = line->gain;
        best->is_good = line->is_good;
        return line->gain;
      };
      std::int64_t likeliest = since;
      std::optional<double> most;
      for (std::int64_t begin = since + 1; begin >= earliest; begin -= kCoarse) {
        const auto gain = try_begin(begin);
        if (!gain || (most && *gain <= *most)) continue;
        most = gain;
        likeliest = begin;
      }
      for (std::int64_t begin = std::max(likeliest - kCoarse + 1, earliest);
           begin < likeliest + kCoarse; ++begin)
        if (begin != likeliest) try_begin(begin);
    }
    if (best) result.push_back(std::move(*best));
  }
  std::stable_sort(result.begin(), result.end(),
                   [](const BegunDrift& a, const BegunDrift& b) { return a.gain > b.gain; });
  return result;
}

}  // namespace bodyschema
