#include "api/stored.h"

#include <algorithm>
#include <array>
#include <cmath>

#include <nlohmann/json.hpp>

#include "api/json.h"
#include "api/names.h"
#include "api/response.h"

namespace brdfit::api {
namespace {

using Json = nlohmann::ordered_json;

/// An object that we wrote ourselves earlier; null if it is none.
Json object_of(std::string_view text) {
    Json json = Json::parse(text, nullptr, false);
    return json.is_object() ? json : Json();
}

Json status_json(const FitStatus& status) {
    const std::string self = "/v1/fits/" + status.id;
    Json json{{"id", status.id}, {"state", status.state}, {"done", status.done}};
    if (status.dataset) json["dataset"] = *status.dataset;
    if (status.queue_position) json["queue_position"] = *status.queue_position;
    json["attempt"] = status.attempt;
    if (Json progress = object_of(status.progress); !progress.is_null()) json["progress"] = std::move(progress);
    json["created"] = status.created;
    if (status.started) json["started"] = *status.started;
    if (status.ended) json["ended"] = *status.ended;
    if (Json error = object_of(status.error); !error.is_null()) {
        for (const char* of_a_request : {"instance", "request_id"}) error.erase(of_a_request);
        json["error"] = std::move(error);
    }
    json["links"] = fit_links(status.id);
    json["links"]["events"] = self + "/events";
    if (!status.done) json["links"]["cancel"] = self + "/cancel";
    if (status.dataset) json["links"]["dataset"] = "/v1/datasets/" + *status.dataset;
    return json;
}

Json dataset_json(const StoredDataset& dataset) {
    Json json{{"id", dataset.id}};
    const Json summary = object_of(dataset.summary);
    for (const auto& [key, value] : summary.items()) json[key] = value;
    json["bytes"] = dataset.bytes;
    json["created"] = dataset.created;
    json["links"] = {{"self", "/v1/datasets/" + dataset.id}, {"fits", "/v1/fits?dataset=" + dataset.id}};
    return json;
}

template <class Item, class Write>
std::string page(std::span<const Item> items, const std::optional<std::string>& next, const Write& write) {
    Json json{{"items", Json::array()}, {"next_cursor", next ? Json(*next) : Json(nullptr)}};
    for (const Item& item : items) json["items"].push_back(write(item));
    return line_of(json);
}

Json range_json(double least, double most) { return {{"min", least}, {"max", most}}; }

Json channel_summary(const optim::Channel& channel) {
    constexpr std::size_t kMostAngles = 100;
    Json json{{"name", channel.name}};
    if (channel.wavelength_nm) json["wavelength_nm"] = *channel.wavelength_nm;
    json["samples"] = channel.samples.size();
    std::vector<double> angles;
    std::size_t not_positive = 0;
    std::size_t out_of_plane = 0;
    bool sigma = true;
    for (const optim::Sample& sample : channel.samples) {
        angles.push_back(sample.direction.theta_i_deg);
        not_positive += sample.brdf <= 0 ? 1 : 0;
        out_of_plane += sample.direction.phi_deg != 0 ? 1 : 0;
        sigma = sigma && sample.sigma.has_value();
    }
    std::sort(angles.begin(), angles.end());
    angles.erase(std::unique(angles.begin(), angles.end()), angles.end());
    angles.resize(std::min(angles.size(), kMostAngles));
    json["theta_i_deg"] = angles;
    const auto extent = [&](const auto& value) {
        const auto [least, most] =
            std::minmax_element(channel.samples.begin(), channel.samples.end(),
                                [&](const optim::Sample& a, const optim::Sample& b) { return value(a) < value(b); });
        return range_json(value(*least), value(*most));
    };
    json["theta_r_deg"] = extent([](const optim::Sample& s) { return s.direction.theta_r_deg; });
    json["brdf"] = extent([](const optim::Sample& s) { return s.brdf; });
    json["not_positive"] = not_positive;
    json["out_of_plane"] = out_of_plane;
    json["sigma"] = sigma;
    return json;
}

/// A field as RFC 4180 writes it. What a spreadsheet would take for a formula is preceded by a quote mark.
std::string csv_field(const Json& value) {
    if (value.is_null()) return "";
    if (!value.is_string()) return value.dump();
    std::string text = value.get<std::string>();
    if (!text.empty() && std::string_view("=+-@\t\r").find(text.front()) != std::string_view::npos) text.insert(0, "'");
    if (text.find_first_of(",\"\r\n ") == std::string::npos) return text;
    std::string quoted = "\"";
    for (const char c : text) quoted += c == '"' ? std::string("\"\"") : std::string(1, c);
    return quoted + "\"";
}

}  // namespace

std::string to_json(const FitStatus& status) { return line_of(status_json(status)); }

std::string page_json(std::span<const FitStatus> items, const std::optional<std::string>& next) {
    return page(items, next, status_json);
}

FailedFit failed_fit(std::string_view error, const std::string& instance, const std::string& request_id) {
    Json json = object_of(error);
    const int status = json.is_object() ? json.value("status", 0) : 0;
    if (status < 400 || status > 599)
        return {500, to_json(Problem{problem_type("internal"), "the fit failed", {}}, instance, request_id)};
    json["instance"] = instance;
    json["request_id"] = request_id;
    return {status, line_of(json)};
}

std::string event_json(std::string_view kind, std::string_view body, const std::string& at) {
    Json json = kind == "state" || kind == "done" ? Json{{"state", body}} : object_of(body);
    if (json.is_null()) json = Json::object();
    json["at"] = at;
    return text_of(json);
}

std::string result_csv(std::string_view result) {
    constexpr std::array<const char*, 7> kOfFit{"rank",          "model", "lobes",     "loss",
                                                "relative_loss", "rmse",  "log10_rmse"};
    constexpr std::array<const char*, 4> kOfParameter{"value", "std_error", "unit", "at_bound"};
    std::string out = "channel,wavelength_nm";
    for (const char* key : kOfFit) out += std::string(",") + key;
    out += ",parameter";
    for (const char* key : kOfParameter) out += std::string(",") + key;
    out += "\r\n";
    const auto field = [](const Json& object, const char* key) {
        return csv_field(object.contains(key) ? object[key] : Json());
    };
    const Json json = object_of(result);
    if (json.is_null()) return out;
    for (const Json& channel : json.value("channels", Json::array()))
        for (const Json& fit : channel.value("fits", Json::array())) {
            std::string begin = field(channel, "name") + "," + field(channel, "wavelength_nm");
            for (const char* key : kOfFit) begin += "," + field(fit, key);
            const Json parameters = fit.value("parameters", Json::object());
            for (const auto& [name, parameter] : parameters.items()) {
                out += begin + "," + csv_field(name);
                for (const char* key : kOfParameter) out += "," + field(parameter, key);
                out += "\r\n";
            }
        }
    return out;
}

std::string summary_json(const optim::Dataset& dataset) {
    std::size_t samples = 0;
    Json channels = Json::array();
    for (const optim::Channel& channel : dataset.channels) {
        samples += channel.samples.size();
        channels.push_back(channel_summary(channel));
    }
    return line_of({{"name", dataset.name},
                    {"unit", name_of(kUnits, dataset.unit)},
                    {"samples", samples},
                    {"channels", channels}});
}

std::string to_json(const StoredDataset& dataset) { return line_of(dataset_json(dataset)); }

std::string to_json(const StoredDataset& dataset, std::string_view body) {
    Json json = dataset_json(dataset);
    json["dataset"] = object_of(body);
    return line_of(json);
}

std::string page_json(std::span<const StoredDataset> items, const std::optional<std::string>& next) {
    return page(items, next, [](const StoredDataset& dataset) { return dataset_json(dataset); });
}

}  // namespace brdfit::api
