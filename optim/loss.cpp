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

Share share_of_equals(const Sample& sample, Loss loss) {
    const double y = sample.brdf;
    switch (loss) {
        case Loss::cosine_l2: {
            const double c = std::cos(sample.direction.theta_r_deg * std::numbers::pi / 180);
            return {c, c};
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

Share share(const Sample& sample, Loss loss) {
    const Share s = share_of_equals(sample, loss);
    return {s.weight * sample.weight, s.denominator * sample.weight};
}

}  // namespace

Weighted weigh(const Channel& channel, Loss loss) {
    Weighted result;
    result.logarithmic = loss == Loss::log;
    double denominator = 0;
    for (const Sample& sample : channel.samples) {
        const Share s = share(sample, loss);
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

}  // namespace brdfit::optim
