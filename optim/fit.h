/// Fits models to the channels of a dataset.
#pragma once

#include <chrono>
#include <cstdint>
#include <map>
#include <memory>
#include <optional>
#include <stdexcept>
#include <stop_token>
#include <string>
#include <vector>

#include "kernels/engine.h"
#include "kernels/model.h"
#include "optim/dataset.h"
#include "optim/loss.h"
#include "optim/progress.h"
#include "optim/report.h"
#include "optim/scene.h"
#include "optim/search.h"
#include "optim/space.h"

namespace brdfit::optim {

/// A model to fit. Values are in the wire's unit: lengths in um where the channel has a wavelength.
struct ModelRequest {
    const kernels::Family* family = nullptr;
    std::optional<std::size_t> lobes{};  ///< none: as few as the data support ("auto"), or a model without lobes
    std::map<std::string, double> fixed;
    std::map<std::string, Interval> bounds;
    const kernels::Submodel* submodel = nullptr;  ///< of the family; nullptr: the whole model

    /// The model with so many lobes (ignored without lobes).
    [[nodiscard]] const kernels::Model& variant(std::size_t repeats) const {
        return family->variant(repeats, submodel);
    }
    /// The number of lobes from which and up to which the fit goes; 1 and 1 without lobes.
    [[nodiscard]] std::size_t most_lobes() const;
    bool operator==(const ModelRequest&) const = default;
};

/// What fits are sorted and ranked by, each the less the better; those without it come last.
enum class RankBy { loss, aicc, bic, held_out, log10_rmse };

struct FitOptions {
    Criterion loss;
    Effort effort = Effort::standard;
    std::optional<kernels::Precision> precision{};  ///< none: the best that may be used
    std::uint64_t seed = 1;
    std::chrono::duration<double> time_limit{30};  ///< of the whole request
    std::vector<Requirement> require{};            ///< each at most once; a model that cannot meet them is a failure
    bool judge = true;                             ///< also held-out errors, albedo and physics
    std::optional<bool> profiled{};                ///< intervals by profiles of the loss; none: if judged
    RankBy rank_by = RankBy::loss;                 ///< held_out needs judge
    bool ledger = false;                           ///< also what less work would have changed (optim/ledger.h)
    std::optional<Scene> scene{};                  ///< with one, simpler forms of the models are fitted as well

    bool operator==(const FitOptions&) const = default;
};

/// A bound or fixed value outside the parameter's domain, or an empty interval.
class InvalidBounds : public std::invalid_argument {
public:
    InvalidBounds(std::string parameter_in, const std::string& reason)
        : std::invalid_argument(reason), parameter(std::move(parameter_in)) {}
    std::string parameter;
};

/// The values of a parameter that a request may name, in words and in the wire's unit.
std::string domain_rule(const kernels::Parameter& parameter, const Channel& channel);

/// What one unit of the parameter on the wire is in the model's own unit: 1, or 1/wavelength_um.
double to_model_unit(const kernels::Parameter& parameter, const Channel& channel);
/// "1", "um", or "lambda" for a length in a channel without a wavelength.
std::string wire_unit(const kernels::Parameter& parameter, const Channel& channel);
/// Bounds of every parameter in the model's unit: the model's, or the request's where it gives them. Names that this
/// variant lacks are passed over. Throws InvalidBounds.
std::vector<Interval> parameter_bounds(const kernels::Model& model, const ModelRequest& request,
                                       const Channel& channel);
/// Samples a fit of the request's smallest variant needs: its free parameters.
std::size_t samples_needed(const ModelRequest& request, const Channel& channel);

/// Fits on an engine, over channels and models: on a device that runs launches in the calling thread with a pool of
/// threads, one search each; on others with a Broker. Safe to use from several threads; their fits share the workers.
class Fitter {
public:
    /// threads: of the pool, at least one.
    Fitter(kernels::Engine& engine, unsigned threads);
    ~Fitter();
    Fitter(const Fitter&) = delete;
    Fitter& operator=(const Fitter&) = delete;

    /// Builds the programs of all variants of a model and runs each kernel once, so that no fit waits for a compiler.
    /// Throws kernels::PrecisionError, kernels::BuildError, kernels::DeviceError.
    void warm_up(const kernels::Family& family);

    /// Fits every model to every channel. A model that fails is in the report's failures. `progress`: gets a task for
    /// each before the first begins; may be nullptr. Throws std::invalid_argument (see weigh), InvalidBounds and
    /// kernels::PrecisionError.
    Report fit(const Dataset& dataset, const std::vector<ModelRequest>& models, const FitOptions& options,
               std::stop_token stop = {}, Progress* progress = nullptr);

    [[nodiscard]] kernels::Engine& engine() const { return engine_; }
    [[nodiscard]] kernels::CostBook& costs() { return costs_; }

private:
    void warm_up(const kernels::Model& model);
    /// Does so for a submodel with a text of its own, once.
    void warm_up(const ModelRequest& request);

    struct Workers;
    kernels::Engine& engine_;
    kernels::CostBook costs_;
    std::unique_ptr<Workers> workers_;
};

}  // namespace brdfit::optim
