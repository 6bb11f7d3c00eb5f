/// A model fitted again from known points, as data or weights change.
#pragma once

#include <optional>
#include <span>
#include <vector>

#include "kernels/evaluator.h"
#include "optim/optimum.h"

namespace brdfit::optim {

/// Descents in one space, on one task's samples; quicker than a search, and local. Not for two threads at once.
class Refitter {
public:
    /// Residuals are those of the task's loss, or differences whatever that is. References must outlive it. Throws what
    /// an evaluator throws.
    enum class Residual { of_loss, difference };
    Refitter(const Task& task, const std::vector<Interval>& bounds, Residual residual = Residual::of_loss);

    struct End : Point {
        double loss2 = 0;  ///< sum of w r^2
        StopReason stop = StopReason::converged;
    };
    /// The ends of descents from the starts, best first. A descent ends when it promises a decrease below `relative` of
    /// its loss^2. Throws what an evaluator throws.
    std::vector<End> descend(const Weighted& weighted, std::span<const Point> starts, double relative);
    /// The best of those ends alone: a descent that cannot be it is not followed to its own.
    End best(const Weighted& weighted, std::span<const Point> starts, double relative);
    /// scale f at each sample, with the unit of the task's channel; on request by each parameter as well. Valid until
    /// the next call.
    const kernels::Values& values(const Point& point, bool gradient);
    /// Half the slopes of the loss^2 of the task's data at each point, all in one launch: by each parameter, then by
    /// the logarithm of the scale; point by point.
    std::vector<double> half_slopes(std::span<const Point> points);
    /// The evaluator, with the data of the last descent or what a caller has assigned since: descents assign their own.
    [[nodiscard]] kernels::Evaluator& evaluator() { return evaluator_; }
    [[nodiscard]] bool logarithmic() const { return logarithmic_; }
    [[nodiscard]] std::size_t evaluations() const { return evaluations_; }

private:
    /// part: with fewer samples of the same data, to tell the curvature of squares by; may be nullptr.
    std::vector<End> descend(kernels::Evaluator& evaluator, const Weighted& weighted, std::span<const Point> starts,
                             double relative, double hopeful, kernels::Evaluator* part = nullptr);

    const Task& task_;
    bool logarithmic_;
    SearchSpace space_;
    kernels::Evaluator evaluator_;
    std::size_t evaluations_ = 0;
    std::optional<Point> known_;  ///< of the next
    kernels::Values with_gradient_;
    kernels::Values without_;
};

}  // namespace brdfit::optim
