// robot_driver_example: ACTION_COMMAND -> MOTION_STATUS, for the serial robot of imaginary_robot

#include "processes/robot_driver_example/robot_driver_example_process.h"

int main(int argc, char** argv) {
  return bodyschema::run_process<bodyschema::RobotDriverProcess>("robot_driver_example", argc,
                                                                 argv);
}
