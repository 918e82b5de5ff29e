#include "common/config/rig.h"

#include <gtest/gtest.h>

#include <filesystem>
#include <fstream>
#include <functional>

#include "common/config/yaml.h"
#include "tests/support/temporary_folder.h"

namespace bodyschema {
namespace {

/// A folder of its own for every test.
class RigTest : public testing::Test {
 protected:
  void write(const std::string& name, const std::string& text) const {
    std::ofstream(folder_ / name) << text;
  }
  std::string error_of(const std::function<void()>& action) const {
    try {
      action();
    } catch (const ConfigError& error) {
      const std::string text = error.what();
      const std::string prefix = folder_.string() + "/";
      EXPECT_EQ(text.rfind(prefix, 0), 0U) << text;
      return text.substr(prefix.size());
    }
    ADD_FAILURE() << "no error";
    return "";
  }
  Markers markers(const std::string& tags) const {
    write("markers.yaml", "family: tag36h11\ntags:\n" + tags);
    return load_markers(folder_);
  }
  Signals signals(const std::string& text) const {
    write("signals.yaml", text);
    return load_signals(folder_);
  }
  Network network(const std::string& text, const std::vector<std::string>& group = {}) const {
    write("network.yaml", text);
    return load_network(folder_, group);
  }

  test::TemporaryFolder temporary_;
  std::filesystem::path folder_ = temporary_.path();
};

TEST_F(RigTest, MarkersAreSortedByIdAndFoundByIt) {
  const Markers read = markers(
      "  - {id: 9, size_m: 0.08, part: 2, placement: {position_m: [0, 0, 0.1]}}\n"
      "  - {id: 3, size_m: 0.05, part: 1, placement: none}\n"
      "  - {id: 5, size_m: 0.08, part: 2, placement: {position_m: [0.1, 0, 0], rpy_deg: [0, 0, "
      "90]}}\n");
  ASSERT_EQ(read.tags.size(), 3U);
  EXPECT_EQ(read.tags[0].id, 3);
  EXPECT_EQ(read.tags[1].id, 5);
  EXPECT_EQ(read.tags[2].id, 9);
  EXPECT_EQ(read.parts(), (std::vector<int>{1, 2}));
  ASSERT_NE(read.find(5), nullptr);
  EXPECT_EQ(read.find(5)->part, 2);
  EXPECT_EQ(read.find(4), nullptr);
  EXPECT_EQ(read.find(10), nullptr);
  EXPECT_EQ(read.find(-1), nullptr);
}

TEST_F(RigTest, APlacementIsAPoseOrNone) {
  const Markers read = markers(
      "  - {id: 0, size_m: 0.05, part: 1, placement: none}\n"
      "  - {id: 1, size_m: 0.08, part: 2, placement: {position_m: [0.1, 0, 0], rpy_deg: [0, 0, "
      "90]}}\n");
  EXPECT_FALSE(read.tags[0].X_BM.has_value());
  ASSERT_TRUE(read.tags[1].X_BM.has_value());
  const Eigen::Vector3d p_B = *read.tags[1].X_BM * Eigen::Vector3d(1, 0, 0);
  EXPECT_LT((p_B - Eigen::Vector3d(0.1, 1, 0)).norm(), 1e-12);
}

TEST_F(RigTest, APartWithSeveralTagsNeedsAPlacementOfEach) {
  EXPECT_EQ(error_of([&] {
              markers(
                  "  - {id: 0, size_m: 0.05, part: 7, placement: none}\n"
                  "  - {id: 1, size_m: 0.05, part: 7, placement: {position_m: [0, 0, 0]}}\n");
            }),
            "markers.yaml:2: tags: part 7 has several tags, so each needs a placement");
}

TEST_F(RigTest, ATagIdStandsOnce) {
  EXPECT_EQ(error_of([&] {
              markers(
                  "  - {id: 4, size_m: 0.05, part: 1, placement: none}\n"
                  "  - {id: 4, size_m: 0.05, part: 2, placement: none}\n");
            }),
            "markers.yaml:2: tags: tag id 4 stands twice");
}

TEST_F(RigTest, TargetTagsAreNoPartsTags) {
  const std::string tags = "  - {id: 4, size_m: 0.05, part: 1, placement: none}\n";
  EXPECT_TRUE(markers(tags).target_tags.empty());
  const Markers read =
      markers(tags + "target_tags:\n  - {id: 41, size_m: 0.1}\n  - {id: 40, size_m: 0.12}\n");
  EXPECT_EQ(read.ids(), (std::vector<int>{4, 40, 41}));
  EXPECT_EQ(read.parts(), std::vector<int>{1});
  EXPECT_EQ(read.find(40), nullptr);
  EXPECT_EQ(read.size_m(40), 0.12);
  EXPECT_EQ(read.size_m(4), 0.05);
  EXPECT_EQ(read.size_m(5), std::nullopt);
  EXPECT_TRUE(read.is_target(41));
  EXPECT_FALSE(read.is_target(4));
  const auto problem_of = [&](const std::string& targets) {
    return error_of([&] { markers(tags + "target_tags:\n" + targets); });
  };
  EXPECT_EQ(problem_of("  - {id: 4, size_m: 0.1}\n"),
            "markers.yaml:5: target_tags[0].id: tag 4 is on part 1, so it is no target");
  EXPECT_EQ(problem_of("  - {id: 40, size_m: 0.1}\n  - {id: 40, size_m: 0.1}\n"),
            "markers.yaml:4: target_tags: tag id 40 stands twice");
  EXPECT_EQ(problem_of("  - {id: 40}\n"),
            "markers.yaml:5: target_tags[0].size_m: this key is missing");
  EXPECT_EQ(problem_of("  - {id: 40, size_m: 0.1, part: 2}\n").substr(0, 35),
            "markers.yaml:5: target_tags[0].part");
}

TEST_F(RigTest, BrokenMarkersPointAtTheKey) {
  EXPECT_EQ(error_of([&] { markers("  - {id: 4, size_m: 0.05, part: 1}\n"); }),
            "markers.yaml:3: tags[0].placement: this key is missing");
  EXPECT_EQ(error_of([&] { markers("  - {id: 4, size_m: 0.05, part: 1, placement: nowhere}\n"); }),
            "markers.yaml:3: tags[0].placement: expected a mapping 'key: value'");
  EXPECT_EQ(error_of([&] { markers("  - {id: 587, size_m: 0.05, part: 1, placement: none}\n"); }),
            "markers.yaml:3: tags[0].id: 587 is outside 0 … 586");
  EXPECT_EQ(error_of([&] { markers("  - {id: 4, size_m: 80, part: 1, placement: none}\n"); }),
            "markers.yaml:3: tags[0].size_m: 80 is outside 0.001 … 10");
  EXPECT_EQ(error_of([&] {
              markers("  - {id: 4, size_m: 0.05, part: 1, placement: none, a: 1}\n");
            }).rfind("markers.yaml:3: tags[0].a: this key is unknown", 0),
            0U);
  write("markers.yaml", "family: tag25h9\ntags: []\n");
  EXPECT_EQ(error_of([&] { load_markers(folder_); }),
            "markers.yaml:1: family: 'tag25h9' is none of: tag36h11");
}

TEST_F(RigTest, SignalsKeepTheirOrderAndTheRootIsOptional) {
  const Signals read = signals(
      "signals:\n  - {name: shoulder, lower: -60, upper: 60}\n  - {name: elbow, lower: 0, upper: "
      "1}\n"
      "end_effector_part: 5\n");
  ASSERT_EQ(read.signals.size(), 2U);
  EXPECT_EQ(read.signals[0].name, "shoulder");
  EXPECT_EQ(read.signals[0].lower, -60);
  EXPECT_EQ(read.signals[1].upper, 1);
  EXPECT_EQ(read.root_part, std::nullopt);
  EXPECT_EQ(read.end_effector_part, 5);
  EXPECT_EQ(signals("signals: []\nroot_part: 2\nend_effector_part: 5\n").root_part, 2);
}

TEST_F(RigTest, SenselessSignalsAreRefused) {
  EXPECT_EQ(error_of([&] {
              signals("signals:\n  - {name: a, lower: 1, upper: 1}\nend_effector_part: 5\n");
            }),
            "signals.yaml:2: signals[0].upper: must be above lower");
  EXPECT_EQ(error_of([&] {
              signals(
                  "signals:\n  - {name: a, lower: 0, upper: 1}\n"
                  "  - {name: a, lower: 0, upper: 1}\nend_effector_part: 5\n");
            }),
            "signals.yaml:3: signals[1].name: this name stands twice");
  EXPECT_EQ(error_of([&] {
              signals("signals:\n  - {name: '', lower: 0, upper: 1}\nend_effector_part: 5\n");
            }),
            "signals.yaml:2: signals[0].name: expected a name");
  EXPECT_EQ(error_of([&] { signals("signals: []\n"); }),
            "signals.yaml:1: end_effector_part: this key is missing");
}

TEST_F(RigTest, TheNetworkGivesTwoUrlsWithPortsNextToEachOther) {
  const Network read = network("network: host\nport: 7700\nttl: 1\n");
  EXPECT_FALSE(read.is_private);
  EXPECT_EQ(read.bus_url(), "udpm://239.255.76.67:7700?ttl=1");
  EXPECT_EQ(read.images_url(), "udpm://239.255.76.67:7701?ttl=1");
  EXPECT_TRUE(network("network: private\nport: 7667\nttl: 0\n").is_private);
  // The images' port must exist as well.
  EXPECT_EQ(error_of([&] { network("network: host\nport: 65535\nttl: 0\n"); }),
            "network.yaml:2: port: 65535 is outside 1024 … 65534");
  EXPECT_EQ(error_of([&] { network("network: wifi\nport: 7667\nttl: 0\n"); }),
            "network.yaml:1: network: 'wifi' is none of: private, host");
}

const std::string kSeveralHosts = "network: host\nport: 7700\nttl: 1\n";

TEST_F(RigTest, HostsHaveTheirSharesOfTheGroup) {
  EXPECT_TRUE(network("network: host\nport: 7700\nttl: 0\n", {"camera"}).hosts.empty());
  const Network read = network(
      kSeveralHosts +
          "hosts:\n  eye: [camera, marker_estimator, log_images]\n  desk: [observer, log]\n",
      {"camera", "log", "log_images", "marker_estimator", "observer"});
  EXPECT_EQ(read.share_of("eye"),
            (std::vector<std::string>{"camera", "marker_estimator", "log_images"}));
  EXPECT_EQ(read.share_of("desk"), (std::vector<std::string>{"observer", "log"}));
  EXPECT_EQ(read.bus_url(), "udpm://239.255.76.67:7700?ttl=1");
  EXPECT_EQ(read.images_url(), "udpm://239.255.76.67:7701?ttl=0") << "images leave their host";
  try {
    read.share_of("dsk");
    ADD_FAILURE() << "a host that there is not";
  } catch (const std::invalid_argument& error) {
    EXPECT_STREQ(error.what(), "--host: network.yaml has no host 'dsk'; there are: desk, eye");
  }
}

TEST_F(RigTest, EveryProcessRunsOnExactlyOneHost) {
  const auto error = [&](const std::string& hosts) {
    return error_of([&] { network(kSeveralHosts + hosts, {"observer", "log"}); });
  };
  EXPECT_EQ(error("hosts:\n  a: [observer]\n  b: [log, observer]\n"),
            "network.yaml:6: hosts.b: 'observer' runs on 'a' already");
  EXPECT_EQ(error("hosts:\n  a: [log, log, observer]\n"),
            "network.yaml:5: hosts.a: 'log' runs on 'a' already");
  EXPECT_EQ(error("hosts:\n  a: [log]\n  b: []\n"),
            "network.yaml:4: hosts: 'observer' runs on no host");
  EXPECT_EQ(
      error("hosts:\n  a: [log, observer]\n  b: [oberver]\n"),
      "network.yaml:6: hosts.b: 'oberver' is no process of this rig; there are: observer, log");
  EXPECT_EQ(error("hosts:\n  all: [log, observer]\n"),
            "network.yaml:5: hosts.all: no host may be called that");
  EXPECT_EQ(error("hosts: [a, b]\n"), "network.yaml:4: hosts: expected a mapping 'key: value'");
  EXPECT_EQ(error("hosts:\n  a: observer\n"), "network.yaml:5: hosts.a: expected a list of texts");
}

TEST_F(RigTest, ImagesStayOnTheHostThatSeesThem) {
  EXPECT_EQ(error_of([&] {
              network(kSeveralHosts + "hosts:\n  a: [camera]\n  b: [marker_estimator]\n");
            }),
            "network.yaml:6: hosts.b: 'marker_estimator' must run where the camera does, on 'a': "
            "images do not survive a network");
  EXPECT_EQ(
      error_of([&] { network(kSeveralHosts + "hosts:\n  a: [log_images]\n  b: [camera]\n"); }),
      "network.yaml:5: hosts.a: 'log_images' must run where the camera does, on 'b': "
      "images do not survive a network");
}

TEST_F(RigTest, SeveralHostsNeedANetworkBetweenThem) {
  const std::string hosts = "hosts: {a: [observer], b: [log]}\n";
  EXPECT_EQ(error_of([&] { network("network: host\nport: 7700\nttl: 0\n" + hosts); }),
            "network.yaml:3: ttl: must be 1 or more to reach another host");
  EXPECT_EQ(error_of([&] { network("network: private\nport: 7700\nttl: 1\n" + hosts); }),
            "network.yaml:1: network: several hosts share a network: expected 'host'");
}

TEST_F(RigTest, AMissingFileIsNamed) {
  EXPECT_EQ(error_of([&] { load_markers(folder_); }),
            "markers.yaml: cannot be read: no such file or no permission");
}

}  // namespace
}  // namespace bodyschema
