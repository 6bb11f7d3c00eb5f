// POST /v1/fits with text/csv. The first line is the query (key=value&...), the rest the body.

#include <boost/algorithm/string/split.hpp>

#include "tests/fuzz/measurements.h"
#include "tests/fuzz/refusal.h"

using namespace brdfit;

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
    const std::string_view text = fuzz::text_of(data, size);
    const auto end = text.find('\n');
    api::Query query;
    std::vector<std::string> pairs;
    if (end != 0 && end != std::string_view::npos)
        boost::algorithm::split(pairs, text.substr(0, end), [](char c) { return c == '&'; });
    for (const std::string& pair : pairs) {
        const auto equal = pair.find('=');
        query.emplace(pair.substr(0, equal), equal == std::string::npos ? "" : pair.substr(equal + 1));
    }
    const std::string_view body = end == std::string_view::npos ? text : text.substr(end + 1);
    api::FitRequest request;
    const auto problem = fuzz::refusal_of([&] { request = api::read_fit_request_csv(body, query, fuzz::catalogue()); });
    if (!problem) {
        fuzz::check_request(request);
        return 0;
    }
    fuzz::check_refusal(*problem, text);
    for (const api::FieldError& error : problem->errors)
        fuzz::require(error.pointer.empty() == error.line.has_value(),
                      "a pointer into the query, or a line of the body");
    return 0;
}
