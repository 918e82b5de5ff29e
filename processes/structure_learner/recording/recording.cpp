#include "processes/structure_learner/recording/recording.h"

#include <fmt/format.h>
#include <sys/mman.h>
#include <unistd.h>
#include <zlib.h>

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <limits>
#include <map>
#include <memory>
#include <string_view>

#include "common/bus/convert.h"
#include "common/bus/event_log.h"
#include "common/config/rig.h"
#include "common/schema/retained_samples.h"
#include "common/text/text.h"
#include "processes/structure_learner/learn.h"

namespace bodyschema {
namespace {

/// [bytes] Unpacked, and of what has to be in memory: more is no recording of an arm.
constexpr std::size_t kLargestFile = 2'000'000'000;
/// Every event of an LCM log begins so.
constexpr std::string_view kLogMark = "\xED\xA1\xDA\x01";

/// A file or stdin ("-"), unpacked where gzip packed it.
class Input {
 public:
  Input(const std::filesystem::path& file, std::string name)
      : name_(std::move(name)),
        is_stdin_(file == "-"),
        file_(is_stdin_ ? gzdopen(dup(STDIN_FILENO), "rb") : gzopen(file.c_str(), "rb"), gzclose) {
    if (!file_) throw RecordingError(name_ + ": cannot be read: no such file or no permission");
  }

  /// At most `size` bytes, fewer only at the end. @throws RecordingError also where more than
  /// kLargestFile follow.
  std::string read(std::size_t size) {
    std::string content;
    std::vector<char> buffer(std::min<std::size_t>(size, 1 << 20));
    while (content.size() < size) {
      const std::size_t wanted = std::min(buffer.size(), size - content.size());
      const int count = gzread(file_.get(), buffer.data(), static_cast<unsigned>(wanted));
      int problem = Z_OK;
      const char* what = gzerror(file_.get(), &problem);
      if (count < 0 || (problem != Z_OK && problem != Z_STREAM_END)) {
        throw RecordingError(
            name_ + ": cannot be read: " + (problem == Z_ERRNO ? std::strerror(errno) : what));
      }
      if (count == 0) return content;
      content.append(buffer.data(), static_cast<std::size_t>(count));
    }
    if (size == kLargestFile) throw RecordingError(name_ + ": larger than 2 GB");
    return content;
  }

  /// Neither packed nor stdin. To be asked after the first read().
  bool is_plain_file() const { return !is_stdin_ && gzdirect(file_.get()) == 1; }

 private:
  const std::string name_;
  const bool is_stdin_;
  const std::unique_ptr<gzFile_s, int (*)(gzFile)> file_;
};

/// A file that is nowhere but in memory, for readers that want a path.
class InMemory {
 public:
  explicit InMemory(const std::string& content) : file_(memfd_create("recording", MFD_CLOEXEC)) {
    std::size_t written = 0;
    while (file_ >= 0 && written < content.size()) {
      const ssize_t count = ::write(file_, content.data() + written, content.size() - written);
      if (count < 0 && errno == EINTR) continue;
      if (count < 0) break;
      written += static_cast<std::size_t>(count);
    }
    if (written == content.size()) return;
    const std::string why = std::strerror(errno);
    if (file_ >= 0) ::close(file_);
    throw RecordingError("the recording cannot be unpacked: " + why);
  }
  ~InMemory() { ::close(file_); }
  InMemory(const InMemory&) = delete;
  InMemory& operator=(const InMemory&) = delete;

  std::string path() const { return "/proc/self/fd/" + std::to_string(file_); }

 private:
  const int file_;
};

Recording read_samples(const std::filesystem::path& file, const std::string& name) {
  Recording recording;
  recording.is_log = true;
  recording.has_noise = true;
  recording.measurement = measurement_of(name);
  LogReport report;
  const std::vector<sample_t> messages = read_log(file, kSample, &report);
  std::string cut;
  if (report.truncated_at_byte)
    cut = fmt::format("ends in the middle of an event at byte {}", *report.truncated_at_byte);
  if (messages.empty())
    throw RecordingError(fmt::format("{}: expected SAMPLE messages, found none in {}{}", name,
                                     counted(report.events, "event"),
                                     cut.empty() ? "" : "; it " + cut));
  if (!cut.empty())
    recording.damage =
        fmt::format("{}: {}; the {} SAMPLEs before it are used", name, cut, messages.size());
  // Samples are repeated, and sent again later where somebody missed them.
  std::map<std::int64_t, const sample_t*> by_index;
  for (const sample_t& message : messages) by_index.try_emplace(message.sample_index, &message);
  for (const auto& [index, message] : by_index) {
    ActionPoseSample& sample = recording.samples.emplace_back(from_message(*message));
    const ActionPoseSample& first = recording.samples.front();
    if (sample.calibration_id != first.calibration_id)
      throw RecordingError(
          fmt::format("{}: sample {} is of another calibration of the tags or lens than the first: "
                      "markers.yaml "
                      "or the camera's calibration changed in between; make a new run",
                      name, index));
    if (sample.action.size() != first.action.size())
      throw RecordingError(fmt::format("{}: sample {} has {} action signals, the first one {}",
                                       name, index, sample.action.size(), first.action.size()));
    sample.sample_index = std::ssize(recording.samples) - 1;
    recording.sights.push_back(tag_sights(*message));
  }
  add_mixture_hint(recording);
  const auto num_signals = recording.samples.front().action.size();
  const std::vector<body_schema_t> schemas = read_log(file, kBodySchema);
  recording.signals = !schemas.empty() && schemas.back().num_signals == num_signals
                          ? from_message(schemas.back()).signals
                          : observed_signals(recording.samples);
  return recording;
}

}  // namespace

std::vector<Signal> observed_signals(const std::vector<ActionPoseSample>& samples) {
  std::vector<Signal> signals;
  const Eigen::Index count = samples.empty() ? 0 : samples.front().action.size();
  for (Eigen::Index i = 0; i < count; ++i) {
    Signal& signal = signals.emplace_back();
    signal.name = "q" + std::to_string(i + 1);
    signal.lower = std::numeric_limits<double>::infinity();
    signal.upper = -signal.lower;
    for (const ActionPoseSample& sample : samples) {
      signal.lower = std::min(signal.lower, sample.action[i]);
      signal.upper = std::max(signal.upper, sample.action[i]);
    }
  }
  return signals;
}

std::vector<ActionPoseSample> Recording::training() const {
  std::vector<ActionPoseSample> result = retained(samples);
  std::erase_if(result, [](const auto& sample) { return !is_learned_from(sample); });
  return result;
}

std::vector<ActionPoseSample> samples_by_signals(const Recording& recording,
                                                 const std::vector<Signal>& signals) {
  const auto names = [](const std::vector<Signal>& of) {
    return of.empty() ? "none" : listed(of, [](const Signal& signal) { return signal.name; });
  };
  std::vector<ActionPoseSample> samples = recording.samples;
  if (recording.is_log) {
    if (recording.signals.size() == signals.size()) return samples;
    throw std::invalid_argument(fmt::format("the samples have {} action signals, the schema {}",
                                            recording.signals.size(), signals.size()));
  }
  std::vector<Eigen::Index> columns;
  for (const Signal& signal : signals) {
    const auto column = std::find_if(recording.signals.begin(), recording.signals.end(),
                                     [&](const Signal& s) { return s.name == signal.name; });
    if (column != recording.signals.end()) columns.push_back(column - recording.signals.begin());
  }
  if (columns.size() != signals.size() || signals.size() != recording.signals.size())
    throw std::invalid_argument(
        fmt::format("the signals of the samples are {}; those of the schema {}: name the columns "
                    "as the schema does",
                    names(recording.signals), names(signals)));
  for (ActionPoseSample& sample : samples) sample.action = sample.action(columns).eval();
  return samples;
}

Recording load_recording(const std::filesystem::path& file) {
  const std::string name = file == "-" ? "stdin" : file.string();
  if (std::filesystem::is_directory(file))
    throw RecordingError(name + ": expected a CSV file or an LCM log, found a folder");
  Input input(file, name);
  std::string content = input.read(kLogMark.size());
  if (content == kLogMark && input.is_plain_file()) return read_samples(file, name);
  content += input.read(kLargestFile);
  if (!content.starts_with(kLogMark)) return parse_csv(content, name);
  const InMemory unpacked(content);
  try {
    return read_samples(unpacked.path(), name);
  } catch (const RecordingError&) {
    throw;
  } catch (const std::runtime_error& error) {
    std::string what = error.what();
    const std::string path = unpacked.path();
    if (what.starts_with(path)) what.replace(0, path.size(), name);
    throw RecordingError(what);
  }
}

MeasurementModel measurement_of(const std::filesystem::path& log) {
  const std::filesystem::path rig = log.parent_path() / "config";
  if (std::filesystem::exists(rig / "noise.yaml")) return load_noise(rig).measurement;
  return {.systematic = kTagSystematic};
}

}  // namespace bodyschema
