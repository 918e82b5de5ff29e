// common/precompiled.h for tests.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "common/precompiled.h"
