#pragma once

#include <algorithm>
#include <cstddef>
#include <stdexcept>
#include <string>

namespace bodyschema {

/// URL of the images' bus beside `bus_url`: the next port of the same network, so that processes
/// that want no images do not receive them (an idle socket on the images' port overflows thousands
/// of times). "udpm://239.255.76.67:7667?ttl=0" → "udpm://239.255.76.67:7668?ttl=0".
/// URLs without a port (file://, memq://, empty): images share the bus.
/// @throws std::runtime_error if the port is not 1 … 65534.
inline std::string images_url(const std::string& bus_url) {
  const bool has_port = bus_url.starts_with("udpm://") || bus_url.starts_with("tcpq://");
  if (!has_port) return bus_url;
  const std::size_t host = bus_url.find("://") + 3;
  const std::size_t query = std::min(bus_url.find('?', host), bus_url.size());
  const std::size_t colon = bus_url.find(':', host);
  const std::string lcm_default = bus_url.starts_with("udpm://") ? "7667" : "7700";
  const bool is_default = colon == std::string::npos || colon > query;
  const std::string digits =
      is_default ? lcm_default : bus_url.substr(colon + 1, query - colon - 1);
  const bool is_number = !digits.empty() && digits.size() <= 5 &&
                         digits.find_first_not_of("0123456789") == std::string::npos;
  const int port = is_number ? std::stoi(digits) : 0;
  if (port < 1 || port > 65534) {
    throw std::runtime_error("no port for images beside " + bus_url +
                             ": its port must be 1 … 65534; or give --images URL");
  }
  const std::string address = is_default ? bus_url.substr(0, query) : bus_url.substr(0, colon);
  return address + ":" + std::to_string(port + 1) + bus_url.substr(query);
}

}  // namespace bodyschema
