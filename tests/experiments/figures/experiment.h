#pragma once

#include <filesystem>
#include <functional>
#include <string>
#include <vector>

namespace bodyschema::experiments {

/// Options of an experiment.
struct Setup {
  bool quick = false;  ///< few robots and sizes: seconds instead of minutes
  std::filesystem::path out;
  int jobs = 1;  ///< threads; results do not depend on it
  /// Reports on stderr the progress of a part of the experiment, 0 … 1.
  std::function<void(const std::string& part, double share)> progress;

  /// `full` robots, or fewer if quick.
  int robots(int full, int few) const { return quick ? few : full; }
};

/// A required result.
struct Must {
  std::string what;      ///< "2-DOF, free, N = 5: mean position < 1e-9 m"
  std::string measured;  ///< "5.0e-16 m"
  bool is_reached = false;
};

struct Findings {
  std::string markdown;  ///< tables, and how to read them
  std::vector<Must> musts;
};

struct Experiment {
  const char* name;
  const char* title;  ///< "Fig. 10: …"
  Findings (*run)(const Setup&);
};

/// One a source file.
Findings local_model(const Setup& setup);
Findings spherical(const Setup& setup);
Findings chain(const Setup& setup);
Findings occluded(const Setup& setup);
Findings two_dof_noise(const Setup& setup);
Findings two_dof_free(const Setup& setup);
Findings seven_dof(const Setup& setup);
Findings trees(const Setup& setup);
Findings adaptation(const Setup& setup);
Findings drift(const Setup& setup);
Findings false_alarms(const Setup& setup);

/// Calls work(0) … work(count − 1), on `setup.jobs` threads, in any order. Rethrows the first
/// exception of `work` when all have ended.
void for_each_robot(const Setup& setup, const std::string& part, int count,
                    const std::function<void(int)>& work);

/// A Markdown table.
class Table {
 public:
  explicit Table(std::vector<std::string> header) : rows_{std::move(header)} {}
  /// @throws std::logic_error if it has another number of cells than the header.
  void add(std::vector<std::string> row);
  std::string markdown() const;

 private:
  std::vector<std::vector<std::string>> rows_;
};

/// One of the curves of a panel.
struct Curve {
  std::string title = {};
  std::vector<double> x = {}, y = {};
  std::vector<double> error = {};  ///< bars y ± error, or a shaded band; empty: none
  int colour = 0;
  bool is_dashed = false;
  enum class Kind { kLine, kPoints, kBand } kind = Kind::kLine;
};

/// A value of the chapter's: a dashed line over the whole width.
struct Reference {
  std::string title;
  double y = 0;
};

struct Panel {
  std::string title = {}, x_label = {}, y_label = {};
  std::vector<Curve> curves = {};
  std::vector<Reference> references = {};
  bool log_x = false, log_y = false;
  std::vector<double> y_range = {};     ///< {low, high}; empty: gnuplot's choice
  /// Curves of equal values are drawn beside each other: each by this share of the width.
  double shift = 0;
};

/// Draws the panels, `columns` beside each other, into setup.out / file.
/// @throws PlotError if gnuplot cannot.
void draw(const Setup& setup, const std::string& file, const std::vector<Panel>& panels,
          int columns);

}  // namespace bodyschema::experiments
