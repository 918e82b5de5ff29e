#include "common/bus/bus_url.h"

#include <arpa/inet.h>
#include <dirent.h>
#include <fcntl.h>
#include <lcm/lcm.h>
#include <netinet/in.h>
#include <spdlog/fmt/fmt.h>
#include <spdlog/fmt/ranges.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <cctype>
#include <charconv>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <set>
#include <string_view>

namespace bodyschema {
namespace {

constexpr const char* kReceiveBuffer = "recv_buf_size=2097152";
constexpr const char* kMulticastHelp =
    "no route for multicast. Type: ip link set lo multicast on; ip route add 224.0.0.0/4 dev lo "
    "(as root), or start the program with ./run";

/// LCM finds out too, but says it on stderr only, in its own words, or ten seconds later.
void probe_multicast(const std::string& url, const Url& parsed) {
  std::string address = parsed.target.substr(0, parsed.target.find(':'));
  if (address.empty()) address = "239.255.76.67";
  std::string port = "7667";
  if (const std::size_t colon = parsed.target.find(':'); colon != std::string::npos) {
    port = parsed.target.substr(colon + 1);
  }
  int port_number = 0;
  const auto [end, error] = std::from_chars(port.data(), port.data() + port.size(), port_number);
  if (error != std::errc() || end != port.data() + port.size() || port_number < 1 ||
      port_number > 65535) {
    throw url_error(url, fmt::format("\"{}\" is not a port (1 … 65535)", port));
  }
  sockaddr_in destination{};
  destination.sin_family = AF_INET;
  destination.sin_port = htons(static_cast<std::uint16_t>(port_number));
  if (::inet_pton(AF_INET, address.c_str(), &destination.sin_addr) != 1 ||
      !IN_MULTICAST(ntohl(destination.sin_addr.s_addr))) {
    throw url_error(url, fmt::format("\"{}\" is not a multicast address (224.0.0.0 … "
                                     "239.255.255.255)",
                                     address));
  }
  const int probe = ::socket(AF_INET, SOCK_DGRAM | SOCK_CLOEXEC, 0);
  const bool has_route =
      probe >= 0 &&
      ::connect(probe, reinterpret_cast<const sockaddr*>(&destination), sizeof destination) == 0;
  if (probe >= 0) ::close(probe);
  if (!has_route) throw url_error(url, kMulticastHelp);
}

std::set<int> open_descriptors() {
  std::set<int> descriptors;
  DIR* folder = ::opendir("/proc/self/fd");
  if (folder == nullptr) return descriptors;
  while (const dirent* entry = ::readdir(folder)) {
    if (std::isdigit(static_cast<unsigned char>(entry->d_name[0])) != 0) {
      descriptors.insert(std::atoi(entry->d_name));
    }
  }
  descriptors.erase(::dirfd(folder));
  ::closedir(folder);
  return descriptors;
}

}  // namespace

std::runtime_error url_error(const std::string& url, const std::string& what) {
  return std::runtime_error(fmt::format("{}: {}", url, what));
}

Url parse_url(const std::string& url) {
  static const std::map<std::string, std::set<std::string>> kOptions = {
      {"udpm", {"ttl", "recv_buf_size"}}, {"tcpq", {}}, {"memq", {}}, {"file", {"speed", "mode"}}};
  const std::size_t separator = url.find("://");
  Url result;
  if (separator != std::string::npos) result.scheme = url.substr(0, separator);
  const auto known = kOptions.find(result.scheme);
  if (known == kOptions.end()) {
    throw url_error(url,
                    "is no bus. Type one of udpm://239.255.76.67:7667?ttl=0, tcpq://HOST:7700, "
                    "memq://, file://PATH?speed=0 (in), file://PATH?mode=w (out)");
  }
  const std::string rest = url.substr(separator + 3);
  const std::size_t question = rest.find('?');
  result.target = rest.substr(0, question);
  std::string_view options =
      question == std::string::npos ? "" : std::string_view(rest).substr(question + 1);
  while (!options.empty()) {
    const std::string_view option = options.substr(0, options.find('&'));
    options.remove_prefix(std::min(options.size(), option.size() + 1));
    const std::size_t equals = option.find('=');
    const std::string key(option.substr(0, equals));
    if (equals == std::string_view::npos || !known->second.contains(key)) {
      throw url_error(url, fmt::format("unknown option \"{}\"; {} knows: {}", option, result.scheme,
                                       fmt::join(known->second, ", ")));
    }
    result.options[key] = std::string(option.substr(equals + 1));
  }
  return result;
}

double parse_number(const std::string& url, const std::string& key, const std::string& text) {
  double value = 0;
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), value);
  if (error != std::errc() || end != text.data() + text.size() || !std::isfinite(value)) {
    throw url_error(url, fmt::format("{}=\"{}\" is not a number", key, text));
  }
  return value;
}

LcmPointer open_lcm(const std::string& url, const Url& parsed) {
  std::string full = url;
  if (parsed.scheme == "udpm") {
    probe_multicast(url, parsed);
    if (parsed.options.contains("ttl")) parse_number(url, "ttl", parsed.options.at("ttl"));
    if (!parsed.options.contains("recv_buf_size")) {
      full += url.find('?') == std::string::npos ? "?" : url.back() == '?' ? "" : "&";
      full += kReceiveBuffer;
    }
  }
  const std::set<int> before = open_descriptors();
  LcmPointer lcm(lcm_create(full.c_str()), [](lcm_t* raw) {
    if (raw != nullptr) lcm_destroy(raw);
  });
  // Asking for the descriptor makes LCM connect and test itself; later it would return broken
  // subscriptions instead of an error.
  if (lcm == nullptr || lcm_get_fileno(lcm.get()) < 0) {
    throw url_error(url, parsed.scheme == "tcpq"
                             ? "nobody answers. Type: java -cp /usr/share/java/lcm.jar "
                               "lcm.lcm.TCPService 7700"
                             : kMulticastHelp);
  }
  // LCM's descriptors must not outlive an exec in a child: its port would stay taken.
  for (const int descriptor : open_descriptors()) {
    if (!before.contains(descriptor)) {
      ::fcntl(descriptor, F_SETFD, ::fcntl(descriptor, F_GETFD) | FD_CLOEXEC);
    }
  }
  return lcm;
}

}  // namespace bodyschema
