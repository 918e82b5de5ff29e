// judge_hosts: judges a run over several hosts (tests/pipeline/hosts.sh), and the cost of lost
// frames. Prints a row of a Markdown table; exit 1 and the reason if something is wrong.
//
//   judge_hosts FOLDER SAMPLES [--head]      (--head prints the table's head instead)

#include <algorithm>
#include <cstdio>
#include <cstring>
#include <exception>
#include <filesystem>
#include <fstream>
#include <map>
#include <nlohmann/json.hpp>
#include <set>
#include <string>
#include <vector>

#include "common/bus/convert.h"
#include "common/bus/event_log.h"
#include "tests/support/rig_truth.h"

using namespace bodyschema;
namespace fs = std::filesystem;

namespace {

using Bytes = std::vector<std::uint8_t>;

void expect(bool is_true, const std::string& what) {
  if (!is_true) throw std::runtime_error(what);
}

template <class Message>
Message message_of(const LogEvent& event) {
  const auto decoded = decode<Message>(event.data.data(), event.data.size());
  expect(decoded.message.has_value(), event.channel + ": " + decoded.problem);
  return *decoded.message;
}

/// The newest PROCESS_INFO of every process heard by the learning host.
struct Heard {
  std::int64_t num_commands = 0;  ///< ACTION_COMMANDs beyond the first of each action
  std::int64_t num_requests = 0;  ///< SAMPLE_REQUESTs
  std::map<std::string, process_info_t> processes;
};

Heard listen(const fs::path& log, const std::map<std::int64_t, Bytes>& samples) {
  Heard heard;
  std::set<std::int64_t> actions;
  for_each_event(log, [&](const LogEvent& event) {
    if (event.channel == kSample.name) {
      const auto index = message_of<sample_t>(event).sample_index;
      const auto made = samples.find(index);
      expect(made != samples.end() && made->second == event.data,
             "SAMPLE " + std::to_string(index) + " arrived otherwise than the observer made it");
    } else if (event.channel == kActionCommand.name) {
      const auto id = message_of<action_command_t>(event).action_id;
      if (!actions.insert(id).second) ++heard.num_commands;
    } else if (event.channel == kSampleRequest.name) {
      ++heard.num_requests;
    } else if (event.channel == kProcessInfo.name) {
      auto info = message_of<process_info_t>(event);
      heard.processes[info.process_name] = std::move(info);
    }
  });
  return heard;
}

void judge(const fs::path& folder, std::size_t num_samples) {
  const test::RigTruth truth(folder / "rig");
  const auto schemas = read_log(folder / "learning/current/schema.lcmlog", kBodySchema);
  expect(schemas.size() == 1, "no BODY_SCHEMA was accepted");
  const std::string objection = truth.objection(from_message(schemas[0]), truth.parts());
  expect(objection.empty(), "the structure is wrong: " + objection);

  const bool has_eye = fs::exists(folder / "eye");
  const fs::path seeing = folder / (has_eye ? "eye" : "robot") / "current";
  std::map<std::int64_t, Bytes> samples;
  for_each_event(seeing / "samples.lcmlog", [&](const LogEvent& event) {
    const auto index = message_of<sample_t>(event).sample_index;
    expect(samples.emplace(index, event.data).second,
           "SAMPLE " + std::to_string(index) + " was made twice");
  });
  expect(samples.size() == num_samples && samples.begin()->first == 0 &&
             samples.rbegin()->first == static_cast<std::int64_t>(num_samples) - 1,
         std::to_string(samples.size()) + " samples were made, not " + std::to_string(num_samples));

  const Heard heard = listen(folder / "learning/current/run.lcmlog.00", samples);
  std::int64_t num_lost_samples = 0;
  for (const auto& [name, info] : heard.processes) {
    for (const counter_t& counter : info.counters) {
      const bool is_damage = counter.counter_name.starts_with("malformed") ||
                             counter.counter_name.starts_with("senseless");
      expect(!is_damage || counter.count == 0,
             name + ": " + counter.counter_name + " " + std::to_string(counter.count));
    }
  }
  for (const char* host : {"robot", "eye", "learning"}) {
    if (!fs::exists(folder / host)) continue;
    std::ifstream file(folder / host / "status.json");
    std::set<std::string> seen;
    const auto status = nlohmann::json::parse(file);
    for (const auto& process : status["processes"]) seen.insert(process["name"]);
    for (const auto& [name, info] : heard.processes)
      expect(seen.contains(name), std::string(host) + " does not see " + name);
  }
  std::ifstream stream(folder / "learning/current/result.json");
  const auto result = nlohmann::json::parse(stream);
  std::int64_t num_frames = 0;
  std::ifstream lost(folder / "lost");
  std::string host;
  for (std::int64_t frames = 0; lost >> host >> frames;) num_frames += frames;
  num_lost_samples = static_cast<std::int64_t>(num_samples) - result["samples"].get<std::int64_t>();
  expect(num_lost_samples == 0,
         "the learning host lacks " + std::to_string(num_lost_samples) + " of the samples");
  std::printf("| %d | right | %zu | %.1f | %lld | %lld | %lld |\n", has_eye ? 3 : 2, samples.size(),
              result["seconds"].get<double>(), static_cast<long long>(num_frames),
              static_cast<long long>(heard.num_commands),
              static_cast<long long>(heard.num_requests));
}

}  // namespace

int main(int argc, char** argv) {
  if (argc == 2 && std::strcmp(argv[1], "--head") == 0) {
    std::printf(
        "| hosts | structure | samples | s | frames lost | commands repeated | samples asked for "
        "|\n"
        "| --- | --- | --- | --- | --- | --- | --- |\n");
    return 0;
  }
  if (argc != 3) {
    std::fprintf(stderr, "usage: judge_hosts FOLDER SAMPLES | judge_hosts --head\n");
    return 2;
  }
  try {
    judge(argv[1], std::stoul(argv[2]));
  } catch (const std::exception& error) {
    std::fprintf(stderr, "judge_hosts: %s\n", error.what());
    return 1;
  }
  return 0;
}
