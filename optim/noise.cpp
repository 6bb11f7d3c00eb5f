#include "optim/noise.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <map>
#include <numbers>
#include <optional>
#include <span>
#include <utility>

namespace brdfit::optim {
namespace {

/// Of the differences: of the third, peaks as wide as ten steps still show 2 %; higher ones tell no more.
constexpr std::size_t kOrder = 4;
/// Fewer differences tell the size of noise to no better than a third.
constexpr std::size_t kFewest = 12;
/// More tell no more that matters.
constexpr std::size_t kMost = 20000;
/// If more differences than this part are no noise, the samples are not independent: interpolated, or too far apart.
constexpr double kMostForeign = 0.25;
/// A sum of squares of overlapping differences has the spread of one of so many times fewer independent ones: the sum
/// of the squared correlations of fourth differences of even steps.
constexpr double kOverlap = 2.63;
/// What cannot be told from rounding, of a value.
constexpr double kRounding = 1e-12;

/// A difference r of neighbouring samples: variance `floor` F + `relative` R for noise of variance F + R y^2.
struct Difference {
    double r2 = 0;
    double floor = 1;
    double relative = 0;
};

/// Of values, and of their logarithms, in which the flank of a peak is smooth, if all are positive.
struct Window {
    Difference linear;
    std::optional<Difference> logarithmic;
    double least = 0;  ///< value
};

using Curve = std::vector<std::pair<double, double>>;  // (angle, value), rising

Window window_of(std::span<const std::pair<double, double>> points) {
    std::array<double, kOrder + 1> c{};
    double norm2 = 0;
    for (std::size_t k = 0; k <= kOrder; ++k) {
        c[k] = 1;
        for (std::size_t l = 0; l <= kOrder; ++l)
            if (l != k) c[k] /= points[k].first - points[l].first;
        norm2 += c[k] * c[k];
    }
    Window window{{0, 1, 0}, Difference{0, 0, 1}, points[0].second};
    double linear = 0;
    double logarithmic = 0;
    for (std::size_t k = 0; k <= kOrder; ++k) {
        const double x = c[k] / std::sqrt(norm2);
        const double y = points[k].second;
        linear += x * y;
        window.linear.relative += x * x * y * y;
        window.least = std::min(window.least, y);
        if (!(y > 0)) continue;
        logarithmic += x * std::log(y);
        window.logarithmic->floor += x * x / (y * y);
    }
    window.linear.r2 = linear * linear;
    window.logarithmic->r2 = logarithmic * logarithmic;
    if (!(window.least > 0)) window.logarithmic.reset();
    return window;
}

/// Windows along every curve of one incidence and one azimuth; values in a unit of their own size.
std::vector<Window> windows_of(const Channel& channel, double unit) {
    std::map<std::pair<double, double>, Curve> curves;
    for (const Sample& sample : channel.samples) {
        const kernels::Direction d = canonical(sample.direction);
        curves[{d.theta_i_deg, d.phi_deg}].emplace_back(d.theta_r_deg, sample.brdf / unit);
    }
    std::size_t count = 0;
    for (auto& [key, curve] : curves) {
        std::stable_sort(curve.begin(), curve.end(), [](const auto& a, const auto& b) { return a.first < b.first; });
        // Repeated directions: the first stands for all.
        curve.erase(std::unique(curve.begin(), curve.end(),
                                [](const auto& a, const auto& b) { return b.first - a.first < 1e-6; }),
                    curve.end());
        if (curve.size() > kOrder) count += curve.size() - kOrder;
    }
    // Of more than the most, evenly spread ones.
    const std::size_t most = std::min(count, kMost);
    std::vector<Window> windows;
    windows.reserve(most);
    std::size_t before = 0;  // of the curves before
    for (const auto& [key, curve] : curves) {
        if (curve.size() <= kOrder) continue;
        const std::size_t here = curve.size() - kOrder;
        for (std::size_t place; windows.size() < most && (place = windows.size() * count / most) < before + here;)
            windows.push_back(window_of(std::span(curve).subspan(place - before, kOrder + 1)));
        before += here;
    }
    return windows;
}

/// Variances F and R.
struct Sizes {
    double floor = 0;
    double relative = 0;
    double foreign = 0;  ///< part of the differences that are no noise
    /// As Noise has them.
    double floor_variance = 0;
    double relative_variance = 0;
    double covariance = 0;
};

/// The difference to judge a window by, if noise is of those sizes.
const Difference& form_of(const Window& w, const Sizes& sizes) {
    constexpr double kSurely = 0.2;  // relative noise up to which logarithms are as good as linear
    const double error2 = w.least > 0 ? sizes.floor / (w.least * w.least) + sizes.relative : HUGE_VAL;
    return w.logarithmic && error2 < kSurely * kSurely ? *w.logarithmic : w.linear;
}

/// A difference under a mixture: Gaussian noise, and among it differences of any size (Cauchy's density) where the
/// curve is not smooth.
struct Mixture {
    double variance, gauss, cauchy;

    Mixture(const Difference& d, const Sizes& at) : variance(d.floor * at.floor + d.relative * at.relative + 1e-300) {
        constexpr double kWidth = 5;  // of the foreign differences, in sigma
        const double z2 = d.r2 / variance;
        gauss = (1 - at.foreign) * std::exp(-z2 / 2) / std::sqrt(2 * std::numbers::pi);
        cauchy = at.foreign / (std::numbers::pi * kWidth * (1 + z2 / (kWidth * kWidth)));
    }
};

/// A floor that is not there: a hundredth of the noise of the least value.
double no_floor(double relative, double least) { return 1e-4 * relative * least * least; }

/// Maximum likelihood by expectation and maximisation, with a floor or without; `forms`: the sizes that tell which form
/// of each difference counts, those found if null.
Sizes likeliest(const std::vector<Window>& windows, double least, Sizes at, bool with_floor, const Sizes* forms) {
    constexpr int kRounds = 200;
    constexpr double kLeast = kRounding * kRounding;
    double ff = 0, fr = 0, rr = 0;  // information on both, of their logarithms
    for (int round = 0; round < kRounds; ++round) {
        double aa = 0, aq = 0, qq = 0, ar = 0, qr = 0, noise = 0;
        for (const Window& w : windows) {
            const Difference& d = form_of(w, forms != nullptr ? *forms : at);
            const Mixture mixture(d, at);
            const double p = mixture.gauss / (mixture.gauss + mixture.cauchy);
            noise += p;
            // Scoring: r^2 regressed on its expectation, by the inverse of its variance.
            const double weight = p / (mixture.variance * mixture.variance);
            aa += weight * d.floor * d.floor;
            aq += weight * d.floor * d.relative;
            qq += weight * d.relative * d.relative;
            ar += weight * d.floor * d.r2;
            qr += weight * d.relative * d.r2;
        }
        const Sizes before = at;
        const double determinant = aa * qq - aq * aq;
        const bool both = with_floor && determinant > 1e-12 * aa * qq;
        at.floor = both ? (ar * qq - qr * aq) / determinant : 0;
        at.relative = both ? (aa * qr - aq * ar) / determinant : 0;
        if (!(at.floor > 0)) at.floor = 0, at.relative = qq > 0 ? qr / qq : 0;
        else if (!(at.relative > 0)) at.relative = 0, at.floor = aa > 0 ? ar / aa : 0;
        at.relative = std::max(at.relative, kLeast);
        at.floor = std::max(at.floor, no_floor(at.relative, least));
        ff = aa * at.floor * at.floor;
        fr = aq * at.floor * at.relative;
        rr = qq * at.relative * at.relative;
        at.foreign = std::clamp(1 - noise / static_cast<double>(windows.size()), 1e-3, 0.5);
        const auto still = [](double a, double b) { return std::abs(a - b) <= 1e-4 * a; };
        if (still(at.floor, before.floor) && still(at.relative, before.relative)) break;
    }
    // What is hardly there is known to be so: then the other is alone.
    constexpr double kAlone = 1e-6;
    const double determinant = ff * rr - fr * fr;
    if (with_floor && determinant > kAlone * ff * rr && ff > kAlone * rr && rr > kAlone * ff) {
        at.floor_variance = 2 * kOverlap * rr / determinant;
        at.relative_variance = 2 * kOverlap * ff / determinant;
        at.covariance = -2 * kOverlap * fr / determinant;
    } else {
        at.floor_variance = at.relative_variance = at.covariance = 2 * kOverlap / std::max({ff, rr, 1e-300});
    }
    return at;
}

/// -2 ln L of that many independent differences as the overlapping ones are worth.
double deviance(const std::vector<Window>& windows, const Sizes& sizes, const Sizes& forms) {
    double sum = 0;
    for (const Window& w : windows) {
        const Mixture mixture(form_of(w, forms), sizes);
        sum -= 2 * std::log(std::max(mixture.gauss + mixture.cauchy, 1e-300)) - std::log(mixture.variance);
    }
    return sum / kOverlap;
}

/// The likeliest sizes, without a floor where the differences do not tell one: beside it the relative part would come
/// out low.
Sizes sizes_of(const std::vector<Window>& windows, double least) {
    constexpr double kEvidence = 2;  // Akaike's criterion
    std::vector<double> ratios;
    for (const Window& w : windows) ratios.push_back(w.linear.r2 / std::max(w.linear.relative, 1e-300));
    const auto middle = ratios.begin() + static_cast<std::ptrdiff_t>(ratios.size() / 2);
    std::nth_element(ratios.begin(), middle, ratios.end());
    constexpr double kMedian = 0.4549;  // of chi^2 with one degree of freedom
    Sizes start{0, std::max(*middle / kMedian, kRounding * kRounding), 0.1};
    start.floor = start.relative * least * least / 100;
    const Sizes both = likeliest(windows, least, start, true, nullptr);
    const Sizes alone = likeliest(windows, least, start, false, &both);
    return deviance(windows, both, both) + kEvidence < deviance(windows, alone, both) ? both : alone;
}

}  // namespace

double Noise::degrees_of(double floor_part) const {
    const double rest = 1 - floor_part;
    const double variance =
        floor_part * floor_part * floor_variance + 2 * floor_part * rest * covariance + rest * rest * relative_variance;
    return variance > 0 ? std::clamp(2 / variance, 2.0, std::max(degrees, 2.0)) : degrees;
}

Noise noise_of(const Channel& channel) {
    Noise noise;
    const auto& samples = channel.samples;
    if (std::all_of(samples.begin(), samples.end(), [](const Sample& s) { return s.sigma.has_value(); })) {
        noise.record.source = NoiseSource::given;
        noise.degrees = std::numeric_limits<double>::infinity();
        for (const Sample& sample : samples) noise.sigma.push_back(*sample.sigma);
        return noise;
    }
    double unit = 0;
    for (const Sample& sample : samples) unit = std::max(unit, std::abs(sample.brdf));
    if (!(unit > 0) || samples.size() < 3) {
        noise.record.source = NoiseSource::none;
        return noise;
    }
    const std::vector<Window> windows = windows_of(channel, unit);
    if (windows.size() < kFewest) return noise;
    // A value that is 0 has been cut off: its noise is at least the smallest value that was not.
    double least = 1;
    for (const Sample& sample : samples)
        if (sample.brdf != 0) least = std::min(least, std::abs(sample.brdf) / unit);
    const Sizes sizes = sizes_of(windows, least);
    if (sizes.foreign > kMostForeign) return noise;
    noise.record.source = NoiseSource::estimated;
    noise.record.relative = std::sqrt(sizes.relative);
    const bool cut = std::any_of(samples.begin(), samples.end(), [](const Sample& s) { return s.brdf == 0; });
    const double floor = std::max(std::sqrt(sizes.floor), cut ? std::min(least, *noise.record.relative) : 0.0);
    noise.record.floor = floor * unit;
    noise.degrees = static_cast<double>(windows.size()) * (1 - sizes.foreign) / kOverlap;
    noise.floor_variance = sizes.floor_variance;
    noise.relative_variance = sizes.relative_variance;
    noise.covariance = sizes.covariance;
    noise.record.relative_error = std::sqrt(1 / (2 * noise.degrees));
    for (const Sample& sample : samples)
        noise.sigma.push_back(std::hypot(*noise.record.floor, *noise.record.relative * sample.brdf));
    return noise;
}

}  // namespace brdfit::optim
