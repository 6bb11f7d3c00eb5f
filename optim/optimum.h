/// The best parameters of one variant of a model on one channel.
#pragma once

#include <optional>
#include <vector>

#include "kernels/engine.h"
#include "kernels/evaluator.h"
#include "kernels/model.h"
#include "optim/dataset.h"
#include "optim/loss.h"
#include "optim/report.h"
#include "optim/search.h"
#include "optim/space.h"

namespace brdfit::optim {

/// Everything a search of one variant on one channel needs. References must outlive it.
struct Task {
    kernels::Engine& engine;
    const kernels::Model& model;
    const Channel& channel;
    const kernels::DirectionSet& directions;  ///< of the channel's samples
    const Weighted& weighted;                 ///< the channel under the loss
    /// None: what is quick for the search, the best that may be used for its end.
    std::optional<kernels::Precision> precision;
    Effort effort;
    SearchControl control;
    ScaleRange scale;  ///< of relative data; {1, 1} for absolute data
};

/// A material, as a descent starts from or ends at.
struct Point {
    std::vector<double> parameters;  ///< in the model's unit
    double scale = 1;                ///< measured = scale * f
};

struct Optimum : Point {  ///< within the bounds
    const kernels::Model* model = nullptr;
    double relative_loss2 = 0;  ///< loss^2 over that of f = 0 (Weighted::norm); for `log` loss^2
    SearchRecord record;
    std::vector<Point> others{};  ///< ends of the search apart from the best one, best first, not polished
    std::vector<double> ends{};   ///< relative_loss2 of all descents of the search, as it saw it
};

/// The smaller variant's point with further lobes of no height.
Point extended(const kernels::Model& model, const kernels::Model& smaller, const Point& point);
/// With weights of a size that single precision can sum: sum of w y^2 near 1.
Weighted balanced(Weighted weighted);
/// Size from which on coefficients are searched by their logarithm, where they are coordinates.
double coefficient_level(const Task& task);
/// Counts evaluations that went before the search.
void add_before(SearchRecord& record, std::size_t evaluations);

/// Searches within the bounds (one for each parameter, in the model's unit). `smaller`: the optimum of a variant with
/// fewer lobes, whose loss this one will not exceed; may be nullptr. Throws kernels::DeviceError, kernels::BuildError,
/// SearchError.
Optimum find_optimum(const Task& task, const std::vector<Interval>& bounds, const Optimum* smaller);

/// What a search under a robust loss begins with.
struct Groundwork {
    double scale = 0;           ///< of the best fit's ordinary residuals, as Weighted::scale
    std::vector<Point> starts;  ///< the best distinct fits under Cauchy's loss of that scale, best first, at least one
    std::size_t evaluations = 0;
};

/// From the squares of task.weighted: searches, each under the squares reweighted by the fit before, until the scale no
/// longer falls. `smaller`: of the variant with fewer lobes, of the model `smaller_model`; may be nullptr. Throws as
/// find_optimum.
Groundwork lay_groundwork(const Task& task, const std::vector<Interval>& bounds, const Point* smaller,
                          const kernels::Model* smaller_model);
/// The same as find_optimum where task.weighted is robust.
Optimum find_robust_optimum(const Task& task, const std::vector<Interval>& bounds, const Optimum* smaller,
                            const Groundwork& groundwork);

}  // namespace brdfit::optim
