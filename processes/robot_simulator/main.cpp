// robot_simulator: ACTION_COMMAND, FAULT_COMMAND -> MOTION_STATUS, SIM_STATE

#include "processes/robot_simulator/robot_simulator_process.h"

int main(int argc, char** argv) {
  return bodyschema::run_process<bodyschema::RobotSimulatorProcess>("robot_simulator", argc, argv);
}
