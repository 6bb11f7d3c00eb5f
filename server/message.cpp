#include "server/message.h"

#include <locale>

#include <boost/algorithm/string/predicate.hpp>

namespace brdfit::server {

bool HeaderOrder::operator()(std::string_view a, std::string_view b) const {
    return boost::algorithm::ilexicographical_compare(a, b, std::locale::classic());
}

std::string_view Request::header(std::string_view name) const {
    const auto found = headers.find(name);
    return found == headers.end() ? std::string_view() : found->second;
}

}  // namespace brdfit::server
