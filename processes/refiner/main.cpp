// refiner: SAMPLE, LEARNED_SCHEMA -> REFINED_SCHEMA, SAMPLE_REQUEST

#include "processes/refiner/refiner_process.h"

int main(int argc, char** argv) {
  return bodyschema::run_process<bodyschema::RefinerProcess>("refiner", argc, argv);
}
