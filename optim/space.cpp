#include "optim/space.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <numbers>
#include <numeric>
#include <optional>

#include "kernels/geometry.h"

namespace brdfit::optim {
namespace {

using kernels::Model;
using kernels::Parameter;
using kernels::Scale;
using kernels::Term;
constexpr double kPi = std::numbers::pi;

/// Coefficients beyond are as good as unbounded.
constexpr double kLargestCoefficient = 1e100;
/// The smallest length of a homogeneous pair that is told from 0.
constexpr double kLogSmallestLength = -345.0;  // ln 1e-150
/// exp of less is 0, which takes it long to find.
constexpr double kLogUnderflow = -746.0;

/// A coefficient came out of the evaluator at its bound, to single precision.
bool at_lower(double c, double bound) { return c <= bound * (1 + 1e-6); }
bool at_upper(double c, double bound) { return c >= bound * (1 - 1e-6); }

/// d coefficients/d u and d parameters/d u, row by row.
class Slopes {
public:
    /// rows: where each parameter's slopes stand; those of coefficients come first.
    Slopes(std::span<double> all, const std::vector<std::size_t>& rows, std::size_t dimension)
        : all_(all), rows_(rows), dimension_(dimension) {}
    [[nodiscard]] std::span<double> coefficient(std::size_t t) { return all_.subspan(t * dimension_, dimension_); }
    [[nodiscard]] std::span<double> parameter(std::size_t i) { return coefficient(rows_[i]); }

private:
    std::span<double> all_;
    const std::vector<std::size_t>& rows_;
    std::size_t dimension_;
};

/// to += factor row. What is 0 stays so, whatever the factor.
void add(std::span<double> to, double factor, std::span<const double> row) {
    for (std::size_t j = 0; j < to.size(); ++j)
        if (row[j] != 0) to[j] += factor * row[j];
}

/// Where slopes are asked for.
struct Placed {
    const Candidate& candidate;
    std::span<const double> coefficients;
    double scale;
};

}  // namespace

class Axis {
public:
    virtual ~Axis() = default;
    [[nodiscard]] virtual std::size_t dimension() const { return 1; }
    /// The homogeneous term of which this is the direction.
    [[nodiscard]] virtual std::optional<std::size_t> lobe() const { return std::nullopt; }
    /// Whether it sets the parameter.
    [[nodiscard]] virtual bool moves(std::size_t parameter) const = 0;
    /// Numbers that apply() leaves for slopes().
    [[nodiscard]] virtual std::size_t notes() const { return 1; }
    virtual void apply(std::span<const double> u, Candidate& out, std::span<double> notes) const = 0;
    /// Adds what the axis's coordinates, from `first` on, move. Must come after the axes that apply() reads.
    virtual void add_slopes(const Placed& at, std::span<const double> notes, std::size_t first,
                            Slopes& slopes) const = 0;
    /// Turns a candidate's parameters into the model's: only a lobe's height has work to do.
    virtual void finish(std::span<const double> /*coefficients*/, std::vector<double>& /*parameters*/) const {}
    virtual void locate(const std::vector<double>& parameters, std::span<double> u) const = 0;
    [[nodiscard]] virtual std::vector<Interval> typical() const = 0;
};

namespace {

/// Coefficients from 0: evenly spaced below a level, and in their logarithm above.
class Level {
public:
    Level(double level, double largest) : level_(level), reach_(std::asinh(largest / level)) {}
    [[nodiscard]] double value(double u) const { return level_ * std::sinh(u * reach_); }
    [[nodiscard]] double slope(double u) const { return level_ * std::cosh(u * reach_) * reach_; }
    [[nodiscard]] double place(double value) const { return std::clamp(std::asinh(value / level_) / reach_, 0.0, 1.0); }

private:
    double level_, reach_;
};

/// A linear coefficient that is searched, from its lower bound on.
class LevelAxis final : public Axis {
public:
    LevelAxis(std::size_t index, Interval bounds, double level)
        : index_(index), bounds_(bounds), level_(level, std::min(bounds.max - bounds.min, kLargestCoefficient)) {}

    [[nodiscard]] bool moves(std::size_t parameter) const override { return parameter == index_; }

    void apply(std::span<const double> u, Candidate& out, std::span<double> notes) const override {
        out.parameters[index_] = std::clamp(bounds_.min + level_.value(u[0]), bounds_.min, bounds_.max);
        notes[0] = level_.slope(u[0]);
    }
    void add_slopes(const Placed&, std::span<const double> notes, std::size_t first, Slopes& slopes) const override {
        slopes.parameter(index_)[first] = notes[0];
    }
    void locate(const std::vector<double>& parameters, std::span<double> u) const override {
        u[0] = level_.place(parameters[index_] - bounds_.min);
    }
    [[nodiscard]] std::vector<Interval> typical() const override { return {{0, 1}}; }

private:
    std::size_t index_;
    Interval bounds_;
    Level level_;
};

/// A parameter on its own scale.
class DirectAxis final : public Axis {
public:
    DirectAxis(const Parameter& parameter, std::size_t index, Interval bounds)
        : index_(index),
          bounds_(bounds),
          log_(parameter.scale == Scale::logarithmic && bounds.min > 0),
          range_(log_ ? std::log(bounds.max / bounds.min) : bounds.max - bounds.min) {
        const auto inside = [&](double value) { return to_u(std::clamp(value, bounds.min, bounds.max)); };
        typical_ = {inside(parameter.typical_min), inside(parameter.typical_max)};
        if (!(typical_.min < typical_.max)) typical_ = {0, 1};
    }

    [[nodiscard]] bool moves(std::size_t parameter) const override { return parameter == index_; }

    void apply(std::span<const double> u, Candidate& out, std::span<double> notes) const override {
        const double value = log_ ? bounds_.min * std::exp(u[0] * range_) : bounds_.min + u[0] * range_;
        out.parameters[index_] = std::clamp(value, bounds_.min, bounds_.max);
        notes[0] = log_ ? out.parameters[index_] * range_ : range_;
    }
    void add_slopes(const Placed&, std::span<const double> notes, std::size_t first, Slopes& slopes) const override {
        slopes.parameter(index_)[first] = notes[0];
    }
    void locate(const std::vector<double>& parameters, std::span<double> u) const override {
        u[0] = to_u(std::clamp(parameters[index_], bounds_.min, bounds_.max));
    }
    [[nodiscard]] std::vector<Interval> typical() const override { return {typical_}; }

private:
    [[nodiscard]] double to_u(double value) const {
        return (log_ ? std::log(value / bounds_.min) : value - bounds_.min) / range_;
    }
    std::size_t index_;
    Interval bounds_;
    bool log_;
    double range_;  ///< of the parameter or its logarithm
    Interval typical_{0, 1};
};

/// n + ik = (1 + rho)/(1 - rho), rho = r e^(i phi): |rho|^2 is the reflectance at normal incidence. phi = pi u_1, and
/// r = u_0 times the radius where the ray of phi leaves the rectangle of the bounds.
class ComplexIndexAxis final : public Axis {
public:
    ComplexIndexAxis(std::size_t n, std::size_t k, Interval n_bounds, Interval k_bounds)
        : n_(n), k_(k), n_bounds_(n_bounds), k_bounds_(k_bounds) {}

    /// The rectangle must hold rho = 0 (n = 1, k = 0) and be star-shaped about it: rays leave n = n_max and come back
    /// only where k >= sqrt(n_max^2 - 1).
    static bool covers(Interval n, Interval k) {
        return n.min < 1 && n.max > 1 && k.min == 0 && k.max > 0 && k.max <= 1.01 * n.max;
    }

    [[nodiscard]] std::size_t dimension() const override { return 2; }
    [[nodiscard]] bool moves(std::size_t parameter) const override { return parameter == n_ || parameter == k_; }

    [[nodiscard]] std::size_t notes() const override { return 4; }

    /// Notes: the slopes of n and k by u_0 and u_1.
    void apply(std::span<const double> u, Candidate& out, std::span<double> notes) const override {
        const double phi = kPi * u[1];
        const Exit leaves = exit(phi);
        const Index index = at(u[0] * leaves.radius, phi);
        out.parameters[n_] = std::clamp(index.n, n_bounds_.min, n_bounds_.max);
        out.parameters[k_] = std::clamp(index.k, k_bounds_.min, k_bounds_.max);
        notes[0] = index.n_r * leaves.radius;
        notes[1] = index.k_r * leaves.radius;
        notes[2] = kPi * (index.n_phi + index.n_r * u[0] * leaves.slope);
        notes[3] = kPi * (index.k_phi + index.k_r * u[0] * leaves.slope);
    }
    void add_slopes(const Placed&, std::span<const double> notes, std::size_t first, Slopes& slopes) const override {
        slopes.parameter(n_)[first] = notes[0];
        slopes.parameter(k_)[first] = notes[1];
        slopes.parameter(n_)[first + 1] = notes[2];
        slopes.parameter(k_)[first + 1] = notes[3];
    }
    void locate(const std::vector<double>& parameters, std::span<double> u) const override {
        // rho = (N - 1)/(N + 1)
        const double n = parameters[n_];
        const double k = parameters[k_];
        const double norm = (n + 1) * (n + 1) + k * k;
        const double re = ((n - 1) * (n + 1) + k * k) / norm;
        const double im = 2 * k / norm;
        const double phi = std::atan2(im, re);
        u[1] = std::clamp(phi / kPi, 0.0, 1.0);
        u[0] = std::clamp(std::hypot(re, im) / exit(phi).radius, 0.0, 1.0);
    }
    /// Away from rho = 0 (n = 1, k = 0), where every slope vanishes.
    [[nodiscard]] std::vector<Interval> typical() const override { return {{0.1, 1}, {0, 1}}; }

private:
    struct Index {
        double n, k, n_r, n_phi, k_r, k_phi;
    };
    struct Exit {
        double radius, slope;  // and d radius/d phi
    };

    static Index at(double r, double phi) {
        const double c = std::cos(phi);
        const double s = std::sin(phi);
        const double d = 1 - 2 * r * c + r * r;
        const double d_r = 2 * (r - c);
        const double d_phi = 2 * r * s;
        const double n = (1 - r * r) / d;
        const double k = 2 * r * s / d;
        return {n, k, (-2 * r - n * d_r) / d, -n * d_phi / d, (2 * s - k * d_r) / d, (2 * r * c - k * d_phi) / d};
    }

    /// Where the ray first meets n = n_min, n = n_max or k = k_max: each a quadratic in r.
    [[nodiscard]] Exit exit(double phi) const {
        const double c = std::cos(phi);
        const double s = std::sin(phi);
        const auto slope_n = [&](double r) {
            const Index i = at(r, phi);
            return -i.n_phi / i.n_r;
        };
        const double n0 = n_bounds_.min;
        const double low = (n0 * c + std::sqrt(n0 * n0 * c * c + (1 - n0) * (1 + n0))) / (1 + n0);
        Exit best{low, slope_n(low)};
        const double n1 = n_bounds_.max;
        const double n_discriminant = n1 * n1 * c * c - (n1 - 1) * (n1 + 1);
        if (c > 0 && n_discriminant >= 0) {
            const double high = (n1 * c - std::sqrt(n_discriminant)) / (1 + n1);
            if (high < best.radius) best = {high, n_discriminant > 0 ? slope_n(high) : 0.0};
        }
        const double k1 = k_bounds_.max;
        const double half = k1 * c + s;
        const double k_discriminant = half * half - k1 * k1;
        if (half > 0 && k_discriminant >= 0) {
            const double top = (half - std::sqrt(k_discriminant)) / k1;
            if (top < best.radius) {
                const Index i = at(top, phi);
                best = {top, k_discriminant > 0 ? -i.k_phi / i.k_r : 0.0};
            }
        }
        return best;
    }

    std::size_t n_, k_;
    Interval n_bounds_, k_bounds_;
};

/// The direction of a homogeneous pair: (x, y) = R (cos psi, sin psi)/S(psi), with height R^degree = c. S is the
/// largest cos psi a + sin psi b over the samples' columns a and b, so that a lobe of height 1 peaks at 1 whatever its
/// degree (and where no sample sees it to speak of, a little of what the largest columns give). A narrow lobe's height
/// follows its direction as exp(degree (psi - pole)), so the coordinate is t with psi = pole + 2 atan(sinh(t)/(1 +
/// degree)): what is a funnel in psi is a straight channel in t. With a level the height is a second coordinate, else a
/// coefficient to solve for.
class DirectionAxis final : public Axis {
public:
    DirectionAxis(std::size_t term, const Term::Homogeneous& homogeneous, Interval x, Interval y,
                  std::optional<double> level, const kernels::DirectionSet* seen)
        : hull_(hull(homogeneous, seen)),
          term_(term),
          x_(homogeneous.plane.first),
          y_(homogeneous.plane.second),
          degree_(homogeneous.degree),
          pole_(homogeneous.pole),
          cos_pole_(std::cos(pole_)),
          sin_pole_(std::sin(pole_)),
          x_bounds_(x),
          y_bounds_(y) {
        if (level) height_.emplace(*level, kLargestCoefficient);
    }

    [[nodiscard]] std::size_t dimension() const override { return height_ ? 2 : 1; }
    [[nodiscard]] bool moves(std::size_t parameter) const override { return parameter == x_ || parameter == y_; }
    [[nodiscard]] std::optional<std::size_t> lobe() const override { return term_; }

    /// The rectangle must hold the origin, so that every direction has lengths from 0.
    static bool covers(Interval x, Interval y) { return x.min < 0 && x.max > 0 && y.min < 0 && y.max > 0; }

    [[nodiscard]] std::size_t notes() const override { return kNotes; }

    /// Must come after the axis of the degree.
    void apply(std::span<const double> u, Candidate& out, std::span<double> notes) const override {
        const double degree = out.parameters[degree_];
        const double sinh_t = std::sinh(kReach * (2 * u[0] - 1));
        const double tangent = sinh_t / (1 + degree);  // of (psi - pole)/2
        const double part = 2 / (1 + tangent * tangent);
        const double cosine = cos_pole_ * (part - 1) - sin_pole_ * part * tangent;
        const double sine = sin_pole_ * (part - 1) + cos_pole_ * part * tangent;
        const Support support = support_along(cosine, sine);
        const double x = out.parameters[x_] = cosine / support.value;
        const double y = out.parameters[y_] = sine / support.value;
        const Longest longest = longest_along(x, y);
        const double log_length = std::log(longest.length);
        const double log_least = degree * kLogSmallestLength;
        out.lower[term_] = log_least < kLogUnderflow ? 0.0 : std::exp(log_least);
        out.upper[term_] = std::exp(degree * log_length);
        const double shrinks = support.slope / support.value;
        notes[kXByAngle] = -y - x * shrinks;
        notes[kYByAngle] = x - y * shrinks;
        notes[kAngleByU] = part * std::sqrt(1 + sinh_t * sinh_t) / (1 + degree) * 2 * kReach;
        notes[kAngleByDegree] = -part * tangent / (1 + degree);
        notes[kLogLongest] = log_length;
        notes[kLongestByX] = longest.by_x ? 1.0 : 0.0;
        if (!height_) return;
        const double height = height_->value(u[1]);
        notes[kHeightByU] = height > out.upper[term_] ? 0.0 : height_->slope(u[1]);  // none where it is held
        out.lower[term_] = out.upper[term_] = std::min(height, out.upper[term_]);
    }
    void add_slopes(const Placed& at, std::span<const double> notes, std::size_t first, Slopes& slopes) const override {
        const Candidate& candidate = at.candidate;
        const double c = at.coefficients[term_];
        const double degree = candidate.parameters[degree_];
        // The angle moves with u and with the degree.
        const std::span<const double> by_degree = slopes.parameter(degree_);
        const auto add_angle = [&](std::span<double> to, double factor) {
            to[first] += factor * notes[kAngleByU];
            add(to, factor * notes[kAngleByDegree], by_degree);
        };
        add_angle(slopes.parameter(x_), notes[kXByAngle]);
        add_angle(slopes.parameter(y_), notes[kYByAngle]);
        const std::span<double> coefficient = slopes.coefficient(term_);
        const bool at_longest = height_ ? notes[kHeightByU] == 0 : at_upper(c, candidate.upper[term_]);
        if (at_longest && candidate.upper[term_] < kLargestCoefficient) {
            // ln upper = degree ln R, and R = bound/|x| or bound/|y| along this direction
            const bool by_x = notes[kLongestByX] != 0;
            add(coefficient, c * notes[kLogLongest], by_degree);
            add_angle(coefficient,
                      -c * degree / candidate.parameters[by_x ? x_ : y_] * notes[by_x ? kXByAngle : kYByAngle]);
        } else if (!height_ && at_lower(c, candidate.lower[term_])) {
            add(coefficient, c * kLogSmallestLength, by_degree);
        }
        if (height_) coefficient[first + 1] += at.scale * notes[kHeightByU];
    }
    void finish(std::span<const double> c, std::vector<double>& parameters) const override {
        const double height = c[term_];
        const double length = height > 0 ? std::exp(std::log(height) / parameters[degree_]) : 0.0;
        parameters[x_] = std::clamp(length * parameters[x_], x_bounds_.min, x_bounds_.max);
        parameters[y_] = std::clamp(length * parameters[y_], y_bounds_.min, y_bounds_.max);
    }
    void locate(const std::vector<double>& parameters, std::span<double> u) const override {
        const double away = std::remainder(std::atan2(parameters[y_], parameters[x_]) - pole_, 2 * kPi);
        const double t = std::asinh(std::tan(away / 2) * (1 + parameters[degree_]));
        u[0] = std::clamp(0.5 + 0.5 * t / kReach, 0.0, 1.0);
        if (!height_) return;
        const double norm = std::hypot(parameters[x_], parameters[y_]);
        const double length = norm > 0 ? norm * support_along(parameters[x_] / norm, parameters[y_] / norm).value : 0.0;
        u[1] = height_->place(std::pow(length, parameters[degree_]));
    }
    [[nodiscard]] std::vector<Interval> typical() const override {
        if (height_) return {{0.3, 0.7}, {0, 1}};
        return {{0.3, 0.7}};
    }

private:
    enum Note : std::size_t {
        kXByAngle,
        kYByAngle,
        kAngleByU,
        kAngleByDegree,
        kLogLongest,
        kLongestByX,
        kHeightByU,
        kNotes
    };
    /// Largest |t|: reaches to within 10 degrees of the pole's opposite at degree 1e4.
    static constexpr double kReach = 12;

    /// Where the columns of the samples end: the vertices that may be farthest along a direction.
    struct Vertex {
        double a, b;
    };
    static std::vector<Vertex> hull(const Term::Homogeneous& homogeneous, const kernels::DirectionSet* seen) {
        if (!homogeneous.columns || seen == nullptr) return {{1, 0}, {0, 1}, {-1, 0}, {0, -1}};
        std::vector<Vertex> vertices;
        for (const auto& [a, b] : seen->hull(homogeneous.columns->first, homogeneous.columns->second))
            vertices.push_back({a, b});
        return vertices;
    }
    /// S at (cos, sin) and dS/d psi.
    struct Support {
        double value, slope;
    };
    [[nodiscard]] Support support_along(double cosine, double sine) const {
        constexpr double kUnseen = 1e-3;
        Support support{0, 0};
        double largest = 0;
        for (const Vertex& v : hull_) {
            largest = std::max({largest, std::abs(v.a), std::abs(v.b)});
            const double value = cosine * v.a + sine * v.b;
            if (value > support.value) support = {value, cosine * v.b - sine * v.a};
        }
        const double least = largest > 0 ? kUnseen * largest : 1.0;
        return support.value > least ? support : Support{least, 0};
    }

    /// The length at which the ray along (x, y) leaves the bounds, and through which side.
    struct Longest {
        double length;
        bool by_x;
    };
    [[nodiscard]] Longest longest_along(double x, double y) const {
        const double by_x = x == 0 ? HUGE_VAL : (x < 0 ? x_bounds_.min : x_bounds_.max) / x;
        const double by_y = y == 0 ? HUGE_VAL : (y < 0 ? y_bounds_.min : y_bounds_.max) / y;
        return {std::min(by_x, by_y), by_x < by_y};
    }
    std::vector<Vertex> hull_;
    std::size_t term_, x_, y_, degree_;
    double pole_, cos_pole_, sin_pole_;
    Interval x_bounds_, y_bounds_;
    std::optional<Level> height_{};
};

}  // namespace

SearchSpace::SearchSpace(const Model& model, std::vector<Interval> bounds, Unknowns unknowns, ScaleRange scale,
                         double level, Charts charts, const kernels::DirectionSet* seen)
    : model_(model),
      seen_(seen),
      nonlinear_(model.nonlinear()),
      bounds_(std::move(bounds)),
      unknowns_(unknowns),
      scale_(scale) {
    const bool all = unknowns == Unknowns::all;
    std::vector<bool> taken(model.parameters.size(), false);
    for (std::size_t i = 0; i < taken.size(); ++i) taken[i] = (model.is_linear(i) && !all) || bounds_[i].fixed();
    const auto take = [&](std::size_t a, std::size_t b, auto axis) {
        taken[a] = taken[b] = true;
        axes_.push_back(std::move(axis));
        lobes_.push_back(model.parameters[a].repeat);
    };
    for (const kernels::Chart& chart : model.charts) {
        const auto [n, k] = chart.parameters;
        if (charts == Charts::used && !taken[n] && !taken[k] && ComplexIndexAxis::covers(bounds_[n], bounds_[k]))
            take(n, k, std::make_unique<ComplexIndexAxis>(n, k, bounds_[n], bounds_[k]));
    }
    std::vector<std::unique_ptr<Axis>> directions;
    std::vector<std::optional<std::size_t>> their_lobes;
    for (std::size_t t = 0; t < model.terms.size(); ++t) {
        const auto& homogeneous = model.terms[t].homogeneous;
        if (!homogeneous || charts == Charts::none) continue;
        const auto [x, y] = homogeneous->plane;
        if (taken[x] || taken[y] || !DirectionAxis::covers(bounds_[x], bounds_[y])) continue;
        taken[x] = taken[y] = true;
        their_lobes.push_back(model.parameters[x].repeat);
        directions.push_back(std::make_unique<DirectionAxis>(t, *homogeneous, bounds_[x], bounds_[y],
                                                             all ? std::optional(level) : std::nullopt, seen));
    }
    for (std::size_t i = 0; i < taken.size(); ++i) {
        if (taken[i]) continue;
        lobes_.push_back(model.parameters[i].repeat);
        if (model.is_linear(i)) axes_.push_back(std::make_unique<LevelAxis>(i, bounds_[i], level));
        else axes_.push_back(std::make_unique<DirectAxis>(model.parameters[i], i, bounds_[i]));
    }
    for (auto& axis : directions) axes_.push_back(std::move(axis));  // they read the degrees set before
    lobes_.insert(lobes_.end(), their_lobes.begin(), their_lobes.end());
    for (const auto& axis : axes_) {
        places_.push_back({axis.get(), dimension_, axis->dimension(), notes_, axis->notes()});
        dimension_ += axis->dimension();
        notes_ += axis->notes();
    }
    if (scaled()) ++dimension_;
    for (const kernels::Chart& chart : model.charts) {
        IndexAxis index{chart.parameters.first, chart.parameters.second, {}};
        for (const Place& place : places_)
            if (place.axis->moves(index.n) || place.axis->moves(index.k))
                for (std::size_t j = 0; j < place.coordinates; ++j) index.coordinates.push_back(place.first + j);
        if (!index.coordinates.empty()) indices_.push_back(std::move(index));
    }
    rows_.resize(bounds_.size());
    std::size_t row = model.terms.size();
    for (const std::size_t parameter : nonlinear_) rows_[parameter] = row++;
    for (std::size_t i = 0; i < rows_.size(); ++i)
        if (rows_[i] == 0) rows_[i] = row++;
    for (std::size_t i = 0; i < bounds_.size(); ++i)
        held_.push_back(bounds_[i].fixed() && (all || !model.is_linear(i)) ? bounds_[i].min : 0.0);
}

SearchSpace::~SearchSpace() = default;
SearchSpace::SearchSpace(SearchSpace&&) noexcept = default;

double SearchSpace::scale(std::span<const double> u) const {
    return scaled() ? scale_.min * std::exp(u.back() * std::log(scale_.max / scale_.min)) : scale_.min;
}

Candidate SearchSpace::candidate(std::span<const double> u) const {
    Candidate out;
    place(u, out);
    return out;
}

void SearchSpace::place(std::span<const double> u, Candidate& out) const {
    const bool all = unknowns_ == Unknowns::all;
    out.parameters = held_;
    out.lower.assign(model_.terms.size(), 1.0);
    out.upper.assign(model_.terms.size(), 1.0);
    out.notes.resize(notes_);
    for (const Place& place : places_)
        place.axis->apply(u.subspan(place.first, place.coordinates), out,
                          std::span(out.notes).subspan(place.note, place.notes));
    for (std::size_t t = 0; t < model_.terms.size(); ++t)
        if (const auto factor = model_.terms[t].factor) {
            out.lower[t] = all ? out.parameters[*factor] : bounds_[*factor].min;
            out.upper[t] = all ? out.parameters[*factor] : bounds_[*factor].max;
        }
    const double s = scale(u);
    for (double& bound : out.lower) bound = std::min(bound * s, kLargestCoefficient);
    for (double& bound : out.upper) bound = std::min(bound * s, kLargestCoefficient);
}

void SearchSpace::gradient(std::span<const double> u, const Candidate& at, std::span<const double> coefficients,
                           std::span<const double> by_parameter, std::span<const double> by_coefficient,
                           std::span<double> by_u) const {
    std::vector<double> slopes;
    jacobian(u, at, coefficients, slopes);
    gradient(slopes, by_parameter, by_coefficient, by_u);
}

void SearchSpace::gradient(std::span<const double> jacobian, std::span<const double> by_parameter,
                           std::span<const double> by_coefficient, std::span<double> by_u) const {
    std::fill(by_u.begin(), by_u.end(), 0.0);
    const auto add_row = [&](double by) {
        add(by_u, by, jacobian.first(dimension_));
        jacobian = jacobian.subspan(dimension_);
    };
    for (const double by : by_coefficient) add_row(by);
    for (const std::size_t parameter : nonlinear_) add_row(by_parameter[parameter]);
}

void SearchSpace::jacobian(std::span<const double> u, const Candidate& at, std::span<const double> coefficients,
                           std::vector<double>& out) const {
    const std::size_t terms = model_.terms.size();
    const Placed placed{at, coefficients, scale(u)};
    out.assign((terms + model_.parameters.size()) * dimension_, 0.0);
    Slopes slopes(out, rows_, dimension_);
    for (const Place& place : places_)
        place.axis->add_slopes(placed, std::span(at.notes).subspan(place.note, place.notes), place.first, slopes);
    for (std::size_t t = 0; t < terms; ++t) {
        const auto factor = model_.terms[t].factor;
        if (factor && unknowns_ == Unknowns::all) add(slopes.coefficient(t), placed.scale, slopes.parameter(*factor));
        // The scale moves the bounds of every coefficient, and with them the coefficients that stand there.
        if (scaled() && (at_lower(coefficients[t], at.lower[t]) ||
                         (at_upper(coefficients[t], at.upper[t]) && at.upper[t] < kLargestCoefficient)))
            slopes.coefficient(t).back() = coefficients[t] * std::log(scale_.max / scale_.min);
    }
}

bool SearchSpace::is_free(double coefficient, double lower, double upper) {
    return !at_lower(coefficient, lower) && !at_upper(coefficient, upper);
}

std::vector<double> SearchSpace::parameters(std::span<const double> u, std::span<const double> coefficients,
                                            double& scale_out) const {
    std::vector<double> result = candidate(u).parameters;
    scale_out = scale(u);
    std::vector<double> absolute(coefficients.begin(), coefficients.end());
    for (double& c : absolute) c /= scale_out;
    for (const auto& axis : axes_) axis->finish(absolute, result);
    for (std::size_t t = 0; t < model_.terms.size(); ++t)
        if (const auto factor = model_.terms[t].factor)
            result[*factor] = std::clamp(absolute[t], bounds_[*factor].min, bounds_[*factor].max);
    return result;
}

bool SearchSpace::out_of_range(std::span<const double> coefficients) {
    return std::any_of(coefficients.begin(), coefficients.end(),
                       [](double c) { return at_upper(c, kLargestCoefficient); });
}

std::vector<double> SearchSpace::coordinates(const std::vector<double>& parameters, double scale) const {
    std::vector<double> u(dimension_);
    std::size_t first = 0;
    for (const auto& axis : axes_) {
        axis->locate(parameters, std::span(u).subspan(first, axis->dimension()));
        first += axis->dimension();
    }
    if (scaled()) u[first] = std::clamp(std::log(scale / scale_.min) / std::log(scale_.max / scale_.min), 0.0, 1.0);
    return u;
}

std::vector<std::vector<std::size_t>> SearchSpace::blocks() const {
    std::map<std::size_t, std::vector<std::size_t>> lobes;
    std::vector<std::vector<std::size_t>> result;
    std::vector<std::size_t> others;
    std::size_t first = 0;
    for (std::size_t i = 0; i < axes_.size(); ++i) {
        std::vector<std::size_t> own(axes_[i]->dimension());
        std::iota(own.begin(), own.end(), first);
        first += own.size();
        if (lobes_[i]) {
            std::vector<std::size_t>& lobe = lobes[*lobes_[i]];
            lobe.insert(lobe.end(), own.begin(), own.end());
        } else if (own.size() > 1) {
            result.push_back(std::move(own));
        } else {
            others.insert(others.end(), own.begin(), own.end());
        }
    }
    if (scaled()) others.push_back(first);
    for (auto& [lobe, coordinates] : lobes) result.push_back(std::move(coordinates));
    if (!others.empty()) result.push_back(std::move(others));
    return result;
}

std::optional<std::size_t> SearchSpace::lobe(const std::vector<std::size_t>& block) const {
    std::size_t first = 0;
    for (std::size_t i = 0; i < axes_.size(); first += axes_[i++]->dimension()) {
        const std::optional<std::size_t> term = axes_[i]->lobe();
        if (!term || std::find(block.begin(), block.end(), first) == block.end()) continue;
        const Term::Homogeneous& of = *model_.terms[*term].homogeneous;
        if (of.columns && !bounds_[of.degree].fixed()) return term;
    }
    return std::nullopt;
}

std::vector<std::vector<double>> SearchSpace::shaped(const std::vector<double>& u,
                                                     const std::vector<std::size_t>& block,
                                                     std::span<const LobeShape> shapes) const {
    const Term::Homogeneous& of = *model_.terms[lobe(block).value()].homogeneous;
    std::vector<double> parameters = candidate(u).parameters;
    std::vector<std::vector<double>> result(shapes.size(), u);
    for (std::size_t i = 0; i < shapes.size(); ++i) {
        parameters[of.degree] = std::clamp(shapes[i].degree, bounds_[of.degree].min, bounds_[of.degree].max);
        parameters[of.plane.first] = std::cos(shapes[i].psi);
        parameters[of.plane.second] = std::sin(shapes[i].psi);
        const std::vector<double> there = coordinates(parameters, scale(u));
        for (const std::size_t j : block) result[i][j] = there[j];
    }
    return result;
}

std::vector<std::vector<double>> SearchSpace::spikes(const std::vector<double>& u,
                                                     const std::vector<std::size_t>& block, std::size_t most) const {
    const std::optional<std::size_t> term = lobe(block);
    if (seen_ == nullptr || !term) return {};
    const Term::Homogeneous& of = *model_.terms[*term].homogeneous;
    std::vector<double> angles;  // of the samples, in the plane of the lobe's columns
    for (const auto& [a, b] : seen_->points(of.columns->first, of.columns->second)) angles.push_back(std::atan2(b, a));
    std::sort(angles.begin(), angles.end());
    angles.erase(std::unique(angles.begin(), angles.end()), angles.end());
    const std::size_t count = std::min(angles.size(), most);
    std::vector<LobeShape> shapes;
    for (std::size_t k = 0; k < count; ++k)
        shapes.push_back({angles[k * angles.size() / count], bounds_[of.degree].max});
    return shaped(u, block, shapes);
}

std::optional<Strength> SearchSpace::strength() const {
    if (unknowns_ == Unknowns::all || indices_.empty()) return std::nullopt;
    const IndexAxis& index = indices_.front();
    if (index.coordinates.size() != 2) return std::nullopt;
    for (std::size_t t = 0; t < model_.terms.size(); ++t) {
        const Term& term = model_.terms[t];
        const bool depends = std::find(term.of.begin(), term.of.end(), index.n) != term.of.end();
        if (depends && !term.factor && !term.homogeneous)
            return Strength{t, index.coordinates.front(), index.coordinates.back()};
    }
    return std::nullopt;
}

Choices SearchSpace::critical_indices(const std::vector<double>& u, std::size_t most) const {
    // On the side of total reflection, in single precision too: the loss bends there no more than elsewhere, on the
    // other side it goes as a root.
    constexpr double kWithin = 1 - 1e-6;
    constexpr double kSame = 1e-7;
    if (seen_ == nullptr || indices_.empty()) return {};
    const IndexAxis& index = indices_.front();
    if (bounds_[index.k].min > 0 || bounds_[index.n].fixed()) return {};
    const auto columns = kernels::geometry_columns();
    const auto sine2 = static_cast<std::size_t>(
        std::find_if(columns.begin(), columns.end(), [](const auto& c) { return c.name == "sd2"; }) - columns.begin());
    std::vector<double> critical;
    for (const auto& [square, same] : seen_->points(sine2, sine2)) {
        const double n = std::sqrt(square) * kWithin;
        if (n >= bounds_[index.n].min && n <= bounds_[index.n].max) critical.push_back(n);
    }
    std::sort(critical.begin(), critical.end());
    critical.erase(std::unique(critical.begin(), critical.end(), [](double a, double b) { return b - a < kSame; }),
                   critical.end());
    Choices result{index.coordinates, {}};
    std::vector<double> parameters = candidate(u).parameters;
    parameters[index.k] = 0;
    const std::size_t count = std::min(critical.size(), most);
    for (std::size_t i = 0; i < count; ++i) {
        parameters[index.n] = critical[i * critical.size() / count];
        const std::vector<double> there = coordinates(parameters, scale(u));
        result.points.push_back(u);
        for (const std::size_t j : index.coordinates) result.points.back()[j] = there[j];
    }
    return result;
}

std::vector<Interval> SearchSpace::typical() const {
    std::vector<Interval> result;
    for (const auto& axis : axes_)
        for (const Interval& interval : axis->typical()) result.push_back(interval);
    if (scaled()) result.push_back({0.25, 0.75});
    return result;
}

}  // namespace brdfit::optim
