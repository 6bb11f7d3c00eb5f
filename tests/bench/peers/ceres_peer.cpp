/// Ceres: Levenberg-Marquardt within bounds, automatic differentiation, from random starts. One start is one attempt.
#include <ceres/ceres.h>

#include "tests/bench/peers/peer.h"

namespace brdfit::peers {
namespace {

template <typename Model>
struct Residuals {
    template <typename T>
    bool operator()(const T* u, T* residuals) const {
        const auto p = problem.natural(u);
        for (const Sample& s : problem.task.samples)
            *residuals++ = std::sqrt(s.weight) * (Model::value(p.data(), s, problem.task.series) - s.y);
        return true;
    }
    const Problem<Model>& problem;
};

template <typename Model>
typename Problem<Model>::Point draw_start(const Problem<Model>& problem, std::mt19937_64& random) {
    return problem.draw(random);
}

/// Between the bounds most lobes are dark, or brighter by many decades than any surface: each lobe's coefficients are
/// scaled so that it peaks at between 1 % and all of the brightest sample.
Problem<Lafortune>::Point draw_start(const Problem<Lafortune>& problem, std::mt19937_64& random) {
    double brightest = 0;
    for (const Sample& s : problem.task.samples) brightest = std::max(brightest, s.y);
    for (;;) {
        Problem<Lafortune>::Point u = problem.draw(random);
        bool good = true;
        for (double* lobe : {u.data() + 1, u.data() + 4}) {
            double b = 0;
            for (const Sample& s : problem.task.samples) b = std::max(b, lobe[0] * s.hxy + lobe[1] * s.hz);
            const double peak = brightest * std::pow(10, std::uniform_real_distribution(-2.0, 0.0)(random));
            const double factor = std::pow(peak, std::exp(-lobe[2])) / b;
            lobe[0] *= factor;
            lobe[1] *= factor;
            for (const std::ptrdiff_t i : {0, 1}) {
                const auto at = static_cast<std::size_t>(lobe + i - u.data());
                good = good && lobe[i] >= problem.low[at] && lobe[i] <= problem.high[at];
            }
        }
        if (good) return u;
    }
}

template <typename Model>
void search(const Problem<Model>& problem) {
    constexpr int kUnknowns = Problem<Model>::kUnknowns;
    std::mt19937_64 random(problem.task.seed);
    ceres::Solver::Options options;
    options.linear_solver_type = ceres::DENSE_QR;
    options.max_num_iterations = 100;
    options.logging_type = ceres::SILENT;
    options.num_threads = 1;
    const Stopwatch all;
    for (int found = 0; found < problem.task.enough && all.cpu() < problem.task.seconds;) {
        const Stopwatch watch;
        auto u = draw_start(problem, random);
        ceres::Problem solve;
        solve.AddResidualBlock(new ceres::AutoDiffCostFunction<Residuals<Model>, ceres::DYNAMIC, kUnknowns>(
                                   new Residuals<Model>{problem}, static_cast<int>(problem.task.samples.size())),
                               nullptr, u.data());
        for (int i = 0; i < kUnknowns; ++i) {
            solve.SetParameterLowerBound(u.data(), i, problem.low[static_cast<std::size_t>(i)]);
            solve.SetParameterUpperBound(u.data(), i, problem.high[static_cast<std::size_t>(i)]);
        }
        ceres::Solver::Summary summary;
        ceres::Solve(options, &solve, &summary);
        Attempt attempt;
        attempt.cpu = watch.cpu();
        attempt.wall = watch.wall();
        const double loss = problem.loss(problem.square_loss(u.data()));
        attempt.trace = {{attempt.cpu, loss}};
        print(attempt);
        found += loss <= problem.task.target;
    }
}

}  // namespace
}  // namespace brdfit::peers

int main(int count, char** arguments) {
    google::InitGoogleLogging(arguments[0]);
    FLAGS_minloglevel = google::GLOG_FATAL;  // starts that fail are counted, not told
    return brdfit::peers::run_peer(count, arguments, [](const auto& problem) { brdfit::peers::search(problem); });
}
