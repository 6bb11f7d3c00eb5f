/// Reports as they are kept for plots.
#pragma once

#include <string>
#include <string_view>

#include "optim/report.h"

namespace brdfit::api {

std::string archive(const optim::Report& report);
optim::Report read_archive(std::string_view text);

}  // namespace brdfit::api
