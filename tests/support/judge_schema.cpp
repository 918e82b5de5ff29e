// judge_schema: judges a learned schema. Exit 0 if it is right; else prints why not. Reads the
// rig's ground truth, which no learner does.
//
//   judge_schema RIG_FOLDER SCHEMA_FILE [HIDDEN_PART…]

#include <algorithm>
#include <cstdio>
#include <exception>
#include <string>

#include "common/bus/convert.h"
#include "common/bus/event_log.h"
#include "tests/support/rig_truth.h"

using namespace bodyschema;

int main(int argc, char** argv) {
  if (argc < 3) {
    std::fprintf(stderr, "usage: judge_schema RIG_FOLDER SCHEMA_FILE [HIDDEN_PART...]\n");
    return 2;
  }
  try {
    const test::RigTruth truth(argv[1]);
    std::vector<int> observed = truth.parts();
    for (int i = 3; i < argc; ++i) std::erase(observed, std::stoi(argv[i]));
    const auto schemas = read_log(argv[2], kBodySchema);
    if (schemas.empty()) throw std::runtime_error("no BODY_SCHEMA in the file");
    const std::string objection = truth.objection(from_message(schemas.back()), observed);
    std::printf("%s\n", objection.empty() ? "right" : objection.c_str());
    return objection.empty() ? 0 : 1;
  } catch (const std::exception& error) {
    std::fprintf(stderr, "judge_schema: %s\n", error.what());
    return 2;
  }
}
