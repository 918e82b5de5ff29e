#include "processes/refiner/drive_model.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "common/schema/warp_process.h"
#include "processes/refiner/part_chain.h"

namespace bodyschema {
namespace {

/// Of a process's weights those that its spectrum makes smaller than this share of the largest are
/// 0.
constexpr double kLeastShare = 1e-4;

/// Standard deviations under which a signal's weights are likeliest; of weights of 0, which tell
/// nothing, those of the widest process.
Eigen::VectorXd weight_sd(const Signal& signal) {
  const std::vector<double>& warp = signal.warp;
  if (std::ranges::all_of(warp, [](double weight) { return weight == 0; })) {
    const Eigen::ArrayXd variance = warp_spectrum(kWarpLengths.front(), std::ssize(warp));
    const double amplitude = kWarpAmplitudes.back() * 0.5 * (signal.upper - signal.lower);
    return amplitude * (variance > kLeastShare * variance.maxCoeff()).select(variance, 0).sqrt();
  }
  const Eigen::ArrayXd w2 =
      Eigen::Map<const Eigen::ArrayXd>(warp.data(), std::ssize(warp)).square();
  double best = -std::numeric_limits<double>::infinity();
  Eigen::VectorXd result;
  for (const double length : kWarpLengths) {
    Eigen::ArrayXd variance = warp_spectrum(length, w2.size());
    const Eigen::Array<bool, Eigen::Dynamic, 1> is_used =
        variance > kLeastShare * variance.maxCoeff();
    const double num = static_cast<double>(is_used.count());
    variance *= std::max((is_used.select(w2 / variance, 0)).sum() / num, 1e-12);
    const double log_likelihood =
        -0.5 * is_used.select(variance.log() + w2 / variance, 0).sum() / num;
    if (log_likelihood <= best) continue;
    best = log_likelihood;
    result = is_used.select(variance, 0).sqrt();
  }
  return result;
}

}  // namespace

bool is_bendable(const BodySchema& schema, int signal) {
  return std::ranges::all_of(schema.edges, [&](const Edge& edge) {
    if (PartChain::has_block(edge)) return true;
    const std::vector<int> signals = edge.signals();
    return std::ranges::find(signals, signal) == signals.end();
  });
}

DriveModel::DriveModel(const BodySchema& schema, JointLoads loads,
                       const std::vector<RefinerSample>& samples)
    : schema_(schema), loads_(std::move(loads)) {
  for (const Edge& edge : schema.edges) {
    if (!PartChain::has_block(edge)) continue;
    first_joints_[&edge] = static_cast<int>(signals_.size());
    for (const ScrewJoint& joint : edge.joints) signals_.push_back(joint.signal);
  }
  if (loads_) {
    num_scalars_ = static_cast<int>(signals_.size());
    find_changing_loads(samples);
  }
  for (int s = 0; s < std::ssize(schema.signals); ++s) {
    const std::vector<double>& warp = schema.signals[s].warp;
    if (warp.empty() || !is_bendable(schema, s)) continue;
    first_weights_[s] = num_scalars_;
    num_scalars_ += static_cast<int>(warp.size());
  }
}

void DriveModel::find_changing_loads(const std::vector<RefinerSample>& samples) {
  Eigen::VectorXd least = loads_(samples.front().sample.action), most = least;
  for (const RefinerSample& seen : samples) {
    const Eigen::VectorXd loads = loads_(seen.sample.action);
    least = least.cwiseMin(loads);
    most = most.cwiseMax(loads);
  }
  constexpr double kLeastShare = 1e-6;
  const double largest = std::max(most.maxCoeff(), -least.minCoeff());
  for (int n = 0; n < static_cast<int>(least.size()); ++n)
    if (most(n) - least(n) > kLeastShare * largest) changing_loads_.push_back(n);
}

ParameterBlock DriveModel::block() const {
  ParameterBlock block;
  block.kind = ParameterBlock::Kind::kDrive;
  if (loads_) {
    for (const int signal : signals_) {
      block.add(0.0);
      block.names.push_back("compliance of " + schema_.signals.at(signal).name);
    }
    block.free = changing_loads_;
  }
  const Eigen::VectorXd sd = prior_sd();
  for (const auto& [signal, first] : first_weights_) {
    const Signal& bent = schema_.signals[signal];
    for (std::size_t k = 0; k < bent.warp.size(); ++k) {
      if (sd(std::ssize(block.values)) > 0)
        block.free.push_back(static_cast<int>(block.values.size()));
      block.add(bent.warp[k]);
      block.names.push_back(fmt::format("bend of {}, term {}", bent.name, k + 1));
    }
  }
  return block;
}

Eigen::VectorXd DriveModel::displacements(const Eigen::VectorXd& action) const {
  Eigen::VectorXd theta = schema_.displacements(action);
  for (const auto& [signal, first] : first_weights_) theta(signal) = action(signal);
  return theta;
}

Eigen::MatrixXd DriveModel::effects(const Eigen::VectorXd& action) const {
  Eigen::MatrixXd effects = Eigen::MatrixXd::Zero(std::ssize(signals_), num_scalars_);
  if (loads_) effects.leftCols(std::ssize(signals_)).diagonal() = loads_(action);
  const Eigen::VectorXd x = normalized(schema_.signals, action);
  for (std::size_t n = 0; n < signals_.size(); ++n) {
    const auto first = first_weights_.find(signals_[n]);
    if (first == first_weights_.end()) continue;
    const int size = static_cast<int>(schema_.signals[signals_[n]].warp.size());
    effects.row(static_cast<Eigen::Index>(n)).segment(first->second, size) =
        warp_basis(std::clamp(x(signals_[n]), -1.0, 1.0), size);
  }
  return effects;
}

Eigen::VectorXd DriveModel::prior_sd() const {
  Eigen::VectorXd sd =
      Eigen::VectorXd::Constant(num_scalars_, std::numeric_limits<double>::infinity());
  for (const auto& [signal, first] : first_weights_) {
    const Eigen::VectorXd of_signal = weight_sd(schema_.signals[signal]);
    sd.segment(first, of_signal.size()) = of_signal;
  }
  return sd;
}

int DriveModel::signal_of(int weight) const {
  int result = -1;
  for (const auto& [signal, first] : first_weights_)
    if (first <= weight) result = signal;
  return result;
}

void DriveModel::copy_weights(const DriveModel& other, const double* from, double* to) const {
  for (const auto& [signal, first] : first_weights_)
    if (const auto same = other.first_weights_.find(signal); same != other.first_weights_.end())
      std::copy_n(from + same->second, schema_.signals[signal].warp.size(), to + first);
}

void DriveModel::set_warps(const ParameterBlock& block, BodySchema* schema) const {
  for (const auto& [signal, first] : first_weights_) {
    std::vector<double>& warp = schema->signals[signal].warp;
    std::copy_n(block.values.begin() + first, warp.size(), warp.begin());
  }
}

}  // namespace bodyschema
