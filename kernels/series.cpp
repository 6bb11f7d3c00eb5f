#include "kernels/series.h"

#include <cmath>
#include <sstream>

namespace brdfit::kernels {

std::string series_options(double log_epsilon) {
    constexpr double kBeyond = 4;  // of LEFT_MARGIN, for the slopes
    // The trapezoidal rule's error falls as exp(-const/stride^2).
    std::ostringstream options;
    options << std::scientific << "-DSERIES_LOG_EPSILON=" << log_epsilon
            << " -DSERIES_NEGLIGIBLE=" << 0.03 * std::exp(-log_epsilon)
            << " -DSERIES_LEFT_MARGIN=" << std::log(log_epsilon) + kBeyond
            << " -DSERIES_STRIDE=" << 4 / std::sqrt(log_epsilon);
    return options.str();
}

}  // namespace brdfit::kernels
