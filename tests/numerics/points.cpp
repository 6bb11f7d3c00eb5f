#include "tests/numerics/points.h"

#include <algorithm>
#include <atomic>
#include <cfloat>
#include <cmath>
#include <cstdio>
#include <future>
#include <numbers>
#include <thread>

#include "tests/numerics/reference.h"

namespace brdfit::tests {
namespace {

using kernels::Direction;
using kernels::Model;
using kernels::Precision;
constexpr double kPi = std::numbers::pi;
constexpr double kRadian = kPi / 180;

// ---- points ----

/// Even over the powers of 10.
double log_uniform(Random& random, double low, double high) {
    return std::exp(random.uniform(std::log(low), std::log(high)));
}
double sign(Random& random) { return random.chance(0.5) ? 1 : -1; }

/// [0, 90): even, or with an even logarithm of what is missing to 90 degrees.
double draw_theta(Random& random) {
    if (random.chance(0.6)) return random.uniform(0, 89.9);
    if (random.chance(0.3)) return log_uniform(random, 1e-9, 1);
    return 90 - log_uniform(random, random.chance(0.1) ? 1e-9 : 1e-3, 30);
}

/// Special directions now and then; else the whole hemisphere, the plane of incidence, and close to the mirror
/// direction, where narrow lobes are.
Direction draw_direction(Random& random, std::size_t index) {
    static const std::vector<Direction> special{
        {0, 0, 0},        {0, 60, 0},          {45, 0, 0},           {15, 15, 0},           {75, 75, 0},
        {89.9, 89.9, 0},  {89.999, 89.999, 0}, {89.999, -89.999, 0}, {89.999, 89.999, 180}, {89.999, 0, 0},
        {0, 89.999, 0},   {0, -89.999, 0},     {89.999, 89.999, 90}, {30, -30, 0},          {75, -75, 0},
        {30, 30, 180},    {30, 30, -180},      {89.9, -89.9, 0},     {89.9, 0, 0},          {0, -89.9, 0},
        {60, 60, 90},     {60, -60, -90},      {60, -20, -135},      {45, 45, 0},           {45, -45, 0},
        {45, 45.001, 0},  {44.999, 45.001, 0}, {45, 45, 90},         {80, 89.9, 0},         {1e-3, 1e-3, 0},
        {1e-9, 1e-9, 45}, {60, 60, 1e-3},      {60, 60, 1e-9},       {45, 45, 360},         {45, 45, -360},
        {20, 89.9, 90},   {89.9, 89.9, 45},    {10, 9.9999, 0},      {89, -89.9, 179},      {0, 0, 123},
        {60, -30, 0},     {60, -29.999999, 0}, {30, 89.999, 0},      {89.999, 30, 60}};
    if (index % 20 == 0) return special[index / 20 % special.size()];
    Direction d;
    d.theta_i_deg = draw_theta(random);
    if (random.chance(0.6)) {
        const double limit = 90 - std::min(1e-9, 90 - d.theta_i_deg);
        const double away = log_uniform(random, 1e-7, 30) * sign(random);
        d.theta_r_deg = std::clamp(d.theta_i_deg + away, -limit, limit);
        if (random.chance(0.1)) d.theta_r_deg = d.theta_i_deg;
        if (random.chance(0.3)) d.phi_deg = log_uniform(random, 1e-7, 30) * sign(random);
    } else {
        d.theta_r_deg = draw_theta(random) * sign(random);
        if (random.chance(0.5)) d.phi_deg = random.uniform(-180, 180);
        if (random.chance(0.1)) d.phi_deg = 90 * static_cast<int>(random.uniform(-4.5, 4.5));
    }
    return d;
}

/// The linear parameters of a lobe.
double draw_weight(Random& random) { return random.chance(0.1) ? 1 : log_uniform(random, 1e-3, 100); }

std::vector<double> draw_phong(Random& random, const Direction& direction, double exponent) {
    const Angles angles(direction);
    double n = random.chance(0.1) ? static_cast<int>(random.uniform(0, 3)) : log_uniform(random, 1e-4, 1e6);
    if (random.chance(0.6)) {
        const double wanted = log_uniform(random, 1e-6, exponent) / -angles.log_cos_alpha;
        if (wanted <= 1e6) n = wanted;
    }
    return {random.uniform(0, 1), draw_weight(random), n};
}

std::vector<double> draw_ward(Random& random, const Direction& direction, double exponent) {
    double alpha = log_uniform(random, 1e-4, 10);
    if (random.chance(0.6)) {
        const double wanted = std::sqrt(Angles(direction).tan2 / log_uniform(random, 1e-6, exponent));
        if (wanted >= 1e-4 && wanted <= 10) alpha = wanted;
    }
    return {random.uniform(0, 1), draw_weight(random), alpha};
}

std::vector<double> draw_lafortune(Random& random, const Direction& direction, const Range& range, std::size_t lobes) {
    const double exponent = range.exponent;
    const Angles angles(direction);
    std::vector<double> p{random.uniform(0, 1)};
    for (std::size_t lobe = 0; lobe < lobes; ++lobe) {
        double c_xy = random.uniform(-3, 3);
        double c_z = random.uniform(-3, 3);
        if (random.chance(0.1)) c_xy = sign(random);
        if (random.chance(0.1)) c_z = sign(random);
        if (random.chance(0.05)) c_xy = 0;
        double n = random.chance(0.1) ? static_cast<int>(random.uniform(0, 4)) : log_uniform(random, 1e-2, 1e6);
        if (random.chance(0.1) && angles.hz > 0)
            c_z = -c_xy * angles.hxy / angles.hz * (1 + log_uniform(random, 1e-6, 1));
        // Bring b^n between underflow and overflow.
        // Where the precision's rounding of the coefficients leaves no digit there is nothing to measure.
        const auto base = [&] { return c_xy * angles.hxy + c_z * angles.hz; };
        const auto amplified = [&] {
            return (std::abs(c_xy * angles.hxy) + std::abs(c_z * angles.hz)) / std::abs(base());
        };
        const double most = 0.06 / static_cast<double>(range.eps);
        if (amplified() > most) c_z = -c_z;
        n = std::min(n, most / amplified());
        const double b = base();
        const double power = random.chance(0.5) ? random.uniform(-exponent, exponent)
                                                : log_uniform(random, 1e-6, exponent) * sign(random);
        const double factor = std::exp(power / n) / b;
        const double larger = std::max(std::abs(c_xy), std::abs(c_z)) * std::abs(factor);
        if (random.chance(0.9) && larger <= 1e4 && larger >= 1e-6) {
            c_xy *= factor;
            c_z *= factor;
        }
        p.insert(p.end(), {c_xy, c_z, n});
    }
    return p;
}

/// Draws g, tau/sigma and the index, and moves the viewer to where the lobe is neither flat nor gone.
std::vector<double> draw_he_torrance(Random& random, Direction& direction, bool may_move, double eps) {
    Angles angles(direction);
    // Few of the largest: their reference sums thousands of terms.
    const double kind = random.uniform(0, 1);
    const double g = kind < 0.3    ? log_uniform(random, 1e-12, 1e-2)
                     : kind < 0.75 ? log_uniform(random, 1e-2, 1e2)
                     : kind < 0.97 ? log_uniform(random, 1e2, 3e3)
                                   : log_uniform(random, 3e3, 1e5);
    const double sigma = std::clamp(std::sqrt(g) / (2 * kPi * angles.cs), 1e-6, 1e3);
    const double ratio = random.chance(0.05) ? 1 : log_uniform(random, 1, 1e4);
    const double tau = random.chance(0.02) ? 1e3 : std::min(sigma * ratio, 1e3);
    if (may_move && random.chance(0.8)) {
        const double a = log_uniform(random, 1e-5, 1e3) * std::max(g, 1.0);
        const double root = std::sqrt(a) / (kPi * tau);  // |u_xy + v_xy|
        const double out = root / (2 * angles.si);
        const double in_plane = angles.si + root * sign(random);
        if (random.chance(0.3) && out < 1) {
            direction.theta_r_deg = direction.theta_i_deg;
            direction.phi_deg = 2 * std::asin(out) / kRadian;
        } else if (std::abs(in_plane) < 1) {
            direction.theta_r_deg = std::asin(in_plane) / kRadian;
            if (!(std::abs(direction.theta_r_deg) < 90)) direction.theta_r_deg = direction.theta_i_deg;
            direction.phi_deg = 0;
        }
        angles = Angles(direction);
    }
    double n = log_uniform(random, 0.05, 20);
    const double index_kind = random.uniform(0, 1);
    if (index_kind < 0.1) n = 1;
    else if (index_kind < 0.25) n = 1 + log_uniform(random, 1e-12, 0.5) * (random.chance(0.7) ? 1 : -1);
    else if (index_kind < 0.45 && angles.sd2 > 0.01)  // total reflection, and its onset
        n = std::sqrt(angles.sd2) *
            (random.chance(0.5) ? random.uniform(0.2, 1) : 1 + log_uniform(random, 64 * eps, 0.1) * sign(random));
    double k = 0;
    if (random.chance(0.6)) k = random.chance(0.5) ? random.uniform(0, 20) : log_uniform(random, 1e-15, 20);
    return {sigma, tau, n, k, random.uniform(0, 1)};
}

Point draw_point(Random& random, const Model& model, const Range& range, std::size_t index) {
    const double exponent = range.exponent;
    Point point;
    Direction& d = point.direction;
    d = draw_direction(random, index);
    if (model.name == "phong") point.parameters = draw_phong(random, d, exponent);
    else if (model.name == "ward") point.parameters = draw_ward(random, d, exponent);
    else if (model.name == "lafortune") point.parameters = draw_lafortune(random, d, range, model.repeats);
    else if (model.name.starts_with("he_torrance"))
        point.parameters = draw_he_torrance(random, d, index % 20 != 0, static_cast<double>(range.eps));
    else point.parameters = random.parameters(model);
    return point;
}

// ---- references ----

/// A term without nonlinear parameters: the diffuse one.
bool is_diffuse(const Model& model, std::size_t parameter) {
    return std::any_of(model.terms.begin(), model.terms.end(),
                       [&](const kernels::Term& t) { return t.factor == parameter && t.of.empty(); });
}

/// A lobe b^n with b = x hxy + y hz has the slopes n b^(n-1) hxy, whose own condition is |n - 1| K + |1 + n ln b| with
/// K = (|x hxy| + |y hz|)/|b|. The value's, weighted with the lobe's share of f, does not cover that. The kernel keeps
/// b to twice the precision, of which hxy and hz have the 64 bits of long double: in double 2^-11 of K is left.
long double homogeneous_condition(const Model& model, const Point& point) {
    const Angles angles(point.direction);
    long double largest = 0;
    for (const kernels::Term& term : model.terms) {
        if (!term.homogeneous) continue;
        const double x = point.parameters[term.homogeneous->plane.first] * angles.hxy;
        const double y = point.parameters[term.homogeneous->plane.second] * angles.hz;
        const double n = point.parameters[term.homogeneous->degree];
        if (!(x + y > 0)) continue;
        const long double cancellation = (std::abs(x) + std::abs(y)) / (x + y);
        largest = std::max(largest, (1.0L + n) * cancellation / 1024 + n * std::abs(std::log(x + y)));
    }
    return largest;
}

/// Fresnel's equations hold q = sqrt(N^2 - sin^2 theta_d), N = n + ik, and their slopes 1/q, whose own condition is
/// (|N|^2 + sin^2 theta_d)/|q|^2: large where total reflection begins.
long double root_condition(const Point& point) {
    const Angles angles(point.direction);
    const long double n = point.parameters[2], k = point.parameters[3];
    const long double q_squared = std::hypot((n - 1) * (n + 1) - k * k + angles.cd2, 2 * n * k);
    return (n * n + k * k + angles.sd2) / q_squared;
}

Golden golden(const Model& model, const Point& point) {
    Golden result{point, 0, {}, 0, {}};
    const auto jet = reference::jet<reference::Fast>(
        model.name, point.parameters,
        {point.direction.theta_i_deg, point.direction.theta_r_deg, point.direction.phi_deg});
    result.specular = jet.specular.convert_to<long double>();
    for (const auto& slope : jet.gradient) result.gradient.push_back(slope.convert_to<long double>());
    if (result.specular > 0)
        for (std::size_t j = 0; j < point.parameters.size(); ++j)
            if (!is_diffuse(model, j))
                result.condition +=
                    std::abs(static_cast<long double>(point.parameters[j]) * result.gradient[j] / result.specular);
    result.slope_condition.assign(point.parameters.size(), result.condition + homogeneous_condition(model, point));
    if (model.name.starts_with("he_torrance")) {
        // Slopes by sigma and tau are differences of terms of this size.
        result.slope_condition[0] += 2 * jet.steepness.convert_to<long double>();
        result.slope_condition[1] += 2 * jet.steepness.convert_to<long double>();
        result.slope_condition[2] += root_condition(point);
        result.slope_condition[3] += root_condition(point);
    }
    return result;
}

// ---- kernels ----

std::vector<double> on_host(const Model& model, Precision precision, const std::vector<double>& parameters,
                            const std::vector<Direction>& directions) {
    return host_kernel(model, precision)
        .terms(columns_of(directions, precision), static_cast<int>(directions.size()), parameters);
}

auto on(kernels::Engine& (*device)()) {
    return [device](const Model& model, Precision precision, const std::vector<double>& parameters,
                    const std::vector<Direction>& directions) {
        const std::vector<double> none(directions.size(), 0.0);
        return kernels::Evaluator(device(), model, precision, directions, none, none).terms(parameters);
    };
}

/// From the terms, by their rows.
Measured combine(const Model& model, const std::vector<double>& parameters,
                 const std::function<long double(std::size_t)>& term_value) {
    Measured result;
    result.gradient.assign(parameters.size(), 0.0L);
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

}  // namespace

const Range& range_of(Precision precision) {
    // Lobes saturate where exp of 709, or 88, does not overflow.
    static const Range in_double{0x1p-53L, DBL_MIN, std::exp(709.0L), DBL_MAX, 700};
    static const Range in_single{0x1p-24L, FLT_MIN, std::exp(88.0L), FLT_MAX, 85};
    return precision == Precision::double_precision ? in_double : in_single;
}

Angles::Angles(const Direction& direction) {
    const auto cosine = [](double degrees) { return std::sin((90 - std::abs(degrees)) * kRadian); };
    const double half_difference = std::sin((direction.theta_r_deg - direction.theta_i_deg) / 2 * kRadian);
    const double half_sum = (direction.theta_r_deg + direction.theta_i_deg) / 2;
    ci = cosine(direction.theta_i_deg);
    cr = cosine(direction.theta_r_deg);
    cs = ci + cr;
    si = std::sin(direction.theta_i_deg * kRadian);
    sr = std::sin(direction.theta_r_deg * kRadian);
    const double lift = si * sr * std::pow(std::sin(direction.phi_deg / 2 * kRadian), 2);
    log_cos_alpha = std::log1p(-std::min(1.0, 2 * (half_difference * half_difference + lift)));
    w = std::max(0.0, std::pow(2 * cosine(half_sum) * half_difference, 2) + 4 * lift);
    tan2 = w / (cs * cs);
    sd2 = std::max(0.0, std::pow(std::sin(half_sum * kRadian), 2) - lift);
    cd2 = std::pow(cosine(half_sum), 2) + lift;
    hxy = -si * sr * std::cos(direction.phi_deg * kRadian);
    hz = ci * cr;
}

void round_to(Precision precision, std::vector<double>& parameters) {
    if (precision == Precision::single_precision)
        for (double& p : parameters) p = static_cast<float>(p);
}

std::vector<Point> draw_points(const Model& model, Precision precision, std::size_t count, std::uint64_t seed) {
    Random random(seed);
    std::vector<Point> points;
    for (std::size_t i = 0; i < count; ++i) {
        points.push_back(draw_point(random, model, range_of(precision), i));
        round_to(precision, points.back().parameters);
    }
    return points;
}

std::vector<Golden> golden(const Model& model, const std::vector<Point>& points) {
    std::vector<Golden> result(points.size());
    std::atomic<std::size_t> next = 0;
    const auto work = [&] {
        for (std::size_t i; (i = next++) < points.size();) result[i] = golden(model, points[i]);
    };
    std::vector<std::future<void>> others;
    for (unsigned i = 1; i < std::thread::hardware_concurrency(); ++i)
        others.push_back(std::async(std::launch::async, work));
    work();
    for (auto& other : others) other.get();
    return result;
}

const HostKernel& host_kernel(const Model& model, Precision precision) {
    const auto all = precision == Precision::double_precision ? host_kernels_double() : host_kernels_single();
    return *std::find_if(all.begin(), all.end(), [&](const HostKernel& k) { return k.label == label(model); });
}

std::vector<double> columns_of(const std::vector<Direction>& directions, Precision precision) {
    std::vector<double> columns;
    for (const kernels::GeometryColumn& c : kernels::geometry_columns())
        for (const Direction& direction : directions)
            columns.push_back(c.read(kernels::Angles(canonical(direction)), precision));
    return columns;
}

const std::vector<Backend>& backends() {
    // A device is set up anew for each chunk of directions; the host is not.
    static const std::vector<Backend> all{
        {"native", on(engine), 32}, {"one_lane", on(scalar_engine), 32}, {"host", on_host, 1}};
    return all;
}

std::vector<Measured> measure(const Model& model, Precision precision, const Backend& backend,
                              std::span<const Golden> points) {
    std::vector<Measured> result;
    for (std::size_t first = 0; first < points.size(); first += backend.chunk) {
        const std::size_t n = std::min(backend.chunk, points.size() - first);
        std::vector<double> parameters;
        std::vector<Direction> directions;
        for (const Golden& point : points.subspan(first, n)) {
            parameters.insert(parameters.end(), point.parameters.begin(), point.parameters.end());
            directions.push_back(point.direction);
        }
        const std::vector<double> rows = backend.terms(model, precision, parameters, directions);
        for (std::size_t i = 0; i < n; ++i)
            result.push_back(combine(model, points[first + i].parameters,
                                     [&](std::size_t row) { return rows[(i * model.term_values() + row) * n + i]; }));
    }
    return result;
}

long double slope_size(const Golden& point, std::size_t parameter) {
    const long double p = point.parameters[parameter];
    return std::max(std::abs(point.gradient[parameter]), std::abs(point.specular / (p == 0 ? 1 : p)));
}

std::string describe(const Model& model, const Point& point) {
    std::string text;
    char buffer[150];
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

/// Smaller results may be taken for 0.
long double faint(const Range& range) { return 4 * range.smallest; }

void Errors::expect(bool good, const Golden& point, const char* what, double got, long double expected) {
    if (good) return;
    char buffer[100];
    std::snprintf(buffer, sizeof buffer, " is %g for %Lg at ", got, expected);
    if (broken++ == 0) broken_where = what + std::string(buffer) + describe(model_, point);
}

std::vector<double> errors_of(const Range& range, const Golden& point, const Measured& got) {
    constexpr double kNone = std::numeric_limits<double>::quiet_NaN();
    const long double f = point.specular;
    const bool is_compared = f >= faint(range) && f <= range.largest / 2;
    std::vector<double> errors{kNone};
    if (is_compared) errors[0] = static_cast<double>((got.specular - f) / (range.eps * (1 + point.condition) * f));
    for (std::size_t j = 0; j < point.gradient.size(); ++j) {
        const long double size = slope_size(point, j);
        const bool in_range = is_compared && size >= faint(range) && size <= range.finite / 2;
        const long double unit = range.eps * (1 + point.slope_condition[j]) * size;
        errors.push_back(in_range ? static_cast<double>((got.gradient[j] - point.gradient[j]) / unit) : kNone);
    }
    return errors;
}

void Errors::add(const Golden& point, const Measured& got) {
    const std::vector<double> errors = errors_of(range_, point, got);
    const auto keep = [&](Worst& worst, double error, const std::string& what) {
        if (!(std::abs(error) > worst.ratio)) return;  // nor NaN: it counts as broken, or is not compared
        worst.ratio = std::abs(error);
        worst.where = what + describe(model_, point);
    };
    const long double f = point.specular;
    const auto specular = static_cast<double>(got.specular);
    expect(std::isfinite(specular) && specular >= 0, point, "f", specular, f);
    const bool is_faint = f < faint(range_);
    if (f > range_.largest / 2) expect(got.specular >= range_.largest / 2, point, "f", specular, f);
    else if (is_faint) expect(got.specular <= 2 * faint(range_), point, "f", specular, f);
    else ++compared;
    keep(value, errors[0], "");
    for (std::size_t j = 0; j < point.gradient.size(); ++j) {
        const std::string& name = model_.parameters[j].name;
        const auto slope_got = static_cast<double>(got.gradient[j]);
        expect(std::isfinite(slope_got), point, name.c_str(), slope_got, point.gradient[j]);
        const long double size = slope_size(point, j);
        if (size < faint(range_) || is_faint)
            expect(std::abs(got.gradient[j]) <= 2 * std::max(faint(range_), size), point, name.c_str(), slope_got,
                   point.gradient[j]);
        keep(slope, errors[1 + j], name + " at ");
    }
}

}  // namespace brdfit::tests
