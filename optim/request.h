/// What is asked of a fit: models, with the bounds of their parameters, and options.
#pragma once

#include <chrono>
#include <cstdint>
#include <map>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include "kernels/model.h"
#include "optim/dataset.h"
#include "optim/interval.h"
#include "optim/loss.h"
#include "optim/report.h"
#include "optim/scene.h"
#include "optim/search.h"

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
    RankBy rank_by = RankBy::loss;                 ///< held_out needs judge
    bool ledger = false;                           ///< also what less work would have changed (optim/ledger.h)
    std::optional<Scene> scene{};                  ///< with one, simpler forms of the models are fitted as well
    std::optional<bool> profiled{};                ///< intervals by profiles of the loss; none: if judged

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
/// Parameters that the bounds leave free.
std::size_t free_parameters(const std::vector<Interval>& bounds);

}  // namespace brdfit::optim
