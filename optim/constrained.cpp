#include "optim/constrained.h"

#include <algorithm>
#include <cmath>
#include <exception>
#include <limits>
#include <memory>
#include <set>

#include <nlopt.h>

#include "kernels/evaluator.h"
#include "kernels/hemisphere.h"
#include "optim/physics.h"
#include "optim/space.h"
#include "optim/space_loss.h"

namespace brdfit::optim {
namespace {

using kernels::Albedo;
using kernels::Hemisphere;

/// Of the quadrature where albedos are differentiated.
constexpr double kFine = 1e-6;
/// Of the cube, for differences of albedos.
constexpr double kStep = 1e-4;
/// What the constraint stays below 1 by, so that the judge's quadrature finds it met.
constexpr double kMargin = 0.2 * kAlbedoTolerance;
/// What SLSQP may be above that.
constexpr double kSlack = 0.1 * kAlbedoTolerance;
constexpr int kMostEvaluations = 300;
constexpr int kMostRounds = 8;
constexpr std::size_t kScreened = 256;
constexpr std::size_t kFirstAngles = 4;
/// A start agrees with the best within this part of its loss.
constexpr double kAgrees = 1e-3;

struct NloptDelete {
    void operator()(nlopt_opt opt) const { nlopt_destroy(opt); }
};
using Nlopt = std::unique_ptr<std::remove_pointer_t<nlopt_opt>, NloptDelete>;

/// Starts beside the unconstrained optimum and that of smaller height.
std::size_t further_starts(Effort effort) { return effort == Effort::draft ? 1 : effort == Effort::standard ? 4 : 16; }

/// Size of the data as coefficients have it.
double level_of(const Task& task) {
    double sum = 0;
    for (const Sample& sample : task.channel.samples) sum += std::abs(sample.brdf);
    const double mean = sum / static_cast<double>(task.channel.samples.size());
    const double level = 0.1 * mean / std::sqrt(task.scale.min * task.scale.max);
    return level > 0 ? level : 1;
}

/// The loss and the albedos at a point of the cube.
class Problem {
public:
    Problem(const Task& task, const std::vector<Interval>& bounds)
        : precision_(task.engine.best_precision()),
          scale2_(task.weighted.norm > 0 ? task.weighted.norm * task.weighted.norm : 1),
          space_(task.model, bounds, Unknowns::all, task.scale, level_of(task), Charts::passed_over, &task.directions),
          evaluator_(task.engine, task.model, precision_, task.directions, task.weighted.y, task.weighted.weight),
          loss_(evaluator_, space_, task.weighted.logarithmic ? 1 : scale2_, &task.weighted),
          hemisphere_(task.engine, task.model, precision_) {}

    [[nodiscard]] const SearchSpace& space() const { return space_; }
    [[nodiscard]] SpaceLoss& loss() { return loss_; }
    [[nodiscard]] std::vector<double> parameters(std::span<const double> u, double& scale) const {
        return space_.parameters(u, space_.candidate(u).lower, scale);
    }
    /// Albedos at u and these angles.
    std::vector<double> albedos(std::span<const double> u, std::span<const double> angles_deg) {
        double scale = 1;
        std::vector<double> values;
        for (const Albedo& albedo : hemisphere_.albedo(parameters(u, scale), angles_deg, kFine))
            values.push_back(std::min(albedo.value, 1e6));  // a number, whatever saturates
        return values;
    }
    LargestAlbedo largest(std::span<const double> u, const Incidence& incidence) {
        double scale = 1;
        return largest_albedo(hemisphere_, parameters(u, scale), incidence);
    }

private:
    kernels::Precision precision_;
    double scale2_;
    SearchSpace space_;
    kernels::Evaluator evaluator_;
    SpaceLoss loss_;
    Hemisphere hemisphere_;
};

/// One descent by SLSQP, and the best point met that keeps to the constraint. NLopt turns foreign exceptions into a
/// bare failure, and SLSQP can spin for ever on a NaN: both end the descent here.
class Descent {
public:
    Descent(Problem& problem, std::span<const double> angles_deg, const SearchControl& control)
        : problem_(problem), angles_(angles_deg), control_(control) {}

    /// Nothing is found where best() is infinite.
    void run(std::vector<double> u) {
        const auto d = static_cast<unsigned>(u.size());
        opt_.reset(nlopt_create(NLOPT_LD_SLSQP, d));
        nlopt_set_lower_bounds1(opt_.get(), 0.0);
        nlopt_set_upper_bounds1(opt_.get(), 1.0);
        nlopt_set_maxeval(opt_.get(), kMostEvaluations);
        nlopt_set_ftol_rel(opt_.get(), 1e-10);
        nlopt_set_xtol_rel(opt_.get(), 1e-9);
        nlopt_set_min_objective(
            opt_.get(),
            [](unsigned n, const double* at, double* gradient, void* self) {
                return static_cast<Descent*>(self)->objective({at, n}, {gradient, gradient != nullptr ? n : 0});
            },
            this);
        const std::vector<double> slack(angles_.size(), kSlack);
        nlopt_add_inequality_mconstraint(
            opt_.get(), static_cast<unsigned>(angles_.size()),
            [](unsigned m, double* result, unsigned n, const double* at, double* gradient, void* self) {
                static_cast<Descent*>(self)->constraint({at, n}, {result, m},
                                                        {gradient, gradient != nullptr ? std::size_t{m} * n : 0});
            },
            this, slack.data());
        double value = 0;
        const nlopt_result result = nlopt_optimize(opt_.get(), u.data(), &value);
        if (error_) std::rethrow_exception(error_);
        stop_ = control_.stop.stop_requested()    ? StopReason::cancelled
                : control_.over()                 ? StopReason::time_limit
                : result == NLOPT_MAXEVAL_REACHED ? StopReason::evaluation_limit
                : result > 0 && !lost_            ? StopReason::converged
                                                  : StopReason::roundoff;
    }

    [[nodiscard]] double best() const { return best_; }
    [[nodiscard]] const std::vector<double>& best_u() const { return best_u_; }
    [[nodiscard]] StopReason stop() const { return stop_; }

private:
    /// False where there is no number to ask for, or no time.
    bool goes_on(std::span<const double> u) {
        if (error_ || lost_) return false;
        lost_ = !std::all_of(u.begin(), u.end(), [](double x) { return std::isfinite(x); });
        if (!lost_ && !control_.over()) return true;
        nlopt_force_stop(opt_.get());
        return false;
    }

    double objective(std::span<const double> u, std::span<double> gradient) {
        std::fill(gradient.begin(), gradient.end(), 0.0);
        if (!goes_on(u)) return std::numeric_limits<double>::max();
        try {
            value_ = problem_.loss()(u, gradient);
            at_.assign(u.begin(), u.end());
            lost_ = !std::isfinite(value_) ||
                    !std::all_of(gradient.begin(), gradient.end(), [](double x) { return std::isfinite(x); });
            if (!lost_) return value_;
        } catch (...) {
            error_ = std::current_exception();
        }
        nlopt_force_stop(opt_.get());
        std::fill(gradient.begin(), gradient.end(), 0.0);
        return std::numeric_limits<double>::max();
    }

    void constraint(std::span<const double> u, std::span<double> result, std::span<double> gradient) {
        std::fill(result.begin(), result.end(), 1.0);
        std::fill(gradient.begin(), gradient.end(), 0.0);
        if (!goes_on(u)) return;
        try {
            const std::vector<double> albedos = problem_.albedos(u, angles_);
            for (std::size_t i = 0; i < result.size(); ++i) result[i] = albedos[i] - (1 - kMargin);
            if (std::equal(u.begin(), u.end(), at_.begin(), at_.end()) && value_ < best_ &&
                std::all_of(result.begin(), result.end(), [](double x) { return x <= kSlack; })) {
                best_ = value_;
                best_u_ = at_;
            }
            if (gradient.empty()) return;
            std::vector<double> moved(u.begin(), u.end());
            for (std::size_t k = 0; k < u.size(); ++k) {
                const double step = u[k] < 0.5 ? kStep : -kStep;
                moved[k] = u[k] + step;
                const std::vector<double> there = problem_.albedos(moved, angles_);
                for (std::size_t i = 0; i < result.size(); ++i)
                    gradient[i * u.size() + k] = (there[i] - albedos[i]) / step;
                moved[k] = u[k];
            }
        } catch (...) {
            error_ = std::current_exception();
            nlopt_force_stop(opt_.get());
        }
    }

    Problem& problem_;
    std::span<const double> angles_;
    const SearchControl& control_;
    Nlopt opt_;
    std::vector<double> at_;  ///< where the objective was evaluated last, ...
    double value_ = 0;        ///< ... and its value
    double best_ = std::numeric_limits<double>::infinity();
    std::vector<double> best_u_;
    StopReason stop_ = StopReason::converged;
    bool lost_ = false;  ///< a point or a value that is no number
    std::exception_ptr error_;
};

/// The parameters with every term as much lower as a term can be: all albedos fall by the factor.
std::vector<double> lowered(const kernels::Model& model, std::vector<double> parameters, double factor) {
    for (const kernels::Term& term : model.terms) {
        if (term.factor) parameters[*term.factor] *= factor;
        else if (term.homogeneous) {
            const double part = std::pow(factor, 1 / std::max(parameters[term.homogeneous->degree], 1e-3));
            parameters[term.homogeneous->plane.first] *= part;
            parameters[term.homogeneous->plane.second] *= part;
        }
    }
    return parameters;
}

/// Of screened points the best that are distinct, by their loss and by how far they are above the constraint.
std::vector<std::vector<double>> screened(Problem& problem, const Task& task, std::span<const double> angles_deg) {
    const auto points = screening_points(problem.space(), kScreened, task.control.seed);
    const std::vector<double> losses = problem.loss().screen(points, task.control);
    const std::size_t wanted = further_starts(task.effort);
    std::vector<std::vector<double>> some = best_distinct(points, losses, 4 * wanted);
    std::vector<double> values;
    for (const std::vector<double>& u : some) {
        const std::vector<double> albedos = problem.albedos(u, angles_deg);
        const double above = std::max(0.0, *std::max_element(albedos.begin(), albedos.end()) - 1);
        values.push_back(problem.loss()(u, {}) + above);
    }
    return best_distinct(some, values, wanted);
}

/// At most so many of the angles where the albedo is above 1: the highest, and others evenly.
std::vector<double> first_angles(Problem& problem, std::span<const double> u, const Incidence& incidence,
                                 const LargestAlbedo& largest) {
    const std::vector<double>& grid = incidence.grid_deg;
    const std::vector<double> albedos = problem.albedos(u, grid);
    std::vector<double> above;
    for (std::size_t i = 0; i < grid.size(); ++i)
        if (albedos[i] > 1) above.push_back(grid[i]);
    std::set<double> angles{largest.theta_i_deg};
    for (std::size_t i = 0; i < kFirstAngles && !above.empty(); ++i)
        angles.insert(above[i * (above.size() - 1) / (kFirstAngles - 1)]);
    return {angles.begin(), angles.end()};
}

}  // namespace

Optimum energy_conserving_optimum(const Task& task, const std::vector<Interval>& bounds, const Optimum& found,
                                  const Incidence& incidence) {
    Problem problem(task, bounds);
    if (problem.space().dimension() == 0) throw SearchError("every parameter is fixed, and energy is not conserved");
    const std::vector<double> from = problem.space().coordinates(found.parameters, found.scale);
    LargestAlbedo largest = problem.largest(from, incidence);
    std::vector<double> angles = first_angles(problem, from, incidence, largest);
    std::vector<std::vector<double>> starts{from};
    if (std::isfinite(largest.albedo.value))
        starts.push_back(problem.space().coordinates(
            lowered(task.model, found.parameters, (1 - kMargin) / largest.albedo.value), found.scale));
    for (auto& u : screened(problem, task, angles)) starts.push_back(std::move(u));

    Optimum optimum{{}, &task.model, std::numeric_limits<double>::infinity(), found.record, {}, {}};
    optimum.record.starts = starts.size();
    for (int round = 0; round < kMostRounds; ++round) {
        std::vector<double> values;
        std::vector<double> best_u;
        optimum.relative_loss2 = std::numeric_limits<double>::infinity();
        for (const std::vector<double>& start : starts) {
            Descent descent(problem, angles, task.control);
            descent.run(start);
            values.push_back(descent.best());
            if (!(descent.best() < optimum.relative_loss2)) continue;
            optimum.relative_loss2 = descent.best();
            optimum.record.stop_reason = descent.stop();
            best_u = descent.best_u();
        }
        if (best_u.empty())
            throw SearchError(task.control.over() ? "the time ran out before energy was conserved"
                                                  : "no parameters were found that conserve energy");
        if (round == 0)
            optimum.record.agreed =
                static_cast<std::size_t>(std::count_if(values.begin(), values.end(), [&](double value) {
                    return std::sqrt(value) <= std::sqrt(optimum.relative_loss2) * (1 + kAgrees) + 1e-12;
                }));
        largest = problem.largest(best_u, incidence);
        if (largest.albedo.value + largest.albedo.error <= 1 + kAlbedoTolerance / 2) {
            optimum.parameters = problem.parameters(best_u, optimum.scale);
            optimum.record.evaluations += problem.loss().evaluations();
            return optimum;
        }
        angles.push_back(largest.theta_i_deg);
        starts = {best_u, problem.space().coordinates(lowered(task.model, problem.parameters(best_u, optimum.scale),
                                                              (1 - kMargin) / largest.albedo.value),
                                                      optimum.scale)};
    }
    throw SearchError("no parameters were found that conserve energy at every angle");
}

}  // namespace brdfit::optim
