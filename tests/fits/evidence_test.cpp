// Which model the evidence chooses, where the truth is known.

#include <gtest/gtest.h>

#include <cstdio>

#include "tests/fits/fitting.h"
#include "tests/fits/materials.h"
#include "tests/fits/truth.h"

namespace brdfit::tests {
namespace {}  // namespace
}  // namespace brdfit::tests
