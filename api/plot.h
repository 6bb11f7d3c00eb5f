/// Error plots: a report drawn as SVG text.
#pragma once

#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "api/query.h"
#include "optim/report.h"

namespace brdfit::api {

inline constexpr Rule kPlotWidth{320, false, 4000, false, "width must be 320 to 4000"};

/// Options that the report does not allow.
class InvalidPlot : public std::invalid_argument {
public:
    InvalidPlot(std::string option_in, const std::string& reason)
        : std::invalid_argument(reason), option(std::move(option_in)) {}
    std::string option;  ///< its name in a query
};

struct PlotOptions {
    std::vector<std::string> models{};  ///< names of models to draw, e.g. "ward"; empty: all
    std::vector<double> theta_i_deg{};  ///< incidence angles to draw; empty: all
    double width = 960;                 ///< of the picture [px], kPlotWidth
    std::string channel{};              ///< empty: the first; in a summary: all
};

/// The options in a URL's query. Throws Refusal.
PlotOptions read_plot_options(const Query& query);
std::vector<QueryParameter> plot_query();

/// Each of these is a pure function: the same report and options give the same bytes, whatever the locale. The text is
/// a whole SVG document in UTF-8 with role="img", <title> and <desc>, white background, no script and no reference
/// to anything outside. Names from the report are escaped; control characters are dropped and bad UTF-8 is replaced. A
/// name that is too long for its place ends in an ellipsis.
///
/// A model has one colour, dash pattern and line weight in all plots of a report and its channels, by its place among
/// the report's sorted model names. Curves are drawn within 0.05 px of their values. Below 960 px a picture gets fewer
/// columns, above it is scaled. What cannot be drawn is counted in the picture: values <= 0, samples out of the plane
/// of incidence, values beyond an axis (arrows), models without a fit, incidence angles past the 24th, channels past
/// the 12th.
///
/// Angles in the report are finite; values, losses and errors need not be. Throws InvalidPlot, naming the
/// valid ones, if options name a model, an incidence angle (to 1e-6 degrees) or a channel that the report lacks, if the
/// width is out of range, or if the report has no channel.

/// The measured BRDF (error bars: one sigma) and each model's curve against the signed exitant angle, a panel per
/// incidence angle with equal axes, the residual log10(model / measured) under it.
std::string plot_brdf(const optim::Report& report, const PlotOptions& options = {});

/// The residual panels alone, larger.
std::string plot_residual(const optim::Report& report, const PlotOptions& options = {});

/// Models ranked by loss, and their errors in decades at each incidence angle, for each channel.
std::string plot_summary(const optim::Report& report, const PlotOptions& options = {});

}  // namespace brdfit::api
