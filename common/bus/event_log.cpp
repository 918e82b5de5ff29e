#include "common/bus/event_log.h"

#include <fcntl.h>
#include <spdlog/fmt/fmt.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <boost/crc.hpp>
#include <cerrno>
#include <cstring>
#include <random>
#include <system_error>
#include <utility>

namespace bodyschema {
namespace {

constexpr std::uint32_t kSync = 0xEDA1DA01;
constexpr std::array<std::uint8_t, 4> kSyncBytes = {0xED, 0xA1, 0xDA, 0x01};
constexpr std::size_t kHeaderSize = 28;
/// Offsets of the checksum, and of the first byte that it covers.
constexpr std::size_t kChecksum = 4, kChecked = 8;
/// lcm-logplayer refuses longer names.
constexpr std::int32_t kLongestChannel = 999;

template <class Integer>
Integer read_big_endian(const std::uint8_t* bytes) {
  std::make_unsigned_t<Integer> value = 0;
  for (std::size_t i = 0; i < sizeof(Integer); ++i) {
    value = static_cast<std::make_unsigned_t<Integer>>((value << 8) | bytes[i]);
  }
  return static_cast<Integer>(value);
}

template <class Integer>
void append_big_endian(std::vector<std::uint8_t>& bytes, Integer value) {
  for (int shift = 8 * (static_cast<int>(sizeof(Integer)) - 1); shift >= 0; shift -= 8) {
    bytes.push_back(static_cast<std::uint8_t>(static_cast<std::uint64_t>(value) >> shift));
  }
}

using Crc32c = boost::crc_optimal<32, 0x1EDC6F41, 0xFFFFFFFF, 0xFFFFFFFF, true, true>;

/// Never 0, which means "no checksum".
std::uint32_t checksum_of(std::span<const std::uint8_t> header, const std::string& channel,
                          std::span<const std::uint8_t> data) {
  Crc32c crc;
  crc.process_bytes(header.data() + kChecked, kHeaderSize - kChecked);
  crc.process_bytes(channel.data(), channel.size());
  crc.process_bytes(data.data(), data.size());
  return crc.checksum() == 0 ? 0xFFFFFFFF : crc.checksum();
}

std::runtime_error file_error(const std::filesystem::path& path, const std::string& what) {
  return std::runtime_error(fmt::format("{}: {}", path.string(), what));
}

std::runtime_error system_error(const std::filesystem::path& path, const std::string& what) {
  return file_error(path, fmt::format("{}: {}", what, std::generic_category().message(errno)));
}

/// Closes on the way out of an exception.
class Descriptor {
 public:
  explicit Descriptor(int descriptor) : descriptor_(descriptor) {}
  ~Descriptor() {
    if (descriptor_ >= 0) ::close(descriptor_);
  }
  Descriptor(const Descriptor&) = delete;
  Descriptor& operator=(const Descriptor&) = delete;
  int get() const { return descriptor_; }
  int release() { return std::exchange(descriptor_, -1); }

 private:
  int descriptor_;
};

/// 0, or errno.
int write_all(int file, std::span<const std::uint8_t> bytes) {
  while (!bytes.empty()) {
    const ssize_t written = ::write(file, bytes.data(), bytes.size());
    if (written < 0) {
      if (errno == EINTR) continue;
      return errno;
    }
    bytes = bytes.subspan(static_cast<std::size_t>(written));
  }
  return 0;
}

void sync_folder(const std::filesystem::path& path) {
  const std::filesystem::path folder = path.has_parent_path() ? path.parent_path() : ".";
  const Descriptor descriptor(::open(folder.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC));
  // Some file systems cannot sync a folder (EINVAL); then there is nothing more to be done.
  if (descriptor.get() < 0 || (::fsync(descriptor.get()) != 0 && errno != EINVAL)) {
    throw system_error(folder, "cannot sync the folder");
  }
}

}  // namespace

std::string describe_malformed(const void* data, std::size_t size, const char* type_name,
                               std::int64_t fingerprint) {
  if (size < 8) return fmt::format("{} bytes are no message", size);
  const auto found = read_big_endian<std::int64_t>(static_cast<const std::uint8_t*>(data));
  if (found != fingerprint) {
    return fmt::format(
        "fingerprint {:016x} is not {}'s ({:016x}): another type, or a program built "
        "from other message definitions",
        static_cast<std::uint64_t>(found), type_name, static_cast<std::uint64_t>(fingerprint));
  }
  return fmt::format("{} bytes do not decode as {}: cut off, too long or damaged", size, type_name);
}

bool EventJoiner::join(LogEvent* event) {
  if (!is_piece(event->data)) return true;
  std::string problem;
  auto whole = joiners_[event->channel].add(event->data, &problem);
  if (!problem.empty()) ++num_bad_;
  if (!whole) return false;
  event->data = *std::move(whole);
  return true;
}

std::int64_t EventJoiner::num_incomplete() const {
  std::int64_t sum = num_bad_;
  for (const auto& [channel, joiner] : joiners_) sum += joiner.num_lost() + joiner.num_unfinished();
  return sum;
}

LogReader::LogReader(const std::filesystem::path& path, OnDamage on_damage, std::int64_t from_byte,
                     Pieces pieces)
    : path_(path), on_damage_(on_damage), pieces_(pieces), position_(from_byte) {
  std::error_code error;
  if (std::filesystem::is_directory(path, error)) throw file_error(path, "is a folder, not a log");
  if (std::filesystem::exists(path, error) && !std::filesystem::is_regular_file(path, error))
    throw file_error(path, "is no file but a device or a pipe, in which a reader cannot go back");
  file_ = std::fopen(path.c_str(), "rbe");
  if (file_ == nullptr) throw system_error(path, "cannot read the log");
  if (from_byte > 0 && ::fseeko(file_, from_byte, SEEK_SET) != 0) {
    std::fclose(file_);
    throw system_error(path, "cannot read the log");
  }
}

LogReader::~LogReader() { std::fclose(file_); }

void LogReader::seek(std::int64_t position) {
  if (::fseeko(file_, position, SEEK_SET) != 0) throw system_error(path_, "cannot read the log");
  position_ = position;
}

bool LogReader::next() {
  bool has_event = next_recorded();
  while (has_event && pieces_ == Pieces::kJoin && !joiner_.join(&event_))
    has_event = next_recorded();
  report_.incomplete = joiner_.num_incomplete();
  return has_event;
}

bool LogReader::next_recorded() {
  if (report_.truncated_at_byte) return false;
  for (;;) {
    const Found found = read_event(true);
    if (std::ferror(file_) != 0) throw system_error(path_, "cannot read the log");
    if (found == Found::kEvent || found == Found::kEnd) return found == Found::kEvent;
    // An event that reaches beyond the end is a torn tail, unless others follow: then its length is
    // damaged.
    const std::optional<std::int64_t> next = find_event(position_ + 1);
    if (found == Found::kTruncated && !next) {
      report_.truncated_at_byte = position_;
      return false;
    }
    // A wrong checksum says that it is a log all the same.
    const bool is_log = position_ > 0 || next || found == Found::kWrongChecksum;
    const std::string damage =
        found == Found::kWrongChecksum
            ? fmt::format("is damaged: the event at byte {} is not what was written (its checksum)",
                          position_)
        : is_log ? fmt::format("is damaged: no event begins at byte {}", position_)
                 : "is not an LCM log (its first bytes are no event)";
    if (!report_.damaged_at_byte) report_.damage = damage;
    if (on_damage_ == OnDamage::kThrow || !is_log) throw file_error(path_, damage);
    std::error_code error;
    const std::int64_t end =
        next.value_or(static_cast<std::int64_t>(std::filesystem::file_size(path_, error)));
    if (!report_.damaged_at_byte) report_.damaged_at_byte = position_;
    report_.damaged_bytes += end - position_;
    seek(end);
  }
}

/// If no event follows, the next event or the length of this one is damaged; a damaged length
/// would swallow whole events. A checksum decides it.
LogReader::Found LogReader::look_behind(std::int64_t end) {
  std::array<std::uint8_t, 4> next{};
  if (::fseeko(file_, end, SEEK_SET) != 0) return Found::kTruncated;
  const std::size_t next_read = std::fread(next.data(), 1, next.size(), file_);
  if (!std::equal(next.begin(), next.begin() + next_read, kSyncBytes.begin())) {
    const auto inside = find_event(position_ + static_cast<std::int64_t>(kHeaderSize));
    if (inside && *inside < end) return Found::kDamaged;
  }
  if (::fseeko(file_, position_ + static_cast<std::int64_t>(kHeaderSize), SEEK_SET) != 0) {
    return Found::kTruncated;
  }
  return Found::kEvent;
}

LogReader::Found LogReader::read_event(bool looks_behind) {
  std::array<std::uint8_t, kHeaderSize> header;
  const std::size_t header_read = std::fread(header.data(), 1, header.size(), file_);
  if (header_read == 0) return Found::kEnd;

  // A power cut leaves zeros up to the end in place of an event that was never written back.
  if (std::all_of(header.begin(), header.begin() + header_read, [](auto b) { return b == 0; })) {
    int byte = 0;
    while ((byte = std::fgetc(file_)) == 0) {
    }
    return byte == EOF && position_ > 0 ? Found::kTruncated : Found::kDamaged;
  }
  const std::size_t comparable = std::min(header_read, kSyncBytes.size());
  if (!std::equal(kSyncBytes.begin(), kSyncBytes.begin() + comparable, header.begin())) {
    return Found::kDamaged;
  }
  if (header_read < header.size()) return Found::kTruncated;

  const auto channel_size = read_big_endian<std::int32_t>(&header[20]);
  const auto data_size = read_big_endian<std::int32_t>(&header[24]);
  if (channel_size < 1 || channel_size > kLongestChannel || data_size < 0 ||
      static_cast<std::size_t>(data_size) > kLargestMessage) {
    return Found::kDamaged;
  }
  // A length beyond the end of the file must be detected before it is allocated.
  std::error_code error;
  const auto file_size = static_cast<std::int64_t>(std::filesystem::file_size(path_, error));
  const std::int64_t end =
      position_ + static_cast<std::int64_t>(kHeaderSize) + channel_size + data_size;
  if (!error && end > file_size) return Found::kTruncated;

  const auto event_number = read_big_endian<std::uint64_t>(&header[kChecksum]);
  const auto checksum = static_cast<std::uint32_t>(event_number >> 32);
  if (looks_behind && checksum == 0 && end < file_size) {
    if (const Found behind = look_behind(end); behind != Found::kEvent) return behind;
  }

  event_.event_number = static_cast<std::uint32_t>(event_number);
  event_.event_utime = read_big_endian<std::int64_t>(&header[12]);
  event_.channel.resize(static_cast<std::size_t>(channel_size));
  event_.data.resize(static_cast<std::size_t>(data_size));
  if (std::fread(event_.channel.data(), 1, event_.channel.size(), file_) != event_.channel.size() ||
      std::fread(event_.data.data(), 1, event_.data.size(), file_) != event_.data.size()) {
    return Found::kTruncated;
  }
  if (checksum != 0 && checksum != checksum_of(header, event_.channel, event_.data)) {
    return Found::kWrongChecksum;
  }
  position_ = end;
  ++report_.events;
  return Found::kEvent;
}

/// The next position at or after `from` where a whole event can be read.
std::optional<std::int64_t> LogReader::find_event(std::int64_t from) {
  const std::int64_t position = position_;
  const std::int64_t events = report_.events;
  std::optional<std::int64_t> found;
  std::clearerr(file_);
  seek(from);
  std::size_t matched = 0;
  for (int byte = 0; !found && (byte = std::fgetc(file_)) != EOF;) {
    if (byte == kSyncBytes[matched]) {
      ++matched;
    } else {
      matched = byte == kSyncBytes[0] ? 1 : 0;
    }
    if (matched < kSyncBytes.size()) continue;
    matched = 0;
    const std::int64_t after_sync = ::ftello(file_);
    const std::int64_t candidate = after_sync - static_cast<std::int64_t>(kSyncBytes.size());
    seek(candidate);
    if (read_event(false) == Found::kEvent) found = candidate;
    seek(after_sync);
  }
  report_.events = events;
  seek(position);
  return found;
}

LogReport for_each_event(const std::filesystem::path& path,
                         const std::function<void(const LogEvent&)>& visit, OnDamage on_damage) {
  LogReader reader(path, on_damage);
  while (reader.next()) visit(reader.event());
  return reader.report();
}

LogLock::LogLock(const std::filesystem::path& path) {
  for (;;) {
    Descriptor file(::open(path.c_str(), O_RDWR | O_CREAT | O_CLOEXEC, 0666));
    if (file.get() < 0) throw system_error(path, "cannot write the log");
    // Released by the kernel when the process dies, however it dies.
    if (::flock(file.get(), LOCK_EX | LOCK_NB) != 0) {
      throw file_error(path, "is being written by another process");
    }
    // The file may have been replaced between the two calls: then the lock is of no use.
    struct stat locked {
    }, named{};
    if (::fstat(file.get(), &locked) != 0) throw system_error(path, "cannot write the log");
    if (::stat(path.c_str(), &named) != 0 || locked.st_dev != named.st_dev ||
        locked.st_ino != named.st_ino) {
      continue;
    }
    file_ = file.release();
    return;
  }
}

LogLock::~LogLock() {
  if (file_ >= 0) ::close(file_);
}

int LogLock::release() { return std::exchange(file_, -1); }

LogAppender::LogAppender(const std::filesystem::path& path, Mode mode, Durability durability)
    : path_(path), durability_(durability) {
  Descriptor file(LogLock(path).release());
  if (mode == Mode::kAppend) {
    LogReader reader(path);
    while (reader.next()) next_number_ = reader.event().event_number + 1;
    found_ = reader.report();
    end_ = reader.position();
  }
  struct stat status {};
  const bool is_regular = ::fstat(file.get(), &status) == 0 && S_ISREG(status.st_mode);
  if (is_regular &&
      (::ftruncate(file.get(), end_) != 0 || ::lseek(file.get(), end_, SEEK_SET) != end_)) {
    throw system_error(path, "cannot cut off the torn tail");
  }
  if (is_regular && durability_ == Durability::kToDisk) {
    if (::fsync(file.get()) != 0) throw system_error(path, "cannot sync");
    sync_folder(path);
  }
  file_ = file.release();
}

LogAppender::~LogAppender() { ::close(file_); }

void LogAppender::append_bytes(const std::string& channel, std::span<const std::uint8_t> data,
                               std::int64_t event_utime) {
  const std::vector<std::uint8_t> event = encode_event(channel, data, event_utime, next_number_);
  int error = write_all(file_, event);
  if (error == 0 && durability_ == Durability::kToDisk && ::fdatasync(file_) != 0) error = errno;
  if (error != 0) {
    // Half an event would hide everything that is appended after it.
    if (::ftruncate(file_, end_) == 0) ::lseek(file_, end_, SEEK_SET);
    errno = error;
    throw system_error(path_, "cannot append to the log");
  }
  end_ += static_cast<std::int64_t>(event.size());
  ++next_number_;
}

std::uint32_t crc32c(std::span<const std::uint8_t> bytes) {
  Crc32c crc;
  crc.process_bytes(bytes.data(), bytes.size());
  return crc.checksum();
}

std::vector<std::uint8_t> encode_event(const std::string& channel,
                                       std::span<const std::uint8_t> data, std::int64_t event_utime,
                                       std::int64_t event_number) {
  if (channel.empty() || channel.size() > static_cast<std::size_t>(kLongestChannel) ||
      data.size() > kLargestMessage) {
    throw std::logic_error(
        "an event needs a channel name of 1 to 999 bytes and at most 2^28 bytes");
  }
  std::vector<std::uint8_t> bytes;
  bytes.reserve(kHeaderSize + channel.size() + data.size());
  append_big_endian(bytes, kSync);
  append_big_endian(bytes, std::uint32_t{0});  // the checksum's place
  append_big_endian(bytes, static_cast<std::uint32_t>(event_number));
  append_big_endian(bytes, event_utime);
  append_big_endian(bytes, static_cast<std::int32_t>(channel.size()));
  append_big_endian(bytes, static_cast<std::int32_t>(data.size()));
  const std::uint32_t checksum = checksum_of(bytes, channel, data);
  for (std::size_t i = 0; i < sizeof checksum; ++i) {
    bytes[kChecksum + i] = static_cast<std::uint8_t>(checksum >> (24 - 8 * i));
  }
  bytes.insert(bytes.end(), channel.begin(), channel.end());
  bytes.insert(bytes.end(), data.begin(), data.end());
  return bytes;
}

void write_file_atomically(const std::filesystem::path& given, const std::string& text) {
  constexpr int kMaxLinks = 40;  // as Linux has it
  std::error_code none;
  std::filesystem::path path = given;
  for (int hop = 0; hop < kMaxLinks && std::filesystem::is_symlink(path, none); ++hop)
    path = path.parent_path() / std::filesystem::read_symlink(path);
  if (std::filesystem::exists(path, none) && !std::filesystem::is_regular_file(path, none)) {
    errno = EINVAL;
    throw system_error(path, "expected a regular file");
  }
  // Not named after the process: process ids repeat in containers and namespaces.
  std::random_device random;
  std::filesystem::path temporary;
  int descriptor = -1;
  for (int attempt = 0; attempt < 100 && descriptor < 0; ++attempt) {
    temporary = path;
    temporary.replace_filename(fmt::format(".{}.{:08x}", path.filename().string(), random()));
    descriptor = ::open(temporary.c_str(), O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, 0666);
    if (descriptor < 0 && errno != EEXIST) break;
  }
  const Descriptor file(descriptor);
  if (file.get() < 0) throw system_error(path, "cannot write beside it");
  const auto* bytes = reinterpret_cast<const std::uint8_t*>(text.data());
  int error = write_all(file.get(), {bytes, text.size()});
  if (error == 0 && ::fsync(file.get()) != 0) error = errno;
  if (error == 0 && ::rename(temporary.c_str(), path.c_str()) != 0) error = errno;
  if (error != 0) {
    ::unlink(temporary.c_str());
    errno = error;
    throw system_error(path, "cannot replace the file");
  }
  sync_folder(path);
}

std::filesystem::path copy_aside(const std::filesystem::path& path) {
  for (int n = 1;; ++n) {
    std::filesystem::path aside = path;
    aside += fmt::format(".bad-{}", n);
    std::error_code error;
    if (std::filesystem::copy_file(path, aside, error)) return aside;
    if (error != std::errc::file_exists) {
      throw file_error(path, fmt::format("cannot be copied to {}: {}", aside.filename().string(),
                                         error.message()));
    }
  }
}

}  // namespace bodyschema
