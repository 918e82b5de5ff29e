// camera: device or SIM_STATE -> CAMERA_IMAGE, CAMERA_INFO

#include "processes/camera/camera_process.h"

int main(int argc, char** argv) {
  return bodyschema::run_process<bodyschema::CameraProcess>("camera", argc, argv);
}
