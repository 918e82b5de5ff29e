#include <fmt/format.h>
#include <spdlog/spdlog.h>

#include <chrono>
#include <iostream>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>

#include "common/bus/bus.h"
#include "common/bus/channels.h"
#include "common/bus/convert.h"
#include "common/bus/rest_position.h"
#include "common/text/clock.h"
#include "processes/console/commands/commands.h"
#include "processes/console/commands/files.h"
#include "processes/console/views/where_view.h"

namespace bodyschema {
namespace {

constexpr std::int64_t kPatience_us = 2'500'000;  // twice what a group repeats in

struct WhereArguments {
  std::string in = default_url();
  std::string schema;
  std::optional<int> part;
  bool json = false;
};

struct Heard {
  std::optional<BodySchema> schema;
  std::optional<motion_status_t> motion;

  /// Where the arm is, once that is known.
  std::optional<Eigen::VectorXd> position() const {
    if (!schema || !motion) return std::nullopt;
    return rest_position(*motion, schema->signals.size());
  }
};

Heard listen(const std::string& url) {
  Heard heard;
  spdlog::set_level(spdlog::level::err);
  Bus bus(url, "");
  bus.subscribe(kBodySchema, [&](const body_schema_t& m) { heard.schema = from_message(m); });
  bus.subscribe(kMotionStatus, [&](const motion_status_t& m) { heard.motion = m; });
  const std::int64_t end_us = clock_us() + kPatience_us;
  while (!heard.position() && clock_us() < end_us) bus.handle(std::chrono::milliseconds(20));
  if (!heard.schema)
    throw std::runtime_error(
        heard.motion ? "no schema is known yet: it comes with the first samples"
                     : fmt::format("no schema is heard on {}: ./run --keep starts a group, "
                                   "./run exec bodyschema where asks one that runs; --schema "
                                   "FILE reads one",
                                   url));
  return heard;
}

void run_where(const WhereArguments& arguments) {
  BodySchema schema;
  std::optional<Eigen::VectorXd> action;
  if (arguments.schema.empty()) {
    const Heard heard = listen(arguments.in);
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
  const auto arguments = std::make_shared<WhereArguments>();
  Arguments where = console.add_subcommand(
      "where", "Where parts are and can go, and how far signals are from their limits");
  where.add_option("PART", arguments->part, "This part only");
  where.add_option("--in", arguments->in, "URL of the bus").capture_default_str();
  where.add_option("--schema", arguments->schema, "Ask a schema file instead of a group");
  where.add_flag("--json", arguments->json, "Print JSON");
  where.callback([arguments] { run_where(*arguments); });
}

}  // namespace bodyschema
