/// What less work would have made of the fits of a report, on their own data.
#pragma once

#include <optional>
#include <vector>

#include "optim/dataset.h"
#include "optim/fit.h"
#include "optim/report.h"
#include "optim/search.h"

namespace brdfit::optim {

/// The parameter of a fit that is furthest off in another fit of the same form: in standard errors of the first where
/// any has one, else relatively. None if all are fixed.
std::optional<LedgerLine::Shift> largest_shift(const Fit& fit, const Fit& other);

/// Fits anew with the search in single precision, and with the next lower effort, where the request asked for more;
/// adds a line for each, and one for each earlier stop that the search itself has passed. Losses are compared under the
/// report's own weights. `control`: the request's; where time has run out a channel's warning says that lines are
/// missing. Throws as Fitter::fit.
void add_ledger(Fitter& fitter, const Dataset& dataset, const std::vector<ModelRequest>& models,
                const FitOptions& options, const SearchControl& control, Report& report);

}  // namespace brdfit::optim
