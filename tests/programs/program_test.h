#pragma once

#include <gtest/gtest.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cstdlib>
#include <filesystem>
#include <nlohmann/json.hpp>
#include <string>

#include "tests/support/text_of.h"

namespace bodyschema::test {

using Json = nlohmann::json;

struct Outcome {
  int exit_code = 0;
  std::string out;
  std::string err;

  Json json() const {
    EXPECT_EQ(exit_code, 0) << err;
    const Json parsed = Json::parse(out, nullptr, false);
    EXPECT_FALSE(parsed.is_discarded()) << out;
    return parsed;
  }
};

/// Runs the program `bodyschema` in a folder of its own, whose name has a space.
class ProgramTest : public testing::Test {
 protected:
  ProgramTest() {
    const auto* test = testing::UnitTest::GetInstance()->current_test_info();
    folder_ = std::filesystem::path(testing::TempDir()) /
              ("bodyschema program " + std::to_string(getpid()) + test->name());
    std::filesystem::remove_all(folder_);
    std::filesystem::create_directories(folder_);
  }
  ~ProgramTest() override { std::filesystem::remove_all(folder_); }

  /// `arguments` as a shell reads them; `before`: shell text in front of the program, e.g.
  /// "cat s.csv | ".
  Outcome run(const std::string& arguments, const std::string& before = "") const {
    std::string command = "cd '" + folder_.string() + "' && " + before + "'" + BODYSCHEMA_PROGRAM +
                          "' " + arguments + " >stdout.txt 2>stderr.txt";
    if (before.find('|') == std::string::npos) command += " </dev/null";
    const int status = std::system(command.c_str());
    EXPECT_TRUE(WIFEXITED(status)) << command << " was killed";
    return {WIFEXITED(status) ? WEXITSTATUS(status) : -1, text_of(folder_ / "stdout.txt"),
            text_of(folder_ / "stderr.txt")};
  }
  /// It failed with a message that contains `what`, and printed no result.
  void expect_failure(const std::string& arguments, const std::string& what,
                      int exit_code = 0) const {
    const Outcome outcome = run(arguments);
    if (exit_code != 0) {
      EXPECT_EQ(outcome.exit_code, exit_code) << what;
    }
    EXPECT_TRUE(outcome.exit_code == 1 || outcome.exit_code == 2) << outcome.exit_code << what;
    EXPECT_EQ(outcome.out, "") << what;
    EXPECT_NE(outcome.err.find(what), std::string::npos) << outcome.err;
  }
  bool exists(const std::string& name) const { return std::filesystem::exists(folder_ / name); }

  std::filesystem::path folder_;
};

}  // namespace bodyschema::test
