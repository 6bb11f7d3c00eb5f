#include "optim/search.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <exception>
#include <limits>
#include <memory>
#include <numeric>
#include <random>
#include <utility>

#include <nlopt.h>
#include <boost/random/sobol.hpp>

#include "optim/descent.h"
#include "optim/robust.h"

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
            control.evaluated(1, value);
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

/// Sobol's points of d dimensions, shifted by the seed, modulo 1.
std::vector<std::vector<double>> sobol_points(std::size_t d, std::size_t count, std::uint64_t seed) {
    std::mt19937_64 random(seed);
    std::uniform_real_distribution<double> uniform(0.0, 1.0);
    std::vector<double> shift(d);
    for (double& s : shift) s = uniform(random);
    boost::random::sobol sobol(d);
    std::vector<std::vector<double>> points(count, std::vector<double>(d));
    for (auto& point : points)
        for (std::size_t j = 0; j < d; ++j) {
            const double x = static_cast<double>(sobol()) / 18446744073709551616.0 + shift[j];
            point[j] = x - std::floor(x);
        }
    return points;
}

/// The point with other coordinates in one block, from half way between the typical range and the whole.
std::vector<std::vector<double>> exchanged_points(const SearchSpace& space, const std::vector<double>& base,
                                                  const std::vector<std::size_t>& block, std::size_t count,
                                                  std::uint64_t seed) {
    const std::vector<Interval> typical = space.typical();
    std::vector<std::vector<double>> points(count, base);
    const auto fresh = sobol_points(block.size(), count, seed);
    for (std::size_t i = 0; i < count; ++i)
        for (std::size_t j = 0; j < block.size(); ++j) {
            const double low = typical[block[j]].min / 2;
            const double high = (1 + typical[block[j]].max) / 2;
            points[i][block[j]] = low + fresh[i][j] * (high - low);
        }
    return points;
}

double distance(std::span<const double> a, std::span<const double> b) {
    double largest = 0;
    for (std::size_t i = 0; i < a.size(); ++i) largest = std::max(largest, std::abs(a[i] - b[i]));
    return largest;
}

/// Descents stop short of what the arithmetic of a search can tell.
constexpr DescentGoal kQuickGoal{1e-5, 1e-12, 60};
constexpr DescentGoal kExactGoal{1e-11, 1e-26, 100};
/// Samples at which a spike is tried in place of a lobe of the best end.
constexpr std::size_t kMostSpikes = 200;
/// Steps a few samples apart are near each other in the cube, and other minima.
constexpr DescentGoal kStepGoal{.relative = 1e-7, .absolute = 1e-12, .looks = 60, .apart = 1e-6};
/// Steps are tried about so many of the best ends, then about the best while loss^2 gains this part, in so many rounds:
/// at most so many of each lobe, where loss^2 is promised to be no more than so much of the best.
constexpr std::size_t kStepBases = 3;
constexpr double kStepGain = 1e-5;
constexpr int kStepRounds = 3;
constexpr std::size_t kMostSteps = 8;
constexpr double kStepPromise = 1.03;
/// Rounds of exchanges, while each gains.
constexpr int kExchangeRounds = 4;
/// Of NLopt's SLSQP from each of the last ends, in all parameters.
constexpr int kFurtherEvaluations = 300;
/// Ends whose loss^2 is this near to the best are worth polishing, so many of them: found with other samples, or with
/// the same ones, when an end of kQuickGoal is known that well.
struct Polish {
    double within;
    std::size_t most;
};
constexpr Polish kOtherSamples{1.02, 3};
constexpr Polish kSameSamples{1.0005, 2};

}  // namespace

std::vector<std::vector<double>> screening_points(const SearchSpace& space, std::size_t count, std::uint64_t seed) {
    const std::vector<Interval> typical = space.typical();
    auto points = sobol_points(space.dimension(), count, seed);
    for (std::size_t i = 0; i < count; ++i)
        for (std::size_t j = 0; i % 4 != 3 && j < typical.size(); ++j)
            points[i][j] = typical[j].min + points[i][j] * (typical[j].max - typical[j].min);
    return points;
}

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

std::vector<Minimum> distinct_ends(const std::vector<Minimum>& ends, double close) {
    std::vector<Minimum> result;
    for (const Minimum& end : ends)
        if (std::none_of(result.begin(), result.end(), [&](const Minimum& m) { return distance(m.u, end.u) < close; }))
            result.push_back(end);
    return result;
}

SearchBudget budget(Effort effort, std::size_t dimension, std::size_t lobes) {
    const bool thorough = effort == Effort::thorough;
    const std::size_t factor = thorough ? 8 : 1;
    const int global = thorough ? 500 : 0;
    if (dimension <= 1) return {48 * factor, 4 * factor, 0, 0, 0, global};
    // Lobes are apt to change places with noise.
    SearchBudget result{24 * dimension, 2 * dimension, 1, 32, 2, global};
    if (lobes > 1) result = {32 * dimension, 2 * dimension, 3, 128, 4, global};
    if (effort == Effort::draft) return {result.screened / 2, result.starts / 2, 0, 0, 0, 0};
    result.screened *= factor;
    result.starts *= factor;
    if (thorough) result.bases *= 4;
    if (thorough) result.exchanged *= 2;
    return result;
}

void SpaceLoss::evaluate(std::span<const std::vector<double>> points, bool gradient) {
    if (candidates_.size() < points.size()) candidates_.resize(points.size());
    parameters_.clear();
    lower_.clear();
    upper_.clear();
    for (std::size_t i = 0; i < points.size(); ++i) {
        Candidate& at = candidates_[i];
        space_.place(points[i], at);
        parameters_.insert(parameters_.end(), at.parameters.begin(), at.parameters.end());
        lower_.insert(lower_.end(), at.lower.begin(), at.lower.end());
        upper_.insert(upper_.end(), at.upper.begin(), at.upper.end());
    }
    if (space_.unknowns() == Unknowns::nonlinear) evaluator_.project(parameters_, lower_, upper_, gradient, batch_);
    else if (robust()) robust_loss(evaluator_, *form_, parameters_, lower_, batch_);
    else evaluator_.loss(parameters_, lower_, logarithmic(), batch_);
    evaluations_ += points.size();
}

double SpaceLoss::operator()(std::span<const double> u, std::span<double> gradient) {
    const std::vector<double> point(u.begin(), u.end());
    evaluate({&point, 1}, !gradient.empty());
    if (!gradient.empty()) {
        space_.gradient(u, candidates_[0], batch_.coefficients, batch_.by_parameter, batch_.by_coefficient, gradient);
        for (double& g : gradient) g /= scale2_;
        // Near underflow the slope of a logarithm overflows; at underflow there is none.
        for (double& slope : gradient)
            if (logarithmic() && !std::isfinite(slope)) slope = 0;
    }
    return batch_.loss[0] / scale2_;
}

std::vector<Look> SpaceLoss::looks(std::span<const std::vector<double>> points) {
    evaluate(points, true);
    const kernels::Model& model = space_.model();
    const std::size_t p = model.parameters.size();
    const std::size_t t = model.terms.size();
    const std::size_t d = space_.dimension();
    const std::size_t unknowns = t + space_.nonlinear();
    const std::size_t normals = unknowns * (unknowns + 1) / 2;
    std::vector<Look> result(points.size());
    normal_.resize(unknowns * unknowns);
    bent_.resize(unknowns * d);
    for (std::size_t i = 0; i < points.size(); ++i) {
        Look& look = result[i];
        const Candidate& at = candidates_[i];
        const std::span<const double> c(batch_.coefficients.data() + i * t, t);
        space_.jacobian(points[i], at, c, jacobian_);
        look.value = batch_.loss[i] / scale2_;
        look.gradient.resize(d);
        space_.gradient(jacobian_, {batch_.by_parameter.data() + i * p, p}, {batch_.by_coefficient.data() + i * t, t},
                        look.gradient);
        for (double& g : look.gradient) g /= scale2_;

        const double* entry = batch_.normal.data() + i * normals;
        for (std::size_t row = 0; row < unknowns; ++row)
            for (std::size_t column = row; column < unknowns; ++column)
                normal_[row * unknowns + column] = normal_[column * unknowns + row] = *entry++;
        // What free coefficients take up of a step is taken out of its curvature.
        for (std::size_t k = 0; k < t; ++k) {
            double* const of_k = normal_.data() + k * unknowns;
            const double pivot = of_k[k];
            if (!SearchSpace::is_free(c[k], at.lower[k], at.upper[k]) || !(pivot > 0)) continue;
            for (std::size_t row = 0; row < unknowns; ++row) {
                const double part = of_k[row] / pivot;
                if (row == k || part == 0) continue;
                for (std::size_t column = 0; column < unknowns; ++column)
                    normal_[row * unknowns + column] -= part * of_k[column];
                normal_[row * unknowns + k] = 0;
            }
            std::fill_n(of_k, unknowns, 0.0);
        }
        // The Jacobian's rows are sparse.
        std::fill(bent_.begin(), bent_.end(), 0.0);
        for (std::size_t row = 0; row < unknowns; ++row)
            for (std::size_t j = 0; j < d; ++j)
                if (const double slope = jacobian_[row * d + j]; slope != 0)
                    for (std::size_t k = 0; k < unknowns; ++k)
                        bent_[j * unknowns + k] += slope * normal_[row * unknowns + k];
        look.curvature.resize(d * d);
        for (std::size_t row = 0; row < unknowns; ++row)
            for (std::size_t j = 0; j < d; ++j)
                if (const double slope = 2 / scale2_ * jacobian_[row * d + j]; slope != 0)
                    for (std::size_t k = 0; k < d; ++k) look.curvature[j * d + k] += slope * bent_[k * unknowns + row];
    }
    return result;
}

std::vector<double> SpaceLoss::screen(const std::vector<std::vector<double>>& points, const SearchControl& control) {
    constexpr std::size_t kLaunch = 1'000'000;  // candidates x samples: under a second on one core
    const std::size_t most = std::max<std::size_t>(1, kLaunch / std::max<std::size_t>(1, evaluator_.samples()));
    std::vector<double> values(points.size(), std::numeric_limits<double>::max());
    for (std::size_t first = 0; first < points.size() && !control.over(); first += most) {
        const std::size_t count = std::min(most, points.size() - first);
        evaluate(std::span(points).subspan(first, count), false);
        for (std::size_t i = 0; i < count; ++i)
            if (std::isfinite(batch_.loss[i])) values[first + i] = batch_.loss[i] / scale2_;
        control.evaluated(count, *std::min_element(values.begin() + static_cast<std::ptrdiff_t>(first),
                                                   values.begin() + static_cast<std::ptrdiff_t>(first + count)));
    }
    return values;
}

std::vector<double> SpaceLoss::screen_roughly(const std::vector<std::vector<double>>& points, std::size_t wanted,
                                              const SearchControl& control) {
    constexpr std::size_t kKept = 4;  // for each that is wanted
    const std::size_t kept = kKept * wanted;
    if (fewer_ == nullptr || kept >= points.size()) return screen(points, control);
    const std::vector<double> rough = fewer_->screen(points, control);
    std::vector<std::size_t> order(points.size());
    std::iota(order.begin(), order.end(), std::size_t{0});
    std::nth_element(order.begin(), order.begin() + static_cast<std::ptrdiff_t>(kept), order.end(),
                     [&](std::size_t a, std::size_t b) { return std::pair(rough[a], a) < std::pair(rough[b], b); });
    order.resize(kept);
    std::vector<std::vector<double>> better;
    for (const std::size_t i : order) better.push_back(points[i]);
    const std::vector<double> exact = screen(better, control);
    std::vector<double> values(points.size(), std::numeric_limits<double>::max());
    for (std::size_t k = 0; k < kept; ++k) values[order[k]] = exact[k];
    return values;
}

std::vector<std::vector<double>> SpaceLoss::steps(StepScan& scan, const Minimum& about, double within, std::size_t most,
                                                  const SearchControl& control) {
    // What is like a step, and has a height the space can tell from 0.
    constexpr std::array<double, 3> kDegrees{0.012, 0.03, 0.1};
    std::vector<std::vector<std::size_t>> lobes = space_.blocks();
    std::erase_if(lobes, [&](const auto& block) { return !space_.lobe(block); });
    if (lobes.empty()) return {};
    Minimum base = about;
    complete(base);
    const Candidate at = space_.candidate(base.u);
    const std::vector<double> values = evaluator_.terms(at.parameters);
    std::vector<std::vector<double>> starts;
    for (const auto& block : lobes) {
        const std::optional<std::size_t> term = space_.lobe(block);
        std::vector<LobeShape> shapes;
        for (const Step& step : scan.best(*term, {values, base.coefficients, at.lower, at.upper}, most))
            for (const double degree : kDegrees)
                if (step.loss2 <= within * scale2_) shapes.push_back({step.psi, degree});
        std::vector<std::vector<double>> points = space_.shaped(base.u, block, shapes);
        const std::vector<double> losses = screen(points, control);
        std::vector<std::vector<double>> chosen;
        for (std::size_t i = 0; i < points.size(); i += kDegrees.size()) {
            const auto first = losses.begin() + static_cast<std::ptrdiff_t>(i);
            const auto least = std::min_element(first, first + static_cast<std::ptrdiff_t>(kDegrees.size()));
            chosen.push_back(std::move(points[static_cast<std::size_t>(least - losses.begin())]));
        }
        // The other terms adapt before the step's edge moves: a sample in its way would hold up all of them.
        const Landscape held = [&](auto points_there) {
            std::vector<Look> seen = looks(points_there);
            for (Look& look : seen)
                for (const std::size_t j : block) {
                    look.gradient[j] = 0;
                    for (std::size_t k = 0, d = look.gradient.size(); k < d; ++k)
                        look.curvature[j * d + k] = look.curvature[k * d + j] = 0;
                }
            return seen;
        };
        for (Minimum& end : descend_together(held, chosen, kStepGoal, control)) starts.push_back(std::move(end.u));
    }
    return starts;
}

void SpaceLoss::complete(Minimum& minimum) {
    minimum.loss2 = (*this)(minimum.u, {}) * scale2_;
    minimum.coefficients = batch_.coefficients;
}

Minimum descend(const Objective& objective, std::vector<double> u, int max_evaluations, double tolerance,
                const SearchControl& control) {
    const std::size_t dimension = u.size();
    return run(local_optimizer(dimension, max_evaluations, tolerance), objective, std::move(u), control);
}

SearchResult search_space(std::span<SpaceLoss* const> stages, const SearchBudget& budget, const SearchControl& control,
                          const std::vector<std::vector<double>>& seeds, StepScan* scan) {
    SpaceLoss& quick = *stages.front();
    SpaceLoss& exact = *stages.back();
    const SearchSpace& space = quick.space();
    const std::size_t d = space.dimension();
    SearchResult result;
    if (d == 0) {
        exact.complete(result.best);
        result.record = {1, 1, 1, StopReason::converged, 0};
        result.minima.push_back(result.best);
        result.ends.push_back(result.best.loss2);
        return result;
    }

    std::vector<Minimum> ends;
    const auto descend_towards = [&](SpaceLoss& loss, const std::vector<std::vector<double>>& starts,
                                     const DescentGoal& goal) {
        const Landscape landscape = [&](auto at) { return loss.looks(at); };
        for (Minimum& end : descend_together(landscape, starts, goal, control)) ends.push_back(std::move(end));
        control.stepped();
        std::stable_sort(ends.begin(), ends.end(),
                         [](const Minimum& a, const Minimum& b) { return a.loss2 < b.loss2; });
    };
    const auto descend_from = [&](SpaceLoss& loss, const std::vector<std::vector<double>>& starts) {
        descend_towards(loss, starts, &loss == &exact ? kExactGoal : kQuickGoal);
    };
    const auto points = screening_points(space, budget.screened, control.seed);
    std::vector<std::vector<double>> starts =
        best_distinct(points, quick.screen_roughly(points, budget.starts, control), budget.starts);
    starts.insert(starts.end(), seeds.begin(), seeds.end());
    control.stepped();
    if (budget.global_evaluations > 0) {
        const Objective objective = [&](std::span<const double> u, std::span<double> g) { return quick(u, g); };
        starts.push_back(explore(objective, d, budget.global_evaluations, control).u);
    }
    std::size_t extra = 0;  // evaluations for milestones
    const auto pass = [&](LessWork milestone, const std::vector<std::vector<double>>& found) {
        if (!control.milestones || control.over()) return;
        std::size_t evaluations = 0;
        for (const SpaceLoss* stage : stages) evaluations += stage->evaluations();
        evaluations -= extra;
        const std::vector<double> values = exact.screen(found, control);
        result.record.milestones.push_back({milestone, *std::min_element(values.begin(), values.end()), evaluations});
        extra += found.size();
    };
    pass(LessWork::stop_after_screening, starts);
    descend_from(quick, starts);
    pass(LessWork::stop_after_descents, {ends.front().u});

    const auto blocks = space.blocks();
    std::size_t bases = blocks.size() > 1 ? budget.bases : 0;
    for (int round = 0; round < kExchangeRounds && bases > 0 && !control.over(); ++round) {
        const double before = ends.front().loss2;
        std::vector<std::vector<double>> next;
        std::uint64_t seed = control.seed + static_cast<std::uint64_t>(round);
        std::vector<Minimum> about = distinct_ends(ends, 0.05);
        about.resize(std::min(about.size(), bases));
        if (round == 0)
            for (const auto& block : blocks) {
                const auto spikes = space.spikes(about.front().u, block, kMostSpikes);
                for (auto& start : best_distinct(spikes, quick.screen(spikes, control), budget.exchange_starts))
                    next.push_back(std::move(start));
            }
        for (const Minimum& base : about)
            for (const auto& block : blocks) {
                const auto fresh = exchanged_points(space, base.u, block, budget.exchanged, ++seed);
                const auto values = quick.screen_roughly(fresh, budget.exchange_starts, control);
                for (auto& start : best_distinct(fresh, values, budget.exchange_starts))
                    next.push_back(std::move(start));
            }
        descend_from(quick, next);
        if (!(ends.front().loss2 < before * (1 - 5e-4))) break;
        bases = 1;
    }
    for (int round = 0; scan != nullptr && round < kStepRounds && bases > 0 && !control.over(); ++round) {
        const double before = ends.front().loss2;
        std::vector<Minimum> about = distinct_ends(ends, 0.05);
        about.resize(std::min<std::size_t>(about.size(), round == 0 ? kStepBases : 1));
        std::vector<std::vector<double>> next;
        for (const Minimum& base : about)
            for (auto& start : quick.steps(*scan, base, kStepPromise * before, kMostSteps, control))
                next.push_back(std::move(start));
        if (next.empty()) break;
        descend_towards(quick, next, kStepGoal);
        if (!(ends.front().loss2 < before * (1 - kStepGain))) break;
    }
    if (blocks.size() > 1 && budget.bases > 0) pass(LessWork::stop_after_exchange, {ends.front().u});

    result.minima = distinct_ends(ends, 1e-2);
    const std::vector<Minimum> searched = ends;
    std::size_t samples = quick.samples();
    for (const Minimum& end : searched) result.ends.push_back(end.loss2);
    for (SpaceLoss* const stage : stages.last(std::max<std::size_t>(1, stages.size() - 1))) {
        const Polish polish = stage->samples() == samples ? kSameSamples : kOtherSamples;
        samples = stage->samples();
        const std::vector<Minimum> best = distinct_ends(ends, 1e-2);
        std::vector<std::vector<double>> from;
        for (const Minimum& end : best)
            if (from.empty() || (from.size() < polish.most && end.loss2 <= polish.within * best.front().loss2))
                from.push_back(end.u);
        ends.clear();
        descend_from(*stage, from);
    }
    // Not of squares that are small: NLopt may know better. Those that touch a robust loss know its slope.
    if (space.unknowns() == Unknowns::all && !exact.robust() && !control.over()) {
        const Objective objective = [&](std::span<const double> u, std::span<double> g) { return exact(u, g); };
        for (const Minimum& end : std::vector<Minimum>(ends))
            ends.push_back(descend(objective, end.u, kFurtherEvaluations, 1e-13, control));
        std::stable_sort(ends.begin(), ends.end(),
                         [](const Minimum& a, const Minimum& b) { return a.loss2 < b.loss2; });
    }
    result.best = ends.front();
    if (!seeds.empty()) {  // which a coarse stage may have passed over
        const std::vector<double> values = exact.screen(seeds, control);
        const auto least = std::min_element(values.begin(), values.end());
        if (*least < result.best.loss2) {
            ends.clear();
            descend_from(exact, {seeds[static_cast<std::size_t>(least - values.begin())]});
            result.best = ends.front();
        }
    }
    // Of what a thinner or coarser loss has found only its own losses are known.
    const double agreed = std::sqrt(searched.front().loss2) * 1.001 + 1e-6;
    result.record.starts = searched.size();
    result.record.agreed = static_cast<std::size_t>(std::count_if(
        searched.begin(), searched.end(), [&](const Minimum& m) { return std::sqrt(m.loss2) <= agreed; }));
    for (const SpaceLoss* stage : stages) result.record.evaluations += stage->evaluations();
    result.record.evaluations -= extra;
    result.record.stop_reason = result.best.stop;
    exact.complete(result.best);
    return result;
}

}  // namespace brdfit::optim
