/// What the peers written in C++ share: their arguments, the measurement, the clock and the values they are checked by.
#pragma once

#include <ceres/jet.h>

#include <array>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <ctime>
#include <fstream>
#include <iomanip>
#include <iostream>
#include <random>
#include <sstream>
#include <stdexcept>
#include <string>
#include <string_view>
#include <vector>

#include "tests/bench/peers/models.h"

namespace brdfit::peers {

struct Bounds {
    double low = 0, high = 0;  ///< of the natural parameter
};

struct Task {
    std::string method;  ///< `values` or one of the program's own
    std::string model;
    Series series = Series::textbook;
    std::vector<Bounds> bounds;
    std::vector<Sample> samples;
    double size = 0;  ///< root of the weighted mean of y^2, [1/sr]: a loss in the file's unit is size sqrt(q)
    std::uint64_t seed = 0;
    double seconds = 0;  ///< of processor time; an attempt begun is finished
    double target = 0;   ///< loss, [1/sr], that counts as found
    int enough = 0;      ///< attempts that found it after which the program ends
};

/// Processor and wall time since its making, [s].
class Stopwatch {
public:
    double cpu() const { return static_cast<double>(std::clock() - cpu_) / CLOCKS_PER_SEC; }
    double wall() const { return std::chrono::duration<double>(std::chrono::steady_clock::now() - wall_).count(); }

private:
    std::clock_t cpu_ = std::clock();
    std::chrono::steady_clock::time_point wall_ = std::chrono::steady_clock::now();
};

/// One attempt: the losses it stood at and when, [s] of processor time from its beginning.
struct Attempt {
    struct Event {
        double cpu = 0, loss = 0;
    };
    std::vector<Event> trace;
    double cpu = 0, wall = 0;
    bool cut = false;  ///< ended by the target or by the clock, not by itself
};

inline void print(const Attempt& attempt) {
    std::cout << std::setprecision(17) << R"({"trace": [)";
    const char* separator = "";
    for (const Attempt::Event& event : attempt.trace) {
        if (!std::isfinite(event.loss)) continue;
        std::cout << separator << '[' << event.cpu << ", " << event.loss << ']';
        separator = ", ";
    }
    std::cout << R"(], "cpu": )" << attempt.cpu << R"(, "wall": )" << attempt.wall << R"(, "cut": )"
              << (attempt.cut ? "true" : "false") << "}\n"
              << std::flush;
}

/// theta_i, theta_r (signed), phi in degrees and the BRDF, a line each.
inline void read_samples(const std::string& path, Task& task) {
    std::ifstream file(path);
    double theta_i = 0, theta_r = 0, phi = 0, y = 0;
    double weights = 0, squares = 0;
    while (file >> theta_i >> theta_r >> phi >> y) {
        constexpr double kRadian = std::numbers::pi / 180;
        const double ti = theta_i * kRadian, tr = theta_r * kRadian;
        const std::array u{-std::sin(ti), 0.0, std::cos(ti)};
        const std::array v{std::sin(tr) * std::cos(phi * kRadian), std::sin(tr) * std::sin(phi * kRadian),
                           std::cos(tr)};
        const std::array sum{u[0] + v[0], u[1] + v[1], u[2] + v[2]};
        Sample s;
        s.ci = u[2];
        s.cr = v[2];
        s.tan_i = std::abs(std::tan(ti));
        s.tan_r = std::abs(std::tan(tr));
        s.cos_alpha = -u[0] * v[0] + u[2] * v[2];
        s.hxy = u[0] * v[0] + u[1] * v[1];
        s.hz = u[2] * v[2];
        s.w = sum[0] * sum[0] + sum[1] * sum[1];
        s.cs = sum[2];
        s.cd2 = std::min((s.w + sum[2] * sum[2]) / 4, 1.0);
        s.y = y;
        s.weight = s.cr;
        weights += s.weight;
        squares += s.weight * y * y;
        task.samples.push_back(s);
    }
    if (task.samples.empty() || squares <= 0) throw std::runtime_error("no measurement in " + path);
    task.size = std::sqrt(squares / weights);
    for (Sample& s : task.samples) s.weight /= squares;
}

/// METHOD MODEL SERIES LOW:HIGH,... SAMPLES SEED SECONDS TARGET ENOUGH
inline Task task_of(int count, char** arguments) {
    const std::vector<std::string> words(arguments + 1, arguments + count);
    if (words.size() != 9)
        throw std::runtime_error("METHOD MODEL SERIES LOW:HIGH,... SAMPLES SEED SECONDS TARGET ENOUGH");
    Task task;
    task.method = words[0];
    task.model = words[1];
    task.series = words[2] == "window" ? Series::window : Series::textbook;
    std::istringstream bounds(words[3]);
    for (std::string pair; std::getline(bounds, pair, ',');) {
        const std::size_t colon = pair.find(':');
        task.bounds.push_back({std::stod(pair.substr(0, colon)), std::stod(pair.substr(colon + 1))});
    }
    read_samples(words[4], task);
    task.seed = std::stoull(words[5]);
    task.seconds = std::stod(words[6]);
    task.target = std::stod(words[7]);
    task.enough = std::stoi(words[8]);
    return task;
}

/// A model on a task's samples, in the coordinates of a search.
template <typename Model>
struct Problem {
    static constexpr int kUnknowns = static_cast<int>(Model::kScales.size());
    using Dual = ceres::Jet<double, kUnknowns>;
    using Point = std::array<double, kUnknowns>;

    explicit Problem(const Task& the_task) : task(the_task) {
        if (task.bounds.size() != kUnknowns) throw std::runtime_error("wrong number of bounds");
        for (std::size_t i = 0; i < kUnknowns; ++i) {
            low[i] = Model::kScales[i].coordinate(task.bounds[i].low);
            high[i] = Model::kScales[i].coordinate(task.bounds[i].high);
        }
    }

    template <typename T>
    std::array<T, kUnknowns> natural(const T* u) const {
        std::array<T, kUnknowns> p;
        for (std::size_t i = 0; i < kUnknowns; ++i) p[i] = Model::kScales[i].natural(u[i]);
        return p;
    }

    /// Weighted mean square over that of f = 0.
    double square_loss(const double* u) const {
        const auto p = natural(u);
        double sum = 0;
        for (const Sample& s : task.samples) {
            const double r = Model::value(p.data(), s, task.series) - s.y;
            sum += s.weight * r * r;
        }
        return sum;
    }
    /// The same, and its gradient.
    double square_loss(const double* u, double* gradient) const {
        const auto p = natural(duals(u).data());
        Dual sum(0.0);
        for (const Sample& s : task.samples) {
            const Dual r = Model::value(p.data(), s, task.series) - s.y;
            sum.a += s.weight * r.a * r.a;
            sum.v += (2 * s.weight * r.a) * r.v;
        }
        for (int i = 0; i < kUnknowns; ++i) gradient[i] = sum.v[i];
        return sum.a;
    }
    double loss(double square) const { return task.size * std::sqrt(square); }

    static std::array<Dual, kUnknowns> duals(const double* u) {
        std::array<Dual, kUnknowns> x;
        for (int i = 0; i < kUnknowns; ++i) x[static_cast<std::size_t>(i)] = Dual(u[i], i);
        return x;
    }

    /// Uniform between the bounds.
    Point draw(std::mt19937_64& random) const {
        Point u;
        for (std::size_t i = 0; i < kUnknowns; ++i) u[i] = std::uniform_real_distribution(low[i], high[i])(random);
        return u;
    }

    const Task& task;
    Point low{}, high{};
};

/// For each line of parameters on standard input: the value and the slopes at each sample, a line each.
template <typename Model>
void print_values(const Problem<Model>& problem) {
    constexpr std::size_t kUnknowns = Model::kScales.size();
    std::array<double, kUnknowns> p{};
    std::cout << std::setprecision(17);
    const auto read = [&] {
        for (double& value : p)
            if (!(std::cin >> value)) return false;
        return true;
    };
    while (read()) {
        const auto x = Problem<Model>::duals(p.data());
        for (const Sample& s : problem.task.samples) {
            const auto f = Model::value(x.data(), s, problem.task.series);
            std::cout << Model::value(p.data(), s, problem.task.series);
            for (int i = 0; i < Problem<Model>::kUnknowns; ++i) std::cout << ' ' << f.v[i];
            std::cout << '\n';
        }
    }
}

/// Reads the task and gives its problem to `search`, or prints values. The program's exit status.
template <typename Search>
int run_peer(int count, char** arguments, Search search) {
    try {
        const Task task = task_of(count, arguments);
        const auto with = [&]<typename Model>(Model) {
            const Problem<Model> problem(task);
            if (task.method == "values") print_values(problem);
            else search(problem);
        };
        if (task.model == "phong") with(Phong{});
        else if (task.model == "ward") with(Ward{});
        else if (task.model == "lafortune") with(Lafortune{});
        else if (task.model == "he_torrance") with(HeTorrance{});
        else throw std::runtime_error("no model " + task.model);
        return 0;
    } catch (const std::exception& error) {
        std::cerr << error.what() << '\n';
        return 1;
    }
}

}  // namespace brdfit::peers
