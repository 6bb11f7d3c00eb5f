/// How noisy the samples of a channel are, by the data alone.
#pragma once

#include <mutex>
#include <vector>

#include "optim/dataset.h"
#include "optim/report.h"

namespace brdfit::optim {

/// Standard deviations of a channel's samples. Independent Gaussian noise with sigma_j^2 = floor^2 + (relative y_j)^2,
/// or as given.
struct Noise {
    NoiseRecord record;
    std::vector<double> sigma;  ///< one a sample, > 0, in the data's unit; empty where only residuals can tell
    double degrees = 0;         ///< of freedom of the estimate; infinite if sigma was given
    /// Relative variances of the estimates of floor^2 and relative^2, and their covariance.
    double floor_variance = 0;
    double relative_variance = 0;
    double covariance = 0;

    /// Of freedom of a variance of which that part is the floor's.
    [[nodiscard]] double degrees_of(double floor_part) const;
};

/// What the channel's sigma say, if every sample has one; else what fourth divided differences along its scans do,
/// which a smooth curve hardly has (docs/statistics.md).
Noise noise_of(const Channel& channel);

/// The noise of a channel, which it refers to, found when it is first asked for. Safe to use from several threads.
class NoiseOf {
public:
    explicit NoiseOf(const Channel& channel) : channel_(channel) {}
    [[nodiscard]] const Noise& get() const {
        std::call_once(once_, [this] { noise_ = noise_of(channel_); });
        return noise_;
    }

private:
    const Channel& channel_;
    mutable std::once_flag once_;
    mutable Noise noise_;
};

}  // namespace brdfit::optim
