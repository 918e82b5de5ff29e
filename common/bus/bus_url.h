#pragma once

#include <map>
#include <memory>
#include <stdexcept>
#include <string>

struct _lcm_t;

namespace bodyschema {

// URLs of buses and logs, and the LCM objects that they open (common/bus/bus.h lists the URLs).

struct Url {
  std::string scheme;
  std::string target;
  std::map<std::string, std::string> options;

  bool is_file() const { return scheme == "file"; }
};

std::runtime_error url_error(const std::string& url, const std::string& what);

/// Strict, because LCM ignores an option that it does not know: a typing error would pass unseen.
/// @throws std::runtime_error with what to type.
Url parse_url(const std::string& url);

/// Value of the option `key`. @throws std::runtime_error if it is no finite number.
double parse_number(const std::string& url, const std::string& key, const std::string& text);

using LcmPointer = std::shared_ptr<_lcm_t>;

/// @throws std::runtime_error with what to type, if the network or the relay does not answer.
LcmPointer open_lcm(const std::string& url, const Url& parsed);

}  // namespace bodyschema
