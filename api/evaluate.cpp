#include "api/evaluate.h"

#include <algorithm>
#include <cmath>

#include <fmt/format.h>

#include "api/field.h"
#include "api/json.h"
#include "api/samples.h"
#include "optim/fit.h"

namespace brdfit::api {
namespace {

using nlohmann::json;

struct Raw {
    std::optional<std::string> model;
    std::optional<double> wavelength_nm;
    const json* lobes = nullptr;
    const json* parameters = nullptr;
    EvaluateRequest request;
};

/// Columns of directions.
struct Columns {
    std::vector<double> theta_i, theta_r, phi;
};

Field<Columns> column(std::string_view key, bool required, std::string_view doc, std::vector<double> Columns::*to,
                      const Rule& bad) {
    return {key, required, doc, schema::array(schema::number(bad), 1, kMostRows),
            [=](const json& v, const Place& p, Columns& out) {
                if (v.is_array() && v.size() > kMostRows)
                    p.fail("too_many", "at most " + std::to_string(kMostRows) + " elements");
                else out.*to = read_column(v, p, bad);
            }};
}

const std::vector<Field<Columns>> kGeometryFields{
    column("theta_i_deg", true, "incidence angles", &Columns::theta_i, bad_theta_i),
    column("theta_r_deg", true, "exitant angles, signed: positive = specular side", &Columns::theta_r, bad_theta_r),
    column("phi_deg", false, "azimuths from the specular half-plane; 0 if absent", &Columns::phi, bad_phi),
};

void read_geometry(const json& value, const Place& place, Raw& out) {
    Columns columns;
    read_object<Columns>(value, place, kGeometryFields, columns);
    if (!value.is_object() || !value.contains("theta_i_deg") || !value.contains("theta_r_deg")) return;
    if (!value["theta_r_deg"].is_array() || value["theta_r_deg"].size() > kMostRows) return;  // told by its field
    const std::size_t n = columns.theta_r.size();
    bool whole = same_length(place, "theta_i_deg", columns.theta_i.size(), n);
    if (value.contains("phi_deg")) whole = same_length(place, "phi_deg", columns.phi.size(), n) && whole;
    else columns.phi.assign(n, 0.0);
    if (n == 0) place.at("theta_r_deg").fail("too_few", "must have 1 to " + std::to_string(kMostRows) + " elements");
    for (std::size_t j = 0; whole && j < n; ++j)
        out.request.directions.push_back({columns.theta_i[j], columns.theta_r[j], columns.phi[j]});
}

const std::vector<Field<Raw>> kFields{
    {"model", true, "the model's name", schema::named("ModelName"),
     [](const json& v, const Place& p, Raw& out) { out.model = read_text(v, p); }},
    {"lobes", false, "number of lobes, of a model that has them; as many as the parameters name if absent",
     schema::Json({{"type", "integer"}, {"minimum", 1}}),
     [](const json& v, const Place&, Raw& out) { out.lobes = &v; }},
    {"parameters", true, "a value for every parameter of the model", schema::named("ParameterValues"),
     [](const json& v, const Place&, Raw& out) { out.parameters = &v; }},
    {"wavelength_nm", false, "with it lengths are in um, without in wavelengths", schema::number(bad_wavelength),
     [](const json& v, const Place& p, Raw& out) { out.wavelength_nm = read_checked(v, p, bad_wavelength); }},
    {"precision", false, "arithmetic", precision_schema(),
     [](const json& v, const Place& p, Raw& out) { out.request.precision = read_precision(v, p); }},
    {"geometry", true, "directions, as columns", schema_of(kGeometryFields), read_geometry},
    {"gradient", false, "whether slopes are wanted", schema::with_default(schema::boolean(), false),
     [](const json& v, const Place& p, Raw& out) {
         if (v.is_boolean()) out.request.gradient = v.get<bool>();
         else p.fail("wrong_type", "must be true or false");
     }},
};

/// The variant that `lobes` asks for, or else the smallest that has every parameter given.
const kernels::Model* choose_variant(const kernels::Family& family, const Raw& raw, const Place& place) {
    if (raw.lobes != nullptr) {
        const auto lobes = read_lobes(*raw.lobes, place.at("lobes"), family);
        return lobes ? &family.variant(*lobes) : nullptr;
    }
    for (const kernels::Model& model : family.variants)
        if (std::all_of(raw.parameters->items().begin(), raw.parameters->items().end(),
                        [&](const auto& item) { return model.find(item.key()).has_value(); }))
            return &model;
    return &family.variants.back();
}

void read_parameters(const Raw& raw, const Place& place, EvaluateRequest& request) {
    const kernels::Model& model = *request.model;
    optim::Channel channel;
    channel.wavelength_nm = raw.wavelength_nm;
    for (const auto& [name, value] : raw.parameters->items()) (void)is_parameter(place, model, name);
    for (const kernels::Parameter& p : model.parameters) {
        const Place at = place.at(p.name);
        request.units.push_back(to_model_unit(p, channel));
        request.parameters.push_back(0);
        if (!raw.parameters->contains(p.name)) {
            at.fail("missing", "must be given: " + p.doc);
            continue;
        }
        const auto number = read_number((*raw.parameters)[p.name], at);
        if (!number) continue;
        request.parameters.back() = *number * request.units.back();
        // In the model's unit the number may have become too large for a double.
        if (request.parameters.back() < p.domain_min || request.parameters.back() > p.domain_max ||
            !std::isfinite(request.parameters.back()))
            at.fail("out_of_range", domain_rule(p, channel));
    }
}

void append(std::string& out, const double* values, std::size_t count, double factor, bool single) {
    out += '[';
    for (std::size_t j = 0; j < count; ++j) {
        if (j > 0) out += ',';
        const double value = values[j] * factor;
        if (!std::isfinite(value)) out += "null";
        else if (single) fmt::format_to(std::back_inserter(out), "{:.9g}", value);
        else fmt::format_to(std::back_inserter(out), "{:.17g}", value);
    }
    out += ']';
}

}  // namespace

schema::Json evaluate_request_schema() { return schema_of(kFields); }

EvaluateRequest read_evaluate_request(std::string_view body, const kernels::Catalogue& catalogue) {
    const json document = parse_json(body, [](const json& part) {
        std::vector<FieldError> wrong;
        Raw unused;
        read_object<Raw>(part, Place(wrong, ""), kFields, unused);
        return wrong;
    });
    std::vector<FieldError> errors;
    const Place root(errors, "");
    Raw raw;
    read_object<Raw>(document, root, kFields, raw);
    if (raw.parameters != nullptr && !raw.parameters->is_object())
        root.at("parameters").fail("wrong_type", "must be an object");
    const kernels::Family* family = raw.model ? catalogue.find(*raw.model) : nullptr;
    if (raw.model && family == nullptr)
        root.at("model").fail("unknown_model", "unknown model; valid are: " + catalogue.names());
    if (family != nullptr && raw.parameters != nullptr && raw.parameters->is_object()) {
        raw.request.model = choose_variant(*family, raw, root);
        if (raw.request.model != nullptr) read_parameters(raw, root.at("parameters"), raw.request);
    }
    refuse_if_any(std::move(errors));
    return raw.request;
}

std::string to_json(const EvaluateRequest& request, const kernels::Values& values, kernels::Precision precision) {
    const bool single = precision == kernels::Precision::single_precision;
    const std::size_t n = request.directions.size();
    std::string out = "{\"values\":";
    append(out, values.f.data(), n, 1, single);
    if (request.gradient) {
        out += ",\"gradient\":{";
        for (std::size_t i = 0; i < request.parameters.size(); ++i) {
            out += (i > 0 ? ",\"" : "\"") + request.model->parameters[i].name + "\":";
            append(out, values.by_parameter.data() + i * n, n, request.units[i], single);
        }
        out += '}';
    }
    return out + "}\n";
}

}  // namespace brdfit::api
