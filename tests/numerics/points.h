/// Points of the models' open domain with their reference, and how a kernel's results are measured against it.
#pragma once

#include <cstddef>
#include <functional>
#include <span>
#include <string>
#include <vector>

#include "kernels/geometry.h"
#include "kernels/model.h"
#include "tests/numerics/host_kernel.h"
#include "tests/support.h"

namespace brdfit::tests {

/// No error of a value or slope may exceed this many eps (1 + condition).
constexpr double kBound = 16;

/// What a precision can hold.
struct Range {
    long double eps;       ///< half a unit of the last place of 1
    long double smallest;  ///< normal number; below, results may flush to 0
    long double largest;   ///< where a lobe saturates
    long double finite;    ///< the largest number
    double exponent;       ///< lobes between exp(-exponent) and 1 are drawn
};
const Range& range_of(kernels::Precision precision);

struct Point {
    std::vector<double> parameters;
    kernels::Direction direction;
};

/// A point with f_spec = f - diffuse/pi and the derivatives of f, in more digits and a wider range than double.
struct Golden : Point {
    long double specular = 0;
    std::vector<long double> gradient;
    long double condition = 0;                 ///< sum over parameters |p df_spec/dp|/|f_spec|
    std::vector<long double> slope_condition;  ///< a slope's own may be larger
};

/// The angles' functions that the models are made of, good enough to place points by.
struct Angles {
    explicit Angles(const kernels::Direction& direction);
    double ci, cr, cs, si, sr;
    double log_cos_alpha;  ///< -inf beyond 90 degrees
    double w;              ///< |u_xy + v_xy|^2
    double tan2;           ///< of the half vector's angle to the normal
    double cd2, sd2;       ///< of either direction's angle to the half vector
    double hxy, hz;
};

/// Random extreme points for that precision: its parameters are numbers of the precision.
std::vector<Point> draw_points(const kernels::Model& model, kernels::Precision precision, std::size_t count,
                               std::uint64_t seed);
/// As far as the precision's numbers go.
void round_to(kernels::Precision precision, std::vector<double>& parameters);

/// The reference of each point, on every core.
std::vector<Golden> golden(const kernels::Model& model, const std::vector<Point>& points);

/// A way to run the kernel text: terms and slopes (candidates x term values x directions).
struct Backend {
    std::string name;
    std::function<std::vector<double>(const kernels::Model&, kernels::Precision, const std::vector<double>& parameters,
                                      const std::vector<kernels::Direction>&)>
        terms;
    std::size_t chunk;  ///< points to a call, which evaluates each candidate at each direction
};
/// On SIMD lanes, on one lane, and as host C++.
const std::vector<Backend>& backends();

const HostKernel& host_kernel(const kernels::Model& model, kernels::Precision precision);
/// The geometry table, a column after the other.
std::vector<double> columns_of(const std::vector<kernels::Direction>& directions, kernels::Precision precision);

/// f_spec and df/dp as a kernel has them.
struct Measured {
    long double specular = 0;
    std::vector<long double> gradient;
};
std::vector<Measured> measure(const kernels::Model& model, kernels::Precision precision, const Backend& backend,
                              std::span<const Golden> points);

/// A parameter's slope is measured relative to max(|df/dp|, |f_spec/p|).
long double slope_size(const Golden& point, std::size_t parameter);
/// All parameters and angles, in hexadecimal and in decimal.
std::string describe(const kernels::Model& model, const Point& point);

long double faint(const Range& range);

/// The errors of the value and of each slope in eps (1 + condition), with their sign; NaN where the result may flush to
/// 0 or saturate.
std::vector<double> errors_of(const Range& range, const Golden& point, const Measured& got);

/// The worst errors over points, in eps (1 + condition), and where they were.
class Errors {
public:
    Errors(const kernels::Model& model, kernels::Precision precision) : model_(model), range_(range_of(precision)) {}
    void add(const Golden& point, const Measured& got);

    struct Worst {
        double ratio = 0;
        std::string where = "nowhere";
    };
    Worst value, slope;
    std::size_t compared = 0;  ///< points whose value is in range, and met by value and slopes
    std::size_t broken = 0;    ///< NaN, infinity, or out of range where the reference is not
    std::string broken_where;

private:
    void expect(bool good, const Golden& point, const char* what, double got, long double expected);
    const kernels::Model& model_;
    const Range& range_;
};

}  // namespace brdfit::tests
