#include "processes/structure_learner/structure_learner.h"

#include <algorithm>
#include <stdexcept>

#include "bodyschema/action_command_t.hpp"
#include "common/bus/convert.h"
#include "common/config/yaml.h"

namespace bodyschema {

StructureLearnerConfig StructureLearnerConfig::load(const std::filesystem::path& file) {
  const Yaml yaml = Yaml::load(file);
  const Signals signals = load_signals(file.parent_path());
  StructureLearnerConfig config;
  config.signals = signals.signals;
  config.options.root = signals.root_part;
  config.options.expected_parts = load_markers(file.parent_path()).parts();
  config.options.max_signals = static_cast<int>(yaml.integer("max_signals", 0, kMaxChainJoints));
  config.options.measurement = load_noise(file.parent_path()).measurement;
  config.options.is_monitored = true;
  yaml.finish();
  return config;
}

StructureLearner::StructureLearner(StructureLearnerConfig config)
    : config_(std::move(config)),
      online_(std::make_shared<OnlineLearner>(config_.signals, config_.options)) {}

void StructureLearner::on_sample(const sample_t& sample) {
  if (sample.sample_index <= last_sample_index_) return;
  if (sample.action.size() != config_.signals.size()) {
    throw std::invalid_argument("SAMPLE has " + std::to_string(sample.action.size()) +
                                " action signals, signals.yaml names " +
                                std::to_string(config_.signals.size()));
  }
  last_sample_index_ = sample.sample_index;
  if (sample.purpose == action_command_t::PURPOSE_TRAIN ||
      sample.purpose == action_command_t::PURPOSE_PROBE) {
    samples_.add(std::make_shared<const ActionPoseSample>(from_message(sample)));
    has_new_ = true;
  }
  if (!pending_.empty() && !pending_.back().is_test) pending_.pop_back();
  pending_.push_back(
      {sample.sample_index, sample.utime, sample.purpose == action_command_t::PURPOSE_TEST});
  while (pending_.front().last_sample_index < last_sample_index_ - RetainedSamples::kMaxLag)
    pending_.pop_front();
}

void StructureLearner::on_body_schema(const body_schema_t& schema) {
  known_ = from_message(schema);
}

SharedSamples StructureLearner::of_this_body(std::int64_t sample_index) {
  const std::int64_t since = known_.body_since(sample_index);
  const std::int64_t stride = retained_stride(since, sample_index);
  std::vector<MovedTag> moved = known_.moved_tags_known(sample_index);
  if (since != online_since_ || stride != online_stride_ || moved != online_moved_) {
    online_ = std::make_shared<OnlineLearner>(config_.signals, config_.options);
    online_since_ = since;
    online_stride_ = stride;
    online_moved_ = std::move(moved);
  }
  SharedSamples samples = samples_.between(since, sample_index);
  for (auto& sample : samples) {
    if (online_moved_.empty()) break;
    auto clean = std::make_shared<ActionPoseSample>(*sample);
    drop_moved_tags(online_moved_, clean.get());
    sample = std::move(clean);
  }
  return samples;
}

void StructureLearner::skip_judged(std::int64_t judged_sample) {
  while (pending_.size() > 1 && pending_.front().last_sample_index <= judged_sample)
    pending_.pop_front();
}

std::function<body_schema_t()> StructureLearner::take_job() {
  const Prefix prefix = pending_.front();
  pending_.pop_front();
  SharedSamples samples = of_this_body(prefix.last_sample_index);
  return [online = online_, since = online_since_, moved = online_moved_,
          samples = std::move(samples), prefix] {
    const int n = static_cast<int>(samples.size());
    BodySchema schema = online->learn(samples, prefix.is_test ? n : std::max(n - 1, 0));
    for (Edge& edge : schema.edges) edge.valid_since_sample = since;
    schema.moved_tags = moved;
    schema.last_sample_index = prefix.last_sample_index;
    schema.utime = prefix.utime;
    return to_message(schema);
  };
}

std::function<void()> StructureLearner::take_preparation() {
  has_new_ = false;
  SharedSamples samples = of_this_body(last_sample_index_);
  return [online = online_, samples = std::move(samples)] { online->prepare(samples); };
}

}  // namespace bodyschema
