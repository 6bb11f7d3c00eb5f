/// A folder of this process for what compilers write.
#pragma once

#include <filesystem>

namespace brdfit::kernels {

/// Made at the first call, for this user alone, and removed when the process ends; what processes left that were killed
/// is removed then. In the first of $POCL_CACHE_DIR, $TMPDIR, /tmp, /var/tmp, $XDG_RUNTIME_DIR and /dev/shm where
/// programs may be written and loaded and 32 MB are free. Empty where there is none.
const std::filesystem::path& scratch_folder();

}  // namespace brdfit::kernels
