#include "optim/ledger.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <utility>

#include "optim/statistics.h"

namespace brdfit::optim {
namespace {

using kernels::Precision;

/// Relative losses below this are rounding, and equal.
constexpr double kNoLoss = 1e-12;

struct Change {
    LessWork what;
    FitOptions options;
};

std::vector<Change> changes(const Fitter& fitter, const FitOptions& options) {
    FitOptions less = options;
    less.ledger = less.judge = false;
    std::vector<Change> result;
    if (options.precision != Precision::single_precision && fitter.engine().supports(Precision::single_precision)) {
        result.push_back({LessWork::single_precision, less});
        result.back().options.precision = Precision::single_precision;
    }
    if (options.effort == Effort::draft) return result;
    const bool thorough = options.effort == Effort::thorough;
    result.push_back({thorough ? LessWork::standard : LessWork::draft, less});
    result.back().options.effort = thorough ? Effort::standard : Effort::draft;
    return result;
}

std::optional<double> ratio(double loss, double reference) {
    if (loss <= kNoLoss && reference <= kNoLoss) return 1;
    return reference > 0 ? std::optional(loss / reference) : std::nullopt;
}

/// relative_loss of the other fit's values under the first one's weights (for `log`, its loss).
double loss_of(const ChannelReport& channel, const Criterion& criterion, const Fit& other) {
    const Weighted weighted = weigh(channel.channel, criterion, channel.robust_scale.value_or(0));
    const double loss = std::sqrt(residuals(weighted, other.values).loss2);
    return weighted.norm > 0 ? loss / weighted.norm : loss;
}

bool ended(const Fit& fit) {
    return fit.search.stop_reason != StopReason::time_limit && fit.search.stop_reason != StopReason::cancelled;
}

LedgerLine line_of(LessWork what, const ChannelReport& channel, const Criterion& criterion, const Fit& fit,
                   const Fit& other) {
    LedgerLine line;
    line.change = what;
    line.loss_ratio = ratio(loss_of(channel, criterion, other), fit.relative_loss);
    line.evaluations = other.search.evaluations;
    line.time_s = other.search.time_s;
    if (other.lobes != fit.lobes) line.lobes = other.lobes;
    else line.largest_shift = largest_shift(fit, other);
    return line;
}

void add_milestones(Fit& fit) {
    // Those of a search under a constraint are of the search without.
    if (fit.constrained && fit.constrained->loss_without != fit.loss) return;
    for (const Milestone& milestone : fit.search.milestones) {
        LedgerLine line;
        line.change = milestone.stop;
        line.loss_ratio = ratio(std::sqrt(milestone.relative_loss2), fit.relative_loss);
        line.evaluations = milestone.evaluations;
        fit.ledger.push_back(std::move(line));
    }
}

}  // namespace

std::optional<LedgerLine::Shift> largest_shift(const Fit& fit, const Fit& other) {
    std::optional<LedgerLine::Shift> largest;
    for (std::size_t i = 0; i < fit.parameters.size(); ++i) {
        const FittedParameter& parameter = fit.parameters[i];
        if (parameter.fixed) continue;
        const double moved = std::abs(other.parameters[i].value - parameter.value);
        LedgerLine::Shift shift{parameter.name, {}, {}};
        if (parameter.std_error && *parameter.std_error > 0) shift.std_errors = moved / *parameter.std_error;
        if (parameter.value != 0 || moved == 0) shift.relative = moved == 0 ? 0 : moved / std::abs(parameter.value);
        // None is less than any number: what has a standard error goes first.
        if (!largest || std::pair(shift.std_errors, shift.relative) > std::pair(largest->std_errors, largest->relative))
            largest = std::move(shift);
    }
    return largest;
}

void add_ledger(Fitter& fitter, const Dataset& dataset, const std::vector<ModelRequest>& models,
                const FitOptions& options, const SearchControl& control, Report& report) {
    std::vector<bool> incomplete(report.channels.size());
    for (Change& change : changes(fitter, options)) {
        change.options.time_limit = control.deadline - std::chrono::steady_clock::now();
        Report less;
        if (!control.over()) less = fitter.fit(dataset, models, change.options, control.stop);
        for (std::size_t c = 0; c < report.channels.size(); ++c) {
            ChannelReport& channel = report.channels[c];
            for (Fit& fit : channel.fits) {
                const std::vector<Fit> none;
                const std::vector<Fit>& others = less.channels.empty() ? none : less.channels[c].fits;
                const auto other = std::find_if(others.begin(), others.end(),
                                                [&](const Fit& candidate) { return candidate.form == fit.form; });
                if (other == others.end() || !ended(*other)) incomplete[c] = true;
                else fit.ledger.push_back(line_of(change.what, channel, report.loss, fit, *other));
            }
        }
    }
    for (std::size_t c = 0; c < report.channels.size(); ++c) {
        for (Fit& fit : report.channels[c].fits) add_milestones(fit);
        if (incomplete[c])
            report.channels[c].warnings.emplace_back(
                "the ledger lacks lines: with less work a model found no fit, or time ran out");
    }
}

}  // namespace brdfit::optim
