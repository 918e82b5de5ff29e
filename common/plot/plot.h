#pragma once

#include <filesystem>
#include <stdexcept>
#include <string>
#include <vector>

namespace bodyschema {

/// gnuplot is missing or refused a script.
class PlotError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// What gnuplot is to draw into a picture of its own: commands that follow `set terminal`.
struct Plot {
  int width_px = 760;
  int height_px = 240;
  std::string script;
};

/// The plots as <svg> elements for one HTML page, drawn by one gnuplot. What gnuplot draws in black
/// has the colour of the page's text, var(--ink), so that it suits light and dark. The elements
/// refer to the symbols in plot_symbols(), which the page must hold once.
/// @throws PlotError with what to install.
std::vector<std::string> draw_plots(const std::vector<Plot>& plots);

/// Draws `plot` into `file`, a PNG on white.
/// @throws PlotError with what to install, or if the file cannot be written.
void draw_png(const Plot& plot, const std::filesystem::path& file);

/// The shapes of gnuplot's points.
std::string plot_symbols();

/// `text` as a gnuplot string that is only a string: no quote, command substitution or control
/// character of it means anything.
std::string gnuplot_string(const std::string& text);

}  // namespace bodyschema
