#include "api/plot.h"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <map>
#include <optional>
#include <set>
#include <stdexcept>
#include <string_view>
#include <utility>

#include <fmt/format.h>

#include "api/svg.h"

namespace brdfit::api {
namespace {

using optim::ChannelReport;
using optim::Fit;
using optim::Report;

constexpr double kLayoutWidth = 960;   ///< of the widest layout; a wider picture is scaled
constexpr double kAngleMatch = 1e-6;   ///< [deg]
constexpr double kGoodDecades = 0.05;  ///< half width of the shaded band
constexpr std::size_t kMaxPanels = 24;
constexpr std::size_t kMaxChannels = 12;
constexpr std::size_t kMaxCircles = 1500;  ///< more points than this in a picture become dots

constexpr std::string_view kHead = R"(text-anchor="end" fill="#666")";
constexpr std::string_view kFailed = R"(font-size="11" fill="#666" font-style="italic")";
constexpr std::string_view kCircle = R"(stroke="#555" stroke-width=".8" fill="#fff")";
constexpr std::string_view kDot = R"(stroke="#8a8a8a" stroke-width="2" stroke-linecap="round")";

// ---- what to draw ---------------------------------------------------------------------------------------------------

/// Of simpler forms, which are many, only the recommended one is drawn.
bool is_drawn(const ChannelReport& channel, const Fit& fit) {
    return fit.submodel.empty() ||
           (channel.recommended && channel.recommended->fit && &channel.fits[*channel.recommended->fit] == &fit);
}

/// A model, and the how-manieth of its drawn fits in the channel by number of lobes, a simpler form before the whole.
using Slot = std::pair<std::string, std::ptrdiff_t>;
Slot slot_of(const ChannelReport& channel, const Fit& fit) {
    const auto before = [&](const Fit& f) {
        return f.model == fit.model && is_drawn(channel, f) &&
               std::pair(f.lobes, f.submodel.empty()) < std::pair(fit.lobes, fit.submodel.empty());
    };
    return {fit.model, std::count_if(channel.fits.begin(), channel.fits.end(), before)};
}
/// The place in here decides the style.
std::set<Slot> slots(const Report& report) {
    std::set<Slot> all;
    for (const ChannelReport& channel : report.channels) {
        for (const Fit& fit : channel.fits)
            if (is_drawn(channel, fit)) all.insert(slot_of(channel, fit));
        for (const optim::Failure& failure : channel.failures) all.insert({failure.model, 0});
    }
    return all;
}

struct Series {
    const Fit* fit;
    std::string name;
    Style style;
};
struct Point {
    double theta_r_deg = 0;  ///< signed
    double y = 0;            ///< log10 of the measured value
    std::size_t sample = 0;
};
struct Scan {
    double theta_i_deg = 0;
    std::vector<Point> points{};  ///< measured > 0, by angle
    std::size_t undrawn = 0;      ///< measured <= 0
};

/// A channel as the options want it.
struct View {
    const ChannelReport& report;
    std::vector<Series> series{};  ///< best first
    std::vector<optim::Failure> failures{};
    std::vector<Scan> scans{};
    std::size_t points = 0;
    std::size_t out_of_plane = 0;
    std::size_t scans_left_out = 0;

    [[nodiscard]] std::size_t models() const { return series.size() + failures.size(); }
};

bool drawable(double value) { return value > 0 && std::isfinite(value); }

bool same_angle(double a, double b) { return std::abs(a - b) <= kAngleMatch; }
bool wanted(const PlotOptions& options, double angle) {
    const auto& chosen = options.theta_i_deg;
    return chosen.empty() || std::any_of(chosen.begin(), chosen.end(), [&](double a) { return same_angle(a, angle); });
}
bool wanted(const PlotOptions& options, const std::string& model) {
    const auto& chosen = options.models;
    return chosen.empty() || std::find(chosen.begin(), chosen.end(), model) != chosen.end();
}

[[noreturn]] void refuse(const char* option, std::string_view what, std::string_view got,
                         const std::vector<std::string>& valid) {
    constexpr std::size_t most = 30;
    std::string list;
    for (std::size_t i = 0; i < std::min(valid.size(), most); ++i) list += (i > 0 ? ", " : "") + valid[i];
    if (valid.size() > most) list += ", ...";
    throw InvalidPlot(option, fmt::format("no {} '{}' in this report; it has: {}", what, got.substr(0, 200), list));
}

/// The channels that the options name, once the options are found valid.
std::vector<const ChannelReport*> chosen_channels(const Report& report, const PlotOptions& options) {
    if (const auto reason = kPlotWidth(options.width)) throw InvalidPlot("width", *reason);
    std::vector<const ChannelReport*> chosen;
    std::vector<std::string> channels, models, angle_names;
    std::set<double> angles;
    for (const ChannelReport& c : report.channels) {
        channels.push_back(c.channel.name);
        if (!options.channel.empty() && c.channel.name != options.channel) continue;
        chosen.push_back(&c);
        for (const optim::Sample& s : c.channel.samples) angles.insert(s.direction.theta_i_deg);
    }
    if (chosen.empty()) refuse("channel", "channel", options.channel, channels);
    for (const auto& [model, repeat] : slots(report))
        if (repeat == 0) models.push_back(model);
    for (const std::string& m : options.models)
        if (std::find(models.begin(), models.end(), m) == models.end()) refuse("models", "model", m, models);
    for (const double a : angles) angle_names.push_back(fmt::format("{:g}", a));
    for (const double a : options.theta_i_deg) {
        const auto same = [&](double b) { return same_angle(a, b); };
        if (std::none_of(angles.begin(), angles.end(), same))
            refuse("theta_i", "theta_i", fmt::format("{:g}", a), angle_names);
    }
    return chosen;
}

void add_scans(View& view, const PlotOptions& options) {
    std::map<double, Scan> scans;
    const std::vector<optim::Sample>& samples = view.report.channel.samples;
    for (std::size_t j = 0; j < samples.size(); ++j) {
        const kernels::Direction d = kernels::canonical(samples[j].direction);
        if (!wanted(options, d.theta_i_deg)) continue;
        if (d.phi_deg != 0 && d.theta_r_deg != 0) {
            ++view.out_of_plane;
            continue;
        }
        Scan& scan = scans[d.theta_i_deg];
        scan.theta_i_deg = d.theta_i_deg;
        if (drawable(samples[j].brdf)) scan.points.push_back({d.theta_r_deg, std::log10(samples[j].brdf), j});
        else ++scan.undrawn;
    }
    for (auto& [angle, scan] : scans) {
        if (view.scans.size() == kMaxPanels) break;
        const auto by_angle = [](const Point& a, const Point& b) { return a.theta_r_deg < b.theta_r_deg; };
        std::stable_sort(scan.points.begin(), scan.points.end(), by_angle);
        view.points += scan.points.size();
        view.scans.push_back(std::move(scan));
    }
    view.scans_left_out = scans.size() - view.scans.size();
}

View view_of(const Report& report, const ChannelReport& channel, const PlotOptions& options) {
    View view{channel};
    const std::set<Slot> order = slots(report);
    for (const Fit& fit : channel.fits) {
        if (!wanted(options, fit.model) || !is_drawn(channel, fit)) continue;
        const auto slot = std::distance(order.begin(), order.find(slot_of(channel, fit)));
        const std::string lobes = fit.lobes > 0 ? " (" + counted(fit.lobes, "lobe") + ")" : "";
        const std::string submodel = fit.submodel.empty() ? "" : ", " + fit.submodel;
        view.series.push_back({&fit, fit.model + lobes + submodel, style(static_cast<std::size_t>(slot))});
    }
    for (const optim::Failure& failure : channel.failures)
        if (wanted(options, failure.model)) view.failures.push_back(failure);
    add_scans(view, options);
    return view;
}

/// log10(model / measured), where there is one.
std::optional<double> residual(const Fit& fit, const Point& p) {
    if (p.sample >= fit.values.size() || !drawable(fit.values[p.sample])) return std::nullopt;
    return std::log10(fit.values[p.sample]) - p.y;
}

/// The model's curve at an incidence angle, in (degree, decade); broken where the model has no logarithm.
std::vector<Line> curve(const Fit& fit, double theta_i_deg) {
    std::vector<Line> lines;
    for (const Fit::Curve& c : fit.curves) {
        if (!same_angle(c.theta_i_deg, theta_i_deg)) continue;
        lines.emplace_back();
        for (std::size_t i = 0; i < std::min(c.theta_r_deg.size(), c.brdf.size()); ++i) {
            if (drawable(c.brdf[i])) lines.back().push_back({c.theta_r_deg[i], std::log10(c.brdf[i])});
            else lines.emplace_back();
        }
    }
    return lines;
}

double quantile(std::vector<double> values, double q) {
    std::sort(values.begin(), values.end());
    return values[static_cast<std::size_t>(q * static_cast<double>(values.size() - 1))];
}

Range angle_range(const View& view) {
    Range range;
    for (const Scan& scan : view.scans)
        for (const Point& p : scan.points) range.add(p.theta_r_deg);
    return range.empty() ? Range{-90, 90} : range.widened(10, 0.04);
}

/// In decades: the measured values save those far below the rest, and curves from half a decade below to one above.
Range brdf_range(const View& view) {
    Range points, curves;
    std::vector<double> values;
    for (const Scan& scan : view.scans) {
        for (const Point& p : scan.points) values.push_back(p.y);
        for (const Series& s : view.series) {
            for (const Line& line : curve(*s.fit, scan.theta_i_deg))
                for (const Pixel& p : line) curves.add(p.y);
        }
    }
    if (values.empty() && curves.empty()) return {-1, 0};
    if (values.empty()) return Range{std::max(curves.lo, curves.hi - 6), curves.hi}.widened(1, 0.05);
    const double floor = quantile(values, 0.05) - 3;
    for (const double v : values) points.add(std::max(v, floor));
    const double lo = std::max(curves.lo, points.lo - 0.5);
    const double hi = std::min(curves.hi, points.hi + 1);
    return Range{std::min(points.lo, lo), std::max(points.hi, hi)}.widened(1, 0.05);
}

/// Symmetric: a round number of decades that holds 90 % of the residuals of the better half of the models.
Range residual_range(const View& view) {
    std::vector<double> sizes;
    for (const Series& s : view.series) {
        std::vector<double> of_model{0};
        for (const Scan& scan : view.scans)
            for (const Point& p : scan.points) of_model.push_back(std::abs(residual(*s.fit, p).value_or(0)));
        sizes.push_back(quantile(of_model, 0.9));
    }
    const double most = sizes.empty() ? 0 : quantile(sizes, 0.5);
    double limit = 0.1;
    for (const double l : {0.2, 0.3, 0.5, 1.0, 2.0, 3.0, 5.0, 10.0})
        if (limit < most) limit = l;
    return Range{-limit, limit}.widened(0, 0.04);
}

// ---- panels ---------------------------------------------------------------------------------------------------------

void draw_specular_direction(Svg& svg, const Panel& p, const Scan& scan) {
    if (!p.x.scale.data.holds(scan.theta_i_deg)) return;
    svg.path(xml("M{} 0v{}", p.x.scale(scan.theta_i_deg), p.height), R"(stroke="#777" stroke-dasharray="1 3")");
}

/// Circles, or dots where there are many; error bars of one sigma; arrows for values below the axis.
void draw_points(Svg& svg, const Panel& p, const View& view, const Scan& scan) {
    const bool few = view.points <= kMaxCircles;
    const double r = std::clamp(0.45 * p.width / static_cast<double>(scan.points.size() + 1), 1.2, 2.3);
    std::string bars, points, arrows;
    for (const Point& point : scan.points) {
        const optim::Sample& sample = view.report.channel.samples[point.sample];
        const double x = p.x.scale(point.theta_r_deg);
        const double y = p.y.scale(point.y);
        if (const double sigma = sample.sigma.value_or(0); drawable(sigma)) {
            const double low = sample.brdf > sigma ? p.y.scale(std::log10(sample.brdf - sigma)) : p.height;
            bars += xml("M{} {}V{}", x, p.y.scale(std::log10(sample.brdf + sigma)), low);
        }
        if (y > p.height) arrows += arrow(x, p.height, false);
        else points += few ? circle(x, y, r) : xml("M{} {}h0", x, y);
    }
    svg.path(bars, R"(stroke="#8a8a8a" stroke-width=".8")");
    svg.path(points, few ? kCircle : kDot, "measured");
    svg.path(arrows, R"(fill="#555")");
}

void draw_curve(Svg& svg, const Panel& p, const Scan& scan, const Series& s) {
    std::vector<Line> bends;
    for (Line& line : curve(*s.fit, scan.theta_i_deg)) {
        if (line.empty()) continue;
        for (Pixel& at : line) at = {p.x.scale(at.x), p.y.scale(at.y)};
        bends.push_back(simplified(line));
    }
    svg.path(path_of(bends), s.style.stroke, s.name);
}

/// The residuals, joined; arrows, not too close to each other, where they leave the axis.
void draw_residual(Svg& svg, const Panel& p, const Scan& scan, const Series& s) {
    std::vector<Line> lines(1);
    std::string arrows;
    double last = -kInfinity;
    for (const Point& point : scan.points) {
        const std::optional<double> r = residual(*s.fit, point);
        if (!r) {
            lines.emplace_back();
            continue;
        }
        const double x = p.x.scale(point.theta_r_deg);
        lines.back().push_back({x, p.y.scale(*r)});
        if (p.y.scale.data.holds(*r) || x - last < 16) continue;
        arrows += arrow(x, *r > 0 ? 0 : p.height, *r > 0);
        last = x;
    }
    svg.path(path_of(lines), s.style.stroke, s.name);
    svg.path(arrows, s.style.fill);
}

// ---- pages ----------------------------------------------------------------------------------------------------------

constexpr double kLeft = 64;  ///< of the leftmost panel: room for tick labels and title
constexpr double kRight = 14;
constexpr double kGap = 26;  ///< between columns
constexpr double kTop = 64;  ///< below the heading
constexpr double kRow = 17;  ///< of a table

std::string channel_name(const optim::Channel& channel) {
    return "channel " + channel.name + (channel.wavelength_nm ? fmt::format(" ({:g} nm)", *channel.wavelength_nm) : "");
}

std::string description(const View& view) {
    std::string text =
        channel_name(view.report.channel) + ", " + counted(view.report.channel.samples.size(), "sample") + ".";
    for (const Series& s : view.series) {
        text += fmt::format(" Rank {}: {}, loss {}, error {} decades.", s.fit->rank, s.name, brief(s.fit->loss),
                            brief(s.fit->log10_rmse));
    }
    for (const optim::Failure& f : view.failures) text += " No fit of " + f.model + ": " + f.reason + ".";
    return text;
}

/// Names the lines, in columns with headings. Returns the height.
double draw_legend(Svg& svg, const View& view, const Pixel& corner, double width, std::size_t columns, bool measured) {
    const std::size_t rows = std::max<std::size_t>(1, (view.models() + columns - 1) / columns);
    if (measured) {
        svg.path(circle(corner.x + 14, corner.y, 2.3), kCircle);
        svg.text(corner.x + 34, corner.y + 4, {"measured"}, R"(font-size="11")");
    }
    std::size_t used = 0;
    const auto place = [&] {
        const std::size_t column = used / rows;
        const double x = corner.x + static_cast<double>(column) * (width + kGap);
        if (used % rows == 0 && used < view.series.size()) {
            svg.text(x + width - 62, corner.y + 4, {"loss"}, kHead);
            svg.text(x + width, corner.y + 4, {"decades"}, kHead);
        }
        return Pixel{x, corner.y + kRow * static_cast<double>(used++ % rows + 1)};
    };
    for (const Series& s : view.series) {
        const Pixel at = place();
        svg.path(xml("M{} {}h28", at.x, at.y), s.style.stroke);
        svg.text(at.x + 34, at.y + 4, escape(s.name, (width - 120) / 11), R"(font-size="11")");
        svg.text(at.x + width - 62, at.y + 4, typeset(brief(s.fit->loss)), kEnd);
        svg.text(at.x + width, at.y + 4, typeset(brief(s.fit->log10_rmse)), kEnd);
    }
    for (const optim::Failure& f : view.failures) {
        const Pixel at = place();
        svg.text(at.x + 34, at.y + 4, escape(f.model + ": no fit: " + f.reason, (width - 34) / 11), kFailed);
    }
    return kRow * static_cast<double>(rows + 1);
}

std::vector<std::string> notes_on(const View& view, bool brdf) {
    std::vector<std::string> notes;
    const std::vector<optim::Sample>& samples = view.report.channel.samples;
    if (view.series.empty()) notes.emplace_back("no fit to draw");
    if (view.out_of_plane > 0)
        notes.push_back(counted(view.out_of_plane, "sample") + " out of the plane of incidence not drawn");
    if (view.scans_left_out > 0)
        notes.push_back(counted(view.scans_left_out, "further incidence angle") + " not drawn");
    if (view.scans.empty()) {
        notes.emplace_back("none lies in it; a summary shows the errors over all samples");
        return notes;
    }
    if (brdf &&
        std::any_of(samples.begin(), samples.end(), [](const optim::Sample& s) { return s.sigma.has_value(); })) {
        notes.emplace_back("bars: one standard deviation");
    }
    notes.emplace_back("dotted line: specular direction");
    notes.emplace_back("triangles on an edge: values beyond the axis");
    notes.emplace_back(fmt::format("band: ±{} decades", kGoodDecades));
    notes.emplace_back("decades: rms of log10(model / measured)");
    return notes;
}

/// Two panels, the upper one for plots of the BRDF, that all incidence angles share but for labels and titles.
struct Pair {
    Panel brdf;
    Panel residual;
};

void draw_scan(Svg& svg, const View& view, const Scan& scan, const Pair& panels) {
    const double width = panels.residual.width;
    svg.text(0, -6, subscripted("θ", "i", fmt::format("= {:g}°", scan.theta_i_deg)), R"(font-size="12")");
    if (scan.undrawn > 0) svg.text(width, -6, {counted(scan.undrawn, "value") + " ≤ 0 not drawn"}, kHead);
    if (panels.brdf.height > 0) {
        open_panel(svg, panels.brdf);
        draw_specular_direction(svg, panels.brdf, scan);
        draw_points(svg, panels.brdf, view, scan);
        for (auto s = view.series.rbegin(); s != view.series.rend(); ++s) draw_curve(svg, panels.brdf, scan, *s);
        close_panel(svg, panels.brdf);
    }
    svg.open_group(0, panels.brdf.height > 0 ? panels.brdf.height + 8 : 0);
    open_panel(svg, panels.residual);
    draw_specular_direction(svg, panels.residual, scan);
    for (auto s = view.series.rbegin(); s != view.series.rend(); ++s) draw_residual(svg, panels.residual, scan, *s);
    close_panel(svg, panels.residual);
    svg.close_group();
}

Pair panels_for(const View& view, double width, bool brdf) {
    const double upper = brdf ? std::round(0.66 * width) : 0;
    const double lower = std::round((brdf ? 0.34 : 0.6) * width);
    const Scale angle{angle_range(view), 0, width};
    const Scale decades{brdf_range(view), upper, 0};
    const Scale error{residual_range(view), lower, 0};
    return {
        {width,
         upper,
         {angle, angle_ticks(angle), false},
         {decades, brdf ? decade_ticks(decades, 20) : std::vector<Tick>{}}},
        {width, lower, {angle, angle_ticks(angle)}, {error, number_ticks(error, 18)}, {-kGoodDecades, kGoodDecades}}};
}

/// The residuals at each incidence angle, with the BRDF above them or not.
std::string plot_angles(const Report& report, const PlotOptions& options, bool brdf) {
    const View view = view_of(report, *chosen_channels(report, options).front(), options);
    const std::size_t n = view.scans.size();
    const bool measured = brdf && view.points > 0;
    const double width = std::min(options.width, kLayoutWidth);
    const std::size_t columns = std::min<std::size_t>(n + 1, width < 600 ? 1 : width < 900 ? 2 : 3);
    const double panel_width = (width - kLeft - kRight + kGap) / static_cast<double>(columns) - kGap;
    Pair panels = panels_for(view, panel_width, brdf);
    const double pitch = panels.brdf.height + panels.residual.height + (brdf ? 68 : 60);

    Svg svg;
    double y = kTop;
    const bool legend_in_grid = n % columns != 0 && kRow * static_cast<double>(view.models() + 2) < pitch;
    if (!legend_in_grid) y += draw_legend(svg, view, {kLeft, y}, panel_width, columns, measured) + 8;
    const auto corner = [&](std::size_t i) {
        const std::size_t row = i / columns;
        return Pixel{kLeft + static_cast<double>(i % columns) * (panel_width + kGap),
                     y + 20 + static_cast<double>(row) * pitch};
    };
    const bool relative = report.unit == optim::Unit::relative;
    const Markup brdf_title = subscripted(relative ? "relative BRDF f" : "BRDF f", "r", relative ? "" : "[1/sr]");
    const Markup residual_title = subscripted("log", "10", brdf ? "(model/data)" : "(model / measured)");
    for (std::size_t i = 0; i < n; ++i) {
        const bool leftmost = i % columns == 0;
        panels.brdf.y.labels = panels.residual.y.labels = leftmost;
        panels.brdf.y.title = leftmost ? brdf_title : Markup{};
        panels.residual.y.title = leftmost ? residual_title : Markup{};
        const bool lowest = i + columns >= n;
        panels.residual.x.title =
            lowest ? subscripted("exitant angle θ", "r", "[°] (specular side positive)") : Markup{};
        svg.open_group(corner(i).x, corner(i).y);
        draw_scan(svg, view, view.scans[i], panels);
        svg.close_group();
    }
    if (legend_in_grid) draw_legend(svg, view, {corner(n).x, corner(n).y + 6}, panel_width, 1, measured);
    const std::size_t rows = (n + columns - 1) / columns;
    y += static_cast<double>(rows) * pitch + 14;
    y += draw_notes(svg, y, width, notes_on(view, brdf));
    const std::string subtitle = (brdf ? "BRDF and fits: " : "errors of fits: ") + channel_name(view.report.channel);
    return document({report.dataset, subtitle, description(view), width, y, options.width}, svg.out);
}

// ---- summary --------------------------------------------------------------------------------------------------------

/// Axes of a summary, equal for all its channels.
struct SummaryAxes {
    bool log_loss = false;
    Range loss;   ///< in decades if log_loss
    Range angle;  ///< [deg]
    Range error;  ///< log10 of decades
};

SummaryAxes summary_axes(const std::vector<View>& views, const PlotOptions& options) {
    Range loss{0, 0}, log_loss, angle, error;
    for (const View& view : views) {
        for (const Series& s : view.series) {
            if (std::isfinite(s.fit->loss)) loss.add(s.fit->loss);
            if (drawable(s.fit->loss)) log_loss.add(std::log10(s.fit->loss));
            for (const optim::ScanError& scan : s.fit->scans) {
                if (!wanted(options, scan.theta_i_deg)) continue;
                angle.add(scan.theta_i_deg);
                if (drawable(scan.log10_rmse.value_or(0))) error.add(std::log10(*scan.log10_rmse));
            }
        }
    }
    const bool log = log_loss.hi - log_loss.lo > 1;
    return {log, log ? log_loss.widened(1, 0.08) : Range{0, loss.hi > 0 ? 1.08 * loss.hi : 1},
            (angle.empty() ? Range{0, 90} : angle).widened(10, 0.06),
            (error.empty() ? Range{-2, 0} : error).widened(1, 0.06)};
}

/// Models by loss: a stem in the style of the model, and the numbers beside it.
void draw_ranking(Svg& svg, const View& view, const SummaryAxes& axes, double width, double height) {
    const Scale x{axes.loss, 0, width};
    const Scale y{{0, std::max(1.0, static_cast<double>(view.models()))}, 0, height};
    Panel p{width, height, {x, axes.log_loss ? decade_ticks(x, 34) : number_ticks(x, 44), true, {"loss"}}, {y, {}}};
    Svg stems, numbers;
    if (!view.series.empty()) {
        numbers.text(width + 58, -6, {"loss"}, kHead);
        numbers.text(width + 122, -6, {"decades"}, kHead);
    }
    if (view.models() == 0) stems.text(8, y(0.5) + 3.5, {"no fit"}, kFailed);
    double row = 0.5;
    for (const Series& s : view.series) {
        p.y.ticks.push_back({row, escape(fmt::format("{}. {}", s.fit->rank, s.name), 13.5)});
        numbers.text(width + 58, y(row) + 3.5, typeset(brief(s.fit->loss)), kEnd);
        numbers.text(width + 122, y(row) + 3.5, typeset(brief(s.fit->log10_rmse)), kEnd);
        if (std::isfinite(s.fit->loss)) {
            const double end = x(std::max(axes.loss.lo, axes.log_loss ? std::log10(s.fit->loss) : s.fit->loss));
            stems.path(xml("M0 {}H{}", y(row), end), s.style.stroke, s.name);
            stems.path(circle(end, y(row), 4), s.style.fill);
        }
        ++row;
    }
    for (const optim::Failure& f : view.failures) {
        p.y.ticks.push_back({row, escape(f.model, 13.5)});
        stems.text(8, y(row++) + 3.5, escape("no fit: " + f.reason, (width - 16) / 11), kFailed);
    }
    open_panel(svg, p);
    svg.out += stems.out;
    close_panel(svg, p);
    svg.out += numbers.out;
}

/// The error of each model over incidence angle; no error at all is an arrow.
void draw_errors(Svg& svg, const View& view, const SummaryAxes& axes, const PlotOptions& options, double width,
                 double height) {
    const Scale x{axes.angle, 0, width};
    const Scale y{axes.error, height, 0};
    const Panel p{width,
                  height,
                  {x, angle_ticks(x), true, subscripted("incidence angle θ", "i", "[°]")},
                  {y, decade_ticks(y, 16), true, {"error [decades]"}}};
    open_panel(svg, p);
    for (auto s = view.series.rbegin(); s != view.series.rend(); ++s) {
        std::vector<Line> lines(1);
        std::string marks;
        for (const optim::ScanError& scan : s->fit->scans) {
            if (!wanted(options, scan.theta_i_deg)) continue;
            const double at = x(scan.theta_i_deg);
            const double error = scan.log10_rmse.value_or(-1);
            if (drawable(error)) {
                lines.back().push_back({at, y(std::log10(error))});
                marks += circle(at, lines.back().back().y, 2.5);
            } else {
                lines.emplace_back();
                if (error == 0) marks += arrow(at, height, false);
            }
        }
        svg.path(path_of(lines), s->style.stroke, s->name);
        svg.path(marks, s->style.fill);
    }
    close_panel(svg, p);
}

// ---- the query ------------------------------------------------------------------------------------------------------

const std::vector<Field<PlotOptions>> kPlotFields{
    {"models", false, "names of models to draw; all if absent", schema::array(schema::text()),
     [](const nlohmann::json& v, const Place& p, PlotOptions& out) {
         for (std::size_t i = 0; i < v.size(); ++i) out.models.push_back(read_text(v[i], p.at(i)).value_or(""));
     }},
    {"theta_i", false, "incidence angles to draw, in degrees; all if absent", schema::array(schema::number()),
     [](const nlohmann::json& v, const Place& p, PlotOptions& out) {
         for (std::size_t i = 0; i < v.size(); ++i) out.theta_i_deg.push_back(read_number(v[i], p).value_or(0));
     }},
    {"width", false, "of the picture, in pixels", schema::with_default(schema::number(kPlotWidth), PlotOptions{}.width),
     [](const nlohmann::json& v, const Place& p, PlotOptions& out) {
         out.width = read_checked(v, p, kPlotWidth).value_or(out.width);
     }},
    {"channel", false, "its name; the first, in a summary all, if absent", schema::name(),
     [](const nlohmann::json& v, const Place& p, PlotOptions& out) { out.channel = read_text(v, p).value_or(""); }},
};

}  // namespace

std::string plot_brdf(const Report& report, const PlotOptions& options) { return plot_angles(report, options, true); }

std::string plot_residual(const Report& report, const PlotOptions& options) {
    return plot_angles(report, options, false);
}

std::string plot_summary(const Report& report, const PlotOptions& options) {
    std::vector<View> views;
    std::size_t left_out = 0;
    for (const ChannelReport* channel : chosen_channels(report, options)) {
        if (views.size() < kMaxChannels) views.push_back(view_of(report, *channel, options));
        else ++left_out;
    }
    const SummaryAxes axes = summary_axes(views, options);

    const double width = std::clamp(options.width, 440.0, kLayoutWidth);
    constexpr double names = 160, numbers = 130;
    const bool beside = width >= 700;
    const double right = beside ? 0.3 * width : width - kLeft - kRight;
    const double left = width - names - numbers - kRight - (beside ? right + kLeft : 0);
    Svg svg;
    double y = kTop;
    std::string text;
    for (const View& view : views) {
        const double height = std::max(110.0, 20 * static_cast<double>(view.models()));
        svg.text(16, y + 4, escape(channel_name(view.report.channel), (width - 32) / 12),
                 R"(font-size="12" font-weight="600")");
        svg.open_group(names, y + 24);
        draw_ranking(svg, view, axes, left, height);
        svg.close_group();
        if (!beside) y += height + 56;
        svg.open_group(width - kRight - right, y + 24);
        draw_errors(svg, view, axes, options, right, height);
        svg.close_group();
        y += height + 78;
        text += description(view) + " ";
    }
    std::vector<std::string> notes{"decades: rms of log10(model / measured)"};
    if (left_out > 0) notes.push_back(counted(left_out, "further channel") + " not drawn");
    y += draw_notes(svg, y, width, notes);
    return document({report.dataset, "models by loss, and their errors", text, width, y, options.width}, svg.out);
}

PlotOptions read_plot_options(const Query& query) {
    std::vector<FieldError> errors;
    PlotOptions options;
    read_query<PlotOptions>(query, Place(errors, ""), kPlotFields, options);
    refuse_if_any(std::move(errors));
    return options;
}

std::vector<QueryParameter> plot_query() { return parameters_of(kPlotFields); }

}  // namespace brdfit::api
