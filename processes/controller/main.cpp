// controller: POSE_TARGET, MOTION_STATUS, MARKER_POSES, SAMPLE, BODY_SCHEMA, MODEL_HEALTH
//             -> ACTION_COMMAND, CONTROL_STATUS

#include "processes/controller/controller_process.h"

int main(int argc, char** argv) {
  return bodyschema::run_process<bodyschema::ControllerProcess>("controller", argc, argv);
}
