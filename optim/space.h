/// The coordinates a search moves in: a unit cube over the nonlinear parameters of a model.
#pragma once

#include <cstddef>
#include <memory>
#include <optional>
#include <span>
#include <vector>

#include "kernels/evaluator.h"
#include "kernels/model.h"
#include "optim/interval.h"

namespace brdfit::optim {

/// A point of the cube as the evaluator takes it.
struct Candidate {
    std::vector<double> parameters;  ///< P; linear ones 0 with Unknowns::nonlinear
    std::vector<double> lower;       ///< T: bounds of the linear coefficients; equal to upper with Unknowns::all
    std::vector<double> upper;
    std::vector<double> notes;  ///< what the space needs of u for slopes there
};

/// The data are `scale` times what the model speaks of, and so are coefficients: one value where it is known, a range
/// where it is one more unknown.
struct ScaleRange {
    double min = 1;
    double max = 1;
};

/// A lobe but for its height.
struct LobeShape {
    double psi;     ///< of its direction in the plane of its pair [rad]
    double degree;  ///< clamped to its bounds
};

/// Points that differ from one another in some coordinates only.
struct Choices {
    std::vector<std::size_t> coordinates;
    std::vector<std::vector<double>> points;
};

/// A term whose strength is nearly the square of one coordinate, and whose shape another one tells.
struct Strength {
    std::size_t term;
    std::size_t coordinate;
    std::size_t shape;
};

/// One coordinate or two of the cube.
class Axis;

/// Which parameters a space holds.
enum class Unknowns {
    nonlinear,  ///< the linear coefficients are solved for (Evaluator::project)
    all,        ///< Evaluator::loss: for losses that are not quadratic in the coefficients
};

/// Whether a model's charts are coordinates. They lead a search well, but where their rays touch the bounds they bend
/// without limit: the last steps are taken in the parameters themselves.
enum class Charts {
    used,
    passed_over,  ///< of pairs of parameters; homogeneous terms keep theirs
    none,         ///< the parameters themselves throughout
};

/// Maps u in [0, 1]^d to candidates. Parameters with a logarithmic scale are even in their logarithm; a complex index
/// is seen in polar coordinates of (N-1)/(N+1); a homogeneous term's pair of parameters is seen as an angle and a
/// height, and the height is a linear coefficient or a coordinate as well. Both charts are used only where the bounds
/// leave them whole.
class SearchSpace {
public:
    /// bounds: one for each parameter of the model. seen: the samples' directions, which must outlive it, by which a
    /// lobe's height is that of its highest value there. level > 0, with Unknowns::all: coefficients and heights are
    /// even below it, and above in their logarithm.
    SearchSpace(const kernels::Model& model, std::vector<Interval> bounds, Unknowns unknowns = Unknowns::nonlinear,
                ScaleRange scale = {}, double level = 1, Charts charts = Charts::used,
                const kernels::DirectionSet* seen = nullptr);
    ~SearchSpace();
    SearchSpace(SearchSpace&&) noexcept;

    [[nodiscard]] const kernels::Model& model() const { return model_; }
    [[nodiscard]] std::size_t dimension() const { return dimension_; }
    /// Nonlinear parameters of the model, Q.
    [[nodiscard]] std::size_t nonlinear() const { return nonlinear_.size(); }
    [[nodiscard]] Unknowns unknowns() const { return unknowns_; }
    [[nodiscard]] Candidate candidate(std::span<const double> u) const;
    /// The same, in memory that may have held another.
    void place(std::span<const double> u, Candidate& out) const;
    /// d loss/d u from the loss's derivatives at the candidate of u and its coefficients c: by_parameter (P),
    /// by_coefficient (T; what a coefficient held at a bound would gain).
    void gradient(std::span<const double> u, const Candidate& at, std::span<const double> coefficients,
                  std::span<const double> by_parameter, std::span<const double> by_coefficient,
                  std::span<double> by_u) const;
    /// d (c, nonlinear parameters)/d u, (T + Q) x d, in the order of kernels::Batch::normal: of coefficients what their
    /// bounds move where they stand on them. More rows, of the other parameters, may follow.
    void jacobian(std::span<const double> u, const Candidate& at, std::span<const double> coefficients,
                  std::vector<double>& out) const;
    /// The gradient as above, by that Jacobian.
    void gradient(std::span<const double> jacobian, std::span<const double> by_parameter,
                  std::span<const double> by_coefficient, std::span<double> by_u) const;
    /// Whether the coefficient lies between its bounds, where the evaluator chooses it.
    [[nodiscard]] static bool is_free(double coefficient, double lower, double upper);
    /// The model's parameters at u and c, within their bounds, and the scale.
    [[nodiscard]] std::vector<double> parameters(std::span<const double> u, std::span<const double> coefficients,
                                                 double& scale) const;
    /// A coefficient stands at the end of what is searched (1e100), which is no bound of its parameters.
    [[nodiscard]] static bool out_of_range(std::span<const double> coefficients);
    /// A point whose candidate has (nearly) these parameters, clamped into the cube.
    [[nodiscard]] std::vector<double> coordinates(const std::vector<double>& parameters, double scale) const;
    /// Where starts should lie: [min, max] within [0, 1], one for each coordinate.
    [[nodiscard]] std::vector<Interval> typical() const;
    /// Coordinates that belong together: those of each lobe, of each chart, and the others. They partition the cube's.
    [[nodiscard]] std::vector<std::vector<std::size_t>> blocks() const;
    /// The point with the lobe whose coordinates these are in the shape of a spike: of the largest exponent, towards a
    /// sample; one point each of up to `most` samples, evenly chosen. None for other coordinates, or where no samples
    /// are known.
    [[nodiscard]] std::vector<std::vector<double>> spikes(const std::vector<double>& u,
                                                          const std::vector<std::size_t>& block,
                                                          std::size_t most) const;
    /// The homogeneous term whose degree and direction these coordinates hold, where it has columns; none for others.
    [[nodiscard]] std::optional<std::size_t> lobe(const std::vector<std::size_t>& block) const;
    /// The points with the lobe of these coordinates in each of the shapes.
    [[nodiscard]] std::vector<std::vector<double>> shaped(const std::vector<double>& u,
                                                          const std::vector<std::size_t>& block,
                                                          std::span<const LobeShape> shapes) const;
    /// The term without a coefficient that a chart's rho = r e^(i phi) makes: its strength is r^2, its shape phi's.
    /// None if there is no such, or with Unknowns::all.
    [[nodiscard]] std::optional<Strength> strength() const;
    /// The point with each real index n < 1 beyond which one more of the samples is reflected totally: the loss has a
    /// kink there. Up to `most`, evenly chosen; none where no index is searched that may be so, or no samples are
    /// known.
    [[nodiscard]] Choices critical_indices(const std::vector<double>& u, std::size_t most) const;
    [[nodiscard]] const std::vector<Interval>& bounds() const { return bounds_; }

private:
    [[nodiscard]] bool scaled() const { return scale_.min < scale_.max; }
    /// The scale at u: the last coordinate, even in its logarithm; 1 for absolute data.
    [[nodiscard]] double scale(std::span<const double> u) const;
    const kernels::Model& model_;
    const kernels::DirectionSet* seen_;
    std::vector<std::size_t> nonlinear_;
    std::vector<Interval> bounds_;
    Unknowns unknowns_;
    ScaleRange scale_;
    std::vector<std::unique_ptr<Axis>> axes_;
    std::vector<std::optional<std::size_t>> lobes_;  ///< of each axis
    /// An axis, its coordinates and its notes among all.
    struct Place {
        const Axis* axis;
        std::size_t first, coordinates, note, notes;
    };
    /// A complex index, and the coordinates that move it.
    struct IndexAxis {
        std::size_t n, k;
        std::vector<std::size_t> coordinates;
    };
    std::vector<IndexAxis> indices_;
    std::vector<Place> places_;
    std::vector<std::size_t> rows_;  ///< of each parameter among the slopes
    std::vector<double> held_;       ///< parameters before any axis has set its own
    std::size_t dimension_ = 0;
    std::size_t notes_ = 0;
};

}  // namespace brdfit::optim
