// observer: MARKER_POSES, MOTION_STATUS, CAMERA_INFO, SAMPLE_REQUEST -> SAMPLE

#include "processes/observer/observer_process.h"

int main(int argc, char** argv) {
  return bodyschema::run_process<bodyschema::ObserverProcess>("observer", argc, argv);
}
