#include "common/scene/mujoco.h"

#include <cstdio>
#include <stdexcept>
#include <string>

namespace bodyschema {
namespace {

// Unwinding through MuJoCo's C frames leaks what they hold, but a handler must not return, and the
// only alternative is to end the process.
[[noreturn]] void on_error(const char* text) {
  throw std::runtime_error(std::string("MuJoCo: ") + text);
}

void on_warning(const char* text) { std::fprintf(stderr, "MuJoCo warning: %s\n", text); }

}  // namespace

void install_mujoco_handlers() {
  mju_user_error = on_error;
  mju_user_warning = on_warning;
}

}  // namespace bodyschema
