#include "api/openapi.h"

#include <algorithm>
#include <map>

#include <fmt/format.h>

#include "api/answers.h"
#include "api/problem.h"
#include "api/response.h"
#include "api/svg.h"

namespace brdfit::api {
namespace {

using schema::Json;

constexpr std::string_view kProblemContent = "application/problem+json";

std::string lower(std::string_view text) {
    std::string out(text);
    std::transform(out.begin(), out.end(), out.begin(), [](unsigned char c) { return std::tolower(c); });
    return out;
}

std::string_view name_of(Parameter::In in) {
    return in == Parameter::In::path ? "path" : in == Parameter::In::query ? "query" : "header";
}

Json content_json(const std::vector<Content>& contents) {
    Json json = Json::object();
    for (const Content& content : contents) {
        Json& form = json[std::string(content.type)];
        form["schema"] = content.schema;
        if (!content.example.is_null()) form["example"] = content.example;
    }
    return json;
}

Json parameter_json(const Parameter& parameter) {
    Json json{{"name", parameter.name},
              {"in", name_of(parameter.in)},
              {"required", parameter.in == Parameter::In::path},
              {"description", parameter.doc},
              {"schema", parameter.schema}};
    if (parameter.in == Parameter::In::query && parameter.schema.value("type", "") == "array") {
        json["style"] = "form";
        json["explode"] = false;  // separated by commas
    }
    if (!parameter.example.is_null()) json["example"] = parameter.example;
    return json;
}

Json answer_json(const Answer& answer) {
    Json json{{"description", answer.doc}};
    for (const auto& [name, doc] : answer.headers)
        json["headers"][std::string(name)] = {{"description", doc}, {"schema", schema::text()}};
    if (!answer.contents.empty()) json["content"] = content_json(answer.contents);
    return json;
}

/// Kinds of problems of an operation by status.
std::map<int, std::string> problems_of(const Operation& operation) {
    std::map<int, std::string> problems;
    for (const ProblemType& type : kProblemTypes)
        if (std::find(operation.problems.begin(), operation.problems.end(), type.name) != operation.problems.end()) {
            std::string& doc = problems[type.status];
            doc += (doc.empty() ? "" : "; ") + std::string(type.name) + ": " + std::string(type.doc);
        }
    return problems;
}

Json problem_json(const std::string& doc) {
    return {{"description", doc},
            {"content", {{std::string(kProblemContent), {{"schema", schema::named("Problem")}}}}}};
}

Json operation_json(const Operation& operation) {
    Json json{{"operationId", operation.id}, {"tags", {operation.tag}}, {"summary", operation.summary}};
    for (const Parameter& parameter : operation.parameters) json["parameters"].push_back(parameter_json(parameter));
    if (!operation.bodies.empty())
        json["requestBody"] = {{"required", true}, {"content", content_json(operation.bodies)}};
    for (const Answer& answer : operation.answers)
        json["responses"][std::to_string(answer.status)] = answer_json(answer);
    for (const auto& [status, doc] : problems_of(operation))
        json["responses"][std::to_string(status)] = problem_json(doc);
    json["responses"]["default"] = problem_json("what any request may meet; see the schema's type");
    return json;
}

// ---- HTML ----

std::string html(std::string_view text) { return escape(text).xml; }

/// Text whose lines stay lines.
std::string escape_lines(std::string_view text) {
    std::string out;
    while (!text.empty()) {
        const std::size_t end = std::min(text.find('\n'), text.size());
        out += html(text.substr(0, end));
        if (end < text.size()) out += '\n';
        text.remove_prefix(std::min(end + 1, text.size()));
    }
    return out;
}

constexpr std::string_view kPage = R"(<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>{}</title><style>
body {{ font: 15px/1.5 system-ui, sans-serif; max-width: 60em; margin: 2em auto; padding: 0 1em; color: #222; }}
code, pre {{ font: 13px/1.4 ui-monospace, monospace; }} pre {{ background: #f4f4f4; padding: .7em; overflow-x: auto; }}
h2 {{ border-top: 1px solid #ccc; padding-top: 1em; }} table {{ border-collapse: collapse; }}
td, th {{ text-align: left; vertical-align: top; padding: .15em 1em .15em 0; }} summary {{ cursor: pointer; }}
</style></head><body>
)";

std::string page(std::string_view title, std::string_view body) {
    return fmt::format(kPage, html(title)) + std::string(body) + "</body></html>\n";
}

void append_contents(std::string& out, std::string_view heading, const std::vector<Content>& contents) {
    for (const Content& content : contents) {
        out += fmt::format("<details><summary>{} <code>{}</code></summary>\n", html(heading), html(content.type));
        if (content.example.is_string())
            out += "<p>For example</p><pre>" + escape_lines(content.example.get<std::string>()) + "</pre>\n";
        else if (!content.example.is_null())
            out += "<p>For example</p><pre>" + escape_lines(content.example.dump(2)) + "</pre>\n";
        out += "<p>Schema</p><pre>" + escape_lines(content.schema.dump(2)) + "</pre></details>\n";
    }
}

std::string operation_html(const Operation& operation) {
    std::string out = fmt::format("<h3 id=\"{0}\"><code>{1} {2}</code></h3>\n<p>{3}</p>\n", html(operation.id),
                                  html(operation.method), html(operation.path), html(operation.summary));
    if (!operation.parameters.empty()) {
        out += "<table>\n";
        for (const Parameter& parameter : operation.parameters)
            out += fmt::format("<tr><td><code>{}</code></td><td>{}</td><td>{}</td></tr>\n", html(parameter.name),
                               html(name_of(parameter.in)), html(parameter.doc));
        out += "</table>\n";
    }
    append_contents(out, "Body", operation.bodies);
    for (const Answer& answer : operation.answers) {
        out += fmt::format("<p><b>{}</b> {}</p>\n", answer.status, html(answer.doc));
        append_contents(out, "Answer", answer.contents);
    }
    for (const auto& [status, doc] : problems_of(operation))
        out += fmt::format("<p><b>{}</b> {}</p>\n", status, html(doc));
    return out;
}

std::string docs_page(const Json& schemas, std::span<const Operation* const> operations) {
    std::string out = fmt::format(
        "<h1>brdfit {}</h1>\n<p>The same as <a href=\"/openapi.json\">OpenAPI 3.1</a>. Angles are in degrees, BRDF in "
        "1/sr, lengths in micrometres, wavelengths in nm.</p>\n",
        html(version()));
    std::string_view tag;
    for (const Operation* operation : operations) {
        if (operation->tag != tag) out += "<h2>" + html(operation->tag) + "</h2>\n";
        tag = operation->tag;
        out += operation_html(*operation);
    }
    out +=
        "<h2 id=\"problems\">Problems</h2>\n<p>Errors are <code>application/problem+json</code> (RFC "
        "9457).</p>\n<table>\n";
    for (const ProblemType& type : kProblemTypes)
        out += fmt::format("<tr id=\"{0}\"><td><code>/problems/{0}</code></td><td>{1}</td><td>{2}: {3}</td></tr>\n",
                           html(type.name), type.status, html(type.title), html(type.doc));
    out += "</table>\n<h2>Schemas</h2>\n";
    for (const auto& [name, schema] : schemas.items())
        out += fmt::format("<details id=\"schema-{0}\"><summary><code>{0}</code></summary><pre>{1}</pre></details>\n",
                           html(name), escape_lines(schema.dump(2)));
    return page("brdfit: the API", out);
}

}  // namespace

std::vector<Parameter> in_query(const std::vector<QueryParameter>& fields) {
    std::vector<Parameter> parameters;
    for (const QueryParameter& field : fields)
        parameters.push_back({Parameter::In::query, field.key, field.doc, field.schema, {}});
    return parameters;
}

std::string openapi_json(std::span<const Operation* const> operations, const kernels::Catalogue& catalogue) {
    Json paths = Json::object();
    for (const Operation* operation : operations)
        paths[std::string(operation->path)][lower(operation->method)] = operation_json(*operation);
    Json document{
        {"openapi", "3.1.0"},
        {"info",
         {{"title", "brdfit"},
          {"version", version()},
          {"description",
           "Fits reflectance models to measured scans. Angles are in degrees, BRDF in 1/sr, lengths in "
           "micrometres, wavelengths in nm. Changes are additive: expect more members in answers."}}},
        {"paths", std::move(paths)},
        {"components",
         {{"schemas", component_schemas(catalogue)},
          {"securitySchemes",
           {{"key",
             {{"type", "http"}, {"scheme", "bearer"}, {"description", "where the service asks for API keys"}}}}}}},
        {"security", Json::array({Json::object(), {{"key", Json::array()}}})}};
    return document.dump() + "\n";
}

std::string docs_html(std::span<const Operation* const> operations, const kernels::Catalogue& catalogue) {
    return docs_page(component_schemas(catalogue), operations);
}

std::string index_html(const std::string& url) {
    constexpr std::string_view kBody = R"(<h1>brdfit {0}</h1>
<p>Fits reflectance models to measured BRDF scans and ranks them. A file with the columns
<code>theta_i_deg,theta_r_deg,brdf_per_sr</code> is enough:</p>
<pre>curl -H 'Content-Type: text/csv' --data-binary @scan.csv '{1}/v1/fits?models=ward,lafortune'</pre>
<ul>
<li><a href="/docs">The API</a>, and as <a href="/openapi.json">OpenAPI 3.1</a></li>
<li><a href="/v1/models">Models</a> with their parameters, bounds and sources</li>
<li><a href="/v1/fits">Fits</a> and <a href="/v1/datasets">datasets</a> that are kept here</li>
<li><a href="/v1">This service</a>: version, device, limits</li>
<li><a href="/health/ready">Whether it is ready</a></li>
</ul>
)";
    return page("brdfit", fmt::format(kBody, html(version()), html(url)));
}

}  // namespace brdfit::api
