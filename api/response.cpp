#include "api/response.h"

#include <algorithm>
#include <cmath>

#include <nlohmann/json.hpp>

#include "api/evaluate.h"
#include "api/json.h"
#include "api/names.h"
#include "api/samples.h"

namespace brdfit::api {
namespace {

using Json = nlohmann::ordered_json;  // members in the order people read them

Json number(double value) { return std::isfinite(value) ? Json(value) : Json(nullptr); }
Json number(const std::optional<double>& value) { return value ? number(*value) : Json(nullptr); }

Json service_links() {
    return {{"self", "/"},
            {"service", "/v1"},
            {"documentation", "/docs"},
            {"openapi", "/openapi.json"},
            {"models", "/v1/models"},
            {"datasets", "/v1/datasets"},
            {"fits", "/v1/fits"},
            {"evaluate", "/v1/evaluate"},
            {"health", "/health/ready"}};
}

Json device_json(const kernels::DeviceInfo& device) {
    return {{"name", device.name}, {"platform", device.platform}, {"type", device.type}};
}

Json parameter_json(const optim::FittedParameter& p) {
    Json json{{"value", number(p.value)},
              {"std_error", number(p.std_error)},
              {"interval_95", nullptr},
              {"unit", p.unit},
              {"at_bound", p.at_bound}};
    if (p.interval_95) json["interval_95"] = {number((*p.interval_95)[0]), number((*p.interval_95)[1])};
    if (p.fixed) json["fixed"] = true;
    return json;
}

/// As many are told one by one.
constexpr std::size_t kToldOutliers = 100;

Json outliers_json(const optim::Outliers& outliers) {
    Json samples = Json::array();
    for (std::size_t i = 0; i < std::min(kToldOutliers, outliers.samples.size()); ++i)
        samples.push_back(outliers.samples[i]);
    return {{"count", outliers.samples.size()}, {"fraction", number(outliers.fraction)}, {"samples", samples}};
}

Json loss_json(const optim::Criterion& loss, const std::optional<double>& robust_scale) {
    Json json{{"name", name_of(kLosses, loss.kind)}};
    if (loss.kind == optim::Loss::cosine) {
        json["cos_theta_i_exponent"] = loss.cos_theta_i_power();
        json["cos_theta_r_exponent"] = loss.cos_theta_r_power();
    }
    json["robust"] = name_of(kRobusts, loss.robust);
    if (loss.robust == optim::Robust::none) return json;
    json["robust_threshold"] = loss.threshold();
    json["robust_scale"] = number(robust_scale);
    return json;
}

Json albedo_json(const std::vector<optim::DirectionalAlbedo>& albedos) {
    Json json = Json::array();
    for (const optim::DirectionalAlbedo& albedo : albedos)
        json.push_back(
            {{"theta_i_deg", albedo.theta_i_deg}, {"value", number(albedo.value)}, {"error", number(albedo.error)}});
    return json;
}

Json physics_json(const optim::Physics& physics) {
    return {{"energy_conserving", physics.energy_conserving ? Json(*physics.energy_conserving) : Json(nullptr)},
            {"theta_i_deg", {physics.theta_i_deg.min, physics.theta_i_deg.max}},
            {"max_albedo", number(physics.max_albedo)},
            {"at_theta_i_deg", number(physics.at_theta_i_deg)},
            {"reciprocal", physics.reciprocal},
            {"nonnegative", physics.nonnegative}};
}

Json constrained_json(const optim::Constrained& constrained, double loss) {
    Json require = Json::array();
    for (const optim::Requirement requirement : constrained.require)
        require.push_back(name_of(kRequirements, requirement));
    const double ratio = loss == constrained.loss_without ? 1 : loss / constrained.loss_without;
    return {{"require", require}, {"loss_without", number(constrained.loss_without)}, {"loss_ratio", number(ratio)}};
}

Json cost_json(const kernels::Cost& cost) {
    Json json{
        {"single_ns", number(cost.single_ns)}, {"double_ns", number(cost.double_ns)}, {"under_load", cost.under_load}};
    if (const auto& n = cost.operations)
        json["operations"] = {
            {"add", n->add}, {"multiply", n->multiply}, {"fma", n->fma}, {"divide", n->divide}, {"sqrt", n->sqrt}};
    return json;
}

Json errors_json(const std::vector<optim::ScanError>& scans) {
    Json json = Json::array();
    for (const optim::ScanError& scan : scans)
        json.push_back(
            {{"theta_i_deg", scan.theta_i_deg}, {"rmse", number(scan.rmse)}, {"log10_rmse", number(scan.log10_rmse)}});
    return json;
}

Json held_out_json(const optim::HeldOut& held_out) {
    return {{"rmse", number(held_out.rmse)},
            {"log10_rmse", number(held_out.log10_rmse)},
            {"loss", number(held_out.loss)},
            {"angles", errors_json(held_out.angles)}};
}

Json correlations_json(const optim::Correlations& correlations) {
    const std::size_t n = correlations.names.size();
    Json matrix = Json::array();
    for (std::size_t i = 0; i < n; ++i) {
        Json row = Json::array();
        for (std::size_t j = 0; j < n; ++j) row.push_back(number(correlations.matrix[i * n + j]));
        matrix.push_back(std::move(row));
    }
    return {{"names", correlations.names}, {"matrix", matrix}};
}

Json rivals_json(const std::vector<optim::Rival>& rivals) {
    Json json = Json::array();
    for (const optim::Rival& rival : rivals) {
        Json parameters = Json::object();
        for (const auto& [name, value] : rival.parameters) parameters[name] = number(value);
        json.push_back({{"loss", number(rival.loss)}, {"agreed", rival.agreed}, {"parameters", parameters}});
    }
    return json;
}

Json ledger_json(const std::vector<optim::LedgerLine>& ledger) {
    Json json = Json::array();
    for (const optim::LedgerLine& line : ledger) {
        Json& entry = json.emplace_back(Json{{"change", name_of(kLessWork, line.change)},
                                             {"loss_ratio", number(line.loss_ratio)},
                                             {"evaluations", line.evaluations}});
        if (line.time_s) entry["time_s"] = number(*line.time_s);
        if (line.lobes) entry["lobes"] = *line.lobes;
        if (const auto& shift = line.largest_shift)
            entry["largest_shift"] = {{"parameter", shift->parameter},
                                      {"std_errors", number(shift->std_errors)},
                                      {"relative", number(shift->relative)}};
    }
    return json;
}

Json noise_json(const optim::NoiseRecord& noise) {
    Json json{{"relative", number(noise.relative)}, {"floor", number(noise.floor)}};
    if (noise.relative_error) json["uncertainty"] = number(*noise.relative_error);
    json["source"] = name_of(kNoiseSources, noise.source);
    return json;
}

Json fit_json(const optim::Fit& fit, const std::string& plot_link) {
    Json json{{"rank", fit.rank}, {"model", fit.model}};
    if (fit.lobes > 0) json["lobes"] = fit.lobes;
    if (!fit.submodel.empty()) json["submodel"] = fit.submodel;
    json["parameters"] = Json::object();
    for (const optim::FittedParameter& p : fit.parameters) json["parameters"][p.name] = parameter_json(p);
    if (fit.scale) json["scale"] = number(*fit.scale);
    json["loss"] = number(fit.loss);
    json["relative_loss"] = number(fit.relative_loss);
    json["rmse"] = number(fit.rmse);
    json["log10_rmse"] = number(fit.log10_rmse);
    json["aicc"] = number(fit.aicc);
    json["bic"] = number(fit.bic);
    json["held_out"] = fit.held_out ? held_out_json(*fit.held_out) : Json(nullptr);
    json["scans"] = errors_json(fit.scans);
    if (fit.outliers) json["outliers"] = outliers_json(*fit.outliers);
    if (fit.physics) {
        json["albedo"] = albedo_json(fit.albedo);
        json["physics"] = physics_json(*fit.physics);
    }
    if (fit.constrained) json["constrained"] = constrained_json(*fit.constrained, fit.loss);
    if (fit.cost) json["cost"] = cost_json(*fit.cost);
    json["correlations"] = correlations_json(fit.correlations);
    if (fit.replicates > 0) json["bootstrap"] = {{"replicates", fit.replicates}};
    json["search"] = {
        {"starts", fit.search.starts},           {"agreed", fit.search.agreed},
        {"evaluations", fit.search.evaluations}, {"stop_reason", name_of(kStopReasons, fit.search.stop_reason)},
        {"time_s", number(fit.search.time_s)},   {"rivals", rivals_json(fit.search.rivals)}};
    if (!fit.ledger.empty()) json["ledger"] = ledger_json(fit.ledger);
    if (!fit.warnings.empty()) json["warnings"] = fit.warnings;
    json["links"] = {{"plot", plot_link}};
    return json;
}

Json pareto_json(const optim::ChannelReport& channel, const optim::ParetoPoint& point) {
    const optim::Fit& fit = channel.fits[point.fit];
    Json json{{"model", fit.model}};
    if (fit.lobes > 0) json["lobes"] = fit.lobes;
    if (!fit.submodel.empty()) json["submodel"] = fit.submodel;
    json["rank"] = fit.rank;
    json["ns_per_evaluation"] = number(point.ns_per_evaluation);
    json["log10_rmse"] = number(point.log10_rmse);
    return json;
}

Json recommended_json(const optim::ChannelReport& channel) {
    const optim::Recommendation& recommended = *channel.recommended;
    Json json{{"model", nullptr}};
    if (recommended.fit) {
        const optim::Fit& fit = channel.fits[*recommended.fit];
        json["model"] = fit.model;
        if (fit.lobes > 0) json["lobes"] = fit.lobes;
        if (!fit.submodel.empty()) json["submodel"] = fit.submodel;
        json["rank"] = fit.rank;
    }
    json["reason"] = recommended.reason;
    if (recommended.next_better) json["next_better"] = pareto_json(channel, *recommended.next_better);
    return json;
}

Json scene_json(const optim::Scene& scene) {
    Json json{{"theta_i_deg", {scene.theta_i_deg.min, scene.theta_i_deg.max}},
              {"theta_r_deg", {scene.theta_r_deg.min, scene.theta_r_deg.max}},
              {"outside_weight", scene.outside_weight},
              {"tolerance_log10", scene.tolerance_log10}};
    if (scene.max_ns_per_evaluation) json["max_ns_per_evaluation"] = *scene.max_ns_per_evaluation;
    return json;
}

Json channel_json(const optim::ChannelReport& channel, const optim::Criterion& loss, const std::string& plots,
                  bool one_of_many) {
    Json json{{"name", channel.channel.name}};
    if (channel.channel.wavelength_nm) json["wavelength_nm"] = *channel.channel.wavelength_nm;
    json["samples"] = channel.channel.samples.size();
    json["loss"] = loss_json(loss, channel.robust_scale);
    json["noise"] = noise_json(channel.noise);
    const std::string which = one_of_many ? "&channel=" + url_encoded(channel.channel.name) : "";
    json["fits"] = Json::array();
    for (const optim::Fit& fit : channel.fits)
        json["fits"].push_back(fit_json(fit, plots + "brdf.svg?models=" + fit.model + which));
    json["failures"] = Json::array();
    for (const optim::Failure& failure : channel.failures) {
        Json entry{{"model", failure.model}};
        if (!failure.submodel.empty()) entry["submodel"] = failure.submodel;
        entry["reason"] = failure.reason;
        json["failures"].push_back(std::move(entry));
    }
    if (channel.recommended) {
        json["recommended"] = recommended_json(channel);
        json["pareto"] = Json::array();
        for (const optim::ParetoPoint& point : channel.pareto) json["pareto"].push_back(pareto_json(channel, point));
    }
    if (!channel.warnings.empty()) json["warnings"] = channel.warnings;
    return json;
}

/// null for a domain without an end.
Json bound_json(double value) { return std::isfinite(value) ? Json(value) : Json(nullptr); }

Json model_parameter_json(const kernels::Model& model, std::size_t index) {
    const kernels::Parameter& p = model.parameters[index];
    return {{"name", p.name},
            {"unit", p.unit},
            {"min", p.min},
            {"max", p.max},
            {"domain", {bound_json(p.domain_min), bound_json(p.domain_max)}},
            {"scale", p.scale == kernels::Scale::logarithmic ? "log" : "linear"},
            {"linear", model.is_linear(index)},
            {"doc", p.doc}};
}

Json family_json(const kernels::Family& family) {
    const kernels::Model& model = family.variants.back();
    Json json{{"name", family.name}, {"title", model.title}, {"source", model.source}, {"formula", model.formula}};
    json["parameters"] = Json::array();
    for (std::size_t i = 0; i < model.parameters.size(); ++i)
        json["parameters"].push_back(model_parameter_json(model, i));
    if (family.repeat)
        json["options"] = {{family.repeat->option,
                            {{"min", family.repeat->min},
                             {"max", family.repeat->max},
                             {"default", "auto"},
                             {"auto_max", family.repeat->auto_max}}}};
    json["submodels"] = Json::array();
    for (const kernels::Submodel& submodel : family.submodels) json["submodels"].push_back(submodel.name);
    json["traits"] = Json::object();
    for (const auto& [name, value] : model.traits) json["traits"][name] = value;
    json["links"] = {{"self", "/v1/models/" + family.name}};
    return json;
}

Json worst_json(const kernels::WorstError& error) {
    Json json{{"eps", number(error.eps)}};
    if (error.eps > kernels::kLargestError_eps) json["at"] = error.where;
    return json;
}

Json model_test_json(const kernels::ModelTest& test) {
    Json json{{"model", test.model}};
    if (test.lobes > 0) json["lobes"] = test.lobes;
    json["points"] = test.points;
    if (test.points > 0) {
        json["value"] = worst_json(test.value);
        json["slope"] = worst_json(test.slope);
    }
    if (test.points > 0 || !test.passed()) json["passed"] = test.passed();
    json["time_ms"] = number(test.time_ms);
    return json;
}

Json self_tests_json(std::span<const kernels::SelfTest> tests) {
    Json precisions = Json::array();
    for (const kernels::SelfTest& test : tests) {
        Json json{{"precision", name_of(kPrecisions, test.precision)},
                  {"form", name_of(kSelfTestForms, test.form)},
                  {"passed", test.passed()}};
        if (!test.passed()) json["reason"] = test.reason();
        json["time_ms"] = number(test.time_ms());
        json["models"] = Json::array();
        for (const kernels::ModelTest& model : test.models) json["models"].push_back(model_test_json(model));
        precisions.push_back(std::move(json));
    }
    return {{"largest_error_eps", kernels::kLargestError_eps}, {"precisions", precisions}};
}

}  // namespace

std::string version() { return BRDFIT_VERSION; }

std::string url_encoded(std::string_view text) {
    constexpr std::string_view kHex = "0123456789ABCDEF";
    std::string out;
    for (const char c : text) {
        const auto byte = static_cast<unsigned char>(c);
        if (std::isalnum(byte) != 0 || c == '-' || c == '_' || c == '.' || c == '~') out += c;
        else out += {'%', kHex[byte >> 4], kHex[byte & 15]};
    }
    return out;
}

Json fit_links(const std::string& id) {
    const std::string self = "/v1/fits/" + id;
    const std::string plots = self + "/plots/";
    return {{"self", self},
            {"result", self + "/result"},
            {"plots",
             {{"brdf", plots + "brdf.svg"}, {"residual", plots + "residual.svg"}, {"summary", plots + "summary.svg"}}}};
}

std::string to_json(const optim::Report& report, const std::string& id) {
    const std::string plots = "/v1/fits/" + id + "/plots/";
    bool any = false;
    Json channels = Json::array();
    for (const optim::ChannelReport& channel : report.channels) {
        channels.push_back(channel_json(channel, report.loss, plots, report.channels.size() > 1));
        any = any || !channel.fits.empty();
    }
    Json device = device_json(report.device);
    device["precision"] = name_of(kPrecisions, report.precision);
    Json json{{"id", id},
              {"state", any ? "succeeded" : "failed"},
              {"version", version()},
              {"seed", report.seed},
              {"device", device},
              {"dataset", {{"name", report.dataset}, {"unit", name_of(kUnits, report.unit)}}}};
    if (report.scene) json["scene"] = scene_json(*report.scene);
    json["channels"] = std::move(channels);
    json["links"] = fit_links(id);
    return line_of(json);
}

std::string to_json(const kernels::Catalogue& catalogue) {
    Json models = Json::array();
    for (const kernels::Family& family : catalogue.families()) models.push_back(family_json(family));
    return line_of({{"models", models}});
}

std::string to_json(const kernels::Family& family, std::span<const kernels::Cost> costs) {
    Json json = family_json(family);
    if (!costs.empty()) json["costs"] = Json::array();
    const std::vector<const kernels::Model*> texts = family.texts();
    for (std::size_t i = 0; i < costs.size(); ++i) {
        Json cost = Json::object();
        if (texts[i]->repeats > 0) cost["lobes"] = texts[i]->repeats;
        for (const kernels::Submodel& submodel : family.submodels)
            for (const kernels::Model& model : submodel.variants)
                if (&model == texts[i]) cost["submodel"] = submodel.name;
        cost.update(cost_json(costs[i]));
        json["costs"].push_back(std::move(cost));
    }
    return line_of(json);
}

std::string to_json(std::span<const kernels::SelfTest> tests) { return line_of(self_tests_json(tests)); }

std::string to_json(const kernels::DeviceInfo& device, std::span<const kernels::Throughput> throughputs) {
    Json precisions = Json::array();
    for (const kernels::Throughput& throughput : throughputs) {
        Json models = Json::array();
        for (const kernels::ModelRate& rate : throughput.models) {
            Json launches = Json::array();
            for (std::size_t i = 0; i < rate.evaluations_per_s.size(); ++i)
                launches.push_back(
                    {{"candidates", kernels::kLaunches[i]}, {"evaluations_per_s", number(rate.evaluations_per_s[i])}});
            models.push_back({{"model", kernels::variant_name(rate.model, rate.lobes)},
                              {"launches", launches},
                              {"value_ns", number(rate.cost.ns)},
                              {"under_load", rate.cost.under_load},
                              {"exps", number(rate.exps)},
                              {"fraction_of_exps", number(1 / rate.exps)}});
        }
        precisions.push_back({{"precision", name_of(kPrecisions, throughput.precision)},
                              {"exps_per_s", number(throughput.exps_per_s)},
                              {"models", models}});
    }
    return line_of({{"device", device_json(device)}, {"samples", kernels::kLaunchSamples}, {"precisions", precisions}});
}

std::string to_json(const kernels::DeviceInfo& device, const optim::FitBench& bench) {
    Json timings = Json::array();
    for (const optim::FitTiming& t : bench.timings)
        timings.push_back({{"growth", t.growth},
                           {"judge", t.judge},
                           {"models", t.models},
                           {"channels", t.channels},
                           {"samples", t.samples},
                           {"effort", name_of(kEfforts, t.effort)},
                           {"requests", t.requests},
                           {"repetitions", t.repetitions},
                           {"wall_s", number(t.wall_s)},
                           {"cpu_s", number(t.cpu_s)},
                           {"peak_MiB", number(t.peak_MiB)}});
    Json batches = Json::array();
    for (const optim::BatchTiming& b : bench.batches)
        batches.push_back({{"datasets", b.datasets},
                           {"samples", b.samples},
                           {"first_per_s", number(b.first_per_s)},
                           {"last_per_s", number(b.last_per_s)},
                           {"first_MiB", number(b.first_MiB)},
                           {"last_MiB", number(b.last_MiB)}});
    return line_of(
        {{"device", device_json(device)}, {"threads", bench.threads}, {"timings", timings}, {"batches", batches}});
}

std::string to_json(const kernels::DeviceInfo& device, const optim::TradeBench& bench) {
    Json cells = Json::array();
    for (const optim::TradeCell& c : bench.cells)
        cells.push_back({{"dataset", c.dataset},
                         {"model", c.model},
                         {"effort", name_of(kEfforts, c.effort)},
                         {"precision", name_of(kArithmetics, c.arithmetic)},
                         {"seeds", c.seeds},
                         {"wall_s", number(c.wall_s)},
                         {"cpu_s", number(c.cpu_s)},
                         {"evaluations", number(c.evaluations)},
                         {"distance", number(c.distance)},
                         {"worst_distance", number(c.worst)},
                         {"success", number(c.success)}});
    Json shifts = Json::array();
    for (const optim::PrecisionShift& s : bench.shifts)
        shifts.push_back({{"dataset", s.dataset},
                          {"model", s.model},
                          {"precision", name_of(kArithmetics, s.arithmetic)},
                          {"seeds", s.seeds},
                          {"parameter", s.parameter.empty() ? Json(nullptr) : Json(s.parameter)},
                          {"std_errors", number(s.std_errors)},
                          {"relative", number(s.relative)}});
    Json series = Json::array();
    for (const optim::SeriesPoint& p : bench.series)
        series.push_back({{"dataset", p.dataset},
                          {"precision", name_of(kPrecisions, p.precision)},
                          {"accuracy", p.accuracy},
                          {"log_epsilon", number(p.log_epsilon)},
                          {"error", number(p.error)},
                          {"ns", number(p.ns)}});
    return line_of({{"device", device_json(device)},
                    {"seeds", bench.seeds},
                    {"cells", cells},
                    {"shifts", shifts},
                    {"series", series}});
}

std::string service_json(const kernels::DeviceInfo& device, std::span<const kernels::SelfTest> tests,
                         std::size_t largest_body) {
    return line_of({{"name", "brdfit"},
                    {"version", version()},
                    {"device", device_json(device)},
                    {"selftest", self_tests_json(tests)},
                    {"limits",
                     {{"body_bytes", largest_body},
                      {"samples", kMostSamples},
                      {"channels", kMostChannels},
                      {"evaluate_rows", kMostRows}}},
                    {"links", service_links()}});
}

std::string links_json() { return line_of({{"name", "brdfit"}, {"version", version()}, {"links", service_links()}}); }

std::string ready_json(std::span<const kernels::SelfTest> tests, bool ready) {
    return line_of({{"status", ready ? "ready" : "unfit"}, {"selftest", self_tests_json(tests)}});
}

}  // namespace brdfit::api
