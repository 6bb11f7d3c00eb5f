#include "api/plot.h"

#include <expat.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <clocale>
#include <cmath>
#include <functional>
#include <iterator>
#include <limits>
#include <map>
#include <set>
#include <sstream>
#include <stdexcept>

namespace brdfit::api {
namespace {

using optim::ChannelReport;
using optim::Fit;
using optim::Report;

// ---- reading a picture ----------------------------------------------------------------------------------------------

struct Element {
    std::string name;
    std::map<std::string, std::string> attributes;
    std::string text;   ///< with that of its children
    std::string title;  ///< of its child <title>
    std::string parent;
    std::size_t depth = 0;
};

struct Picture {
    std::vector<Element> elements{};
    std::vector<std::size_t> open{};
    std::string error{};

    [[nodiscard]] std::vector<Element> all(const std::function<bool(const Element&)>& matches) const {
        std::vector<Element> found;
        std::copy_if(elements.begin(), elements.end(), std::back_inserter(found), matches);
        return found;
    }
    [[nodiscard]] std::size_t panels() const {
        return all([](const Element& e) { return e.name == "svg"; }).size() - 1;
    }
    /// The lines of a model, within panels.
    [[nodiscard]] std::vector<Element> lines(const std::string& title) const {
        return all([&](const Element& e) { return e.name == "path" && e.title == title; });
    }
    [[nodiscard]] std::size_t texts(const std::string& part) const {
        return all([&](const Element& e) { return e.name == "text" && e.text.find(part) != std::string::npos; }).size();
    }
};

/// Parses with Expat; an error fails the test.
Picture parse(const std::string& svg) {
    Picture picture;
    const XML_Parser parser = XML_ParserCreate("UTF-8");
    XML_SetUserData(parser, &picture);
    XML_SetElementHandler(
        parser,
        [](void* data, const XML_Char* name, const XML_Char** attributes) {
            auto& p = *static_cast<Picture*>(data);
            Element e;
            e.name = name;
            e.depth = p.open.size();
            if (!p.open.empty()) e.parent = p.elements[p.open.back()].name;
            for (; *attributes != nullptr; attributes += 2) e.attributes[attributes[0]] = attributes[1];
            p.open.push_back(p.elements.size());
            p.elements.push_back(e);
        },
        [](void* data, const XML_Char*) {
            auto& p = *static_cast<Picture*>(data);
            const Element closed = p.elements[p.open.back()];
            p.open.pop_back();
            if (p.open.empty()) return;
            if (closed.name == "title") p.elements[p.open.back()].title = closed.text;
            else p.elements[p.open.back()].text += closed.text;
        });
    XML_SetCharacterDataHandler(parser, [](void* data, const XML_Char* text, int length) {
        auto& p = *static_cast<Picture*>(data);
        p.elements[p.open.back()].text.append(text, static_cast<std::size_t>(length));
    });
    if (XML_Parse(parser, svg.data(), static_cast<int>(svg.size()), 1) == XML_STATUS_ERROR) {
        ADD_FAILURE() << XML_ErrorString(XML_GetErrorCode(parser)) << " in line " << XML_GetCurrentLineNumber(parser);
    }
    XML_ParserFree(parser);
    return picture;
}

/// The corners of a path of M and l, as drawn.
std::vector<std::pair<double, double>> corners(std::string d) {
    std::vector<std::pair<double, double>> points;
    for (std::size_t i = 1; i < d.size(); ++i) {
        if (d[i] == '-' && d[i - 1] != ' ' && d[i - 1] != 'l') d.insert(i++, " ");
    }
    std::replace(d.begin(), d.end(), 'M', ' ');
    for (std::size_t i = 0; (i = d.find('l', i)) != std::string::npos;) d[i] = ' ';
    std::istringstream in(d);
    double dx = 0, dy = 0, x = 0, y = 0;
    while (in >> dx >> dy) points.emplace_back(x += dx, y += dy);
    return points;
}

// ---- reports --------------------------------------------------------------------------------------------------------

optim::Sample sample(double theta_i, double theta_r, double brdf, double phi = 0) {
    optim::Sample s;
    s.direction = {theta_i, theta_r, phi};
    s.brdf = brdf;
    return s;
}

optim::Failure failure(const std::string& model, const std::string& reason) {
    optim::Failure f;
    f.model = model;
    f.reason = reason;
    return f;
}

double lobe(double theta_i, double theta_r, double height) {
    return 0.1 + height * std::exp(-std::pow((theta_r - theta_i) / 8, 2));
}

/// A fit of a lobe of the given height, as dense curves and as values.
Fit fit_of(const optim::Channel& channel, const std::string& model, double height, double loss) {
    Fit fit;
    fit.model = model;
    fit.loss = loss;
    fit.log10_rmse = loss;
    std::map<double, Fit::Curve> curves;
    for (const optim::Sample& s : channel.samples) {
        const double theta_i = s.direction.theta_i_deg;
        fit.values.push_back(lobe(theta_i, s.direction.theta_r_deg, height));
        Fit::Curve& curve = curves[theta_i];
        curve.theta_i_deg = theta_i;
    }
    for (auto& [theta_i, curve] : curves) {
        for (double t = -80; t <= 80; t += 0.5) {
            curve.theta_r_deg.push_back(t);
            curve.brdf.push_back(lobe(theta_i, t, height));
        }
        fit.curves.push_back(curve);
        fit.scans.push_back({theta_i, loss, loss});
    }
    return fit;
}

optim::Channel channel_of(const std::vector<double>& theta_i_deg, double step = 4) {
    optim::Channel channel{"green", 550, {}};
    for (const double theta_i : theta_i_deg) {
        for (double t = -80; t <= 80; t += step) channel.samples.push_back(sample(theta_i, t, lobe(theta_i, t, 2)));
    }
    return channel;
}

ChannelReport fitted(const optim::Channel& channel, const std::vector<std::string>& models) {
    ChannelReport report;
    report.channel = channel;
    for (std::size_t k = 0; k < models.size(); ++k) {
        report.fits.push_back(
            fit_of(channel, models[k], 1 + static_cast<double>(k), 0.01 * static_cast<double>(k + 1)));
        report.fits.back().rank = k + 1;
    }
    return report;
}

const std::vector<double> kAngles{15, 30, 45, 60, 75};

Report typical() {
    Report report;
    report.dataset = "white plastic";
    report.channels = {fitted(channel_of(kAngles), {"ward", "lafortune", "phong", "lambert", "he_torrance"})};
    report.channels[0].fits[1].lobes = 2;
    return report;
}

Report single(ChannelReport channel) {
    Report report;
    report.dataset = "extreme";
    report.channels = {std::move(channel)};
    return report;
}

/// All three pictures are well formed and hold no number that is none.
void expect_sound(const Report& report, const PlotOptions& options = {}) {
    for (const auto& plot : {plot_brdf, plot_residual, plot_summary}) {
        const std::string svg = plot(report, options);
        for (const Element& e : parse(svg).elements) {
            for (const auto& [name, value] : e.attributes) {
                EXPECT_EQ(value.find("nan"), std::string::npos) << name << "=" << value;
                EXPECT_EQ(value.find("inf"), std::string::npos) << name << "=" << value;
            }
            EXPECT_EQ(e.text.find("nan"), std::string::npos) << e.text;
        }
    }
}

std::string refusal(const Report& report, const PlotOptions& options) {
    std::string what;
    for (const auto& plot : {plot_brdf, plot_residual, plot_summary}) {
        try {
            plot(report, options);
            ADD_FAILURE() << "not refused";
        } catch (const std::invalid_argument& e) {
            what = e.what();
        }
    }
    return what;
}

// ---- what a picture holds -------------------------------------------------------------------------------------------

TEST(Plot, HasPanelsForEachIncidenceAngle) {
    EXPECT_EQ(parse(plot_brdf(typical())).panels(), 2 * kAngles.size());
    EXPECT_EQ(parse(plot_residual(typical())).panels(), kAngles.size());
    EXPECT_EQ(parse(plot_brdf(typical())).texts("θi= 45°"), 1u);
    EXPECT_EQ(parse(plot_brdf(typical(), {.theta_i_deg = {30, 60}})).panels(), 4u);
}

TEST(Plot, DrawsEveryModelInEveryPanel) {
    const Picture brdf = parse(plot_brdf(typical()));
    for (const char* name : {"ward", "lafortune (2 lobes)", "phong", "lambert", "he_torrance"}) {
        EXPECT_EQ(brdf.lines(name).size(), 2 * kAngles.size()) << name;  // curve and residual
        EXPECT_EQ(brdf.texts(name), 1u) << name;                         // in the legend
    }
    EXPECT_EQ(brdf.lines("measured").size(), kAngles.size());
    EXPECT_EQ(parse(plot_brdf(typical(), {.models = {"ward"}})).lines("phong").size(), 0u);
}

TEST(Plot, NamesUnitsAndIsAnAccessibleImage) {
    Report report = typical();
    const Picture picture = parse(plot_brdf(report));
    EXPECT_GE(picture.texts("BRDF fr[1/sr]"), 1u);
    EXPECT_GE(picture.texts("exitant angle θr[°]"), 1u);
    EXPECT_EQ(picture.texts("550 nm"), 1u);
    EXPECT_EQ(picture.elements[0].attributes.at("role"), "img");
    EXPECT_EQ(picture.elements[1].name, "title");
    EXPECT_EQ(picture.elements[2].name, "desc");
    EXPECT_NE(picture.elements[2].text.find("Rank 1: ward, loss 0.0100"), std::string::npos);
    report.unit = optim::Unit::relative;
    EXPECT_GE(parse(plot_brdf(report)).texts("relative BRDF"), 1u);
}

TEST(Plot, DrawsCurvesWhereTheirValuesAre) {
    const Report report = single(fitted(channel_of({30}), {"ward"}));
    const Picture picture = parse(plot_brdf(report));
    const auto drawn = corners(picture.lines("ward").at(0).attributes.at("d"));
    // The axes, from two labels each: 0 and 60 degrees, 0.1 and 1 per steradian.
    const auto label = [&](const std::string& text, const std::string& anchor, const std::string& coordinate) {
        for (const Element& e : picture.elements) {
            const auto found = e.attributes.find("text-anchor");
            if (e.name == "text" && e.text == text && found != e.attributes.end() && found->second == anchor) {
                return std::stod(e.attributes.at(coordinate));
            }
        }
        ADD_FAILURE() << "no label " << text;
        return 0.0;
    };
    const double x0 = label("0", "middle", "x");
    const double per_degree = (label("60", "middle", "x") - x0) / 60;
    const double y0 = label("1", "end", "y") - 3.5;  // text stands lower than its tick
    const double per_decade = y0 - (label("0.1", "end", "y") - 3.5);
    const Fit::Curve& curve = report.channels[0].fits[0].curves[0];
    for (std::size_t i = 0; i < curve.brdf.size(); ++i) {
        const double x = x0 + per_degree * curve.theta_r_deg[i];
        const double y = y0 + per_decade * std::log10(curve.brdf[i]);
        double distance = 1e9;
        for (std::size_t k = 1; k < drawn.size(); ++k) {
            const auto [ax, ay] = drawn[k - 1];
            const auto [bx, by] = drawn[k];
            if (x < ax - 0.1 || x > bx + 0.1) continue;
            const double slope = (by - ay) / (bx - ax);
            distance = std::min(distance, std::abs(ay + slope * (x - ax) - y) / std::hypot(1, slope));
        }
        EXPECT_LT(distance, 0.1) << "at " << curve.theta_r_deg[i] << " degrees";
    }
}

TEST(Plot, KeepsTheStyleOfAModelWhateverItsRank) {
    const Report report = typical();
    Report reversed = report;
    std::reverse(reversed.channels[0].fits.begin(), reversed.channels[0].fits.end());
    Report failed = report;
    failed.channels[0].fits.erase(failed.channels[0].fits.begin());
    failed.channels[0].failures = {failure("ward", "out of time")};
    std::set<std::string> styles;
    for (const char* name : {"lafortune (2 lobes)", "phong", "lambert", "he_torrance"}) {
        const auto style = [&](const std::string& svg) {
            const auto attributes = parse(svg).lines(name).at(0).attributes;
            return attributes.at("stroke") + " " + attributes.at("stroke-dasharray");
        };
        const std::string expected = style(plot_brdf(report));
        styles.insert(expected);
        EXPECT_EQ(style(plot_brdf(reversed)), expected);
        EXPECT_EQ(style(plot_brdf(failed)), expected);
        EXPECT_EQ(style(plot_residual(report)), expected);
        EXPECT_EQ(style(plot_summary(report)), expected);
        EXPECT_EQ(style(plot_brdf(report, {.models = {"lafortune", "phong", "lambert", "he_torrance"}})), expected);
    }
    EXPECT_EQ(styles.size(), 4u);
}

TEST(Plot, TellsApartTwoFitsOfOneModelWithDifferentLobes) {
    Report report = single(fitted(channel_of({30}), {"lafortune", "lafortune"}));
    report.channels[0].fits[0].lobes = 2;
    report.channels[0].fits[1].lobes = 1;
    const Picture picture = parse(plot_brdf(report));
    EXPECT_NE(picture.lines("lafortune (2 lobes)").at(0).attributes.at("stroke"),
              picture.lines("lafortune (1 lobe)").at(0).attributes.at("stroke"));
}

TEST(Plot, ShowsErrorBarsOnlyWithSigma) {
    Report report = single(fitted(channel_of({30}), {"ward"}));
    EXPECT_EQ(parse(plot_brdf(report)).texts("one standard deviation"), 0u);
    for (optim::Sample& s : report.channels[0].channel.samples) s.sigma = 2 * s.brdf;  // reaches below zero
    EXPECT_EQ(parse(plot_brdf(report)).texts("one standard deviation"), 1u);
    expect_sound(report);
}

TEST(Plot, SummaryRanksModelsOfEveryChannel) {
    Report report = typical();
    report.channels.push_back(report.channels[0]);
    report.channels[1].channel.name = "red";
    report.channels[1].failures = {failure("oren_nayar", "a cause")};
    const Picture picture = parse(plot_summary(report));
    EXPECT_EQ(picture.panels(), 4u);
    EXPECT_EQ(picture.texts("channel green"), 1u);
    EXPECT_EQ(picture.texts("channel red"), 1u);
    EXPECT_EQ(picture.texts("2. lafortune (2 lobes)"), 2u);
    EXPECT_EQ(picture.texts("no fit: a cause"), 1u);
    EXPECT_EQ(parse(plot_summary(report, {.channel = "red"})).panels(), 2u);
    EXPECT_EQ(parse(plot_brdf(report, {.channel = "red"})).texts("channel red"), 1u);
}

// ---- text -----------------------------------------------------------------------------------------------------------

TEST(Plot, EscapesEveryName) {
    Report report = typical();
    const std::string nasty = "<script>&\"' \x01\x1f]]> \xC3\xA9";
    report.dataset = nasty;
    report.channels[0].channel.name = nasty;
    report.channels[0].fits[0].model = nasty;
    report.channels[0].failures = {failure(nasty, nasty)};
    expect_sound(report);
    const std::string svg = plot_brdf(report);
    EXPECT_EQ(svg.find("<script"), std::string::npos);
    EXPECT_EQ(svg.find('\x01'), std::string::npos);
    EXPECT_NE(parse(svg).elements[1].text.find("<script>&\"' ]]> \xC3\xA9"), std::string::npos);
}

TEST(Plot, ReplacesWhatIsNotUtf8OrNotXml) {
    Report report = typical();
    for (const char* bad :
         {"\xFF", "\xC3", "\xE2\x82", "\xED\xA0\x80", "\xF4\x90\x80\x80", "\xC0\xAF", "\xEF\xBF\xBF"}) {
        report.dataset = std::string("a") + bad + "b";
        report.channels[0].channel.name = bad;
        expect_sound(report);
    }
}

TEST(Plot, ShortensLongNamesButNotInTheTitle) {
    Report report = typical();
    report.dataset = std::string(5000, 'x') + "end";
    const Picture picture = parse(plot_brdf(report));
    EXPECT_NE(picture.elements[1].text.find("xend"), std::string::npos);
    EXPECT_EQ(picture.texts("xend"), 0u);
    EXPECT_EQ(picture.texts("xx…"), 1u);
}

// ---- extremes -------------------------------------------------------------------------------------------------------

TEST(Plot, HoldsForOneSample) {
    ChannelReport channel;
    channel.channel = {"a", {}, {sample(30, 30, 0.5)}};
    channel.fits = {fit_of(channel.channel, "ward", 1, 0.1)};
    const Report report = single(channel);
    expect_sound(report);
    EXPECT_EQ(parse(plot_brdf(report)).lines("ward").size(), 2u);
}

TEST(Plot, HoldsForEqualValuesAndPerfectFits) {
    Report report = single(fitted(channel_of({30}), {"lambert"}));
    Fit& fit = report.channels[0].fits[0];
    for (optim::Sample& s : report.channels[0].channel.samples) s.brdf = 0.5;
    std::fill(fit.values.begin(), fit.values.end(), 0.5);
    std::fill(fit.curves[0].brdf.begin(), fit.curves[0].brdf.end(), 0.5);
    fit.loss = 0;
    fit.log10_rmse = 0;
    fit.scans = {{30, 0, 0.0}};
    expect_sound(report);
    EXPECT_EQ(corners(parse(plot_brdf(report)).lines("lambert").at(0).attributes.at("d")).size(), 2u);
}

TEST(Plot, HoldsOverManyDecades) {
    Report report = single(fitted(channel_of({30}, 1), {"ward"}));
    ChannelReport& channel = report.channels[0];
    for (std::size_t j = 0; j < channel.channel.samples.size(); ++j) {
        channel.channel.samples[j].brdf = std::pow(10, -30 + 36.0 * static_cast<double>(j) / 160);
        channel.fits[0].values[j] = j % 2 == 0 ? 1e-300 : 1e300;
    }
    for (double& f : channel.fits[0].curves[0].brdf) f *= 1e-300;
    channel.fits[0].loss = 1e-200;
    expect_sound(report);
    const Picture picture = parse(plot_brdf(report));
    EXPECT_EQ(picture.texts("10−30"), 1u);
    EXPECT_EQ(picture.texts("105"), 1u);
}

TEST(Plot, NumbersThatNeedAnExponentStayNarrow) {
    for (const double factor : {1e-30, 1e6}) {
        Report report = typical();
        ChannelReport& channel = report.channels[0];
        for (optim::Sample& s : channel.channel.samples) s.brdf *= factor;
        for (Fit& fit : channel.fits) {
            fit.loss *= factor;
            for (double& value : fit.values) value *= factor;
            for (Fit::Curve& curve : fit.curves)
                for (double& value : curve.brdf) value *= factor;
        }
        expect_sound(report);
        const Picture picture = parse(plot_brdf(report, {}));
        // Between powers of ten an axis has bare digits: there is no room for more beside its title.
        EXPECT_GE(picture.texts(factor < 1 ? "10−30" : "106"), 1U) << factor;
        EXPECT_EQ(picture.texts("5×10"), 0U) << factor;
    }
}

TEST(Plot, BreaksCurvesWhereTheModelHasNoLogarithm) {
    Report report = single(fitted(channel_of({30}), {"ward"}));
    Fit& fit = report.channels[0].fits[0];
    const std::array<double, 5> none{std::nan(""), std::numeric_limits<double>::infinity(), 0, -1, -std::nan("")};
    for (std::size_t i = 0; i < none.size(); ++i) {
        fit.values[6 * i + 3] = none[i];
        fit.curves[0].brdf[40 * i + 20] = none[i];
    }
    fit.loss = std::nan("");
    fit.log10_rmse = std::numeric_limits<double>::infinity();
    fit.scans[0].log10_rmse = std::nan("");
    expect_sound(report);
    for (const Element& line : parse(plot_brdf(report)).lines("ward")) {
        const std::string& d = line.attributes.at("d");
        EXPECT_EQ(std::count(d.begin(), d.end(), 'M'), 6);
    }
}

TEST(Plot, CountsValuesThatALogarithmicAxisLacks) {
    Report report = typical();
    report.channels[0].channel.samples[2].brdf = 0;
    report.channels[0].channel.samples[5].brdf = -0.01;
    report.channels[0].channel.samples[7].brdf = -1e-9;
    expect_sound(report);
    EXPECT_EQ(parse(plot_brdf(report)).texts("3 values ≤ 0 not drawn"), 1u);
    for (optim::Sample& s : report.channels[0].channel.samples) s.brdf = -1;
    expect_sound(report);
    EXPECT_EQ(parse(plot_brdf(report)).texts("41 values ≤ 0 not drawn"), kAngles.size());
}

TEST(Plot, DrawsPointsWithoutFitsAndSaysWhy) {
    Report report = single(fitted(channel_of({30}), {}));
    report.channels[0].failures = {failure("ward", "out of time")};
    expect_sound(report);
    const Picture picture = parse(plot_brdf(report));
    EXPECT_EQ(picture.lines("measured").size(), 1u);
    EXPECT_EQ(picture.texts("no fit to draw"), 1u);
    EXPECT_EQ(picture.texts("ward: no fit: out of time"), 1u);
    report.channels[0].failures.clear();
    expect_sound(report);
}

TEST(Plot, CountsSamplesOutOfThePlaneOfIncidence) {
    Report report = single(fitted(channel_of({30}), {"ward"}));
    auto& samples = report.channels[0].channel.samples;
    samples[0].direction.phi_deg = 45;
    samples[1].direction.phi_deg = 180;  // in the plane: signed by the other convention
    EXPECT_EQ(parse(plot_brdf(report)).texts("1 sample out of the plane of incidence"), 1u);
    for (optim::Sample& s : samples) s.direction = {30, 20, 90};
    expect_sound(report);
    EXPECT_EQ(parse(plot_brdf(report)).panels(), 0u);
    EXPECT_EQ(parse(plot_brdf(report)).texts("41 samples out of the plane of incidence"), 1u);
    EXPECT_EQ(parse(plot_summary(report)).panels(), 2u);
}

TEST(Plot, BoundsPanelsAndChannelsAndSaysSo) {
    std::vector<double> angles;
    for (int i = 0; i < 30; ++i) angles.push_back(2.5 * i);
    const Picture many = parse(plot_residual(single(fitted(channel_of(angles, 20), {"ward"}))));
    EXPECT_EQ(many.panels(), 24u);
    EXPECT_EQ(many.texts("6 further incidence angles not drawn"), 1u);
    Report channels = typical();
    channels.channels.resize(15, channels.channels[0]);
    EXPECT_EQ(parse(plot_summary(channels)).panels(), 24u);
    EXPECT_EQ(parse(plot_summary(channels)).texts("3 further channels not drawn"), 1u);
}

TEST(Plot, StaysSmall) {
    EXPECT_LT(plot_brdf(typical()).size(), 100'000u);
    const Report large = single(fitted(channel_of({30}, 0.02), {"ward"}));  // 8,001 samples
    EXPECT_LT(plot_brdf(large).size(), 300'000u);
    EXPECT_LT(parse(plot_brdf(large)).elements.size(), 200u);
}

TEST(Plot, FitsItsWidth) {
    for (const double width : {320.0, 640.0, 960.0, 4000.0}) {
        for (const auto& plot : {plot_brdf, plot_residual, plot_summary}) {
            const Picture picture = parse(plot(typical(), {.width = width}));
            EXPECT_EQ(std::stod(picture.elements[0].attributes.at("width")), width);
        }
    }
}

// ---- a pure function ------------------------------------------------------------------------------------------------

TEST(Plot, GivesTheSameBytesInAnyLocale) {
    for (const auto& plot : {plot_brdf, plot_residual, plot_summary}) {
        const std::string first = plot(typical(), {});
        const std::string old = std::setlocale(LC_ALL, nullptr);
        for (const char* name : {"de_DE.UTF-8", "fr_FR.UTF-8", "C.UTF-8"}) {
            std::setlocale(LC_ALL, name);  // stays as it was if there is none
            EXPECT_EQ(plot(typical(), {}), first) << name;
        }
        std::setlocale(LC_ALL, old.c_str());
        EXPECT_EQ(plot(typical(), {}), first);
        for (const char* outside : {"<script", "href", "url(", "@import", "<!", "<image"}) {
            EXPECT_EQ(first.find(outside), std::string::npos) << outside;
        }
    }
}

TEST(Plot, RefusesWhatTheReportLacksAndNamesWhatItHas) {
    const Report report = typical();
    EXPECT_EQ(refusal(report, {.models = {"ward", "oren_nayar"}}),
              "no model 'oren_nayar' in this report; it has: he_torrance, lafortune, lambert, phong, ward");
    EXPECT_EQ(refusal(report, {.theta_i_deg = {17}}), "no theta_i '17' in this report; it has: 15, 30, 45, 60, 75");
    EXPECT_EQ(refusal(report, {.channel = "blue"}), "no channel 'blue' in this report; it has: green");
    for (const double width : {319.0, 4001.0, -1.0, std::nan("")}) {
        EXPECT_EQ(refusal(report, {.width = width}), "width must be 320 to 4000");
    }
    refusal(Report{}, {});
}

}  // namespace
}  // namespace brdfit::api
