#pragma once

#include <mujoco/mujoco.h>

#include <memory>

namespace bodyschema {

struct MjModelDeleter {
  void operator()(mjModel* model) const { mj_deleteModel(model); }
};
struct MjDataDeleter {
  void operator()(mjData* data) const { mj_deleteData(data); }
};
using MjModelPtr = std::unique_ptr<mjModel, MjModelDeleter>;
using MjDataPtr = std::unique_ptr<mjData, MjDataDeleter>;

/// MuJoCo's fatal errors (no memory, a broken model) end the process with one line and exit code 1,
/// its warnings go to stderr. Left alone it waits for the Enter key on an error and writes
/// MUJOCO_LOG.TXT into the working directory.
/// Everything in common/scene calls this before its first call of MuJoCo; again does no harm.
void install_mujoco_handlers();

}  // namespace bodyschema
