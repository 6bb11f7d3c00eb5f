/// Steps: what a lobe of the least exponent is at the samples, and the best places for one in a fit.
#pragma once

#include <cstddef>
#include <map>
#include <span>
#include <utility>
#include <vector>

#include "kernels/evaluator.h"
#include "kernels/model.h"
#include "optim/loss.h"

namespace brdfit::optim {

/// A fit as it is before one of its lobes becomes a step. Spans are of the caller's memory.
struct StepBase {
    std::span<const double> values;        ///< every term and its slopes at every sample, as Evaluator::terms
    std::span<const double> coefficients;  ///< T
    std::span<const double> lower;         ///< T: bounds of the coefficients; equal where they are held
    std::span<const double> upper;
};

/// A step whose edge lies between two samples.
struct Step {
    double psi = 0;    ///< of its direction in the lobe's plane [rad]
    double loss2 = 0;  ///< with the other terms adapted to it, to first order
};

/// A lobe max(0, x a + y b)^n of a small n is 1 on one side of its edge x a + y b = 0 and 0 on the other, so its loss
/// jumps wherever the edge passes a sample: no slope leads to the best place. But what a step adds to the normal
/// equations are running sums over the samples in the order of their angles, and so every place can be tried.
class StepScan {
public:
    /// data: squares, one entry a direction. All must outlive it.
    StepScan(const kernels::Model& model, const kernels::DirectionSet& directions, const Weighted& data)
        : model_(model), directions_(directions), data_(data) {}

    /// The best steps in place of a homogeneous term that has columns, some samples apart, best first: at most so many.
    /// None where there are too many directions to look at each.
    [[nodiscard]] std::vector<Step> best(std::size_t term, const StepBase& base, std::size_t most);

private:
    /// The samples by their angles in a plane of two columns; none where there are too many.
    struct Order {
        std::vector<std::size_t> samples;
        std::vector<double> angles;  ///< in that order, rising
    };
    const Order& order_in(const std::pair<std::size_t, std::size_t>& columns);

    std::map<std::pair<std::size_t, std::size_t>, Order> orders_;
    const kernels::Model& model_;
    const kernels::DirectionSet& directions_;
    const Weighted& data_;
};

}  // namespace brdfit::optim
