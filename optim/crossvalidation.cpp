#include "optim/crossvalidation.h"

#include <cmath>
#include <map>

#include "optim/statistics.h"

namespace brdfit::optim {
namespace {

constexpr std::size_t kMostFolds = 24;
/// A fold's loss^2 is found to this part.
constexpr double kEnough = 1e-6;

}  // namespace

std::optional<HeldOut> hold_out(Refitter& refitter, const Task& task, const Channel& channel, double unit,
                                const Weighted& weighted, std::span<const Point> starts, std::size_t free) {
    std::map<double, std::size_t> fold_of;  // of each incidence angle
    for (const Sample& sample : channel.samples) fold_of.emplace(sample.direction.theta_i_deg, 0);
    if (fold_of.size() < 2) return std::nullopt;
    const std::size_t folds = std::min(fold_of.size(), kMostFolds);
    std::size_t next = 0;
    for (auto& [theta_i_deg, fold] : fold_of) fold = next++ % folds;
    std::vector<std::size_t> fold;
    for (const Sample& sample : channel.samples) fold.push_back(fold_of.at(sample.direction.theta_i_deg));

    std::vector<double> predicted(fold.size());
    for (std::size_t k = 0; k < folds; ++k) {
        if (task.control.over()) return std::nullopt;
        Weighted kept = task.weighted;
        kept.used = 0;
        double norm2 = 0;
        for (std::size_t j = 0; j < fold.size(); ++j) {
            if (fold[j] == k) kept.weight[j] = 0;
            if (kept.weight[j] > 0) ++kept.used;
            norm2 += kept.weight[j] * kept.y[j] * kept.y[j];
        }
        if (kept.used < free) return std::nullopt;
        if (!kept.logarithmic) kept.norm = std::sqrt(norm2);
        const auto ends = refitter.descend(kept, starts, kEnough);
        const kernels::Values values = refitter.values(ends.front(), false);
        for (std::size_t j = 0; j < fold.size(); ++j)
            if (fold[j] == k) predicted[j] = values.f[j] * unit;
    }
    return held_out_errors(channel, weighted, predicted);
}

}  // namespace brdfit::optim
