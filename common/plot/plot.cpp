#include "common/plot/plot.h"

#include <fcntl.h>
#include <fmt/format.h>
#include <spawn.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cerrno>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <utility>

namespace bodyschema {
namespace {

/// A folder of our own that goes with its content.
class ScratchFolder {
 public:
  ScratchFolder() {
    std::string path = (std::filesystem::temp_directory_path() / "bodyschema-XXXXXX").string();
    if (::mkdtemp(path.data()) == nullptr)
      throw PlotError(path + ": cannot make a folder: " + std::strerror(errno));
    path_ = path;
  }
  ~ScratchFolder() {
    std::error_code ignored;
    std::filesystem::remove_all(path_, ignored);
  }
  ScratchFolder(const ScratchFolder&) = delete;
  ScratchFolder& operator=(const ScratchFolder&) = delete;
  std::filesystem::path operator/(const std::string& name) const { return path_ / name; }

 private:
  std::filesystem::path path_;
};

std::string text_of(const std::filesystem::path& file) {
  std::ifstream stream(file, std::ios::binary);
  return {std::istreambuf_iterator<char>(stream), {}};
}

/// 0 if gnuplot drew everything.
int run_gnuplot(const std::filesystem::path& script, const std::filesystem::path& errors) {
  posix_spawn_file_actions_t actions;
  posix_spawn_file_actions_init(&actions);
  posix_spawn_file_actions_addopen(&actions, STDIN_FILENO, "/dev/null", O_RDONLY, 0);
  posix_spawn_file_actions_addopen(&actions, STDOUT_FILENO, "/dev/null", O_WRONLY, 0);
  posix_spawn_file_actions_addopen(&actions, STDERR_FILENO, errors.c_str(), O_WRONLY | O_CREAT,
                                   0600);
  std::string program = "gnuplot", argument = script.string();
  char* const arguments[] = {program.data(), argument.data(), nullptr};
  pid_t child = 0;
  const int error = ::posix_spawnp(&child, "gnuplot", &actions, nullptr, arguments, environ);
  posix_spawn_file_actions_destroy(&actions);
  if (error == ENOENT) throw PlotError("gnuplot is missing. Type: apt-get install gnuplot-nox");
  if (error != 0)
    throw PlotError(std::string("gnuplot cannot be started: ") + std::strerror(error));
  int status = 0;
  while (::waitpid(child, &status, 0) < 0 && errno == EINTR) {
  }
  return status;
}

void replace_all(std::string& text, const std::string& what, const std::string& by) {
  for (std::size_t at = 0; (at = text.find(what, at)) != std::string::npos; at += by.size())
    text.replace(at, what.size(), by);
}

void erase_between(std::string& text, const std::string& begin, const std::string& end) {
  const std::size_t from = text.find(begin);
  const std::size_t to = text.find(end, from);
  if (from != std::string::npos && to != std::string::npos)
    text.erase(from, to + end.size() - from);
}

/// gnuplot opens a group for every change of its pen, mostly for nothing.
std::string without_empty_groups(const std::string& svg) {
  std::string result;
  result.reserve(svg.size());
  for (std::size_t at = 0; at < svg.size();) {
    const std::size_t group = svg.find("<g ", at);
    const std::size_t content = svg.find('>', group);
    if (content == std::string::npos) return result + svg.substr(at);
    const std::size_t next = svg.find_first_not_of(" \t\n", content + 1);
    const bool is_empty = next != std::string::npos && svg.compare(next, 4, "</g>") == 0;
    result.append(svg, at, (is_empty ? group : content + 1) - at);
    at = is_empty ? next + 4 : content + 1;
  }
  return result;
}

/// What draws `plot` into `file`, after whatever was drawn before.
std::string commands(const Plot& plot, const std::string& terminal,
                     const std::filesystem::path& file) {
  return fmt::format(
      "reset\nset encoding utf8\n"
      "set terminal {} size {},{}\n"
      "set output {}\n"
      "set border 3 lw 0.7\n"
      "set tics out nomirror scale 0.4\n"
      "set grid lw 0.5 lt 1 lc rgb '#99888888'\n"
      "{}\n"
      "unset output\n",
      terminal, plot.width_px, plot.height_px, gnuplot_string(file.string()), plot.script);
}

void draw(const std::string& commands, const ScratchFolder& folder) {
  std::ofstream script(folder / "script.gp");
  script << commands;
  script.close();
  if (!script) throw PlotError("cannot write into " + (folder / "").string());
  if (run_gnuplot(folder / "script.gp", folder / "errors") == 0) return;
  std::string errors = text_of(folder / "errors");
  replace_all(errors, "\n", " ");
  throw PlotError("gnuplot refused a plot: " + errors);
}

/// The element alone, without what several of them in one page would say twice.
std::string inline_svg(std::string svg) {
  svg.erase(0, svg.find("<svg"));
  erase_between(svg, "<title>", "</desc>");
  erase_between(svg, "<defs>", "</defs>");
  for (std::size_t at = 0; (at = svg.find(" id=\"gnuplot_", at)) != std::string::npos;)
    svg.erase(at, svg.find('"', at + 14) + 1 - at);
  replace_all(svg, "rgb(  0,   0,   0)", "var(--ink)");
  for (const char* attribute : {"color", "stroke", "fill"}) {
    replace_all(svg, fmt::format("{}=\"black\"", attribute),
                fmt::format("{}=\"var(--ink)\"", attribute));
    replace_all(svg, fmt::format("{}='black'", attribute),
                fmt::format("{}='var(--ink)'", attribute));
  }
  return without_empty_groups(svg);
}

}  // namespace

std::string gnuplot_string(const std::string& text) {
  std::string quoted = "'";
  for (const char c : text) {
    if (c == '\'') quoted += '\'';
    // In single quotes backslash and backquote are ordinary characters.
    quoted += static_cast<unsigned char>(c) < 0x20 ? ' ' : c;
  }
  return quoted + "'";
}

std::vector<std::string> draw_plots(const std::vector<Plot>& plots) {
  if (plots.empty()) return {};
  const ScratchFolder folder;
  std::string script;
  for (std::size_t i = 0; i < plots.size(); ++i)
    script += commands(plots[i], "svg dynamic noenhanced font 'system-ui,12' butt",
                       folder / std::to_string(i));
  draw(script, folder);
  std::vector<std::string> result;
  for (std::size_t i = 0; i < plots.size(); ++i)
    result.push_back(inline_svg(text_of(folder / std::to_string(i))));
  return result;
}

void draw_png(const Plot& plot, const std::filesystem::path& file) {
  draw(commands(plot, "pngcairo noenhanced font 'DejaVu Sans,10' background 'white'", file),
       ScratchFolder());
  std::error_code missing;
  if (!(std::filesystem::file_size(file, missing) > 0) || missing)
    throw PlotError(file.string() + ": gnuplot could not write it");
}

std::string plot_symbols() {
  return "<svg width=\"0\" height=\"0\" style=\"position:absolute\" aria-hidden=\"true\"><defs>"
         "<circle id='gpDot' r='0.5' stroke-width='0.5' stroke='currentColor'/>"
         "<circle id='gpPt5' stroke-width='0.3' stroke='currentColor' fill='none' r='1'/>"
         "<circle id='gpPt6' fill='currentColor' stroke='none' r='1'/>"
         "</defs></svg>\n";
}

}  // namespace bodyschema
