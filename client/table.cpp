#include "client/table.h"

#include <fmt/format.h>

namespace brdfit::client {
namespace {

std::string parameters(const optim::Fit& fit) {
    std::string text;
    for (const optim::FittedParameter& p : fit.parameters) {
        text += fmt::format("{}{} {:.4g}", text.empty() ? "" : ", ", p.name, p.value);
        if (p.std_error) text += fmt::format(" ± {:.1g}", *p.std_error);
        if (p.unit != "1") text += " " + p.unit;
        if (p.at_bound) text += " (bound)";
    }
    return text;
}

}  // namespace

std::string table(const optim::Report& report) {
    std::string text;
    for (const optim::ChannelReport& channel : report.channels) {
        text += fmt::format("{}, channel {}, {} samples\n", report.dataset, channel.channel.name,
                            channel.channel.samples.size());
        text += fmt::format("  {:>4}  {:<14} {:>11} {:>8} {:>8}  {}\n", "rank", "model", "loss", "decades", "ms",
                            "parameters");
        for (const optim::Fit& fit : channel.fits) {
            const std::string name = fit.lobes > 0 ? fmt::format("{} ({})", fit.model, fit.lobes) : fit.model;
            const std::string decades = fit.log10_rmse ? fmt::format("{:.3f}", *fit.log10_rmse) : "-";
            text += fmt::format("  {:>4}  {:<14} {:>11.5g} {:>8} {:>8.1f}  {}\n", fit.rank, name, fit.loss, decades,
                                1e3 * fit.search.time_s, parameters(fit));
            for (const std::string& warning : fit.warnings) text += fmt::format("{:>22}{}\n", "", warning);
        }
        for (const optim::Failure& failure : channel.failures)
            text += fmt::format("  {:>4}  {:<14} {}\n", "-", failure.model, failure.reason);
        for (const std::string& warning : channel.warnings) text += "  note: " + warning + "\n";
    }
    return text;
}

}  // namespace brdfit::client
