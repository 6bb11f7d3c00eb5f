/// A model on a set of samples: batches of candidate parameters in, losses, gradients and values out.
#pragma once

#include <memory>
#include <span>
#include <utility>
#include <vector>

#include "kernels/engine.h"
#include "kernels/geometry.h"
#include "kernels/model.h"

namespace brdfit::kernels {

/// Directions with the numbers that kernels read of them, formed once a precision and shared by copies and evaluators.
/// Safe to use from several threads.
class DirectionSet {
public:
    DirectionSet(std::vector<Direction> directions);  // NOLINT(google-explicit-constructor): it is a list of directions
    [[nodiscard]] std::span<const Direction> directions() const;
    /// The corners of the smallest convex polygon about the points (a, b) of two geometry columns, given by their
    /// places in geometry_columns(); of many directions about 4000 are looked at.
    [[nodiscard]] std::vector<std::pair<double, double>> hull(std::size_t a, std::size_t b) const;

    /// The same points themselves, of many directions about 4000, in the directions' order.
    [[nodiscard]] std::vector<std::pair<double, double>> points(std::size_t a, std::size_t b) const;

    struct Impl;
    [[nodiscard]] Impl& impl() const { return *impl_; }

private:
    std::shared_ptr<Impl> impl_;
};

/// What one launch returns for a batch of B candidates of a model with P parameters, T terms and Q nonlinear
/// parameters.
struct Batch {
    std::vector<double> loss;            ///< B: sum of w r^2
    std::vector<double> coefficients;    ///< B x T: the linear coefficients c
    std::vector<double> by_coefficient;  ///< B x T: d loss/d c (0 where c is free between its bounds)
    std::vector<double> by_parameter;    ///< B x P: d loss/d parameter at those c; 0 for linear parameters
    /// B x U(U+1)/2, U = T + Q: upper triangles of sum w J'J, J = d r/d (c, nonlinear parameters in rising order)
    std::vector<double> normal;
};

/// f of one candidate at each direction, and on request df/dp, P x directions.
struct Values {
    std::vector<double> f;
    std::vector<double> by_parameter;
};

/// Owns its queue, kernels and device buffers. Not for two threads at once; use one each. Where the calling thread has
/// a Waiter (kernels/waiting.h), a launch is left to it to wait for; else it blocks.
class Evaluator {
public:
    /// Residuals are r = f - y, with weight w >= 0; all three have one entry a sample. For `loss` with `logarithmic`
    /// y is ln of the measured value. Throws PrecisionError, BuildError, DeviceError.
    Evaluator(Engine& engine, const Model& model, Precision precision, const DirectionSet& directions,
              std::span<const double> y, std::span<const double> w, Accuracy accuracy = Accuracy::full);
    ~Evaluator();
    Evaluator(Evaluator&&) noexcept;
    Evaluator& operator=(Evaluator&&) noexcept;

    /// For each candidate the coefficients within [lower, upper] (B x T) that minimise the loss, and the loss there.
    /// parameters: B x P, linear ones ignored. Without `gradient` there are no derivatives. Throws DeviceError.
    void project(std::span<const double> parameters, std::span<const double> lower, std::span<const double> upper,
                 bool gradient, Batch& out);
    /// The loss at given coefficients (B x T). logarithmic: r = ln f - y. Throws DeviceError.
    void loss(std::span<const double> parameters, std::span<const double> coefficients, bool logarithmic, Batch& out);
    /// Every term and its slopes at every sample: B x V x samples, V = Model::term_values(), in the order of Terms.
    /// Throws DeviceError.
    [[nodiscard]] std::vector<double> terms(std::span<const double> parameters);
    /// f = sum_t c_t phi_t [1/sr] of one candidate at each sample, and on request df/dp. Throws DeviceError.
    [[nodiscard]] Values values(const std::vector<double>& parameters, bool gradient);
    /// Other data for what follows, as many as before. Throws DeviceError.
    void assign(std::span<const double> y, std::span<const double> w);

    [[nodiscard]] const Model& model() const;
    [[nodiscard]] std::size_t samples() const;

private:
    struct Impl;
    std::unique_ptr<Impl> impl_;
};

/// Evaluator::values without data.
Values evaluate(Engine& engine, const Model& model, Precision precision, const std::vector<double>& parameters,
                const DirectionSet& directions, bool gradient);

}  // namespace brdfit::kernels
