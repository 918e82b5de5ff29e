#pragma once

#include <memory>

namespace bodyschema {

/// An OpenGL context without window or display server (EGL, surfaceless). A context is current in
/// one thread at a time.
class EglContext {
 public:
  /// @throws std::runtime_error that says which package is missing.
  EglContext();
  ~EglContext();
  EglContext(const EglContext&) = delete;
  EglContext& operator=(const EglContext&) = delete;

  /// Makes it the calling thread's. Cheap where it is already. @throws std::runtime_error.
  void make_current();

 private:
  void* context_ = nullptr;
};

}  // namespace bodyschema
