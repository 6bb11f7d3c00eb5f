#include "server/metrics.h"

#include <dirent.h>
#include <unistd.h>

#include <fstream>
#include <mutex>

#include <prometheus/counter.h>
#include <prometheus/gauge.h>
#include <prometheus/histogram.h>
#include <prometheus/metric_family.h>
#include <prometheus/registry.h>
#include <prometheus/text_serializer.h>

#include "api/response.h"

namespace brdfit::server {
namespace {

const prometheus::Histogram::BucketBoundaries kSeconds{0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1,
                                                       0.25,   0.5,   1,      2.5,   5,    10,    30,   60};

double resident_bytes() {
    std::ifstream statm("/proc/self/statm");
    double size = 0;
    double resident = 0;
    statm >> size >> resident;
    return resident * static_cast<double>(::sysconf(_SC_PAGESIZE));
}

double open_files() {
    DIR* folder = ::opendir("/proc/self/fd");
    if (folder == nullptr) return 0;
    double count = -3;  // ".", ".." and the folder itself
    while (::readdir(folder) != nullptr) ++count;
    ::closedir(folder);
    return count;
}

}  // namespace

struct Metrics::Impl {
    prometheus::Registry registry;
    prometheus::Family<prometheus::Counter>& requests =
        prometheus::BuildCounter()
            .Name("brdfit_http_requests_total")
            .Help("Requests answered, by method, template of the path and status")
            .Register(registry);
    prometheus::Family<prometheus::Histogram>& durations =
        prometheus::BuildHistogram()
            .Name("brdfit_http_request_duration_seconds")
            .Help("Time from a request's last byte to the first of its answer, by template of the path")
            .Register(registry);
    prometheus::Counter& received = prometheus::BuildCounter()
                                        .Name("brdfit_http_request_bytes_total")
                                        .Help("Bytes of requests' bodies")
                                        .Register(registry)
                                        .Add({});
    prometheus::Counter& sent = prometheus::BuildCounter()
                                    .Name("brdfit_http_response_bytes_total")
                                    .Help("Bytes of answers' bodies")
                                    .Register(registry)
                                    .Add({});
    prometheus::Counter& accepted = prometheus::BuildCounter()
                                        .Name("brdfit_http_connections_accepted_total")
                                        .Help("Connections accepted")
                                        .Register(registry)
                                        .Add({});
    prometheus::Family<prometheus::Counter>& closed = prometheus::BuildCounter()
                                                          .Name("brdfit_http_connections_closed_total")
                                                          .Help("Connections closed, by reason")
                                                          .Register(registry);
    prometheus::Gauge& connections = gauge("brdfit_http_connections", "Connections that are open");
    prometheus::Gauge& in_flight = gauge("brdfit_http_requests_in_flight", "Requests being answered");
    prometheus::Gauge& streams = gauge("brdfit_http_streams", "Answers that are written bit by bit");
    prometheus::Gauge& resident = gauge("process_resident_memory_bytes", "Resident memory");
    prometheus::Gauge& files = gauge("process_open_fds", "Open file descriptors");
    std::mutex mutex;
    std::vector<std::function<std::vector<Figure>()>> sources;

    Impl() {
        prometheus::BuildGauge()
            .Name("brdfit_build_info")
            .Help("1, with the version")
            .Register(registry)
            .Add({{"version", api::version()}})
            .Set(1);
    }
    prometheus::Gauge& gauge(const std::string& name, const std::string& help) {
        return prometheus::BuildGauge().Name(name).Help(help).Register(registry).Add({});
    }
};

Metrics::Metrics() : impl_(std::make_unique<Impl>()) {}
Metrics::~Metrics() = default;

void Metrics::add_source(std::function<std::vector<Figure>()> source) {
    const std::lock_guard lock(impl_->mutex);
    impl_->sources.push_back(std::move(source));
}

void Metrics::count(const Served& served) {
    const std::string route = served.route.empty() ? "none" : served.route;
    impl_->requests.Add({{"method", served.method}, {"route", route}, {"status", std::to_string(served.status)}})
        .Increment();
    impl_->durations.Add({{"route", route}}, kSeconds).Observe(served.time.count());
    impl_->received.Increment(static_cast<double>(served.received));
    impl_->sent.Increment(static_cast<double>(served.sent));
}

void Metrics::count_accepted() { impl_->accepted.Increment(); }
void Metrics::count_closed(const std::string& why) { impl_->closed.Add({{"reason", why}}).Increment(); }
void Metrics::add_connections(int change) { impl_->connections.Increment(change); }
void Metrics::add_requests(int change) { impl_->in_flight.Increment(change); }
void Metrics::add_streams(int change) { impl_->streams.Increment(change); }

std::string Metrics::text() const {
    impl_->resident.Set(resident_bytes());
    impl_->files.Set(open_files());
    std::vector<prometheus::MetricFamily> families = impl_->registry.Collect();
    std::map<std::string, prometheus::MetricFamily> others;
    const std::lock_guard lock(impl_->mutex);
    for (const auto& source : impl_->sources)
        for (const Figure& figure : source()) {
            prometheus::MetricFamily& family = others[figure.name];
            family.name = figure.name;
            family.help = figure.help;
            family.type = figure.only_grows ? prometheus::MetricType::Counter : prometheus::MetricType::Gauge;
            prometheus::ClientMetric& metric = family.metric.emplace_back();
            for (const auto& [name, value] : figure.labels) metric.label.push_back({name, value});
            (figure.only_grows ? metric.counter.value : metric.gauge.value) = figure.value;
        }
    for (auto& [name, family] : others) families.push_back(std::move(family));
    return prometheus::TextSerializer().Serialize(families);
}

}  // namespace brdfit::server
