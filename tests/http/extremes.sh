#!/usr/bin/env bash
# Measurements at the extremes: answered with numbers, or refused with a reason.
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
require_server

# scans VALUE: a request over three incidence angles; VALUE is jq of $i and $r.
scans() {
    jq -nc '{dataset: {channels: [{scans: [(15, 45, 75) as $i | [range(-75; 76; 10)] as $angles
        | {theta_i_deg: $i, theta_r_deg: $angles, brdf: [$angles[] as $r | '"$1"']}]}]}}'
}
lobe='(0.1 + (-(($r - $i) / 8) * (($r - $i) / 8) | exp)) * (1 + 0.01 * (($r + 75) / 10 * 3 % 7))'
# numbers NAME: every fit holds numbers where it must, and says what it does not know.
numbers() {
    answered "$1" 200 || return
    holds "$1: fits or reasons" 'all(.channels[]; (.fits | length) + (.failures | length) == 5
        and all(.failures[]; .reason | length > 0 and (contains("internal") | not)))'
    holds "$1: numbers" 'all(.channels[0].fits[]; all(.loss, .relative_loss, .rmse, .bic; type == "number")
        and all(.aicc, .log10_rmse; type | IN("number", "null")) and all(.parameters[]; .value | type == "number"))'
    holds "$1: no standard error without a word" 'all(.channels[0].fits[]; (.warnings // [] | join(" ; ")) as $words
        | all(.parameters | to_entries[] | select(.value.std_error == null); .key as $name | $words | contains($name)))'
    check "$1: no -0" test "$(grep -c -- '-0\.0[,}]' "$work/body")" = 0
    cp "$work/body" "$work/answer"
    for kind in brdf residual summary; do
        get "$(jq -r ".links.plots.$kind" "$work/answer")"
        answered "$1: plot $kind" 200
        check "$1: plot $kind is well-formed" xmllint --noout --nonet "$work/body"
        check "$1: plot $kind holds numbers" test "$(grep -ciE '[^a-z](nan|inf)[^a-z]' "$work/body")" = 0
    done
    cp "$work/answer" "$work/body"
}

for factor in 1e-30 1e-4 1e6; do
    post_json /v1/fits "$(scans "$factor * $lobe")"
    numbers "values of $factor"
done
for value in 0.1 1e-30 0 -0.0 -0.01; do
    post_json /v1/fits "$(scans "$value")"
    numbers "all equal $value"
    if [[ $value == 0.1 || $value == 1e-30 ]]; then
        holds "all equal $value: nothing is left over" '.channels[0].fits[] | select(.model == "lambert")
            | .relative_loss < 1e-12 and .search.stop_reason == "converged"'
        holds "all equal $value: no second lobe" '.channels[0].fits[] | select(.model == "lafortune") | .lobes == 1'
    fi
done
holds "all negative: a natural limit is told" \
    '.channels[0].fits[] | select(.model == "ward").warnings | index("rho_d stands at its natural limit 0")'
post_json /v1/fits "$(scans '1e-200')"
answered "values of 1e-200" 200
holds "values of 1e-200: a reason" '.channels[0] | .fits == [] and all(.failures[]; .reason | contains("too small"))'
# A lobe of exponent 0.01 is 0.01 high with a height of 1e-200, whose slopes have squares beyond every number.
post_json /v1/fits "$(scans '0.0098 * (1 + 0.01 * (($r + 75) / 10 * 3 % 7))' | jq -c '.options.loss = "log" | .models = [
    {name: "lafortune", lobes: 1, fixed: {n_1: 0.01, k_d: 0}, bounds: {c_xy_1: [-1e-200, -1e-203], c_z_1: [1e-203, 1e-200]}}]')"
answered "heights of 1e-200" 200
holds "heights of 1e-200: found, with a standard error or a word" '.channels[0] | .failures == []
    and (.fits[0] | .loss < 0.05 and (.parameters.c_z_1.std_error != null or (.warnings | join(" ") | contains("c_z_1"))))'
post_json /v1/fits "$(scans "1e-30 * $lobe" | jq -c '.dataset.unit = "relative"')"
numbers "relative values of 1e-30"
finish
