// Walks through the places where the kernels change their method: errors stay within their bound and do not jump.

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <functional>
#include <numbers>
#include <string>
#include <vector>

#include "tests/numerics/points.h"
#include "tests/support.h"

namespace brdfit::tests {
namespace {

using kernels::Direction;
using kernels::Precision;
using Parameters = std::vector<double>;
constexpr double kPi = std::numbers::pi;
constexpr double kRadian = kPi / 180;

/// Points in order along one unknown.
struct Walk {
    std::string name;
    std::string model;
    std::vector<double> steps;
    std::function<Point(double)> at;
};
void PrintTo(const Walk& walk, std::ostream* out) { *out << walk.name; }

/// Evenly in the logarithm.
std::vector<double> log_steps(double low, double high, int count) {
    std::vector<double> steps;
    for (int i = 0; i <= count; ++i) steps.push_back(low * std::pow(high / low, static_cast<double>(i) / count));
    return steps;
}

/// Towards a point from below and on from it: at relative distances from 0.1 to 1e-17 and the next numbers, of double
/// and of float, on both sides.
std::vector<double> through(double point) {
    const double size = point == 0 ? 1 : std::abs(point);
    std::vector<double> steps{point, std::nextafter(point, -1e9), std::nextafter(point, 1e9)};
    const auto nearest = static_cast<float>(point);
    for (const float bound : {-1e9F, 1e9F}) steps.push_back(std::nextafter(nearest, bound));
    for (const double away : log_steps(1e-17, 0.1, 64)) {
        steps.push_back(point - away * size);
        steps.push_back(point + away * size);
    }
    std::sort(steps.begin(), steps.end());
    return steps;
}

std::vector<double> within(std::vector<double> steps, double low, double high) {
    std::erase_if(steps, [&](double x) { return x < low || x > high; });
    return steps;
}

/// sigma for g at the directions, where the effective roughness does not enter.
double sigma_of(double g, const Direction& d) { return std::sqrt(g) / (2 * kPi * Angles(d).cs); }

std::vector<Walk> he_torrance_walks() {
    std::vector<Walk> walks;
    const auto add = [&](const std::string& name, std::vector<double> steps, std::function<Point(double)> at) {
        walks.push_back({"he_torrance_" + name, "he_torrance", std::move(steps), std::move(at)});
    };
    // The start of the series' window, its stride, the mode's start and the deviance's branches all follow g and a/g.
    for (const double s : {0.0, 0.3, 3.0, 30.0, 100.0})
        add("g_at_a_over_g_" + std::to_string(static_cast<int>(10 * s)), log_steps(5, 400, 600), [s](double g) {
            Direction d{25, 25, 0};
            const double sigma = sigma_of(g, d);
            const double tau = 150 * sigma;
            d.theta_r_deg = std::asin(std::sin(25 * kRadian) + std::sqrt(s * g) / (kPi * tau)) / kRadian;
            return Point{{sigma, tau, 1.5, 0.1, 0.3}, d};
        });
    add("g_small", log_steps(1e-12, 5, 300), [](double g) {
        const Direction d{10, 13, 0};
        return Point{{sigma_of(g, d), 40 * sigma_of(g, d) + 1, 1.5, 0, 0.3}, d};
    });
    add("g_large", log_steps(400, 1e5, 120), [](double g) {
        const Direction d{10, 10.5, 0};
        return Point{{sigma_of(g, d), 30 * sigma_of(g, d), 1.5, 0, 0.3}, d};
    });
    // From no tangential momentum to where every term underflows.
    for (const double g : {1e-8, 0.1, 1.0, 10.0, 60.0, 200.0})
        add("a_at_g_" + std::to_string(std::lround(10 * g)), log_steps(1e-4, 1e5, 300), [g](double a) {
            const Direction d{20, 50, 7};
            return Point{{sigma_of(g, d), std::sqrt(a / Angles(d).w) / kPi, 0.4, 3, 0.3}, d};
        });
    // Shadowing and effective roughness: h to 30 and beyond, Lambert's W from 0 through 1e-6 and 1.
    for (const double theta : {20.0, 60.0, 80.0, 89.0, 89.99})
        add("slope_at_" + std::to_string(std::lround(100 * theta)), log_steps(1, 1e4, 400), [theta](double ratio) {
            return Point{{0.05, 0.05 * ratio, 1.5, 0, 0.3}, {theta, theta - 1, 0}};
        });
    add("h_30", through(60 * std::tan(60 * kRadian)), [](double ratio) {
        return Point{{0.1, 0.1 * ratio, 1.5, 0, 0.3}, {60, 60, 0}};
    });
    // Total reflection begins; beside it, with a little absorption.
    for (const double k : {0.0, 1e-12, 1e-3})
        add("critical_n_at_k_" + std::to_string(std::lround(1e12 * k)), log_steps(1e-5, 0.3, 60), [k](double away) {
            return Point{{0.1, 2, std::sin(40 * kRadian) * (1 + away), k, 0.3}, {40, 40, 0}};
        });
    for (const double k : {0.0, 1e-12, 1e-3})
        add("below_critical_n_at_k_" + std::to_string(std::lround(1e12 * k)), log_steps(1e-5, 0.3, 60),
            [k](double away) {
                return Point{{0.1, 2, std::sin(40 * kRadian) * (1 - away), k, 0.3}, {40, 40, 0}};
            });
    add("equal_real_and_imaginary", through(1), [](double k) {
        return Point{{0.1, 2, 1, k, 0.3}, {0, 0, 0}};  // A changes its sign
    });
    add("n_through_1", through(1), [](double n) { return Point{{0.1, 2, n, 0, 0.3}, {40, 50, 0}}; });
    for (const double n : {0.3, 1.0, 1.5})
        add(
            "k_from_0_at_n_" + std::to_string(std::lround(10 * n)),
            [] {
                std::vector<double> steps = log_steps(1e-25, 20, 200);
                steps.insert(steps.begin(), 0.0);
                return steps;
            }(),
            [n](double k) {
                return Point{{0.1, 2, n, k, 0.3}, {40, 50, 0}};
            });
    return walks;
}

std::vector<Walk> angle_walks() {
    std::vector<Walk> walks;
    const std::vector<std::pair<std::string, Parameters>> models{{"phong", {0.3, 0.7, 20}},
                                                                 {"ward", {0.3, 0.7, 0.2}},
                                                                 {"lafortune_1", {0.3, -1.1, 0.8, 20}},
                                                                 {"he_torrance", {0.2, 2, 1.5, 0.2, 0.3}}};
    for (const auto& [model, p] : models) {
        const auto add = [&walks, name = model, parameters = p](const std::string& what, std::vector<double> steps,
                                                                std::function<Direction(double)> direction) {
            walks.push_back({name + "_" + what, name, std::move(steps), [parameters, direction](double x) {
                                 return Point{parameters, direction(x)};
                             }});
        };
        add("theta_i_45", through(45), [](double t) { return Direction{t, 40, 0}; });
        add("theta_r_45", through(45), [](double t) { return Direction{40, t, 0}; });
        add("half_sum_45", through(48), [](double t) { return Direction{42, t, 20}; });
        add("mirror_direction", through(30), [](double t) { return Direction{30, t, 0}; });
        add("normal", within(through(0), 0, 1), [](double t) { return Direction{t, 0, 0}; });
        add("viewer_through_normal", through(0), [](double t) { return Direction{10, t, 0}; });
        add("retro", through(30), [](double t) { return Direction{30, -t, 0}; });
        add("out_of_plane", through(0), [](double t) { return Direction{30, 35, t}; });
        add("phi_90", through(90), [](double t) { return Direction{30, 35, t}; });
        add("phi_180", through(180), [](double t) { return Direction{30, 35, t}; });
        add("towards_90", log_steps(1e-10, 90, 300), [](double t) { return Direction{90 - t, 90 - t, 0}; });
        add("viewer_towards_90", log_steps(1e-10, 90, 300), [](double t) { return Direction{50, 90 - t, 30}; });
    }
    return walks;
}

std::vector<Walk> other_walks() {
    std::vector<Walk> walks;
    const auto add = [&](const std::string& name, const std::string& model, std::vector<double> steps,
                         std::function<Point(double)> at) {
        walks.push_back({model + "_" + name, model, std::move(steps), std::move(at)});
    };
    for (const double n : {0.01, 1.0, 30.0}) {
        const std::string at_n = "_at_n_" + std::to_string(std::lround(100 * n));
        // 1 - cos alpha = 0.5 at 60 degrees, the lobe's end at 90.
        add("alpha_60" + at_n, "phong", through(60), [n](double t) { return Point{{0.3, 0.7, n}, {0, t, 0}}; });
        add("alpha_90" + at_n, "phong", through(30), [n](double t) { return Point{{0.3, 0.7, n}, {60, -t, 0}}; });
        add("alpha_90_out_of_plane" + at_n, "phong", through(90), [n](double t) {
            return Point{{0.3, 0.7, n}, {60, 89, t}};
        });
    }
    add("n", "phong", log_steps(1e-8, 1e6, 400), [](double n) { return Point{{0.3, 0.7, n}, {30, 32, 0}}; });
    for (const double theta : {30.0, 30.1, 31.0, 50.0, -80.0})
        add("alpha_at_" + std::to_string(std::lround(std::abs(10 * theta))), "ward", log_steps(1e-4, 10, 400),
            [theta](double alpha) {
                return Point{{0.3, 0.7, alpha}, {30, theta, 0}};
            });
    for (const double n : {0.5, 1.0, 2.0, 700.0, 1e6}) {
        const std::string at_n = "_at_n_" + std::to_string(std::lround(10 * n));
        // b = c_xy h_xy + c_z h_z with h_xy = h_z = 1/2 at exact retro-reflection from 45 degrees.
        add("b_0" + at_n, "lafortune_1", through(1), [n](double c) { return Point{{0.3, -1, c, n}, {45, -45, 0}}; });
        add("b_1" + at_n, "lafortune_1", through(1), [n](double c) { return Point{{0.3, 0, c, n}, {0, 0, 0}}; });
        add("b" + at_n, "lafortune_1", log_steps(1e-300, 1e300, 300), [n](double c) {
            return Point{{0.3, 0, c, n}, {20, 40, 0}};
        });
    }
    add("n", "lafortune_1", log_steps(1e-8, 1e6, 400), [](double n) {
        return Point{{0.3, -1.1, 0.9, n}, {30, 32, 0}};
    });
    return walks;
}

std::vector<Walk> all_walks() {
    std::vector<Walk> walks = he_torrance_walks();
    for (const auto& more : {angle_walks(), other_walks()}) walks.insert(walks.end(), more.begin(), more.end());
    return walks;
}

class Seams : public testing::TestWithParam<std::tuple<Walk, Precision>> {};
INSTANTIATE_TEST_SUITE_P(Walks, Seams,
                         testing::Combine(testing::ValuesIn(all_walks()),
                                          testing::Values(Precision::double_precision, Precision::single_precision)),
                         [](const auto& parameter) {
                             const bool is_double = std::get<1>(parameter.param) == Precision::double_precision;
                             return std::get<0>(parameter.param).name + (is_double ? "_double" : "_float");
                         });

TEST_P(Seams, ErrorsStayWithinTheirBoundAndDoNotJump) {
    const auto& [walk, precision] = GetParam();
    if (!engine().supports(precision)) GTEST_SKIP() << "the device lacks this precision";
    const kernels::Model& model = variant(walk.model);
    const Range& range = range_of(precision);
    std::vector<Point> path;
    for (const double step : walk.steps) {
        Point point = walk.at(step);
        round_to(precision, point.parameters);
        // Not numbers of this precision, or a product with them may be none.
        if (std::any_of(point.parameters.begin(), point.parameters.end(),
                        [&](double p) { return !std::isfinite(p) || (p != 0 && std::abs(p) < 1e8L * range.smallest); }))
            continue;
        path.push_back(std::move(point));
    }
    const std::vector<Golden> points = golden(model, path);
    for (const Backend& backend : backends()) {
        const std::vector<Measured> got = measure(model, precision, backend, points);
        Errors errors(model, precision);
        double jump = 0;
        std::string where;
        std::vector<double> before;
        for (std::size_t i = 0; i < points.size(); ++i) {
            errors.add(points[i], got[i]);
            const std::vector<double> now = errors_of(range, points[i], got[i]);
            for (std::size_t j = 0; j < before.size(); ++j) {
                // The kernel's change less the reference's own, in eps (1 + condition).
                const double change = std::abs(now[j] - before[j]);
                if (!(change > jump)) continue;
                jump = change;
                where = (j == 0 ? "f" : model.parameters[j - 1].name) + " before " + describe(model, points[i]);
            }
            before = now;
        }
        EXPECT_EQ(errors.broken, 0U) << backend.name << ": " << errors.broken_where;
        EXPECT_LE(errors.value.ratio, kBound) << backend.name << ": " << errors.value.where;
        EXPECT_LE(errors.slope.ratio, kBound) << backend.name << ": " << errors.slope.where;
        EXPECT_LE(jump, kBound) << backend.name << ": " << where;
        RecordProperty(backend.name + "_jump_eps", std::to_string(jump));
    }
}

}  // namespace
}  // namespace brdfit::tests
