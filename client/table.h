/// Reports for a terminal.
#pragma once

#include <string>

#include "optim/report.h"

namespace brdfit::client {

/// A ranked table for each channel: rank, model, loss, error in decades, time, parameters with their standard errors.
std::string table(const optim::Report& report);

}  // namespace brdfit::client
