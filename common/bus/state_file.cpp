#include "common/bus/state_file.h"

#include <stdexcept>

#include "common/bus/event_log.h"

namespace bodyschema {

bool StateFile::save(const std::string& text) {
  if (text == wanted_) return problem_.empty();
  wanted_ = text;
  return retry();
}

bool StateFile::retry() {
  problem_.clear();
  if (file_.empty() || wanted_ == saved_) return true;
  try {
    write_file_atomically(file_, wanted_);
    saved_ = wanted_;
  } catch (const std::runtime_error& error) {
    problem_ = error.what();
    ++num_failed_;
  }
  return problem_.empty();
}

}  // namespace bodyschema
