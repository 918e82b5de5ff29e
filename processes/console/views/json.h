#pragma once

#include <nlohmann/json.hpp>
#include <optional>

namespace bodyschema {

using Json = nlohmann::ordered_json;

/// null for −1, "not known" on the wire, and all below 0.
template <class Number>
Json known(Number value) {
  return value < 0 ? Json() : Json(value);
}

template <class Value>
Json or_null(const std::optional<Value>& value) {
  return value ? Json(*value) : Json();
}

/// An array of what `to_json` makes of each item.
template <class Items, class ToJson>
Json array_of(const Items& items, ToJson to_json) {
  Json array = Json::array();
  for (const auto& item : items) array.push_back(to_json(item));
  return array;
}

}  // namespace bodyschema
