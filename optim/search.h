/// The search for the best point of a space: global, then local, with NLopt where no curvature is known.
#pragma once

#include <chrono>
#include <cstdint>
#include <functional>
#include <span>
#include <stdexcept>
#include <stop_token>
#include <vector>

#include "kernels/evaluator.h"
#include "optim/loss.h"
#include "optim/progress.h"
#include "optim/report.h"
#include "optim/space.h"
#include "optim/steps.h"

namespace brdfit::optim {

/// A search that has no result; what() is fit for the user.
class SearchError : public std::runtime_error {
public:
    using std::runtime_error::runtime_error;
};

/// How much a search may spend.
struct SearchBudget {
    std::size_t screened = 0;         ///< candidates of a low-discrepancy set, evaluated in one batch
    std::size_t starts = 0;           ///< the best distinct ones, from which descents start
    std::size_t bases = 0;            ///< the best distinct ends about which blocks of coordinates are exchanged
    std::size_t exchanged = 0;        ///< candidates for each block, ...
    std::size_t exchange_starts = 0;  ///< the best distinct of which descend
    int global_evaluations = 0;       ///< of NLopt's global method
};

enum class Effort { draft, standard, thorough };

/// Budget for a space of that dimension and a model with so many lobes (0 or 1 without).
SearchBudget budget(Effort effort, std::size_t dimension, std::size_t lobes);

struct SearchControl {
    std::uint64_t seed = 1;  ///< shifts the low-discrepancy set
    std::chrono::steady_clock::time_point deadline = std::chrono::steady_clock::time_point::max();
    std::stop_token stop{};
    TaskProgress* progress = nullptr;  ///< told what is done, if there is one
    bool milestones = false;           ///< SearchRecord::milestones are wanted

    /// Time has run out, or a stop was asked for.
    [[nodiscard]] bool over() const { return stop.stop_requested() || std::chrono::steady_clock::now() >= deadline; }
    void evaluated(std::size_t candidates, double relative_loss2) const {
        if (progress != nullptr) progress->evaluated(candidates, relative_loss2);
    }
    void stepped() const {
        if (progress != nullptr) progress->stepped();
    }
};

/// Where a search ended.
struct Minimum {
    std::vector<double> u;
    std::vector<double> coefficients;
    double loss2 = 0;  ///< sum of w r^2
    StopReason stop = StopReason::converged;
};

class SpaceLoss;

struct SearchResult {
    Minimum best;
    SearchRecord record;          ///< without the time
    std::vector<Minimum> minima;  ///< distinct ends of descents, best first; not completed
    std::vector<Minimum> last;    ///< ends of the last stage's descents, best first; not completed
    std::vector<double> ends;     ///< loss^2 of all descents of the search, rising; as `minima`, of the first stage
};

/// An objective at a point: its value, its gradient, and its curvature by Gauss and Newton's approximation.
struct Look {
    double value = 0;
    std::vector<double> gradient;   ///< d
    std::vector<double> curvature;  ///< d x d, symmetric, positive semidefinite
};

/// Points to screen: of a low-discrepancy set, three of four within the typical range, the others anywhere.
std::vector<std::vector<double>> screening_points(const SearchSpace& space, std::size_t count, std::uint64_t seed);
/// The best points, by their values, that are not close to a better one.
std::vector<std::vector<double>> best_distinct(const std::vector<std::vector<double>>& points,
                                               const std::vector<double>& values, std::size_t count);

/// The ends, in their order, that differ from those before by `close` in some coordinate.
std::vector<Minimum> distinct_ends(const std::vector<Minimum>& ends, double close);

/// Minimises over a space. `stages` are losses of that space in rising order of cost and trust, at least one: the first
/// is searched, each further one goes on from the best ends of the one before, the last decides, or leaves that to the
/// loss it stands for (SearchResult::last). `seeds` descend
/// always: the result is no worse than any seed as the first stage sees it. `scan`, of the first stage's data and only
/// with Unknowns::nonlinear: lobes are tried as steps; may be nullptr. Throws what they throw.
SearchResult search_space(std::span<SpaceLoss* const> stages, const SearchBudget& budget, const SearchControl& control,
                          const std::vector<std::vector<double>>& seeds, StepScan* scan = nullptr);

/// A smooth function on the unit cube: value, and its gradient unless that is empty.
using Objective = std::function<double(std::span<const double> u, std::span<double> gradient)>;

/// One descent with NLopt's SLSQP from u; returns the best point met. Throws what the objective throws.
Minimum descend(const Objective& objective, std::vector<double> u, int max_evaluations, double tolerance,
                const SearchControl& control);

}  // namespace brdfit::optim
