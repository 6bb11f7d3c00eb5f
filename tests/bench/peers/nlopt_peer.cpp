/// NLopt on the scalar loss in all parameters: a global method, then SLSQP. One run of the global method is one
/// attempt.
///   mlsl  G_MLSL with SLSQP inside: runs until the target or the clock
///   crs2  GN_CRS2_LM until its population has shrunk, then LD_SLSQP from its end
#include <nlopt.h>

#include <memory>
#include <utility>

#include "tests/bench/peers/peer.h"

namespace brdfit::peers {
namespace {

constexpr double kMargin = 5e-4;  // a run goes on until the target is passed by half its tolerance

template <typename Model>
class Run {
public:
    explicit Run(const Problem<Model>& problem, double seconds) : problem_(problem), seconds_(seconds) {}

    /// The target is known to the bench alone: an attempt that is cut there counts with its whole budget.
    void stop_at_target(double target) { target_ = target * (1 - kMargin); }

    Attempt global_then_local(std::uint64_t seed) {
        nlopt_srand(static_cast<unsigned long>(seed));
        std::mt19937_64 random(seed);
        u_ = problem_.draw(random);
        const bool mlsl = problem_.task.method == "mlsl";
        const Optimizer global = make(mlsl ? NLOPT_G_MLSL : NLOPT_GN_CRS2_LM);
        const Optimizer local = make(NLOPT_LD_SLSQP);
        nlopt_set_ftol_rel(local.get(), 1e-8);
        nlopt_set_xtol_rel(local.get(), 1e-8);
        nlopt_set_maxeval(local.get(), 500);
        if (mlsl) {
            nlopt_set_local_optimizer(global.get(), local.get());
        } else {
            nlopt_set_ftol_rel(global.get(), 1e-4);
            nlopt_set_xtol_rel(global.get(), 1e-4);
            nlopt_set_maxeval(global.get(), 100000);
        }
        for (const Optimizer* step : {&global, &local}) {
            active_ = step->get();
            double value = 0;
            nlopt_optimize(active_, u_.data(), &value);
            u_ = best_;
            if (attempt_.cut || mlsl) break;
        }
        attempt_.cpu = watch_.cpu();
        attempt_.wall = watch_.wall();
        return std::move(attempt_);
    }

private:
    using Optimizer = std::unique_ptr<nlopt_opt_s, decltype(&nlopt_destroy)>;

    Optimizer make(nlopt_algorithm algorithm) {
        Optimizer optimizer(nlopt_create(algorithm, Problem<Model>::kUnknowns), nlopt_destroy);
        nlopt_set_lower_bounds(optimizer.get(), problem_.low.data());
        nlopt_set_upper_bounds(optimizer.get(), problem_.high.data());
        nlopt_set_min_objective(optimizer.get(), &Run::objective, this);
        return optimizer;
    }

    static double objective(unsigned /*count*/, const double* u, double* gradient, void* run) {
        return static_cast<Run*>(run)->evaluate(u, gradient);
    }

    double evaluate(const double* u, double* gradient) {
        const double square = gradient ? problem_.square_loss(u, gradient) : problem_.square_loss(u);
        if (!std::isfinite(square)) return 1e300;
        if (square < least_) {
            least_ = square;
            std::copy_n(u, best_.size(), best_.begin());
            const double loss = problem_.loss(square);
            if (loss <= 1.1 * problem_.task.target) attempt_.trace.push_back({watch_.cpu(), loss});
            if (loss <= target_) stop();
        }
        if (++evaluations_ % 64 == 0 && watch_.cpu() > seconds_) stop();
        return square;
    }

    void stop() {
        attempt_.cut = true;
        nlopt_force_stop(active_);
    }

    const Problem<Model>& problem_;
    double seconds_;
    double target_ = 0;
    nlopt_opt active_ = nullptr;
    typename Problem<Model>::Point u_{}, best_{};
    double least_ = std::numeric_limits<double>::infinity();
    long evaluations_ = 0;
    Attempt attempt_;
    Stopwatch watch_;
};

template <typename Model>
void search(const Problem<Model>& problem) {
    const Stopwatch all;
    for (int found = 0, run = 0; found < problem.task.enough && all.cpu() < problem.task.seconds; ++run) {
        Run<Model> attempt(problem, problem.task.seconds - all.cpu());
        if (problem.task.method == "mlsl") attempt.stop_at_target(problem.task.target);
        const Attempt result = attempt.global_then_local(problem.task.seed + static_cast<std::uint64_t>(run));
        print(result);
        found += !result.trace.empty() && result.trace.back().loss <= problem.task.target;
    }
}

}  // namespace
}  // namespace brdfit::peers

int main(int count, char** arguments) {
    return brdfit::peers::run_peer(count, arguments, [](const auto& problem) { brdfit::peers::search(problem); });
}
