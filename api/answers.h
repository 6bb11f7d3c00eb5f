/// Schemas of what is answered and of what requests share, by their names in the published document.
#pragma once

#include "api/schema.h"
#include "kernels/model.h"

namespace brdfit::api {

/// components.schemas: each is referred to by schema::named(name).
schema::Json component_schemas(const kernels::Catalogue& catalogue);

}  // namespace brdfit::api
