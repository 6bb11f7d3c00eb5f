#include "api/model_request.h"

#include <optional>
#include <string>

#include "api/names.h"

namespace brdfit::api {
namespace {

using nlohmann::json;
using optim::Interval;
using optim::ModelRequest;

/// A model before its family is known to exist.
struct RawModel {
    std::string name;
    const json* lobes = nullptr;
    const json* submodel = nullptr;
    const json* fixed = nullptr;
    const json* bounds = nullptr;
};

const std::vector<Field<RawModel>>& model_fields() {
    static const std::vector<Field<RawModel>> fields{
        {"name", true, "the model's name", schema::named("ModelName"),
         [](const json& v, const Place& p, RawModel& out) { out.name = read_text(v, p).value_or(""); }},
        {"lobes", false, "number of lobes, of a model that has them; \"auto\": as few as the data support",
         schema::with_default(schema::any_of({schema::constant("auto"), {{"type", "integer"}, {"minimum", 1}}}),
                              "auto"),
         [](const json& v, const Place&, RawModel& out) { out.lobes = &v; }},
        {"submodel", false, "a simpler form of the model, by its name", schema::name(),
         [](const json& v, const Place&, RawModel& out) { out.submodel = &v; }},
        {"fixed", false, "parameters held at a value", schema::named("ParameterValues"),
         [](const json& v, const Place&, RawModel& out) { out.fixed = &v; }},
        {"bounds", false, "parameters kept within [low, high]", schema::map_of(schema::array(schema::number(), 2, 2)),
         [](const json& v, const Place&, RawModel& out) { out.bounds = &v; }},
    };
    return fields;
}

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
        read_object<RawModel>(value, place, model_fields(), raw);
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

}  // namespace

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

schema::Json models_schema() {
    return schema::array(schema::any_of({schema::named("ModelName"), schema_of(model_fields())}), 1, kMostModels);
}

}  // namespace brdfit::api
