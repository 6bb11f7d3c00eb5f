/// The program `brdfit`: reads the command line and wires the parts.
#include <algorithm>
#include <chrono>
#include <csignal>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <map>
#include <string>
#include <thread>
#include <vector>

#include <CLI/CLI.hpp>

#include "api/csv.h"
#include "api/plot.h"
#include "api/problem.h"
#include "api/request.h"
#include "api/response.h"
#include "client/table.h"
#include "kernels/engine.h"
#include "kernels/model.h"
#include "kernels/program_cache.h"
#include "kernels/selftest.h"
#include "kernels/throughput.h"
#include "kernels/tuning.h"
#include "optim/bench.h"
#include "optim/fit.h"
#include "optim/trade.h"
#include "server/serve.h"
#include "server/worker.h"

namespace {

using namespace brdfit;

struct FitArguments {
    std::string file;
    std::vector<std::string> options;  // key=value, as in the query of POST /v1/fits
    kernels::EngineOptions engine;
    std::vector<std::filesystem::path> model_folders;
    std::string plots;
    bool json = false;
};

std::string read_file(const std::string& name) {
    std::ifstream in(name, std::ios::binary);
    std::string text{std::istreambuf_iterator<char>(in), {}};
    if (!in) throw std::runtime_error(name + ": cannot be read");
    return text;
}

void write_file(const std::filesystem::path& path, const std::string& text) {
    std::ofstream out(path, std::ios::binary);
    if (!(out << text).flush()) throw std::runtime_error(path.string() + ": cannot be written");
}

/// Tests the device in what this fit uses: double where it may, as the report is computed in it, else single.
void prove(kernels::Engine& engine, const api::FitRequest& request) {
    using kernels::Precision;
    std::vector<kernels::Family> families;
    for (const optim::ModelRequest& model : request.models) families.push_back(*model.family);
    const auto test = [&](Precision precision) {
        const kernels::SelfTest result = kernels::prove(engine, families, precision, kernels::SelfTestForm::brief);
        if (result.passed()) return;
        std::fprintf(stderr, "brdfit: %s\n", result.reason().c_str());
        for (const kernels::ModelTest& model : result.models)
            for (const std::string& failure : model.failures()) std::fprintf(stderr, "    %s\n", failure.c_str());
    };
    if (engine.supports(Precision::double_precision)) test(Precision::double_precision);
    if (!engine.supports(Precision::double_precision) || request.options.precision == Precision::single_precision)
        test(Precision::single_precision);
}

/// False if no model could be fitted.
bool fit(const FitArguments& arguments) {
    const kernels::Catalogue catalogue(arguments.model_folders);
    api::Query query{{"name", std::filesystem::path(arguments.file).stem().string()}};
    for (const std::string& option : arguments.options) {
        const auto equals = option.find('=');
        if (equals == std::string::npos) throw std::runtime_error("an option is key=value, not \"" + option + "\"");
        if (option.starts_with("name=")) query.clear();
        query.emplace(option.substr(0, equals), option.substr(equals + 1));
    }
    const std::string text = read_file(arguments.file);
    const bool is_json = std::filesystem::path(arguments.file).extension() == ".json";
    const api::FitRequest request =
        is_json ? api::read_fit_request(text, catalogue) : api::read_fit_request_csv(text, query, catalogue);
    kernels::Engine engine(arguments.engine);
    optim::Fitter fitter(engine, std::thread::hardware_concurrency());
    prove(engine, request);
    for (const optim::ModelRequest& model : request.models) fitter.warm_up(*model.family);
    const optim::Report report = fitter.fit(request.dataset, request.models, request.options);
    if (arguments.json) std::fputs(api::to_json(report, "local").c_str(), stdout);
    else std::fputs(client::table(report).c_str(), stdout);
    const bool fitted = std::any_of(report.channels.begin(), report.channels.end(),
                                    [](const optim::ChannelReport& channel) { return !channel.fits.empty(); });
    if (arguments.plots.empty()) return fitted;
    std::filesystem::create_directories(arguments.plots);
    write_file(std::filesystem::path(arguments.plots) / "summary.svg", api::plot_summary(report, {}));
    for (std::size_t c = 0; c < report.channels.size(); ++c) {
        api::PlotOptions options;
        options.channel = report.channels[c].channel.name;
        const std::string suffix = report.channels.size() > 1 ? "_" + std::to_string(c + 1) : "";
        write_file(std::filesystem::path(arguments.plots) / ("brdf" + suffix + ".svg"), plot_brdf(report, options));
        write_file(std::filesystem::path(arguments.plots) / ("residual" + suffix + ".svg"),
                   plot_residual(report, options));
    }
    return fitted;
}

void print_refusal(const std::string& file, const api::Problem& problem) {
    for (const api::FieldError& error : problem.errors) {
        std::string place = file;
        if (error.line) place += ":" + std::to_string(*error.line);
        if (error.column) place += ":" + std::to_string(*error.column);
        std::fprintf(stderr, "%s: %s%s%s\n", place.c_str(), error.pointer.c_str(), error.pointer.empty() ? "" : ": ",
                     error.detail.c_str());
    }
    if (problem.errors.empty()) std::fprintf(stderr, "%s: %s\n", file.c_str(), problem.detail.c_str());
}

void list_devices() {
    for (const kernels::DeviceInfo& device : kernels::list_devices())
        std::printf("%-4s %-6s %s (%s, %s)\n", device.type.c_str(), device.has_double ? "double" : "single",
                    device.name.c_str(), device.platform.c_str(), device.version.c_str());
}

const char* name_of(kernels::Precision precision) {
    return precision == kernels::Precision::double_precision ? "double" : "single";
}

/// False if the choice could not be kept.
bool tune(const kernels::EngineOptions& options, const std::vector<std::filesystem::path>& model_folders) {
    const kernels::Catalogue catalogue(model_folders);
    const std::vector<kernels::Tuning> tunings = kernels::tune(options, catalogue.families());
    if (tunings.empty()) std::puts("nothing to choose: a work-item of this device takes one sample at a time");
    bool kept = true;
    for (const kernels::Tuning& tuning : tunings) {
        std::printf("%s precision\n", name_of(tuning.precision));
        for (const kernels::LanesTiming& timing : tuning.timings)
            std::printf("  %2u lanes %9.2f us a candidate%s%s\n", timing.lanes, timing.time_us,
                        timing.lanes == tuning.native ? ", native" : "",
                        timing.lanes == tuning.chosen ? ", chosen" : "");
        kept = kept && tuning.kept;
    }
    if (!kept)
        std::fputs("brdfit: the choice could not be kept: there is no cache folder that can be written\n", stderr);
    return kept;
}

/// False if the device failed.
bool self_test(const kernels::EngineOptions& options, const std::vector<std::filesystem::path>& model_folders,
               bool json) {
    const kernels::Catalogue catalogue(model_folders);
    kernels::Engine engine(options);
    const auto tests = kernels::prove(engine, catalogue.families(), kernels::SelfTestForm::whole);
    if (json) std::fputs(api::to_json(tests).c_str(), stdout);
    else {
        std::printf("%s\n", engine.device().name.c_str());
        for (const kernels::SelfTest& test : tests)
            std::printf("  %u lanes in %s precision\n", engine.lanes(test.precision), name_of(test.precision));
        std::fputs(client::table(tests).c_str(), stdout);
    }
    return std::all_of(tests.begin(), tests.end(), [](const kernels::SelfTest& test) { return test.passed(); });
}

void bench_device(const kernels::EngineOptions& options, double seconds, bool json) {
    const kernels::Catalogue catalogue;
    kernels::Engine engine(options);
    const auto throughputs =
        kernels::measure_throughput(engine, catalogue.families(), std::chrono::duration<double>(seconds));
    if (json) std::fputs(api::to_json(engine.device(), throughputs).c_str(), stdout);
    else std::printf("%s\n%s", engine.device().name.c_str(), client::table(throughputs).c_str());
}

void bench_fit(const kernels::EngineOptions& options, const std::string& growth, optim::BenchLength length, bool json) {
    const kernels::Catalogue catalogue;
    kernels::Engine engine(options);
    const auto bench = optim::bench_fits(engine, catalogue, std::thread::hardware_concurrency(), growth, length);
    if (json) std::fputs(api::to_json(engine.device(), bench).c_str(), stdout);
    else std::printf("%s, %s", engine.device().name.c_str(), client::table(bench).c_str());
}

/// False if a file is refused.
bool bench_trade(const kernels::EngineOptions& options, const std::vector<std::string>& files, std::size_t made_up,
                 std::size_t seeds, bool json) {
    std::vector<optim::Dataset> datasets;
    for (const std::string& file : files) try {
            datasets.push_back(api::read_csv(read_file(file)));
            datasets.back().name = std::filesystem::path(file).stem().string();
        } catch (const api::Refusal& refusal) {
            print_refusal(file, refusal.problem());
            return false;
        }
    const kernels::Catalogue catalogue;
    kernels::Engine engine(options);
    constexpr std::size_t kSamples = 500;
    for (std::size_t i = 0; i < made_up; ++i) {
        datasets.push_back(optim::made_up(engine, catalogue, 1, kSamples, i));
        datasets.back().name += " " + std::to_string(i);
    }
    if (datasets.empty()) throw std::runtime_error("name files, or a number of made-up surfaces");
    const optim::TradeBench bench = optim::bench_trade(options, catalogue, datasets, seeds);
    if (json) std::fputs(api::to_json(engine.device(), bench).c_str(), stdout);
    else std::printf("%s\n%s", engine.device().name.c_str(), client::table(bench).c_str());
    return true;
}

}  // namespace

int main(int argc, char** argv) {
    server::set_log_format(server::LogFormat::text);
    CLI::App app{"Fits reflectance models to BRDF measurements and ranks them."};
    app.set_version_flag("--version", api::version());
    app.require_subcommand(1);

    server::ServeOptions serve_options;
    CLI::App* serve = app.add_subcommand("serve", "Answer HTTP requests until SIGTERM");
    serve->add_option("--host", serve_options.host, "Address to bind; one that others reach needs --api-keys")
        ->capture_default_str();
    serve->add_option("--port", serve_options.port, "Port to bind; 0 takes a free one")
        ->check(CLI::Range(0, 65535))
        ->capture_default_str();

    serve->add_option("--workers", serve_options.workers, "Processes that compute")
        ->check(CLI::Range(1, 64))
        ->capture_default_str();
    serve->add_option("--store", serve_options.store,
                      "File where jobs and results are kept (default: $XDG_DATA_HOME/brdfit/brdfit.db or "
                      "~/.local/share/brdfit/brdfit.db)");
    auto keep = serve_options.keep.count();
    const std::map<std::string, decltype(keep)> ages{{"s", 1}, {"m", 60}, {"h", 3600}, {"d", 86400}};
    serve->add_option("--keep", keep, "How long fits that have ended are kept, e.g. 30d; 0: for ever")
        ->transform(CLI::AsNumberWithUnit(ages))
        ->default_str("30d");
    serve
        ->add_option("--max-store", serve_options.most_bytes,
                     "Size of the store beyond which the oldest fits are removed, e.g. 10GB; 0: no limit")
        ->transform(CLI::AsSizeValue(true))
        ->default_str("10GB");

    server::WorkerOptions worker_options;
    CLI::App* worker = app.add_subcommand("worker", "Compute the fits of a store until SIGTERM; serve starts its own");
    worker->add_option("--store", worker_options.store, "File where jobs and results are kept")->required();
    const std::map<std::string, server::Lane> lanes{{"any", server::Lane::any},
                                                    {"interactive", server::Lane::interactive}};
    worker->add_option("--lane", worker_options.lane, "any, or interactive: only fits that somebody waits for")
        ->transform(CLI::CheckedTransformer(lanes));
    worker->add_option("--nice", worker_options.niceness, "Added to the niceness of the process")
        ->check(CLI::Range(0, 19));
    worker->add_option("--channel", worker_options.channel)->group("");
    worker->add_option("--owner", worker_options.owner)->group("");
    for (auto& [command, threads] : {std::pair{serve, &serve_options.threads}, {worker, &worker_options.threads}})
        command->add_option("--threads", *threads, "Searches at once in a worker; 0: one a core")
            ->check(CLI::Range(0, 1024));

    serve->add_option("--api-keys", serve_options.http.api_keys,
                      "File of API keys, a line each: name:SHA-256 of the key; requests then need one");
    serve->add_option("--max-body", serve_options.http.limits.largest_body, "Most bytes of a request's body, e.g. 64MB")
        ->transform(CLI::AsSizeValue(false))
        ->check(CLI::Range(std::size_t{1024}, std::size_t{1} << 30))
        ->capture_default_str();
    serve
        ->add_option("--max-connections", serve_options.http.limits.most_connections,
                     "Most connections at once, one peer half of them")
        ->check(CLI::Range(8, 100000))
        ->capture_default_str();
    serve
        ->add_option("--rate", serve_options.http.rate,
                     "Most requests a second of a client, /health apart; 0: as many as come")
        ->check(CLI::Range(0.0, 1e6))
        ->capture_default_str();
    const std::map<std::string, server::LogFormat> log_formats{{"text", server::LogFormat::text},
                                                               {"json", server::LogFormat::json}};
    serve->add_option("--log-format", serve_options.log_format, "text or json: lines on standard error")
        ->transform(CLI::CheckedTransformer(log_formats));

    FitArguments fit_arguments;
    CLI::App* fit_command = app.add_subcommand("fit", "Fit a CSV file, or a JSON request, without a server");
    fit_command->add_option("file", fit_arguments.file, "Measurements")->required();
    fit_command->add_option("options", fit_arguments.options,
                            "key=value as in the query of POST /v1/fits, e.g. models=ward,phong loss=l2 (CSV only)");
    fit_command->add_flag("--json", fit_arguments.json, "Print the answer of the service instead of a table");
    fit_command->add_option("--plots", fit_arguments.plots, "Folder to write SVG error plots to");

    std::vector<std::filesystem::path> folders;
    CLI::App* models = app.add_subcommand("models", "Print the models as JSON");
    CLI::App* devices = app.add_subcommand("devices", "List OpenCL devices, the preferred one first");
    CLI::App* self_test_command =
        app.add_subcommand("selftest", "Compare the device with references: worst errors per model and precision");
    bool self_test_json = false;
    self_test_command->add_flag("--json", self_test_json, "Print JSON, as GET /v1 has it, instead of a table");
    CLI::App* tune_command = app.add_subcommand(
        "tune", "Measure which number of SIMD lanes is fastest here, and use it from now on; takes a minute");
    CLI::App* bench = app.add_subcommand("bench", "Measure speed");
    bench->require_subcommand(1);
    CLI::App* bench_device_command = bench->add_subcommand("device", "Evaluations a second, per model and precision");
    double bench_seconds = 0.2;
    bench_device_command->add_option("--seconds", bench_seconds, "Time for each figure")
        ->check(CLI::Range(0.0, 60.0))
        ->capture_default_str();
    CLI::App* bench_fit_command = bench->add_subcommand("fit", "Times and memory of whole fits");
    std::string bench_growth;
    bench_fit_command->add_option("--only", bench_growth,
                                  "models, channels, samples, effort, judge, requests or batch");
    auto bench_length = optim::BenchLength::standard;
    const std::map<std::string, optim::BenchLength> lengths{{"brief", optim::BenchLength::brief},
                                                            {"standard", optim::BenchLength::standard},
                                                            {"full", optim::BenchLength::full}};
    bench_fit_command->add_option("--length", bench_length, "brief, standard or full")
        ->transform(CLI::CheckedTransformer(lengths));
    bool one_by_one = false;
    bench_fit_command->add_flag("--one-by-one", one_by_one,
                                "Launch each candidate alone and wait for it: what batching is measured against");
    CLI::App* bench_trade_command =
        bench->add_subcommand("trade", "What effort and precision buy: time, distance to the best known, parameters");
    std::vector<std::string> trade_files;
    bench_trade_command->add_option("files", trade_files, "Measurements (CSV), absolute; the first channel of each");
    std::size_t trade_made_up = 0;
    bench_trade_command->add_option("--made-up", trade_made_up, "So many made-up surfaces, 500 samples with 2 % noise")
        ->check(CLI::Range(0, 1000))
        ->capture_default_str();
    std::size_t trade_seeds = 8;
    bench_trade_command
        ->add_option("--seeds", trade_seeds, "Searches of a kind; of thorough ones a quarter, at least 2")
        ->check(CLI::Range(1, 1000))
        ->capture_default_str();
    bool bench_json = false;
    for (CLI::App* command : {bench_device_command, bench_fit_command, bench_trade_command})
        command->add_flag("--json", bench_json, "Print JSON instead of a table");
    for (CLI::App* command : {serve, worker, fit_command, models, self_test_command, tune_command})
        command->add_option("--models", folders, "Folder with further model files (*.cl); may be given again")
            ->allow_extra_args(false)
            ->check(CLI::ExistingDirectory);
    kernels::EngineOptions engine_options;
    for (CLI::App* command : {serve, worker, fit_command, self_test_command, tune_command, bench_device_command,
                              bench_fit_command, bench_trade_command}) {
        command->add_option("--device", engine_options.device, "auto, cpu, gpu, or a part of the device's name")
            ->capture_default_str();
        command->add_option("--build-options", engine_options.build_options,
                            "Further options for the OpenCL compiler, e.g. --build-options=-cl-fast-relaxed-math");
    }
    std::string cache_folder;
    bool no_cache = false;
    for (CLI::App* command : {serve, worker, fit_command, self_test_command, tune_command}) {
        command->add_option(
            "--cache", cache_folder,
            "Folder where compiled kernels are kept (default: $XDG_CACHE_HOME/brdfit or ~/.cache/brdfit)");
        command->add_flag("--no-cache", no_cache, "Keep no compiled kernels: compile all of them at each start")
            ->excludes("--cache");
    }
    std::string build_device, build_folder;
    CLI::App* build = app.add_subcommand("build-programs", "For processes that brdfit starts itself")->group("");
    build->add_option("device", build_device)->required();
    build->add_option("folder", build_folder)->required();
    CLI11_PARSE(app, argc, argv);
    // A write beyond a limit of the shell's then fails, as on a full disk.
    std::signal(SIGXFSZ, SIG_IGN);

    serve_options.keep = std::chrono::seconds(keep);
    serve_options.model_folders = worker_options.model_folders = fit_arguments.model_folders = folders;
    if (no_cache) engine_options.cache = "";
    else
        engine_options.cache =
            cache_folder.empty() ? kernels::default_cache_folder() : std::filesystem::absolute(cache_folder);
    engine_options.builder = "/proc/self/exe";
    engine_options.one_by_one = one_by_one;
    serve_options.engine = worker_options.engine = fit_arguments.engine = engine_options;
    try {
        if (build->parsed()) kernels::build_programs(build_device, build_folder);
        if (serve->parsed()) server::serve(serve_options);
        if (worker->parsed()) server::work(worker_options);
        if (fit_command->parsed() && !fit(fit_arguments)) return 1;
        if (self_test_command->parsed() && !self_test(engine_options, folders, self_test_json)) return 1;
        if (tune_command->parsed() && !tune(engine_options, folders)) return 1;
        if (models->parsed()) std::fputs(api::to_json(kernels::Catalogue(folders)).c_str(), stdout);
        if (devices->parsed()) list_devices();
        if (bench_device_command->parsed()) bench_device(engine_options, bench_seconds, bench_json);
        if (bench_fit_command->parsed()) bench_fit(engine_options, bench_growth, bench_length, bench_json);
        if (bench_trade_command->parsed() &&
            !bench_trade(engine_options, trade_files, trade_made_up, trade_seeds, bench_json))
            return 2;
    } catch (const api::Refusal& refusal) {
        print_refusal(fit_arguments.file, refusal.problem());
        return 2;
    } catch (const std::exception& error) {
        std::fprintf(stderr, "brdfit: %s\n", error.what());
        return 1;
    }
    return 0;
}
