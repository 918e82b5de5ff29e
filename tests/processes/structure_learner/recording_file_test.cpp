#include <gtest/gtest.h>
#include <unistd.h>
#include <zlib.h>

#include <algorithm>
#include <filesystem>
#include <fstream>
#include <random>
#include <sstream>

#include "common/bus/convert.h"
#include "common/bus/event_log.h"
#include "processes/structure_learner/recording/recording.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

std::string valid_csv() {
  test::Rng rng(42);
  const auto robot = test::chapter_robot("a", rng);
  std::stringstream text;
  test::write_csv(test::babble(robot, 6, {}, rng), text);
  return text.str();
}

// A file that was damaged on its way is read or refused, never anything else.
TEST(RecordingTest, TwentyThousandDamagedFilesAreReadOrRefused) {
  const std::string good = valid_csv();
  const std::string likely = "0123456789,.-+eE \r\n\tnaifxq\xEF\xBB\xBF\"";
  std::mt19937_64 rng(43);
  const auto below = [&](std::size_t n) { return static_cast<std::size_t>(rng() % n); };
  int num_read = 0, num_refused = 0;
  for (int n = 0; n < 20'000; ++n) {
    std::string text = good.substr(0, n % 3 == 0 ? below(good.size()) + 1 : good.size());
    for (std::size_t k = 0, count = 1 + below(4); k < count; ++k) {
      if (text.empty()) break;
      const std::size_t at = below(text.size());
      switch (below(5)) {
        case 0:
          text[at] = static_cast<char>(rng());
          break;
        case 1:
          text[at] = likely[below(likely.size())];
          break;
        case 2:
          text.insert(at, 1, likely[below(likely.size())]);
          break;
        case 3:
          text.erase(at, 1 + below(10));
          break;
        default:
          text.insert(at, text.substr(below(text.size()), below(80)));
      }
    }
    try {
      const Recording recording = parse_csv(text, "f.csv");
      ++num_read;
      ASSERT_FALSE(recording.samples.empty());
      for (const ActionPoseSample& sample : recording.samples) {
        ASSERT_EQ(sample.action.size(), static_cast<Eigen::Index>(recording.signals.size()));
        ASSERT_TRUE(sample.action.allFinite());
        ASSERT_FALSE(sample.parts.empty());
        int last = -1;
        for (const PartObservation& part : sample.parts) {
          ASSERT_GT(part.part, last);
          last = part.part;
          ASSERT_TRUE(part.X_CB.matrix().allFinite());
          ASSERT_LT(
              (part.X_CB.linear() * part.X_CB.linear().transpose() - Eigen::Matrix3d::Identity())
                  .norm(),
              1e-9);
        }
      }
    } catch (const RecordingError& error) {
      ++num_refused;
      // FILE:LINE:COLUMN: what
      int line = 0, column = 0;
      ASSERT_EQ(std::sscanf(error.what(), "f.csv:%d:%d: ", &line, &column), 2) << error.what();
      ASSERT_GE(line, 1);
      ASSERT_GE(column, 1);
    }
  }
  EXPECT_GT(num_read, 100);
  EXPECT_GT(num_refused, 1000);
}

/// A file of its own for every test.
class RecordingFileTest : public testing::Test {
 protected:
  RecordingFileTest() {
    const auto* test = testing::UnitTest::GetInstance()->current_test_info();
    file_ = std::filesystem::path(testing::TempDir()) /
            ("recording_" + std::to_string(getpid()) + test->name());
    std::filesystem::remove(file_);
    test::Rng rng(44);
    robot_ = test::chapter_robot("a", rng);
    const test::ObservationOptions options{
        .regime = test::Regime::kTag, .with_covariances = true, .with_other_hypothesis = true};
    for (ActionPoseSample& sample : test::babble(robot_, 12, options, rng)) {
      sample.sample_index += 5;
      sample.utime = 1000 * sample.sample_index;
      if (sample.sample_index % 5 == 4) sample.purpose = Purpose::kTest;
      samples_.push_back(sample);
    }
  }
  ~RecordingFileTest() override { std::filesystem::remove(file_); }

  std::string load_error() const {
    try {
      load_recording(file_);
    } catch (const std::runtime_error& error) {
      const std::string text = error.what();
      EXPECT_EQ(text.rfind(file_.string() + ":", 0), 0U) << text;
      return text.substr(std::min(text.size(), file_.string().size() + 1));
    }
    ADD_FAILURE() << "no error";
    return "";
  }

  std::filesystem::path file_;
  test::SyntheticRobot robot_;
  std::vector<ActionPoseSample> samples_;
};

TEST_F(RecordingFileTest, ALogOfSamplesIsReadWithInstantsCountedFromZero) {
  {
    LogAppender log(file_);
    for (const ActionPoseSample& sample : samples_) {
      if (sample.sample_index == samples_[3].sample_index) continue;  // its datagram was lost
      log.append(kSample, to_message(sample));
      log.append(kSample, to_message(sample));  // repeated on the bus
      log.append(kSample, to_message(samples_.front()));
    }
    log.append(kSample, to_message(samples_[3]));  // sent again on request
  }
  const Recording recording = load_recording(file_);
  EXPECT_TRUE(recording.is_log);
  EXPECT_TRUE(recording.has_noise);
  ASSERT_EQ(recording.samples.size(), 12U);
  for (std::size_t i = 0; i < samples_.size(); ++i) {
    const ActionPoseSample& read = recording.samples[i];
    EXPECT_EQ(read.sample_index, static_cast<std::int64_t>(i));
    EXPECT_EQ(read.utime, samples_[i].utime);
    EXPECT_EQ(read.purpose, samples_[i].purpose);
    EXPECT_EQ(read.action, samples_[i].action);
    ASSERT_EQ(read.parts.size(), samples_[i].parts.size());
    for (std::size_t k = 0; k < read.parts.size(); ++k) {
      const PartObservation &a = read.parts[k], &b = samples_[i].parts[k];
      EXPECT_EQ(a.part, b.part);
      EXPECT_LT((a.X_CB.matrix() - b.X_CB.matrix()).norm(), 1e-12);
      EXPECT_TRUE(a.covariance.isApprox(b.covariance, 1e-6)) << "beyond rounding to float";
      EXPECT_EQ(a.X_CB_other.has_value(), b.X_CB_other.has_value());
      EXPECT_EQ(a.error_ratio, b.error_ratio);
    }
  }
  ASSERT_EQ(recording.signals.size(), 2U);
  EXPECT_EQ(recording.signals[0].name, "q1");
}

TEST_F(RecordingFileTest, APositionAloneIsReadAndAMixtureWithPosesIsTold) {
  {
    LogAppender log(file_);
    sample_t alone = to_message(samples_[0]);
    part_observation_t& part = alone.parts[0];
    part.has_rotation = part.has_other = 0;
    part.error_ratio = 0;
    part.X_CB.rotation_wxyz[0] = 1;
    for (int i = 1; i < 4; ++i) part.X_CB.rotation_wxyz[i] = 0;
    part.X_CB_other = part.X_CB;
    std::fill(part.covariance + 6, part.covariance + 21, 0.0F);
    log.append(kSample, alone);
    log.append(kSample, to_message(samples_[1]));
  }
  const Recording recording = load_recording(file_);
  ASSERT_EQ(recording.samples[0].parts.size(), samples_[0].parts.size());
  const PartObservation& alone = recording.samples[0].parts[0];
  EXPECT_FALSE(alone.has_rotation);
  EXPECT_TRUE(alone.X_CB.linear().isIdentity(0));
  EXPECT_TRUE(alone.covariance.bottomRows<3>().isZero(0));
  EXPECT_GT(alone.covariance(0, 0), 0);
  ASSERT_EQ(recording.hints.size(), 1U);
  EXPECT_NE(recording.hints[0].find("1 of 2 observations are left out, which have no orientation"),
            std::string::npos)
      << recording.hints[0];
}

TEST_F(RecordingFileTest, OnlyTrainAndProbeAreLearnedFrom) {
  {
    LogAppender log(file_);
    const Purpose purposes[] = {Purpose::kTrain, Purpose::kTest, Purpose::kProbe,
                                Purpose::kControl};
    for (std::size_t i = 0; i < samples_.size(); ++i) {
      samples_[i].purpose = purposes[i % 4];
      log.append(kSample, to_message(samples_[i]));
    }
  }
  const Recording recording = load_recording(file_);
  EXPECT_EQ(recording.samples.size(), 12U);
  const auto training = recording.training();
  ASSERT_EQ(training.size(), 6U);
  for (const ActionPoseSample& sample : training) {
    EXPECT_TRUE(sample.purpose == Purpose::kTrain || sample.purpose == Purpose::kProbe);
    // Its number is that in the file, so that outliers can be found there.
    EXPECT_EQ(sample.action, recording.samples.at(sample.sample_index).action);
  }
}

TEST_F(RecordingFileTest, SignalNamesAndLimitsComeFromTheRecordedSchema) {
  BodySchema schema;
  schema.signals = {{"shoulder", -60, 60}, {"elbow", 0, 1}};
  {
    LogAppender log(file_);
    for (const ActionPoseSample& sample : samples_) log.append(kSample, to_message(sample));
    log.append(kBodySchema, to_message(schema));
  }
  const Recording recording = load_recording(file_);
  EXPECT_EQ(recording.signals[1].name, "elbow");
  EXPECT_EQ(recording.signals[0].lower, -60);
}

TEST_F(RecordingFileTest, ATornTailOfALogIsNoError) {
  {
    LogAppender log(file_);
    for (const ActionPoseSample& sample : samples_) log.append(kSample, to_message(sample));
  }
  std::filesystem::resize_file(file_, std::filesystem::file_size(file_) - 11);
  EXPECT_EQ(load_recording(file_).samples.size(), 11U);
}

TEST_F(RecordingFileTest, ALogThatIsOfNoUseIsRefused) {
  BodySchema schema;
  LogAppender(file_).append(kBodySchema, to_message(schema));
  EXPECT_EQ(load_error(), " expected SAMPLE messages, found none in 1 event");

  std::filesystem::remove(file_);
  {
    LogAppender log(file_);
    log.append(kSample, to_message(samples_[0]));
    sample_t longer = to_message(samples_[1]);
    set_array(longer.num_signals, longer.action, {1, 2, 3});
    log.append(kSample, longer);
  }
  EXPECT_EQ(load_error(), " sample 6 has 3 action signals, the first one 2");

  std::filesystem::remove(file_);
  {
    LogAppender log(file_);
    samples_[0].calibration_id = 1;
    samples_[1].calibration_id = 2;
    log.append(kSample, to_message(samples_[0]));
    log.append(kSample, to_message(samples_[1]));
  }
  EXPECT_EQ(load_error(),
            " sample 6 is of another calibration of the tags or lens than the first: markers.yaml "
            "or the camera's calibration changed in between; make a new run");

  std::filesystem::remove(file_);
  {
    LogAppender log(file_);
    log.append(kSample, to_message(samples_[0]));
    const std::vector<std::uint8_t> garbage(100, 7);
    log.append_bytes("SAMPLE", garbage, 1);
  }
  EXPECT_EQ(load_error().rfind(" event 1 (SAMPLE): ", 0), 0U);

  std::filesystem::resize_file(file_, 50);
  EXPECT_EQ(load_error(),
            " expected SAMPLE messages, found none in 0 events; it ends in the middle of an event "
            "at byte 0");
}

TEST_F(RecordingFileTest, AFileThatCannotBeReadIsNamed) {
  EXPECT_EQ(load_error(), " cannot be read: no such file or no permission");
  std::filesystem::create_directory(file_);
  EXPECT_EQ(load_error(), " expected a CSV file or an LCM log, found a folder");
}

/// As gzip writes it.
void write_packed(const std::filesystem::path& file, const std::string& text) {
  const gzFile packed = gzopen(file.c_str(), "wb");
  ASSERT_NE(packed, nullptr);
  ASSERT_EQ(gzwrite(packed, text.data(), static_cast<unsigned>(text.size())),
            static_cast<int>(text.size()));
  ASSERT_EQ(gzclose(packed), Z_OK);
}

TEST_F(RecordingFileTest, APackedCsvIsReadAndPointedInto) {
  write_packed(file_, valid_csv());
  EXPECT_EQ(load_recording(file_).samples.size(), 6U);
  write_packed(file_, "t,q1\n");
  EXPECT_EQ(load_error(), "1:3: expected a column 'part' after the action signals");
}

TEST_F(RecordingFileTest, APackedLogIsRead) {
  {
    LogAppender log(file_);
    for (const ActionPoseSample& sample : samples_) log.append(kSample, to_message(sample));
    const std::vector<std::uint8_t> garbage(100, 7);
    log.append_bytes("OTHER", garbage, 1);
  }
  std::ifstream stream(file_, std::ios::binary);
  const std::string bytes(std::istreambuf_iterator<char>(stream), {});
  write_packed(file_, bytes);
  const Recording recording = load_recording(file_);
  EXPECT_TRUE(recording.is_log);
  EXPECT_EQ(recording.samples.size(), samples_.size());
  // Its own name stands in errors, as of every file.
  write_packed(file_, bytes.substr(0, 100));
  EXPECT_EQ(load_error().rfind(" expected SAMPLE messages", 0), 0U);
}

TEST_F(RecordingFileTest, APackedFileThatIsDamagedIsRefused) {
  write_packed(file_, valid_csv());
  std::ifstream stream(file_, std::ios::binary);
  const std::string packed(std::istreambuf_iterator<char>(stream), {});
  std::mt19937_64 rng(46);
  for (int n = 0; n < 500; ++n) {
    std::string bytes = packed;
    if (n % 2 == 0) {
      bytes.resize(11 + rng() % (bytes.size() - 11));
    } else {
      // Behind the header, whose time stamp nobody checks.
      bytes[10 + rng() % (bytes.size() - 10)] ^= static_cast<char>(1 << rng() % 8);
    }
    std::ofstream(file_, std::ios::trunc | std::ios::binary) << bytes;
    try {
      load_recording(file_);
      ADD_FAILURE() << "damage " << n << " was not seen";
    } catch (const RecordingError& error) {
      EXPECT_EQ(std::string(error.what()).rfind(file_.string() + ":", 0), 0U) << error.what();
    }
  }
}

TEST_F(RecordingFileTest, FilesShorterThanALogsMarkAreReadAsCsv) {
  for (const std::string text : {"", "t", "t,q", "\xED\xA1\xDA"}) {
    std::ofstream(file_, std::ios::trunc) << text;
    EXPECT_EQ(load_error().rfind("1:", 0), 0U);
  }
}

}  // namespace
}  // namespace bodyschema
