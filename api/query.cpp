#include "api/query.h"

#include <charconv>
#include <cmath>

#include <boost/algorithm/string/split.hpp>

namespace brdfit::api {

nlohmann::json query_value(const std::string& text, const schema::Json& schema) {
    const std::string type = schema.value("type", "");
    if (type == "array") {
        std::vector<std::string> parts;
        boost::algorithm::split(parts, text, [](char c) { return c == ','; });
        nlohmann::json array = nlohmann::json::array();
        for (const std::string& part : parts) array.push_back(query_value(part, schema["items"]));
        return array;
    }
    if (type == "boolean" && (text == "true" || text == "false")) return text == "true";
    if (type != "number" && type != "integer") return text;
    double number = 0;
    const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), number);
    if (error == std::errc{} && end == text.data() + text.size() && std::isfinite(number)) return number;
    return text;
}

}  // namespace brdfit::api
