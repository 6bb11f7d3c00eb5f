/// Answers as JSON text.
#pragma once

#include <span>
#include <string>
#include <string_view>

#include <nlohmann/json.hpp>

#include "kernels/model.h"
#include "kernels/selftest.h"
#include "kernels/throughput.h"
#include "optim/bench.h"
#include "optim/report.h"
#include "optim/trade.h"

namespace brdfit::api {

/// The version of this program, "1.2.3".
std::string version();

/// Text as a part of a URL's query.
std::string url_encoded(std::string_view text);

/// Where a fit's status, result and plots are.
nlohmann::ordered_json fit_links(const std::string& id);

/// The ranked fits of a job (WIRE: the answer of POST /v1/fits). Numbers are finite; what is not known is null.
std::string to_json(const optim::Report& report, const std::string& id);

/// All models, or one (GET /v1/models, /v1/models/{name}), with the costs of its first texts where they are given.
std::string to_json(const kernels::Catalogue& catalogue);
std::string to_json(const kernels::Family& family, std::span<const kernels::Cost> costs = {});

/// Self-tests by precision: `brdfit selftest --json`.
std::string to_json(std::span<const kernels::SelfTest> tests);

/// `brdfit bench device --json`, `brdfit bench fit --json`, `brdfit bench trade --json`.
std::string to_json(const kernels::DeviceInfo& device, std::span<const kernels::Throughput> throughputs);
std::string to_json(const kernels::DeviceInfo& device, const optim::FitBench& bench);
std::string to_json(const kernels::DeviceInfo& device, const optim::TradeBench& bench);

/// GET /v1: what this service is.
std::string service_json(const kernels::DeviceInfo& device, std::span<const kernels::SelfTest> tests,
                         std::size_t largest_body);
/// GET /: where to go.
std::string links_json();

/// GET /health/ready: whether the device is fit for work in some precision, and what its self-tests found.
std::string ready_json(std::span<const kernels::SelfTest> tests, bool ready);

}  // namespace brdfit::api
