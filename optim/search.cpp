#include "optim/search.h"

#include <algorithm>
#include <cmath>
#include <exception>
#include <limits>
#include <memory>
#include <numeric>
#include <random>

#include <nlopt.h>
#include <boost/random/sobol.hpp>

namespace brdfit::optim {
namespace {

using Clock = std::chrono::steady_clock;

struct NloptDelete {
    void operator()(nlopt_opt opt) const { nlopt_destroy(opt); }
};
using Nlopt = std::unique_ptr<std::remove_pointer_t<nlopt_opt>, NloptDelete>;

bool all_finite(std::span<const double> values) {
    return std::all_of(values.begin(), values.end(), [](double value) { return std::isfinite(value); });
}

/// Carries an objective through NLopt's C interface. NLopt turns foreign exceptions into a bare failure, so they are
/// kept here and thrown again; it may end away from its best point, so that is kept too.
struct Adapter {
    const Objective& objective;
    const SearchControl& control;
    nlopt_opt opt = nullptr;
    std::vector<double> best_u{};
    double best = std::numeric_limits<double>::infinity();
    bool timed_out = false;
    bool lost = false;  ///< the optimiser asked for a point that is no number
    std::exception_ptr error{};

    static double call(unsigned n, const double* u, double* gradient, void* self) {
        return static_cast<Adapter*>(self)->evaluate({u, n}, {gradient, gradient ? n : 0});
    }

    double evaluate(std::span<const double> u, std::span<double> gradient) {
        try {
            if (control.stop.stop_requested()) nlopt_force_stop(opt);
            if (Clock::now() >= control.deadline) {
                timed_out = true;
                nlopt_force_stop(opt);
            }
            if (!all_finite(u)) {  // SLSQP's own round-off: what was found before stands
                lost = true;
                nlopt_force_stop(opt);
                std::fill(gradient.begin(), gradient.end(), 0.0);
                return std::numeric_limits<double>::max();
            }
            const double value = objective(u, gradient);
            // SLSQP can spin for ever on a NaN.
            if (!std::isfinite(value) || !all_finite(gradient))
                throw SearchError("the model gave a value that is not finite");
            if (value < best) {
                best = value;
                best_u.assign(u.begin(), u.end());
            }
            return value;
        } catch (...) {
            error = std::current_exception();
            nlopt_force_stop(opt);
            std::fill(gradient.begin(), gradient.end(), 0.0);
            return std::numeric_limits<double>::max();
        }
    }

    [[nodiscard]] StopReason reason(nlopt_result result) const {
        if (control.stop.stop_requested()) return StopReason::cancelled;
        if (timed_out || result == NLOPT_MAXTIME_REACHED) return StopReason::time_limit;
        if (result == NLOPT_MAXEVAL_REACHED) return StopReason::evaluation_limit;
        if (result == NLOPT_ROUNDOFF_LIMITED) return StopReason::roundoff;
        if (lost) return StopReason::roundoff;
        // SLSQP says "failure" where its line search finds no descent along a gradient lost in round-off.
        if (result == NLOPT_FAILURE) return StopReason::roundoff;
        if (result < 0) throw SearchError("the optimiser refused the problem");
        return StopReason::converged;
    }
};

/// Runs opt from u with the objective.
Minimum run(Nlopt opt, const Objective& objective, std::vector<double> u, const SearchControl& control) {
    Adapter adapter{objective, control};
    adapter.opt = opt.get();
    nlopt_set_min_objective(opt.get(), &Adapter::call, &adapter);
    nlopt_set_lower_bounds1(opt.get(), 0.0);
    nlopt_set_upper_bounds1(opt.get(), 1.0);
    for (double& x : u) x = std::clamp(x, 0.0, 1.0);
    double value = 0;
    const nlopt_result result = nlopt_optimize(opt.get(), u.data(), &value);
    if (adapter.error) std::rethrow_exception(adapter.error);
    Minimum minimum;
    minimum.stop = adapter.reason(result);
    minimum.u = adapter.best_u.empty() ? u : adapter.best_u;
    minimum.loss2 = adapter.best;
    return minimum;
}

Nlopt local_optimizer(std::size_t dimension, int max_evaluations, double tolerance) {
    Nlopt opt(nlopt_create(NLOPT_LD_SLSQP, static_cast<unsigned>(dimension)));
    nlopt_set_maxeval(opt.get(), max_evaluations);
    nlopt_set_ftol_rel(opt.get(), tolerance);
    nlopt_set_xtol_rel(opt.get(), 1e-3 * std::sqrt(tolerance));
    return opt;
}

/// NLopt's global search. One dimension: DIRECT, which cannot miss a basin wider than its mesh. More: multi-level
/// single linkage over a low-discrepancy sequence, with SLSQP inside.
Minimum explore(const Objective& objective, std::size_t dimension, int max_evaluations, const SearchControl& control) {
    Nlopt opt(nlopt_create(dimension == 1 ? NLOPT_GN_DIRECT_L : NLOPT_GD_MLSL_LDS, static_cast<unsigned>(dimension)));
    nlopt_set_maxeval(opt.get(), max_evaluations);
    if (dimension > 1) {
        const Nlopt local = local_optimizer(dimension, max_evaluations, 1e-6);
        nlopt_set_local_optimizer(opt.get(), local.get());
    }
    return run(std::move(opt), objective, std::vector<double>(dimension, 0.5), control);
}

/// Sobol's points, shifted by the seed, modulo 1: three of four within the typical range, the others anywhere.
std::vector<std::vector<double>> screening_points(const SearchSpace& space, std::size_t count, std::uint64_t seed) {
    const std::size_t d = space.dimension();
    const std::vector<Interval> typical = space.typical();
    std::mt19937_64 random(seed);
    std::uniform_real_distribution<double> uniform(0.0, 1.0);
    std::vector<double> shift(d);
    for (double& s : shift) s = uniform(random);
    boost::random::sobol sobol(d);
    std::vector<std::vector<double>> points(count, std::vector<double>(d));
    for (std::size_t i = 0; i < count; ++i)
        for (std::size_t j = 0; j < d; ++j) {
            double x = static_cast<double>(sobol()) / 18446744073709551616.0 + shift[j];
            x -= std::floor(x);
            points[i][j] = i % 4 == 3 ? x : typical[j].min + x * (typical[j].max - typical[j].min);
        }
    return points;
}

double distance(std::span<const double> a, std::span<const double> b) {
    double largest = 0;
    for (std::size_t i = 0; i < a.size(); ++i) largest = std::max(largest, std::abs(a[i] - b[i]));
    return largest;
}

/// The best points that are not close to a better one.
std::vector<std::vector<double>> best_distinct(const std::vector<std::vector<double>>& points,
                                               const std::vector<double>& values, std::size_t count) {
    constexpr double kClose = 0.05;
    std::vector<std::size_t> order(points.size());
    std::iota(order.begin(), order.end(), std::size_t{0});
    std::stable_sort(order.begin(), order.end(), [&](std::size_t a, std::size_t b) { return values[a] < values[b]; });
    std::vector<std::vector<double>> chosen;
    for (const std::size_t i : order) {
        if (chosen.size() == count) break;
        if (std::none_of(chosen.begin(), chosen.end(), [&](const auto& u) { return distance(u, points[i]) < kClose; }))
            chosen.push_back(points[i]);
    }
    return chosen;
}

/// Seeds that descend.
constexpr std::size_t kSeedStarts = 8;

}  // namespace

SearchBudget budget(Effort effort, std::size_t dimension) {
    const std::size_t factor = effort == Effort::draft ? 1 : effort == Effort::standard ? 4 : 16;
    if (dimension <= 1) return {16 * factor, 2, 40, 100};
    return {32 * factor * (dimension - 1), 3 * factor, static_cast<int>(40 * factor), 200};
}

double ProjectedLoss::operator()(std::span<const double> u, std::span<double> gradient) {
    ++evaluations_;
    const Candidate at = space_.candidate(u);
    evaluator_.project(at.parameters, at.lower, at.upper, !gradient.empty(), batch_);
    if (!gradient.empty()) {
        space_.gradient(u, at, batch_.coefficients, batch_.by_parameter, batch_.by_coefficient, gradient);
        for (double& g : gradient) g /= scale2_;
    }
    return batch_.loss[0] / scale2_;
}

std::vector<double> ProjectedLoss::screen(const std::vector<std::vector<double>>& points,
                                          const SearchControl& control) {
    constexpr std::size_t kLaunch = 1'000'000;  // candidates x samples: under a second on one core
    const std::size_t most = std::max<std::size_t>(1, kLaunch / std::max<std::size_t>(1, evaluator_.samples()));
    std::vector<double> values(points.size(), std::numeric_limits<double>::max());
    for (std::size_t first = 0; first < points.size() && !control.over(); first += most) {
        const std::size_t count = std::min(most, points.size() - first);
        std::vector<double> parameters, lower, upper;
        for (std::size_t i = first; i < first + count; ++i) {
            const Candidate at = space_.candidate(points[i]);
            parameters.insert(parameters.end(), at.parameters.begin(), at.parameters.end());
            lower.insert(lower.end(), at.lower.begin(), at.lower.end());
            upper.insert(upper.end(), at.upper.begin(), at.upper.end());
        }
        evaluator_.project(parameters, lower, upper, false, batch_);
        evaluations_ += count;
        for (std::size_t i = 0; i < count; ++i)
            if (std::isfinite(batch_.loss[i])) values[first + i] = batch_.loss[i] / scale2_;
    }
    return values;
}

void ProjectedLoss::complete(Minimum& minimum) {
    minimum.loss2 = (*this)(minimum.u, {}) * scale2_;
    minimum.coefficients = batch_.coefficients;
}

Minimum descend(const Objective& objective, std::vector<double> u, int max_evaluations, double tolerance,
                const SearchControl& control) {
    const std::size_t dimension = u.size();
    return run(local_optimizer(dimension, max_evaluations, tolerance), objective, std::move(u), control);
}

Descents descend_all(const Objective& objective, const std::vector<std::vector<double>>& starts, int max_evaluations,
                     const SearchControl& control) {
    const auto cut_short = [](const Minimum& end) {
        return end.stop == StopReason::time_limit || end.stop == StopReason::cancelled;
    };
    Descents result;
    for (const std::vector<double>& start : starts) {
        result.ends.push_back(descend(objective, start, max_evaluations, 1e-9, control));
        if (cut_short(result.ends.back())) break;
    }
    std::stable_sort(result.ends.begin(), result.ends.end(),
                     [](const Minimum& a, const Minimum& b) { return a.loss2 < b.loss2; });
    result.best = result.ends.front();
    for (int round = 0; round < 5; ++round) {
        const Minimum next = descend(objective, result.best.u, max_evaluations, 1e-13, control);
        const double gain = result.best.loss2 - next.loss2;
        if (gain >= 0) result.best = next;
        result.best.stop = next.stop;
        if (cut_short(next) || gain <= 1e-9 * result.best.loss2) break;
    }
    result.agreed =
        static_cast<std::size_t>(std::count_if(result.ends.begin(), result.ends.end(), [&](const Minimum& m) {
            return std::sqrt(m.loss2) <= 1.001 * std::sqrt(result.best.loss2) + 1e-12;
        }));
    return result;
}

SearchResult search_projected(kernels::Evaluator& evaluator, const SearchSpace& space, const SearchBudget& budget,
                              const SearchControl& control, double scale2,
                              const std::vector<std::vector<double>>& seeds) {
    const std::size_t d = space.dimension();
    ProjectedLoss problem(evaluator, space, scale2);
    SearchResult result;
    if (d == 0) {
        problem.complete(result.best);
        result.record = {1, 1, 1, StopReason::converged, 0};
        result.minima.push_back(result.best);
        return result;
    }

    const Objective objective = [&](std::span<const double> u, std::span<double> g) { return problem(u, g); };
    const auto points = screening_points(space, budget.screened, control.seed);
    std::vector<std::vector<double>> starts;
    if (!seeds.empty()) starts = best_distinct(seeds, problem.screen(seeds, control), kSeedStarts);
    if (budget.global_evaluations > 0) starts.push_back(explore(objective, d, budget.global_evaluations, control).u);
    for (auto& start : best_distinct(points, problem.screen(points, control), budget.starts))
        starts.push_back(std::move(start));

    Descents descents = descend_all(objective, starts, budget.local_evaluations, control);
    for (const Minimum& end : descents.ends) {
        const bool known = std::any_of(result.minima.begin(), result.minima.end(),
                                       [&](const Minimum& m) { return distance(m.u, end.u) < 1e-3; });
        if (!known) result.minima.push_back(end);
    }
    result.best = std::move(descents.best);
    problem.complete(result.best);
    result.record = {descents.ends.size(), descents.agreed, problem.evaluations(), result.best.stop, 0};
    return result;
}

}  // namespace brdfit::optim
