#include "api/request.h"

#include <charconv>
#include <set>

#include <fmt/format.h>
#include <boost/algorithm/string/split.hpp>

#include "api/csv.h"
#include "api/field.h"
#include "api/json.h"
#include "api/samples.h"

namespace brdfit::api {
namespace {

using nlohmann::json;
using optim::Channel;
using optim::Dataset;
using optim::FitOptions;
using optim::Interval;
using optim::ModelRequest;
using optim::Sample;
using optim::Scene;

constexpr double kLargestSeed = 9007199254740991;  // 2^53 - 1: exact in every JSON parser
constexpr double kLongestTime_s = 3600;
constexpr std::size_t kMostModels = 50;
constexpr std::string_view kSceneKeys = "scene.";  // members of the scene in a query
constexpr std::string_view kRequireKey = "require";

// ---- options ----

void read_seed(const json& value, const Place& place, FitOptions& out) {
    const auto number = read_number(value, place);
    if (!number) return;
    if (*number < 0 || *number > kLargestSeed || *number != std::floor(*number))
        place.fail("out_of_range", "must be a whole number from 0 to 2^53 - 1");
    else out.seed = static_cast<std::uint64_t>(*number);
}

void read_time_limit(const json& value, const Place& place, FitOptions& out) {
    const auto number = read_number(value, place);
    if (!number) return;
    if (!(*number > 0 && *number <= kLongestTime_s)) place.fail("out_of_range", "must lie in (0, 3600]");
    else out.time_limit = std::chrono::duration<double>(*number);
}

std::optional<std::string> bad_exponent(double value) {
    if (std::abs(value) <= optim::kSteepestCosine) return std::nullopt;
    return fmt::format("must lie in [-{0:g}, {0:g}]", optim::kSteepestCosine);
}

std::optional<std::string> bad_threshold(double value) {
    if (value >= optim::kLeastThreshold && value <= optim::kMostThreshold) return std::nullopt;
    return fmt::format("must lie in [{:g}, {:g}]", optim::kLeastThreshold, optim::kMostThreshold);
}

/// Keys that check_together names as well.
constexpr std::string_view kLossKey = "loss";
constexpr std::string_view kExponentIKey = "cos_theta_i_exponent";
constexpr std::string_view kExponentRKey = "cos_theta_r_exponent";
constexpr std::string_view kThresholdKey = "robust_threshold";

void read_require(const json& value, const Place& place, FitOptions& out) {
    if (!value.is_array()) return place.fail("wrong_type", "must be an array of: " + names_of(kRequirements));
    for (std::size_t i = 0; i < value.size(); ++i) {
        const auto requirement = read_choice(value[i], place.at(i), kRequirements);
        if (!requirement) continue;
        if (std::find(value.begin(), value.end(), value[i]) != value.begin() + static_cast<std::ptrdiff_t>(i))
            place.at(i).fail("duplicate", "is required twice");
        else if (std::find(out.require.begin(), out.require.end(), *requirement) == out.require.end())
            out.require.push_back(*requirement);  // options and scene may both ask for it
    }
}

Field<FitOptions> switch_field(std::string_view key, std::string_view doc, bool FitOptions::*option) {
    return {key, false, doc, [=](const json& value, const Place& place, FitOptions& out) {
                if (!value.is_boolean()) place.fail("wrong_type", "must be true or false");
                else out.*option = value.get<bool>();
            }};
}

const std::vector<Field<FitOptions>> kOptionFields{
    {kLossKey, false, "what is minimised",
     [](const json& v, const Place& p, FitOptions& out) {
         if (const auto loss = read_choice(v, p, kLosses)) out.loss.kind = *loss;
     }},
    {kExponentIKey, false, "of the loss cosine: a in cos(theta_i)^a; 0 if absent",
     [](const json& v, const Place& p, FitOptions& out) {
         out.loss.cos_theta_i_exponent = read_checked(v, p, bad_exponent);
     }},
    {kExponentRKey, false, "of the loss cosine: b in cos(theta_r)^b; 1 if absent",
     [](const json& v, const Place& p, FitOptions& out) {
         out.loss.cos_theta_r_exponent = read_checked(v, p, bad_exponent);
     }},
    {"robust", false, "what takes the place of the loss's squares, against outliers",
     [](const json& v, const Place& p, FitOptions& out) {
         if (const auto robust = read_choice(v, p, kRobusts)) out.loss.robust = *robust;
     }},
    {kThresholdKey, false, "of a robust loss, in robust standard deviations; 1.345 for huber, 2.385 for cauchy",
     [](const json& v, const Place& p, FitOptions& out) {
         out.loss.robust_threshold = read_checked(v, p, bad_threshold);
     }},
    {"effort", false, "how much the search may spend",
     [](const json& v, const Place& p, FitOptions& out) {
         if (const auto effort = read_choice(v, p, kEfforts)) out.effort = *effort;
     }},
    {"precision", false, "arithmetic of the search; auto: the best the device has",
     [](const json& v, const Place& p, FitOptions& out) { out.precision = read_precision(v, p); }},
    {"seed", false, "of the starts; the same seed gives the same result", read_seed},
    {"time_limit_s", false, "of the whole request, in seconds", read_time_limit},
    {kRequireKey, false, "what a fit must keep to", read_require},
    switch_field("judge", "also held-out errors, albedo and physics", &FitOptions::judge),
    switch_field("ledger", "also what single precision, less effort and earlier stops would have changed",
                 &FitOptions::ledger),
};

// ---- scene ----

constexpr double kLargestTolerance_log10 = 10;

Field<FitOptions> angles_field(std::string_view key, std::string_view doc, Interval Scene::*angles) {
    return {key, false, doc, [=](const json& v, const Place& p, FitOptions& out) {
                if (!v.is_array() || v.size() != 2 || !v[0].is_number() || !v[1].is_number())
                    return p.fail("wrong_type", "must be [low, high]");
                const Interval interval{v[0].get<double>(), v[1].get<double>()};
                if (!(0 <= interval.min && interval.min <= interval.max && interval.max <= 90))
                    return p.fail("out_of_range", "must be 0 <= low <= high <= 90");
                (*out.scene).*angles = interval;
            }};
}

const std::vector<Field<FitOptions>> kSceneFields{
    angles_field("theta_i_deg", "incidence angles that the scene sees, [low, high]", &Scene::theta_i_deg),
    angles_field("theta_r_deg", "exitant angles that the scene sees, without sign, [low, high]", &Scene::theta_r_deg),
    {"outside_weight", false, "weight of a sample outside, where one within has 1; 0: left out",
     [](const json& v, const Place& p, FitOptions& out) {
         const auto number = read_number(v, p);
         if (!number) return;
         if (!(*number >= 0 && *number < 1)) p.fail("out_of_range", "must lie in [0, 1)");
         else out.scene->outside_weight = *number;
     }},
    {"tolerance_log10", false, "the largest root mean square error that is good enough, in decades",
     [](const json& v, const Place& p, FitOptions& out) {
         const auto number = read_number(v, p);
         if (!number) return;
         if (!(*number > 0 && *number <= kLargestTolerance_log10)) p.fail("out_of_range", "must lie in (0, 10]");
         else out.scene->tolerance_log10 = *number;
     }},
    {"max_ns_per_evaluation", false, "the most that an evaluation may cost on this device, in nanoseconds",
     [](const json& v, const Place& p, FitOptions& out) {
         const auto number = read_number(v, p);
         if (!number) return;
         if (!(*number > 0)) p.fail("out_of_range", "must be above 0");
         else out.scene->max_ns_per_evaluation = *number;
     }},
    {kRequireKey, false, "what a fit must keep to, as options.require", read_require},
};

// ---- models ----

/// A model before its family is known to exist.
struct RawModel {
    std::string name;
    const json* lobes = nullptr;
    const json* submodel = nullptr;
    const json* fixed = nullptr;
    const json* bounds = nullptr;
};

const std::vector<Field<RawModel>> kModelFields{
    {"name", true, "the model's name",
     [](const json& v, const Place& p, RawModel& out) { out.name = read_text(v, p).value_or(""); }},
    {"lobes", false, "number of lobes, or \"auto\"",
     [](const json& v, const Place&, RawModel& out) { out.lobes = &v; }},
    {"submodel", false, "a simpler form of the model, by its name",
     [](const json& v, const Place&, RawModel& out) { out.submodel = &v; }},
    {"fixed", false, "parameters held at a value", [](const json& v, const Place&, RawModel& out) { out.fixed = &v; }},
    {"bounds", false, "parameters kept within [low, high]",
     [](const json& v, const Place&, RawModel& out) { out.bounds = &v; }},
};

/// Calls read for every member that names a parameter of the model.
template <class Read>
void read_parameters(const json* object, const Place& place, const ModelRequest& request, const Read& read) {
    if (object == nullptr) return;
    if (!object->is_object()) {
        place.fail("wrong_type", "must be an object");
        return;
    }
    const kernels::Model& model = request.variant(request.most_lobes());
    for (const auto& [name, value] : object->items())
        if (is_parameter(place, model, name)) read(name, value, place.at(name));
}

/// nullptr after an error.
const kernels::Submodel* read_submodel(const json& value, const Place& place, const kernels::Family& family) {
    const auto name = read_text(value, place);
    if (!name) return nullptr;
    const kernels::Submodel* submodel = family.submodel(*name);
    if (submodel != nullptr) return submodel;
    std::string names;
    for (const kernels::Submodel& s : family.submodels) names += (names.empty() ? "" : ", ") + s.name;
    place.fail("unknown_value",
               names.empty() ? "the model " + family.name + " has no simpler forms" : "must be one of: " + names);
    return nullptr;
}

std::optional<ModelRequest> read_model(const json& value, const Place& place, const kernels::Catalogue& catalogue) {
    RawModel raw;
    const Place name_place = value.is_object() ? place.at("name") : place;
    if (value.is_string()) raw.name = value.get<std::string>();
    else {
        if (!value.is_object()) {
            place.fail("wrong_type", "must be a model's name or an object");
            return std::nullopt;
        }
        read_object<RawModel>(value, place, kModelFields, raw);
        if (!value.contains("name") || !value["name"].is_string()) return std::nullopt;
    }
    ModelRequest request;
    request.family = catalogue.find(raw.name);
    if (request.family == nullptr) {
        name_place.fail("unknown_model", "unknown model; valid are: " + catalogue.names());
        return std::nullopt;
    }
    if (raw.lobes != nullptr && !is_auto(*raw.lobes))
        request.lobes = read_lobes(*raw.lobes, place.at("lobes"), *request.family);
    if (raw.submodel != nullptr) request.submodel = read_submodel(*raw.submodel, place.at("submodel"), *request.family);
    const auto is_held = [&](const std::string& name, const Place& p) {
        const bool held = request.submodel != nullptr && request.submodel->fixed.count(name) != 0;
        if (held) p.fail("contradiction", "the submodel " + request.submodel->name + " holds the parameter");
        return held;
    };
    read_parameters(raw.fixed, place.at("fixed"), request, [&](const std::string& name, const json& v, const Place& p) {
        if (const auto number = read_number(v, p); number && !is_held(name, p)) request.fixed[name] = *number;
    });
    read_parameters(raw.bounds, place.at("bounds"), request,
                    [&](const std::string& name, const json& v, const Place& p) {
                        if (!v.is_array() || v.size() != 2 || !v[0].is_number() || !v[1].is_number())
                            p.fail("wrong_type", "must be [low, high]");
                        else if (!(v[0].get<double>() < v[1].get<double>()))
                            p.fail("out_of_range", "low must be below high; to hold a parameter use \"fixed\"");
                        else if (request.fixed.count(name) != 0)
                            p.fail("contradiction", "the parameter is fixed as well");
                        else if (!is_held(name, p))
                            request.bounds[name] = Interval{v[0].get<double>(), v[1].get<double>()};
                    });
    return request;
}

void read_models(const json& value, const Place& place, const kernels::Catalogue& catalogue,
                 std::vector<ModelRequest>& out) {
    if (!value.is_array() || value.empty() || value.size() > kMostModels) {
        place.fail("wrong_type", "must be an array of 1 to " + std::to_string(kMostModels) +
                                     " models; valid are: " + catalogue.names());
        return;
    }
    for (std::size_t i = 0; i < value.size(); ++i)
        if (auto model = read_model(value[i], place.at(i), catalogue)) out.push_back(std::move(*model));
}

// ---- dataset ----

/// Columns of a scan or of free samples, before they become samples.
struct Columns {
    std::optional<double> scan_theta_i;
    std::vector<double> theta_i, phi_i, theta_r, phi_r, brdf, sigma;
    bool has_phi_i = false;
    bool has_sigma = false;
};

Field<Columns> column_field(std::string_view key, bool required, std::string_view doc,
                            std::vector<double> Columns::*column, Check bad) {
    return {key, required, doc,
            [=](const json& v, const Place& p, Columns& out) { out.*column = read_column(v, p, bad); }};
}

Field<Columns> sigma_field() {
    return {"sigma", false, "standard deviation of brdf, same unit", [](const json& v, const Place& p, Columns& out) {
                out.sigma = read_column(v, p, bad_sigma);
                out.has_sigma = true;
            }};
}

const std::vector<Field<Columns>> kScanFields{
    {"theta_i_deg", true, "incidence angle",
     [](const json& v, const Place& p, Columns& out) { out.scan_theta_i = read_checked(v, p, bad_theta_i); }},
    column_field("theta_r_deg", true, "exitant angles, signed: positive = specular side", &Columns::theta_r,
                 bad_theta_r),
    column_field("brdf", true, "BRDF values", &Columns::brdf, bad_brdf),
    sigma_field(),
};

const std::vector<Field<Columns>> kSamplesFields{
    column_field("theta_i_deg", true, "incidence angles", &Columns::theta_i, bad_theta_i),
    {"phi_i_deg", false, "azimuths of incidence; 0 if absent",
     [](const json& v, const Place& p, Columns& out) {
         out.phi_i = read_column(v, p, bad_phi);
         out.has_phi_i = true;
     }},
    column_field("theta_r_deg", true, "exitant angles", &Columns::theta_r, bad_theta_r),
    column_field("phi_r_deg", true, "exitant azimuths: phi_r - phi_i = 180 is the specular side", &Columns::phi_r,
                 bad_phi),
    column_field("brdf", true, "BRDF values", &Columns::brdf, bad_brdf),
    sigma_field(),
};

void append_scan(const json& value, const Place& place, Channel& out) {
    Columns columns;
    read_object<Columns>(value, place, kScanFields, columns);
    const std::size_t n = columns.theta_r.size();
    if (!value.is_object() || !value.contains("brdf") || !value.contains("theta_r_deg")) return;
    if (n == 0) place.at("theta_r_deg").fail("empty", "must have at least one element");
    bool whole = same_length(place, "brdf", columns.brdf.size(), n);
    if (columns.has_sigma) whole = same_length(place, "sigma", columns.sigma.size(), n) && whole;
    if (!whole || !columns.scan_theta_i) return;
    for (std::size_t j = 0; j < n; ++j) {
        Sample sample{{*columns.scan_theta_i, columns.theta_r[j], 0}, columns.brdf[j], {}};
        if (columns.has_sigma) sample.sigma = columns.sigma[j];
        out.samples.push_back(sample);
    }
}

void append_samples(const json& value, const Place& place, Channel& out) {
    Columns columns;
    read_object<Columns>(value, place, kSamplesFields, columns);
    if (!value.is_object() || !value.contains("theta_r_deg")) return;
    const std::size_t n = columns.theta_r.size();
    if (n == 0) place.at("theta_r_deg").fail("empty", "must have at least one element");
    bool whole = true;
    for (const auto& [key, column] :
         {std::pair{"theta_i_deg", &columns.theta_i}, std::pair{"phi_i_deg", &columns.phi_i},
          std::pair{"phi_r_deg", &columns.phi_r}, std::pair{"brdf", &columns.brdf}, std::pair{"sigma", &columns.sigma}})
        if (value.contains(key)) whole = same_length(place, key, column->size(), n) && whole;
        else if (std::string_view(key) != "phi_i_deg" && std::string_view(key) != "sigma") whole = false;
    if (!whole) return;
    const bool has_sign = std::any_of(columns.theta_r.begin(), columns.theta_r.end(), [](double t) { return t < 0; });
    for (std::size_t j = 0; j < n; ++j) {
        const auto direction =
            direction_of(columns.theta_i[j], columns.theta_r[j], columns.has_phi_i ? columns.phi_i[j] : 0.0,
                         columns.phi_r[j], has_sign ? Signs::meaningful : Signs::absent);
        if (!direction) {
            place.at("theta_r_deg")
                .at(j)
                .fail("contradiction",
                      "the sign (positive = specular side) contradicts phi_r - phi_i "
                      "(180 = specular side)");
            continue;
        }
        Sample sample{*direction, columns.brdf[j], {}};
        if (columns.has_sigma) sample.sigma = columns.sigma[j];
        out.samples.push_back(sample);
    }
}

const std::vector<Field<Channel>> kChannelFields{
    {"name", false, "name; the wavelength or the position if absent",
     [](const json& v, const Place& p, Channel& out) { out.name = read_text(v, p).value_or(""); }},
    {"wavelength_nm", false, "wavelength",
     [](const json& v, const Place& p, Channel& out) { out.wavelength_nm = read_checked(v, p, bad_wavelength); }},
    {"scans", false, "scans in the plane of incidence",
     [](const json& v, const Place& p, Channel& out) {
         if (!v.is_array()) return p.fail("wrong_type", "must be an array");
         for (std::size_t i = 0; i < v.size(); ++i) append_scan(v[i], p.at(i), out);
     }},
    {"samples", false, "samples in any direction, as columns", append_samples},
};

void read_channels(const json& value, const Place& place, Dataset& out) {
    if (!value.is_array() || value.empty() || value.size() > kMostChannels) {
        place.fail("wrong_type", "must be an array of 1 to " + std::to_string(kMostChannels) + " channels");
        return;
    }
    std::set<std::string> names;
    std::size_t samples = 0;
    for (std::size_t i = 0; i < value.size(); ++i) {
        Channel channel;
        read_object<Channel>(value[i], place.at(i), kChannelFields, channel);
        if (channel.samples.empty() && value[i].is_object() && !value[i].contains("scans") &&
            !value[i].contains("samples"))
            place.at(i).fail("missing", "must have scans or samples");
        if (channel.name.empty())
            channel.name = channel.wavelength_nm ? wavelength_name(*channel.wavelength_nm) : std::to_string(i + 1);
        if (!names.insert(channel.name).second)
            place.at(i).at("name").fail("duplicate", "a channel of that name stands before");
        samples += channel.samples.size();
        if (samples > kMostSamples) {
            place.at(i).fail("too_many", "at most " + std::to_string(kMostSamples) + " samples in a request");
            return;
        }
        out.channels.push_back(std::move(channel));
    }
}

const std::vector<Field<Dataset>> kDatasetFields{
    {"name", false, "of the surface",
     [](const json& v, const Place& p, Dataset& out) { out.name = read_text(v, p).value_or(""); }},
    {"unit", false, "of all BRDF values",
     [](const json& v, const Place& p, Dataset& out) {
         if (const auto unit = read_choice(v, p, kUnits)) out.unit = *unit;
     }},
    {"channels", true, "wavelengths or colours", read_channels},
};

// ---- the whole ----

/// Parts of the loss that do not go together, or not with the measured angles.
void check_loss(const FitRequest& request, const Place& options) {
    const optim::Criterion& loss = request.options.loss;
    const auto check_exponent = [&](std::string_view key, const std::optional<double>& exponent,
                                    double kernels::Direction::*angle) {
        if (!exponent) return;
        if (loss.kind != optim::Loss::cosine)
            options.at(key).fail("contradiction", "exponents belong to the loss cosine alone");
        else if (*exponent < 0)
            for (const Channel& channel : request.dataset.channels)
                if (std::any_of(channel.samples.begin(), channel.samples.end(), [&](const Sample& sample) {
                        return std::abs(sample.direction.*angle) > optim::kGrazing_deg;
                    }))
                    return options.at(key).fail(
                        "out_of_range", fmt::format("must not be negative beside samples above {:g} degrees, which "
                                                    "would outweigh all others; channel {} has such",
                                                    optim::kGrazing_deg, channel.name));
    };
    check_exponent(kExponentIKey, loss.cos_theta_i_exponent, &kernels::Direction::theta_i_deg);
    check_exponent(kExponentRKey, loss.cos_theta_r_exponent, &kernels::Direction::theta_r_deg);
    if (loss.robust_threshold && loss.robust == optim::Robust::none)
        options.at(kThresholdKey).fail("contradiction", "belongs to robust losses alone: give robust as well");
}

/// What the fields cannot say one by one: enough samples, bounds within domains, sigma for chi2.
void check_together(const FitRequest& request, bool models_given, const Place& place) {
    check_loss(request, place.at("options"));
    for (std::size_t c = 0; c < request.dataset.channels.size(); ++c) {
        const Channel& whole = request.dataset.channels[c];
        const Place channel_place = place.at("dataset").at("channels").at(c);
        if (whole.samples.empty()) {
            channel_place.fail("empty", "the channel has no samples");
            continue;
        }
        const std::optional<Scene>& scene = request.options.scene;
        const Channel channel = scene ? seen_by(*scene, whole) : whole;
        if (scene && std::none_of(channel.samples.begin(), channel.samples.end(),
                                  [&](const Sample& sample) { return scene->sees(sample.direction); })) {
            place.at("scene").fail("empty", "no sample of channel " + channel.name + " lies within");
            continue;
        }
        if (request.options.loss.kind == optim::Loss::chi2 &&
            !std::all_of(channel.samples.begin(), channel.samples.end(), [](const Sample& s) { return s.sigma; }))
            place.at("options").at(kLossKey).fail("needs_sigma",
                                                  "chi2 needs sigma at every sample of channel " + channel.name);
        bool possible = false;
        for (std::size_t m = 0; m < request.models.size(); ++m) {
            const ModelRequest& model = request.models[m];
            const Place model_place = place.at("models").at(m);
            try {
                const std::size_t needed = samples_needed(model, channel);
                (void)parameter_bounds(model.variant(model.most_lobes()), model, channel);
                possible = possible || needed <= channel.samples.size();
                if (models_given && needed > channel.samples.size())
                    channel_place.fail("too_few_samples", "has " + std::to_string(channel.samples.size()) +
                                                              " samples, fewer than the " + std::to_string(needed) +
                                                              " free parameters of " + model.family->name);
            } catch (const optim::InvalidBounds& error) {
                const bool is_fixed = model.fixed.count(error.parameter) != 0;
                model_place.at(is_fixed ? "fixed" : "bounds").at(error.parameter).fail("out_of_range", error.what());
            }
        }
        if (!models_given && !possible)
            channel_place.fail("too_few_samples", "has fewer samples than any model has parameters");
    }
}

struct RawRequest {
    const json* dataset = nullptr;
    const json* models = nullptr;
    const json* options = nullptr;
    const json* scene = nullptr;
};

const std::vector<Field<RawRequest>> kRequestFields{
    {"dataset", true, "the measurements", [](const json& v, const Place&, RawRequest& out) { out.dataset = &v; }},
    {"models", false, "models to fit; all if absent",
     [](const json& v, const Place&, RawRequest& out) { out.models = &v; }},
    {"options", false, "options of the fit", [](const json& v, const Place&, RawRequest& out) { out.options = &v; }},
    {"scene", false, "what the models are for: the cheapest that is good enough is recommended",
     [](const json& v, const Place&, RawRequest& out) { out.scene = &v; }},
};

/// Models and options into the request, then the checks over everything.
void finish(const RawRequest& raw, const kernels::Catalogue& catalogue, FitRequest& request,
            std::vector<FieldError>& errors) {
    const Place root(errors, "");
    if (raw.models != nullptr) read_models(*raw.models, root.at("models"), catalogue, request.models);
    else
        for (const kernels::Family& family : catalogue.families()) request.models.push_back({&family, {}, {}, {}});
    if (raw.options != nullptr)
        read_object<FitOptions>(*raw.options, root.at("options"), kOptionFields, request.options);
    if (raw.scene != nullptr) {
        request.options.scene.emplace();
        read_object<FitOptions>(*raw.scene, root.at("scene"), kSceneFields, request.options);
    }
    if (errors.empty()) check_together(request, raw.models != nullptr, root);
    refuse_if_any(std::move(errors));
}

/// "a,b,c" of a query.
std::vector<std::string> names_in(const std::string& text) {
    std::vector<std::string> names;
    boost::algorithm::split(names, text, [](char c) { return c == ','; });
    return names;
}

/// A query parameter's text as JSON: a number or a truth value where it is one, an array where commas are between.
json query_value(const std::string& text) {
    if (text.find(',') != std::string::npos) {
        json values = json::array();
        for (const std::string& part : names_in(text)) values.push_back(query_value(part));
        return values;
    }
    if (text == "true" || text == "false") return text == "true";
    double number = 0;
    const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), number);
    if (error == std::errc{} && end == text.data() + text.size() && std::isfinite(number)) return number;
    return text;
}

}  // namespace

FitRequest read_fit_request(std::string_view body, const kernels::Catalogue& catalogue) {
    const json document = parse_json(body);
    std::vector<FieldError> errors;
    const Place root(errors, "");
    RawRequest raw;
    read_object<RawRequest>(document, root, kRequestFields, raw);
    FitRequest request;
    if (raw.dataset != nullptr && raw.dataset->is_string())
        root.at("dataset").fail("unknown_dataset", "there is no stored dataset of that id");
    else if (raw.dataset != nullptr)
        read_object<Dataset>(*raw.dataset, root.at("dataset"), kDatasetFields, request.dataset);
    finish(raw, catalogue, request, errors);
    return request;
}

FitRequest read_fit_request_csv(std::string_view body, const Query& query, const kernels::Catalogue& catalogue) {
    FitRequest request;
    std::vector<FieldError> errors;
    const Place root(errors, "");
    json models;
    json options = json::object();
    json dataset = json::object();
    json scene;
    for (const auto& [key, value] : query) {
        const auto is_key = [&key = key](const auto& field) { return field.key == key; };
        if (query.count(key) > 1) root.at(key).fail("duplicate_key", "the query parameter stands twice");
        else if (key == "models") {
            models = names_in(value);
        } else if (key == "unit" || key == "name") dataset[key] = value;
        else if (key == kRequireKey) options[key] = names_in(value);
        else if (key == std::string(kSceneKeys) + std::string(kRequireKey))
            scene[std::string(kRequireKey)] = names_in(value);
        else if (std::any_of(kOptionFields.begin(), kOptionFields.end(), is_key)) options[key] = query_value(value);
        else if (key.starts_with(kSceneKeys)) scene[key.substr(kSceneKeys.size())] = query_value(value);
        else {
            std::string names = "models, unit, name";
            for (const auto& field : kOptionFields) names += ", " + std::string(field.key);
            for (const auto& field : kSceneFields) names += ", " + std::string(kSceneKeys) + std::string(field.key);
            root.at(key).fail("unknown_key", "unknown query parameter; valid are: " + names);
        }
    }
    request.dataset = read_csv(body);
    for (const auto& field : kDatasetFields)
        if (dataset.contains(field.key)) field.read(dataset[field.key], root.at(field.key), request.dataset);
    RawRequest raw;
    if (!models.is_null()) raw.models = &models;
    raw.options = &options;
    if (!scene.is_null()) raw.scene = &scene;
    finish(raw, catalogue, request, errors);
    return request;
}

}  // namespace brdfit::api
