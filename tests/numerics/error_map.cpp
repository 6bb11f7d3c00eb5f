// Writes the worst error of value and slopes over a plane of each model's domain as CSV: for docs/figures.
// Call: error_map OUTPUT [POINTS], that many random points to each model and precision.

#include <algorithm>
#include <cmath>
#include <fstream>
#include <iostream>
#include <limits>
#include <numbers>
#include <string>
#include <vector>

#include "tests/numerics/points.h"

namespace {

using namespace brdfit;
using kernels::Precision;
using tests::Angles;
using tests::Golden;
constexpr double kPi = std::numbers::pi;
constexpr int kBins = 36;

/// One axis, even in the logarithm.
struct Axis {
    double low, high;  // powers of 10

    [[nodiscard]] int bin(double x) const {
        const double place = (std::log10(x) - low) / (high - low);
        return place >= 0 && place <= 1 ? std::min(static_cast<int>(place * kBins), kBins - 1) : -1;
    }
    [[nodiscard]] double centre(int bin) const { return low + (high - low) * (bin + 0.5) / kBins; }
};

/// What a panel shows of a model.
struct Plane {
    std::string name, model;
    Axis x, y;
    std::pair<double, double> (*place)(const Golden&);
};

/// g with the effective roughness.
double roughness_parameter(double sigma, double tau, const kernels::Direction& d) {
    double k_sum = 0;
    for (const double theta : {d.theta_i_deg, d.theta_r_deg}) {
        const double tangent = std::tan(std::abs(theta) * kPi / 180);
        if (tangent > 0) k_sum += tangent * std::erfc(tau / (2 * sigma * tangent));
    }
    const double z = k_sum * k_sum / (8 * kPi);
    double w = z > 1 ? 0.7 * std::log(z) + 0.3 : z / (1 + z);
    for (int step = 0; step < 8 && z > 1e-12; ++step) w = w * (1 + std::log(z) - std::log(w)) / (1 + w);
    return std::pow(2 * kPi * sigma * Angles(d).cs, 2) / (1 + w);
}

const std::vector<Plane>& planes() {
    static const std::vector<Plane> all{
        {"phong",
         "phong",
         {-4, 6},
         {-6, 3},
         [](const Golden& p) {
             const double n = p.parameters[2];
             return std::pair(n, -n * Angles(p.direction).log_cos_alpha);
         }},
        {"ward",
         "ward",
         {-4, 1},
         {-3, 1.5},
         [](const Golden& p) {
             const double alpha = p.parameters[2];
             return std::pair(alpha, std::sqrt(Angles(p.direction).tan2) / alpha);
         }},
        {"lafortune",
         "lafortune_1",
         {-2, 6},
         {-6, 3},
         [](const Golden& p) {
             const Angles angles(p.direction);
             const double b = p.parameters[1] * angles.hxy + p.parameters[2] * angles.hz;
             return std::pair(p.parameters[3], std::abs(p.parameters[3] * std::log(b)));
         }},
        {"he_torrance",
         "he_torrance",
         {-12, 5},
         {-6, 6},
         [](const Golden& p) {
             const double g = roughness_parameter(p.parameters[0], p.parameters[1], p.direction);
             return std::pair(g, std::pow(kPi * p.parameters[1], 2) * Angles(p.direction).w / g);
         }},
        {"he_torrance_angles", "he_torrance", {-3, 2}, {-3, 2}, [](const Golden& p) {
             return std::pair(90 - p.direction.theta_i_deg, 90 - std::abs(p.direction.theta_r_deg));
         }}};
    return all;
}

/// The worst error in each bin; -1 where no point fell.
std::vector<double> worst_errors(const Plane& plane, Precision precision, const std::vector<Golden>& points,
                                 const std::vector<tests::Measured>& got) {
    std::vector<double> worst(kBins * kBins, -1);
    for (std::size_t i = 0; i < points.size(); ++i) {
        const auto [x, y] = plane.place(points[i]);
        const int column = plane.x.bin(x), row = plane.y.bin(y);
        if (column < 0 || row < 0) continue;
        double& bin = worst[static_cast<std::size_t>(row * kBins + column)];
        for (const double error : tests::errors_of(tests::range_of(precision), points[i], got[i]))
            if (std::abs(error) > bin) bin = std::abs(error);
    }
    return worst;
}

}  // namespace

int main(int argc, char** argv) {
    if (argc < 2 || argc > 3) {
        std::cerr << "usage: error_map OUTPUT [POINTS]\n";
        return 2;
    }
    const std::size_t count = argc > 2 ? std::stoull(argv[2]) : 50000;
    std::ofstream out(argv[1]);
    out << "plane,precision,log10_x,log10_y,worst_eps\n";
    for (const Precision precision : {Precision::double_precision, Precision::single_precision}) {
        std::string drawn;
        std::vector<Golden> points;
        std::vector<tests::Measured> got;
        for (const Plane& plane : planes()) {
            const kernels::Model& model = tests::variant(plane.model);
            if (drawn != plane.model) {  // planes of one model share its points
                points = tests::golden(model, tests::draw_points(model, precision, count, 1));
                got = tests::measure(model, precision, tests::backends().back(), points);
                drawn = plane.model;
            }
            const std::vector<double> worst = worst_errors(plane, precision, points, got);
            for (int row = 0; row < kBins; ++row)
                for (int column = 0; column < kBins; ++column) {
                    const double bin = worst[static_cast<std::size_t>(row * kBins + column)];
                    out << plane.name << ',' << (precision == Precision::double_precision ? "double" : "single") << ','
                        << plane.x.centre(column) << ',' << plane.y.centre(row) << ','
                        << (bin < 0 ? "nan" : std::to_string(bin)) << '\n';
                }
        }
    }
    return out.good() ? 0 : 1;
}
