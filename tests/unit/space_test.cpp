// The search space: its charts cover the bounds, and its slopes are those of the loss.

#include "optim/space.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>

#include "kernels/evaluator.h"
#include "tests/support.h"

namespace brdfit::tests {
namespace {

using kernels::Batch;
using kernels::Evaluator;
using kernels::Model;
using optim::Candidate;
using optim::Charts;
using optim::Interval;
using optim::ScaleRange;
using optim::SearchSpace;
using optim::Unknowns;

std::vector<Interval> default_bounds(const Model& model) {
    std::vector<Interval> bounds;
    for (const kernels::Parameter& p : model.parameters) bounds.push_back({p.min, p.max});
    return bounds;
}

/// A point where lobes can be seen.
std::vector<double> typical_point(Random& random, const SearchSpace& space) {
    std::vector<double> u;
    for (const Interval& typical : space.typical())
        u.push_back(random.uniform(std::max(typical.min, 0.02), std::min(typical.max, 0.98)));
    return u;
}

std::vector<double> random_point(Random& random, std::size_t dimension) {
    std::vector<double> u(dimension);
    for (double& x : u) x = random.uniform(0.02, 0.98);
    return u;
}

const std::vector<kernels::Direction> kDirections = scan_directions({15, 45, 70}, 8);
const kernels::DirectionSet kSeen(kDirections);

/// Data that no model fits exactly: bounds of coefficients become active here and there.
struct Problem {
    std::vector<kernels::Direction> directions = kDirections;
    std::vector<double> y, weight;

    explicit Problem(bool logarithmic) {
        y = model_values(variant("he_torrance"), {0.93, 12.7, 1.5, 0.3, 0.9}, directions);
        Random random(1);
        for (double& value : y) {
            value *= 1 + 0.1 * random.normal();
            if (logarithmic) value = std::log(value);
            weight.push_back(random.uniform(0.5, 1.5) / static_cast<double>(directions.size()));
        }
    }
};

/// The loss and its slopes by u.
class Objective {
public:
    Objective(const SearchSpace& space, Unknowns unknowns, bool logarithmic)
        : space_(space),
          unknowns_(unknowns),
          logarithmic_(logarithmic),
          problem_(logarithmic),
          evaluator_(engine(), space.model(), engine().best_precision(), problem_.directions, problem_.y,
                     problem_.weight) {}

    double operator()(const std::vector<double>& u) {
        const Candidate at = space_.candidate(u);
        if (unknowns_ == Unknowns::all) evaluator_.loss(at.parameters, at.lower, logarithmic_, batch_);
        else evaluator_.project(at.parameters, at.lower, at.upper, true, batch_);
        return batch_.loss[0];
    }
    std::vector<double> slopes(const std::vector<double>& u) {
        (*this)(u);
        std::vector<double> by_u(u.size());
        space_.gradient(u, space_.candidate(u), batch_.coefficients, batch_.by_parameter, batch_.by_coefficient, by_u);
        return by_u;
    }

private:
    const SearchSpace& space_;
    Unknowns unknowns_;
    bool logarithmic_;
    Problem problem_;
    Evaluator evaluator_;
    Batch batch_;
};

struct Agreement {
    std::size_t compared = 0, skipped = 0;
    double worst = 0;
    std::string where;
};

/// Compares slopes with central differences; where those to the left and to the right differ, the loss has a kink (a
/// coefficient reaches its bound) and is passed over.
Agreement compare(const SearchSpace& space, Unknowns unknowns, bool logarithmic, std::size_t points) {
    Objective objective(space, unknowns, logarithmic);
    Random random(2);
    Agreement result;
    for (std::size_t i = 0; i < points; ++i) {
        const std::vector<double> u =
            i % 3 == 0 ? random_point(random, space.dimension()) : typical_point(random, space);
        const double f = objective(u);
        if (f > (logarithmic ? 1e3 : 1e50)) continue;  // a lobe saturates: its value is flat, its slope is not
        const std::vector<double> slopes = objective.slopes(u);
        for (std::size_t k = 0; k < u.size(); ++k) {
            // Richardson's combination of two steps: error h^4.
            const auto central = [&](double h) {
                std::vector<double> up = u, down = u;
                up[k] += h;
                down[k] -= h;
                return (objective(up) - objective(down)) / (2 * h);
            };
            constexpr double kStep = 2e-5;
            const double wide = central(2 * kStep), narrow = central(kStep);
            const double difference = (4 * narrow - wide) / 3;
            const double size = std::max({std::abs(difference), std::abs(slopes[k]), 1e-3 * f, 1e-12});
            const double noise = 1e-13 * f / kStep / size;
            if (!std::isfinite(f) || std::abs(wide - narrow) > 1e-4 * size || noise > 1e-5) {
                ++result.skipped;
                continue;
            }
            ++result.compared;
            const double error = std::abs(difference - slopes[k]) / size;
            if (error > result.worst) {
                result.worst = error;
                result.where = "coordinate " + std::to_string(k) + " at " + testing::PrintToString(u) + ": " +
                               std::to_string(slopes[k]) + " against " + std::to_string(difference);
            }
        }
    }
    return result;
}

class EverySpace : public testing::TestWithParam<const Model*> {};
INSTANTIATE_TEST_SUITE_P(Models, EverySpace, testing::ValuesIn(variants()),
                         [](const auto& parameter) { return label(*parameter.param); });

void expect_agreement(const Agreement& agreement, const SearchSpace& space) {
    EXPECT_LT(agreement.worst, 1e-3) << agreement.where;
    if (space.dimension() > 0) {
        EXPECT_GT(agreement.compared, agreement.skipped);
    }
}

TEST_P(EverySpace, SlopesOfTheProjectedLossAreThoseOfItsValues) {
    for (const kernels::DirectionSet* seen : {static_cast<const kernels::DirectionSet*>(nullptr), &kSeen}) {
        const SearchSpace space(*GetParam(), default_bounds(*GetParam()), Unknowns::nonlinear, {}, 1, Charts::used,
                                seen);
        expect_agreement(compare(space, Unknowns::nonlinear, false, 60), space);
    }
}

TEST_P(EverySpace, SlopesHoldWhereBoundsOfCoefficientsAreActive) {
    // Narrow bounds: most solutions lie on one.
    const Model& model = *GetParam();
    std::vector<Interval> bounds = default_bounds(model);
    for (std::size_t i = 0; i < bounds.size(); ++i) {
        if (model.is_linear(i)) bounds[i] = {0.1, 0.2};
        for (const kernels::Term& term : model.terms)
            if (term.homogeneous && (i == term.homogeneous->plane.first || i == term.homogeneous->plane.second))
                bounds[i] = {-0.9, 0.95};
    }
    for (const kernels::DirectionSet* seen : {static_cast<const kernels::DirectionSet*>(nullptr), &kSeen}) {
        const SearchSpace space(model, bounds, Unknowns::nonlinear, {}, 1, Charts::used, seen);
        expect_agreement(compare(space, Unknowns::nonlinear, false, 60), space);
    }
}

TEST_P(EverySpace, SlopesHoldWithAScale) {
    const SearchSpace space(*GetParam(), default_bounds(*GetParam()), Unknowns::nonlinear, ScaleRange{0.1, 10});
    expect_agreement(compare(space, Unknowns::nonlinear, false, 60), space);
}

TEST_P(EverySpace, SlopesHoldForAllUnknownsAndALogarithmicLoss) {
    std::vector<Interval> bounds = default_bounds(*GetParam());
    for (const ScaleRange scale : {ScaleRange{}, ScaleRange{0.1, 10}}) {
        const SearchSpace space(*GetParam(), bounds, Unknowns::all, scale, 1, Charts::used, &kSeen);
        expect_agreement(compare(space, Unknowns::all, true, 60), space);
    }
}

TEST_P(EverySpace, KeepsToBoundsAndFixedParameters) {
    const Model& model = *GetParam();
    Random random(3);
    for (int round = 0; round < 20; ++round) {
        std::vector<Interval> bounds;
        for (const kernels::Parameter& p : model.parameters) {
            const double a = random.on_scale(p.scale, p.min, p.max), b = random.on_scale(p.scale, p.min, p.max);
            bounds.push_back(random.chance(0.3)   ? Interval{a, a}
                             : random.chance(0.3) ? Interval{p.min, p.max}
                                                  : Interval{std::min(a, b), std::max(a, b)});
        }
        for (const Unknowns unknowns : {Unknowns::nonlinear, Unknowns::all}) {
            const SearchSpace space(model, bounds, unknowns);
            EXPECT_EQ(space.typical().size(), space.dimension());
            for (const Interval& typical : space.typical()) {
                EXPECT_GE(typical.min, 0);
                EXPECT_LE(typical.max, 1);
                EXPECT_LE(typical.min, typical.max);
            }
            for (int i = 0; i < 20; ++i) {
                std::vector<double> u = random_point(random, space.dimension());
                if (i == 0) std::fill(u.begin(), u.end(), 0.0);
                if (i == 1) std::fill(u.begin(), u.end(), 1.0);
                const Candidate at = space.candidate(u);
                std::vector<double> c;
                for (std::size_t t = 0; t < model.terms.size(); ++t) {
                    EXPECT_LE(at.lower[t], at.upper[t]);
                    c.push_back(random.chance(0.5) ? at.upper[t] : std::min(at.lower[t] + 0.3, at.upper[t]));
                }
                double scale = 0;
                const std::vector<double> p = space.parameters(u, c, scale);
                EXPECT_EQ(scale, 1);
                for (std::size_t k = 0; k < p.size(); ++k) {
                    EXPECT_GE(p[k], bounds[k].min) << model.parameters[k].name;
                    EXPECT_LE(p[k], bounds[k].max) << model.parameters[k].name;
                }
            }
        }
    }
}

TEST_P(EverySpace, EveryPointOfTheBoundsHasCoordinates) {
    const Model& model = *GetParam();
    Random random(4);
    const std::vector<Interval> bounds = default_bounds(model);
    for (const Unknowns unknowns : {Unknowns::nonlinear, Unknowns::all}) {
        const SearchSpace space(model, bounds, unknowns);
        std::size_t reached = 0;
        for (int i = 0; i < 300; ++i) {
            std::vector<double> p = random.parameters(model);
            for (const kernels::Term& term : model.terms)  // heights that neither vanish nor overflow
                if (term.homogeneous)
                    p[term.homogeneous->degree] = random.on_scale(kernels::Scale::logarithmic, 0.1, 200);
            const std::vector<double> u = space.coordinates(p, 1);
            // Directions almost opposite to the pole of a narrow lobe lie beyond the chart's ends.
            if (std::any_of(u.begin(), u.end(), [](double x) { return x == 0 || x == 1; })) continue;
            ++reached;
            std::vector<double> c = model.coefficients(p);
            for (std::size_t t = 0; t < model.terms.size(); ++t)
                if (const auto& h = model.terms[t].homogeneous)
                    c[t] = std::pow(std::max(std::abs(p[h->plane.first]), std::abs(p[h->plane.second])), p[h->degree]);
            if (unknowns == Unknowns::all) c = space.candidate(u).lower;
            double scale = 0;
            const std::vector<double> back = space.parameters(u, c, scale);
            for (std::size_t k = 0; k < p.size(); ++k)
                EXPECT_NEAR(back[k], p[k], 1e-9 * std::max(std::abs(p[k]), 1.0))
                    << model.parameters[k].name << " of " << testing::PrintToString(p);
        }
        EXPECT_GT(reached, 290U);
    }
}

TEST(ComplexIndex, ChartCoversTheWholeBox) {
    const Model& model = variant("he_torrance");
    const SearchSpace space(model, default_bounds(model));
    Random random(5);
    std::vector<std::pair<double, double>> points{{0.05, 0}, {20, 0}, {0.05, 20}, {20, 19.9}, {1, 20}, {1, 1e-9}};
    for (int i = 0; i < 5000; ++i)
        points.emplace_back(
            random.on_scale(kernels::Scale::logarithmic, 0.05, 20),
            random.chance(0.3) ? random.on_scale(kernels::Scale::logarithmic, 1e-6, 20) : random.uniform(0, 20));
    for (const auto& [n, k] : points) {
        const Candidate at = space.candidate(space.coordinates({0.1, 3, n, k, 0.5}, 1));
        EXPECT_NEAR(at.parameters[2], n, 1e-9 * (1 + n)) << n << " " << k;
        EXPECT_NEAR(at.parameters[3], k, 1e-9 * (1 + k)) << n << " " << k;
    }
}

TEST(ComplexIndex, IsTriedWhereOneMoreSampleIsReflectedTotally) {
    const Model& model = variant("he_torrance");
    const kernels::DirectionSet directions({{30, 30, 0}, {60, 60, 0}, {20, 40, 0}, {1, 1, 0}});  // 1 degree: n < 0.05
    const SearchSpace space(model, default_bounds(model), Unknowns::nonlinear, {}, 1, Charts::used, &directions);
    const std::vector<double> u{0.4, 0.3, 0.6, 0.7};
    const optim::Choices choices = space.critical_indices(u, 10);
    ASSERT_EQ(choices.points.size(), 2U);  // 30 degrees twice
    for (std::size_t i = 0; i < 2; ++i) {
        const std::vector<double> p = space.candidate(choices.points[i]).parameters;
        const double critical = std::sin((i == 0 ? 30 : 60) * std::numbers::pi / 180);
        EXPECT_LT(p[2], critical);
        EXPECT_NEAR(p[2], critical, 1e-5);
        EXPECT_NEAR(p[3], 0, 1e-12);
        for (std::size_t j = 0; j < u.size(); ++j)
            if (std::count(choices.coordinates.begin(), choices.coordinates.end(), j) == 0) {
                EXPECT_EQ(choices.points[i][j], u[j]);
            }
    }
    EXPECT_EQ(space.critical_indices(u, 1).points.size(), 1U);
    EXPECT_TRUE(SearchSpace(model, default_bounds(model)).critical_indices(u, 10).points.empty());
    std::vector<Interval> absorbs = default_bounds(model);
    absorbs[3].min = 0.1;
    const SearchSpace metals(model, absorbs, Unknowns::nonlinear, {}, 1, Charts::used, &directions);
    EXPECT_TRUE(metals.critical_indices(u, 10).points.empty());
}

TEST(ComplexIndex, MissesOnlyTheOuterCornerOfTheBox) {
    // Rays from n = 1, k = 0 leave n = n_max and come back at k > sqrt(n_max^2 - 1): the chart ends where they leave.
    const Model& model = variant("he_torrance");
    const SearchSpace space(model, default_bounds(model));
    const Candidate at = space.candidate(space.coordinates({0.1, 3, 20, 20, 0.5}, 1));
    EXPECT_NEAR(at.parameters[2], 20, 0.1);
    EXPECT_NEAR(at.parameters[3], 20, 0.1);
}

TEST(ComplexIndex, EveryCandidateIsInTheBox) {
    const Model& model = variant("he_torrance");
    for (const Interval n : {Interval{0.05, 20}, Interval{0.5, 3}, Interval{0.9, 1.1}})
        for (const Interval k : {Interval{0, 20}, Interval{0, 0.5}, Interval{0, 3}}) {
            std::vector<Interval> bounds = default_bounds(model);
            bounds[2] = n;
            bounds[3] = k;
            const SearchSpace space(model, bounds);
            Random random(6);
            for (int i = 0; i < 1000; ++i) {
                std::vector<double> u = random_point(random, space.dimension());
                for (double& x : u)
                    if (random.chance(0.1)) x = random.chance(0.5) ? 0 : 1;
                const Candidate at = space.candidate(u);
                EXPECT_TRUE(at.parameters[2] >= n.min && at.parameters[2] <= n.max) << at.parameters[2];
                EXPECT_TRUE(at.parameters[3] >= k.min && at.parameters[3] <= k.max) << at.parameters[3];
            }
            const Agreement agreement = compare(space, Unknowns::nonlinear, false, 30);
            EXPECT_LT(agreement.worst, 1e-3) << agreement.where;
        }
}

TEST(Dimension, CountsTheFreeNonlinearParameters) {
    const auto dimension = [](const char* name, Unknowns unknowns) {
        return SearchSpace(variant(name), default_bounds(variant(name)), unknowns).dimension();
    };
    EXPECT_EQ(dimension("lambert", Unknowns::nonlinear), 0U);
    EXPECT_EQ(dimension("phong", Unknowns::nonlinear), 1U);
    EXPECT_EQ(dimension("ward", Unknowns::nonlinear), 1U);
    EXPECT_EQ(dimension("lafortune_2", Unknowns::nonlinear), 4U);
    EXPECT_EQ(dimension("he_torrance", Unknowns::nonlinear), 4U);
    EXPECT_EQ(dimension("lambert", Unknowns::all), 1U);
    EXPECT_EQ(dimension("lafortune_2", Unknowns::all), 7U);
    EXPECT_EQ(dimension("he_torrance", Unknowns::all), 5U);
}

TEST(Dimension, NarrowedBoundsFallBackToTheParametersThemselves) {
    // One sign of c_xy: the direction chart would leave the bounds, so c_xy and c_z are searched as they are.
    std::vector<Interval> bounds = default_bounds(variant("lafortune_1"));
    bounds[1] = {-3, -0.5};
    const SearchSpace lafortune(variant("lafortune_1"), bounds);
    EXPECT_EQ(lafortune.dimension(), 3U);
    EXPECT_LT(compare(lafortune, Unknowns::nonlinear, false, 60).worst, 1e-3);
    // n without 1, and k without 0.
    bounds = default_bounds(variant("he_torrance"));
    bounds[2] = {1.3, 1.7};
    const SearchSpace he(variant("he_torrance"), bounds);
    EXPECT_EQ(he.dimension(), 4U);
    const std::vector<double> u = he.coordinates({0.1, 3, 1.5, 2, 0.5}, 1);
    EXPECT_NEAR(he.candidate(u).parameters[2], 1.5, 1e-12);
    EXPECT_NEAR(he.candidate(u).parameters[3], 2, 1e-12);
    EXPECT_LT(compare(he, Unknowns::nonlinear, false, 60).worst, 1e-3);
}

TEST(Scale, IsTheLastCoordinateEvenInItsLogarithm) {
    const Model& model = variant("ward");
    const SearchSpace space(model, default_bounds(model), Unknowns::nonlinear, ScaleRange{1e-2, 1e4});
    ASSERT_EQ(space.dimension(), 2U);
    const std::vector<double> u = space.coordinates({0.3, 0.2, 0.1}, 10);
    EXPECT_NEAR(u[1], 0.5, 1e-12);
    const Candidate at = space.candidate(u);
    EXPECT_NEAR(at.upper[0], 10 * model.parameters[0].max, 1e-9);  // coefficients are scale times the albedo
    double scale = 0;
    const std::vector<double> p = space.parameters(u, std::vector<double>{3, 2}, scale);
    EXPECT_NEAR(scale, 10, 1e-12);
    EXPECT_NEAR(p[0], 0.3, 1e-12);
    EXPECT_NEAR(p[1], 0.2, 1e-12);
}

}  // namespace
}  // namespace brdfit::tests
