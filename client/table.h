/// Reports for a terminal.
#pragma once

#include <string>

#include <span>

#include "kernels/selftest.h"
#include "kernels/throughput.h"
#include "optim/bench.h"
#include "optim/report.h"
#include "optim/trade.h"

namespace brdfit::client {

/// A ranked table for each channel: rank, model, loss, error in decades, time, parameters with their standard errors.
std::string table(const optim::Report& report);

/// A line for each model and precision of a self-test: points, worst errors in eps, verdict; below it, where a model
/// failed.
std::string table(std::span<const kernels::SelfTest> tests);

/// A line for each model and precision: millions of evaluations a second for each size of launch, the fastest as a part
/// of the device's exponentials a second, and how many of them an evaluation is worth.
std::string table(std::span<const kernels::Throughput> throughputs);

/// A line for each size of request.
std::string table(const optim::FitBench& bench);

/// A line for each dataset, model, effort and precision; for each shift of parameters; for each accuracy of series.
std::string table(const optim::TradeBench& bench);

}  // namespace brdfit::client
