/// Kernel texts linked into the program; generated from the .cl files by embed.cmake.
#pragma once

#include <span>
#include <string_view>

namespace brdfit::kernels {

struct EmbeddedModel {
    std::string_view name;  ///< file name without ".cl"
    std::string_view text;
};

/// kernels/models/*.cl, by name.
std::span<const EmbeddedModel> embedded_models();

extern const std::string_view kPreludeText;
extern const std::string_view kSpecialText;
extern const std::string_view kParametersText;
extern const std::string_view kResidualText;
extern const std::string_view kHemisphereText;

}  // namespace brdfit::kernels
