#include "processes/model_monitor/health/misreadings.h"

#include <algorithm>

#include "processes/model_monitor/likelihood/reading_distance.h"

namespace bodyschema {
namespace {

void push(const Pose& place, std::size_t most, std::vector<Pose>* places) {
  if (places->size() == most) places->erase(places->begin());
  places->push_back(place);
}

}  // namespace

bool Misreadings::look(const ActionPoseSample& sample, const BodySchema& schema,
                       const MeasurementModel& measurement) {
  bool is_news = false;
  for (const auto& [part, X_RB] : schema.predict_all(sample.action)) {
    const PartObservation* seen = sample.find(part);
    if (!seen) continue;
    const Pose X_CB = schema.X_CR * X_RB;
    const MeasurementModel::Reading reading = measurement.reading(*seen, X_CB);
    const ReadingDistance distance(reading.covariance);
    std::vector<Pose>& open = open_[part];
    const double d2 = distance(X_CB, reading.X_CB);
    if (d2 > ReadingDistance::kOther) push(X_CB.inverse() * reading.X_CB, kOnce, &open);
    if (d2 > ReadingDistance::kSame) continue;
    // It is back. What is misread several times in a row counts once.
    std::vector<Pose> excursion;
    const auto is_in = [&](const std::vector<Pose>& places, const Pose& place) {
      return std::ranges::any_of(places, [&](const Pose& other) {
        return distance(place, other) < ReadingDistance::kSame;
      });
    };
    for (const Pose& place : open)
      if (!is_in(excursion, place)) excursion.push_back(place);
    open.clear();
    for (const Pose& place : excursion) {
      if (is_in(places_[part], place)) continue;
      if (is_in(once_[part], place)) {
        push(place, kOften, &places_[part]);
        is_news = true;
      } else {
        push(place, kOnce, &once_[part]);
      }
    }
  }
  return is_news;
}

}  // namespace bodyschema
