// POST /v1/fits with application/json: any bytes are a request within all limits, or a refusal with places.

#include "api/json.h"
#include "tests/fuzz/measurements.h"
#include "tests/fuzz/refusal.h"

using namespace brdfit;

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
    const std::string_view text = fuzz::text_of(data, size);
    api::FitRequest request;
    const auto problem = fuzz::refusal_of([&] { request = api::read_fit_request(text, fuzz::catalogue()); });
    if (!problem) {
        fuzz::check_request(request);
        return 0;
    }
    fuzz::check_refusal(*problem, text);
    nlohmann::json document;
    if (!fuzz::refusal_of([&] { document = api::parse_json(text); })) fuzz::check_pointers(*problem, document);
    return 0;
}
