#include "kernels/selftest.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <limits>

#include "kernels/evaluator.h"
#include "kernels/hard_points.h"

namespace brdfit::kernels {
namespace {

/// Points of the brief form, at most.
constexpr std::size_t kBriefPoints = 8;

struct Arithmetic {
    double eps;
    /// Values that are compared. Below, a factor of the result may lie under the smallest normal number and be flushed
    /// to 0; above, lobes saturate.
    long double smallest, largest;
};

Arithmetic arithmetic(Precision precision) {
    return precision == Precision::double_precision ? Arithmetic{0x1p-53, 1e-300L, 1e120L}
                                                    : Arithmetic{0x1p-24, 1e-30L, 1e12L};
}

std::string text_of(double eps) {
    char buffer[32];
    std::snprintf(buffer, sizeof buffer, "%.4g", eps);
    return buffer;
}

std::vector<const HardPoint*> points_of(const Model& model, Precision precision, SelfTestForm form) {
    const Arithmetic limits = arithmetic(precision);
    std::vector<const HardPoint*> points;
    for (const HardPoint& point : hard_points())
        if (point.model == model.name && point.lobes == model.repeats && point.value >= limits.smallest &&
            point.value <= limits.largest)
            points.push_back(&point);
    if (form == SelfTestForm::whole || points.size() <= kBriefPoints) return points;
    std::vector<const HardPoint*> some;  // from end to end: neighbours are alike
    for (std::size_t i = 0; i < kBriefPoints; ++i) some.push_back(points[i * (points.size() - 1) / (kBriefPoints - 1)]);
    return some;
}

std::string describe(const Model& model, const HardPoint& point) {
    std::string text;
    const auto add = [&](const std::string& name, double number) {
        char buffer[64];
        std::snprintf(buffer, sizeof buffer, "=%a (%g)", number, number);
        text += (text.empty() ? "" : " ") + name + buffer;
    };
    for (std::size_t i = 0; i < model.parameters.size(); ++i)
        add(model.parameters[i].name, static_cast<double>(point.parameters[i]));
    add("theta_i_deg", point.direction.theta_i_deg);
    add("theta_r_deg", point.direction.theta_r_deg);
    add("phi_deg", point.direction.phi_deg);
    return text;
}

/// sum |p df/dp|/|f|: what the result owes to the rounding of its parameters.
long double condition(const Model& model, const HardPoint& point) {
    long double sum = 0;
    for (std::size_t i = 0; i < model.parameters.size(); ++i)
        sum += std::abs(static_cast<long double>(point.parameters[i]) * point.slopes[i] / point.value);
    return sum;
}

/// A lobe b^n with b = x hxy + y hz has the slopes n b^(n-1) hxy, whose own condition is |n - 1| K with
/// K = (|x hxy| + |y hz|)/|b|. The value's, n K weighted with the lobe's share of f, does not cover that.
long double homogeneous_condition(const Model& model, const HardPoint& point) {
    long double largest = 0;
    for (const Term& term : model.terms) {
        if (!term.homogeneous) continue;
        const auto [i, j] = term.homogeneous->plane;
        const long double x = point.slopes[i] * static_cast<long double>(point.parameters[i]);
        const long double y = point.slopes[j] * static_cast<long double>(point.parameters[j]);
        if (x + y == 0) continue;  // a dark lobe
        const auto n = static_cast<long double>(point.parameters[term.homogeneous->degree]);
        largest = std::max(largest, (1 + n) * (std::abs(x) + std::abs(y)) / std::abs(x + y));
    }
    return largest;
}

void compare(double got, long double expected, long double unit, const std::string& where, WorstError& worst) {
    auto error = static_cast<double>(std::abs(got - expected) / unit);
    if (std::isnan(error)) error = std::numeric_limits<double>::infinity();
    if (error > worst.eps) worst = {error, where};
}

void compare(Engine& engine, const Model& model, Precision precision, const std::vector<const HardPoint*>& points,
             ModelTest& test) {
    const auto eps = static_cast<long double>(arithmetic(precision).eps);
    std::vector<Direction> directions;
    for (const HardPoint* point : points) directions.push_back(point->direction);
    for (std::size_t i = 0; i < points.size(); ++i) {
        const HardPoint& point = *points[i];
        const std::vector<double> parameters(
            point.parameters.begin(), point.parameters.begin() + static_cast<std::ptrdiff_t>(model.parameters.size()));
        // At the directions of all points: SIMD lanes then hold unlike samples, as in a fit.
        const Values values = evaluate(engine, model, precision, parameters, directions, true);
        const std::string where = describe(model, point);
        const long double f = point.value;
        const long double cond = condition(model, point);
        compare(values.f[i], f, eps * (1 + cond) * f, where, test.value);
        const long double slope_cond = cond + homogeneous_condition(model, point);
        for (std::size_t p = 0; p < parameters.size(); ++p) {
            const long double slope = point.slopes[p];
            const long double ratio =
                f / (parameters[p] == 0 ? 1.0L : std::abs(static_cast<long double>(parameters[p])));
            compare(values.by_parameter[p * points.size() + i], slope,
                    eps * (1 + slope_cond) * std::max(std::abs(slope), ratio),
                    model.parameters[p].name + " at " + where, test.slope);
        }
        ++test.points;
    }
}

ModelTest test_model(Engine& engine, const Model& model, Precision precision, SelfTestForm form) {
    using Clock = std::chrono::steady_clock;
    const auto start = Clock::now();
    ModelTest test;
    test.model = model.name;
    test.lobes = model.repeats;
    const std::vector<const HardPoint*> points = points_of(model, precision, form);
    if (points.empty()) return test;
    try {
        compare(engine, model, precision, points, test);
    } catch (const BuildError& error) {
        test.refusal = error.what();
    } catch (const DeviceError& error) {
        test.refusal = error.what();
    }
    test.time_ms = std::chrono::duration<double, std::milli>(Clock::now() - start).count();
    return test;
}

}  // namespace

bool ModelTest::passed() const {
    return refusal.empty() && value.eps <= kLargestError_eps && slope.eps <= kLargestError_eps;
}

std::vector<std::string> ModelTest::failures() const {
    std::vector<std::string> lines;
    if (!refusal.empty()) lines.push_back(refusal);
    if (value.eps > kLargestError_eps) lines.push_back("value off by " + text_of(value.eps) + " eps: " + value.where);
    if (slope.eps > kLargestError_eps) lines.push_back("slope off by " + text_of(slope.eps) + " eps: " + slope.where);
    return lines;
}

bool SelfTest::passed() const {
    return std::all_of(models.begin(), models.end(), [](const ModelTest& test) { return test.passed(); });
}

double SelfTest::time_ms() const {
    double sum = 0;
    for (const ModelTest& test : models) sum += test.time_ms;
    return sum;
}

std::string SelfTest::reason() const {
    std::string list;
    for (const ModelTest& test : models) {
        if (test.passed()) continue;
        list += (list.empty() ? "" : ", ") + variant_name(test.model, test.lobes) +
                (test.refusal.empty() ? " is off by " + text_of(std::max(test.value.eps, test.slope.eps)) + " eps"
                                      : " cannot be computed");
    }
    if (list.empty()) return "";
    const char* name = precision == Precision::double_precision ? "double" : "single";
    return std::string("the device failed the self-test in ") + name + " precision (" + text_of(kLargestError_eps) +
           " eps are allowed): " + list;
}

SelfTest self_test(Engine& engine, std::span<const Family> families, Precision precision, SelfTestForm form) {
    if (const auto reason = engine.refusal(precision)) throw PrecisionError(*reason);
    SelfTest result{precision, form, {}};
    for (const Family& family : families)
        for (const Model* model : family.texts()) {
            const bool of_submodel = model->name != family.name;
            if (of_submodel && form == SelfTestForm::brief) continue;  // they are built when a scene asks for them
            result.models.push_back(test_model(engine, *model, precision, form));
        }
    return result;
}

SelfTest prove(Engine& engine, std::span<const Family> families, Precision precision, SelfTestForm form) {
    engine.build_ahead(families, {&precision, 1});
    SelfTest result = self_test(engine, families, precision, form);
    if (!result.passed()) engine.withdraw(precision, result.reason());
    return result;
}

std::vector<SelfTest> prove(Engine& engine, std::span<const Family> families, SelfTestForm form) {
    std::vector<Precision> precisions;
    for (const Precision precision : {Precision::double_precision, Precision::single_precision})
        if (engine.supports(precision)) precisions.push_back(precision);
    engine.build_ahead(families, precisions);
    std::vector<SelfTest> results;
    for (const Precision precision : precisions) results.push_back(prove(engine, families, precision, form));
    return results;
}

}  // namespace brdfit::kernels
