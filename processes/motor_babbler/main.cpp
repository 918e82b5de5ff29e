// motor_babbler: MOTION_STATUS, SAMPLE, MARKER_POSES, MODEL_HEALTH, BODY_SCHEMA, CONTROL_STATUS
//                -> ACTION_COMMAND, SAMPLE_REQUEST

#include "processes/motor_babbler/motor_babbler_process.h"

int main(int argc, char** argv) {
  return bodyschema::run_process<bodyschema::MotorBabblerProcess>("motor_babbler", argc, argv);
}
