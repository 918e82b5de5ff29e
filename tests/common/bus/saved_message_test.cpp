#include "common/bus/saved_message.h"

#include <gtest/gtest.h>

#include <fstream>

#include "tests/common/bus/bus_test_support.h"
#include "tests/lcmtypes/example_messages.h"

namespace bodyschema::test {
namespace {

class SavedMessageTest : public testing::Test {
 protected:
  std::optional<body_schema_t> load(const std::string& objection = "") {
    return SavedMessage(file_, kBodySchema).load([&](const body_schema_t&) { return objection; });
  }
  bool is_set_aside(int n = 1) const {
    return !std::filesystem::exists(file_) &&
           std::filesystem::exists(file_.string() + ".bad-" + std::to_string(n));
  }

  TemporaryFolder folder_;
  std::filesystem::path file_ = folder_ / "schema.lcmlog";
};

TEST_F(SavedMessageTest, WhatIsSavedIsLoaded) {
  EXPECT_FALSE(load());
  EXPECT_EQ(SavedMessage(file_, kBodySchema).save(example_body_schema()), "");
  const auto loaded = load();
  ASSERT_TRUE(loaded);
  EXPECT_EQ(encode(kBodySchema, *loaded), encode(kBodySchema, example_body_schema()));
}

TEST_F(SavedMessageTest, AFileThatCannotBeUsedIsSetAsideWhereverItIsCut) {
  SavedMessage(file_, kBodySchema).save(example_body_schema());
  const auto good = read_bytes(file_);
  int n = 0;
  for (std::size_t size = 0; size < good.size(); size += 37) {
    write_bytes(file_, {good.begin(), good.begin() + static_cast<std::ptrdiff_t>(size)});
    EXPECT_FALSE(load()) << size << " bytes";
    EXPECT_TRUE(is_set_aside(++n)) << size << " bytes";
  }
  auto damaged = good;
  damaged[good.size() / 2] ^= 0xFF;
  damaged[30] ^= 0xFF;
  write_bytes(file_, damaged);
  EXPECT_FALSE(load());
  EXPECT_TRUE(is_set_aside(++n));
  write_bytes(file_, {'x', 'y'});
  EXPECT_FALSE(load());
  EXPECT_TRUE(is_set_aside(++n));
}

TEST_F(SavedMessageTest, AnotherRigsIsSetAsideToo) {
  SavedMessage(file_, kBodySchema).save(example_body_schema());
  EXPECT_FALSE(load("it has 7 action signals"));
  EXPECT_TRUE(is_set_aside());
}

TEST_F(SavedMessageTest, TheSameIsWrittenOnceAndAFailureIsTriedAgain) {
  SavedMessage saved(folder_ / "later" / "schema.lcmlog", kBodySchema);
  EXPECT_NE(saved.save(example_body_schema()), "");
  std::filesystem::create_directory(folder_ / "later");
  EXPECT_EQ(saved.save(example_body_schema()), "");
  std::filesystem::remove(folder_ / "later" / "schema.lcmlog");
  EXPECT_EQ(saved.save(example_body_schema()), "");
  EXPECT_FALSE(std::filesystem::exists(folder_ / "later" / "schema.lcmlog"));
}

TEST_F(SavedMessageTest, WithoutAFileNothingIsKept) {
  SavedMessage saved("", kBodySchema);
  EXPECT_EQ(saved.save(example_body_schema()), "");
  EXPECT_FALSE(saved.load([](const body_schema_t&) { return ""; }));
}

}  // namespace
}  // namespace bodyschema::test
