/// The outcome of fitting models to a dataset: plain values, nothing computed here.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "kernels/cost.h"
#include "kernels/engine.h"
#include "optim/dataset.h"
#include "optim/interval.h"
#include "optim/loss.h"
#include "optim/scene.h"

namespace brdfit::optim {

/// Why a search ended.
enum class StopReason {
    converged,         ///< gradient and curvature at the end promise no decrease that counts (optim/stationarity.h)
    evaluation_limit,  ///< the budget was spent first
    time_limit,        ///< options.time_limit_s passed
    roundoff,          ///< a decrease is promised that no step reaches: the point is usable
    cancelled,
};

/// A fitted parameter.
struct FittedParameter {
    std::string name;
    std::string unit;  ///< "1", "um" (or "lambda" for a channel without a wavelength)
    double value = 0;
    std::optional<double> std_error{};  ///< none where the data do not determine it, or it is fixed or at a bound
    bool at_bound = false;
    bool fixed = false;  ///< by the request
    /// Holds the value with 95 % confidence, as far as noise goes; none where std_error is none but for one at a bound.
    std::optional<std::array<double, 2>> interval_95{};
};

/// Where the sizes of the samples' noise come from.
enum class NoiseSource {
    none,       ///< nowhere: too few samples
    residuals,  ///< of each fit itself: scans too sparse, too few or not independent for differences
    given,      ///< sigma in the data
    estimated,  ///< from differences of neighbouring samples
};

/// sigma^2 = floor^2 + (relative y)^2
struct NoiseRecord {
    NoiseSource source = NoiseSource::residuals;
    std::optional<double> relative{};        ///< if estimated
    std::optional<double> floor{};           ///< if estimated, [1/sr]
    std::optional<double> relative_error{};  ///< standard error of sigma as a part of it
};

/// Errors over the samples of one incidence angle.
struct ScanError {
    double theta_i_deg = 0;
    double rmse = 0;                     ///< [1/sr]
    std::optional<double> log10_rmse{};  ///< decades, over samples with y > 0 and f > 0; none if there are none
};

/// Errors at samples of incidence angles that the fit has not seen.
struct HeldOut {
    double rmse = 0;                     ///< [1/sr]
    std::optional<double> log10_rmse{};  ///< decades
    double loss = 0;                     ///< as of the fit, over all folds
    std::vector<ScanError> angles;
};

/// Another minimum that the search has met.
struct Rival {
    double loss = 0;
    std::size_t agreed = 0;  ///< descents that ended within 1e-3 of that loss
    std::vector<std::pair<std::string, double>> parameters;
};

/// Of the estimates of the parameters that have a standard error; logarithmic ones by their logarithm.
struct Correlations {
    std::vector<std::string> names;
    std::vector<double> matrix;  ///< by rows
};

/// Less than a fit was given.
enum class LessWork {
    single_precision,
    draft,
    standard,
    stop_after_screening,
    stop_after_descents,
    stop_after_exchange
};

/// What a search had found when it might have stopped.
struct Milestone {
    LessWork stop{};
    double relative_loss2 = 0;    ///< at full accuracy; loss^2 over that of f = 0, for `log` loss^2
    std::size_t evaluations = 0;  ///< until then
};

struct SearchRecord {
    std::size_t starts = 0;       ///< independent local searches
    std::size_t agreed = 0;       ///< those that ended within 1e-3 of the best loss
    std::size_t evaluations = 0;  ///< candidates evaluated, all phases
    StopReason stop_reason = StopReason::converged;
    double time_s = 0;
    std::vector<Rival> rivals{};          ///< best first, a few
    std::vector<Milestone> milestones{};  ///< where SearchControl asks for them
};

/// What less work would have made of a fit.
struct LedgerLine {
    LessWork change{};
    std::optional<double> loss_ratio{};  ///< over the fit's loss; none if only that is 0
    std::size_t evaluations = 0;
    std::optional<double> time_s{};      ///< none for an earlier stop
    std::optional<std::size_t> lobes{};  ///< where it ends with another number of lobes
    struct Shift {
        std::string parameter;
        std::optional<double> std_errors{};  ///< the shift in units of the fit's standard error
        std::optional<double> relative{};    ///< ... and of the parameter; none if that is 0
    };
    std::optional<Shift> largest_shift{};  ///< in standard errors; none for an earlier stop, or for other parameters
};

/// Samples that a robust loss has taken most of the weight from: they keep less than a tenth.
struct Outliers {
    std::vector<std::size_t> samples;  ///< their places in the channel, rising
    double fraction = 0;               ///< of the samples that have a weight
};

/// What a fit may be required to keep to.
enum class Requirement { energy_conserving, reciprocal, nonnegative };

/// What a requirement costs.
struct Constrained {
    std::vector<Requirement> require;
    double loss_without = 0;  ///< of the best fit without the requirement
    bool binding = false;     ///< that fit does not meet it
};

/// The directional albedo of a fitted model: the integral of f cos theta_r over the exitant hemisphere.
struct DirectionalAlbedo {
    double theta_i_deg = 0;
    std::optional<double> value{};  ///< none where it could not be computed within optim::kAlbedoTolerance
    double error = 0;               ///< estimated; infinite without a value
};

/// What nature allows, and whether a fitted model keeps to it.
struct Physics {
    std::optional<bool> energy_conserving{};  ///< no albedo above 1; none where that could not be told
    /// The incidence angles over which energy is judged: from 0 to 89 degrees (further where the data go further), of
    /// those what a scene sees.
    Interval theta_i_deg{0, 89};
    /// The largest albedo over them, and where it is; none where it could not be computed within its tolerance.
    std::optional<double> max_albedo{};
    std::optional<double> at_theta_i_deg{};
    bool reciprocal = true;   ///< f(u, v) = f(v, u), as measured over a set of directions
    bool nonnegative = true;  ///< at every direction looked at
};

/// One model fitted to one channel.
struct Fit {
    std::size_t rank = 0;  ///< from 1, by FitOptions::rank_by
    std::string model;
    std::size_t lobes = 0;  ///< of a model with lobes, else 0
    std::string submodel;   ///< the name of a simpler form; empty for the whole model
    std::vector<FittedParameter> parameters;
    std::optional<double> scale{};  ///< relative data: measured = scale * f
    double loss = 0;
    double relative_loss = 0;
    double rmse = 0;                     ///< [1/sr], unweighted
    std::optional<double> log10_rmse{};  ///< decades
    std::optional<double> aicc{};        ///< none with too few samples for the correction
    double bic = 0;
    std::vector<ScanError> scans;
    std::optional<Outliers> outliers{};     ///< of a robust loss
    std::vector<DirectionalAlbedo> albedo;  ///< at the incidence angles of the data; empty where it was not asked for
    std::optional<Physics> physics{};       ///< likewise
    std::optional<Constrained> constrained{};  ///< of a request with requirements, which the fit meets
    std::optional<kernels::Cost> cost{};  ///< of an evaluation on this device; none where judging was not asked for
    std::optional<HeldOut> held_out{};    ///< none with fewer than two incidence angles, or not asked for
    Correlations correlations;
    std::size_t replicates = 0;  ///< of the bootstrap that made the intervals; 0: made from the covariance
    SearchRecord search;
    std::vector<LedgerLine> ledger;  ///< empty where it was not asked for
    std::size_t form = 0;            ///< its place among the models and forms that were fitted
    std::vector<std::string> warnings;
    /// The model at the reported parameters, times scale: what the plots draw and the errors measure.
    std::vector<double> values;  ///< at each sample of the channel
    struct Curve {
        double theta_i_deg = 0;
        std::vector<double> theta_r_deg;  ///< dense and rising, in the plane of incidence
        std::vector<double> brdf;         ///< same length
    };
    std::vector<Curve> curves;  ///< one for each incidence angle with samples in the plane of incidence
};

struct Failure {
    std::string model;
    std::string reason;      ///< for the user
    std::string detail;      ///< for the log: may hold a driver's words
    std::string submodel{};  ///< as in Fit
};

struct ChannelReport {
    Channel channel;        ///< the measurements, as fitted
    std::vector<Fit> fits;  ///< best first
    std::vector<Failure> failures;
    std::vector<std::string> warnings{};
    std::vector<ParetoPoint> pareto{};            ///< cheapest first
    std::optional<Recommendation> recommended{};  ///< none where it was not asked for
    /// Of a robust loss: size of the best model's ordinary residuals, in the loss's unit; the same for all fits.
    std::optional<double> robust_scale{};
    NoiseRecord noise{};
};

struct Report {
    std::string dataset;  ///< its name
    Unit unit = Unit::per_steradian;
    std::uint64_t seed = 0;
    kernels::DeviceInfo device;
    kernels::Precision precision = kernels::Precision::double_precision;
    std::vector<ChannelReport> channels;
    Criterion loss{};
    std::optional<Scene> scene{};  ///< that was asked for
};

}  // namespace brdfit::optim
