// Message to a user without a route for multicast. Runs in a network namespace without one.

#include <gtest/gtest.h>

#include <stdexcept>
#include <string>

#include "common/bus/bus.h"

namespace bodyschema {
namespace {

TEST(BusWithoutNetwork, SaysAtConstructionWhatToType) {
  for (const bool is_input : {true, false}) {
    try {
      const std::string url = "udpm://239.255.76.67:7667?ttl=0";
      const Bus bus(is_input ? url : "", is_input ? "" : url);
      FAIL() << "was opened";
    } catch (const std::runtime_error& error) {
      EXPECT_NE(std::string(error.what()).find("ip route add 224.0.0.0/4 dev lo"),
                std::string::npos)
          << error.what();
    }
  }
}

}  // namespace
}  // namespace bodyschema
