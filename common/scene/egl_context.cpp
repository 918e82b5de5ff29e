#include "common/scene/egl_context.h"

#include <EGL/egl.h>
#include <EGL/eglext.h>

#include <cstdio>
#include <stdexcept>
#include <string>

namespace bodyschema {
namespace {

std::runtime_error failure(const std::string& what) {
  char code[16];
  std::snprintf(code, sizeof code, "0x%x", static_cast<unsigned>(eglGetError()));
  return std::runtime_error("rendering without a display: " + what + " (EGL error " + code +
                            "); are the packages libegl1 and libgl1-mesa-dri installed?");
}

// One display for the whole process, never terminated: all contexts share it, and eglTerminate
// would end those that others still use.
EGLDisplay display() {
  static const EGLDisplay shared = [] {
    const auto get_display = reinterpret_cast<PFNEGLGETPLATFORMDISPLAYEXTPROC>(
        eglGetProcAddress("eglGetPlatformDisplayEXT"));
    if (!get_display) throw failure("eglGetPlatformDisplayEXT is missing");
    const EGLDisplay result =
        get_display(EGL_PLATFORM_SURFACELESS_MESA, EGL_DEFAULT_DISPLAY, nullptr);
    if (result == EGL_NO_DISPLAY) throw failure("there is no surfaceless display");
    if (!eglInitialize(result, nullptr, nullptr)) throw failure("eglInitialize failed");
    return result;
  }();
  return shared;
}

}  // namespace

EglContext::EglContext() {
  const EGLDisplay shared = display();
  // The API is a setting of the thread.
  if (!eglBindAPI(EGL_OPENGL_API)) throw failure("OpenGL is not supported");
  const EGLint wanted[] = {EGL_SURFACE_TYPE, EGL_PBUFFER_BIT, EGL_RENDERABLE_TYPE, EGL_OPENGL_BIT,
                           EGL_NONE};
  EGLConfig config = nullptr;
  EGLint count = 0;
  if (!eglChooseConfig(shared, wanted, &config, 1, &count) || count < 1) {
    throw failure("no suitable configuration");
  }
  context_ = eglCreateContext(shared, config, EGL_NO_CONTEXT, nullptr);
  if (context_ == EGL_NO_CONTEXT) throw failure("no context");
}

EglContext::~EglContext() {
  if (eglGetCurrentContext() == context_) {
    eglMakeCurrent(display(), EGL_NO_SURFACE, EGL_NO_SURFACE, EGL_NO_CONTEXT);
  }
  eglDestroyContext(display(), context_);
}

void EglContext::make_current() {
  if (eglGetCurrentContext() == context_) return;
  eglBindAPI(EGL_OPENGL_API);
  if (!eglMakeCurrent(display(), EGL_NO_SURFACE, EGL_NO_SURFACE, context_)) {
    throw failure("the context cannot be made current; is it in use by another thread?");
  }
}

}  // namespace bodyschema
