#include "api/answers.h"

#include "api/evaluate.h"
#include "api/names.h"
#include "api/problem.h"
#include "api/request.h"

namespace brdfit::api {
namespace {

using namespace schema;

const Json kNumberOrNull = or_null(number());
const Json kTime = formatted("date-time");
const Json kLink = formatted("uri-reference");

// ---- what requests share ----

Json model_name(const kernels::Catalogue& catalogue) {
    Json json = text();
    for (const kernels::Family& family : catalogue.families()) json["enum"].push_back(family.name);
    return json;
}

/// A value for each of a model's parameters that is named.
Json parameter_values(const kernels::Family& family) {
    const kernels::Model& model = family.variants.back();
    Json json{{"type", "object"}, {"properties", Json::object()}, {"additionalProperties", false}};
    for (const kernels::Parameter& p : model.parameters) {
        Json value = number();
        // A length's limits depend on the wavelength.
        if (p.unit == "1" && std::isfinite(p.domain_min)) value["minimum"] = p.domain_min;
        if (p.unit == "1" && std::isfinite(p.domain_max)) value["maximum"] = p.domain_max;
        value["description"] = p.doc + (p.unit == "1" ? "" : "; in um, or in wavelengths where none is given");
        json["properties"][p.name] = std::move(value);
    }
    return json;
}

std::string parameters_name(const kernels::Family& family) { return "Parameters." + family.name; }

Json parameter_values(const kernels::Catalogue& catalogue) {
    std::vector<Json> models;
    for (const kernels::Family& family : catalogue.families()) models.push_back(named(parameters_name(family)));
    return any_of(std::move(models));
}

// ---- problems ----

Json problem() {
    std::vector<Json> types;
    std::string docs;
    for (const ProblemType& type : kProblemTypes) {
        types.emplace_back("/problems/" + std::string(type.name));
        docs += (docs.empty() ? "" : "; ") + std::string(type.name) + " (" + std::to_string(type.status) +
                "): " + std::string(type.title);
    }
    const Json error = object({
        {"pointer", text(), "RFC 6901 pointer into the request; empty for CSV"},
        {"code", text(), "for programs"},
        {"detail", text(), "for people"},
        {"line", whole(1, 1e15), "of the text, where the text is at fault", false},
        {"column", whole(1, 1e15), "byte within the line; for CSV the field", false},
    });
    return object({
        {"type", {{"type", "string"}, {"enum", types}}, docs},
        {"title", text()},
        {"status", whole(400, 599)},
        {"detail", text()},
        {"instance", text(), "path of the request"},
        {"request_id", text(), "X-Request-Id"},
        {"errors", array(error, 0, kMostErrors), "the place of each mistake", false},
    });
}

// ---- results ----

Json device(bool with_precision) {
    std::vector<Member> members{{"name", text()}, {"platform", text()}, {"type", text()}};
    if (with_precision) members.push_back({"precision", choice(kPrecisions), "of the search"});
    return object(std::move(members));
}

Json fitted_parameter() {
    return object({
        {"value", kNumberOrNull},
        {"std_error", kNumberOrNull, "null where the data do not determine it, or it is fixed or at a bound"},
        {"interval_95", or_null(array(number(), 2, 2)), "holds the value with 95 % confidence, as far as noise goes"},
        {"unit", text(), "1, um, or lambda: wavelengths"},
        {"at_bound", boolean()},
        {"fixed", boolean(), "by the request", false},
    });
}

Json angle_errors() {
    return array(object({{"theta_i_deg", number()}, {"rmse", kNumberOrNull}, {"log10_rmse", kNumberOrNull}}));
}

Json cost() {
    return object({
        {"lobes", whole(1, 100), "of a model with lobes", false},
        {"submodel", text(), "a simpler form with a text of its own", false},
        {"single_ns", kNumberOrNull, "nanoseconds of an evaluation in single precision"},
        {"double_ns", kNumberOrNull, "in double precision"},
        {"under_load", boolean(), "measured beside other work, and maybe too high: it is measured again"},
        {"operations", map_of(number()), "of an evaluation", false},
    });
}

Json physics() {
    return object({
        {"energy_conserving", or_null(boolean()), "null where that could not be told"},
        {"theta_i_deg", array(number(), 2, 2), "the incidence angles over which energy is judged, [low, high]"},
        {"max_albedo", kNumberOrNull, "the largest directional albedo over them"},
        {"at_theta_i_deg", kNumberOrNull},
        {"reciprocal", boolean()},
        {"nonnegative", boolean()},
    });
}

/// A fit by its place among those of its channel.
std::vector<Member> fit_place(bool may_be_none) {
    return {{"model", may_be_none ? or_null(text()) : text()},
            {"lobes", whole(1, 100), "of a model with lobes", false},
            {"submodel", text(), "a simpler form of the model", false},
            {"rank", whole(1, 1e6), "of the fit", !may_be_none}};
}

Json pareto_point() {
    std::vector<Member> members = fit_place(false);
    members.push_back({"ns_per_evaluation", number()});
    members.push_back({"log10_rmse", number(), "decades"});
    return object(std::move(members));
}

Json recommendation() {
    std::vector<Member> members = fit_place(true);
    members.push_back({"reason", text(), "for people"});
    members.push_back({"next_better", pareto_point(), "", false});
    return object(std::move(members));
}

Json fit() {
    return object({
        {"rank", whole(1, 1e6), "by options.rank_by"},
        {"model", text()},
        {"lobes", whole(1, 100), "of a model with lobes", false},
        {"submodel", text(), "a simpler form of the model", false},
        {"parameters", map_of(named("FittedParameter"))},
        {"scale", kNumberOrNull, "relative data: measured = scale * f", false},
        {"loss", kNumberOrNull},
        {"relative_loss", kNumberOrNull, "the loss over that of f = 0"},
        {"rmse", kNumberOrNull, "1/sr"},
        {"log10_rmse", kNumberOrNull, "decades"},
        {"aicc", kNumberOrNull},
        {"bic", kNumberOrNull},
        {"held_out",
         or_null(object({{"rmse", kNumberOrNull},
                         {"log10_rmse", kNumberOrNull},
                         {"loss", kNumberOrNull},
                         {"angles", angle_errors()}})),
         "errors at incidence angles that were left out"},
        {"scans", angle_errors(), "errors by incidence angle"},
        {"outliers", object({{"count", count()}, {"fraction", number()}, {"samples", array(count())}}),
         "of a robust loss: samples that keep less than a tenth of their weight", false},
        {"albedo", array(object({{"theta_i_deg", number()}, {"value", kNumberOrNull}, {"error", kNumberOrNull}})),
         "directional albedos", false},
        {"physics", physics(), "", false},
        {"constrained",
         object({{"require", array(choice(kRequirements))},
                 {"loss_without", kNumberOrNull},
                 {"loss_ratio", kNumberOrNull}}),
         "what the requirements cost", false},
        {"cost", cost(), "on this device", false},
        {"correlations", object({{"names", array(text())}, {"matrix", array(array(kNumberOrNull))}}),
         "of the parameters"},
        {"bootstrap", object({{"replicates", count()}}), "where the intervals come from one", false},
        {"search",
         object({{"starts", count()},
                 {"agreed", count(), "starts that ended within 1e-3 of the best loss"},
                 {"evaluations", count()},
                 {"stop_reason", choice(kStopReasons)},
                 {"time_s", kNumberOrNull},
                 {"rivals",
                  array(object({{"loss", kNumberOrNull}, {"agreed", count()}, {"parameters", map_of(kNumberOrNull)}})),
                  "other minima that were met"}})},
        {"ledger",
         array(object({{"change", choice(kLessWork)},
                       {"loss_ratio", kNumberOrNull, "over the fit's loss"},
                       {"evaluations", count()},
                       {"time_s", kNumberOrNull, "", false},
                       {"lobes", whole(1, 100), "where there are others", false},
                       {"largest_shift",
                        object({{"parameter", text()}, {"std_errors", kNumberOrNull}, {"relative", kNumberOrNull}}), "",
                        false}})),
         "what less work would have changed", false},
        {"warnings", array(text()), "", false},
        {"links", object({{"plot", kLink}})},
    });
}

Json fit_result() {
    const Json channel = object({
        {"name", text()},
        {"wavelength_nm", number(), "", false},
        {"samples", count()},
        {"loss", object({{"name", choice(kLosses)},
                         {"cos_theta_i_exponent", number(), "", false},
                         {"cos_theta_r_exponent", number(), "", false},
                         {"robust", choice(kRobusts)},
                         {"robust_threshold", number(), "", false},
                         {"robust_scale", kNumberOrNull, "", false}})},
        {"noise", object({{"relative", kNumberOrNull, "part of the value"},
                          {"floor", kNumberOrNull, "1/sr"},
                          {"uncertainty", number(), "standard error of sigma, as a part of it", false},
                          {"source", choice(kNoiseSources)}})},
        {"fits", array(named("Fit")), "best first"},
        {"failures", array(object({{"model", text()}, {"submodel", text(), "", false}, {"reason", text()}}))},
        {"recommended", recommendation(), "the cheapest fit that is good enough", false},
        {"pareto", array(pareto_point()), "fits that no cheaper one equals, cheapest first", false},
        {"warnings", array(text()), "", false},
    });
    return object({
        {"id", text()},
        {"state", {{"type", "string"}, {"enum", {"succeeded", "failed"}}}},
        {"version", text()},
        {"seed", count()},
        {"device", device(true)},
        {"dataset", object({{"name", text()}, {"unit", choice(kUnits)}})},
        {"scene", anything(), "as it was understood", false},
        {"channels", array(channel)},
        {"links", object({{"self", kLink}, {"result", kLink}, {"plots", map_of(kLink)}})},
    });
}

// ---- jobs ----

Json fit_status() {
    const Json problem_members = object({{"type", text()},
                                         {"title", text()},
                                         {"status", whole(400, 599)},
                                         {"detail", text()},
                                         {"errors", array(anything()), "", false}});
    const Json best =
        object({{"channel", text()}, {"model", text()}, {"relative_loss", kNumberOrNull}, {"done", boolean()}});
    const Json progress = object({{"fraction", number(), "of the work"},
                                  {"models_done", count()},
                                  {"models", count(), "one of each channel"},
                                  {"evaluations", count()},
                                  {"evaluations_per_s", number()},
                                  {"best", array(best), "what each has reached so far, at most 100"}});
    return object({
        {"id", text()},
        {"state", named("FitState")},
        {"done", boolean(), "whether it has ended"},
        {"dataset", named("DatasetId"), "of a stored dataset, where the request names one", false},
        {"queue_position", count(), "fits that are before it, while it is queued", false},
        {"attempt", count(), "how often it was begun"},
        {"progress", progress, "as the last progress event told it", false},
        {"created", kTime},
        {"started", kTime, "the last attempt", false},
        {"ended", kTime, "", false},
        {"error", problem_members, "why it failed", false},
        {"links", map_of(any_of({kLink, map_of(kLink)}))},
    });
}

Json page_of(std::string_view item) {
    return object({{"items", array(named(item))},
                   {"next_cursor", or_null(text()), "for the query parameter cursor; null on the last page"}});
}

// ---- datasets ----

Json dataset_info() {
    const Json range = object({{"min", number()}, {"max", number()}});
    const Json channel = object({
        {"name", text()},
        {"wavelength_nm", number(), "", false},
        {"samples", count()},
        {"theta_i_deg", array(number()), "incidence angles, the first 100"},
        {"theta_r_deg", range},
        {"brdf", range},
        {"not_positive", count(), "values of 0 or less: kept, left out where logarithms are taken"},
        {"out_of_plane", count(), "samples outside the plane of incidence"},
        {"sigma", boolean(), "whether every sample has a standard deviation"},
    });
    return object({
        {"name", text()},
        {"unit", choice(kUnits)},
        {"samples", count()},
        {"channels", array(channel)},
    });
}

Json extended(Json base, std::vector<Member> more) {
    Json further = object(std::move(more));
    for (auto& [key, value] : further["properties"].items()) base["properties"][key] = value;
    for (auto& key : further["required"]) base["required"].push_back(key);
    return base;
}

Json stored_dataset() {
    return extended(dataset_info(), {{"id", named("DatasetId")},
                                     {"bytes", count(), "as it is kept"},
                                     {"created", kTime},
                                     {"links", map_of(kLink)}});
}

// ---- models ----

Json model() {
    const Json parameter = object({
        {"name", text()},
        {"unit", text(), "1, or wavelength: a length"},
        {"min", number(), "default bound of a fit"},
        {"max", number(), "default bound of a fit"},
        {"domain", array(kNumberOrNull, 2, 2), "what a request may name"},
        {"scale", {{"type", "string"}, {"enum", {"linear", "log"}}}},
        {"linear", boolean(), "whether f is linear in it"},
        {"doc", text()},
    });
    return object({
        {"name", named("ModelName")},
        {"title", text()},
        {"source", text()},
        {"formula", text()},
        {"parameters", array(parameter)},
        {"options", map_of(anything()), "of a model with lobes", false},
        {"submodels", array(text()), "simpler forms"},
        {"traits", map_of(boolean())},
        {"costs", array(cost()), "of an evaluation, once they are measured", false},
        {"links", object({{"self", kLink}})},
    });
}

Json self_test() {
    const Json worst = object({{"eps", kNumberOrNull}, {"at", text(), "", false}});
    const Json model = object({
        {"model", text()},
        {"lobes", count(), "", false},
        {"points", count()},
        {"value", worst, "", false},
        {"slope", worst, "", false},
        {"passed", boolean(), "", false},
        {"time_ms", kNumberOrNull},
    });
    const Json precision = object({
        {"precision", choice(kPrecisions)},
        {"form", choice(kSelfTestForms)},
        {"passed", boolean()},
        {"reason", text(), "", false},
        {"time_ms", kNumberOrNull},
        {"models", array(model)},
    });
    return object({{"largest_error_eps", number()}, {"precisions", array(precision)}});
}

Json service() {
    return object({
        {"name", text()},
        {"version", text()},
        {"device", device(false)},
        {"selftest", named("SelfTest")},
        {"limits", map_of(number())},
        {"links", map_of(kLink)},
    });
}

}  // namespace

Json component_schemas(const kernels::Catalogue& catalogue) {
    Json dataset_id = text();
    dataset_id["pattern"] = "^[0-9a-f]{64}$";
    Json json{
        {"FitRequest", fit_request_schema()},
        {"Dataset", dataset_schema()},
        {"DatasetId", dataset_id},
        {"EvaluateRequest", evaluate_request_schema()},
        {"ModelName", model_name(catalogue)},
        {"ParameterValues", parameter_values(catalogue)},
        {"FitState", one_of(kFitStates)},
        {"FitStatus", fit_status()},
        {"FitPage", page_of("FitStatus")},
        {"FitResult", fit_result()},
        {"Fit", fit()},
        {"FittedParameter", fitted_parameter()},
        {"DatasetInfo", dataset_info()},
        {"StoredDataset", stored_dataset()},
        {"WholeDataset", extended(stored_dataset(), {{"dataset", named("Dataset"), "the measurements"}})},
        {"DatasetPage", page_of("StoredDataset")},
        {"Values", object({{"values", array(kNumberOrNull), "1/sr"},
                           {"gradient", map_of(array(kNumberOrNull)), "by parameter, 1/sr per its unit", false}})},
        {"Model", model()},
        {"Models", object({{"models", array(named("Model"))}})},
        {"SelfTest", self_test()},
        {"Service", service()},
        {"Ready", object({{"status", text()}, {"selftest", named("SelfTest")}})},
        {"Live", object({{"status", constant("live")}})},
        {"Links", object({{"name", text()}, {"version", text()}, {"links", map_of(kLink)}})},
        {"ProblemType", object({{"type", text()}, {"title", text()}, {"status", whole(400, 599)}, {"doc", text()}})},
        {"Problem", problem()},
    };
    for (const kernels::Family& family : catalogue.families()) json[parameters_name(family)] = parameter_values(family);
    return json;
}

}  // namespace brdfit::api
