#include "server/datasets.h"

#include "api/dataset.h"
#include "api/examples.h"
#include "api/listing.h"
#include "api/request.h"
#include "api/stored.h"
#include "server/headers.h"
#include "server/paging.h"

namespace brdfit::server {
namespace {

using api::problem_type;
using api::Refusal;

optim::Dataset read(const Request& request) {
    if (body_type(request, {kJson, kCsv}) == kCsv) return api::read_dataset_csv(request.body, request.query);
    refuse_query(request);
    return api::read_dataset(request.body);
}

api::StoredDataset stored(const DatasetInfo& info) { return {info.id, info.meta, info.bytes, rfc3339(info.created)}; }

Refusal unknown() { return Refusal({problem_type("unknown-dataset"), "there is no dataset of that id", {}}); }

Response validate(const Call& call) {
    Response response;
    response.body = api::summary_json(read(call.request));
    return response;
}

}  // namespace

std::vector<Route> Datasets::routes() {
    using namespace api;
    using In = Parameter::In;
    namespace s = api::schema;
    const Parameter id{In::path, "id", "SHA-256 of what it says, in hexadecimal", s::named("DatasetId"), {}};
    const std::vector<Content> bodies{{kJson, s::named("Dataset"), examples::dataset()},
                                      {kCsv, s::text(), examples::kCsv}};
    const std::vector<std::string_view> refusals{"invalid-json", "too-large", "unsupported-media-type",
                                                 "invalid-request"};
    const auto call = [this](Response (Datasets::*member)(const Call&)) {
        return [this, member](const Call& c) { return (this->*member)(c); };
    };
    std::vector<Route> routes;
    {
        Operation op{"POST", "/v1/datasets", "postDataset", "Datasets",
                     "Keep measurements: the same ones have the same id, whatever form they came in"};
        op.parameters = in_query(dataset_query());
        op.bodies = bodies;
        op.answers = {
            {201, "kept", {{kJson, s::named("StoredDataset")}}, {{"Location", "of the dataset"}}},
            {200, "it was kept before", {{kJson, s::named("StoredDataset")}}, {{"Location", "of the dataset"}}}};
        op.problems = refusals;
        op.problems.push_back("unavailable");
        routes.push_back({std::move(op), call(&Datasets::post)});
    }
    {
        Operation op{"POST", "/v1/datasets/validate", "validateDataset", "Datasets",
                     "What POST /v1/datasets would make of the same request; nothing is kept"};
        op.parameters = in_query(dataset_query());
        op.bodies = bodies;
        op.answers = {{200, "it would be kept; what it holds", {{kJson, s::named("DatasetInfo")}}}};
        op.problems = refusals;
        routes.push_back({std::move(op), validate});
    }
    {
        Operation op{"GET", "/v1/datasets", "listDatasets", "Datasets", "Datasets that are kept, newest first"};
        op.parameters = in_query(dataset_list_query());
        op.answers = {{200, "a page", {{kJson, s::named("DatasetPage")}}, {{"Link", "rel=next: the next page"}}}};
        op.problems = {"invalid-cursor", "invalid-request"};
        routes.push_back({std::move(op), call(&Datasets::list)});
    }
    {
        Operation op{"GET", "/v1/datasets/{id}", "getDataset", "Datasets", "A dataset with its measurements"};
        op.parameters = {id, {In::header, "If-None-Match", "304 if the entity tag is still that", s::text(), {}}};
        op.answers = {{200, "the dataset", {{kJson, s::named("WholeDataset")}}, {{"ETag", "strong"}}},
                      {304, "it is as If-None-Match says"}};
        op.problems = {"unknown-dataset"};
        routes.push_back({std::move(op), call(&Datasets::get)});
    }
    {
        Operation op{"DELETE", "/v1/datasets/{id}", "deleteDataset", "Datasets", "Remove a dataset; its fits stay"};
        op.parameters = {id};
        op.answers = {{204, "removed"}};
        op.problems = {"unknown-dataset", "dataset-in-use"};
        routes.push_back({std::move(op), call(&Datasets::remove)});
    }
    return routes;
}

Response Datasets::post(const Call& call) {
    const optim::Dataset dataset = read(call.request);
    const JobStore::PutDataset put = store_.put_dataset(api::canonical_text(dataset), api::summary_json(dataset));
    const auto found = store_.find_dataset(put.id);
    if (!found) throw unknown();  // removed by another, at once
    store_.sync();
    Response response;
    response.status = put.created ? 201 : 200;
    response.body = api::to_json(stored(found->info));
    response.headers["Location"] = "/v1/datasets/" + put.id;
    return response;
}

Response Datasets::list(const Call& call) {
    const api::ListQuery query = api::read_dataset_list(call.request.query);
    const Page<DatasetInfo> page = list_page([&] { return store_.list_datasets(page_of(query)); });
    std::vector<api::StoredDataset> items;
    for (const DatasetInfo& info : page.items) items.push_back(stored(info));
    Response response;
    response.body = api::page_json(items, page.next);
    if (page.next) response.headers["Link"] = api::next_link(call.request.path, call.request.query, *page.next);
    return response;
}

Response Datasets::get(const Call& call) {
    refuse_query(call.request);
    const auto found = store_.find_dataset(call.path[0]);
    if (!found) throw unknown();
    Response response;
    response.body = api::to_json(stored(found->info), found->body);
    response.headers["ETag"] = entity_tag(response.body);
    response.headers["Last-Modified"] = http_date(found->info.created);
    response.headers["Cache-Control"] = "private, no-cache";
    return response;
}

Response Datasets::remove(const Call& call) {
    refuse_query(call.request);
    switch (store_.remove_dataset(call.path[0])) {
        case JobStore::RemoveDataset::unknown: throw unknown();
        case JobStore::RemoveDataset::in_use:
            throw Refusal({problem_type("dataset-in-use"), "a fit that has not ended uses it", {}});
        case JobStore::RemoveDataset::removed: break;
    }
    store_.sync();
    Response response;
    response.status = 204;
    return response;
}

}  // namespace brdfit::server
