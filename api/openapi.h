/// The published contract: OpenAPI 3.1, made from the tables by which requests are read and routed.
#pragma once

#include <span>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "api/query.h"
#include "api/schema.h"
#include "kernels/model.h"

namespace brdfit::api {

/// A form that a body may have.
struct Content {
    std::string_view type;  ///< media type
    schema::Json schema;
    schema::Json example{};  ///< null: none
};

struct Parameter {
    enum class In { path, query, header } in;
    std::string_view name;
    std::string_view doc;
    schema::Json schema;
    schema::Json example{};  ///< null: none
};

struct Answer {
    int status;
    std::string_view doc;
    std::vector<Content> contents{};
    std::vector<std::pair<std::string_view, std::string_view>> headers{};  ///< name, doc
};

/// A method of a resource: what it takes and what it answers.
struct Operation {
    std::string_view method;
    std::string_view path;  ///< a template, "/v1/fits/{id}": a name stands for one part of a path, or its beginning
    std::string_view id;    ///< for generated clients, "getFit"
    std::string_view tag;
    std::string_view summary;
    std::vector<Parameter> parameters{};
    std::vector<Content> bodies{};  ///< none: it takes no body
    std::vector<Answer> answers{};
    /// Names of kProblemTypes, beside those that any request may meet.
    std::vector<std::string_view> problems{};
};

/// Parameters of the query that a table of fields reads.
std::vector<Parameter> in_query(const std::vector<QueryParameter>& fields);

/// The document, as JSON.
std::string openapi_json(std::span<const Operation* const> operations, const kernels::Catalogue& catalogue);

/// The same for people: one HTML page without anything from outside.
std::string docs_html(std::span<const Operation* const> operations, const kernels::Catalogue& catalogue);

/// The page at the service's root: where to go, and a first command. `url`: where the client reached us.
std::string index_html(const std::string& url);

}  // namespace brdfit::api
