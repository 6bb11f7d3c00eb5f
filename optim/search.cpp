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
#include "optim/space_loss.h"

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

/// Places of values, the least first.
std::vector<std::size_t> ranked(const std::vector<double>& values) {
    std::vector<std::size_t> order(values.size());
    std::iota(order.begin(), order.end(), std::size_t{0});
    std::stable_sort(order.begin(), order.end(), [&](std::size_t a, std::size_t b) { return values[a] < values[b]; });
    return order;
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
/// Rounds of exchanges, while each gains this part of loss^2.
constexpr int kExchangeRounds = 4;
constexpr double kExchangeGain = 5e-4;
/// A term without which loss^2 is no more than so many times the best fits little but noise, and there are many ways to
/// do so: so many more points are screened with its strength freed, and so many of them descend.
constexpr double kWeak = 4;
constexpr std::size_t kWeakScreened = 192;
constexpr std::size_t kWeakStarts = 16;
/// Of a term with a strength other shapes are tried about the best end: so many on a line, and descents from so many of
/// them, so far from each other.
constexpr std::size_t kShapes = 24;
constexpr std::size_t kShapeStarts = 3;
constexpr double kShapesApart = 0.15;
/// Critical angles at which a real index is tried about a best end, and starts of each, where loss^2 with the strength
/// freed is up to so much of the best; of a weak term about so many ends, and in so many rounds while it gains.
constexpr std::size_t kMostCritical = 200;
constexpr std::size_t kCriticalStarts = 8;
constexpr double kCriticalPromise = 1.1;
constexpr std::size_t kWeakBases = 6;
constexpr int kWeakRounds = 3;
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
    std::vector<std::vector<double>> chosen;
    for (const std::size_t i : ranked(values)) {
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

Minimum descend(const Objective& objective, std::vector<double> u, int max_evaluations, double tolerance,
                const SearchControl& control) {
    const std::size_t dimension = u.size();
    return run(local_optimizer(dimension, max_evaluations, tolerance), objective, std::move(u), control);
}

namespace {

/// One search: each member is a step of it, in the order of run().
class Search {
public:
    Search(std::span<SpaceLoss* const> stages, const SearchBudget& budget, const SearchControl& control)
        : stages_(stages),
          quick_(*stages.front()),
          exact_(*stages.back()),
          space_(quick_.space()),
          blocks_(space_.blocks()),
          budget_(budget),
          control_(control) {}

    SearchResult run(const std::vector<std::vector<double>>& seeds, StepScan* scan) {
        if (space_.dimension() == 0) return only_point();
        descend_from_screened(seeds);
        if (blocks_.size() > 1 && budget_.bases > 0) {
            const bool weak = is_weak();
            if (weak) descend_freed();
            exchange();
            take_critical_indices(weak);
            if (scan != nullptr) take_steps(*scan);
            pass(LessWork::stop_after_exchange, {ends_.front().u});
        }
        keep_ends();
        polish();
        if (!seeds.empty()) hold_against(seeds);
        for (const SpaceLoss* stage : stages_) result_.record.evaluations += stage->evaluations();
        result_.record.evaluations -= extra_;
        result_.record.stop_reason = result_.best.stop;
        exact_.complete(result_.best);
        return std::move(result_);
    }

private:
    SearchResult only_point() {
        exact_.complete(result_.best);
        result_.record = {1, 1, 1, StopReason::converged, 0};
        result_.minima.push_back(result_.best);
        result_.ends.push_back(result_.best.loss2);
        return std::move(result_);
    }

    void sort_ends() {
        std::stable_sort(ends_.begin(), ends_.end(),
                         [](const Minimum& a, const Minimum& b) { return a.loss2 < b.loss2; });
    }
    void descend_towards(SpaceLoss& loss, const std::vector<std::vector<double>>& starts, const DescentGoal& goal) {
        const Landscape landscape = [&](auto at) { return loss.looks(at); };
        for (Minimum& end : descend_together(landscape, starts, goal, control_)) ends_.push_back(std::move(end));
        control_.stepped();
        sort_ends();
    }
    void descend_from(SpaceLoss& loss, const std::vector<std::vector<double>>& starts) {
        descend_towards(loss, starts, &loss == &exact_ ? kExactGoal : kQuickGoal);
    }

    /// Tells what less work would have found, if that is wanted.
    void pass(LessWork milestone, const std::vector<std::vector<double>>& found) {
        if (!control_.milestones || control_.over()) return;
        std::size_t evaluations = 0;
        for (const SpaceLoss* stage : stages_) evaluations += stage->evaluations();
        evaluations -= extra_;
        const std::vector<double> values = exact_.whole().screen(found, control_);
        result_.record.milestones.push_back({milestone, *std::min_element(values.begin(), values.end()), evaluations});
        extra_ += found.size();
    }

    void descend_from_screened(const std::vector<std::vector<double>>& seeds) {
        const auto points = screening_points(space_, budget_.screened, control_.seed);
        std::vector<std::vector<double>> starts =
            best_distinct(points, quick_.screen_roughly(points, budget_.starts, control_), budget_.starts);
        starts.insert(starts.end(), seeds.begin(), seeds.end());
        control_.stepped();
        if (budget_.global_evaluations > 0) {
            const Objective objective = [&](std::span<const double> u, std::span<double> g) { return quick_(u, g); };
            starts.push_back(explore(objective, space_.dimension(), budget_.global_evaluations, control_).u);
        }
        pass(LessWork::stop_after_screening, starts);
        descend_from(quick_, starts);
        pass(LessWork::stop_after_descents, {ends_.front().u});
    }

    static bool has(const std::vector<std::size_t>& block, std::size_t coordinate) {
        return std::find(block.begin(), block.end(), coordinate) != block.end();
    }

    /// Whether the term with a strength is little but noise.
    bool is_weak() {
        const std::optional<Strength> strength = space_.strength();
        if (!strength || control_.over()) return false;
        std::vector<double> without = ends_.front().u;
        without[strength->coordinate] = 0;
        return quick_.screen({without}, control_).front() < kWeak * ends_.front().loss2;
    }

    /// Points at random are best where such a term is next to nothing: its strength is chosen for each.
    void descend_freed() {
        auto points = screening_points(space_, kWeakScreened, control_.seed + 7);
        const std::vector<double> values = quick_.screen_freed_roughly(points, control_);
        descend_from(quick_, best_distinct(points, values, kWeakStarts));
    }

    /// Starts along the shapes of a term about a point, the strength chosen for each. Strength is only nearly the
    /// square of its coordinate, so it is chosen twice.
    std::vector<std::vector<double>> shapes(const std::vector<double>& about, const Strength& strength, int round) {
        std::vector<std::vector<double>> line(kShapes, about);
        const double gap = 1.0 / static_cast<double>(kShapes - 1);
        for (std::size_t i = 0; i < kShapes; ++i)
            line[i][strength.shape] = std::min(1.0, (static_cast<double>(i) + 0.5 * round) * gap);
        quick_.screen_freed_roughly(line, control_);
        quick_.screen_freed_roughly(line, control_);
        const std::vector<double> values = quick_.screen(line, control_);
        std::vector<std::vector<double>> chosen{about};
        for (const std::size_t i : ranked(values)) {
            const auto close = [&](const auto& u) {
                return std::abs(u[strength.shape] - line[i][strength.shape]) < kShapesApart;
            };
            if (chosen.size() > kShapeStarts) break;
            if (std::none_of(chosen.begin(), chosen.end(), close)) chosen.push_back(line[i]);
        }
        chosen.erase(chosen.begin());
        return chosen;
    }

    /// Other coordinates in one block of the best ends, in rounds while each gains.
    void exchange() {
        std::size_t bases = budget_.bases;
        for (int round = 0; round < kExchangeRounds && !control_.over(); ++round) {
            const double before = ends_.front().loss2;
            std::vector<Minimum> about = distinct_ends(ends_, 0.05);
            about.resize(std::min(about.size(), bases));
            std::vector<std::vector<double>> next;
            const auto add_best = [&](const std::vector<std::vector<double>>& points,
                                      const std::vector<double>& values) {
                for (auto& start : best_distinct(points, values, budget_.exchange_starts))
                    next.push_back(std::move(start));
            };
            if (round == 0)
                for (const auto& block : blocks_) {
                    const auto spikes = space_.spikes(about.front().u, block, kMostSpikes);
                    add_best(spikes, quick_.screen(spikes, control_));
                }
            std::uint64_t seed = control_.seed + static_cast<std::uint64_t>(round);
            for (const Minimum& base : about)
                for (const auto& block : blocks_) {
                    if (const auto strength = space_.strength(); strength && has(block, strength->shape)) {
                        for (auto& start : shapes(base.u, *strength, round)) next.push_back(std::move(start));
                        ++seed;
                        continue;
                    }
                    const auto fresh = exchanged_points(space_, base.u, block, budget_.exchanged, ++seed);
                    add_best(fresh, quick_.screen_roughly(fresh, budget_.exchange_starts, control_));
                }
            descend_from(quick_, next);
            if (!(ends_.front().loss2 < before * (1 - kExchangeGain))) break;
            bases = 1;
        }
    }

    /// The quick loss with these coordinates held, which must outlive it.
    Landscape with_held(const std::vector<std::size_t>& coordinates) {
        return [this, &coordinates](auto points) {
            std::vector<Look> seen = quick_.looks(points);
            for (Look& look : seen)
                for (const std::size_t j : coordinates) {
                    look.gradient[j] = 0;
                    for (std::size_t k = 0, d = look.gradient.size(); k < d; ++k)
                        look.curvature[j * d + k] = look.curvature[k * d + j] = 0;
                }
            return seen;
        };
    }

    /// A real index n < 1 reflects all light beyond its critical angle, so the loss has a kink, and may have a minimum,
    /// at every n that is the sine of a sample's angle: no slope leads from one to the other, and all are tried.
    void take_critical_indices(bool weak) {
        for (int round = 0; round < (weak ? kWeakRounds : 1) && !control_.over(); ++round) {
            const double before = ends_.front().loss2;
            std::vector<Minimum> about = distinct_ends(ends_, 0.05);
            about.resize(std::min<std::size_t>(about.size(), weak && round == 0 ? kWeakBases : 1));
            std::vector<std::vector<double>> next;
            for (const Minimum& base : about) {
                const Choices choices = space_.critical_indices(base.u, kMostCritical);
                if (choices.points.empty()) return;
                if (!weak && !may_be_critical(choices.points)) return;
                std::vector<std::vector<double>> chosen;
                const auto add_best = [&](const std::vector<double>& values) {
                    std::size_t count = 0;
                    for (const std::size_t i : ranked(values)) {
                        if (count++ == kCriticalStarts || !(values[i] < kCriticalPromise * before)) break;
                        if (std::find(chosen.begin(), chosen.end(), choices.points[i]) == chosen.end())
                            chosen.push_back(choices.points[i]);
                    }
                };
                auto freed = choices.points;
                add_best(quick_.screen_freed(freed, control_));
                if (weak) add_best(quick_.screen(choices.points, control_));
                // The other coordinates adapt before the index moves, which the kink would hold up.
                for (Minimum& end : descend_together(with_held(choices.coordinates), chosen, kStepGoal, control_))
                    next.push_back(std::move(end.u));
            }
            if (next.empty()) break;
            descend_towards(quick_, next, kStepGoal);
            if (!(ends_.front().loss2 < before * (1 - kStepGain))) break;
        }
    }

    /// Whether a few of the points, most of them with a small index, promise anything with their strength freed.
    bool may_be_critical(const std::vector<std::vector<double>>& points) {
        std::vector<std::vector<double>> few;
        for (std::size_t i = 1; i <= points.size(); i *= 2) few.push_back(points[i - 1]);
        const std::vector<double> values = quick_.screen_freed(few, control_);
        return *std::min_element(values.begin(), values.end()) < kCriticalPromise * ends_.front().loss2;
    }

    /// Starts about a minimum with a step in place of each lobe, where that promises loss^2 of up to `within`.
    std::vector<std::vector<double>> steps(StepScan& scan, const Minimum& about, double within) {
        // What is like a step, and has a height the space can tell from 0.
        constexpr std::array<double, 3> kDegrees{0.012, 0.03, 0.1};
        std::vector<std::vector<std::size_t>> lobes = blocks_;
        std::erase_if(lobes, [&](const auto& block) { return !space_.lobe(block); });
        if (lobes.empty()) return {};
        Minimum base = about;
        quick_.complete(base);
        const Candidate at = space_.candidate(base.u);
        const std::vector<double> values = quick_.terms(at);
        std::vector<std::vector<double>> starts;
        for (const auto& block : lobes) {
            const std::optional<std::size_t> term = space_.lobe(block);
            std::vector<LobeShape> shapes;
            for (const Step& step : scan.best(*term, {values, base.coefficients, at.lower, at.upper}, kMostSteps))
                for (const double degree : kDegrees)
                    if (step.loss2 <= within * quick_.scale2()) shapes.push_back({step.psi, degree});
            std::vector<std::vector<double>> points = space_.shaped(base.u, block, shapes);
            const std::vector<double> losses = quick_.screen(points, control_);
            std::vector<std::vector<double>> chosen;
            for (std::size_t i = 0; i < points.size(); i += kDegrees.size()) {
                const auto first = losses.begin() + static_cast<std::ptrdiff_t>(i);
                const auto least = std::min_element(first, first + static_cast<std::ptrdiff_t>(kDegrees.size()));
                chosen.push_back(std::move(points[static_cast<std::size_t>(least - losses.begin())]));
            }
            // The other terms adapt before the step's edge moves: a sample in its way would hold up all of them.
            for (Minimum& end : descend_together(with_held(block), chosen, kStepGoal, control_))
                starts.push_back(std::move(end.u));
        }
        return starts;
    }

    void take_steps(StepScan& scan) {
        for (int round = 0; round < kStepRounds && !control_.over(); ++round) {
            const double before = ends_.front().loss2;
            std::vector<Minimum> about = distinct_ends(ends_, 0.05);
            about.resize(std::min<std::size_t>(about.size(), round == 0 ? kStepBases : 1));
            std::vector<std::vector<double>> next;
            for (const Minimum& base : about)
                for (auto& start : steps(scan, base, kStepPromise * before)) next.push_back(std::move(start));
            if (next.empty()) break;
            descend_towards(quick_, next, kStepGoal);
            if (!(ends_.front().loss2 < before * (1 - kStepGain))) break;
        }
    }

    /// What the first stage has found: of what a thinner or coarser loss has found only its own losses are known.
    void keep_ends() {
        result_.minima = distinct_ends(ends_, 1e-2);
        for (const Minimum& end : ends_) result_.ends.push_back(end.loss2);
        const double agreed = std::sqrt(result_.ends.front()) * 1.001 + 1e-6;
        result_.record.starts = result_.ends.size();
        result_.record.agreed = static_cast<std::size_t>(std::count_if(
            result_.ends.begin(), result_.ends.end(), [&](double loss2) { return std::sqrt(loss2) <= agreed; }));
    }

    /// On through the further stages, from the best ends of the one before.
    void polish() {
        for (SpaceLoss* const stage : stages_.last(std::max<std::size_t>(1, stages_.size() - 1))) {
            // Others will judge where the last stage sees a part of the samples.
            const Polish polish = exact_.whole().samples() == stage->samples() ? kSameSamples : kOtherSamples;
            const std::vector<Minimum> best = distinct_ends(ends_, 1e-2);
            std::vector<std::vector<double>> from;
            for (const Minimum& end : best)
                if (from.empty() || (from.size() < polish.most && end.loss2 <= polish.within * best.front().loss2))
                    from.push_back(end.u);
            ends_.clear();
            descend_from(*stage, from);
        }
        // Not of squares that are small: NLopt may know better. Those that touch a robust loss know its slope.
        if (space_.unknowns() == Unknowns::all && !exact_.robust() && !control_.over()) {
            const Objective objective = [&](std::span<const double> u, std::span<double> g) { return exact_(u, g); };
            for (const Minimum& end : std::vector<Minimum>(ends_))
                ends_.push_back(descend(objective, end.u, kFurtherEvaluations, 1e-13, control_));
            sort_ends();
        }
        result_.best = ends_.front();
        result_.last = ends_;
    }

    /// Seeds, which a coarse stage may have passed over.
    void hold_against(const std::vector<std::vector<double>>& seeds) {
        const std::vector<double> values = exact_.screen(seeds, control_);
        const auto least = std::min_element(values.begin(), values.end());
        if (!(*least < result_.best.loss2)) return;
        ends_.clear();
        descend_from(exact_, {seeds[static_cast<std::size_t>(least - values.begin())]});
        result_.best = ends_.front();
        result_.last.insert(result_.last.begin(), result_.best);
    }

    std::span<SpaceLoss* const> stages_;
    SpaceLoss& quick_;
    SpaceLoss& exact_;
    const SearchSpace& space_;
    std::vector<std::vector<std::size_t>> blocks_;
    const SearchBudget& budget_;
    const SearchControl& control_;
    std::vector<Minimum> ends_;  ///< of descents, best first
    std::size_t extra_ = 0;      ///< evaluations for milestones
    SearchResult result_;
};

}  // namespace

SearchResult search_space(std::span<SpaceLoss* const> stages, const SearchBudget& budget, const SearchControl& control,
                          const std::vector<std::vector<double>>& seeds, StepScan* scan) {
    return Search(stages, budget, control).run(seeds, scan);
}

}  // namespace brdfit::optim
