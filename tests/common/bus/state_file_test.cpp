#include "common/bus/state_file.h"

#include <gtest/gtest.h>

#include "tests/support/temporary_folder.h"
#include "tests/support/text_of.h"

namespace bodyschema {
namespace {

class StateFileTest : public testing::Test {
 protected:
  std::string content() const { return test::text_of(file_); }
  const test::TemporaryFolder temporary_;
  const std::filesystem::path folder_ = temporary_ / "state";
  const std::filesystem::path file_ = folder_ / "state.yaml";  // no folder yet: cannot be written
};

TEST_F(StateFileTest, WhatCannotBeSavedIsSaidAndTriedAgain) {
  StateFile state(file_, "");
  EXPECT_FALSE(state.save("a"));
  EXPECT_NE(state.problem().find("state.yaml"), std::string::npos) << state.problem();
  EXPECT_FALSE(state.retry());
  EXPECT_EQ(state.num_failed(), 2);
  EXPECT_FALSE(state.save("a"));  // only retry() tries the same again
  EXPECT_EQ(state.num_failed(), 2);
  std::filesystem::create_directory(folder_);
  EXPECT_TRUE(state.retry());
  EXPECT_EQ(state.problem(), "");
  EXPECT_EQ(content(), "a");
  EXPECT_TRUE(state.save("b"));
  EXPECT_EQ(content(), "b");
  EXPECT_EQ(state.num_failed(), 2);
}

TEST_F(StateFileTest, WhatIsOnDiskIsNotWrittenAgain) {
  StateFile state(file_, "a");
  EXPECT_TRUE(state.save("a"));
  EXPECT_FALSE(state.save("b"));
  EXPECT_TRUE(state.save("a"));  // as the file says
  EXPECT_EQ(state.problem(), "");
}

TEST_F(StateFileTest, WithoutAFileEverythingCountsAsSaved) {
  StateFile state("", "");
  EXPECT_TRUE(state.save("a"));
  EXPECT_TRUE(state.retry());
  EXPECT_EQ(state.num_failed(), 0);
}

}  // namespace
}  // namespace bodyschema
