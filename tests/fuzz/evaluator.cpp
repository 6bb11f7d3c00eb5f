// The kernel text as host C++: parameters anywhere in a model's domain, any directions, any data. Values and slopes are
// finite, values are not negative, and the linear coefficients stay within their bounds.

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "kernels/geometry.h"
#include "tests/fuzz/fuzz.h"
#include "tests/numerics/host_kernel.h"
#include "tests/support.h"

using namespace brdfit;
using fuzz::Bytes;

namespace {

/// Even over [low, high], or even in the logarithm for a range that allows it.
double between(double low, double high, double fraction, bool logarithmic) {
    const double value = logarithmic && low > 0 ? low * std::pow(high / low, fraction) : low + (high - low) * fraction;
    return std::clamp(value, low, high);
}

double parameter_from(Bytes& bytes, const kernels::Parameter& p) {
    const double low = p.domain_min;
    const double high = p.domain_max;
    const bool logarithmic = p.scale == kernels::Scale::logarithmic;
    const std::uint8_t kind = bytes.byte();
    const double fraction = bytes.fraction();
    double value = 0;
    switch (kind % 6) {
        case 0: value = between(p.min, p.max, fraction, logarithmic); break;
        case 1: value = between(p.typical_min, p.typical_max, fraction, logarithmic); break;
        case 2: value = between(low, high, fraction, logarithmic); break;
        case 3: value = std::ldexp(1.0, static_cast<int>(fraction * 1200) - 600); break;
        case 4: value = -std::ldexp(1.0, static_cast<int>(fraction * 1200) - 600); break;
        default: {
            const double ends[] = {low, high, p.min, p.max, 0, 1, std::nextafter(1.0, 0.0), std::nextafter(1.0, 2.0)};
            value = ends[static_cast<std::size_t>(fraction * 7.99)];
        }
    }
    return std::clamp(value, low, high);
}

/// From 0 to below the steepest: evenly, close to it, close to 0, or beside another angle.
double angle_from(Bytes& bytes, double other) {
    const double steepest = 90;
    const double below = std::nextafter(steepest, 0.0);
    const std::uint8_t kind = bytes.byte();
    const double fraction = bytes.fraction();
    const double tiny = std::ldexp(1.0, -static_cast<int>(fraction * 60));
    double value = 0;
    switch (kind % 6) {
        case 0: value = 90 * fraction; break;
        case 1: value = steepest - tiny; break;
        case 2: value = tiny; break;
        case 3: value = other; break;
        case 4: value = other + tiny; break;
        default: value = std::floor(89 * fraction); break;
    }
    return std::min(value, below);
}

kernels::Direction direction_from(Bytes& bytes) {
    kernels::Direction d;
    d.theta_i_deg = angle_from(bytes, 0);
    d.theta_r_deg = angle_from(bytes, d.theta_i_deg);
    const std::uint8_t kind = bytes.byte();
    if (kind & 1U) d.theta_r_deg = -d.theta_r_deg;
    const double sign = kind & 2U ? -1 : 1;
    switch (kind / 4 % 4) {
        case 0: d.phi_deg = 0; break;
        case 1: d.phi_deg = sign * 360 * bytes.fraction(); break;
        case 2: d.phi_deg = sign * std::ldexp(1.0, static_cast<int>(bytes.fraction() * 100) - 90); break;
        default: d.phi_deg = sign * 45 * std::floor(bytes.fraction() * 8); break;
    }
    return d;
}

/// A measured value, or a weight: 0, or any size from 1e-12 to 1e6.
double size_from(Bytes& bytes) {
    const std::uint8_t kind = bytes.byte();
    return kind % 8 == 0 ? 0.0 : std::pow(10.0, 18 * (kind / 255.0) - 12);
}

struct Case {
    const kernels::Model& model;
    const tests::HostKernel& kernel;
    std::vector<double> parameters;
    std::vector<kernels::Direction> directions;
};

/// The case in hexadecimal floats, for a report.
std::string describe(const Case& at) {
    std::string text(at.kernel.label);
    text += at.kernel.precision == kernels::Precision::double_precision ? " double" : " single";
    char buffer[120];
    for (std::size_t i = 0; i < at.parameters.size(); ++i) {
        std::snprintf(buffer, sizeof buffer, " %s=%a (%g)", at.model.parameters[i].name.c_str(), at.parameters[i],
                      at.parameters[i]);
        text += buffer;
    }
    for (const kernels::Direction& d : at.directions) {
        std::snprintf(buffer, sizeof buffer, " [%a %a %a] (%g %g %g)", d.theta_i_deg, d.theta_r_deg, d.phi_deg,
                      d.theta_i_deg, d.theta_r_deg, d.phi_deg);
        text += buffer;
    }
    return text;
}

void check_terms(const Case& at, const std::vector<double>& columns) {
    const std::size_t n = at.directions.size();
    const std::vector<double> rows = at.kernel.terms(columns, static_cast<int>(n), at.parameters);
    std::size_t row = 0;
    const auto check = [&](const std::string& name, bool is_value) {
        for (std::size_t j = 0; j < n; ++j) {
            const double value = rows[row * n + j];
            const bool good = std::isfinite(value) && (!is_value || value >= 0);
            if (!good)
                fuzz::require(false, name + " is " + std::to_string(value) + ": " +
                                         describe({at.model, at.kernel, at.parameters, {at.directions[j]}}));
        }
        ++row;
    };
    for (const kernels::Term& term : at.model.terms) {
        check(term.name, true);
        for (const std::size_t i : term.of) check("d " + term.name + "/d " + at.model.parameters[i].name, false);
    }
}

void check_projection(const Case& at, const std::vector<double>& columns, Bytes& bytes) {
    std::vector<double> y, w;
    for (std::size_t j = 0; j < at.directions.size(); ++j) {
        const double sign = bytes.byte() % 4 == 0 ? -1 : 1;
        y.push_back(sign * size_from(bytes));
        w.push_back(std::min(size_from(bytes), 1.0));
    }
    std::vector<double> lower, upper;
    for (const kernels::Term& term : at.model.terms) {
        const double most = term.factor ? at.model.parameters[*term.factor].max : 1;
        lower.push_back(bytes.byte() % 2 == 0 ? 0 : std::min(size_from(bytes), most));
        upper.push_back(bytes.byte() % 4 == 0 ? lower.back() : std::min(lower.back() + size_from(bytes), most));
    }
    const std::vector<double> out = at.kernel.project(columns, y, w, at.parameters, lower, upper);
    const auto good = [&](bool holds, const std::string& what) {
        if (!holds) {
            std::string data = " y w:";
            char buffer[60];
            for (std::size_t j = 0; j < y.size(); ++j) {
                std::snprintf(buffer, sizeof buffer, " %a %a,", y[j], w[j]);
                data += buffer;
            }
            data += " bounds:";
            for (std::size_t t = 0; t < lower.size(); ++t) {
                std::snprintf(buffer, sizeof buffer, " %a %a,", lower[t], upper[t]);
                data += buffer;
            }
            fuzz::require(false, what + ": " + describe(at) + data);
        }
    };
    good(std::isfinite(out[0]) && out[0] >= 0, "the loss is " + std::to_string(out[0]));
    for (const double value : out) good(std::isfinite(value), "a slope of the loss is " + std::to_string(value));
    const bool single = at.kernel.precision == kernels::Precision::single_precision;
    for (std::size_t t = 0; t < lower.size(); ++t) {
        const double low = single ? static_cast<double>(static_cast<float>(lower[t])) : lower[t];
        const double high = single ? static_cast<double>(static_cast<float>(upper[t])) : upper[t];
        good(out[1 + t] >= low && out[1 + t] <= high, "a coefficient outside its bounds");
    }
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
    static const std::vector<const kernels::Model*> models = tests::variants();
    Bytes bytes(data, size);
    const std::uint8_t choice = bytes.byte();
    const kernels::Model& model = *models[choice / 2 % models.size()];
    const auto kernels_of = choice % 2 == 0 ? tests::host_kernels_double() : tests::host_kernels_single();
    const auto& kernel = *std::find_if(kernels_of.begin(), kernels_of.end(),
                                       [&](const auto& k) { return k.label == tests::label(model); });
    Case at{model, kernel, {}, {}};
    for (const kernels::Parameter& p : model.parameters) at.parameters.push_back(parameter_from(bytes, p));
    const std::size_t directions = 1 + bytes.byte() % 8;
    for (std::size_t j = 0; j < directions; ++j) at.directions.push_back(direction_from(bytes));
    std::vector<double> columns;
    for (const kernels::GeometryColumn& c : kernels::geometry_columns())
        for (const kernels::Direction& d : at.directions)
            columns.push_back(c.read(kernels::Angles(kernels::canonical(d)), kernel.precision));
    check_terms(at, columns);
    check_projection(at, columns, bytes);
    return 0;
}
