// structure_learner: SAMPLE, BODY_SCHEMA, MODEL_HEALTH -> LEARNED_SCHEMA, SAMPLE_REQUEST

#include "processes/structure_learner/structure_learner_process.h"

int main(int argc, char** argv) {
  return bodyschema::run_process<bodyschema::StructureLearnerProcess>("structure_learner", argc,
                                                                      argv);
}
