// Batches on the device: the bounded least squares is optimal, and a candidate's result depends on nothing else.

#include "kernels/evaluator.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <future>
#include <limits>

#include "kernels/series.h"
#include "tests/support.h"

namespace brdfit::tests {
namespace {

using kernels::Batch;
using kernels::Direction;
using kernels::Evaluator;
using kernels::Model;
using kernels::Precision;

/// Weighted least squares within bounds by trying every active set, in long double.
struct BruteForce {
    std::vector<std::vector<long double>> phi;  // columns
    std::vector<double> y, w, lower, upper;

    [[nodiscard]] long double loss(const std::vector<long double>& c) const {
        long double sum = 0;
        for (std::size_t j = 0; j < y.size(); ++j) {
            long double r = -static_cast<long double>(y[j]);
            for (std::size_t t = 0; t < c.size(); ++t) r += c[t] * phi[t][j];
            sum += w[j] * r * r;
        }
        return sum;
    }

    [[nodiscard]] long double minimum() const {
        const std::size_t terms = phi.size();
        std::size_t sets = 1;
        for (std::size_t t = 0; t < terms; ++t) sets *= 3;
        long double best = std::numeric_limits<long double>::infinity();
        for (std::size_t set = 0; set < sets; ++set) {
            std::vector<long double> c(terms);
            std::vector<std::size_t> free;
            for (std::size_t t = 0, digits = set; t < terms; ++t, digits /= 3) {
                if (digits % 3 == 2) free.push_back(t);
                else c[t] = digits % 3 == 0 ? lower[t] : upper[t];
            }
            if (solve(c, free)) best = std::min(best, loss(c));
        }
        return best;
    }

private:
    /// Fills c at `free`; false if they are singular or out of bounds.
    bool solve(std::vector<long double>& c, const std::vector<std::size_t>& free) const {
        const std::size_t n = free.size();
        std::vector<std::vector<long double>> m(n, std::vector<long double>(n + 1));
        for (std::size_t a = 0; a < n; ++a)
            for (std::size_t j = 0; j < y.size(); ++j) {
                long double rest = y[j];
                for (std::size_t t = 0; t < c.size(); ++t)
                    if (std::find(free.begin(), free.end(), t) == free.end()) rest -= c[t] * phi[t][j];
                for (std::size_t b = 0; b < n; ++b) m[a][b] += w[j] * phi[free[a]][j] * phi[free[b]][j];
                m[a][n] += w[j] * phi[free[a]][j] * rest;
            }
        std::vector<long double> size(n);
        for (std::size_t a = 0; a < n; ++a) size[a] = m[a][a];
        for (std::size_t a = 0; a < n; ++a) {
            if (!(m[a][a] > 1e-15L * size[a])) return false;
            for (std::size_t b = a + 1; b < n; ++b) {
                const long double factor = m[b][a] / m[a][a];
                for (std::size_t k = a; k <= n; ++k) m[b][k] -= factor * m[a][k];
            }
        }
        for (std::size_t a = n; a-- > 0;) {
            for (std::size_t b = a + 1; b < n; ++b) m[a][n] -= m[a][b] * c[free[b]];
            c[free[a]] = m[a][n] / m[a][a];
            if (!(c[free[a]] >= lower[free[a]] && c[free[a]] <= upper[free[a]])) return false;
        }
        return true;
    }
};

std::vector<Direction> some_directions(Random& random, std::size_t count) {
    std::vector<Direction> directions;
    for (std::size_t i = 0; i < count; ++i)
        directions.push_back(
            {random.uniform(0, 80), random.uniform(-80, 80), i % 3 == 0 ? random.uniform(-90, 90) : 0.0});
    return directions;
}

/// Three lobes and a diffuse term: four columns, some of them equal, nearly equal or 0.
std::vector<double> random_lobes(Random& random) {
    std::vector<double> p{0};
    std::vector<double> lobe;
    for (int j = 0; j < 3; ++j) {
        if (lobe.empty() || random.chance(0.6))
            lobe = {random.uniform(-1, 1), random.uniform(-1, 1),
                    random.on_scale(kernels::Scale::logarithmic, 0.1, 100)};
        if (random.chance(0.2)) lobe[2] *= 1 + std::pow(10, random.uniform(-12, -1));  // nearly collinear
        if (random.chance(0.1)) lobe = {-1, -1, 5};                                    // dark everywhere
        p.insert(p.end(), lobe.begin(), lobe.end());
    }
    return p;
}

TEST(Project, IsTheMinimumWithinTheBounds) {
    const Model& model = variant("lafortune_3");
    Random random(1);
    std::size_t active = 0;
    for (int problem = 0; problem < 600; ++problem) {
        const std::vector<Direction> directions = some_directions(random, 30);
        BruteForce brute;
        for (std::size_t j = 0; j < directions.size(); ++j) {
            brute.y.push_back(random.uniform(-0.3, 1) * (problem % 2 == 0 ? 1 : 1e3));
            brute.w.push_back(random.chance(0.1) ? 0.0 : random.uniform(0.1, 1));
        }
        const std::vector<double> p = random_lobes(random);
        for (std::size_t t = 0; t < model.terms.size(); ++t) {
            brute.lower.push_back(random.chance(0.7) ? 0 : random.uniform(-1, 0.5));
            brute.upper.push_back(random.chance(0.2)   ? brute.lower[t]
                                  : random.chance(0.5) ? brute.lower[t] + random.uniform(0, 1)
                                                       : 1e100);
        }
        Evaluator evaluator(engine(), model, engine().best_precision(), directions, brute.y, brute.w);
        Batch batch;
        evaluator.project(p, brute.lower, brute.upper, true, batch);
        const std::vector<double> rows = evaluator.terms(p);
        const std::size_t n = directions.size();
        for (std::size_t t = 0, row = 0; t < model.terms.size(); row += 1 + model.terms[t].of.size(), ++t)
            brute.phi.emplace_back(rows.begin() + static_cast<std::ptrdiff_t>(row * n),
                                   rows.begin() + static_cast<std::ptrdiff_t>((row + 1) * n));
        std::vector<long double> c(batch.coefficients.begin(), batch.coefficients.end());
        for (std::size_t t = 0; t < c.size(); ++t) {
            ASSERT_GE(batch.coefficients[t], brute.lower[t]) << problem;
            ASSERT_LE(batch.coefficients[t], brute.upper[t]) << problem;
            if (batch.coefficients[t] == brute.lower[t] || batch.coefficients[t] == brute.upper[t]) ++active;
        }
        const auto best = static_cast<double>(brute.minimum());
        double scale = 0;
        for (std::size_t j = 0; j < n; ++j) scale += brute.w[j] * brute.y[j] * brute.y[j];
        EXPECT_LE(batch.loss[0], best + 1e-9 * scale) << "problem " << problem << ", p " << testing::PrintToString(p);
        EXPECT_NEAR(batch.loss[0], static_cast<double>(brute.loss(c)), 1e-12 * scale) << problem;
    }
    EXPECT_GT(active, 600U);
}

TEST(Project, LeavesNoSlopeByAFreeCoefficient) {
    const Model& model = variant("lafortune_2");
    Random random(2);
    const std::vector<Direction> directions = some_directions(random, 40);
    std::vector<double> y, w(directions.size(), 1.0);
    for (std::size_t j = 0; j < directions.size(); ++j) y.push_back(random.uniform(0, 1));
    Evaluator evaluator(engine(), model, engine().best_precision(), directions, y, w);
    for (int i = 0; i < 100; ++i) {
        std::vector<double> p = random_lobes(random);
        p.resize(7);
        Batch batch;
        evaluator.project(p, std::vector<double>(3, 0.0), std::vector<double>(3, 1.0), true, batch);
        for (std::size_t t = 0; t < 3; ++t) {
            const double c = batch.coefficients[t], slope = batch.by_coefficient[t];
            if (c <= 0) {
                EXPECT_GE(slope, -1e-6);
            } else if (c >= 1) {
                EXPECT_LE(slope, 1e-6);
            } else {
                EXPECT_NEAR(slope, 0, 1e-6);
            }
        }
        EXPECT_EQ(batch.by_parameter[0], 0);  // a linear parameter has no slope of its own
    }
}

class EveryEvaluator : public testing::TestWithParam<const Model*> {};
INSTANTIATE_TEST_SUITE_P(Models, EveryEvaluator, testing::ValuesIn(variants()),
                         [](const auto& parameter) { return label(*parameter.param); });

/// A batch of random candidates with everything the evaluator takes.
struct Inputs {
    std::vector<Direction> directions;
    std::vector<double> y, w, parameters, lower, upper;

    Inputs(const Model& model, std::size_t samples, std::size_t candidates, std::uint64_t seed) {
        Random random(seed);
        directions = some_directions(random, samples);
        for (std::size_t j = 0; j < samples; ++j) {
            y.push_back(random.uniform(0.1, 1));
            w.push_back(random.uniform(0.1, 1));
        }
        for (std::size_t i = 0; i < candidates; ++i) {
            std::vector<double> p = random.typical_parameters(model);
            for (const kernels::Term& term : model.terms)
                if (term.homogeneous)
                    for (const std::size_t k : {term.homogeneous->plane.first, term.homogeneous->plane.second})
                        p[k] /= 4;
            parameters.insert(parameters.end(), p.begin(), p.end());
        }
        lower.assign(candidates * model.terms.size(), 0.05);
        upper.assign(candidates * model.terms.size(), 1.0);
    }
};

void expect_same(const Batch& batch, std::size_t index, const Batch& single) {
    const auto slice = [&](const std::vector<double>& all, const std::vector<double>& one) {
        const auto begin = all.begin() + static_cast<std::ptrdiff_t>(index * one.size());
        EXPECT_TRUE(std::equal(one.begin(), one.end(), begin)) << "candidate " << index;
    };
    slice(batch.loss, single.loss);
    slice(batch.coefficients, single.coefficients);
    slice(batch.by_coefficient, single.by_coefficient);
    slice(batch.by_parameter, single.by_parameter);
}

TEST_P(EveryEvaluator, ABatchIsBitForBitItsCandidates) {
    const Model& model = *GetParam();
    const std::size_t p = model.parameters.size(), t = model.terms.size();
    const Inputs in(model, 37, 20, 3);
    Evaluator evaluator(engine(), model, engine().best_precision(), in.directions, in.y, in.w);
    Batch batch, values, losses, single;
    evaluator.project(in.parameters, in.lower, in.upper, true, batch);
    evaluator.project(in.parameters, in.lower, in.upper, false, values);
    evaluator.loss(in.parameters, in.upper, true, losses);
    const std::vector<double> rows = evaluator.terms(in.parameters);
    for (std::size_t i = 0; i < 20; ++i) {
        const auto one = [&](const std::vector<double>& all, std::size_t stride) {
            return std::span(all).subspan(i * stride, stride);
        };
        evaluator.project(one(in.parameters, p), one(in.lower, t), one(in.upper, t), true, single);
        expect_same(batch, i, single);
        EXPECT_EQ(values.loss[i], single.loss[0]);
        evaluator.loss(one(in.parameters, p), one(in.upper, t), true, single);
        expect_same(losses, i, single);
        const std::vector<double> row = evaluator.terms(one(in.parameters, p));
        EXPECT_TRUE(std::equal(row.begin(), row.end(), rows.begin() + static_cast<std::ptrdiff_t>(i * row.size())));
    }
}

TEST_P(EveryEvaluator, PaddingAndLanesDoNotShow) {
    const Model& model = *GetParam();
    for (std::size_t samples = 1; samples <= 19; ++samples) {
        const Inputs in(model, samples, 4, 4);
        Evaluator wide(engine(), model, engine().best_precision(), in.directions, in.y, in.w);
        Evaluator narrow(scalar_engine(), model, engine().best_precision(), in.directions, in.y, in.w);
        EXPECT_EQ(wide.samples(), samples);
        Batch a, b;
        wide.loss(in.parameters, in.upper, false, a);
        narrow.loss(in.parameters, in.upper, false, b);
        for (std::size_t i = 0; i < 4; ++i) EXPECT_NEAR(a.loss[i], b.loss[i], 1e-10 * b.loss[i]) << samples;
        for (std::size_t k = 0; k < a.by_parameter.size(); ++k)
            EXPECT_NEAR(a.by_parameter[k], b.by_parameter[k], 1e-9 * (std::abs(b.by_parameter[k]) + b.loss[0]))
                << samples;
        EXPECT_EQ(wide.terms(in.parameters).size(), 4 * samples * model.term_values());
    }
}

TEST_P(EveryEvaluator, LossIsTheSumOverTheTerms) {
    const Model& model = *GetParam();
    const std::size_t samples = 33, candidates = 5, p = model.parameters.size();
    const Inputs in(model, samples, candidates, 5);
    for (const bool logarithmic : {false, true}) {
        std::vector<double> y = in.y;
        if (logarithmic)
            for (double& value : y) value = std::log(value);
        Evaluator evaluator(engine(), model, engine().best_precision(), in.directions, y, in.w);
        Batch batch;
        evaluator.loss(in.parameters, in.upper, logarithmic, batch);
        const std::vector<double> rows = evaluator.terms(in.parameters);
        for (std::size_t i = 0; i < candidates; ++i) {
            const double* first = rows.data() + i * model.term_values() * samples;
            double loss = 0;
            std::vector<double> by_parameter(p), by_coefficient(model.terms.size());
            for (std::size_t j = 0; j < samples; ++j) {
                double f = 0;
                std::size_t row = 0;
                for (const kernels::Term& term : model.terms) {
                    f += first[row * samples + j];  // every coefficient is 1
                    row += 1 + term.of.size();
                }
                const double r = (logarithmic ? std::log(f) : f) - y[j];
                const double factor = 2 * in.w[j] * r / (logarithmic ? f : 1);
                loss += in.w[j] * r * r;
                row = 0;
                for (std::size_t t = 0; t < model.terms.size(); ++t) {
                    by_coefficient[t] += factor * first[row++ * samples + j];
                    for (const std::size_t k : model.terms[t].of)
                        by_parameter[k] += factor * first[row++ * samples + j];
                }
            }
            EXPECT_NEAR(batch.loss[i], loss, 1e-12 * loss);
            for (std::size_t k = 0; k < p; ++k)
                EXPECT_NEAR(batch.by_parameter[i * p + k], by_parameter[k], 1e-10 * (std::abs(by_parameter[k]) + loss))
                    << model.parameters[k].name;
            for (std::size_t t = 0; t < by_coefficient.size(); ++t)
                EXPECT_NEAR(batch.by_coefficient[i * by_coefficient.size() + t], by_coefficient[t],
                            1e-10 * (std::abs(by_coefficient[t]) + loss));
        }
    }
}

/// As far apart as two orders of the same sums may be.
void expect_near(const Batch& whole, const Batch& sliced, double relative, const std::string& what) {
    const auto near = [&](const std::vector<double>& a, const std::vector<double>& b, const char* of) {
        ASSERT_EQ(a.size(), b.size()) << what << of;
        const std::size_t stride = a.size() / whole.loss.size();
        for (std::size_t k = 0; k < a.size(); ++k) {
            double size = whole.loss[k / stride];  // of sums whose parts cancel
            for (std::size_t m = 0; m < stride; ++m) size = std::max(size, std::abs(a[k / stride * stride + m]));
            EXPECT_NEAR(a[k], b[k], relative * size) << what << of << " " << k;
        }
    };
    near(whole.loss, sliced.loss, " loss");
    near(whole.coefficients, sliced.coefficients, " coefficients");
    near(whole.by_coefficient, sliced.by_coefficient, " by coefficient");
    near(whole.by_parameter, sliced.by_parameter, " by parameter");
    near(whole.normal, sliced.normal, " normal");
}

TEST_P(EveryEvaluator, SlicesAddUpToTheWhole) {
    const Model& model = *GetParam();
    const Precision precision = engine().best_precision();
    const double relative = precision == Precision::double_precision ? 1e-9 : 1e-3;
    for (const std::size_t samples : {1U, 15U, 17U, 300U}) {
        const Inputs in(model, samples, 9, 7);
        Evaluator whole(engine(), model, precision, in.directions, in.y, in.w);
        Evaluator sliced(sliced_engine(), model, precision, in.directions, in.y, in.w);
        const std::string what = std::to_string(samples) + " samples";
        Batch a, b, again;
        if (samples > 2 * (model.parameters.size() + model.terms.size())) {  // else coefficients are not determined
            whole.project(in.parameters, in.lower, in.upper, true, a);
            sliced.project(in.parameters, in.lower, in.upper, true, b);
            expect_near(a, b, relative, what + ", projected,");
            sliced.project(in.parameters, in.lower, in.upper, true, again);
            EXPECT_EQ(b.loss, again.loss);
            EXPECT_EQ(b.normal, again.normal);
            whole.project(in.parameters, in.lower, in.upper, false, a);
            sliced.project(in.parameters, in.lower, in.upper, false, b);
            expect_near(a, b, relative, what + ", values,");
        }
        for (const bool logarithmic : {false, true}) {
            whole.loss(in.parameters, in.upper, logarithmic, a);
            sliced.loss(in.parameters, in.upper, logarithmic, b);
            expect_near(a, b, relative, what + ", loss,");
        }
        EXPECT_EQ(whole.terms(in.parameters), sliced.terms(in.parameters));
    }
}

TEST_P(EveryEvaluator, ASlicedBatchIsBitForBitItsCandidates) {
    const Model& model = *GetParam();
    const std::size_t p = model.parameters.size(), t = model.terms.size();
    const Inputs in(model, 37, 20, 3);
    Evaluator evaluator(sliced_engine(), model, engine().best_precision(), in.directions, in.y, in.w);
    Batch batch, values, losses, single;
    evaluator.project(in.parameters, in.lower, in.upper, true, batch);
    evaluator.project(in.parameters, in.lower, in.upper, false, values);
    evaluator.loss(in.parameters, in.upper, true, losses);
    for (std::size_t i = 0; i < 20; ++i) {
        const auto one = [&](const std::vector<double>& all, std::size_t stride) {
            return std::span(all).subspan(i * stride, stride);
        };
        evaluator.project(one(in.parameters, p), one(in.lower, t), one(in.upper, t), true, single);
        expect_same(batch, i, single);
        EXPECT_EQ(values.loss[i], single.loss[0]);
        evaluator.loss(one(in.parameters, p), one(in.upper, t), true, single);
        expect_same(losses, i, single);
    }
}

TEST(Sliced, ALargeBatchGoesInSeveralLaunches) {
    const Model& model = variant("lafortune_3");
    const Inputs in(model, 6000, 40, 8);  // 64 MB hold the terms of fewer candidates
    Evaluator whole(engine(), model, engine().best_precision(), in.directions, in.y, in.w);
    Evaluator sliced(sliced_engine(), model, engine().best_precision(), in.directions, in.y, in.w);
    Batch a, b;
    whole.project(in.parameters, in.lower, in.upper, true, a);
    sliced.project(in.parameters, in.lower, in.upper, true, b);
    expect_near(a, b, engine().best_precision() == Precision::double_precision ? 1e-9 : 1e-3, "6000 samples,");
}

TEST_P(EveryEvaluator, SingleIsCloseToDouble) {
    if (!engine().supports(Precision::double_precision)) GTEST_SKIP() << "the device lacks double precision";
    const Model& model = *GetParam();
    const Inputs in(model, 60, 50, 6);
    Evaluator full(engine(), model, Precision::double_precision, in.directions, in.y, in.w);
    Evaluator single(engine(), model, Precision::single_precision, in.directions, in.y, in.w);
    Batch a, b;
    full.project(in.parameters, in.lower, in.upper, true, a);
    single.project(in.parameters, in.lower, in.upper, true, b);
    for (std::size_t i = 0; i < 50; ++i) EXPECT_NEAR(b.loss[i], a.loss[i], 1e-3 * a.loss[i]);
}

/// The eps that the compiler's options ask for is the error that comes out, in its order of magnitude.
TEST(SeriesOptions, SetTheError) {
    if (!engine().supports(Precision::double_precision)) GTEST_SKIP() << "double precision only";
    const Model& model = variant("he_torrance");
    std::vector<Direction> directions;
    for (double theta_r = -80; theta_r <= 80; theta_r += 2.5) directions.push_back({40, theta_r, 0});
    const std::vector<double> none(directions.size(), 0.0);
    Evaluator full(engine(), model, Precision::double_precision, directions, none, none);
    for (const double log_epsilon : {8.0, 17.0}) {
        kernels::EngineOptions options;
        options.build_options = kernels::series_options(log_epsilon);
        kernels::Engine dialled(options);
        Evaluator shorter(dialled, model, Precision::double_precision, directions, none, none);
        double worst = 0;
        for (const double sigma : {0.05, 0.2, 0.6, 1.5}) {
            const std::vector<double> p{sigma, 8.8, 1.5, 0.3, 0.5};
            const std::vector<double> a = full.terms(p);
            const std::vector<double> b = shorter.terms(p);
            for (std::size_t j = directions.size(); j < 2 * directions.size(); ++j)  // the lobe
                if (a[j] > 1e-6) worst = std::max(worst, std::abs(b[j] / a[j] - 1));
        }
        EXPECT_LT(worst, 10 * std::exp(-log_epsilon));
        EXPECT_GT(worst, 1e-3 * std::exp(-log_epsilon));
    }
}

/// Values within 2e-5, slopes within 2e-4 of max(|slope|, |value/parameter|).
TEST(SearchAccuracy, IsCloseToFullOverSurfacesOfEveryKind) {
    const Model& model = variant("he_torrance");
    std::vector<Direction> directions;
    for (const double theta_i : {0.0, 15.0, 30.0, 45.0, 60.0, 75.0, 85.0})
        for (double theta_r = -85; theta_r <= 85; theta_r += 2.5) directions.push_back({theta_i, theta_r, 0});
    const std::size_t n = directions.size();
    const std::vector<double> none(n, 0.0);
    const Precision best = engine().best_precision();
    Evaluator full(engine(), model, best, directions, none, none);
    for (const Precision precision : {Precision::double_precision, Precision::single_precision}) {
        if (!engine().supports(precision)) continue;
        Evaluator search(engine(), model, precision, directions, none, none, kernels::Accuracy::search);
        double worst_value = 0;
        double worst_slope = 0;
        for (double sigma = 0.02; sigma < 5; sigma *= 1.25)
            for (const double tau : {2.0, 5.0, 8.8, 12.7, 14.8, 20.0, 60.0}) {
                const std::vector<double> p{sigma, tau, 1.5, 0.3, 0.5};
                const std::vector<double> a = full.terms(p);
                const std::vector<double> b = search.terms(p);
                for (std::size_t j = 0; j < n; ++j) {
                    const double value = a[n + j];  // rows: diffuse, lobe, its slopes
                    if (value < 1e-6) continue;
                    worst_value = std::max(worst_value, std::abs(b[n + j] / value - 1));
                    for (std::size_t k = 0; k < 4; ++k) {
                        const double slope = a[(2 + k) * n + j];
                        worst_slope = std::max(worst_slope, std::abs(b[(2 + k) * n + j] - slope) /
                                                                std::max(std::abs(slope), value / p[k]));
                    }
                }
            }
        EXPECT_LT(worst_value, 2e-5);
        EXPECT_LT(worst_slope, 2e-4);
        EXPECT_GT(worst_slope, 1e-6) << "nothing was saved";
        std::printf("search, %s: values %.1e, slopes %.1e\n",
                    precision == Precision::double_precision ? "double" : "single", worst_value, worst_slope);
    }
}

TEST(Batches, LargerThanOneLaunchAreWhole) {
    const Model& model = variant("lafortune_3");
    const std::size_t candidates = 3000;  // of 512 samples: 160 MB of terms
    const Inputs in(model, 512, candidates, 7);
    Evaluator evaluator(engine(), model, engine().best_precision(), in.directions, in.y, in.w);
    Batch batch, single;
    evaluator.project(in.parameters, in.lower, in.upper, true, batch);
    ASSERT_EQ(batch.loss.size(), candidates);
    for (const std::size_t i : {std::size_t{0}, candidates / 2, candidates - 1}) {
        evaluator.project(std::span(in.parameters).subspan(i * 10, 10), std::span(in.lower).subspan(i * 4, 4),
                          std::span(in.upper).subspan(i * 4, 4), true, single);
        expect_same(batch, i, single);
    }
}

TEST(Batches, NoCandidatesAreNoResults) {
    const Model& model = variant("ward");
    const Inputs in(model, 5, 0, 8);
    Evaluator evaluator(engine(), model, engine().best_precision(), in.directions, in.y, in.w);
    Batch batch;
    evaluator.project({}, {}, {}, true, batch);
    EXPECT_TRUE(batch.loss.empty());
    EXPECT_TRUE(evaluator.terms({}).empty());
}

/// Threads that ask for many directions' columns together each form a part of them.
TEST(Columns, OfManyDirectionsAreThoseOfEachAlone) {
    const Model& model = variant("he_torrance");
    std::vector<Direction> many = scan_directions({5, 20, 35, 50, 65, 80}, 0.05);
    const kernels::DirectionSet directions(many);
    const std::vector<double> parameters{0.3, 2, 1.5, 0.1, 0.2};
    std::vector<std::future<std::vector<double>>> found;
    for (int thread = 0; thread < 3; ++thread)
        found.push_back(std::async(std::launch::async, [&] {
            return Evaluator(engine(), model, engine().best_precision(), directions, {}, {}).terms(parameters);
        }));
    const std::vector<double> terms = found[0].get();
    for (std::size_t thread = 1; thread < found.size(); ++thread) EXPECT_EQ(found[thread].get(), terms);
    const std::size_t count = 64;
    for (const std::size_t first : {std::size_t{0}, std::size_t{4090}, many.size() - count}) {
        const auto begin = many.begin() + static_cast<std::ptrdiff_t>(first);
        const std::vector<Direction> few(begin, begin + static_cast<std::ptrdiff_t>(count));
        const std::vector<double> alone =
            Evaluator(engine(), model, engine().best_precision(), few, {}, {}).terms(parameters);
        for (std::size_t row = 0; row < model.term_values(); ++row)
            for (std::size_t j = 0; j < count; ++j)  // lanes differ where a series ends with its neighbours'
                EXPECT_NEAR(terms[row * many.size() + first + j], alone[row * count + j],
                            1e-9 * std::abs(alone[row * count + j]) + 1e-300);
    }
}

TEST(Engines, UnknownDevicesAreRefusedWithTheKnownOnes) {
    try {
        const kernels::Engine none({"no such device", {}});
        FAIL();
    } catch (const kernels::DeviceError& error) {
        EXPECT_NE(std::string(error.what()).find(engine().device().name), std::string::npos) << error.what();
    }
}

}  // namespace
}  // namespace brdfit::tests
