#include "kernels/hemisphere.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numbers>
#include <optional>

#include <boost/math/quadrature/gauss_kronrod.hpp>  // nodes and weights

#include "kernels/geometry.h"
#include "kernels/transfers.h"

namespace brdfit::kernels {
namespace {

constexpr double kPi = std::numbers::pi;

/// As kernels/hemisphere.cl has them.
constexpr std::size_t kNodes = 16;
constexpr std::size_t kCell = 17;
constexpr std::size_t kSums = 5;
constexpr std::size_t kRays = 3;

/// Cells that an integral may be divided into, rounds of dividing, and cells of a launch.
constexpr std::size_t kMostCells = 600;
constexpr int kMostRounds = 40;
constexpr std::size_t kLaunchCells = 4096;
/// The share of an admitted error that is left to cells which are not divided.
constexpr double kKeptShare = 0.3;
/// A pole is no nearer to the horizon than this cosine.
constexpr double kLeastHeight = 1e-3;

/// Kronrod's rule of 15 nodes and Gauss's of 7 on [0, 1]: nodes, weights, weights; a 16th node counts for nothing.
std::vector<double> rule() {
    using Kronrod = boost::math::quadrature::gauss_kronrod<double, 15>;
    using Gauss = boost::math::quadrature::gauss<double, 7>;
    constexpr std::size_t kHalf = 7;
    std::vector<double> table(3 * kNodes, 0.0);
    table[kNodes - 1] = 0.5;
    for (std::size_t i = 0; i <= kHalf; ++i)
        for (const bool upper : {false, true}) {
            const std::size_t at = upper ? kHalf + i : kHalf - i;
            const double x = Kronrod::abscissa()[i];
            table[at] = 0.5 * (upper ? 1 + x : 1 - x);
            table[kNodes + at] = 0.5 * Kronrod::weights()[i];
            if (i % 2 == 0) table[2 * kNodes + at] = 0.5 * Gauss::weights()[i / 2];
        }
    return table;
}

/// A rectangle of the coordinates, and what is known of it.
struct Cell {
    double s = 0, s_size = 1, t = 0, t_size = 1;
    double value = 0, size = 0;
    double error_s = std::numeric_limits<double>::infinity(), error_t = 0;  ///< of each rule
    bool known = false;
    /// A cell about here was off by more than it told: there is a kink, at a critical angle or a lobe's edge.
    bool kinked = false;
    std::optional<double> whole{};  ///< of a first half: what both were before, until that is compared
    double whole_error = 0;

    /// What Kronrod's rule is off by: less than Gauss's where that is near already, and the integrand is smooth.
    [[nodiscard]] double error() const {
        constexpr double kNear = 1e-4;
        const double gauss = std::max(error_s, error_t);
        if (kinked || !(size > 0) || !std::isfinite(gauss)) return gauss;
        return gauss * std::min(1.0, std::sqrt(gauss / size / kNear));
    }
    [[nodiscard]] std::array<Cell, 2> halves() const {
        Cell low;
        low.s = s, low.s_size = s_size, low.t = t, low.t_size = t_size, low.kinked = kinked;
        Cell high = low;
        low.whole = value, low.whole_error = error();
        if (error_s >= error_t) {
            low.s_size = high.s_size = s_size / 2;
            high.s += s_size / 2;
        } else {
            low.t_size = high.t_size = t_size / 2;
            high.t += t_size / 2;
        }
        return {low, high};
    }
};

/// One term at one incidence angle.
struct Integral {
    std::size_t angle = 0;
    std::size_t term = 0;
    long double sin_i = 0, cos_i = 1;
    long double pole = 0, pole_height = 1;  ///< m and sqrt(1 - m^2)
    bool ends = false;                      ///< the lobe is 0 beyond 90 degrees
    double q = 1, scale = 1;
    double chi_0 = 0, chi_width = 1, low = 0, high = 1;
    std::vector<Cell> cells;

    [[nodiscard]] double sum(double(Cell::*part)) const {
        double total = 0;
        for (const Cell& cell : cells) total += cell.*part;
        return total;
    }
    [[nodiscard]] double error() const {
        double total = 0;
        for (const Cell& cell : cells) total += cell.error();
        return total;
    }
    /// Beyond this more digits say nothing.
    [[nodiscard]] bool is_finite() const { return std::isfinite(error()) && sum(&Cell::size) < 1e30; }

    /// Coordinates for a lobe of these half widths in r, by the rays at chi = 0, pi/2 and pi; 0 or less: unknown.
    void adapt(const std::array<double, kRays>& widths) {
        const auto m = static_cast<double>(pole);
        const auto height = static_cast<double>(pole_height);
        const auto narrower = [](double a, double b) { return a > 0 && (b <= 0 || a < b) ? a : b; };
        const double along = narrower(widths[0], widths[2]);
        const double across = widths[1];
        const bool flat = along > 0 && across > 0 && along < across * std::sqrt(height);
        q = flat ? height : 1;
        scale = narrower(along / q, across);
        if (!(scale > 0)) scale = 0.5;
        chi_width = height;
        if (!flat) {  // the edge is near to one side of chi = pi/2
            chi_0 = kPi / 2;
            high = std::asinh(kPi / 2 / chi_width);
            low = -high;
        } else {  // ... and far about chi = pi only
            chi_0 = m >= 0 ? kPi : 0;
            low = m >= 0 ? -std::asinh(kPi / chi_width) : 0;
            high = m >= 0 ? 0 : std::asinh(kPi / chi_width);
        }

        constexpr double kCore = 6;  // widths
        std::vector<double> s{0, 1};
        if (const double core = std::asinh(kCore) / std::asinh((1 + std::abs(m)) / q / scale); core < 0.6)
            s.insert(s.begin() + 1, 1 - std::sqrt(1 - core));
        std::vector<double> t{0, 1};
        if (ends && m != 0)  // where edge and end of the lobe meet
            if (const double corner = (std::asinh((std::atan2(1.0, -m / q) - chi_0) / chi_width) - low) / (high - low);
                corner > 0.01 && corner < 0.99)
                t.insert(t.begin() + 1, corner);
        cells.clear();
        for (std::size_t i = 0; i + 1 < s.size(); ++i)
            for (std::size_t j = 0; j + 1 < t.size(); ++j) {
                Cell cell;
                cell.s = s[i], cell.s_size = s[i + 1] - s[i];
                cell.t = t[j], cell.t_size = t[j + 1] - t[j];
                cells.push_back(cell);
            }
    }

    /// Divides the cells of the largest errors; whether there were any to divide.
    bool divide(double admitted) {
        if (error() <= admitted || !is_finite() || cells.size() >= kMostCells) return false;
        std::sort(cells.begin(), cells.end(), [](const Cell& a, const Cell& b) { return a.error() < b.error(); });
        double kept = 0;
        std::size_t first = 0;
        for (; first + 1 < cells.size(); ++first) {
            kept += cells[first].error();
            if (kept > kKeptShare * admitted) break;
        }
        const std::vector<Cell> large(cells.begin() + static_cast<std::ptrdiff_t>(first), cells.end());
        cells.resize(first);
        for (const Cell& cell : large)
            for (const Cell& half : cell.halves()) cells.push_back(half);
        return true;
    }
};

}  // namespace

struct Hemisphere::Impl : Transfers {
    Impl(Engine& engine, const Model& model_in, Precision precision_in)
        : Transfers(engine, precision_in), model(model_in), coefficients(model.terms.size()) {
        const cl::Program program = shared.hemisphere_program(model, precision);
        hemisphere = cl::Kernel(program, "hemisphere");
        probe = cl::Kernel(program, "probe");
        rule_buffer = constant_buffer(shared.context, precision, rule());
        hemisphere.setArg(0, rule_buffer);
        const auto columns = geometry_columns();
        for (std::size_t i = 0; i < columns.size(); ++i) {
            if (columns[i].name == "hxy") hxy = i;
            if (columns[i].name == "hz") hz = i;
        }
    }

    /// The foot of the term's axis in the disk: where the header declares a lobe about an axis, there, else the mirror
    /// direction.
    void place_pole(std::span<const double> parameters, Integral& integral) const {
        integral.pole = integral.sin_i;
        integral.pole_height = integral.cos_i;
        const auto& lobe = model.terms[integral.term].homogeneous;
        if (!lobe || lobe->columns != std::pair(hxy, hz)) return;
        const long double x = -parameters[lobe->plane.first] * integral.sin_i;
        const long double z = parameters[lobe->plane.second] * integral.cos_i;
        const long double length = std::hypot(x, z);
        if (!(length > 0)) return;
        integral.ends = z / length > kLeastHeight;
        integral.pole_height = integral.ends ? z / length : kLeastHeight;
        integral.pole = integral.ends
                            ? x / length
                            : std::copysign(std::sqrt((1 - integral.pole_height) * (1 + integral.pole_height)), x);
    }

    void append_row(const Integral& integral, const Cell& cell, std::span<const double> parameters) {
        const long double m = integral.pole;
        for (const long double value : {integral.sin_i, integral.cos_i, m, integral.pole_height * integral.pole_height,
                                        m - integral.sin_i, (integral.sin_i - m) * (integral.sin_i + m)})
            rows.push_back(static_cast<double>(value));
        rows.insert(rows.end(), {integral.q, integral.scale, integral.chi_0, integral.chi_width, integral.low,
                                 integral.high, cell.s, cell.s_size, cell.t, cell.t_size, integral.ends ? 1.0 : 0.0});
        for (std::size_t t = 0; t < coefficients.size(); ++t)
            rows.push_back(t == integral.term ? coefficients[t] : 0.0);
        rows.insert(rows.end(), coefficients.begin(), coefficients.end());
        rows.insert(rows.end(), parameters.begin(), parameters.end());
    }

    [[nodiscard]] std::size_t stride() const { return kCell + 2 * coefficients.size() + model.parameters.size(); }

    /// Runs the kernel, whose arguments from `first` on are cells, in, out, over the rows; `each` numbers a row.
    void run(cl::Kernel& kernel, cl_uint first, std::size_t each) {
        const std::size_t count = rows.size() / stride();
        results.resize(count * each);
        for (std::size_t begin = 0; begin < count; begin += kLaunchCells) {
            const std::size_t n = std::min(kLaunchCells, count - begin);
            guarded([&] {
                upload(in_buffer, std::span(rows).subspan(begin * stride(), n * stride()));
                reserve(out_buffer, n * each);
                kernel.setArg(first, static_cast<cl_int>(n));
                kernel.setArg(first + 1, in_buffer);
                kernel.setArg(first + 2, out_buffer);
                queue.enqueueNDRangeKernel(kernel, cl::NullRange,
                                           cl::NDRange(shared.info.type == "cpu" ? cpu_width() : n), cl::NDRange(1));
                download(out_buffer, std::span(results).subspan(begin * each, n * each));
            });
        }
    }

    /// Values of each integral's term along its rays: integrals x kRays x kNodes.
    void look(const std::vector<Integral>& integrals, std::span<const double> parameters) {
        rows.clear();
        for (Integral integral : integrals) {
            integral.ends = false;  // the rays go on to the edge
            append_row(integral, {}, parameters);
        }
        run(probe, 0, kRays * kNodes);
        evaluations += results.size();
    }

    /// Half widths in r, from the values along the rays.
    [[nodiscard]] static std::array<double, kRays> widths(const Integral& integral, std::span<const double> values) {
        double peak = 0;
        for (const double value : values) peak = std::max(peak, std::abs(value));
        const auto m = static_cast<double>(integral.pole);
        const std::array<double, kRays> rims{1 - m, static_cast<double>(integral.pole_height), 1 + m};
        std::array<double, kRays> result{};
        if (!(peak > 0) || !std::isfinite(peak)) return result;
        for (std::size_t j = 0; j < kRays; ++j)
            for (std::size_t k = 0; k < kNodes; ++k) {
                if (std::abs(values[j * kNodes + k]) < 0.5 * peak) continue;
                // Down at four times this r; no width is seen where the edge is bright.
                if (k > 0) result[j] = 2 * rims[j] * std::pow(0.25, static_cast<double>(k));
                break;
            }
        return result;
    }

    void sum_cells(std::vector<Integral>& integrals, std::span<const double> parameters, std::vector<Albedo>& albedos) {
        std::vector<std::pair<Integral*, Cell*>> cells;
        rows.clear();
        for (Integral& integral : integrals)
            for (Cell& cell : integral.cells)
                if (!cell.known) {
                    cells.emplace_back(&integral, &cell);
                    append_row(integral, cell, parameters);
                }
        run(hemisphere, 1, kSums);
        evaluations += cells.size() * (kNodes - 1) * (kNodes - 1);
        for (std::size_t i = 0; i < cells.size(); ++i) {
            const double* sums = results.data() + i * kSums;
            Cell& cell = *cells[i].second;
            cell.value = sums[0];
            cell.error_s = std::abs(sums[0] - sums[1]);
            cell.error_t = std::abs(sums[0] - sums[2]);
            cell.size = sums[3];
            cell.known = true;
            if (sums[4] > 0) albedos[cells[i].first->angle].negative = true;
        }
        for (std::size_t i = 0; i + 1 < cells.size(); ++i) {
            Cell& low = *cells[i].second;
            if (!low.whole) continue;
            Cell& high = *cells[i + 1].second;  // they came together
            if (std::abs(low.value + high.value - *low.whole) > low.whole_error) low.kinked = high.kinked = true;
            low.whole.reset();
        }
    }

    const Model& model;
    std::vector<double> coefficients;
    cl::Kernel hemisphere, probe;
    cl::Buffer rule_buffer, in_buffer, out_buffer;
    std::size_t hxy = 0, hz = 0;  ///< places of geometry columns
    std::vector<double> rows, results;
    std::size_t evaluations = 0;
};

Hemisphere::Hemisphere(Engine& engine, const Model& model, Precision precision) try
    : impl_(std::make_unique<Impl>(engine, model, precision)) {
} catch (const cl::Error& error) {
    throw device_error(error);
}

Hemisphere::~Hemisphere() = default;
Hemisphere::Hemisphere(Hemisphere&&) noexcept = default;
Hemisphere& Hemisphere::operator=(Hemisphere&&) noexcept = default;

std::vector<Albedo> Hemisphere::albedo(std::span<const double> parameters, std::span<const double> theta_i_deg,
                                       double tolerance) try {
    Impl& m = *impl_;
    m.coefficients = m.model.coefficients({parameters.begin(), parameters.end()});
    std::vector<Albedo> albedos(theta_i_deg.size());
    std::vector<Integral> integrals;
    for (std::size_t t = 0; t < m.model.terms.size(); ++t) {
        if (m.coefficients[t] == 0) continue;
        for (std::size_t angle = 0; angle < theta_i_deg.size(); ++angle) {
            Integral integral;
            integral.angle = angle;
            integral.term = t;
            const Angles angles({theta_i_deg[angle], 0, 0});
            integral.sin_i = angles.sin_i;
            integral.cos_i = angles.cos_i;
            m.place_pole(parameters, integral);
            integrals.push_back(std::move(integral));
        }
    }
    m.look(integrals, parameters);
    std::vector<Integral> lobes;
    for (std::size_t i = 0; i < integrals.size(); ++i) {
        Integral& integral = integrals[i];
        const std::span<const double> values(m.results.data() + i * kRays * kNodes, kRays * kNodes);
        const auto [least, most] = std::minmax_element(values.begin(), values.end());
        Albedo& albedo = albedos[integral.angle];
        if (m.model.terms[integral.term].of.empty() && *least == *most) {  // a uniform term
            albedo.value += kPi * *most;
            albedo.scale += kPi * std::abs(*most);
            continue;
        }
        integral.adapt(Impl::widths(integral, values));
        lobes.push_back(std::move(integral));
    }
    const auto terms = static_cast<double>(std::max<std::size_t>(1, m.model.terms.size()));
    for (int round = 0; round < kMostRounds; ++round) {
        m.sum_cells(lobes, parameters, albedos);
        if (round + 1 == kMostRounds) break;  // what is divided must be summed
        bool divided = false;
        for (Integral& integral : lobes) {
            const double size = integral.sum(&Cell::size) + albedos[integral.angle].scale;
            divided = integral.divide(tolerance / terms * std::max(1.0, size)) || divided;
        }
        if (!divided) break;
    }
    for (const Integral& integral : lobes) {
        Albedo& albedo = albedos[integral.angle];
        albedo.value += integral.sum(&Cell::value);
        albedo.scale += integral.sum(&Cell::size);
        albedo.error += integral.error();
    }
    for (Albedo& albedo : albedos)
        if (!std::isfinite(albedo.value) || !std::isfinite(albedo.error))
            albedo.error = std::numeric_limits<double>::infinity();
    return albedos;
} catch (const cl::Error& error) {
    throw device_error(error);
}

std::size_t Hemisphere::evaluations() const { return impl_->evaluations; }

}  // namespace brdfit::kernels
