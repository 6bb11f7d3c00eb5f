#include "client/table.h"

#include <fmt/format.h>

#include "api/names.h"

namespace brdfit::client {
namespace {

std::string parameters(const optim::Fit& fit) {
    std::string text;
    for (const optim::FittedParameter& p : fit.parameters) {
        text += fmt::format("{}{} {:.4g}", text.empty() ? "" : ", ", p.name, p.value);
        if (p.interval_95) text += fmt::format(" [{:.4g}, {:.4g}]", (*p.interval_95)[0], (*p.interval_95)[1]);
        if (p.unit != "1") text += " " + p.unit;
        if (p.at_bound) text += " (bound)";
    }
    return text;
}

std::string noise(const optim::NoiseRecord& noise) {
    if (noise.source != optim::NoiseSource::estimated) return std::string(name_of(api::kNoiseSources, noise.source));
    return fmt::format("{:.2g} % of the value, {:.2g} at least (both to {:.0f} %), {}", 100 * *noise.relative,
                       *noise.floor, 100 * *noise.relative_error, name_of(api::kNoiseSources, noise.source));
}

/// Errors of a model without points are not known.
std::string eps(const kernels::ModelTest& test, const kernels::WorstError& error) {
    return test.points == 0 ? "-" : fmt::format("{:.2f}", error.eps);
}

std::string shift(const optim::LedgerLine& line) {
    const auto& moved = line.largest_shift;
    if (line.lobes) return fmt::format(", with {} lobes", *line.lobes);
    if (!moved) return "";
    if (moved->std_errors)
        return fmt::format(", {} moves {:.2g} standard errors", moved->parameter, *moved->std_errors);
    return moved->relative ? fmt::format(", {} moves by {:.2g} of itself", moved->parameter, *moved->relative) : "";
}

std::string verdict(const kernels::ModelTest& test) {
    if (!test.passed()) return "FAILED";
    return test.points == 0 ? "no points" : "passed";
}

}  // namespace

std::string table(std::span<const kernels::SelfTest> tests) {
    std::string text = fmt::format("  {:<14} {:<9} {:>6} {:>10} {:>10} {:>8}  {}\n", "model", "precision", "points",
                                   "value, eps", "slope, eps", "ms", "verdict");
    for (const kernels::SelfTest& test : tests)
        for (const kernels::ModelTest& model : test.models) {
            text += fmt::format("  {:<14} {:<9} {:>6} {:>10} {:>10} {:>8.1f}  {}\n",
                                kernels::variant_name(model.model, model.lobes),
                                name_of(api::kPrecisions, test.precision), model.points, eps(model, model.value),
                                eps(model, model.slope), model.time_ms, verdict(model));
            for (const std::string& failure : model.failures()) text += "      " + failure + "\n";
        }
    return text;
}

std::string table(std::span<const kernels::Throughput> throughputs) {
    std::string text;
    for (const kernels::Throughput& throughput : throughputs) {
        text += fmt::format(
            "{} precision: {:.1f} million exps/s. Millions of evaluations/s, with gradient, {} samples:\n",
            name_of(api::kPrecisions, throughput.precision), 1e-6 * throughput.exps_per_s, kernels::kLaunchSamples);
        text += fmt::format("  {:<14}", "candidates");
        for (const std::size_t candidates : kernels::kLaunches) text += fmt::format(" {:>9}", candidates);
        text += fmt::format(" {:>9} {:>9} {:>9}\n", "of exps", "in exps", "value, ns");
        for (const kernels::ModelRate& rate : throughput.models) {
            text += fmt::format("  {:<14}", kernels::variant_name(rate.model, rate.lobes));
            for (const double evaluations : rate.evaluations_per_s)
                text += fmt::format(" {:>9.2f}", 1e-6 * evaluations);
            text += fmt::format(" {:>7.1f} % {:>9.1f} {:>9.2f}{}\n", 100 / rate.exps, rate.exps, rate.cost.ns,
                                rate.cost.under_load ? ", under load" : "");
        }
    }
    return text;
}

std::string table(const optim::FitBench& bench) {
    std::string text = fmt::format("{} threads, medians\n", bench.threads);
    text += fmt::format("  {:<9} {:>8} {:>8} {:<9} {:>8} {:>5} {:>10} {:>10} {:>9}  {}\n", "growth", "channels",
                        "samples", "effort", "requests", "times", "wall, ms", "cpu, ms", "peak, MiB", "models");
    for (const optim::FitTiming& t : bench.timings)
        text += fmt::format("  {:<9} {:>8} {:>8} {:<9} {:>8} {:>5} {:>10.1f} {:>10.1f} {:>9.1f}  {}\n",
                            t.judge ? "judged" : t.growth, t.channels, t.samples, name_of(api::kEfforts, t.effort),
                            t.requests, t.repetitions, 1e3 * t.wall_s, 1e3 * t.cpu_s, t.peak_MiB,
                            fmt::join(t.models, ", "));
    for (const optim::BatchTiming& b : bench.batches)
        text += fmt::format(
            "{} datasets of {} samples: {:.1f} a second and {:.1f} MiB in the first tenth, {:.1f} and {:.1f} MiB in "
            "the "
            "last\n",
            b.datasets, b.samples, b.first_per_s, b.first_MiB, b.last_per_s, b.last_MiB);
    return text;
}

std::string table(const optim::TradeBench& bench) {
    const auto or_dash = [](const std::optional<double>& value) {
        return value ? fmt::format("{:.2g}", *value) : std::string("-");
    };
    std::string text = fmt::format("{:<16} {:<13} {:<9} {:<12} {:>5} {:>9} {:>9} {:>11} {:>9} {:>9} {:>8}\n", "dataset",
                                   "model", "effort", "precision", "seeds", "wall, ms", "cpu, ms", "evaluations",
                                   "distance", "worst", "success");
    for (const optim::TradeCell& c : bench.cells)
        text +=
            fmt::format("{:<16} {:<13} {:<9} {:<12} {:>5} {:>9.1f} {:>9.1f} {:>11.0f} {:>9.1e} {:>9.1e} {:>6.0f} %\n",
                        c.dataset, c.model, name_of(api::kEfforts, c.effort), name_of(api::kArithmetics, c.arithmetic),
                        c.seeds, 1e3 * c.wall_s, 1e3 * c.cpu_s, c.evaluations, c.distance, c.worst, 100 * c.success);
    text += fmt::format("\n{:<16} {:<13} {:<12} {:>5} {:<9} {:>10} {:>9}\n", "shift against", "double", "precision",
                        "seeds", "parameter", "std errors", "relative");
    for (const optim::PrecisionShift& s : bench.shifts)
        text += fmt::format("{:<16} {:<13} {:<12} {:>5} {:<9} {:>10} {:>9}\n", s.dataset, s.model,
                            name_of(api::kArithmetics, s.arithmetic), s.seeds, s.parameter.empty() ? "-" : s.parameter,
                            or_dash(s.std_errors), or_dash(s.relative));
    text += fmt::format("\n{:<16} {:<10} {:<9} {:>9} {:>9} {:>8}\n", "series on", "precision", "accuracy", "ln(1/eps)",
                        "error", "ns");
    for (const optim::SeriesPoint& p : bench.series)
        text += fmt::format("{:<16} {:<10} {:<9} {:>9} {:>9.1e} {:>8.1f}\n", p.dataset,
                            name_of(api::kPrecisions, p.precision), p.accuracy, or_dash(p.log_epsilon), p.error, p.ns);
    return text;
}

std::string table(const optim::Report& report) {
    std::string text;
    for (const optim::ChannelReport& channel : report.channels) {
        text += fmt::format("{}, channel {}, {} samples\n", report.dataset, channel.channel.name,
                            channel.channel.samples.size());
        text += "  noise: " + noise(channel.noise) + "\n";
        text += fmt::format("  {:>4}  {:<14} {:>11} {:>11} {:>8} {:>10} {:>8}  {}\n", "rank", "model", "loss",
                            "held out", "decades", "bic", "ms", "parameters [95 % interval]");
        for (const optim::Fit& fit : channel.fits) {
            const std::string decades = fit.log10_rmse ? fmt::format("{:.3f}", *fit.log10_rmse) : "-";
            const std::string held_out = fit.held_out ? fmt::format("{:.5g}", fit.held_out->loss) : "-";
            text += fmt::format("  {:>4}  {:<14} {:>11.5g} {:>11} {:>8} {:>10.1f} {:>8.1f}  {}\n", fit.rank,
                                kernels::variant_name(fit.model, fit.lobes, fit.submodel), fit.loss, held_out, decades,
                                fit.bic, 1e3 * fit.search.time_s, parameters(fit));
            for (const optim::LedgerLine& line : fit.ledger)
                text += fmt::format("{:>22}{}: {} evaluations, loss times {}{}\n", "",
                                    name_of(api::kLessWork, line.change), line.evaluations,
                                    line.loss_ratio ? fmt::format("{:.6g}", *line.loss_ratio) : "-", shift(line));
            for (const std::string& warning : fit.warnings) text += fmt::format("{:>22}{}\n", "", warning);
        }
        for (const optim::Failure& failure : channel.failures)
            text += fmt::format("  {:>4}  {:<14} {}\n", "-", failure.model, failure.reason);
        for (const std::string& warning : channel.warnings) text += "  note: " + warning + "\n";
    }
    return text;
}

}  // namespace brdfit::client
