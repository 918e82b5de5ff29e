#include "processes/model_monitor/baseline/chapter_adaptation.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "processes/model_monitor/changes/learned.h"

namespace bodyschema {
namespace {

/// A model needs that many to be learned, and as many to be tested.
constexpr std::size_t kFewestSamples = 2;
/// Of one pair of parts.
constexpr std::size_t kMaxModels = 64;

std::vector<std::vector<int>> signal_sets(int num_signals, int size) {
  std::vector<std::vector<int>> sets{{}};
  for (int k = 0; k < size; ++k) {
    std::vector<std::vector<int>> longer;
    for (const auto& set : sets) {
      for (int s = set.empty() ? 0 : set.back() + 1; s < num_signals; ++s) {
        longer.push_back(set);
        longer.back().push_back(s);
      }
    }
    sets = std::move(longer);
  }
  return sets;
}

}  // namespace

ChapterAdaptation::ChapterAdaptation(BodySchema schema, ChapterAdaptationOptions options,
                                     LearnEdge learn_edge)
    : options_(options), learn_edge_(std::move(learn_edge)), schema_(std::move(schema)) {
  for (const Edge& edge : schema_.edges) {
    Pair pair;
    Model given;
    given.edge = edge;
    given.signals = edge.signals();
    pair.models.push_back(std::move(given));
    for (int k = 0; k <= options_.max_signals; ++k) {
      auto sets = signal_sets(static_cast<int>(schema_.signals.size()), k);
      std::ranges::stable_sort(sets, [&](const auto& a, const auto& b) {
        return structural_proximity(a, edge.signals()) > structural_proximity(b, edge.signals());
      });
      pair.candidates.insert(pair.candidates.end(), sets.begin(), sets.end());
    }
    pairs_.push_back(std::move(pair));
  }
}

bool ChapterAdaptation::has_valid_tree() const {
  return std::ranges::all_of(pairs_, [](const Pair& pair) { return pair.is_valid; });
}

std::size_t ChapterAdaptation::num_models() const {
  std::size_t sum = 0;
  for (const Pair& pair : pairs_) sum += pair.models.size();
  return sum;
}

void ChapterAdaptation::learn(Model* model, const ActionPoseSample& sample) const {
  if (!model->is_learning || model->num_offered >= options_.training) return;
  ++model->num_offered;
  const Edge edge = model->edge;
  if (!sample.find(edge.from) || !sample.find(edge.to)) return;
  model->training.push_back(sample);
  if (model->training.size() < kFewestSamples) return;
  std::vector<const ActionPoseSample*> samples;
  for (const ActionPoseSample& s : model->training) samples.push_back(&s);
  model->edge = learn_edge_(edge.from, edge.to, model->signals, samples);
  model->residuals.clear();
}

void ChapterAdaptation::test(Model* model, const std::deque<ActionPoseSample>& window) const {
  // A model that has not learned anything yet is neither valid nor refuted.
  model->is_tested =
      !window.empty() && (!model->is_learning || model->training.size() >= kFewestSamples);
  if (!model->is_tested) return;
  for (std::size_t n = model->residuals.size(); n < window.size(); ++n) {
    const ActionPoseSample& sample = window[n];
    const Edge& edge = model->edge;
    const Pose z = sample.find(edge.from)->X_CB.inverse() * sample.find(edge.to)->X_CB;
    const Pose difference = edge.predict(schema_.displacements(sample.action)).inverse() * z;
    model->residuals.push_back({difference.translation().norm(), rotation_angle(difference)});
  }
  double position = 0, rotation = 0;
  for (const Model::Residual& r : model->residuals) {
    position += r.position_m * r.position_m;
    rotation += r.rotation_rad * r.rotation_rad;
  }
  const auto count = static_cast<double>(window.size());
  model->error = std::max(std::sqrt(position / count) / (3 * options_.sigma_position_m),
                          std::sqrt(rotation / count) / (3 * options_.sigma_rotation_rad));
}

void ChapterAdaptation::add_model(Pair* pair) {
  if (pair->models.size() >= kMaxModels) {
    const auto oldest = std::find_if(pair->models.begin() + 1, pair->models.end(),
                                     [](const Model& model) { return !model.has_served; });
    if (oldest == pair->models.end()) return;
    const auto index = static_cast<std::size_t>(oldest - pair->models.begin());
    if (pair->serving > index) --pair->serving;
    pair->models.erase(oldest);
  }
  if (pair->next_candidate == pair->candidates.size()) pair->next_candidate = 0;
  Model model;
  model.edge.from = pair->models.back().edge.from;
  model.edge.to = pair->models.back().edge.to;
  model.signals = pair->candidates[pair->next_candidate++];
  model.is_learning = true;
  pair->models.push_back(std::move(model));
  ++num_sampled_;
}

std::vector<AdaptationEvent> ChapterAdaptation::on_sample(const ActionPoseSample& sample) {
  schema_.displacements(sample.action);  // throws on a wrong number of signals
  std::vector<AdaptationEvent> events;
  const auto tell = [&](AdaptationEvent::Kind kind, const Edge& edge, std::size_t num_samples) {
    AdaptationEvent event;
    event.kind = kind;
    event.sample_index = sample.sample_index;
    event.from = edge.from;
    event.to = edge.to;
    event.num_samples = static_cast<int>(num_samples);
    events.push_back(std::move(event));
  };
  for (std::size_t e = 0; e < pairs_.size(); ++e) {
    Pair& pair = pairs_[e];
    Edge& serving = schema_.edges[e];
    if (sample.find(serving.from) && sample.find(serving.to)) {
      pair.window.push_back(sample);
      if (pair.window.size() > static_cast<std::size_t>(options_.window)) {
        pair.window.pop_front();
        for (Model& model : pair.models)
          if (!model.residuals.empty()) model.residuals.pop_front();
      }
    }
    const bool was_valid = pair.is_valid;
    const std::size_t served = pair.serving;
    pair.is_valid = false;
    double least = 1;
    for (std::size_t n = 0; n < pair.models.size(); ++n) {
      Model& model = pair.models[n];
      learn(&model, sample);
      test(&model, pair.window);
      // Nothing speaks against the first model before anything was seen.
      const double error = model.is_tested ? model.error : n == 0 ? 0 : INFINITY;
      if (error >= least) continue;
      least = error;
      pair.is_valid = true;
      pair.serving = n;
    }
    Model& model = pair.models[pair.serving];
    if (was_valid && !pair.is_valid)
      tell(AdaptationEvent::Kind::kMismatch, serving, pair.window.size());
    if (pair.is_valid && pair.serving != served)
      tell(model.has_served || !model.is_learning ? AdaptationEvent::Kind::kRestored
                                                  : AdaptationEvent::Kind::kCandidate,
           model.edge, model.training.size());
    model.has_served |= pair.is_valid;
    serving = model.edge;
    serving.confidence = pair.is_valid ? 1 : 0;
    serving.state = pair.is_valid ? EdgeState::kOk : EdgeState::kInvalid;
  }
  num_without_tree_ = has_valid_tree() ? 0 : num_without_tree_ + 1;
  if (num_without_tree_ < options_.wait) return events;
  for (Pair& pair : pairs_) {
    // The newest one gets its chance first.
    const Model& newest = pair.models.back();
    const bool has_learned = !newest.is_learning || newest.num_offered >= options_.training;
    if (!pair.is_valid && (newest.is_tested || has_learned)) add_model(&pair);
  }
  return events;
}

}  // namespace bodyschema
