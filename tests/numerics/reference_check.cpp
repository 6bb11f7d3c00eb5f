// The reference itself against facts that were derived another way: closed forms, limits, symmetries, an
// integral.

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <boost/math/constants/constants.hpp>
#include <boost/math/quadrature/gauss_kronrod.hpp>
#include <boost/math/special_functions/bessel.hpp>
#include <cmath>
#include <complex>
#include <cstddef>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "reference.h"
#include "tests/numerics/points.h"

namespace brdfit::reference {
namespace {

using Parameters = std::vector<double>;

const Real kPi = boost::math::constants::pi<Real>();
constexpr double kPiDouble = boost::math::constants::pi<double>();

Real relativeDifference(const Real& a, const Real& b) { return abs(a - b) / abs(b); }

double radians(double degrees) { return degrees * kPiDouble / 180; }

// M_1 = sum e^-g g^m / (m! m) exp(-a/m) from f of he_torrance at normal incidence and exitance, where the
// shadowing is 1, the effective roughness is sigma, and G = 4. a = 0 there and g = (4 pi sigma)^2.
Real seriesAtNormal(double sigma, double tau) {
    const Parameters p{sigma, tau, 1.5, 0, 0};
    const Real reflectance = Real(1) / 25;
    return value("he_torrance", p, Geometry{0, 0, 0}) / reflectance / kPi / (Real(tau) * tau);
}

// Ei(x) - gamma - ln x by Ramanujan's series, whose terms differ from those of M_1.
Real exponentialIntegral(const Real& x) {
    Real sum = 0;
    Real odd_reciprocals = 0;
    Real power = -2;  // (-1)^(n-1) x^n / (n! 2^(n-1))
    for (unsigned n = 1; n < 100000; ++n) {
        power *= -x / (2 * n);
        if (n % 2 == 1) {
            odd_reciprocals += Real(1) / n;
        }
        sum += power * odd_reciprocals;
        if (n > x && abs(power) < 1e-90) {
            break;
        }
    }
    return exp(x / 2) * sum;
}

// Rs and Rp of a dielectric from Snell's law and the sine and tangent laws.
Real dielectricReflectance(double n, const Real& theta) {
    const Real refracted = asin(sin(theta) / n);
    const Real s = sin(theta - refracted) / sin(theta + refracted);
    const Real p = tan(theta - refracted) / tan(theta + refracted);
    return (s * s + p * p) / 2;
}

TEST(HeTorranceReference, ZeroLateralMomentumGivesTheExponentialIntegral) {
    for (const double sigma : {0.003, 0.05, 0.2, 0.5, 1.0}) {
        const Real g = (4 * kPi * sigma) * (4 * kPi * sigma);
        const Real expected = exp(-g) * exponentialIntegral(g);
        EXPECT_LT(relativeDifference(seriesAtNormal(sigma, 3.0), expected), 1e-65) << sigma;
    }
}

TEST(HeTorranceReference, ZeroLateralMomentumFollowsTheAsymptoticSeriesOnVeryRoughSurfaces) {
    // Ei(g) ~ e^g / g (1 + 1!/g + 2!/g^2 + ...), up to its smallest term.
    for (const double sigma : {3.0, 8.0, 20.0}) {
        const Real g = (4 * kPi * sigma) * (4 * kPi * sigma);
        Real term = 1 / g;
        Real expected = 0;
        for (unsigned m = 1; m < 60; ++m) {
            expected += term;
            term *= m / g;
        }
        EXPECT_LT(relativeDifference(seriesAtNormal(sigma, 3.0), expected), 1e-60) << sigma;
    }
}

TEST(HeTorranceReference, RoughSurfaceApproachesTheBeckmannMicrofacetModel) {
    // The steep slopes are absent (tau / sigma = 40), so neither shadowing nor effective roughness enters.
    for (const double theta_r : {20.0, 22.0, 24.5, 27.0}) {
        for (const double sigma : {2.5, 8.0}) {
            const double theta_i = 20;
            const double tau = 40 * sigma;
            const Real to_radians = kPi / 180;
            const Real cos_i = cos(theta_i * to_radians);
            const Real cos_r = cos(theta_r * to_radians);
            const Real delta = (theta_r - theta_i) / 2 * to_radians;
            const Real theta_d = (theta_r + theta_i) / 2 * to_radians;
            const Real slope = 2 * sigma / Real(tau);
            const Real s = pow(tan(delta) / slope, 2);
            const Real g = pow(2 * kPi * sigma * (cos_i + cos_r), 2);
            const Real beckmann = dielectricReflectance(1.5, theta_d) * exp(-s) /
                                  (4 * kPi * slope * slope * pow(cos(delta), 4) * cos_i * cos_r);
            const Real f = value("he_torrance", Parameters{sigma, tau, 1.5, 0, 0}, Geometry{theta_i, theta_r, 0});
            const Real correction = (s * s - 4 * s + 2) / (2 * g);
            EXPECT_LT(abs(f / beckmann - 1 - correction), 10 / (g * g)) << theta_r << " " << sigma;
            EXPECT_GT(g, 800);
        }
    }
}

TEST(HeTorranceReference, LobeIsTheKirchhoffIntegralOfAGaussianSurface) {
    // Without shadowing: M_1 = int_0^inf [exp(-g (1 - exp(-x^2))) - exp(-g)] J_0(2 sqrt(a) x) 2 x dx.
    for (const double phi : {0.0, 3.0, 40.0}) {
        for (const double sigma : {0.02, 0.1, 0.3}) {
            const double theta_i = 30;
            const double theta_r = 37;
            const double tau = 40 * sigma;
            const double ci = std::cos(radians(theta_i));
            const double cr = std::cos(radians(theta_r));
            const double si = std::sin(radians(theta_i));
            const double sr = std::sin(radians(theta_r));
            const double lateral = si * si + sr * sr - 2 * si * sr * std::cos(radians(phi));
            const double g = std::pow(2 * kPiDouble * sigma * (ci + cr), 2);
            const double a = std::pow(kPiDouble * tau, 2) * lateral;
            const auto integrand = [&](double x) {
                return (std::exp(g * std::expm1(-x * x)) - std::exp(-g)) *
                       boost::math::cyl_bessel_j(0, 2 * std::sqrt(a) * x) * 2 * x;
            };
            double integral = 0;
            for (int piece = 0; piece < 40; ++piece) {
                integral += boost::math::quadrature::gauss_kronrod<double, 61>::integrate(integrand, piece * 0.175,
                                                                                          (piece + 1) * 0.175, 0);
            }
            const double cos_d = std::sqrt((1 + ci * cr - si * sr * std::cos(radians(phi))) / 2);
            const double reflectance = dielectricReflectance(1.5, Real(std::acos(cos_d))).convert_to<double>();
            const double geometric = std::pow(4 * cos_d * cos_d / (ci + cr), 2);
            const double factor = reflectance * geometric * std::pow(kPiDouble * tau, 2) / 4 / (kPiDouble * ci * cr);
            const Real f = value("he_torrance", Parameters{sigma, tau, 1.5, 0, 0}, Geometry{theta_i, theta_r, phi});
            EXPECT_NEAR(f.convert_to<double>(), factor * integral, factor * 2e-15) << phi << " " << sigma;
        }
    }
}

TEST(HeTorranceReference, ObliqueRoughSurfaceHasTheShadowingAndEffectiveRoughnessOfItsSlopes) {
    // Both closed forms in double precision: S = x / (x + exp(-h^2)), x = sqrt(pi) h erfc(-h), and
    // sigma = sigma_0 / sqrt(1 + W), W exp(W) = (K_i + K_r)^2 / (8 pi).
    for (const double theta : {35.0, 60.0, 80.0, 88.0}) {
        const double sigma_0 = 0.4;
        const double tau = 1.1;
        const double cosine = std::cos(radians(theta));
        const double h = tau / (2 * sigma_0 * std::tan(radians(theta)));
        const double x = std::sqrt(kPiDouble) * h * std::erfc(-h);
        const double shadowing = x / (x + std::exp(-h * h));
        const double z = std::pow(2 * std::tan(radians(theta)) * std::erfc(h), 2) / (8 * kPiDouble);
        double w = 0;
        double high = z;
        for (int step = 0; step < 200; ++step) {
            const double middle = (w + high) / 2;
            (middle * std::exp(middle) < z ? w : high) = middle;
        }
        const double g = std::pow(4 * kPiDouble * sigma_0 * cosine, 2) / (1 + w);
        const double series = (exp(-Real(g)) * exponentialIntegral(Real(g))).convert_to<double>();
        const double reflectance = dielectricReflectance(1.5, Real(radians(theta))).convert_to<double>();
        const double expected =
            reflectance * 4 * shadowing * shadowing * std::pow(kPiDouble * tau, 2) / 4 * series / kPiDouble;
        const Real f = value("he_torrance", Parameters{sigma_0, tau, 1.5, 0, 0}, Geometry{theta, theta, 0});
        EXPECT_NEAR(f.convert_to<double>(), expected, 1e-13 * expected) << theta;
    }
}

TEST(HeTorranceReference, NormalIncidenceHasTheFresnelReflectanceOfTheComplexIndex) {
    const auto at = [](double n, double k) {
        return value("he_torrance", Parameters{0.1, 2, n, k, 0}, Geometry{0, 0, 0});
    };
    for (const auto& [n, k] : {std::pair{1.5, 0.0}, {0.2, 3.5}, {2.75, 3.79}, {1.001, 0.0}, {0.6, 0.0}, {1.0, 1e-6}}) {
        const Real expected =
            ((Real(n) - 1) * (Real(n) - 1) + Real(k) * k) / ((Real(n) + 1) * (Real(n) + 1) + Real(k) * k);
        // The reflectance of index 3 is 1/4.
        EXPECT_LT(relativeDifference(at(n, k) / at(3, 0) / 4, expected), 1e-60) << n << " " << k;
    }
}

TEST(HeTorranceReference, TotalReflectionIsComplete) {
    // theta_d = 50 degrees, above the critical angle asin(0.6) = 36.9 degrees; a mirror of huge k reflects
    // all as well.
    const Real f = value("he_torrance", Parameters{0.1, 2, 0.6, 0, 0}, Geometry{50, 50, 0});
    const Real mirror = value("he_torrance", Parameters{0.1, 2, 1, 1e70, 0}, Geometry{50, 50, 0});
    EXPECT_LT(relativeDifference(f, mirror), 1e-65);
}

TEST(HeTorranceReference, ObliqueIncidenceOnAMetalHasItsComplexAmplitudes) {
    const double n = 1.35;
    const double k = 4.2;
    const double theta = 70;
    const std::complex<double> index(n, k);
    const double c = std::cos(radians(theta));
    const std::complex<double> q = std::sqrt(index * index - 1.0 + c * c);
    const double expected =
        (std::norm((c - q) / (c + q)) + std::norm((index * index * c - q) / (index * index * c + q))) / 2;
    const Geometry geometry{theta, theta, 0};
    const Real f = value("he_torrance", Parameters{0.1, 20, n, k, 0}, geometry);
    const Real dielectric = value("he_torrance", Parameters{0.1, 20, 1.5, 0, 0}, geometry);
    const Real ratio = f / dielectric * dielectricReflectance(1.5, theta * kPi / 180);
    EXPECT_NEAR(ratio.convert_to<double>(), expected, 1e-14);
}

TEST(HeTorranceReference, DegenerateSurfacesAndGrazingDirectionsLeaveTheDiffuseTerm) {
    const Real diffuse = Real(0.25) / kPi;
    EXPECT_EQ(value("he_torrance", Parameters{0, 2, 1.5, 0, 0.25}, Geometry{30, 30, 0}), diffuse);
    EXPECT_EQ(value("he_torrance", Parameters{0.1, 2, 1.5, 0, 0.25}, Geometry{30, 90, 0}), diffuse);
    EXPECT_EQ(value("he_torrance", Parameters{0.1, 2, 1, 0, 0.25}, Geometry{0, 0, 0}), diffuse);
}

TEST(PhongReference, LobeIsTheNormalisedPowerOfTheCosineToTheMirrorDirection) {
    // 60 degrees from the mirror direction: cos^3 = 1/8; incidence at 60 degrees doubles the lobe.
    EXPECT_LT(relativeDifference(value("phong", Parameters{0.5, 0.25, 3}, Geometry{60, 0, 0}),
                                 Real(0.5) / kPi + Real(0.25) * 4 / (2 * kPi) / 8 * 2),
              1e-70);
    // 120 degrees from it: no lobe, not even for the power 0.
    EXPECT_EQ(value("phong", Parameters{0.5, 0.25, 0}, Geometry{60, -60, 0}), Real(0.5) / kPi);
}

TEST(WardReference, LobeIsAGaussianOfTheTangentOfTheHalfVector) {
    // The half vector of 0 and 60 degrees is at 30: tan^2 = 1/3.
    const Real alpha_squared = Real(0.4) * 0.4;
    const Real lobe = Real(0.25) * exp(-1 / (3 * alpha_squared)) / (4 * kPi * alpha_squared * sqrt(Real(0.5)));
    EXPECT_LT(relativeDifference(value("ward", Parameters{0.5, 0.25, 0.4}, Geometry{0, 60, 0}), Real(0.5) / kPi + lobe),
              1e-70);
}

TEST(LambertReference, IsAlbedoOverPiInEveryDirection) {
    EXPECT_EQ(value("lambert", Parameters{0.5}, Geometry{60, -20, 35}), Real(0.5) / kPi);
    EXPECT_LT(relativeDifference(gradient("lambert", Parameters{0.5}, Geometry{10, 20, 0})[0], 1 / kPi), 1e-45);
}

TEST(LafortuneReference, WhitePlasticRowHasItsPublishedLobe) {
    // Westin, Li, Torrance, PCG-04-2 (2004), table 2: C_xy, C_z, n of two lobes.
    const Parameters p{0.542, -1.22, -0.142, 21.4, -1.04, 0.893, 21.1};
    const std::array<std::pair<double, double>, 3> lobes{{{15, 0.116}, {45, 0.487}, {75, 15.2}}};
    for (const auto& [theta, lobe] : lobes) {
        const Real f = value("lafortune", p, Geometry{theta, theta, 0}) - Real(0.542) / kPi;
        EXPECT_NEAR(f.convert_to<double>(), lobe, 0.005 * lobe) << theta;
    }
}

TEST(ReciprocalModels, ExchangeOfLightAndViewerLeavesTheValue) {
    const std::vector<std::pair<std::string, Parameters>> models{
        {"ward", {0.3, 0.2, 0.15}},
        {"lafortune", {0.542, -1.22, -0.142, 21.4, -1.04, 0.893, 21.1}},
        {"he_torrance", {0.3, 1.7, 1.5, 0.2, 0.4}},
        {"he_torrance", {0.9, 1.7, 0.3, 4, 0.1}}};
    for (const auto& [model, p] : models) {
        for (const double phi : {0.0, 25.0, 90.0, 171.5}) {
            EXPECT_LT(
                relativeDifference(value(model, p, Geometry{12, 71, phi}), value(model, p, Geometry{71, 12, phi})),
                1e-60)
                << model << " " << phi;
            // A viewer on the back side: the azimuth between the two stays the same.
            EXPECT_LT(
                relativeDifference(value(model, p, Geometry{12, -71, phi}), value(model, p, Geometry{71, -12, phi})),
                1e-60)
                << model << " " << phi;
        }
    }
}

TEST(ReferenceGeometry, NegativeExitanceIsTheOppositeAzimuth) {
    for (const auto& [model, p] : std::vector<std::pair<std::string, Parameters>>{
             {"phong", {0.3, 0.2, 7.5}}, {"ward", {0.3, 0.2, 0.5}}, {"he_torrance", {0.3, 1.7, 1.5, 0.2, 0.4}}}) {
        EXPECT_LT(relativeDifference(value(model, p, Geometry{40, -25, 0}), value(model, p, Geometry{40, 25, 180})),
                  1e-70);
    }
}

TEST(ReferenceGradient, DoesNotDependOnTheStep) {
    struct Case {
        std::string model;
        Parameters p;
        Geometry geometry;
    };
    const std::vector<Case> cases{{"phong", {0.3, 0.2, 7.5}, {40, 52, 10}},
                                  {"phong", {0, 0, 1e5}, {40, 40.2, 0}},
                                  {"ward", {0.3, 0.2, 0.15}, {40, 52, 10}},
                                  {"ward", {0.3, 0.2, 1e-3}, {40, 40.1, 0}},
                                  {"lafortune", {0.542, -1.22, -0.142, 21.4, -1.04, 0.893, 21.1}, {40, 52, 10}},
                                  {"lafortune", {0.1, 0, 1.1, 1e4}, {20, 23, 0}},
                                  {"he_torrance", {0.3, 1.7, 1.5, 0.2, 0.4}, {40, 52, 10}},
                                  {"he_torrance", {0.3, 1.7, 1.5, 0, 0}, {40, 52, 10}},
                                  {"he_torrance", {0.3, 1.7, 0.6, 0, 0.1}, {65, 70, 0}},
                                  {"he_torrance", {0.3, 1.7, 1, 0, 0.1}, {40, 52, 0}},
                                  {"he_torrance", {2.1, 1.7, 0.2, 3.5, 0.1}, {80, 85, 0}},
                                  {"he_torrance", {1e-3, 30, 1.5, 0, 0.1}, {20, -60, 0}},
                                  {"he_torrance", {5, 150, 1.5, 0, 0.1}, {10, 14, 0}}};
    for (const Case& c : cases) {
        const std::vector<Real> g = gradient(c.model, c.p, c.geometry);
        const std::vector<Real> other = gradient(c.model, c.p, c.geometry, Real("3.7e-22"));
        const Real f = value(c.model, c.p, c.geometry);
        ASSERT_EQ(g.size(), c.p.size());
        for (std::size_t i = 0; i < g.size(); ++i) {
            EXPECT_LE(abs(g[i] - other[i]), 1e-36 * (abs(g[i]) + abs(f))) << c.model << " " << i;
        }
    }
}

TEST(ReferenceGradient, AgreesWithDerivativesKnownInClosedForm) {
    const Geometry geometry{40, 52, 10};
    const Real f = value("ward", Parameters{0, 0.2, 0.15}, geometry);
    EXPECT_LT(relativeDifference(gradient("ward", Parameters{0, 0.2, 0.15}, geometry)[1], f / Real(0.2)), 1e-45);

    // 57 degrees from the mirror direction of a narrow lobe, under a diffuse term more than 10^40 times as
    // large.
    const Parameters narrow{0.5, 0.25, 180};
    const Geometry far{60, 3, 0};
    const Real weak = value("phong", Parameters{0, 0.25, 180}, far);
    EXPECT_LT(weak, 1e-40);
    EXPECT_LT(relativeDifference(gradient("phong", narrow, far)[1], weak / Real(0.25)), 1e-45);

    // One Lafortune lobe b^n: df/dn = f ln b, and f is homogeneous of degree n in (C_xy, C_z).
    const Parameters lobe{0, -1.04, 0.893, 21.1};
    const Real b_to_n = value("lafortune", lobe, geometry);
    const std::vector<Real> g = gradient("lafortune", lobe, geometry);
    EXPECT_LT(relativeDifference(g[1] * lobe[1] + g[2] * lobe[2], b_to_n * lobe[3]), 1e-44);
    EXPECT_LT(relativeDifference(g[3], b_to_n * log(b_to_n) / lobe[3]), 1e-44);

    // At normal directions sigma and tau enter he_torrance by g and tau^2 only: tau df/dtau = 2 f, and
    // g dM_1/dg = 1 - e^-g - g M_1.
    const Parameters he{0.15, 3, 1.5, 0, 0};
    const Geometry normal{0, 0, 0};
    const Real series = seriesAtNormal(0.15, 3);
    const Real roughness = pow(4 * kPi * 0.15, 2);
    const Real at_normal = value("he_torrance", he, normal);
    const std::vector<Real> h = gradient("he_torrance", he, normal);
    EXPECT_LT(relativeDifference(h[0] * he[0], 2 * at_normal * ((1 - exp(-roughness)) / series - roughness)), 1e-43);
    EXPECT_LT(relativeDifference(h[1] * he[1], 2 * at_normal), 1e-44);
    // F = ((n - 1) / (n + 1))^2: dF/dn = F 4 / (n^2 - 1); F is even in k there.
    EXPECT_LT(relativeDifference(h[2], at_normal * 4 / Real(1.25)), 1e-44);
    EXPECT_LT(abs(h[3]), 1e-44 * at_normal);
    EXPECT_LT(relativeDifference(h[4], 1 / kPi), 1e-44);
}

// ---- the narrower type and the differentiation against the wide type and differences, at extreme points ----

class ReferenceTypes : public testing::TestWithParam<std::string> {};
INSTANTIATE_TEST_SUITE_P(Models, ReferenceTypes,
                         testing::Values("phong", "ward", "lafortune_1", "lafortune_3", "he_torrance"),
                         [](const auto& parameter) { return parameter.param; });

Geometry geometryOf(const tests::Point& point) {
    return {point.direction.theta_i_deg, point.direction.theta_r_deg, point.direction.phi_deg};
}

TEST_P(ReferenceTypes, FastOneAgreesWithTheJudge) {
    const kernels::Model& model = tests::variant(GetParam());
    const bool costly = model.name == "he_torrance";
    const auto points = tests::golden(
        model, tests::draw_points(model, kernels::Precision::double_precision, costly ? 300 : 2000, 20040203));
    double worst = 0;
    std::string where;
    for (const tests::Golden& point : points) {
        if (!(point.specular > 1e-320L && point.specular < 1e320L)) continue;
        const Jet<Fast> fast = jet<Fast>(model.name, point.parameters, geometryOf(point));
        const Jet<Real> wide = jet<Real>(model.name, point.parameters, geometryOf(point));
        const auto check = [&](const Fast& a, const Real& b, long double size, long double condition) {
            const auto error = Real(abs(Real(a) - b) / (Real(size) * (1 + Real(condition)))).convert_to<double>();
            if (error <= worst) return;
            worst = error;
            where = tests::describe(model, point);
        };
        check(fast.specular, wide.specular, point.specular, point.condition);
        for (std::size_t j = 0; j < point.parameters.size(); ++j)
            check(fast.gradient[j], wide.gradient[j], tests::slope_size(point, j), point.slope_condition[j]);
    }
    EXPECT_LT(worst, 1e-22) << where;
    std::printf("%s: 113 bits agree with 256 bits to %.1e (1 + condition)\n", GetParam().c_str(), worst);
}

TEST_P(ReferenceTypes, DifferentiationAgreesWithDifferences) {
    const kernels::Model& model = tests::variant(GetParam());
    const bool costly = model.name == "he_torrance";
    const auto points = tests::golden(
        model, tests::draw_points(model, kernels::Precision::double_precision, costly ? 150 : 1000, 19910728));
    std::size_t compared = 0;
    for (const tests::Golden& point : points) {
        if (!(point.specular > 1e-320L && point.specular < 1e320L)) continue;
        // An index about the difference's step from 1; more terms than there is time for.
        if (costly && std::hypot(point.parameters[2] - 1, point.parameters[3]) < 1e-6) continue;
        if (costly && std::pow(2 * kPiDouble * point.parameters[0] * tests::Angles(point.direction).cs, 2) > 1e3)
            continue;
        // A coefficient of about the difference's step.
        if (model.name == "lafortune" && std::any_of(point.parameters.begin() + 1, point.parameters.end(),
                                                     [](double p) { return std::abs(p) < 1e-3; }))
            continue;
        ++compared;
        const Jet<Real> wide = jet<Real>(model.name, point.parameters, geometryOf(point));
        const std::vector<Real> differences = gradient(model.name, point.parameters, geometryOf(point));
        for (std::size_t j = 0; j < point.parameters.size(); ++j) {
            const Real size = Real(tests::slope_size(point, j)) * (1 + Real(point.slope_condition[j]));
            EXPECT_LT(abs(wide.gradient[j] - differences[j]), 1e-26 * size)
                << j << " at " << tests::describe(model, point);
        }
    }
    EXPECT_GT(compared, points.size() / 2);
}

TEST(ReferenceArguments, UnknownModelsAndWrongParameterCountsAreRefused) {
    const Geometry geometry{10, 20, 0};
    EXPECT_THROW(value("blinn", Parameters{1}, geometry), std::invalid_argument);
    EXPECT_THROW(value("phong", Parameters{1}, geometry), std::invalid_argument);
    EXPECT_THROW(gradient("lafortune", Parameters{0.1, 1, 1}, geometry), std::invalid_argument);
    EXPECT_THROW(value("ward", Parameters{0.1, 0.1, 0.1}, Geometry{10, 90, 0}), std::invalid_argument);
}

}  // namespace
}  // namespace brdfit::reference
