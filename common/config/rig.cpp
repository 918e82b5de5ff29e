#include "common/config/rig.h"

#include <algorithm>
#include <set>

#include "common/config/yaml.h"

namespace bodyschema {

std::vector<int> Markers::parts() const {
  std::set<int> parts;
  for (const TagPlacement& tag : tags) parts.insert(tag.part);
  return {parts.begin(), parts.end()};
}

const TagPlacement* Markers::find(int tag_id) const {
  const auto tag = std::lower_bound(tags.begin(), tags.end(), tag_id,
                                    [](const TagPlacement& a, int id) { return a.id < id; });
  return tag != tags.end() && tag->id == tag_id ? &*tag : nullptr;
}

Markers load_markers(const std::filesystem::path& rig_folder) {
  const Yaml yaml = Yaml::load(rig_folder / "markers.yaml");
  Markers markers;
  markers.family = yaml.choice("family", {"tag36h11"});
  std::map<int, int> tags_of_part;
  const std::vector<Yaml> tags = yaml.list("tags");
  for (const Yaml& tag : tags) {
    TagPlacement placement;
    placement.id = static_cast<int>(tag.integer("id", 0, 586));
    placement.size_m = tag.number("size_m", 0.001, 10);
    placement.part = static_cast<int>(tag.integer("part", 0, 9999));
    // 'none' is a text, a placement a mapping.
    bool is_none = false;
    try {
      is_none = tag.text("placement") == "none";
    } catch (const ConfigError&) {
    }
    if (!is_none) placement.X_BM = tag.pose("placement");
    ++tags_of_part[placement.part];
    markers.tags.push_back(placement);
  }
  yaml.finish();
  std::stable_sort(markers.tags.begin(), markers.tags.end(),
                   [](const auto& a, const auto& b) { return a.id < b.id; });
  for (std::size_t i = 1; i < markers.tags.size(); ++i) {
    if (markers.tags[i].id == markers.tags[i - 1].id) {
      throw yaml.error("tags", "tag id " + std::to_string(markers.tags[i].id) + " stands twice");
    }
  }
  for (const TagPlacement& tag : markers.tags) {
    if (!tag.X_BM && tags_of_part[tag.part] > 1) {
      throw yaml.error("tags", "part " + std::to_string(tag.part) +
                                   " has several tags, so each needs a placement");
    }
  }
  return markers;
}

Signals load_signals(const std::filesystem::path& rig_folder) {
  const Yaml yaml = Yaml::load(rig_folder / "signals.yaml");
  Signals result;
  std::set<std::string> names;
  for (const Yaml& item : yaml.list("signals")) {
    Signal signal;
    signal.name = item.text("name");
    if (signal.name.empty()) throw item.error("name", "expected a name");
    signal.lower = item.number("lower");
    signal.upper = item.number("upper");
    if (signal.upper <= signal.lower) throw item.error("upper", "must be above lower");
    if (!names.insert(signal.name).second) throw item.error("name", "this name stands twice");
    result.signals.push_back(signal);
  }
  if (yaml.has("root_part"))
    result.root_part = static_cast<int>(yaml.integer("root_part", 0, 9999));
  result.end_effector_part = static_cast<int>(yaml.integer("end_effector_part", 0, 9999));
  yaml.finish();
  return result;
}

namespace {

std::string url(int port, int ttl) {
  return "udpm://239.255.76.67:" + std::to_string(port) + "?ttl=" + std::to_string(ttl);
}

}  // namespace

std::string Network::bus_url() const { return url(port, ttl); }
std::string Network::images_url() const { return url(port + 1, ttl); }

Network load_network(const std::filesystem::path& rig_folder) {
  const Yaml yaml = Yaml::load(rig_folder / "network.yaml");
  Network network;
  network.is_private = yaml.choice("network", {"private", "host"}) == "private";
  network.port = static_cast<int>(yaml.integer("port", 1024, 65534));
  network.ttl = static_cast<int>(yaml.integer("ttl", 0, 255));
  yaml.finish();
  return network;
}

}  // namespace bodyschema
