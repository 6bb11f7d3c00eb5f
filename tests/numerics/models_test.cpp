// Every model against the high-precision reference, on every way the kernel text can run, and the physics it states.

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <functional>
#include <limits>
#include <numbers>
#include <ostream>

#include "kernels/geometry.h"
#include "tests/numerics/host_kernel.h"
#include "tests/numerics/reference.h"
#include "tests/support.h"

namespace brdfit::tests {
namespace {

using kernels::Direction;
using kernels::Model;
using kernels::Precision;
constexpr double kPi = std::numbers::pi;

// ---- golden values ----

/// A reference of f_spec = f - diffuse/pi, with more digits and a wider range than double.
struct Golden {
    std::vector<double> parameters;
    Direction direction;
    bool single = false;  ///< every parameter is a float: the point serves both precisions
    long double specular = 0;
    std::vector<long double> gradient;
    long double condition = 0;  ///< sum over parameters |p df_spec/dp|/|f_spec|
    long double slope_condition = 0;
};

/// A term without nonlinear parameters: the diffuse one.
bool is_diffuse(const Model& model, std::size_t parameter) {
    return std::any_of(model.terms.begin(), model.terms.end(),
                       [&](const kernels::Term& t) { return t.factor == parameter && t.of.empty(); });
}

double column(const char* name, const Direction& direction) {
    for (const kernels::GeometryColumn& c : kernels::geometry_columns())
        if (c.name == name) return c.value(kernels::Angles(canonical(direction)));
    throw std::invalid_argument(name);
}

/// Special directions first, then random ones: the whole hemisphere, the plane of incidence, and close to the mirror
/// direction, where narrow lobes are.
Direction draw_direction(Random& random, std::size_t index) {
    static const std::vector<Direction> special{
        {0, 0, 0},     {0, 60, 0},      {45, 0, 0},       {15, 15, 0},      {75, 75, 0},      {89.9, 89.9, 0},
        {30, -30, 0},  {75, -75, 0},    {30, 30, 180},    {89.9, -89.9, 0}, {89.9, 0, 0},     {0, -89.9, 0},
        {60, 60, 90},  {60, -20, -135}, {45, 45.001, 0},  {80, 89.9, 0},    {1e-3, 1e-3, 0},  {60, 60, 1e-3},
        {45, 45, 360}, {20, 89.9, 90},  {89.9, 89.9, 45}, {10, 9.9999, 0},  {89, -89.9, 179}, {0, 0, 123}};
    if (index < 3 * special.size()) return special[index % special.size()];
    Direction d;
    d.theta_i_deg = random.chance(0.1) ? random.uniform(85, 89.9) : random.uniform(0, 89.9);
    if (random.chance(0.6)) {
        const double away = std::pow(10, random.uniform(-4, 1.5)) * (random.chance(0.5) ? 1 : -1);
        d.theta_r_deg = std::clamp(d.theta_i_deg + away, -89.9, 89.9);
        if (random.chance(0.3)) d.phi_deg = std::pow(10, random.uniform(-4, 1.5));
    } else {
        d.theta_r_deg = random.uniform(-89.9, 89.9);
        if (random.chance(0.5)) d.phi_deg = random.uniform(-180, 180);
    }
    return d;
}

/// Parameters over the whole bounds. In every other point the heights of homogeneous lobes are brought to where the
/// lobe is neither 0 nor overflows.
std::vector<double> draw_parameters(Random& random, const Model& model, const Direction& direction, std::size_t index) {
    std::vector<double> p = random.parameters(model);
    for (const kernels::Term& term : model.terms) {
        if (!term.homogeneous || index % 4 == 3) continue;
        double& x = p[term.homogeneous->plane.first];
        double& y = p[term.homogeneous->plane.second];
        const double b = x * column("hxy", direction) + y * column("hz", direction);
        const double factor = std::exp(random.uniform(-30, 5) / p[term.homogeneous->degree]) / std::abs(b);
        const double larger = std::max(std::abs(x), std::abs(y)) * factor;
        if (!(larger <= 3 && larger >= 1e-3)) continue;
        x *= b > 0 ? factor : -factor;
        y *= b > 0 ? factor : -factor;
    }
    // The corners of the box, a real index among them.
    for (std::size_t i = 0; i < p.size(); ++i)
        if (!model.parameters[i].repeat && random.chance(0.05))
            p[i] = random.chance(0.5) ? model.parameters[i].min : model.parameters[i].max;
    return p;
}

/// A lobe b^n with b = x hxy + y hz has the slopes n b^(n-1) hxy, whose own condition is |n - 1| K with
/// K = (|x hxy| + |y hz|)/|b|. The value's, n K weighted with the lobe's share of f, does not cover that.
long double homogeneous_condition(const Model& model, const Golden& point) {
    long double largest = 0;
    for (const kernels::Term& term : model.terms) {
        if (!term.homogeneous) continue;
        const double x = point.parameters[term.homogeneous->plane.first] * column("hxy", point.direction);
        const double y = point.parameters[term.homogeneous->plane.second] * column("hz", point.direction);
        const double n = point.parameters[term.homogeneous->degree];
        if (x + y > 0) largest = std::max(largest, (1.0L + n) * (std::abs(x) + std::abs(y)) / (x + y));
    }
    return largest;
}

std::vector<Golden> draw_golden(const Model& model) {
    const bool costly = model.name == "he_torrance";
    const std::size_t count = count_from("BRDFIT_POINTS", (costly ? 300 : 2000) * (long_form() ? 10 : 1));
    Random random(20040203);
    std::vector<Golden> points;
    for (std::size_t i = 0; i < count; ++i) {
        Golden point;
        point.direction = draw_direction(random, i);
        point.parameters = draw_parameters(random, model, point.direction, i);
        point.single = i % 2 == 0;
        if (point.single)
            for (double& p : point.parameters) p = static_cast<float>(p);

        std::vector<double> specular = point.parameters;
        for (std::size_t j = 0; j < specular.size(); ++j)
            if (is_diffuse(model, j)) specular[j] = 0;
        const reference::Geometry geometry{point.direction.theta_i_deg, point.direction.theta_r_deg,
                                           point.direction.phi_deg};
        point.specular = reference::value(model.name, specular, geometry).convert_to<long double>();
        for (const auto& slope : reference::gradient(model.name, specular, geometry))
            point.gradient.push_back(slope.convert_to<long double>());
        if (point.specular > 0)
            for (std::size_t j = 0; j < specular.size(); ++j)
                point.condition += std::abs(static_cast<long double>(specular[j]) * point.gradient[j] / point.specular);
        point.slope_condition = point.condition + homogeneous_condition(model, point);
        points.push_back(std::move(point));
    }
    return points;
}

const std::vector<Golden>& golden(const Model& model) {
    static std::map<std::string, std::vector<Golden>> cache;
    auto [it, missing] = cache.try_emplace(label(model));
    if (missing) it->second = draw_golden(model);
    return it->second;
}

/// One way to run the kernel text: terms and slopes (candidates x term values x directions).
using Terms = std::function<std::vector<double>(const Model&, Precision, const std::vector<double>& parameters,
                                                const std::vector<Direction>&)>;

struct Backend {
    std::string name;
    Terms terms;
};
void PrintTo(const Backend& backend, std::ostream* out) { *out << backend.name; }

Terms on(kernels::Engine& (*device)()) {
    return [device](const Model& model, Precision precision, const std::vector<double>& parameters,
                    const std::vector<Direction>& directions) {
        const std::vector<double> none(directions.size(), 0.0);
        return kernels::Evaluator(device(), model, precision, directions, none, none).terms(parameters);
    };
}

const HostKernel& host_kernel(const Model& model, Precision precision) {
    const auto all = precision == Precision::double_precision ? host_kernels_double() : host_kernels_single();
    return *std::find_if(all.begin(), all.end(), [&](const HostKernel& k) { return k.label == label(model); });
}

std::vector<double> columns_of(const std::vector<Direction>& directions) {
    std::vector<double> columns;
    for (const kernels::GeometryColumn& c : kernels::geometry_columns())
        for (const Direction& direction : directions) columns.push_back(c.value(kernels::Angles(canonical(direction))));
    return columns;
}

std::vector<double> on_host(const Model& model, Precision precision, const std::vector<double>& parameters,
                            const std::vector<Direction>& directions) {
    return host_kernel(model, precision).terms(columns_of(directions), static_cast<int>(directions.size()), parameters);
}

std::vector<Backend> backends() { return {{"native", on(engine)}, {"one_lane", on(scalar_engine)}, {"host", on_host}}; }

/// f_spec and df/dp of one candidate at one direction from its terms.
struct Measured {
    double specular = 0;
    std::vector<double> gradient;
};

Measured combine(const Model& model, const std::vector<double>& parameters,
                 const std::function<double(std::size_t)>& term_value) {
    Measured result;
    result.gradient.assign(parameters.size(), 0.0);
    const std::vector<double> c = model.coefficients(parameters);
    std::size_t row = 0;
    for (std::size_t t = 0; t < model.terms.size(); ++t) {
        const kernels::Term& term = model.terms[t];
        if (!term.of.empty()) result.specular += c[t] * term_value(row);
        if (term.factor) result.gradient[*term.factor] += term_value(row);
        ++row;
        for (const std::size_t parameter : term.of) result.gradient[parameter] += c[t] * term_value(row++);
    }
    return result;
}

std::string describe(const Model& model, const Golden& point) {
    std::string text;
    char buffer[100];
    for (std::size_t i = 0; i < point.parameters.size(); ++i) {
        std::snprintf(buffer, sizeof buffer, "%s=%a (%g) ", model.parameters[i].name.c_str(), point.parameters[i],
                      point.parameters[i]);
        text += buffer;
    }
    const Direction& d = point.direction;
    std::snprintf(buffer, sizeof buffer, "theta_i=%a theta_r=%a phi=%a (%g, %g, %g)", d.theta_i_deg, d.theta_r_deg,
                  d.phi_deg, d.theta_i_deg, d.theta_r_deg, d.phi_deg);
    return text + buffer;
}

/// The worst error of a kind and where it was.
struct Worst {
    double ratio = 0;
    std::string where = "nowhere";

    void add(long double error, long double unit, const std::string& at) {
        if (error == 0) return;
        const auto r = static_cast<double>(error / unit);
        if (!(r <= ratio)) {
            ratio = r;
            where = at;
        }
    }
};

class GoldenTest : public testing::TestWithParam<std::tuple<const Model*, Backend, Precision>> {};

TEST_P(GoldenTest, ValuesAndSlopesAreWithinTheirBounds) {
    const auto& [model, backend, precision] = GetParam();
    if (!engine().supports(precision)) GTEST_SKIP() << "the device lacks this precision";
    const bool is_double = precision == Precision::double_precision;
    const long double eps = is_double ? 0x1p-53L : 0x1p-24L;
    // Below, a factor of the result may lie under the smallest normal number, where it may be flushed to 0: He-Torrance
    // multiplies its series by up to 1e7. Above, Lafortune's lobe saturates.
    const long double smallest = is_double ? 1e-300L : 1e-30L;
    const long double largest = is_double ? 1e120L : 1e12L;

    std::vector<const Golden*> points;
    for (const Golden& point : golden(*model))
        if (is_double || point.single) points.push_back(&point);

    Worst value, slope;
    std::size_t compared = 0;
    constexpr std::size_t kChunk = 100;
    for (std::size_t first = 0; first < points.size(); first += kChunk) {
        const std::size_t n = std::min(kChunk, points.size() - first);
        std::vector<double> parameters;
        std::vector<Direction> directions;
        for (std::size_t i = 0; i < n; ++i) {
            const Golden& point = *points[first + i];
            parameters.insert(parameters.end(), point.parameters.begin(), point.parameters.end());
            directions.push_back(point.direction);
        }
        const std::vector<double> rows = backend.terms(*model, precision, parameters, directions);
        for (std::size_t i = 0; i < n; ++i) {
            const Golden& point = *points[first + i];
            const Measured got = combine(*model, point.parameters, [&](std::size_t row) {
                return rows[(i * model->term_values() + row) * n + i];
            });
            const long double f = point.specular;
            if (f > largest) {
                EXPECT_GT(static_cast<long double>(got.specular), largest / 2) << describe(*model, point);
                continue;
            }
            if (f < smallest) {
                EXPECT_LE(std::abs(static_cast<long double>(got.specular)), 2 * smallest) << describe(*model, point);
                continue;
            }
            ++compared;
            const std::string where = describe(*model, point);
            value.add(std::abs(got.specular - f), eps * (1 + point.condition) * f, where);
            for (std::size_t j = 0; j < point.gradient.size(); ++j) {
                const long double g = point.gradient[j];
                const long double p = point.parameters[j] == 0 ? 1.0L : static_cast<long double>(point.parameters[j]);
                slope.add(std::abs(got.gradient[j] - g),
                          eps * (1 + point.slope_condition) * std::max(std::abs(g), std::abs(f / p)),
                          model->parameters[j].name + " at " + where);
            }
        }
    }
    EXPECT_LE(value.ratio, 16) << value.where;
    EXPECT_LE(slope.ratio, 16) << slope.where;
    if (model->name != "lambert") {
        EXPECT_GT(compared, points.size() / 4);
    }
    std::printf("%-12s %-9s %-6s %5zu points: value %6.2f eps, slopes %6.2f eps\n", label(*model).c_str(),
                backend.name.c_str(), is_double ? "double" : "float", compared, value.ratio, slope.ratio);
    RecordProperty("worst_value_eps", std::to_string(value.ratio));
    RecordProperty("worst_slope_eps", std::to_string(slope.ratio));
}

INSTANTIATE_TEST_SUITE_P(Models, GoldenTest,
                         testing::Combine(testing::ValuesIn(variants()), testing::ValuesIn(backends()),
                                          testing::Values(Precision::double_precision, Precision::single_precision)),
                         [](const auto& parameter) {
                             const Precision precision = std::get<2>(parameter.param);
                             return label(*std::get<0>(parameter.param)) + "_" + std::get<1>(parameter.param).name +
                                    (precision == Precision::double_precision ? "_double" : "_float");
                         });

// ---- the host's skeleton ----

class HostTest : public testing::TestWithParam<const Model*> {};
INSTANTIATE_TEST_SUITE_P(Models, HostTest, testing::ValuesIn(variants()),
                         [](const auto& parameter) { return label(*parameter.param); });

TEST_P(HostTest, ProjectsAsTheDeviceDoes) {
    const Model& model = *GetParam();
    const std::vector<Direction> directions = scan_directions({15, 45, 70}, 5);
    Random random(9);
    std::vector<double> y, w, parameters;
    for (std::size_t j = 0; j < directions.size(); ++j) {
        y.push_back(random.uniform(0.1, 1));
        w.push_back(random.uniform(0, 1));
    }
    constexpr std::size_t kCandidates = 50;
    for (std::size_t i = 0; i < kCandidates; ++i) {
        std::vector<double> p = random.typical_parameters(model);
        for (const kernels::Term& term : model.terms)
            if (term.homogeneous) p[term.homogeneous->plane.first] /= 4, p[term.homogeneous->plane.second] /= 4;
        parameters.insert(parameters.end(), p.begin(), p.end());
    }
    const std::size_t t = model.terms.size();
    const std::vector<double> lower(kCandidates * t, 0.0), upper(kCandidates * t, 0.5);
    for (const Precision precision : {Precision::double_precision, Precision::single_precision}) {
        if (!engine().supports(precision)) continue;
        const std::vector<double> rows =
            host_kernel(model, precision).project(columns_of(directions), y, w, parameters, lower, upper);
        kernels::Evaluator evaluator(engine(), model, precision, directions, y, w);
        kernels::Batch batch;
        evaluator.project(parameters, lower, upper, true, batch);
        const std::size_t stride = 1 + 2 * t + model.parameters.size();
        for (std::size_t i = 0; i < kCandidates; ++i)
            EXPECT_NEAR(rows[i * stride], batch.loss[i],
                        (precision == Precision::double_precision ? 1e-10 : 1e-4) * batch.loss[i]);
    }
}

}  // namespace
}  // namespace brdfit::tests
