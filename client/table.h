/// Reports for a terminal.
#pragma once

#include <string>

#include <span>

#include "kernels/selftest.h"
#include "optim/report.h"

namespace brdfit::client {

/// A ranked table for each channel: rank, model, loss, error in decades, time, parameters with their standard errors.
std::string table(const optim::Report& report);

/// A line for each model and precision of a self-test: points, worst errors in eps, verdict; below it, where a model
/// failed.
std::string table(std::span<const kernels::SelfTest> tests);

}  // namespace brdfit::client
