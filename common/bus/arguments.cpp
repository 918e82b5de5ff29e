#include "common/bus/arguments.h"

#include <CLI/CLI.hpp>
#include <cstdint>
#include <filesystem>
#include <optional>
#include <set>
#include <utility>

namespace bodyschema {

Argument& Argument::required() {
  option_->required();
  return *this;
}

Argument& Argument::expected(int count) {
  option_->expected(count);
  return *this;
}

Argument& Argument::type_name(const std::string& name) {
  option_->type_name(name);
  return *this;
}

Argument& Argument::envname(const std::string& name) {
  option_->envname(name);
  return *this;
}

Argument& Argument::capture_default_str() {
  option_->capture_default_str();
  return *this;
}

Argument& Argument::needs(const Argument& other) {
  option_->needs(other.option_);
  return *this;
}

Argument& Argument::excludes(const Argument& other) {
  option_->excludes(other.option_);
  return *this;
}

Argument& Argument::in_range(int lowest, int highest) {
  option_->check(CLI::Range(lowest, highest));
  return *this;
}

Argument& Argument::in_range(double lowest, double highest) {
  option_->check(CLI::Range(lowest, highest));
  return *this;
}

Argument& Argument::positive() {
  option_->check(CLI::PositiveNumber);
  return *this;
}

Argument& Argument::one_of(const std::vector<std::string>& values) {
  option_->check(CLI::IsMember(values));
  return *this;
}

Argument& Argument::existing_file() {
  option_->check(CLI::ExistingFile);
  return *this;
}

Argument& Argument::check(std::function<std::string(const std::string& text)> problem_of,
                          const std::string& type_name) {
  option_->check(std::move(problem_of), type_name);
  return *this;
}

using Text = const std::string&;
template <class Value>
Argument Arguments::add_option(const std::string& name, Value& value, const std::string& help) {
  return Argument(app_->add_option(name, value, help));
}
template Argument Arguments::add_option(Text, std::string&, Text);
template Argument Arguments::add_option(Text, std::filesystem::path&, Text);
template Argument Arguments::add_option(Text, int&, Text);
template Argument Arguments::add_option(Text, std::int64_t&, Text);
template Argument Arguments::add_option(Text, double&, Text);
template Argument Arguments::add_option(Text, std::optional<int>&, Text);
template Argument Arguments::add_option(Text, std::vector<int>&, Text);
template Argument Arguments::add_option(Text, std::vector<double>&, Text);
template Argument Arguments::add_option(Text, std::vector<std::string>&, Text);
template Argument Arguments::add_option(Text, std::set<std::string>&, Text);

Argument Arguments::add_flag(const std::string& name, bool& value, const std::string& help) {
  return Argument(app_->add_flag(name, value, help));
}

Arguments Arguments::add_subcommand(const std::string& name, const std::string& help) {
  return Arguments(app_->add_subcommand(name, help));
}

Arguments& Arguments::require_subcommand(int count) {
  app_->require_subcommand(count);
  return *this;
}

Arguments& Arguments::fallthrough() {
  app_->fallthrough();
  return *this;
}

Arguments& Arguments::group(const std::string& name) {
  app_->group(name);
  return *this;
}

Arguments& Arguments::allow_extras() {
  app_->allow_extras();
  return *this;
}

Arguments& Arguments::callback(std::function<void()> run) {
  app_->callback(std::move(run));
  return *this;
}

void refuse_argument(const std::string& name, const std::string& why) {
  throw CLI::ValidationError(name, why);
}

void end_as_failed() { throw CLI::RuntimeError(1); }

}  // namespace bodyschema
