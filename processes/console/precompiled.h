// Read once by the compiler for all sources of the console.
#include <fmt/format.h>
#include <spdlog/spdlog.h>

#include <iostream>
#include <nlohmann/json.hpp>

#include "common/bus/channels.h"
#include "common/bus/codec.h"
#include "common/precompiled.h"
#include "common/schema/body_schema.h"
