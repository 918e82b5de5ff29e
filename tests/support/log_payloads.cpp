// log_payloads: prints the payloads of one channel of a log, raw, for comparing runs. The stamps of
// events differ from recording to recording; payloads must not.
//
//   log_payloads FILE CHANNEL [--last]

#include <cstdio>
#include <cstring>
#include <exception>
#include <string>
#include <vector>

#include "common/bus/event_log.h"

int main(int argc, char** argv) {
  if (argc < 3) {
    std::fprintf(stderr, "usage: log_payloads FILE CHANNEL [--last]\n");
    return 2;
  }
  const bool only_last = argc > 3 && std::strcmp(argv[3], "--last") == 0;
  try {
    std::vector<std::uint8_t> payloads;
    bodyschema::for_each_event(argv[1], [&](const bodyschema::LogEvent& event) {
      if (event.channel != argv[2]) return;
      if (only_last) payloads.clear();
      payloads.insert(payloads.end(), event.data.begin(), event.data.end());
    });
    if (payloads.empty()) {
      std::fprintf(stderr, "log_payloads: %s has no %s\n", argv[1], argv[2]);
      return 1;
    }
    std::fwrite(payloads.data(), 1, payloads.size(), stdout);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "log_payloads: %s\n", error.what());
    return 1;
  }
  return 0;
}
