#include "common/config/rig.h"

#include <algorithm>
#include <set>
#include <stdexcept>

#include "common/config/yaml.h"
#include "common/geometry/angle.h"
#include "common/text/text.h"

namespace bodyschema {

namespace {

/// Chosen: encoder ticks of many turns fit, squares and sums of it are far from overflow.
constexpr double kLargestCommand = 1e9;

}  // namespace

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

bool Markers::is_target(int tag_id) const {
  return std::any_of(target_tags.begin(), target_tags.end(),
                     [&](const TargetTag& tag) { return tag.id == tag_id; });
}

std::optional<double> Markers::size_m(int tag_id) const {
  if (const TagPlacement* tag = find(tag_id)) return tag->size_m;
  for (const TargetTag& tag : target_tags)
    if (tag.id == tag_id) return tag.size_m;
  return std::nullopt;
}

std::vector<int> Markers::ids() const {
  std::vector<int> ids;
  for (const TagPlacement& tag : tags) ids.push_back(tag.id);
  for (const TargetTag& tag : target_tags) ids.push_back(tag.id);
  return ids;
}

namespace {

int tag_id(const Yaml& tag) { return static_cast<int>(tag.integer("id", 0, 586)); }
double tag_size_m(const Yaml& tag) { return tag.number("size_m", 0.001, 10); }

/// Ascending id, each once.
template <class Tag>
void sort_tags(const Yaml& yaml, const char* key, std::vector<Tag>& tags) {
  std::stable_sort(tags.begin(), tags.end(),
                   [](const auto& a, const auto& b) { return a.id < b.id; });
  for (std::size_t i = 1; i < tags.size(); ++i) {
    if (tags[i].id == tags[i - 1].id)
      throw yaml.error(key, "tag id " + std::to_string(tags[i].id) + " stands twice");
  }
}

}  // namespace

std::vector<TagPlacement> load_tags(const Yaml& yaml) {
  std::vector<TagPlacement> tags;
  std::map<int, int> tags_of_part;
  for (const Yaml& tag : yaml.list("tags")) {
    TagPlacement placement;
    placement.id = tag_id(tag);
    placement.size_m = tag_size_m(tag);
    placement.part = static_cast<int>(tag.integer("part", 0, 9999));
    // 'none' is a text, a placement a mapping.
    bool is_none = false;
    try {
      is_none = tag.text("placement") == "none";
    } catch (const ConfigError&) {
    }
    if (!is_none) placement.X_BM = tag.pose("placement");
    ++tags_of_part[placement.part];
    tags.push_back(placement);
  }
  sort_tags(yaml, "tags", tags);
  for (const TagPlacement& tag : tags) {
    if (!tag.X_BM && tags_of_part[tag.part] > 1) {
      throw yaml.error("tags", "part " + std::to_string(tag.part) +
                                   " has several tags, so each needs a placement");
    }
  }
  return tags;
}

std::vector<TargetTag> load_target_tags(const Yaml& yaml, const std::vector<TagPlacement>& tags,
                                        std::map<int, Pose>* X_CM) {
  std::vector<TargetTag> targets;
  if (!yaml.has("target_tags")) return targets;
  for (const Yaml& item : yaml.list("target_tags")) {
    const TargetTag& target = targets.emplace_back(TargetTag{tag_id(item), tag_size_m(item)});
    if (X_CM) (*X_CM)[target.id] = item.pose("X_CM");
    for (const TagPlacement& tag : tags) {
      if (tag.id == target.id)
        throw item.error("id", "tag " + std::to_string(tag.id) + " is on part " +
                                   std::to_string(tag.part) + ", so it is no target");
    }
  }
  sort_tags(yaml, "target_tags", targets);
  return targets;
}

Markers load_markers(const std::filesystem::path& rig_folder) {
  const Yaml yaml = Yaml::load(rig_folder / "markers.yaml");
  Markers markers;
  markers.family = yaml.choice("family", {"tag36h11"});
  markers.tags = load_tags(yaml);
  markers.target_tags = load_target_tags(yaml, markers.tags);
  yaml.finish();
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
    signal.lower = item.number("lower", -kLargestCommand, kLargestCommand);
    signal.upper = item.number("upper", -kLargestCommand, kLargestCommand);
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

/// One lost frame loses a whole image, so images stay on the host that makes them.
const std::set<std::string> kImageProcesses = {"camera", "marker_estimator", "log_images"};

std::map<std::string, std::vector<std::string>> load_hosts(const Yaml& yaml,
                                                           const std::vector<std::string>& group) {
  const Yaml section = yaml.section("hosts");
  std::map<std::string, std::vector<std::string>> hosts;
  std::map<std::string, std::string> host_of;
  for (const std::string& host : section.keys()) {
    if (host == "all") throw section.error(host, "no host may be called that");
    hosts[host] = section.texts(host);
    for (const std::string& process : hosts[host]) {
      const auto [other, is_first] = host_of.try_emplace(process, host);
      if (!is_first) {
        throw section.error(host, "'" + process + "' runs on '" + other->second + "' already");
      }
      if (!group.empty() && std::find(group.begin(), group.end(), process) == group.end()) {
        throw section.error(
            host, "'" + process + "' is no process of this rig; there are: " + listed(group));
      }
    }
  }
  for (const std::string& process : group) {
    if (!host_of.contains(process)) {
      throw yaml.error("hosts", "'" + process + "' runs on no host");
    }
  }
  for (const auto& [process, host] : host_of) {
    if (kImageProcesses.contains(process) && host_of.contains("camera") &&
        host != host_of["camera"]) {
      throw section.error(host, "'" + process + "' must run where the camera does, on '" +
                                    host_of["camera"] + "': images do not survive a network");
    }
  }
  return hosts;
}

}  // namespace

std::string Network::bus_url() const { return url(port, ttl); }
std::string Network::images_url() const { return url(port + 1, hosts.empty() ? ttl : 0); }

std::vector<std::string> Network::share_of(const std::string& host) const {
  const auto share = hosts.find(host);
  if (share != hosts.end()) return share->second;
  const std::string all = listed(hosts, [](const auto& known) { return known.first; });
  throw std::invalid_argument("--host: network.yaml has no host '" + host + "'; " +
                              (all.empty() ? "all runs on one machine" : "there are: " + all));
}

RigNoise load_noise(const std::filesystem::path& rig_folder, const std::string& file) {
  const Yaml yaml = Yaml::load(rig_folder / file);
  RigNoise noise;
  noise.corner_noise_px = yaml.number("corner_noise_px", 1e-3, 10);
  noise.small_tag_noise_px = yaml.number("small_tag_noise_px", 0, 10);
  noise.measurement.systematic.position_m = yaml.number("systematic_position_m", 0, 1);
  noise.measurement.systematic.rotation_rad =
      yaml.number("systematic_rotation_deg", 0, 90) * kDegree;
  noise.measurement.outlier_rate = yaml.number("outlier_rate", 0, 0.5);
  noise.measurement.tags.position_m = yaml.number("tag_position_m", 0, 1);
  noise.measurement.tags.rotation_rad = yaml.number("tag_rotation_deg", 0, 90) * kDegree;
  noise.measurement.tags.size_share = yaml.number("tag_size_share", 0, 0.5);
  yaml.finish();
  return noise;
}

Network load_network(const std::filesystem::path& rig_folder,
                     const std::vector<std::string>& group) {
  const Yaml yaml = Yaml::load(rig_folder / "network.yaml");
  Network network;
  network.is_private = yaml.choice("network", {"private", "host"}) == "private";
  network.port = static_cast<int>(yaml.integer("port", 1024, 65534));
  network.ttl = static_cast<int>(yaml.integer("ttl", 0, 255));
  if (yaml.has("hosts")) {
    network.hosts = load_hosts(yaml, group);
    if (network.is_private) {
      throw yaml.error("network", "several hosts share a network: expected 'host'");
    }
    if (network.ttl < 1) throw yaml.error("ttl", "must be 1 or more to reach another host");
  }
  yaml.finish();
  return network;
}

}  // namespace bodyschema
