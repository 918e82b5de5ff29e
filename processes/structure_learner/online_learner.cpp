#include "processes/structure_learner/online_learner.h"

#include <algorithm>

namespace bodyschema {
namespace {

constexpr std::size_t kMaxKept = 3;

std::vector<ActionPoseSample> copied(const SharedSamples& samples, int first, int end) {
  std::vector<ActionPoseSample> result;
  result.reserve(static_cast<std::size_t>(end - first));
  for (int n = first; n < end; ++n) result.push_back(*samples[n]);
  return result;
}

bool are_few_enough_to_refit(const SharedSamples& samples) {
  std::size_t readings = 0;
  for (const auto& sample : samples) readings += sample->parts.size();
  return readings <= OnlineLearner::kMaxRefitReadings;
}

}  // namespace

OnlineLearner::OnlineLearner(std::vector<Signal> signals, LearnOptions options)
    : signals_(std::move(signals)), options_(std::move(options)) {}

int OnlineLearner::checkpoint_within(int n) {
  int c = std::min(n, kEverySample);
  while (c >= kEverySample && c + c / 20 <= n) c += c / 20;
  return c;
}

BodySchema OnlineLearner::learn(const SharedSamples& samples, int num_searched) {
  const std::lock_guard lock(mutex_);
  const int n = static_cast<int>(samples.size());
  const int c = checkpoint_within(num_searched);
  if (c == 0 || c == n) return schema_of(&checkpoint(samples, n), samples, n);
  Checkpoint& start = checkpoint(samples, c);
  const std::vector<int>& known = start.structure.parts;
  const bool is_part_new = std::any_of(samples.begin() + c, samples.end(), [&](const auto& s) {
    return std::any_of(s->parts.begin(), s->parts.end(), [&](const PartObservation& o) {
      return !std::binary_search(known.begin(), known.end(), o.part);
    });
  });
  if (!is_part_new && !are_few_enough_to_refit(samples)) return schema_of(&start, samples, c);
  const auto all = copied(samples, 0, n);
  const LearnOptions options = options_for(all);
  BodySchema schema = relearn(start.structure, all, options).schema;
  schema.complete &= options.root == options_.root;
  return schema;
}

void OnlineLearner::prepare(const SharedSamples& samples) {
  const std::lock_guard lock(mutex_);
  const int c = checkpoint_within(static_cast<int>(samples.size()));
  if (c == 0) return;
  Checkpoint& start = checkpoint(samples, c);
  if (!are_few_enough_to_refit(samples)) schema_of(&start, samples, c);
}

LearnOptions OnlineLearner::options_for(const std::vector<ActionPoseSample>& samples) const {
  LearnOptions options = options_;
  if (options.root && std::none_of(samples.begin(), samples.end(), [&](const auto& sample) {
        return sample.find(*options.root);
      })) {
    // Nothing can hang on a root that nobody saw.
    options.expected_parts.push_back(*options.root);
    options.root.reset();
  }
  return options;
}

OnlineLearner::Checkpoint& OnlineLearner::checkpoint(const SharedSamples& samples, int n) {
  const auto known = checkpoints_.find(n);
  if (known != checkpoints_.end()) return known->second;
  // Of the others those nearest to n may be needed again.
  while (checkpoints_.size() >= kMaxKept) {
    const bool is_first_farther =
        n - checkpoints_.begin()->first >= checkpoints_.rbegin()->first - n;
    checkpoints_.erase(is_first_farther ? checkpoints_.begin() : std::prev(checkpoints_.end()));
  }
  return checkpoints_
      .emplace(n, Checkpoint{find_structure(signals_, copied(samples, 0, n), options_), {}})
      .first->second;
}

const BodySchema& OnlineLearner::schema_of(Checkpoint* checkpoint, const SharedSamples& samples,
                                           int n) const {
  if (!checkpoint->schema) {
    const auto all = copied(samples, 0, n);
    const LearnOptions options = options_for(all);
    checkpoint->schema = fit_structure(checkpoint->structure, all, options).schema;
    checkpoint->schema->complete &= options.root == options_.root;
  }
  return *checkpoint->schema;
}

}  // namespace bodyschema
