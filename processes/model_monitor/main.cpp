// model_monitor: SAMPLE, LEARNED_SCHEMA, REFINED_SCHEMA
//                -> BODY_SCHEMA, MODEL_HEALTH, SAMPLE_REQUEST

#include "processes/model_monitor/model_monitor_process.h"

int main(int argc, char** argv) {
  return bodyschema::run_process<bodyschema::ModelMonitorProcess>("model_monitor", argc, argv);
}
