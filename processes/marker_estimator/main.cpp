// marker_estimator: CAMERA_IMAGE, CAMERA_INFO -> MARKER_POSES

#include "processes/marker_estimator/marker_estimator_process.h"

int main(int argc, char** argv) {
  return bodyschema::run_process<bodyschema::MarkerEstimatorProcess>("marker_estimator", argc,
                                                                     argv);
}
