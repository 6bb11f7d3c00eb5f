#include "api/archive.h"

#include <cstdint>
#include <cstring>
#include <stdexcept>

#include <nlohmann/json.hpp>

namespace brdfit::api {
namespace {

using Json = nlohmann::json;

std::string packed(const Json& json) {
    std::string bytes;
    Json::to_msgpack(json, bytes);
    return bytes;
}

/// What `read` makes of the bytes.
template <class Read>
auto unpacked(std::string_view bytes, const Read& read) {
    try {
        return read(Json::from_msgpack(bytes));
    } catch (const Json::exception& error) {
        throw std::invalid_argument(std::string("no archive of this version: ") + error.what());
    } catch (const std::out_of_range& error) {
        throw std::invalid_argument(std::string("an archive of columns that do not match: ") + error.what());
    }
}

/// Doubles as they are in memory: a column takes no time.
Json column(const std::vector<double>& values) {
    Json::binary_t::container_type bytes(values.size() * sizeof(double));
    if (!bytes.empty()) std::memcpy(bytes.data(), values.data(), bytes.size());
    return Json::binary(std::move(bytes));
}

std::vector<double> read_column(const Json& json) {
    const auto& bytes = json.get_binary();
    if (bytes.size() % sizeof(double) != 0) throw std::invalid_argument("no archive: half a number");
    std::vector<double> values(bytes.size() / sizeof(double));
    if (!values.empty()) std::memcpy(values.data(), bytes.data(), bytes.size());
    return values;
}

/// A column of one number for each element.
template <class Elements, class Number>
Json column_of(const Elements& elements, const Number& number) {
    std::vector<double> values;
    for (const auto& element : elements) values.push_back(number(element));
    return column(values);
}

template <class Value>
Json optional(const std::optional<Value>& value) {
    return value ? Json(*value) : Json();
}
template <class Value>
std::optional<Value> read_optional(const Json& json) {
    if (json.is_null()) return std::nullopt;
    return json.get<Value>();
}

// ---- reports ----

Json samples_json(const std::vector<optim::Sample>& samples) {
    using optim::Sample;
    Json sigmas = Json::array();  // mostly none: then nothing
    for (std::size_t i = 0; i < samples.size(); ++i)
        if (samples[i].sigma) sigmas.push_back({i, *samples[i].sigma});
    return {{"theta_i", column_of(samples, [](const Sample& s) { return s.direction.theta_i_deg; })},
            {"theta_r", column_of(samples, [](const Sample& s) { return s.direction.theta_r_deg; })},
            {"phi", column_of(samples, [](const Sample& s) { return s.direction.phi_deg; })},
            {"brdf", column_of(samples, [](const Sample& s) { return s.brdf; })},
            {"sigma", sigmas}};
}

std::vector<optim::Sample> read_samples(const Json& json) {
    const std::vector<double> theta_i = read_column(json.at("theta_i")), theta_r = read_column(json.at("theta_r")),
                              phi = read_column(json.at("phi")), brdf = read_column(json.at("brdf"));
    std::vector<optim::Sample> samples;
    for (std::size_t i = 0; i < brdf.size(); ++i)
        samples.push_back({{theta_i.at(i), theta_r.at(i), phi.at(i)}, brdf[i], {}});
    for (const Json& sigma : json.at("sigma")) samples.at(sigma.at(0).get<std::size_t>()).sigma = sigma.at(1);
    return samples;
}

Json fit_json(const optim::Fit& fit, const optim::Fit& first) {
    using optim::ScanError;
    Json log10_rmse = Json::array();
    for (const ScanError& scan : fit.scans) log10_rmse.push_back(optional(scan.log10_rmse));
    Json curves = Json::array();
    for (std::size_t i = 0; i < fit.curves.size(); ++i) {
        const optim::Fit::Curve& curve = fit.curves[i];
        Json json{{"theta_i", curve.theta_i_deg}, {"brdf", column(curve.brdf)}};
        // The fits of a channel are drawn at the same angles.
        const bool same = &fit != &first && i < first.curves.size() && first.curves[i].theta_r_deg == curve.theta_r_deg;
        if (!same) json["theta_r"] = column(curve.theta_r_deg);
        curves.push_back(std::move(json));
    }
    return {{"rank", fit.rank},
            {"model", fit.model},
            {"lobes", fit.lobes},
            {"submodel", fit.submodel},
            {"loss", fit.loss},
            {"relative_loss", fit.relative_loss},
            {"rmse", fit.rmse},
            {"log10_rmse", optional(fit.log10_rmse)},
            {"scan_theta_i", column_of(fit.scans, [](const ScanError& s) { return s.theta_i_deg; })},
            {"scan_rmse", column_of(fit.scans, [](const ScanError& s) { return s.rmse; })},
            {"scan_log10_rmse", log10_rmse},
            {"values", column(fit.values)},
            {"curves", curves}};
}

optim::Fit read_fit(const Json& json, const std::vector<optim::Fit>& before) {
    optim::Fit fit;
    json.at("rank").get_to(fit.rank);
    json.at("model").get_to(fit.model);
    json.at("lobes").get_to(fit.lobes);
    json.at("submodel").get_to(fit.submodel);
    json.at("loss").get_to(fit.loss);
    json.at("relative_loss").get_to(fit.relative_loss);
    json.at("rmse").get_to(fit.rmse);
    fit.log10_rmse = read_optional<double>(json.at("log10_rmse"));
    const std::vector<double> theta_i = read_column(json.at("scan_theta_i")), rmse = read_column(json.at("scan_rmse"));
    for (std::size_t i = 0; i < theta_i.size(); ++i)
        fit.scans.push_back({theta_i[i], rmse.at(i), read_optional<double>(json.at("scan_log10_rmse").at(i))});
    fit.values = read_column(json.at("values"));
    for (const Json& curve : json.at("curves")) {
        const std::vector<double> theta_r = curve.contains("theta_r")
                                                ? read_column(curve["theta_r"])
                                                : before.at(0).curves.at(fit.curves.size()).theta_r_deg;
        fit.curves.push_back({curve.at("theta_i"), theta_r, read_column(curve.at("brdf"))});
    }
    return fit;
}

// ---- devices ----

Json worst_json(const kernels::WorstError& worst) { return {{"eps", worst.eps}, {"where", worst.where}}; }
kernels::WorstError read_worst(const Json& json) { return {json.at("eps"), json.at("where")}; }

Json test_json(const kernels::SelfTest& test) {
    Json models = Json::array();
    for (const kernels::ModelTest& model : test.models)
        models.push_back({{"model", model.model},
                          {"lobes", model.lobes},
                          {"points", model.points},
                          {"value", worst_json(model.value)},
                          {"slope", worst_json(model.slope)},
                          {"refusal", model.refusal},
                          {"time_ms", model.time_ms}});
    return {{"precision", test.precision}, {"form", test.form}, {"models", models}};
}

kernels::SelfTest read_test(const Json& json) {
    kernels::SelfTest test{json.at("precision"), json.at("form"), {}};
    for (const Json& model : json.at("models"))
        test.models.push_back({model.at("model"), model.at("lobes"), model.at("points"), read_worst(model.at("value")),
                               read_worst(model.at("slope")), model.at("refusal"), model.at("time_ms")});
    return test;
}

}  // namespace

std::string archive(const optim::Report& report) {
    Json channels = Json::array();
    for (const optim::ChannelReport& channel : report.channels) {
        Json fits = Json::array();
        for (const optim::Fit& fit : channel.fits) fits.push_back(fit_json(fit, channel.fits.front()));
        Json failures = Json::array();
        for (const optim::Failure& failure : channel.failures) failures.push_back({failure.model, failure.reason});
        channels.push_back({{"name", channel.channel.name},
                            {"wavelength_nm", optional(channel.channel.wavelength_nm)},
                            {"samples", samples_json(channel.channel.samples)},
                            {"fits", fits},
                            {"recommended", channel.recommended ? optional(channel.recommended->fit) : Json()},
                            {"failures", failures}});
    }
    return packed({{"dataset", report.dataset}, {"unit", report.unit}, {"channels", channels}});
}

optim::Report read_archive(std::string_view bytes) {
    return unpacked(bytes, [](const Json& json) {
        optim::Report report;
        json.at("dataset").get_to(report.dataset);
        json.at("unit").get_to(report.unit);
        for (const Json& from : json.at("channels")) {
            optim::ChannelReport channel;
            from.at("name").get_to(channel.channel.name);
            channel.channel.wavelength_nm = read_optional<double>(from.at("wavelength_nm"));
            channel.channel.samples = read_samples(from.at("samples"));
            for (const Json& fit : from.at("fits")) channel.fits.push_back(read_fit(fit, channel.fits));
            if (const auto fit = read_optional<std::size_t>(from.at("recommended")); fit && *fit < channel.fits.size())
                channel.recommended.emplace().fit = fit;
            for (const Json& failure : from.at("failures"))
                channel.failures.push_back({failure.at(0), failure.at(1), ""});
            report.channels.push_back(std::move(channel));
        }
        return report;
    });
}

std::string archive(const DeviceFacts& facts) {
    Json costs = Json::array();
    for (const ModelCost& cost : facts.costs)
        costs.push_back({cost.model, cost.lobes, optional(cost.single_ns), optional(cost.double_ns), cost.under_load});
    Json tests = Json::array();
    for (const kernels::SelfTest& test : facts.self_tests) tests.push_back(test_json(test));
    const kernels::DeviceInfo& device = facts.device;
    return packed({{"name", device.name},
                   {"platform", device.platform},
                   {"version", device.version},
                   {"type", device.type},
                   {"has_double", device.has_double},
                   {"compute_units", device.compute_units},
                   {"runs_inline", device.runs_inline},
                   {"self_tests", tests},
                   {"complete", facts.complete},
                   {"costs", costs},
                   {"single_refusal", optional(facts.single_refusal)},
                   {"double_refusal", optional(facts.double_refusal)}});
}

DeviceFacts read_device_facts(std::string_view bytes) {
    return unpacked(bytes, [](const Json& json) {
        DeviceFacts facts;
        json.at("name").get_to(facts.device.name);
        json.at("platform").get_to(facts.device.platform);
        json.at("version").get_to(facts.device.version);
        json.at("type").get_to(facts.device.type);
        json.at("has_double").get_to(facts.device.has_double);
        json.at("compute_units").get_to(facts.device.compute_units);
        json.at("runs_inline").get_to(facts.device.runs_inline);
        for (const Json& test : json.at("self_tests")) facts.self_tests.push_back(read_test(test));
        json.at("complete").get_to(facts.complete);
        for (const Json& cost : json.at("costs"))
            facts.costs.push_back({cost.at(0), cost.at(1), read_optional<double>(cost.at(2)),
                                   read_optional<double>(cost.at(3)), cost.at(4)});
        facts.single_refusal = read_optional<std::string>(json.at("single_refusal"));
        facts.double_refusal = read_optional<std::string>(json.at("double_refusal"));
        return facts;
    });
}

}  // namespace brdfit::api
