// bodyschema: the operator's command. It listens to everything on the bus and works on recordings.

#include <fmt/format.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <iostream>
#include <stdexcept>
#include <string>
#include <vector>

#include "common/bus/arguments.h"
#include "common/bus/log_summary.h"
#include "common/text/text.h"
#include "processes/console/commands/commands.h"
#include "processes/console/hint.h"
#include "processes/driver_test/driver_test.h"

namespace {
constexpr int kWrongUsage = 2;

/// What was typed where one of several commands was expected; "" if that is not what was wrong.
std::string unknown_command(const CLI::App& console) {
  const CLI::App* app = &console;
  while (!app->get_subcommands().empty()) app = app->get_subcommands().front();
  const std::vector<std::string> rest = app->remaining();
  const auto word =
      std::ranges::find_if(rest, [](const std::string& text) { return !text.starts_with("-"); });
  if (app->get_require_subcommand_min() == 0 || word == rest.end()) return "";
  std::string names;
  for (const CLI::App* command : app->get_subcommands(nullptr)) names += " " + command->get_name();
  return fmt::format("{}: unknown command '{}'; there are:{}\n", app->get_name(),
                     bodyschema::fit(*word, 40), names);
}

bool is_number(const std::string& word) {
  char* end = nullptr;
  std::strtod(word.c_str(), &end);
  return !word.empty() && *end == '\0';
}

/// What was typed, the last word first, as CLI11 takes it: to it "-.5" would be an option.
std::vector<std::string> words_of(int argc, char** argv) {
  std::vector<std::string> words(argv + std::min(argc, 1), argv + argc);
  for (std::string& word : words) {
    if (word == "--") break;
    if (word.starts_with("-.") && is_number(word)) word.insert(1, "0");
  }
  std::ranges::reverse(words);
  return words;
}
}  // namespace

int main(int argc, char** argv) {
  CLI::App console("A robot arm's body schema: learn it, look at it, judge it", "bodyschema");
  console.require_subcommand(1);
  console.set_version_flag("--version", "bodyschema " + bodyschema::program_version());
  console.footer(
      "Exit codes: 0 a result; 1 the input, the bus or a file is at fault, or the arm did not do "
      "it; 2 wrong usage.");
  const bodyschema::Arguments commands(&console);
  bodyschema::add_offline_commands(commands);
  bodyschema::add_monitor_command(commands);
  bodyschema::add_engineer_command(commands);
  bodyschema::add_urdf_command(commands);
  bodyschema::add_reach_command(commands);
  bodyschema::add_refine_command(commands);
  bodyschema::add_adopt_command(commands);
  bodyschema::add_log_command(commands);
  bodyschema::add_operate_commands(commands);
  bodyschema::add_watch_command(commands);
  bodyschema::add_driver_test_command(commands);
  bodyschema::add_fault_command(commands);
  bodyschema::add_status_command(commands);
  bodyschema::add_follow_command(commands);
  bodyschema::add_where_command(commands);
  bodyschema::add_report_command(commands);
  try {
    console.parse(words_of(argc, argv));
    // A full disk must not look like a result.
    if (!std::cout.flush()) throw std::runtime_error("stdout: the result could not be written");
  } catch (const CLI::RuntimeError& error) {
    return console.exit(error);  // the result was printed
  } catch (const CLI::RequiredError& error) {
    const std::string unknown = unknown_command(console);
    if (unknown.empty())
      console.exit(error);
    else
      std::fputs(unknown.c_str(), stderr);
    return kWrongUsage;
  } catch (const CLI::ParseError& error) {
    return console.exit(error) == 0 ? 0 : kWrongUsage;
  } catch (const std::exception& error) {
    std::fprintf(stderr, "bodyschema: %s\n", error.what());
    return 1;
  }
  return 0;
}
