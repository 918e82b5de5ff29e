#include "common/scene/mujoco.h"

#include <cstdio>
#include <cstdlib>

namespace bodyschema {
namespace {

// MuJoCo calls this in the middle of its C code, with its stack half used: it must not return, and
// an exception must not unwind through C. So it ends the process.
[[noreturn]] void on_error(const char* text) {
  std::fprintf(stderr, "MuJoCo cannot go on and ends the process: %s\n", text);
  std::_Exit(1);
}

void on_warning(const char* text) { std::fprintf(stderr, "MuJoCo warning: %s\n", text); }

}  // namespace

void install_mujoco_handlers() {
  mju_user_error = on_error;
  mju_user_warning = on_warning;
}

}  // namespace bodyschema
