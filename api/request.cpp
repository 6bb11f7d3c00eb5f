#include "api/request.h"

#include <cmath>
#include <set>

#include <fmt/format.h>

#include "api/csv.h"
#include "api/dataset.h"
#include "api/field.h"
#include "api/json.h"
#include "api/model_request.h"
#include "api/options.h"
#include "api/query.h"

namespace brdfit::api {
namespace {

using nlohmann::json;
using optim::Channel;
using optim::Dataset;
using optim::FitOptions;
using optim::ModelRequest;
using optim::Sample;
using optim::Scene;

// ---- the whole ----
/// What the text of a job begins with whose request came as CSV: then its query as JSON, an end of line, and the CSV.
constexpr std::string_view kCsvJob = "csv ";

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
    {"models", false, "models to fit, by name or with settings; all if absent", models_schema(),
     [](const json& v, const Place&, RawRequest& out) { out.models = &v; }},
    {"options", false, "options of the fit", schema_of(option_fields()),
     [](const json& v, const Place&, RawRequest& out) { out.options = &v; }},
    {"scene", false, "what the models are for: the cheapest that is good enough is recommended",
     schema_of(scene_fields()), [](const json& v, const Place&, RawRequest& out) { out.scene = &v; }},
};

/// Models and options into the request.
void read_rest(const RawRequest& raw, const kernels::Catalogue& catalogue, FitRequest& request, const Place& root) {
    if (raw.models != nullptr) read_models(*raw.models, root.at("models"), catalogue, request.models);
    else
        for (const kernels::Family& family : catalogue.families()) request.models.push_back({&family, {}, {}, {}});
    if (raw.options != nullptr)
        read_object<FitOptions>(*raw.options, root.at("options"), option_fields(), request.options);
    if (raw.scene != nullptr) {
        request.options.scene.emplace();
        read_object<FitOptions>(*raw.scene, root.at("scene"), scene_fields(), request.options);
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
        if (body) read_object<Dataset>(parse_json(*body), place, dataset_fields(), request.dataset);
        else place.fail("unknown_dataset", "there is no stored dataset of that id");
    } else if (raw.dataset != nullptr) {
        read_object<Dataset>(*raw.dataset, root.at("dataset"), dataset_fields(), request.dataset);
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
    append_simple(fields, dataset_fields(), &CsvQuery::dataset);
    return fields;
}();

const std::vector<Field<CsvQuery>> kFitQueryFields = [] {
    std::vector<Field<CsvQuery>> fields{{"models", false, "names of models to fit; all if absent",
                                         schema::array(schema::named("ModelName"), 1, kMostModels),
                                         [](const json& v, const Place&, CsvQuery& out) { out.models = v; }}};
    append_simple(fields, dataset_fields(), &CsvQuery::dataset);
    append_simple(fields, option_fields(), &CsvQuery::options, "/options");
    static const std::vector<std::string> keys = [] {
        std::vector<std::string> names;
        for (const Field<FitOptions>& field : scene_fields()) names.push_back("scene." + std::string(field.key));
        return names;
    }();
    for (std::size_t i = 0; i < keys.size(); ++i)
        fields.push_back({keys[i], false, scene_fields()[i].doc, scene_fields()[i].schema,
                          [read = scene_fields()[i].read](const json& v, const Place& p, CsvQuery& out) {
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
    const std::string line = line_of(query);
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
                                        read_object<Dataset>(part, Place(wrong, ""), dataset_fields(), unused);
                                        return wrong;
                                    }),
                         root, dataset_fields(), dataset);
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

schema::Json dataset_schema() { return schema_of(dataset_fields()); }
schema::Json fit_request_schema() { return schema_of(kRequestFields); }
std::vector<QueryParameter> dataset_query() { return parameters_of(kDatasetQueryFields); }
std::vector<QueryParameter> fit_query() { return parameters_of(kFitQueryFields); }

}  // namespace brdfit::api
