#include "tests/numerics/hard_points.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <map>
#include <numbers>
#include <stdexcept>

#include "tests/numerics/reference.h"
#include "tests/support.h"

namespace brdfit::tests {
namespace {

using kernels::Direction;
using kernels::HardPoint;
using kernels::Model;

constexpr std::size_t kDrawn = 44;  // points of a model with parameters other than an albedo

/// Normal incidence, mirror, retro-reflection, grazing, across the plane, and a hair beside each.
const std::vector<Direction>& hard_directions() {
    static const std::vector<Direction> all{
        {0, 0, 0},        {0, 60, 0},        {45, 0, 0},      {15, 15, 0},          {75, 75, 0},
        {89.9, 89.9, 0},  {30, -30, 0},      {75, -75, 0},    {30, 30, 180},        {89.9, -89.9, 0},
        {89.9, 0, 0},     {0, -89.9, 0},     {60, 60, 90},    {60, -20, -135},      {45, 45.001, 0},
        {80, 89.9, 0},    {1e-3, 1e-3, 0},   {60, 60, 1e-3},  {89.999, 89.999, 0},  {20, 89.9, 90},
        {89.9, 89.9, 45}, {10, 9.9999, 0},   {89.999, 30, 0}, {0, 0, 123},          {89.999, -89.999, 0.01},
        {0, 1e-4, 0},     {60, 60.01, 0.01}, {85, 84, 1},     {89.99, 89.999, 0.1}, {70, 80, 10},
    };
    return all;
}

struct Listed {
    std::vector<double> parameters;
    Direction direction;
};

/// Extremes that no draw over the default bounds finds; the first parameter of all but he_torrance is the albedo.
const std::vector<Listed>& listed(const std::string& label) {
    static const std::map<std::string, std::vector<Listed>> all{
        {"lambert", {{{1}, {0, 0, 0}}, {{0.1}, {89.999, -89.999, 0}}, {{1e-6}, {60, 60, 90}}}},
        {"phong",
         {
             {{0, 1, 1e6}, {30, 30, 0}},      // the peak
             {{0, 1, 1e6}, {30, 30.01, 0}},   // within a very narrow lobe
             {{0, 1, 1e6}, {30, 30.3, 0.2}},  // in its tail
             {{0, 1, 1e6}, {60, 61.5, 0}},    // below single precision
             {{0, 1, 1e6}, {89.999, 89.998, 0}},
             {{0, 100, 1e5}, {0, 1e-3, 0}},
             {{0, 1, 1e5}, {89.999, 89.999, 0}},
             {{0, 1, 0.01}, {45, -44.99, 0}},  // the mirror angle near 90 degrees
             {{0, 1, 2}, {45, -44.9999, 0}},
             {{0, 1, 30}, {45, -44.9, 0}},
             {{0, 1, 6}, {89.999, 0.01, 0}},
             {{0, 1, 0.01}, {89.999, 89.999, 89}},
             {{0, 1, 66}, {20, -4, 90}},
             {{0, 1e-30, 10}, {20, -40, 0}},
             {{0, 1, 112}, {45, 45, 85}},     // near underflow of single precision
             {{0, 100, 1100}, {45, 45, 85}},  // and of double
             {{0, 1, 1e-6}, {80, -9.5, 0}},
         }},
        {"ward",
         {
             {{0, 1, 1e-4}, {30, 30, 0}},  // the peak of a very narrow lobe
             {{0, 1, 1e-4}, {30, 30.01, 0}},
             {{0, 1, 1e-4}, {30, 30.05, 0.05}},
             {{0, 1, 1e-4}, {30, 30.25, 0}},  // below single precision
             {{0, 1, 1e-4}, {89.999, 89.9989, 0}},
             {{0, 1, 1e-4}, {0, 1e-4, 0}},
             {{0, 1, 1e-3}, {75, 75, 0.05}},
             {{0, 100, 1e4}, {89.999, -89.999, 0}},  // grazing and back
             {{0, 1, 10}, {89.9, -60, 0}},
             {{0, 1, 10}, {0, 0, 0}},
             {{0, 1, 10}, {89.999, 0, 0}},
             {{0, 1, 0.04}, {30, -30, 0}},  // far from the peak
             {{0, 1, 0.025}, {30, -30, 0}},
             {{0, 1, 0.1}, {50, -35, 40}},
             {{0, 1e-30, 0.3}, {40, 20, 10}},
             {{0, 1, 0.24}, {60, -66, 0}},   // near underflow of single precision
             {{0, 1, 0.076}, {60, -66, 0}},  // and of double
         }},
        {"lafortune_1",
         {
             {{0, -1, 1 - 0x1p-24, 1e6}, {0, 0, 0}},  // very narrow, at its peak
             {{0, -1, 1 + 0x1p-20, 1e6}, {0, 0, 0}},
             {{0, -1, 1, 1e6}, {30, 30, 0}},
             {{0, -1, 1, 1e6}, {30, 30.1, 0.1}},
             {{0, -1, 1, 1e6}, {60, 61, 0}},         // below single precision
             {{0, 1, 1 + 0x1p-20, 1}, {45, 45, 0}},  // just off b = 0
             {{0, 1, 1 + 0x1p-20, 3}, {45, 45, 0}},
             {{0, 1, 1.01, 0.01}, {45, 45, 0}},
             {{0, 0.99, 1, 0.5}, {45, 45, 0}},
             {{0, -1, -0.3332, 2}, {60, 60, 0}},
             {{0, -1, 1, 0.01}, {89.999, 89.999, 0}},
             {{0, 1, 1, 100}, {89.999, -89.999, 0}},  // retro-reflection
             {{0, 1, 0, 1e5}, {89.99, -89.98, 0.01}},
             {{0, 0, 1, 20}, {89.9, 20, 0}},
             {{0, 0, 1, 50}, {89.999, 20, 77}},  // near underflow of double
             {{0, 0.001, 0.001, 9}, {20, -40, 30}},
             {{0, 3, 3, 20}, {10, -20, 0}},    // high
             {{0, 30, 30, 60}, {10, -20, 0}},  // higher than single precision goes
         }},
        {"lafortune_2",
         {
             {{0, -1, 1, 1e4, 1, 1, 1}, {30, 30.1, 0}},            // a narrow lobe on a wide one
             {{0, -1, 1, 1e4, 1, 1, 1}, {30, 40, 0}},              // the narrow one gone
             {{0, -1, 0.5, 2, 1, -0.5, 3}, {80, 80, 0}},           // one dark
             {{0, 1, 1 + 0x1p-16, 1, -0.1, 0.1, 1}, {45, 45, 0}},  // one just off b = 0
             {{0, -0.9, 0.9, 0.01, 1, 1, 1e5}, {60, -60, 0}},
             {{0, -1, 1, 500, -1.001, 0.999, 500}, {70, 71, 1}},  // two alike
         }},
        {"lafortune_3",
         {
             {{0, -1, 1, 1e4, -1, 1, 100, -1, 1, 1}, {60, 60.1, 0.1}},  // one about the other
             {{0, -1, 1, 1e5, 1, 1, 1e3, 0, 1, 2}, {75, -75, 0}},       // and back
             {{0, 1, 1 + 0x1p-12, 2, 1, 0.99, 2, -0.01, 0.01, 2}, {45, 45, 0}},
             {{0, -0.5, 0.5, 30, 0.01, 0.01, 3, -1, 1, 1e6}, {89.99, 89.99, 0}},
             {{0, -1, 0.7, 50, -1, 0.8, 50, -1, 0.9, 50}, {85, 80, 5}},
             {{0, -1e-3, 1e-3, 0.01, 1e-3, 1e-3, 5, 1e-3, -1e-3, 0.1}, {30, -50, 20}},
         }},
        {"he_torrance",
         {
             {{1e-6, 1, 1.5, 0, 0}, {85, 85, 0}},  // g = 1e-12
             {{1e-6, 0.01, 1.5, 0.1, 0}, {0, 0, 0}},
             {{1e-5, 1000, 1.5, 0, 0}, {30, 30.01, 0}},  // flat and smooth
             {{0.001, 10, 1.5, 1, 0}, {30, 31, 0}},
             {{0.01, 1000, 2, 3, 0}, {60, 60.05, 0.01}},  // tau/sigma = 1e5
             {{0.1, 1000, 1.5, 0, 0}, {60, 60, 0}},       // tau/sigma = 1e4
             {{0.1, 1000, 1.5, 0, 0}, {60, 60.1, 0}},
             {{0.5, 200, 1.5, 0.5, 0}, {45, 46, 1}},
             {{25, 1000, 1.5, 0, 0}, {0, 0, 0}},  // g = 1e5
             {{25, 1000, 1.5, 4, 0}, {30, 33, 2}},
             {{20, 200, 0.2, 3, 0}, {70, 75, 0}},
             {{10, 10, 1.5, 0, 0}, {60, 50, 30}},  // tau/sigma = 1
             {{10, 10, 1.5, 0, 0}, {89.999, 89.999, 0}},
             {{1, 1, 1.3, 0, 0}, {89.9, 80, 0}},
             {{1, 1, 0.05, 20, 0}, {30, -30, 0}},
             {{0.3, 3, 1 + 0x1p-10, 0, 0}, {40, 40, 0}},  // hardly an interface
             {{0.3, 3, 1 + 0x1p-20, 0, 0}, {40, 10, 0}},
             {{0.3, 3, 1, 0x1p-10, 0}, {40, 45, 10}},
             {{0.3, 3, 1, 20, 0}, {40, 45, 10}},
             {{0.3, 3, 20, 20, 0}, {89.9, 89.9, 0}},
             {{0.3, 3, 1.5, 0, 0}, {56.31, 56.31, 0}},      // Brewster's angle
             {{0.3, 3, 0.2, 3.5, 0}, {89.999, 89.999, 0}},  // silver, grazing
             {{0.3, 3, 0.2, 3.5, 0}, {89.999, 0, 0}},
             {{0.18, 1.5, 0.0563, 18, 0}, {84.5, 89.9, 0}},  // an index nearly imaginary: dF/dk cancels
             {{0.2, 1.5, 0.05, 20, 0}, {89.9, 89.9, 0}},
             {{0.0045, 0.66, 0.11, 18.9, 0}, {88.81, 88.8103, 0.0147}},
             {{0.2, 2, 0.05, 0.01, 0}, {45, 46, 0}},
             {{0.05, 2, 1.5, 0, 0}, {89.999, -89.999, 0}},  // retro-reflection, grazing
             {{0.05, 3, 1.5, 0, 0}, {60, -60, 0}},          // near underflow of single precision
             {{0.05, 12, 1.5, 0, 0}, {60, -60, 0}},         // below it
             {{2, 20, 1.5, 0, 0}, {60, -60, 0}},
             {{0.03, 0.1, 1.5, 2, 0}, {0, 1e-3, 0}},
             {{1, 10, 1.5, 0, 0}, {75, 40, 0}},   // an ordinary rough surface
             {{0.2, 5, 2.5, 3, 0}, {45, 45, 0}},  // an ordinary smooth metal
         }},
    };
    static const std::vector<Listed> none;
    const auto it = all.find(label.starts_with("he_torrance") ? "he_torrance" : label);
    return it == all.end() ? none : it->second;
}

double sin_deg(double degrees) { return std::sin(degrees * std::numbers::pi / 180); }
double cos_deg(double degrees) { return std::cos(degrees * std::numbers::pi / 180); }
/// The products that a lobe's base is made of.
double hxy(const Direction& d) { return -sin_deg(d.theta_i_deg) * sin_deg(d.theta_r_deg) * cos_deg(d.phi_deg); }
double hz(const Direction& d) { return cos_deg(d.theta_i_deg) * cos_deg(d.theta_r_deg); }

Direction draw_direction(Random& random, std::size_t index) {
    if (index < hard_directions().size()) return hard_directions()[index];
    Direction d;
    d.theta_i_deg = random.uniform(0, 89.9);
    const double away = std::pow(10, random.uniform(-4, 1.5)) * (random.chance(0.5) ? 1 : -1);
    d.theta_r_deg = std::clamp(d.theta_i_deg + away, -89.9, 89.9);
    if (random.chance(0.5)) d.phi_deg = std::pow(10, random.uniform(-4, 1.5));
    return d;
}

/// Over the whole bounds, corners among them; heights of homogeneous lobes where the lobe neither vanishes nor
/// overflows.
std::vector<double> draw_parameters(Random& random, const Model& model, const Direction& direction) {
    std::vector<double> p = random.parameters(model);
    for (const kernels::Term& term : model.terms) {
        if (!term.homogeneous) continue;
        double& x = p[term.homogeneous->plane.first];
        double& y = p[term.homogeneous->plane.second];
        const double b = x * hxy(direction) + y * hz(direction);
        const double factor = std::exp(random.uniform(-30, 5) / p[term.homogeneous->degree]) / std::abs(b);
        const double larger = std::max(std::abs(x), std::abs(y)) * factor;
        if (!(larger <= 3 && larger >= 1e-3)) continue;
        x *= b > 0 ? factor : -factor;
        y *= b > 0 ? factor : -factor;
    }
    for (std::size_t i = 0; i < p.size(); ++i)
        if (!model.parameters[i].repeat && random.chance(0.05))
            p[i] = random.chance(0.5) ? model.parameters[i].min : model.parameters[i].max;
    // An albedo in front hides the lobe.
    for (const kernels::Term& term : model.terms)
        if (term.factor && term.of.empty()) p[*term.factor] = 0;
    return p;
}

HardPoint point_of(const Model& model, const std::vector<double>& parameters, const Direction& direction) {
    HardPoint point{model.name, model.repeats, {}, direction, 0, {}};
    std::transform(parameters.begin(), parameters.end(), point.parameters.begin(),
                   [](double p) { return static_cast<float>(p); });
    return point;
}

std::vector<double> parameters_of(const Model& model, const HardPoint& point) {
    return {point.parameters.begin(), point.parameters.begin() + static_cast<std::ptrdiff_t>(model.parameters.size())};
}

reference::Geometry geometry_of(const HardPoint& point) {
    return {point.direction.theta_i_deg, point.direction.theta_r_deg, point.direction.phi_deg};
}

long double value_of(const Model& model, const HardPoint& point) {
    return reference::value(model.name, parameters_of(model, point), geometry_of(point)).convert_to<long double>();
}

bool is_held(long double value) { return value >= 1e-300L && value <= 1e120L; }

}  // namespace

std::vector<HardPoint> choose_hard_points(const Model& model) {
    std::vector<HardPoint> points;
    for (const Listed& entry : listed(label(model))) {
        points.push_back(point_of(model, entry.parameters, entry.direction));
        if (!is_held(value_of(model, points.back())))
            throw std::logic_error("double cannot hold the value at " + text_of(model, points.back()));
    }
    const bool has_lobe =
        std::any_of(model.terms.begin(), model.terms.end(), [](const kernels::Term& term) { return !term.of.empty(); });
    Random random(20040203);
    for (std::size_t drawn = 0, tries = 0; has_lobe && drawn < kDrawn && tries < 100 * kDrawn; ++tries) {
        const Direction direction = draw_direction(random, tries);
        const HardPoint point = point_of(model, draw_parameters(random, model, direction), direction);
        if (!is_held(value_of(model, point))) continue;
        points.push_back(point);
        ++drawn;
    }
    return points;
}

void refer(const Model& model, HardPoint& point) {
    const std::vector<double> p = parameters_of(model, point);
    const reference::Real value = reference::value(model.name, p, geometry_of(point));
    const std::vector<reference::Real> slopes = reference::gradient(model.name, p, geometry_of(point));
    point.value = value.convert_to<long double>();
    for (std::size_t i = 0; i < p.size(); ++i) {
        // A slope that is 0 comes out of the differences as noise.
        const reference::Real scale = p[i] == 0 ? value : reference::Real(value / p[i]);
        point.slopes[i] = abs(slopes[i]) < 1e-36 * abs(scale) ? 0 : slopes[i].convert_to<long double>();
    }
}

std::string text_of(const Model& model, const HardPoint& point) {
    std::string text = "{\"" + model.name + "\", " + std::to_string(model.repeats) + ", {";
    char buffer[64];
    const auto add = [&](const char* format, auto number, bool first) {
        std::snprintf(buffer, sizeof buffer, format, number);
        text += (first ? "" : ", ") + std::string(buffer);
    };
    for (std::size_t i = 0; i < model.parameters.size(); ++i)
        add("%aF", static_cast<double>(point.parameters[i]), i == 0);
    text += "}, {";
    add("%a", point.direction.theta_i_deg, true);
    add("%a", point.direction.theta_r_deg, false);
    add("%a", point.direction.phi_deg, false);
    text += "}, ";
    add("%LaL", point.value, true);
    text += ", {";
    for (std::size_t i = 0; i < model.parameters.size(); ++i) add("%LaL", point.slopes[i], i == 0);
    return text + "}},\n";
}

}  // namespace brdfit::tests
