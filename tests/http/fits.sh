#!/usr/bin/env bash
# POST /v1/fits that succeeds: the form of the answer, each option, plots, the same request twice.
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
require_server

# ---- the documented example, made whole ----
example=$(jq -nc '
    [range(-80; 81; 5)] as $angles
    | {dataset: {name: "white plastic", unit: "1/sr", channels: [{name: "550nm", wavelength_nm: 550,
        scans: [(15, 45) | . as $theta_i | {theta_i_deg: $theta_i, theta_r_deg: $angles,
                 brdf: [$angles[] | 0.17 + 0.2 * (-pow((. - $theta_i) / 17; 2) | exp2) + 0.0002 * (. % 7)],
                 sigma: [$angles[] | 0.003]}],
        samples: {theta_i_deg: [15, 15], phi_i_deg: [0, 10], theta_r_deg: [30, 30], phi_r_deg: [180, 70],
                  brdf: [0.28, 0.18], sigma: [0.003, 0.003]}}]},
       models: ["phong", "ward", {name: "lafortune", lobes: 2, fixed: {k_d: 0.5}, bounds: {n_1: [1, 500]}}, "he_torrance"],
       options: {loss: "cosine_l2", effort: "standard", precision: "auto", seed: 1, time_limit_s: 30}}')
post_json /v1/fits "$example"
answered "the documented example" 200 || finish  # nothing below means anything without it
check_equal "its type" "$(header Content-Type)" application/json
cp "$work/body" "$work/first"
holds "members of the answer" 'keys_unsorted == ["id", "state", "version", "seed", "device", "dataset", "channels", "links"]
    and .state == "succeeded" and .seed == 1 and (.device | keys_unsorted == ["name", "platform", "type", "precision"])
    and (.device.precision | IN("single", "double")) and .dataset == {name: "white plastic", unit: "1/sr"}'
holds "id is a UUID of version 7" \
    '.id | test("^[0-9a-f]{8}-[0-9a-f]{4}-7[0-9a-f]{3}-[89ab][0-9a-f]{3}-[0-9a-f]{12}$")'
holds "links" '"/v1/fits/\(.id)" as $self | .links == {self: $self, result: "\($self)/result", plots: {
    brdf: "\($self)/plots/brdf.svg", residual: "\($self)/plots/residual.svg", summary: "\($self)/plots/summary.svg"}}'
holds "the channel" '.channels | length == 1 and (.[0] | .name == "550nm" and .wavelength_nm == 550 and .samples == 68
    and .failures == [])'
holds "every model asked for" '[.channels[0].fits[].model] | sort == ["he_torrance", "lafortune", "phong", "ward"]'
holds "fits are sorted by loss" '[.channels[0].fits[].loss] | . == sort'
holds "ranks count from 1" '[.channels[0].fits[].rank] == [1, 2, 3, 4]'
holds "members of a fit" 'all(.channels[0].fits[]; (keys_unsorted - ["lobes", "warnings"]) == ["rank", "model", "parameters",
    "loss", "relative_loss", "rmse", "log10_rmse", "aicc", "bic", "held_out", "scans", "albedo", "physics", "cost",
    "correlations", "search", "links"])'
holds "numbers of a fit" 'all(.channels[0].fits[]; all(.loss, .relative_loss, .rmse, .log10_rmse, .aicc, .bic;
    type == "number"))'
holds "lobes of lafortune alone" \
    'all(.channels[0].fits[]; if .model == "lafortune" then .lobes == 2 else has("lobes") | not end)'
holds "parameters" 'all(.channels[0].fits[].parameters[]; (keys_unsorted - ["fixed"]) == ["value", "std_error", "interval_95", "unit", "at_bound"]
    and (.value | type == "number") and (.std_error | type | IN("number", "null")) and (.at_bound | type == "boolean"))'
# parameters MODEL UNIT NAME...: in this order; the unit is that of the first
parameters() {
    local model=$1 unit=$2
    shift 2
    check_equal "parameters of $model" "$(jq -r --arg m "$model" '.channels[0].fits[] | select(.model == $m).parameters
        | "\(to_entries[0].value.unit) \(keys_unsorted | join(" "))"' "$work/body")" "$unit $*"
}
parameters phong 1 k_d k_s n
parameters ward 1 rho_d rho_s alpha
parameters lafortune 1 k_d c_xy_1 c_z_1 n_1 c_xy_2 c_z_2 n_2
parameters he_torrance um sigma tau n k rho_ud
holds "a fixed parameter stays" '.channels[0].fits[] | select(.model == "lafortune").parameters.k_d
    | .value == 0.5 and .fixed and .std_error == null'
holds "bounds are kept" '.channels[0].fits[] | select(.model == "lafortune").parameters.n_1.value | . >= 1 and . <= 500'
holds "scans" 'all(.channels[0].fits[]; [.scans[].theta_i_deg] == [15, 45]
    and all(.scans[]; keys_unsorted == ["theta_i_deg", "rmse", "log10_rmse"] and (.rmse | type == "number")))'
holds "search" 'all(.channels[0].fits[].search; keys_unsorted == ["starts", "agreed", "evaluations", "stop_reason", "time_s", "rivals"]
    and .starts >= 1 and .agreed >= 1 and .agreed <= .starts and .evaluations >= 1 and .time_s >= 0
    and (.stop_reason | IN("converged", "evaluation_limit", "time_limit", "roundoff", "cancelled")))'

path=$(jq -r .links.result "$work/first")
check_equal "Content-Location names the result" "$(header Content-Location)" "$path"
get "$path"
answered "GET $path" 200
check "GET $path gives the same bytes" cmp "$work/body" "$work/first"
get "${path%/result}"
holds "GET ${path%/result} gives its state" '.state == "succeeded" and .done'
post_json /v1/fits "$example"
answered "the same request twice" 200
check "... is answered with the same bytes" cmp "$work/body" "$work/first"
post_json /v1/fits "$example" -H 'Cache-Control: no-cache'
check_equal "... computed again gives the same answer" "$(normalised "$work/body")" "$(normalised "$work/first")"
check "... under another id" test "$(jq -r .id "$work/body")" != "$(jq -r .id "$work/first")"
post_json /v1/fits "$(jq -c '.options.seed = 9007199254740991 | .models = ["ward"]' <<<"$example")"
holds "the largest seed is told exactly" '.seed == 9007199254740991'

# ---- plots ----
# check_plot NAME PATH: an SVG in which nothing may run.
check_plot() {
    get "$2"
    answered "$1" 200 || return
    check_equal "$1: headers" \
        "$(header Content-Type) | $(header Content-Security-Policy) | $(header X-Content-Type-Options)" \
        "image/svg+xml | default-src 'none'; style-src 'unsafe-inline' | nosniff"
    check "$1: well-formed" xmllint --noout --nonet "$work/body"
    check "$1: is a picture" grep -q '<svg ' "$work/body"
}
for kind in brdf residual summary; do
    check_plot "plot $kind" "$(jq -r ".links.plots.$kind" "$work/first")"
    cp "$work/body" "$work/plot"
    get "$(jq -r ".links.plots.$kind" "$work/first")"
    check "plot $kind twice gives the same bytes" cmp "$work/body" "$work/plot"
done
check_plot "plot of one model" "$(jq -r '.channels[0].fits[1].links.plot' "$work/first")"
plots=$(jq -r .links.self "$work/first")/plots
check_plot "plot with options" "$plots/brdf.svg?models=ward,phong&theta_i=15&width=640&channel=550nm"
for query in models=cook theta_i=16 theta_i=x theta_i= width=1 width=nan channel=red model=ward; do
    get "$plots/brdf.svg?$query"
    refused "plot with $query" 422
done
get "$plots/brdf.png"
refused "a plot there is not" 404

# ---- every sample, every model ----
for file in "$samples"/*.csv; do
    name=$(basename "$file" .csv)
    post_csv "name=$name" "$file"
    answered "$name" 200
    holds "$name: all models fit" '.channels | length == 1 and (.[0] | .failures == [] and (.fits | length == 5))'
    holds "$name: its name" '.dataset.name == $n' --arg n "$name"
    holds "$name: two lobes of lafortune beat Phong" \
        '[.channels[0].fits[] | {(.model): .loss}] | add | .lafortune < .phong and .phong <= .lambert'
    cp "$work/body" "$work/answer"
    for kind in brdf residual summary; do check_plot "$name: $kind" "$(jq -r ".links.plots.$kind" "$work/answer")"; done
done
finish
