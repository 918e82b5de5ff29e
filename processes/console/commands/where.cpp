#include <fmt/format.h>
#include <spdlog/spdlog.h>

#include <chrono>
#include <iostream>
#include <optional>
#include <stdexcept>
#include <string>

#include "common/bus/bus.h"
#include "common/text/clock.h"
#include "processes/console/commands/commands.h"
#include "processes/console/commands/files.h"
#include "processes/console/commands/session.h"
#include "processes/console/views/where_view.h"

namespace bodyschema {
namespace {

constexpr std::int64_t kRepeated_us = 2'500'000;  // twice what a group repeats in

struct WhereArguments {
  std::string in = default_url();
  std::string schema;
  std::optional<int> part;
  bool json = false;
};

/// @throws std::runtime_error unless a schema comes.
void listen(const std::string& url, Heard* heard) {
  spdlog::set_level(spdlog::level::err);
  Bus bus(url, "");
  heard->listen(bus);
  const std::int64_t end_us = clock_us() + kRepeated_us;
  while (!heard->position() && clock_us() < end_us) bus.handle(std::chrono::milliseconds(20));
  if (!heard->schema)
    throw std::runtime_error(
        heard->motion ? "no schema is known yet: it comes with the first samples"
                      : fmt::format("no schema is heard on {}: ./run --keep starts a group, "
                                    "./run exec bodyschema where asks one that runs; --schema "
                                    "FILE reads one",
                                    url));
}

void run_where(const WhereArguments& arguments) {
  BodySchema schema;
  std::optional<Eigen::VectorXd> action;
  if (arguments.schema.empty()) {
    Heard heard;
    listen(arguments.in, &heard);
    schema = *heard.schema;
    action = heard.position();
    if (!action)
      std::cerr << (heard.motion ? "the driver tells no place where the arm rests"
                                 : "no driver is heard")
                << ": where parts are now is not known\n";
  } else {
    schema = load_schema(arguments.schema);
  }
  const Whereabouts where = whereabouts_of(schema, arguments.part, action);
  print(arguments.json, where_json(schema, where), where_text(schema, where));
}

}  // namespace

void add_where_command(Arguments console) {
  auto [where, arguments] = console.add_command(
      "where", "Where parts are and can go, and how far signals are from their limits", run_where);
  where.add_option("PART", arguments.part, "This part only");
  where.add_option("--in", arguments.in, "URL of the bus").capture_default_str();
  where.add_option("--schema", arguments.schema, "Ask a schema file instead of a group");
  where.add_flag("--json", arguments.json, "Print JSON");
}

}  // namespace bodyschema
