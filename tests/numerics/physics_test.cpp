// What the models state: symmetries, peaks, limits, slopes.

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <boost/math/constants/constants.hpp>
#include <boost/math/quadrature/gauss_kronrod.hpp>
#include <boost/math/special_functions/expint.hpp>
#include <cmath>
#include <complex>
#include <cstdio>
#include <numbers>

#include "tests/support.h"

namespace brdfit::tests {
namespace {

using kernels::Direction;
using kernels::Model;
using kernels::Precision;
using kernels::Values;
constexpr double kPi = std::numbers::pi;

double cos_deg(double degrees) { return std::cos(degrees * kPi / 180); }
double tan_deg(double degrees) { return std::tan(degrees * kPi / 180); }

Values at(const std::string& model, const std::vector<double>& parameters, const std::vector<Direction>& directions) {
    return kernels::evaluate(engine(), variant(model), engine().best_precision(), parameters, directions, true);
}
double value(const std::string& model, const std::vector<double>& parameters, const Direction& direction) {
    return at(model, parameters, {direction}).f[0];
}

/// Directions over the hemisphere, on both sides of the normal.
std::vector<Direction> random_directions(Random& random, std::size_t count, double limit_deg) {
    std::vector<Direction> directions;
    for (std::size_t i = 0; i < count; ++i)
        directions.push_back({random.uniform(0, limit_deg), random.uniform(-limit_deg, limit_deg),
                              i % 2 == 0 ? 0.0 : random.uniform(-180, 180)});
    return directions;
}

class EveryModel : public testing::TestWithParam<const Model*> {};
INSTANTIATE_TEST_SUITE_P(Models, EveryModel, testing::ValuesIn(variants()),
                         [](const auto& parameter) { return label(*parameter.param); });

TEST_P(EveryModel, IsReciprocalWhereItSaysSo) {
    const Model& model = *GetParam();
    Random random(1);
    const std::vector<Direction> forth = random_directions(random, 200, 85);
    std::vector<Direction> back;
    for (const Direction& d : forth)  // light and viewer change places: the azimuth between them stays
        back.push_back({std::abs(d.theta_r_deg), std::copysign(d.theta_i_deg, d.theta_r_deg), d.phi_deg});
    double worst = 0;
    for (int i = 0; i < 20; ++i) {
        const std::vector<double> p = random.typical_parameters(model);
        const std::vector<double> f = model_values(model, p, forth);
        const std::vector<double> g = model_values(model, p, back);
        for (std::size_t j = 0; j < f.size(); ++j) {
            if (f[j] < 1e-200) continue;
            // ln f may be large and negative: its rounding is that of the exponent.
            worst = std::max(worst, std::abs(f[j] - g[j]) / f[j] / (1 + std::abs(std::log(f[j]))));
        }
    }
    if (model.traits.at("reciprocal")) EXPECT_LT(worst, 1e-10);
    else EXPECT_GT(worst, 1e-2);
}

TEST_P(EveryModel, IsNeverNegativeAndAlwaysFinite) {
    const Model& model = *GetParam();
    Random random(2);
    const std::vector<Direction> directions = random_directions(random, 400, 89.99);
    for (const Precision precision : {Precision::double_precision, Precision::single_precision}) {
        if (!engine().supports(precision)) continue;
        for (int i = 0; i < 50; ++i) {
            const std::vector<double> p = random.parameters(model);
            const Values values = kernels::evaluate(engine(), model, precision, p, directions, true);
            for (std::size_t j = 0; j < directions.size(); ++j) {
                ASSERT_GE(values.f[j], 0) << testing::PrintToString(p);
                ASSERT_TRUE(std::isfinite(values.f[j])) << testing::PrintToString(p);
            }
        }
    }
}

TEST_P(EveryModel, HasFiniteSlopesOverItsBounds) {
    const Model& model = *GetParam();
    Random random(2);
    const std::vector<Direction> directions = random_directions(random, 400, 89.99);
    for (const Precision precision : {Precision::double_precision, Precision::single_precision}) {
        if (!engine().supports(precision)) continue;
        std::size_t infinite = 0;
        std::vector<double> where;
        for (int i = 0; i < 50; ++i) {
            const std::vector<double> p = random.parameters(model);
            const Values values = kernels::evaluate(engine(), model, precision, p, directions, true);
            const auto bad = std::count_if(values.by_parameter.begin(), values.by_parameter.end(),
                                           [](double slope) { return !std::isfinite(slope); });
            if (bad > 0) where = p;
            infinite += static_cast<std::size_t>(bad);
        }
        EXPECT_EQ(infinite, 0U) << (precision == Precision::double_precision ? "double" : "float") << ", last at "
                                << testing::PrintToString(where);
    }
}

TEST_P(EveryModel, SlopesAgreeWithCentralDifferences) {
    const Model& model = *GetParam();
    Random random(3);
    const std::vector<Direction> directions = random_directions(random, 100, 80);
    for (int i = 0; i < 20; ++i) {
        const std::vector<double> p = random.typical_parameters(model);
        const Values values = kernels::evaluate(engine(), model, engine().best_precision(), p, directions, true);
        for (std::size_t k = 0; k < p.size(); ++k) {
            // Every lobe's exponent is of the order of p/h: small against the lobe's own scale.
            const double h = 1e-6 * std::max(std::abs(p[k]), 1e-3);
            std::vector<double> up = p, down = p;
            up[k] += h;
            down[k] -= h;
            const std::vector<double> f_up = model_values(model, up, directions);
            const std::vector<double> f_down = model_values(model, down, directions);
            for (std::size_t j = 0; j < directions.size(); ++j) {
                if (values.f[j] > 1e100) continue;  // Lafortune: saturates
                const double slope = values.by_parameter[k * directions.size() + j];
                const double difference = (f_up[j] - f_down[j]) / (2 * h);
                // Truncation grows with the square of the exponent's slope, round-off with f/h.
                const double steep = values.f[j] > 0 ? std::abs(slope) / values.f[j] * h : 0;
                const double tolerance =
                    1e-5 * std::abs(slope) + 10 * steep * steep * std::abs(slope) + 1e-13 * values.f[j] / h + 1e-300;
                ASSERT_NEAR(slope, difference, tolerance)
                    << model.parameters[k].name << " at " << testing::PrintToString(p) << ", "
                    << directions[j].theta_i_deg << " " << directions[j].theta_r_deg << " " << directions[j].phi_deg;
            }
        }
    }
}

TEST_P(EveryModel, DoesNotDependOnTheWayADirectionIsWritten) {
    const Model& model = *GetParam();
    Random random(4);
    const std::vector<double> p = random.typical_parameters(model);
    for (const Direction& d : random_directions(random, 50, 80)) {
        const std::vector<double> f = model_values(model, p,
                                                   {d,
                                                    {d.theta_i_deg, d.theta_r_deg, -d.phi_deg},
                                                    {d.theta_i_deg, -d.theta_r_deg, d.phi_deg + 180},
                                                    {d.theta_i_deg, d.theta_r_deg, d.phi_deg + 360}});
        for (const double g : f) EXPECT_NEAR(g, f[0], 1e-9 * f[0]);
    }
}

// ---- Lambert, Phong, Ward, Lafortune ----

TEST(Lambert, IsAlbedoOverPiEverywhere) {
    Random random(5);
    for (const double f : at("lambert", {0.25}, random_directions(random, 50, 89.9)).f) EXPECT_DOUBLE_EQ(f, 0.25 / kPi);
}

TEST(Phong, PeaksInTheMirrorDirectionWithTheNormalisationNPlusOneOverTwoPi) {
    for (const double theta : {0.0, 15.0, 45.0, 75.0})
        EXPECT_NEAR(value("phong", {0.5, 0.2, 67.8}, {theta, theta, 0}),
                    0.5 / kPi + 0.2 * 68.8 / (2 * kPi) / cos_deg(theta), 1e-12);
}

TEST(Phong, WeightIsTheLobesIntegralOverTheHemisphereAtNormalIncidence) {
    for (const double n : {0.5, 10.0, 1000.0}) {
        const auto ring = [&](double theta_deg) {
            return value("phong", {0, 0.7, n}, {0, theta_deg, 0}) * 2 * kPi * std::sin(theta_deg * kPi / 180) * kPi /
                   180;
        };
        EXPECT_NEAR((boost::math::quadrature::gauss_kronrod<double, 61>::integrate(ring, 0.0, 90.0, 8, 1e-8)), 0.7,
                    1e-5);
    }
}

TEST(Phong, NarrowsWithTheRootOfTheExponent) {
    for (const double n : {1e2, 1e3, 1e4, 1e5, 1e6}) {
        const double half_width = 180 / kPi * std::sqrt(2 * std::log(2)) / std::sqrt(n);  // 67.5 deg/sqrt(n)
        const double peak = value("phong", {0, 1, n}, {30, 30, 0});
        EXPECT_NEAR(value("phong", {0, 1, n}, {30, 30 + half_width, 0}) / peak, 0.5, 1 / n);
    }
}

TEST(Phong, HasNoLobeBehindTheMirrorDirectionsHorizon) {
    const Values values = at("phong", {0.4, 10, 0.01}, {{60, -31, 0}, {60, -89, 0}, {45, 60, 180}});
    for (const double f : values.f) EXPECT_DOUBLE_EQ(f, 0.4 / kPi);
    for (std::size_t j = 3; j < 9; ++j) EXPECT_EQ(values.by_parameter[j], 0);
}

TEST(Ward, PeaksInTheMirrorDirectionWithWardsNormalisation) {
    for (const double alpha : {0.01, 0.15, 1.0})
        for (const double theta : {0.0, 15.0, 45.0, 75.0})
            EXPECT_NEAR(value("ward", {0.5, 0.2, alpha}, {theta, theta, 0}),
                        0.5 / kPi + 0.2 / (4 * kPi * alpha * alpha * cos_deg(theta)), 1e-11 / (alpha * alpha));
}

TEST(Ward, FallsByEWhereTheHalfVectorsTangentIsTheWidth) {
    const double alpha = 0.2;
    const double away = 2 * std::atan(alpha) * 180 / kPi;
    EXPECT_NEAR(value("ward", {0, 1, alpha}, {20, 20 + away, 0}) * std::sqrt(cos_deg(20 + away)) /
                    (value("ward", {0, 1, alpha}, {20, 20, 0}) * std::sqrt(cos_deg(20))),
                std::exp(-1), 1e-12);
}

TEST(Ward, NarrowLobesKeepTheirPeakAndTheirWidth) {
    for (const double alpha : {1e-2, 1e-3, 1e-4, 1e-5, 1e-6}) {
        EXPECT_NEAR(value("ward", {0, 1, alpha}, {30, 30, 0}) * 4 * kPi * alpha * alpha * cos_deg(30), 1, 1e-14);
        const double away = 2 * std::atan(alpha) * 180 / kPi;
        // The angle's own rounding is of the order of 1e-14/alpha.
        EXPECT_NEAR(value("ward", {0, 1, alpha}, {0, away, 0}) * 4 * kPi * alpha * alpha, std::exp(-1),
                    alpha * alpha + 1e-14 / alpha);
    }
}

TEST(Ward, NarrowestLobeIsExactlyZeroAwayFromThePeak) {
    const Values values = at("ward", {0.3, 1, 1e-6}, {{20, 30, 0}, {20, -70, 0}});
    for (const double f : values.f) EXPECT_DOUBLE_EQ(f, 0.3 / kPi);
    for (std::size_t j = 2; j < 6; ++j) EXPECT_EQ(values.by_parameter[j], 0);
}

TEST(Lafortune, LobesWithANegativeBaseAreDark) {
    for (const double n : {0.01, 1.0, 25.0}) {
        const Values values = at("lafortune_1", {0.3, -1, -1, n}, {{15, 10, 0}, {45, -30, 0}, {0, 0, 0}});
        for (const double f : values.f) EXPECT_DOUBLE_EQ(f, 0.3 / kPi);
        for (std::size_t j = 3; j < 12; ++j) EXPECT_EQ(values.by_parameter[j], 0);
    }
}

TEST(Lafortune, SlopesFollowThePowerOfTheBaseAsItVanishes) {
    // b = cos(theta_i + theta_r) -> 0+: df/dc_xy = n b^(n-1) u_x v_x, which diverges for n < 1.
    for (const double n : {0.25, 1.0, 2.0, 3.5})
        for (const double away : {1e-3, 1e-6, 1e-9}) {
            const Values values = at("lafortune_1", {0, 1, 1, n}, {{45, 45 - away, 0}});
            // The angle is known to 1e-14 degrees; u_x v_x is -1/2 to the first order.
            const double b = std::sin(away * kPi / 180);
            const double expected = -n * std::pow(b, n - 1) / 2;
            EXPECT_NEAR(values.by_parameter[1] / expected, 1, 0.1 * away + 2e-14 / away) << n << " " << away;
            EXPECT_NEAR(values.f[0] / std::pow(b, n), 1, n * 2e-14 / away) << n << " " << away;
        }
}

TEST(Lafortune, LobesAddUp) {
    const std::vector<double> a{-1.22, -0.142, 21.4}, b{-1.04, 0.893, 21.1}, c{0.7, 0.8, 3};
    Random random(6);
    for (const Direction& d : random_directions(random, 50, 80)) {
        const double three = value("lafortune_3", {0.1, a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]}, d);
        const double sum = value("lafortune_1", {0.1, a[0], a[1], a[2]}, d) +
                           value("lafortune_1", {0, b[0], b[1], b[2]}, d) +
                           value("lafortune_1", {0, c[0], c[1], c[2]}, d);
        EXPECT_NEAR(three, sum, 1e-13 * sum);
    }
}

// ---- He-Torrance: rows of the table of limits ----

/// A smooth enough slope that neither shadowing nor effective roughness enters.
constexpr double kGentle = 400;

double reflectance(double n, double k, double theta_d_deg) {
    const std::complex<double> index(n, k);
    const double c = cos_deg(theta_d_deg);
    const std::complex<double> q = std::sqrt(index * index - 1.0 + c * c);
    return (std::norm((c - q) / (c + q)) + std::norm((index * index * c - q) / (index * index * c + q))) / 2;
}

/// e^-g (Ei(g) - gamma - ln g), the series at a = 0.
double series_without_tangent(double g) {
    return std::exp(-g) * (boost::math::expint(g) - boost::math::constants::euler<double>() - std::log(g));
}

TEST(HeTorrance, InTheMirrorDirectionTheSeriesIsAnExponentialIntegral) {
    for (const double theta : {0.0, 15.0, 60.0})
        for (const double sigma : {0.02, 0.1, 0.3, 1.0}) {
            const double tau = kGentle * sigma;
            const double g = std::pow(4 * kPi * sigma * cos_deg(theta), 2);
            const double expected =
                reflectance(1.5, 0, theta) * 4 * std::pow(kPi * tau, 2) / 4 * series_without_tangent(g) / kPi;
            EXPECT_NEAR(value("he_torrance", {sigma, tau, 1.5, 0, 0}, {theta, theta, 0}) / expected, 1, 1e-11)
                << theta << " " << sigma;
        }
}

TEST(HeTorrance, SmoothSurfacesTailsHoldMoreThanTheFirstTerm) {
    // g = 1e-4 and a = 40: the second term is 10^4 times the first.
    const double sigma = 1e-2 / (4 * kPi);
    const double theta_r = 60;
    const double g = std::pow(2 * kPi * sigma * (1 + cos_deg(theta_r)), 2);
    const double w = std::pow(std::sin(theta_r * kPi / 180), 2);
    const double tau = std::sqrt(40 / w) / kPi;
    const double cd2 = (1 + cos_deg(theta_r)) / 2;
    double first = g * std::exp(-g - 40);
    double sum = 0;
    for (int m = 1; m < 60; ++m) sum += std::exp(-g + m * std::log(g) - std::lgamma(m + 1) - 40.0 / m) / m;
    EXPECT_GT(sum, 1000 * first);
    const double expected = reflectance(1.5, 0, theta_r / 2) * std::pow(4 * cd2 / (1 + cos_deg(theta_r)), 2) *
                            std::pow(kPi * tau, 2) / 4 * sum / (kPi * cos_deg(theta_r));
    EXPECT_NEAR(value("he_torrance", {sigma, tau, 1.5, 0, 0}, {0, theta_r, 0}) / expected, 1, 1e-11);
}

/// f_dd of a gentle surface, where neither shadowing nor effective roughness enters, from its series.
double gentle(double n, const Direction& d, double tau, double series) {
    const double ci = cos_deg(d.theta_i_deg), cr = cos_deg(d.theta_r_deg);
    const double theta_d = (d.theta_r_deg + d.theta_i_deg) / 2;
    const double geometric = std::pow(4 * std::pow(cos_deg(theta_d), 2) / (ci + cr), 2);
    return reflectance(n, 0, theta_d) * geometric * std::pow(kPi * tau, 2) / 4 * series / (kPi * ci * cr);
}

TEST(HeTorrance, SmoothSurfacesHaveTheFirstTermsOfTheSeries) {
    // M_1 = g e^-g (e^-a + g/4 e^(-a/2) + g^2/18 e^(-a/3) + ...); sigma -> 0 leaves the first, or, far out, the second.
    const Direction d{20, 50, 0};
    const double cs = cos_deg(20) + cos_deg(50);
    const double w = std::pow(std::sin(50 * kPi / 180) - std::sin(20 * kPi / 180), 2);
    for (const double sigma : {1e-6, 1e-5, 1e-4, 1e-3})
        for (const double a : {0.01, 1.0, 10.0}) {
            const double g = std::pow(2 * kPi * sigma * cs, 2);
            const double tau = std::sqrt(a / w) / kPi;
            double series = 0;
            for (int m = 1; m < 8; ++m) series += std::pow(g, m) / std::tgamma(m + 1) / m * std::exp(-g - a / m);
            EXPECT_NEAR(value("he_torrance", {sigma, tau, 1.5, 0, 0}, d) / gentle(1.5, d, tau, series), 1, 1e-12)
                << sigma << " " << a;
        }
}

TEST(HeTorrance, RoughSurfacesHaveTheAsymptoticSeriesInTheMirrorDirection) {
    // M_1 ~ 1/g + 1!/g^2 + 2!/g^3 + ...
    for (const double g : {1e3, 1e4, 1e5}) {
        const double sigma = std::sqrt(g) / (4 * kPi);
        const double tau = 40 * sigma;
        double series = 0, term = 1 / g;
        for (int m = 1; m < 12; ++m, term *= (m - 1) / g) series += term;
        EXPECT_NEAR(value("he_torrance", {sigma, tau, 1.5, 0, 0}, {0, 0, 0}) / gentle(1.5, {0, 0, 0}, tau, series), 1,
                    1e-12)
            << g;
    }
}

TEST(HeTorrance, RetroReflectionHasTheSimplifiedGeometricFactor) {
    // Where the literal polarisation vectors are 0/0: G = 4/cos^2 theta_i, theta_d = 0, w = 4 sin^2 theta_i.
    for (const double theta : {0.0, 20.0, 60.0}) {
        const double sigma = 0.2, tau = 100 * sigma;
        const double g = std::pow(4 * kPi * sigma * cos_deg(theta), 2);
        const double a = std::pow(2 * kPi * tau * std::sin(theta * kPi / 180), 2);
        double series = 0;
        for (int m = 1; m < 3000; ++m) series += std::exp(-g + m * std::log(g) - std::lgamma(m + 1) - a / m) / m;
        if (series < 1e-290) series = 0;
        const double expected = gentle(1.5, {theta, -theta, 0}, tau, series);
        for (const Direction& d : std::vector<Direction>{{theta, -theta, 0}, {theta, theta, 180}}) {
            EXPECT_NEAR(value("he_torrance", {sigma, tau, 1.5, 0, 0}, d), expected, 1e-9 * expected + 1e-280) << theta;
        }
    }
}

TEST(HeTorrance, OneGrazingDirectionHasTheLimitsOfShadowingAndRoughness) {
    // S_1/cos theta -> sqrt(pi) tau/(2 sigma sin theta), K -> tan theta - tau/(sqrt(pi) sigma), W e^W = K^2/(8 pi).
    const double sigma = 0.3, tau = 3, theta_r = 5;
    for (const double theta_i : {90 - 1e-4, 90 - 1e-6, 90 - 1e-8}) {
        const double away = 90 - theta_i;
        const double cosine = std::sin(away * kPi / 180);
        const double log_z = 2 * std::log((1 / cosine - tau / (std::sqrt(kPi) * sigma)) / std::sqrt(8 * kPi));
        double w = log_z;
        for (int step = 0; step < 50; ++step) w = w * (1 + log_z - std::log(w)) / (1 + w);
        const double cs = cosine + cos_deg(theta_r);
        const double g = std::pow(2 * kPi * sigma * cs, 2) / (1 + w);
        const double sines = std::cos(away * kPi / 180) - std::sin(theta_r * kPi / 180);
        const double a = std::pow(kPi * tau * sines, 2);
        double series = 0;
        for (int m = 1; m < 200; ++m) series += std::exp(-g + m * std::log(g) - std::lgamma(m + 1) - a / m) / m;
        const double cd2 = std::pow(cos_deg((90 - away + theta_r) / 2), 2);
        const double theta_d = (90 - away + theta_r) / 2;
        const double expected = reflectance(1.5, 0, theta_d) * std::pow(4 * cd2 / cs, 2) * std::sqrt(kPi) * tau /
                                (2 * sigma) * std::pow(kPi * tau, 2) / 4 * series / (kPi * cos_deg(theta_r));
        EXPECT_NEAR(value("he_torrance", {sigma, tau, 1.5, 0, 0}, {theta_i, theta_r, 0}) / expected, 1, away) << away;
    }
}

TEST(HeTorrance, SteepSurfacesAreShadowedInProportionToTheirSlope) {
    // h -> 0: S_1 -> sqrt(pi) h in both directions, and K -> tan theta: f ~ tau^4 in the mirror direction.
    for (const double tau : {1e-3, 1e-5, 1e-7})
        EXPECT_NEAR(value("he_torrance", {0.5, tau, 1.5, 0, 0}, {60, 60, 0}) /
                        value("he_torrance", {0.5, tau / 10, 1.5, 0, 0}, {60, 60, 0}),
                    1e4, 1e5 * tau)
            << tau;
}

TEST(HeTorrance, RoughSurfacesApproachBeckmannsMicrofacets) {
    const double sigma = 8;
    const double tau = 40 * sigma;
    for (const double theta_r : {20.0, 22.0, 24.5}) {
        const double ci = cos_deg(20), cr = cos_deg(theta_r), slope = 2 * sigma / tau;
        const double delta = (theta_r - 20) / 2;
        const double s = std::pow(tan_deg(delta) / slope, 2);
        const double g = std::pow(2 * kPi * sigma * (ci + cr), 2);
        const double beckmann = reflectance(1.5, 0, (theta_r + 20) / 2) * std::exp(-s) /
                                (4 * kPi * slope * slope * std::pow(cos_deg(delta), 4) * ci * cr);
        const double f = value("he_torrance", {sigma, tau, 1.5, 0, 0}, {20, theta_r, 0});
        EXPECT_NEAR(f / beckmann - 1, (s * s - 4 * s + 2) / (2 * g), 20 / (g * g)) << theta_r;
    }
}

TEST(HeTorrance, VanishesWithTheSquareOfTheRoughness) {
    for (const double sigma : {1e-3, 1e-4, 1e-5}) {
        const double f = value("he_torrance", {sigma, 2, 1.5, 0, 0}, {30, 40, 0});
        const double smaller = value("he_torrance", {sigma / 10, 2, 1.5, 0, 0}, {30, 40, 0});
        EXPECT_NEAR(f / smaller, 100, 2e4 * sigma) << sigma;
    }
    EXPECT_NEAR(value("he_torrance", {1e-6, 2, 1.5, 0, 0.4}, {30, 40, 0}), 0.4 / kPi, 1e-9);
}

TEST(HeTorrance, HasNoLobeWhereThereIsNoRoughness) {
    for (const auto& [sigma, tau] : {std::pair{0.0, 2.0}, {0.0, 1e6}, {0.5, 0.0}, {0.0, 0.0}}) {
        const Values values = at("he_torrance", {sigma, tau, 1.5, 20, 0}, {{30, 30, 0}, {30, 40, 0}, {0, 0, 0}});
        EXPECT_THAT(values.f, testing::Each(0.0));
        for (std::size_t i = 0; i < 4 * values.f.size(); ++i) EXPECT_EQ(values.by_parameter[i], 0);
    }
}

TEST(HeTorrance, LeavesOnlyTheDiffuseTermWhereBothDirectionsGraze) {
    // In the mirror direction f_dd falls as cos^4, times the effective roughness, which falls like a logarithm.
    const auto lobe = [](double away) { return value("he_torrance", {0.3, 3, 1.5, 0, 0}, {90 - away, 90 - away, 0}); };
    EXPECT_GT(lobe(0.01) / lobe(0.001), 1e4);
    EXPECT_LT(lobe(0.01) / lobe(0.001), 2e4);
    EXPECT_LT(lobe(1e-3), 1e-6);
}

TEST(HeTorrance, IsFiniteWhereOneDirectionGrazes) {
    double before = value("he_torrance", {0.3, 3, 1.5, 0, 0}, {30, 89, 0});
    for (const double away : {0.1, 0.01, 1e-4, 1e-8}) {
        const Values values = at("he_torrance", {0.3, 3, 1.5, 0, 0}, {{30, 90 - away, 0}, {90 - away, 30, 0}});
        EXPECT_GT(values.f[0], 0);
        EXPECT_LT(values.f[0], 2 * before);
        EXPECT_NEAR(values.f[1], values.f[0], 1e-9 * values.f[0]);
        for (const double slope : values.by_parameter) EXPECT_TRUE(std::isfinite(slope));
        before = values.f[0];
    }
}

TEST(HeTorrance, IsSteadyThroughNormalIncidenceAndRetroReflection) {
    const std::vector<double> p{0.3, 1.7, 1.5, 0.2, 0};
    const double normal = value("he_torrance", p, {0, 20, 0});
    const double retro = value("he_torrance", p, {35, -35, 0});
    for (const double away : {1e-3, 1e-6, 1e-9, 1e-12}) {
        EXPECT_NEAR(value("he_torrance", p, {away, 20, 0}) / normal, 1, 0.2 * away);
        EXPECT_NEAR(value("he_torrance", p, {35, -35 - away, 0}) / retro, 1, 0.2 * away);
        EXPECT_NEAR(value("he_torrance", p, {35, 35, 180 - away}) / retro, 1, 0.2 * away);
    }
}

TEST(HeTorrance, SteepSurfacesAreFinite) {
    // tau/sigma ~ 1 and below: outside the theory, not outside the numbers.
    for (const double tau : {1.0, 0.3, 0.1, 1e-3})
        for (const Direction& d : std::vector<Direction>{{15, 15, 0}, {75, 75, 0}, {75, -75, 0}, {0, 80, 0}}) {
            const Values values = at("he_torrance", {1, tau, 1.5, 0.3, 0}, {d});
            EXPECT_TRUE(std::isfinite(values.f[0]) && values.f[0] >= 0) << tau;
            for (const double slope : values.by_parameter) EXPECT_TRUE(std::isfinite(slope)) << tau;
        }
}

TEST(HeTorrance, GentleSlopesHaveNoShadowingAndNoEffectiveRoughness) {
    // Then f depends on sigma through g alone, and on tau through T and a.
    const Values gentle = at("he_torrance", {0.1, 100, 1.5, 0, 0}, {{60, 60, 0}});
    EXPECT_NEAR(100 * gentle.by_parameter[1] / gentle.f[0], 2, 1e-12);  // tau df/dtau = 2 f at a = 0
    const double g = std::pow(4 * kPi * 0.1 * cos_deg(60), 2);
    EXPECT_NEAR(0.1 * gentle.by_parameter[0] / gentle.f[0], 2 * (-std::expm1(-g) / series_without_tangent(g) - g),
                1e-11);
}

TEST(HeTorrance, ReflectsAsARealIndexWhereTheImaginaryPartVanishes) {
    const Direction d{40, 55, 0};
    const double real = value("he_torrance", {0.1, 3, 1.5, 0, 0}, d);
    EXPECT_NEAR(value("he_torrance", {0.1, 3, 1.5, 1e-9, 0}, d) / real, 1, 1e-14);
    EXPECT_NEAR(value("he_torrance", {0.1, 3, 1.5, 1e-4, 0}, d) / real, 1, 1e-7);
    EXPECT_EQ(at("he_torrance", {0.1, 3, 1.5, 0, 0}, {d}).by_parameter[3], 0);
}

TEST(HeTorrance, IndexNearOneReflectsWithTheSquareOfTheContrast) {
    // F -> ((n-1)^2 + k^2) (1 + cos^2 2 theta_d)/(8 cos^4 theta_d)
    const Direction d{20, 50, 0};
    const double theta_d = 35;
    const double per_reflectance = value("he_torrance", {0.1, 3, 1.5, 0, 0}, d) / reflectance(1.5, 0, theta_d);
    for (const auto& [n, k] : std::vector<std::pair<double, double>>{{1 + 1e-5, 0}, {1, 1e-5}, {1 - 1e-6, 1e-6}}) {
        const double expected =
            ((n - 1) * (n - 1) + k * k) * (1 + std::pow(cos_deg(2 * theta_d), 2)) / (8 * std::pow(cos_deg(theta_d), 4));
        EXPECT_NEAR(value("he_torrance", {0.1, 3, n, k, 0}, d) / per_reflectance / expected, 1, 1e-4) << n << " " << k;
    }
    const Values none = at("he_torrance", {0.1, 3, 1, 0, 0}, {d});
    EXPECT_EQ(none.f[0], 0);
    EXPECT_EQ(none.by_parameter[2], 0);
    EXPECT_EQ(none.by_parameter[3], 0);
}

TEST(HeTorrance, TotalReflectionIsComplete) {
    // theta_d = 50 degrees is beyond the critical angle of 0.6, 36.9 degrees.
    const Direction d{45, 55, 0};
    const double f = value("he_torrance", {0.1, 3, 0.6, 0, 0}, d);
    const double per_reflectance = value("he_torrance", {0.1, 3, 1.5, 0, 0}, d) / reflectance(1.5, 0, 50);
    EXPECT_NEAR(f / per_reflectance, 1, 1e-13);
    // At its onset the slope by n is infinite from one side; that from the other is given.
    EXPECT_EQ(at("he_torrance", {0.1, 3, 0.5, 0, 0}, {{30, 30, 0}}).by_parameter[2], 0);
}

// ---- the paper's white plastic ----

TEST(Plastic, MirrorDirectionBrightensFiftyfoldFromFifteenToSeventyFiveDegrees) {
    // Wavelength 0.55 um; sigma, tau reconstructed from the paper's curves, whose lobes are 0.160 and 15.8.
    const std::vector<double> he{0.5125 / 0.55, 6.98 / 0.55, 1.5, 0, 0};
    const double he_15 = value("he_torrance", he, {15, 15, 0});
    const double he_75 = value("he_torrance", he, {75, 75, 0});
    EXPECT_NEAR(he_15, 0.160, 0.002);
    EXPECT_NEAR(he_75, 15.8, 0.2);
    // Two lobes of the paper's table 2.
    const std::vector<double> lafortune{0, -1.22, -0.142, 21.4, -1.04, 0.893, 21.1};
    const double lobes_15 = value("lafortune_2", lafortune, {15, 15, 0});
    const double lobes_75 = value("lafortune_2", lafortune, {75, 75, 0});
    EXPECT_NEAR(lobes_15, 0.116, 0.001);
    EXPECT_NEAR(lobes_75, 15.2, 0.1);
    // The lobes alone rise a hundredfold; with the diffuse terms of the table the value does by fifty.
    const double he_rise = (he_75 + 0.534 / kPi) / (he_15 + 0.534 / kPi);
    const double lafortune_rise = (lobes_75 + 0.542 / kPi) / (lobes_15 + 0.542 / kPi);
    EXPECT_NEAR(he_rise, 50, 5);
    EXPECT_NEAR(lafortune_rise, 50, 5);
    std::printf("plastic, 15 to 75 degrees: He-Torrance x %.1f (its lobe x %.0f), Lafortune x %.1f (x %.0f)\n", he_rise,
                he_75 / he_15, lafortune_rise, lobes_75 / lobes_15);
}

TEST(Plastic, LobesOfPhongAndWardCannotRiseMoreThanTheInverseCosine) {
    const double rise = cos_deg(15) / cos_deg(75);
    for (const double n : {1.0, 67.8, 1e4})
        EXPECT_NEAR(value("phong", {0, 1, n}, {75, 75, 0}) / value("phong", {0, 1, n}, {15, 15, 0}), rise, 1e-9);
    for (const double alpha : {0.01, 0.1, 1.0})
        EXPECT_NEAR(value("ward", {0, 1, alpha}, {75, 75, 0}) / value("ward", {0, 1, alpha}, {15, 15, 0}), rise, 1e-9);
    EXPECT_LT(rise, 4);
}

}  // namespace
}  // namespace brdfit::tests
