#include <fmt/format.h>
#include <spdlog/spdlog.h>
#include <unistd.h>

#include <chrono>
#include <set>
#include <stdexcept>
#include <string>

#include "common/bus/all_channels.h"
#include "common/bus/bus.h"
#include "common/bus/images_url.h"
#include "common/bus/log_summary.h"
#include "common/text/clock.h"
#include "processes/console/commands/commands.h"
#include "processes/console/commands/files.h"
#include "processes/console/hint.h"
#include "processes/console/status_board.h"
#include "processes/console/views/status_view.h"

namespace bodyschema {
namespace {

struct StatusArguments {
  std::string in = default_url();
  std::string images;
  std::set<std::string> processes;
  double seconds = 2.1;
  bool json = false;
};

void run_status(const StatusArguments& arguments) {
  // Dropped messages stand in the result.
  spdlog::set_level(spdlog::level::err);
  StatusBoard board(arguments.processes, program_version());
  Bus bus(arguments.in, "");
  Bus images(arguments.images.empty() ? images_url(arguments.in) : arguments.images, "");
  for_each_channel([&]<class Message>(const Channel<Message>& channel) {
    constexpr bool is_image = std::is_same_v<Message, camera_image_t>;
    (is_image ? images : bus).subscribe(channel, [&board, channel](const Message& message) {
      board.on_arrival(channel.name, clock_us());
      if constexpr (requires { board.on_message(message); }) board.on_message(message);
      if constexpr (std::is_same_v<Message, body_schema_t>) {
        const bool is_accepted = std::string(channel.name) == kBodySchema.name;
        is_accepted ? board.on_body_schema(message) : board.on_learned_schema(message);
      }
    });
  });
  const std::int64_t begin = clock_us();
  const auto end = begin + static_cast<std::int64_t>(arguments.seconds * 1e6);
  board.begin(begin);
  while (clock_us() < end) {
    images.handle(std::chrono::milliseconds(0));
    bus.handle(std::chrono::milliseconds(20));
  }
  board.end(clock_us());
  board.on_own_counters(bus.counters());
  board.on_own_counters(images.counters());
  if (board.is_silent())
    throw std::runtime_error(fmt::format(
        "nothing on {} in {:.1f} s. `./run --keep` starts a group, `./run exec bodyschema status` "
        "looks at one that runs",
        arguments.in, arguments.seconds));
  const GroupStatus status = board.status();
  print(arguments.json, status_json(status),
        status_text(status, terminal_width(STDOUT_FILENO).value_or(100)));
}

}  // namespace

void add_status_command(Arguments console) {
  auto [status, arguments] =
      console.add_command("status", "How the group on the bus is", run_status);
  status.add_option("--in", arguments.in, "URL of the bus").capture_default_str();
  status.add_option("--images", arguments.images,
                    "URL of the images' bus; default: the next port of --in");
  status.add_option("--processes", arguments.processes,
                    "Processes that should be heard of; says which is not");
  status.add_option("--seconds", arguments.seconds, "How long to listen [s]")
      .in_range(0.1, 3600.0)
      .capture_default_str();
  status.add_flag("--json", arguments.json, "Print JSON");
}

}  // namespace bodyschema
