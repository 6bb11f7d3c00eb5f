#include "api/request.h"

#include <cmath>
#include <set>

#include <fmt/format.h>

#include "api/csv.h"
#include "api/field.h"
#include "api/json.h"
#include "api/query.h"
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
constexpr std::size_t kMostModels = 50;
/// What the text of a job begins with whose request came as CSV: then its query as JSON, an end of line, and the CSV.
constexpr std::string_view kCsvJob = "csv ";

// ---- options ----

void read_seed(const json& value, const Place& place, FitOptions& out) {
    const auto number = read_number(value, place);
    if (!number) return;
    if (*number < 0 || *number > kLargestSeed || *number != std::floor(*number))
        place.fail("out_of_range", "must be a whole number from 0 to 2^53 - 1");
    else out.seed = static_cast<std::uint64_t>(*number);
}

constexpr Rule bad_time_limit{0, true, 3600, false, "must lie in (0, 3600]"};

const FitOptions kDefaults;

static_assert(optim::kSteepestCosine == 4 && optim::kLeastThreshold == 0.5 && optim::kMostThreshold == 20);
constexpr Rule bad_exponent{-optim::kSteepestCosine, false, optim::kSteepestCosine, false, "must lie in [-4, 4]"};
constexpr Rule bad_threshold{optim::kLeastThreshold, false, optim::kMostThreshold, false, "must lie in [0.5, 20]"};

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

schema::Json require_schema() { return schema::array(schema::choice(kRequirements), 0, kRequirements.size()); }

const std::vector<Field<FitOptions>> kOptionFields{
    {kLossKey, false, "what is minimised",
     schema::with_default(schema::choice(kLosses), name_of(kLosses, kDefaults.loss.kind)),
     [](const json& v, const Place& p, FitOptions& out) {
         if (const auto loss = read_choice(v, p, kLosses)) out.loss.kind = *loss;
     }},
    {kExponentIKey, false, "of the loss cosine: a in cos(theta_i)^a; 0 if absent", schema::number(bad_exponent),
     [](const json& v, const Place& p, FitOptions& out) {
         out.loss.cos_theta_i_exponent = read_checked(v, p, bad_exponent);
     }},
    {kExponentRKey, false, "of the loss cosine: b in cos(theta_r)^b; 1 if absent", schema::number(bad_exponent),
     [](const json& v, const Place& p, FitOptions& out) {
         out.loss.cos_theta_r_exponent = read_checked(v, p, bad_exponent);
     }},
    {"robust", false, "what takes the place of the loss's squares, against outliers",
     schema::with_default(schema::choice(kRobusts), name_of(kRobusts, kDefaults.loss.robust)),
     [](const json& v, const Place& p, FitOptions& out) {
         if (const auto robust = read_choice(v, p, kRobusts)) out.loss.robust = *robust;
     }},
    {kThresholdKey, false, "of a robust loss, in robust standard deviations; 1.345 for huber, 2.385 for cauchy",
     schema::number(bad_threshold),
     [](const json& v, const Place& p, FitOptions& out) {
         out.loss.robust_threshold = read_checked(v, p, bad_threshold);
     }},
    {"effort", false, "how much the search may spend",
     schema::with_default(schema::choice(kEfforts), name_of(kEfforts, kDefaults.effort)),
     [](const json& v, const Place& p, FitOptions& out) {
         if (const auto effort = read_choice(v, p, kEfforts)) out.effort = *effort;
     }},
    {"precision", false, "arithmetic of the search; what is reported is computed in double where that may be used",
     precision_schema(), [](const json& v, const Place& p, FitOptions& out) { out.precision = read_precision(v, p); }},
    {"seed", false, "of the starts; the same seed gives the same result",
     schema::with_default(schema::whole(0, kLargestSeed), kDefaults.seed), read_seed},
    {"time_limit_s", false, "of the whole request, in seconds",
     schema::with_default(schema::number(bad_time_limit), kDefaults.time_limit.count()),
     [](const json& v, const Place& p, FitOptions& out) {
         if (const auto seconds = read_checked(v, p, bad_time_limit))
             out.time_limit = std::chrono::duration<double>(*seconds);
     }},
    {"require", false, "what a fit must keep to", require_schema(), read_require},
    {"judge", false, "also held-out errors, rivals, albedo, physics, cost and a recommendation",
     schema::with_default(schema::boolean(), kDefaults.judge),
     [](const json& v, const Place& p, FitOptions& out) {
         if (const auto judge = read_flag(v, p)) out.judge = *judge;
     }},
    {"rank_by", false, "what fits are sorted by",
     schema::with_default(schema::choice(kRankBy), name_of(kRankBy, kDefaults.rank_by)),
     [](const json& v, const Place& p, FitOptions& out) {
         if (const auto rank_by = read_choice(v, p, kRankBy)) out.rank_by = *rank_by;
     }},
    {"ledger", false, "also what single precision, less effort and earlier stops would have changed",
     schema::with_default(schema::boolean(), kDefaults.ledger),
     [](const json& v, const Place& p, FitOptions& out) {
         if (const auto ledger = read_flag(v, p)) out.ledger = *ledger;
     }},
};

// ---- scene ----

const Scene kAnyScene;
constexpr Rule bad_scene_angle{0, false, 90, false, "must lie in [0, 90]"};
constexpr Rule bad_outside_weight{0, false, 1, true, "must lie in [0, 1)"};
constexpr Rule bad_tolerance{0, true, 10, false, "must lie in (0, 10]"};
constexpr Rule bad_ns{0, true, 1e9, false, "must lie in (0, 1e9]"};

/// These fields are read into FitOptions::scene, which is there.
Field<FitOptions> angles_field(std::string_view key, std::string_view doc, Interval Scene::*angles) {
    return {key, false, doc,
            schema::with_default(schema::array(schema::number(bad_scene_angle), 2, 2),
                                 {(kAnyScene.*angles).min, (kAnyScene.*angles).max}),
            [=](const json& v, const Place& p, FitOptions& out) {
                if (!v.is_array() || v.size() != 2) return p.fail("wrong_type", "must be [low, high]");
                const auto low = read_checked(v[0], p.at(std::size_t{0}), bad_scene_angle);
                const auto high = read_checked(v[1], p.at(std::size_t{1}), bad_scene_angle);
                if (!low || !high) return;
                if (*low > *high) p.fail("out_of_range", "low must not be above high");
                else (*out.scene).*angles = {*low, *high};
            }};
}

const std::vector<Field<FitOptions>> kSceneFields{
    angles_field("theta_i_deg", "incidence angles that the scene sees, [low, high]", &Scene::theta_i_deg),
    angles_field("theta_r_deg", "exitant angles that the scene sees, without sign, [low, high]", &Scene::theta_r_deg),
    {"outside_weight", false, "weight of a sample outside, where one within has 1; 0: left out",
     schema::with_default(schema::number(bad_outside_weight), kAnyScene.outside_weight),
     [](const json& v, const Place& p, FitOptions& out) {
         if (const auto weight = read_checked(v, p, bad_outside_weight)) out.scene->outside_weight = *weight;
     }},
    {"tolerance_log10", false, "the largest root mean square error that is good enough, in decades",
     schema::with_default(schema::number(bad_tolerance), kAnyScene.tolerance_log10),
     [](const json& v, const Place& p, FitOptions& out) {
         if (const auto tolerance = read_checked(v, p, bad_tolerance)) out.scene->tolerance_log10 = *tolerance;
     }},
    {"max_ns_per_evaluation", false, "the most that an evaluation may cost on this device, in nanoseconds",
     schema::number(bad_ns),
     [](const json& v, const Place& p, FitOptions& out) {
         out.scene->max_ns_per_evaluation = read_checked(v, p, bad_ns);
     }},
    {"require", false, "what a fit must keep to, beside options.require", require_schema(), read_require},
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
    {"name", true, "the model's name", schema::named("ModelName"),
     [](const json& v, const Place& p, RawModel& out) { out.name = read_text(v, p).value_or(""); }},
    {"lobes", false, "number of lobes, of a model that has them; \"auto\": as few as the data support",
     schema::with_default(schema::any_of({schema::constant("auto"), {{"type", "integer"}, {"minimum", 1}}}), "auto"),
     [](const json& v, const Place&, RawModel& out) { out.lobes = &v; }},
    {"submodel", false, "a simpler form of the model, by its name", schema::name(),
     [](const json& v, const Place&, RawModel& out) { out.submodel = &v; }},
    {"fixed", false, "parameters held at a value", schema::named("ParameterValues"),
     [](const json& v, const Place&, RawModel& out) { out.fixed = &v; }},
    {"bounds", false, "parameters kept within [low, high]", schema::map_of(schema::array(schema::number(), 2, 2)),
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
                            std::vector<double> Columns::*column, const Rule& bad) {
    return {key, required, doc, schema::array(schema::number(bad), 1, kMostSamples),
            [=](const json& v, const Place& p, Columns& out) { out.*column = read_column(v, p, bad); }};
}

Field<Columns> sigma_field() {
    return {"sigma", false, "standard deviation of brdf, same unit",
            schema::array(schema::number(bad_sigma), 1, kMostSamples), [](const json& v, const Place& p, Columns& out) {
                out.sigma = read_column(v, p, bad_sigma);
                out.has_sigma = true;
            }};
}

const std::vector<Field<Columns>> kScanFields{
    {"theta_i_deg", true, "incidence angle", schema::number(bad_theta_i),
     [](const json& v, const Place& p, Columns& out) { out.scan_theta_i = read_checked(v, p, bad_theta_i); }},
    column_field("theta_r_deg", true, "exitant angles, signed: positive = specular side", &Columns::theta_r,
                 bad_theta_r),
    column_field("brdf", true, "BRDF values", &Columns::brdf, bad_brdf),
    sigma_field(),
};

const std::vector<Field<Columns>> kSamplesFields{
    column_field("theta_i_deg", true, "incidence angles", &Columns::theta_i, bad_theta_i),
    {"phi_i_deg", false, "azimuths of incidence; 0 if absent", schema::array(schema::number(bad_phi), 1, kMostSamples),
     [](const json& v, const Place& p, Columns& out) {
         out.phi_i = read_column(v, p, bad_phi);
         out.has_phi_i = true;
     }},
    column_field("theta_r_deg", true, "exitant angles; if one is negative, signs count and must agree with phi",
                 &Columns::theta_r, bad_theta_r),
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
    {"name", false, "name; the wavelength or the position if absent", schema::name(),
     [](const json& v, const Place& p, Channel& out) { out.name = read_text(v, p).value_or(""); }},
    {"wavelength_nm", false, "wavelength", schema::number(bad_wavelength),
     [](const json& v, const Place& p, Channel& out) { out.wavelength_nm = read_checked(v, p, bad_wavelength); }},
    {"scans", false, "scans in the plane of incidence; a channel has these or samples, or both",
     schema::array(schema_of(kScanFields)),
     [](const json& v, const Place& p, Channel& out) {
         if (!v.is_array()) return p.fail("wrong_type", "must be an array");
         for (std::size_t i = 0; i < v.size(); ++i) append_scan(v[i], p.at(i), out);
     }},
    {"samples", false, "samples in any direction, as columns of equal length", schema_of(kSamplesFields),
     append_samples},
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
    {"name", false, "of the surface", schema::name(),
     [](const json& v, const Place& p, Dataset& out) { out.name = read_text(v, p).value_or(""); }},
    {"unit", false, "of all BRDF values", schema::with_default(schema::choice(kUnits), name_of(kUnits, Dataset{}.unit)),
     [](const json& v, const Place& p, Dataset& out) {
         if (const auto unit = read_choice(v, p, kUnits)) out.unit = *unit;
     }},
    {"channels", true, "wavelengths or colours", schema::array(schema_of(kChannelFields), 1, kMostChannels),
     read_channels},
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

/// What the fields cannot say one by one: enough samples, bounds within domains, sigma for chi2, ranks that are judged.
void check_together(const FitRequest& request, bool models_given, const Place& place) {
    if (request.options.rank_by == optim::RankBy::held_out && !request.options.judge)
        place.at("options").at("rank_by").fail("contradiction", "held_out needs \"judge\": true");
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
    {"dataset", true, "the measurements, or the id of a stored dataset",
     schema::any_of({schema::named("Dataset"), schema::named("DatasetId")}),
     [](const json& v, const Place&, RawRequest& out) { out.dataset = &v; }},
    {"models", false, "models to fit, by name or with settings; all if absent",
     schema::array(schema::any_of({schema::named("ModelName"), schema_of(kModelFields)}), 1, kMostModels),
     [](const json& v, const Place&, RawRequest& out) { out.models = &v; }},
    {"options", false, "options of the fit", schema_of(kOptionFields),
     [](const json& v, const Place&, RawRequest& out) { out.options = &v; }},
    {"scene", false, "what the models are for: the cheapest that is good enough is recommended",
     schema_of(kSceneFields), [](const json& v, const Place&, RawRequest& out) { out.scene = &v; }},
};

/// Models and options into the request.
void read_rest(const RawRequest& raw, const kernels::Catalogue& catalogue, FitRequest& request, const Place& root) {
    if (raw.models != nullptr) read_models(*raw.models, root.at("models"), catalogue, request.models);
    else
        for (const kernels::Family& family : catalogue.families()) request.models.push_back({&family, {}, {}, {}});
    if (raw.options != nullptr)
        read_object<FitOptions>(*raw.options, root.at("options"), kOptionFields, request.options);
    if (raw.scene != nullptr) {
        request.options.scene.emplace();
        read_object<FitOptions>(*raw.scene, root.at("scene"), kSceneFields, request.options);
    }
}

/// The checks over everything, if every field is good.
void finish(const RawRequest& raw, const FitRequest& request, std::vector<FieldError>& errors) {
    const Place root(errors, "");
    if (errors.empty()) check_together(request, raw.models != nullptr, root);
    refuse_if_any(std::move(errors));
}

/// The fields of a request of JSON that has been parsed.
RawRequest read_fields(const json& document, const kernels::Catalogue& catalogue, const DatasetSource& datasets,
                       FitRequest& request, const Place& root) {
    RawRequest raw;
    read_object<RawRequest>(document, root, kRequestFields, raw);
    if (raw.dataset != nullptr && raw.dataset->is_string()) {
        const Place place = root.at("dataset");
        const auto body = datasets ? datasets(raw.dataset->get<std::string>()) : std::nullopt;
        if (body) read_object<Dataset>(parse_json(*body), place, kDatasetFields, request.dataset);
        else place.fail("unknown_dataset", "there is no stored dataset of that id");
    } else if (raw.dataset != nullptr) {
        read_object<Dataset>(*raw.dataset, root.at("dataset"), kDatasetFields, request.dataset);
    }
    read_rest(raw, catalogue, request, root);
    return raw;
}

FitRequest read_document(const json& document, const kernels::Catalogue& catalogue, const DatasetSource& datasets) {
    std::vector<FieldError> errors;
    FitRequest request;
    const RawRequest raw = read_fields(document, catalogue, datasets, request, Place(errors, ""));
    finish(raw, request, errors);
    return request;
}

json parse_request(std::string_view body, const kernels::Catalogue& catalogue) {
    return parse_json(body, [&](const json& part) {
        std::vector<FieldError> errors;
        FitRequest request;
        read_fields(part, catalogue, {}, request, Place(errors, ""));
        return errors;
    });
}

// ---- what stands in the query beside a body of CSV ----

struct CsvQuery {
    json models;
    Dataset dataset;
    FitOptions options;
};

bool is_simple(const schema::Json& schema) {
    const std::string type = schema.value("type", "");
    return type != "object" && (type != "array" || is_simple(schema["items"])) && !schema.contains("anyOf");
}

/// Fields of a part, as fields of the query: those that a query can hold. Errors tell where they stand in JSON.
template <class Part>
void append_simple(std::vector<Field<CsvQuery>>& fields, const std::vector<Field<Part>>& parts, Part CsvQuery::*part,
                   const std::string& within = "") {
    for (const Field<Part>& field : parts)
        if (is_simple(field.schema))
            fields.push_back({field.key, false, field.doc, field.schema,
                              [read = field.read, part, within](const json& v, const Place& p, CsvQuery& out) {
                                  read(v, p.within(within), out.*part);
                              }});
}

const std::vector<Field<CsvQuery>> kDatasetQueryFields = [] {
    std::vector<Field<CsvQuery>> fields;
    append_simple(fields, kDatasetFields, &CsvQuery::dataset);
    return fields;
}();

const std::vector<Field<CsvQuery>> kFitQueryFields = [] {
    std::vector<Field<CsvQuery>> fields{{"models", false, "names of models to fit; all if absent",
                                         schema::array(schema::named("ModelName"), 1, kMostModels),
                                         [](const json& v, const Place&, CsvQuery& out) { out.models = v; }}};
    append_simple(fields, kDatasetFields, &CsvQuery::dataset);
    append_simple(fields, kOptionFields, &CsvQuery::options, "/options");
    static const std::vector<std::string> keys = [] {
        std::vector<std::string> names;
        for (const Field<FitOptions>& field : kSceneFields) names.push_back("scene." + std::string(field.key));
        return names;
    }();
    for (std::size_t i = 0; i < keys.size(); ++i)
        fields.push_back({keys[i], false, kSceneFields[i].doc, kSceneFields[i].schema,
                          [read = kSceneFields[i].read](const json& v, const Place& p, CsvQuery& out) {
                              if (!out.options.scene) out.options.scene.emplace();
                              read(v, p, out.options);
                          }});
    return fields;
}();

/// Names and unit from the query onto what the file holds.
Dataset with_query(Dataset dataset, CsvQuery query) {
    dataset.name = std::move(query.dataset.name);
    dataset.unit = query.dataset.unit;
    return dataset;
}

// ---- datasets as they are kept ----

/// phi_r of a canonical direction where phi_i is 0 and theta_r has no sign.
double azimuth_on_wire(const kernels::Direction& direction) {
    return 180 + (direction.theta_r_deg < 0 ? 180 - direction.phi_deg : direction.phi_deg);
}

/// A sample in the plane of incidence, into the scan before it where it continues that one.
void append_scan_sample(json& scans, const Sample& sample) {
    const bool continues = !scans.empty() && scans.back()["theta_i_deg"] == sample.direction.theta_i_deg &&
                           scans.back().contains("sigma") == sample.sigma.has_value();
    if (!continues) scans.push_back({{"theta_i_deg", sample.direction.theta_i_deg}});
    json& scan = scans.back();
    scan["theta_r_deg"].push_back(sample.direction.theta_r_deg);
    scan["brdf"].push_back(sample.brdf);
    if (sample.sigma) scan["sigma"].push_back(*sample.sigma);
}

}  // namespace

FitRequest read_fit_request(std::string_view body, const kernels::Catalogue& catalogue, const DatasetSource& datasets) {
    return read_document(parse_request(body, catalogue), catalogue, datasets);
}

FitRequest read_fit_request_csv(std::string_view body, const Query& query, const kernels::Catalogue& catalogue) {
    std::vector<FieldError> errors;
    CsvQuery read;
    read_query<CsvQuery>(query, Place(errors, ""), kFitQueryFields, read);
    FitRequest request;
    request.dataset = with_query(read_csv(body), read);
    request.options = read.options;
    RawRequest raw;
    if (!read.models.is_null()) raw.models = &read.models;
    read_rest(raw, catalogue, request, Place(errors, ""));
    finish(raw, request, errors);
    return request;
}

PostedFit read_posted_fit(std::string_view body, const kernels::Catalogue& catalogue, const DatasetSource& datasets) {
    const json document = parse_request(body, catalogue);
    PostedFit posted{read_document(document, catalogue, datasets).options.precision, document.dump(), {}};
    if (document["dataset"].is_string()) posted.dataset = document["dataset"].get<std::string>();
    return posted;
}

PostedFit read_posted_fit_csv(std::string_view body, const Query& query, const kernels::Catalogue& catalogue) {
    PostedFit posted{read_fit_request_csv(body, query, catalogue).options.precision, "", {}};
    // Not within JSON, where reading it again would take several times its size.
    const std::string line = json(query).dump(-1, ' ', false, json::error_handler_t::replace) + "\n";
    posted.text.reserve(kCsvJob.size() + line.size() + body.size());
    posted.text.append(kCsvJob).append(line).append(body);
    return posted;
}

FitRequest read_job(std::string_view text, std::string_view dataset, const kernels::Catalogue& catalogue) {
    if (text.starts_with(kCsvJob)) {
        text.remove_prefix(kCsvJob.size());
        const std::size_t end = text.find('\n');
        return read_fit_request_csv(text.substr(end + 1), parse_json(text.substr(0, end)).get<Query>(), catalogue);
    }
    return read_document(parse_json(text), catalogue, [&](const std::string&) { return std::string(dataset); });
}

Dataset read_dataset(std::string_view body) {
    std::vector<FieldError> errors;
    const Place root(errors, "");
    Dataset dataset;
    read_object<Dataset>(parse_json(body,
                                    [](const json& part) {
                                        std::vector<FieldError> wrong;
                                        Dataset unused;
                                        read_object<Dataset>(part, Place(wrong, ""), kDatasetFields, unused);
                                        return wrong;
                                    }),
                         root, kDatasetFields, dataset);
    if (errors.empty())
        for (std::size_t c = 0; c < dataset.channels.size(); ++c)
            if (dataset.channels[c].samples.empty())
                root.at("channels").at(c).fail("empty", "the channel has no samples");
    refuse_if_any(std::move(errors));
    return dataset;
}

Dataset read_dataset_csv(std::string_view body, const Query& query) {
    std::vector<FieldError> errors;
    CsvQuery read;
    read_query<CsvQuery>(query, Place(errors, ""), kDatasetQueryFields, read);
    Dataset dataset = with_query(read_csv(body), read);
    refuse_if_any(std::move(errors));
    return dataset;
}

schema::Json dataset_schema() { return schema_of(kDatasetFields); }
schema::Json fit_request_schema() { return schema_of(kRequestFields); }
std::vector<QueryParameter> dataset_query() { return parameters_of(kDatasetQueryFields); }
std::vector<QueryParameter> fit_query() { return parameters_of(kFitQueryFields); }

std::string canonical_text(const Dataset& dataset) {
    json channels = json::array();
    for (const Channel& channel : dataset.channels) {
        json entry{{"name", channel.name}};
        if (channel.wavelength_nm) entry["wavelength_nm"] = *channel.wavelength_nm;
        json scans = json::array();
        json samples = json::object();
        for (const Sample& sample : channel.samples) {
            const double phi_r = azimuth_on_wire(sample.direction);
            // What reading will make of it: rounded once, and the same ever after.
            const Sample kept{*direction_of(sample.direction.theta_i_deg, std::abs(sample.direction.theta_r_deg), 0,
                                            phi_r, Signs::absent),
                              sample.brdf, sample.sigma};
            if (sample.direction.phi_deg == 0) append_scan_sample(scans, sample);
            else if (kept.direction.phi_deg == 0) append_scan_sample(scans, kept);
            else {
                samples["theta_i_deg"].push_back(kept.direction.theta_i_deg);
                samples["theta_r_deg"].push_back(std::abs(kept.direction.theta_r_deg));
                samples["phi_r_deg"].push_back(phi_r);
                samples["brdf"].push_back(kept.brdf);
                if (kept.sigma) samples["sigma"].push_back(*kept.sigma);
            }
        }
        if (!scans.empty()) entry["scans"] = std::move(scans);
        if (!samples.empty()) entry["samples"] = std::move(samples);
        channels.push_back(std::move(entry));
    }
    return json{{"name", dataset.name}, {"unit", name_of(kUnits, dataset.unit)}, {"channels", channels}}.dump();
}

}  // namespace brdfit::api
