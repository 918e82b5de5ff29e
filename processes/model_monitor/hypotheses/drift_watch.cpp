#include "processes/model_monitor/hypotheses/drift_watch.h"

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <functional>
#include <utility>

#include "common/estimation/chi_square.h"
#include "common/estimation/student_t.h"
#include "processes/model_monitor/changes/change_family.h"
#include "processes/model_monitor/changes/drift.h"
#include "processes/model_monitor/hypotheses/change_fit.h"
#include "processes/model_monitor/hypotheses/schema_difference.h"
#include "processes/model_monitor/sample_stream.h"

namespace bodyschema {
namespace {

constexpr std::size_t kWindow = 44;
/// Of a straight line through the newest measurements.
constexpr std::size_t kFollowed = 40;
constexpr std::size_t kFewestFollowed = 4;

/// A drift of 0.1° a sample is suspected about 20 samples after its begin.
constexpr std::int64_t kLongestUnseen = 28;
constexpr std::int64_t kCoarse = 4;
/// Measurements since its begin by which a drift is told.
constexpr int kFewestMoved = 4;
/// Squared distance, and the share of the measurements that must be below it: outliers are rarer.
const double kExplained = chi_square_quantile(6, 0.001);
constexpr double kMostlyExplained = 0.75;

/// Probability that a drift ends at a given sample; and how many samples ago at most it is looked
/// for. Chosen: drifts last for hundreds of samples.
constexpr double kEnds = 0.005;
constexpr int kLatestEnd = 20;

struct TimedReading {
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
Line fit_line(const std::vector<TimedReading>& readings, double ended = 0, int rounds = 6) {
  Line line;
  line.ab.setZero();
  for (int round = 0; round < rounds; ++round) {
    Eigen::Matrix<double, 12, 12> H = 1e-9 * Eigen::Matrix<double, 12, 12>::Identity();
    H.bottomRightCorner<6, 6>() += rate_information();
    Eigen::Matrix<double, 12, 1> g = Eigen::Matrix<double, 12, 1>::Zero();
    line.cost = 0;
    for (const TimedReading& r : readings) {
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

/// Fills in ξ: about the reading nearest to all others, in the end about the line's own value of
/// now. Returns that pose, and the line.
std::pair<Pose, Line> line_through(const std::vector<Pose>& T,
                                   std::vector<TimedReading>* readings) {
  Pose reference = T[T.size() / 2];
  const auto refer = [&] {
    for (std::size_t n = 0; n < T.size(); ++n) (*readings)[n].xi = log(reference.inverse() * T[n]);
  };
  Line line;
  for (int round = 0; round < 3; ++round) {
    refer();
    line = fit_line(*readings);
    reference = reference * exp(line.ab.head<6>());
  }
  refer();
  line.ab.head<6>().setZero();
  return {reference, line};
}

/// A drift that lasts, or has ended.
struct Course {
  Line line;
  int ended;  // samples ago
  double log_weight;
};

std::vector<Course> courses_of(const Line& line, const std::vector<TimedReading>& readings) {
  std::vector<Course> courses{{line, 0, -line.cost}};
  for (int ended = 1; ended <= kLatestEnd; ++ended) {
    const auto num_before = std::ranges::count_if(
        readings, [ended](const TimedReading& r) { return r.time <= -ended; });
    if (num_before < static_cast<std::ptrdiff_t>(kFewestFollowed)) break;
    const Line stopped = fit_line(readings, -ended, 3);
    courses.push_back({stopped, ended, std::log(kEnds) - stopped.cost});
  }
  return courses;
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

/// ξ(t) = rate · (t − begin) from `begin` on, and 0 before. std::nullopt if too little of it was
/// seen. From time `since` on it is to explain the readings. Neither place nor T is set.
std::optional<BegunDrift> fit_begun(const std::vector<TimedReading>& readings, double begin,
                                    double since) {
  int num_moved = 0;
  for (const TimedReading& r : readings) num_moved += r.time > begin;
  if (num_moved < kFewestMoved) return std::nullopt;
  const Matrix6d prior = rate_information();
  BegunDrift line;
  Vector6d& rate = line.drift.rate;
  Matrix6d H;
  for (int round = 0; round < 6; ++round) {
    H = prior;
    Vector6d g = -prior * rate;
    for (const TimedReading& r : readings) {
      const double elapsed = r.time - begin;
      if (elapsed <= 0) continue;
      // T is far from 1 where it drifted for long: exact residuals, and Jacobians of small ones.
      const Vector6d e = round == 0 ? r.xi : log(exp(-elapsed * rate) * exp(r.xi));
      const Matrix6d I = (round == 0 ? 1 : robust_weight(e.dot(r.information * e))) * r.information;
      H += elapsed * elapsed * I;
      g += elapsed * I * e;
    }
    rate += H.ldlt().solve(g);
  }
  line.drift.rate_covariance = H.inverse();
  const Eigen::LLT<Matrix6d> llt(H), of_prior(prior);
  if (llt.info() != Eigen::Success || !rate.allFinite()) return std::nullopt;
  line.log_prior = kSmallLogOdds - 0.5 * rate.dot(prior * rate) +
                   of_prior.matrixLLT().diagonal().array().log().sum() -
                   llt.matrixLLT().diagonal().array().log().sum() -
                   std::log(static_cast<double>(kLongestUnseen));
  line.gain = line.log_prior;
  int num = 0, num_explained = 0;
  bool is_newest_explained = false;
  for (const TimedReading& r : readings) {
    const double elapsed = r.time - begin;
    if (elapsed <= 0) continue;
    const Vector6d e = log(exp(-elapsed * rate) * exp(r.xi));
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

std::optional<DriftWatch::Measured> DriftWatch::measure(const TreeFilter& filter,
                                                        const TreeFilter::Instant& instant,
                                                        const TreeFilter::Instant& exact, int node,
                                                        Measure how) {
  const auto of = (filter.*how)(instant, node);
  const auto with_exact_models = (filter.*how)(exact, node);
  if (!of || !with_exact_models) return std::nullopt;
  // Exact models believe fewer markers: what they know less does not make the others surer.
  return Measured{0, {}, *of, positive_part(of->covariance - with_exact_models->covariance)};
}

void DriftWatch::add(const TreeFilter& filter, const TreeFilter::Instant& instant,
                     const BodySchema& schema, const Eigen::VectorXd& displacements,
                     std::int64_t sample_index, bool counts_near) {
  if (!is_same(schema, schema_)) {
    before_.clear();
    schema_ = schema;
  }
  if (!counts_near && last_.size() == displacements.size() &&
      is_small_step(last_, displacements, schema.signals))
    return;
  last_ = displacements;
  actions_.add(displacements, schema.signals, sample_index);
  const TreeFilter::Instant exact = with_exact_models(instant);
  const auto add = [&](const ElementId& element, int node, Measure how) {
    auto measured = measure(filter, instant, exact, node, how);
    if (!measured) return;
    measured->sample_index = sample_index;
    measured->displacements = displacements;
    auto& queue = measured_[element];
    queue.push_back(std::move(*measured));
    if (element.is_tag()) correlate(element);
    if (queue.size() <= kWindow) return;
    const std::vector<Reading> oldest = readings(schema, element, queue.front());
    auto& means = before_[element];
    means.resize(oldest.size());
    for (std::size_t link = 0; link < means.size(); ++link) means[link].add(oldest[link]);
    queue.pop_front();
  };
  for (int node = 0; node < filter.num_nodes(); ++node) {
    add(edge_element(filter.part(node), schema.root), node, &TreeFilter::measure_edge);
    add(tag_element(filter.part(node)), node, &TreeFilter::measure_marker);
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
    auto measured =
        measure(filter, instant, with_exact_models(instant), node, &TreeFilter::measure_edge);
    if (!measured) continue;
    measured->sample_index = sample->sample_index;
    measured->displacements = schema.displacements(sample->action);
    auto& queue = measured_[edge_element(part, schema.root)];
    queue.push_back(std::move(*measured));
    if (queue.size() > kWindow) queue.pop_front();
  }
}

void DriftWatch::forget(int part, std::int64_t before) {
  const auto is_its = [part](const auto& of) { return !of.first.is_tag() && of.first.id == part; };
  for (auto& of : measured_)
    if (is_its(of))
      while (!of.second.empty() && of.second.front().sample_index < before) of.second.pop_front();
  std::erase_if(before_, is_its);
}

void DriftWatch::forget_all() {
  last_.resize(0);
  actions_.clear();
  measured_.clear();
  before_.clear();
}

const std::deque<DriftWatch::Measured>* DriftWatch::find(const ElementId& element,
                                                         std::size_t fewest) const {
  const auto it = measured_.find(element);
  return it == measured_.end() || it->second.size() < fewest ? nullptr : &it->second;
}

std::optional<Drift> DriftWatch::follow(const BodySchema& schema, int part) const {
  const auto* queue = find(edge_element(part, schema.root), kFewestFollowed);
  if (!queue) return std::nullopt;
  const Edge* edge = edge_to(schema, part);
  std::optional<Drift> best;
  double most = 0;
  const std::int64_t now = queue->back().sample_index;
  for (std::size_t link = num_links(edge); link-- > 0;) {
    std::vector<Pose> T;
    std::vector<TimedReading> readings;
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
    const auto [reference, line] = line_through(T, &readings);
    const std::vector<Course> courses = courses_of(line, readings);
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

namespace {

/// The links of the edge to a part, and what is read of each.
struct Places {
  int part, node;
  const Edge* edge;
  std::vector<std::vector<TimedReading>> links;
};

std::vector<Places> readings_by_link(const BodySchema& before, const MeasurementModel& measurement,
                                     const std::vector<int>& parts,
                                     const std::vector<const ActionPoseSample*>& samples) {
  const TreeFilter filter(before, measurement);
  std::vector<Places> places;
  for (const int part : parts)
    if (const int node = filter.node_of(part); node >= 0)
      places.push_back({part, node, edge_to(before, part), {}});
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
  return places;
}

}  // namespace

std::vector<BegunDrift> begun_drifts(const BodySchema& before, const MeasurementModel& measurement,
                                     const std::vector<int>& parts,
                                     const std::vector<const ActionPoseSample*>& samples,
                                     std::int64_t since) {
  std::vector<BegunDrift> result;
  if (samples.empty()) return result;
  const std::int64_t now = samples.back()->sample_index;
  const std::int64_t earliest = std::max(since - kLongestUnseen, samples.front()->sample_index - 1);
  for (const Places& place : readings_by_link(before, measurement, parts, samples)) {
    std::optional<BegunDrift> best;
    for (std::size_t link = place.links.size(); link-- > 0;) {
      const std::vector<TimedReading>& readings = place.links[link];
      const auto try_begin = [&](std::int64_t begin) -> std::optional<double> {
        auto line = fit_begun(readings, static_cast<double>(begin), static_cast<double>(since));
        if (!line) return std::nullopt;
        const double gain = line->gain;
        if (best && gain <= best->gain) return gain;
        const auto elapsed = static_cast<double>(now - begin);
        line->begin = begin;
        line->drift.part = place.part;
        line->drift.link = static_cast<int>(link);
        line->drift.T = exp(elapsed * line->drift.rate);
        line->drift.covariance = elapsed * elapsed * line->drift.rate_covariance;
        best = std::move(line);
        return gain;
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
  std::ranges::stable_sort(result, std::greater(), &BegunDrift::gain);
  return result;
}

}  // namespace bodyschema
