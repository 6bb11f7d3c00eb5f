/// NLopt, global then local, over a search space.
#pragma once

#include <chrono>
#include <cstdint>
#include <functional>
#include <span>
#include <stdexcept>
#include <stop_token>
#include <vector>

#include "kernels/evaluator.h"
#include "optim/report.h"
#include "optim/space.h"

namespace brdfit::optim {

/// A search that has no result; what() is fit for the user.
class SearchError : public std::runtime_error {
public:
    using std::runtime_error::runtime_error;
};

/// How much a search may spend.
struct SearchBudget {
    std::size_t screened = 0;    ///< candidates of a low-discrepancy set, evaluated in one batch
    std::size_t starts = 0;      ///< the best distinct ones from which SLSQP descends
    int global_evaluations = 0;  ///< of NLopt's global method
    int local_evaluations = 0;   ///< of each local search
};

enum class Effort { draft, standard, thorough };

/// Budget for a space of that dimension.
SearchBudget budget(Effort effort, std::size_t dimension);

struct SearchControl {
    std::uint64_t seed = 1;  ///< shifts the low-discrepancy set
    std::chrono::steady_clock::time_point deadline = std::chrono::steady_clock::time_point::max();
    std::stop_token stop{};

    /// Time has run out, or a stop was asked for.
    [[nodiscard]] bool over() const { return stop.stop_requested() || std::chrono::steady_clock::now() >= deadline; }
};

/// Where a search ended.
struct Minimum {
    std::vector<double> u;
    std::vector<double> coefficients;
    double loss2 = 0;  ///< sum of w r^2
    StopReason stop = StopReason::converged;
};

struct SearchResult {
    Minimum best;
    SearchRecord record;          ///< without the time
    std::vector<Minimum> minima;  ///< distinct ends of local searches, best first; not completed
};

/// The projected loss (Evaluator::project) over a space, divided by scale2 > 0, as an objective. References must
/// outlive it. All members throw what the evaluator throws.
class ProjectedLoss {
public:
    ProjectedLoss(kernels::Evaluator& evaluator, const SearchSpace& space, double scale2)
        : evaluator_(evaluator), space_(space), scale2_(scale2) {}

    /// The value at u, and its gradient unless that is empty.
    double operator()(std::span<const double> u, std::span<double> gradient);
    /// Values at many points, in launches small enough to look at the clock between them; points left when time runs
    /// out have the largest value.
    std::vector<double> screen(const std::vector<std::vector<double>>& points, const SearchControl& control);
    /// Fills in the loss, not divided, and the coefficients at minimum.u.
    void complete(Minimum& minimum);

    [[nodiscard]] std::size_t evaluations() const { return evaluations_; }

private:
    kernels::Evaluator& evaluator_;
    const SearchSpace& space_;
    double scale2_;
    kernels::Batch batch_;
    std::size_t evaluations_ = 0;
};

/// Minimises the projected loss (Evaluator::project) over the space. `seeds` are screened apart, and the best of them
/// descend always: the result is no worse than any seed. scale2 > 0 makes the objective of order one: loss2/scale2.
/// Throws what the evaluator throws.
SearchResult search_projected(kernels::Evaluator& evaluator, const SearchSpace& space, const SearchBudget& budget,
                              const SearchControl& control, double scale2,
                              const std::vector<std::vector<double>>& seeds);

/// A smooth function on the unit cube: value, and its gradient unless that is empty.
using Objective = std::function<double(std::span<const double> u, std::span<double> gradient)>;

/// One descent with NLopt's SLSQP from u; returns the best point met. Throws what the objective throws.
Minimum descend(const Objective& objective, std::vector<double> u, int max_evaluations, double tolerance,
                const SearchControl& control);

/// Descents from several starts, at least one, and from the best end again until nothing is gained.
struct Descents {
    Minimum best;               ///< its stop is the last descent's
    std::vector<Minimum> ends;  ///< of each start until time ran out, best first
    std::size_t agreed = 0;     ///< ends within 1e-3 of the best loss
};
Descents descend_all(const Objective& objective, const std::vector<std::vector<double>>& starts, int max_evaluations,
                     const SearchControl& control);

}  // namespace brdfit::optim
