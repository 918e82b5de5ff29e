#include "processes/console/report/template.h"

#include <gtest/gtest.h>

namespace bodyschema {
namespace {

TEST(EscapeTest, LeavesNoMarkup) {
  EXPECT_EQ(escape_html("<a href='x'>\"&\x01</a>"),
            "&lt;a href=&#39;x&#39;&gt;&quot;&amp; &lt;/a&gt;");
}

TEST(TemplateTest, ValuesAreEscapedUnlessTheyAreRaw) {
  EXPECT_EQ(render("{{x}} {{{x}}} {{n}}{{none}}", {{"x", "<&>"}, {"n", 3}}), "&lt;&amp;&gt; <&> 3");
}

TEST(TemplateTest, SectionsStandForEachOfAListOnceOrInsteadOfNothing) {
  const Json data = {{"list", {{{"x", 1}}, {{"x", 2}}}}, {"yes", true}, {"zero", 0}, {"x", 9}};
  EXPECT_EQ(render("{{#list}}{{x}},{{y}}{{/list}}{{x}}", data), "1,2,9");
  EXPECT_EQ(render("{{#yes}}a{{/yes}}{{^yes}}b{{/yes}}{{#zero}}{{.}}{{/zero}}", data), "a0");
  for (const Json& nothing : {Json(), Json(false), Json(""), Json::array()})
    EXPECT_EQ(render("{{#x}}a{{/x}}{{^x}}b{{/x}}", {{"x", nothing}}), "b");
}

TEST(TemplateTest, InnerSectionsComeFirst) {
  EXPECT_EQ(render("{{#a}}{{x}}{{z}}{{#b}}{{x}}{{/b}}{{/a}}",
                   {{"z", "!"}, {"a", {{"x", 1}, {"b", {{"x", 2}}}}}}),
            "1!2");
}

TEST(TemplateTest, WhatDoesNotEndIsAnError) {
  EXPECT_THROW(render("{{x", {}), std::logic_error);
  EXPECT_THROW(render("{{#x}}", {}), std::logic_error);
}

}  // namespace
}  // namespace bodyschema
