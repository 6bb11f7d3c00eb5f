// What crosses between processes arrives as it was sent.
#include "api/archive.h"

#include <cmath>
#include <limits>
#include <stdexcept>
#include <string>
#include <utility>

#include <gtest/gtest.h>

#include "api/plot.h"

namespace brdfit::api {
namespace {

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
constexpr double kInfinity = std::numeric_limits<double>::infinity();

optim::Fit fit(const std::string& model, std::size_t lobes, std::size_t rank, const optim::Channel& channel) {
    optim::Fit made;
    made.rank = rank;
    made.model = model;
    made.lobes = lobes;
    made.loss = 0.1 * static_cast<double>(rank) / 3;
    made.relative_loss = 1.0 / 7;
    made.rmse = 1e-300;
    if (lobes != 2) made.log10_rmse = 1.0 / 3;
    made.scans = {{15, 0.01, 0.02}, {60, 0.03, {}}};
    for (const optim::Sample& sample : channel.samples) made.values.push_back(sample.brdf * (1 + 0.1 * std::sin(rank)));
    made.values.back() = rank == 1 ? kNan : kInfinity;
    for (const double theta_i_deg : {15.0, 60.0}) {
        optim::Fit::Curve curve{theta_i_deg, {}, {}};
        for (int angle = -80; angle <= 80; angle += 4) {
            curve.theta_r_deg.push_back(angle + (rank == 3 ? 0.1 : 0));  // one fit is drawn at angles of its own
            curve.brdf.push_back(std::exp(angle / 31.0) / static_cast<double>(rank));
        }
        curve.brdf[5] = -1;
        made.curves.push_back(curve);
    }
    return made;
}

/// Everything that a report may hold.
optim::Report everything() {
    optim::Report report;
    report.dataset = "a <name> with \"quotes\", \xc3\xa9 and \xff";
    report.unit = optim::Unit::relative;
    for (const char* name : {"red", "550nm"}) {
        optim::Channel channel{name, {}, {}};
        if (report.channels.empty()) channel.wavelength_nm = 550.5;
        for (const double theta_i_deg : {15.0, 60.0})
            for (int angle = -75; angle <= 75; angle += 5) {
                optim::Sample sample{{theta_i_deg, angle / 1.1, angle == 0 ? 30.5 : 0.0}, std::exp(angle / 29.0), {}};
                if (angle % 2 == 0) sample.sigma = sample.brdf / 17;
                if (angle == 20) sample.brdf = -0.0;
                channel.samples.push_back(sample);
            }
        optim::ChannelReport of_channel{channel, {}, {{"he_torrance", "no & such <fit>", "a driver's words"}}, {}};
        for (auto [model, lobes, rank] : {std::tuple{"ward", 0U, 1U}, {"lafortune", 2U, 2U}, {"lafortune", 1U, 3U}})
            of_channel.fits.push_back(fit(model, lobes, rank, channel));
        report.channels.push_back(of_channel);
    }
    report.channels.push_back({{"empty", {}, {}}, {}, {}, {}});
    return report;
}

TEST(Archive, PlotsAreTheSameByteForByte) {
    const optim::Report report = everything();
    const optim::Report read = read_archive(archive(report));
    PlotOptions of_one;
    of_one.channel = "550nm";
    of_one.models = {"lafortune"};
    of_one.theta_i_deg = {60};
    for (const PlotOptions& options : {PlotOptions{}, of_one}) {
        EXPECT_EQ(plot_brdf(read, options), plot_brdf(report, options));
        EXPECT_EQ(plot_residual(read, options), plot_residual(report, options));
        if (options.theta_i_deg.empty()) {
            EXPECT_EQ(plot_summary(read, options), plot_summary(report, options));
        }
    }
    EXPECT_EQ(archive(read), archive(report));
    EXPECT_TRUE(read.channels[0].failures[0].detail.empty()) << "a driver's words are for the log alone";
}

TEST(Archive, NoFitsAreNoTrouble) {
    optim::Report report = everything();
    for (optim::ChannelReport& channel : report.channels) channel.fits.clear();
    EXPECT_EQ(plot_brdf(read_archive(archive(report))), plot_brdf(report));
}

TEST(Archive, TakesLittleMoreThanItsNumbers) {
    constexpr std::size_t kSamples = 62, kAngles = 2 * 41;
    constexpr std::size_t kNumbers = 2 * (4 * kSamples + kSamples / 2 + 3 * (kSamples + kAngles) + 2 * kAngles);
    EXPECT_LT(archive(everything()).size(), 10 * kNumbers);
}

TEST(Archive, DeviceFactsComeBack) {
    DeviceFacts facts;
    facts.device = {"a device", "a platform", "1.2", "cpu", true, 8, true};
    kernels::ModelTest test{"ward", 0, 3, {0.5, "alpha=0x1p-3"}, {kInfinity, ""}, "", 1.25};
    facts.self_tests = {{kernels::Precision::single_precision, kernels::SelfTestForm::brief, {test}}};
    facts.complete = true;
    facts.single_refusal = "it failed";
    facts.costs = {{"ward", 0, {}, 1.5, true}};
    const DeviceFacts read = read_device_facts(archive(facts));
    EXPECT_EQ(read.device, facts.device);
    EXPECT_TRUE(read.complete);
    EXPECT_TRUE(read.usable());
    EXPECT_EQ(read.refusal(kernels::Precision::single_precision), "it failed");
    EXPECT_FALSE(read.refusal(kernels::Precision::double_precision));
    ASSERT_EQ(read.self_tests.size(), 1U);
    EXPECT_EQ(read.self_tests[0].precision, kernels::Precision::single_precision);
    EXPECT_EQ(read.self_tests[0].models[0].value.where, "alpha=0x1p-3");
    EXPECT_EQ(read.self_tests[0].models[0].slope.eps, kInfinity);
    ASSERT_EQ(read.costs.size(), 1U);
    EXPECT_EQ(read.costs[0].model, "ward");
    EXPECT_FALSE(read.costs[0].single_ns);
    EXPECT_EQ(read.costs[0].double_ns, 1.5);
    EXPECT_TRUE(read.costs[0].under_load);
    EXPECT_EQ(archive(read), archive(facts));
}

TEST(Archive, WhatIsNoneIsRefused) {
    const std::string good = archive(everything());
    for (const std::string& bad : {std::string(), std::string("text"), good.substr(0, good.size() / 2), good + "x"})
        EXPECT_THROW((void)read_archive(bad), std::invalid_argument) << bad.size();
    for (std::size_t at = 0; at < good.size(); at += 7) {  // damaged anywhere: refused or read, never worse
        std::string bad = good;
        bad[at] = static_cast<char>(bad[at] ^ 0x55);
        try {
            (void)read_archive(bad);
        } catch (const std::invalid_argument&) {
        }
    }
}

}  // namespace
}  // namespace brdfit::api
