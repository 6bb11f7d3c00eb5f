#!/usr/bin/env bash
# What can be read without a fit: health, the service, the models.
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
require_server

get /health/live
answered "health" 200
holds "health says live" '.status == "live"'

get /v1
answered "GET /v1" 200
holds "GET /v1 names the service" '.name == "brdfit" and (.version | test("^[0-9]+\\.[0-9]+\\.[0-9]+$"))
    and .limits.body_bytes == 33554432 and (.device.type | IN("cpu", "gpu", "accelerator"))'
get /
answered "GET /" 200
holds "GET / leads on" '.name == "brdfit" and .links.fits == "/v1/fits" and .links.openapi == "/openapi.json"'

get /v1/models
answered "models" 200
check_equal "models: type" "$(header Content-Type)" application/json
cp "$work/body" "$work/models"
holds "five models" '[.models[].name] | sort == ["he_torrance", "lafortune", "lambert", "phong", "ward"]'
holds "every model says what it is" \
    'all(.models[]; (.title, .source, .formula | length > 0) and (.traits | has("reciprocal")))'
holds "every parameter says what it is" \
    'all(.models[].parameters[]; (.doc | length > 0) and (.min < .max) and (.linear | type == "boolean"))'

# bounds MODEL PARAMETER... as documented, each "name unit min max"
bounds() {
    local model=$1
    shift
    check_equal "bounds of $model" "$(jq -r --arg m "$model" \
        '.models[] | select(.name == $m).parameters[] | "\(.name) \(.unit) \(.min) \(.max)"' "$work/models")" \
        "$(printf '%s\n' "$@")"
}
bounds lambert 'k_d 1 0 1'
bounds phong 'k_d 1 0 1' 'k_s 1 0 100' 'n 1 0.01 100000'
bounds ward 'rho_d 1 0 1' 'rho_s 1 0 100' 'alpha 1 0.001 5'
bounds he_torrance 'sigma wavelength 0.001 20' 'tau wavelength 0.1 200' 'n 1 0.05 20' 'k 1 0 20' 'rho_ud 1 0 1'
bounds lafortune 'k_d 1 0 1' {c_xy_1\ 1\ -3\ 3,c_z_1\ 1\ -3\ 3,n_1\ 1\ 0.01\ 10000} \
    {c_xy_2\ 1\ -3\ 3,c_z_2\ 1\ -3\ 3,n_2\ 1\ 0.01\ 10000} {c_xy_3\ 1\ -3\ 3,c_z_3\ 1\ -3\ 3,n_3\ 1\ 0.01\ 10000}
holds "lobes of lafortune" \
    '.models[] | select(.name == "lafortune").options.lobes == {min: 1, max: 3, default: "auto", auto_max: 2}'

for model in lambert phong ward lafortune he_torrance; do
    get /v1/models/$model
    answered "GET $model" 200
    check_equal "$model alone is as in the list" "$(jq -cS 'del(.costs)' "$work/body")" \
        "$(jq -cS --arg m $model '.models[] | select(.name == $m)' "$work/models")"
    holds "costs of $model" '(.costs | length > 0) and all(.costs[]; .double_ns > 0 and .operations.add >= 0)'
    check_equal "$model links to itself" "$(jq -r .links.self "$work/body")" "/v1/models/$model"
done
get /v1/models/cook_torrance
refused "unknown model" 404
holds "unknown model: the valid ones are named" '.detail | contains("lafortune")'
finish
