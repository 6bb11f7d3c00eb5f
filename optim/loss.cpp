#include "optim/loss.h"

#include <cmath>
#include <numbers>
#include <stdexcept>

namespace brdfit::optim {
namespace {

/// Weight of a sample before the loss's denominator, and what it adds to that denominator.
struct Share {
    double weight = 0;
    double denominator = 0;
};

double cosine(double degrees) { return std::cos(degrees * std::numbers::pi / 180); }

Share share_of_equals(const Sample& sample, const Criterion& criterion) {
    const double y = sample.brdf;
    switch (criterion.kind) {
        case Loss::cosine_l2: {
            const double c = cosine(sample.direction.theta_r_deg);
            return {c, c};
        }
        case Loss::cosine: {
            const double w = std::pow(cosine(sample.direction.theta_i_deg), criterion.cos_theta_i_power()) *
                             std::pow(cosine(sample.direction.theta_r_deg), criterion.cos_theta_r_power());
            return {w, w};
        }
        case Loss::l2: return {1, 1};
        case Loss::log: return y > 0 ? Share{1 / (std::numbers::ln10 * std::numbers::ln10), 1} : Share{};
        case Loss::relative: return y > 0 ? Share{1 / (y * y), 1} : Share{};
        case Loss::chi2:
            if (!sample.sigma) throw std::invalid_argument("the loss chi2 needs sigma at every sample");
            return {1 / (*sample.sigma * *sample.sigma), 1};
    }
    return {};
}

Share share(const Sample& sample, const Criterion& criterion) {
    const Share s = share_of_equals(sample, criterion);
    return {s.weight * sample.weight, s.denominator * sample.weight};
}

double denominator_of(const Channel& channel, const Criterion& criterion) {
    double denominator = 0;
    for (const Sample& sample : channel.samples) denominator += share(sample, criterion).denominator;
    return denominator;
}

}  // namespace

double Criterion::threshold() const {
    switch (robust) {
        case Robust::none: return 0;
        case Robust::huber: return robust_threshold.value_or(1.345);
        case Robust::cauchy: return robust_threshold.value_or(2.385);
    }
    return 0;
}

Influence Weighted::influence(double square) const {
    const double bend = threshold * scale;
    switch (robust) {
        case Robust::none: break;
        case Robust::huber: {
            const double size = std::sqrt(square);
            if (size <= bend) break;
            return {bend * (2 * size - bend), bend / size, 0};
        }
        case Robust::cauchy: {
            const double x = square / (bend * bend);
            const double kept = 1 / (1 + x);
            return {bend * bend * std::log1p(x), kept, (1 - x) * kept * kept};
        }
    }
    return {square, 1, 1};
}

Weighted weigh(const Channel& channel, const Criterion& criterion) {
    Weighted result;
    result.logarithmic = criterion.kind == Loss::log;
    result.weight.reserve(channel.samples.size());
    result.y.reserve(channel.samples.size());
    double denominator = 0;
    for (const Sample& sample : channel.samples) {
        const Share s = share(sample, criterion);
        denominator += s.denominator;
        result.weight.push_back(s.weight);
        if (s.weight > 0) ++result.used;
        result.y.push_back(s.weight > 0 ? (result.logarithmic ? std::log(sample.brdf) : sample.brdf) : 0.0);
    }
    double norm2 = 0;
    for (std::size_t j = 0; j < result.weight.size(); ++j) {
        if (denominator > 0) result.weight[j] /= denominator;
        norm2 += result.weight[j] * result.y[j] * result.y[j];
    }
    result.norm = result.logarithmic ? 1.0 : std::sqrt(norm2);
    return result;
}

Weighted weigh(const Channel& channel, const Criterion& criterion, double scale) {
    Weighted result = weigh(channel, criterion);
    if (criterion.robust == Robust::none) return result;
    const double denominator = denominator_of(channel, criterion);
    if (!(denominator > 0)) return result;
    result.robust = criterion.robust;
    result.threshold = criterion.threshold();
    result.scale = scale / std::sqrt(denominator);
    if (result.logarithmic) return result;
    double norm2 = 0;
    for (std::size_t j = 0; j < result.weight.size(); ++j)
        norm2 += result.influence(result.weight[j] * result.y[j] * result.y[j]).loss;
    result.norm = std::sqrt(norm2);
    return result;
}

double scale_in_loss(const Channel& channel, const Criterion& criterion, double scale) {
    return scale * std::sqrt(denominator_of(channel, criterion));
}

bool has_unit(Loss loss) { return loss == Loss::cosine_l2 || loss == Loss::cosine || loss == Loss::l2; }

}  // namespace brdfit::optim
