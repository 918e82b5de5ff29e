#include "tests/experiments/figures/experiment.h"

#include <fmt/format.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <exception>
#include <mutex>
#include <stdexcept>
#include <thread>

#include "common/plot/plot.h"

namespace bodyschema::experiments {
namespace {

constexpr int kPanelWidth = 560, kPanelHeight = 460;
const char* const kColours[] = {"#c0504d", "#2f6db3", "#4a9a5a", "#8a63b0", "#d08a2e", "#3f9c9c"};

std::string number(double value) {
  return std::isfinite(value) ? fmt::format("{:.8g}", value) : "NaN";
}

/// What `plot` draws of a block of data.
std::vector<std::string> plots_of(const Curve& curve, const std::string& block) {
  const std::string style =
      fmt::format("lc rgb '{}'", kColours[curve.colour % std::size(kColours)]);
  std::vector<std::string> plots;
  const std::string title =
      curve.title.empty() ? "notitle" : "title " + gnuplot_string(curve.title);
  switch (curve.kind) {
    case Curve::Kind::kBand:
      plots.push_back(
          fmt::format("{} using 1:($2-$3):($2+$3) with filledcurves fs transparent solid 0.18 "
                      "noborder {} notitle",
                      block, style));
      plots.push_back(fmt::format("{} using 1:2 with lines lw 2 {} {}", block, style, title));
      break;
    case Curve::Kind::kLine:
      if (!curve.error.empty())
        plots.push_back(fmt::format("{} using 1:2:3 with yerrorbars pt 7 ps 0.1 lw 1 {} notitle",
                                    block, style));
      // The rings of the dashed are seen around the dots of the others.
      plots.push_back(fmt::format("{} using 1:2 with linespoints pt {} ps {} lw 2 dt {} {} {}",
                                  block, curve.is_dashed ? 6 : 7, curve.is_dashed ? 1.2 : 0.7,
                                  curve.is_dashed ? 3 : 1, style, title));
      break;
    case Curve::Kind::kPoints:
      plots.push_back(
          fmt::format("{} using 1:2 with points pt 7 ps 0.6 {} {}", block, style, title));
      break;
  }
  return plots;
}

std::string script_of(const Panel& panel, int index) {
  double low = INFINITY, high = -INFINITY;
  for (const Curve& curve : panel.curves) {
    for (const double x : curve.x) {
      low = std::min(low, x);
      high = std::max(high, x);
    }
  }
  const auto shifted = [&](double x, std::size_t curve) {
    const double by = panel.shift * (static_cast<double>(curve) -
                                     0.5 * (static_cast<double>(panel.curves.size()) - 1));
    return panel.log_x ? x * std::pow(high / low, by) : x + (high - low) * by;
  };
  std::string data, curves;
  const auto also = [&curves](const std::string& what) {
    curves += (curves.empty() ? "plot " : ", \\\n     ") + what;
  };
  for (std::size_t c = 0; c < panel.curves.size(); ++c) {
    const Curve& curve = panel.curves[c];
    const std::string block = fmt::format("$data_{}_{}", index, c);
    data += block + " << END\n";
    for (std::size_t n = 0; n < curve.x.size(); ++n)
      data += fmt::format("{} {} {}\n", number(shifted(curve.x[n], c)), number(curve.y[n]),
                          number(curve.error.empty() ? 0 : curve.error[n]));
    data += "END\n";
    for (const std::string& plot : plots_of(curve, block)) also(plot);
  }
  int dash = 2;
  for (const Reference& reference : panel.references)
    also(fmt::format("{} with lines dt {} lw 1.5 lc rgb '#333333' title {}", number(reference.y),
                     dash++, gnuplot_string(reference.title)));
  std::string result = data;
  result += "set title " + gnuplot_string(panel.title) + "\n";
  result += "set xlabel " + gnuplot_string(panel.x_label) + " offset 0,0.75\n";
  result += "set ylabel " + gnuplot_string(panel.y_label) + "\n";
  const double margin = panel.log_x ? 0 : 0.03 * (high - low), factor = panel.log_x ? 1.1 : 1;
  result += fmt::format("set xrange [{}:{}]\n", number(low / factor - margin),
                        number(high * factor + margin));
  result += panel.log_x ? "set logscale x\nset xtics (3, 5, 8, 10, 15, 20, 30, 50, 100, 200)\n"
                        : "unset logscale x\nset xtics autofreq\n";
  result += panel.log_y ? "set logscale y\n" : "unset logscale y\n";
  if (panel.y_range.size() == 2)
    result +=
        fmt::format("set yrange [{}:{}]\n", number(panel.y_range[0]), number(panel.y_range[1]));
  else
    result += "set yrange [*:*]\n";
  result += "set key below maxcols 2 spacing 1.1 samplen 3\n";
  return result + curves + "\n";
}

}  // namespace

void for_each_robot(const Setup& setup, const std::string& part, int count,
                    const std::function<void(int)>& work) {
  std::atomic<int> next = 0;
  int done = 0;
  std::exception_ptr failure;
  std::mutex mutex;
  const auto run = [&] {
    for (int n = next++; n < count; n = next++) {
      std::exception_ptr thrown;
      try {
        work(n);
      } catch (...) {
        thrown = std::current_exception();
      }
      const std::lock_guard lock(mutex);
      if (thrown && !failure) {
        failure = thrown;
        next = count;
      }
      if (setup.progress) setup.progress(part, static_cast<double>(++done) / count);
    }
  };
  std::vector<std::thread> threads;
  for (int n = 1; n < setup.jobs; ++n) threads.emplace_back(run);
  run();
  for (std::thread& thread : threads) thread.join();
  if (failure) std::rethrow_exception(failure);
}

void Table::add(std::vector<std::string> row) {
  if (row.size() != rows_.front().size()) throw std::logic_error("table: a row of another width");
  rows_.push_back(std::move(row));
}

std::string Table::markdown() const {
  std::string result;
  for (std::size_t n = 0; n < rows_.size(); ++n) {
    result += "|";
    for (const std::string& cell : rows_[n]) result += " " + cell + " |";
    result += "\n";
    if (n > 0) continue;
    for (std::size_t c = 0; c < rows_[0].size(); ++c) result += c == 0 ? "| --- |" : " --- |";
    result += "\n";
  }
  return result;
}

void draw(const Setup& setup, const std::string& file, const std::vector<Panel>& panels,
          int columns) {
  const int rows = (static_cast<int>(panels.size()) + columns - 1) / columns;
  Plot plot;
  plot.width_px = kPanelWidth * columns;
  plot.height_px = kPanelHeight * rows;
  plot.script = fmt::format("set multiplot layout {},{}\n", rows, columns);
  for (std::size_t n = 0; n < panels.size(); ++n)
    plot.script += script_of(panels[n], static_cast<int>(n));
  plot.script += "unset multiplot\n";
  draw_png(plot, setup.out / file);
}

}  // namespace bodyschema::experiments
