#pragma once

#include <functional>
#include <memory>
#include <string>
#include <utility>
#include <vector>

namespace CLI {
class App;
class Option;
}  // namespace CLI

namespace bodyschema {

/// One option or positional argument; CLI11's methods of the same names.
class Argument {
 public:
  explicit Argument(CLI::Option* option) : option_(option) {}
  Argument& required();
  Argument& expected(int count);
  Argument& type_name(const std::string& name);
  Argument& envname(const std::string& name);
  Argument& capture_default_str();
  Argument& needs(const Argument& other);
  Argument& excludes(const Argument& other);

  Argument& in_range(int lowest, int highest);
  Argument& in_range(double lowest, double highest);
  Argument& positive();
  Argument& one_of(const std::vector<std::string>& values);
  Argument& existing_file();
  /// `problem_of` a text is "" if there is none.
  Argument& check(std::function<std::string(const std::string& text)> problem_of,
                  const std::string& type_name = "");

 private:
  CLI::Option* option_;
};

/// The arguments of a program or of one of its commands. CLI11's own header takes 6 to 9 s in each
/// source that includes it.
class Arguments {
 public:
  explicit Arguments(CLI::App* app) : app_(app) {}

  /// Value: std::string, std::filesystem::path, int, std::int64_t, double, an optional int, a
  /// vector of ints, doubles or strings, a set of strings.
  template <class Value>
  Argument add_option(const std::string& name, Value& value, const std::string& help);
  Argument add_flag(const std::string& name, bool& value, const std::string& help);

  Arguments add_subcommand(const std::string& name, const std::string& help);
  /// A subcommand that runs `run`, and what that gets: its options are to be stored in it.
  template <class Given>
  std::pair<Arguments, Given&> add_command(const std::string& name, const std::string& help,
                                           void (*run)(const Given&)) {
    const auto given = std::make_shared<Given>();
    Arguments command = add_subcommand(name, help);
    command.callback([given, run] { run(*given); });
    return {command, *given};
  }
  Arguments& require_subcommand(int count);
  /// Options of the command above may come last.
  Arguments& fallthrough();
  /// "" hides a command.
  Arguments& group(const std::string& name);
  Arguments& allow_extras();
  Arguments& callback(std::function<void()> run);

 private:
  CLI::App* app_;
};

/// Ends a command as wrong usage. @throws CLI::ValidationError
[[noreturn]] void refuse_argument(const std::string& name, const std::string& why);

/// Ends a command whose result is printed with exit code 1. @throws CLI::RuntimeError
[[noreturn]] void end_as_failed();

}  // namespace bodyschema
