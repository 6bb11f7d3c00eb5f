#!/usr/bin/env bash
# What a scene asks for, and what is recommended for it.
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
require_server
measured() { get /v1/models/he_torrance && jq -e '.costs | length == 2' "$work/body"; }
check "costs are measured, of simpler forms, too" until_true 120 measured
holds "the simpler form is named" '.costs[1].submodel == "no effective roughness" and all(.costs[]; .under_load | type == "boolean")'

# Ward's surface without a diffuse term, with a little noise, and a lobe that points back to where the light comes from.
surface=$(jq -nc '
    def cos_deg: . * 0.017453292519943295 | cos;
    def sin_deg: . * 0.017453292519943295 | sin;
    def exp_: . * 1.4426950408889634 | exp2;
    3.141592653589793 as $pi | 0.16 as $alpha2
    | def ward($i; $r): (($i | cos_deg) + ($r | cos_deg)) as $z | (($r | sin_deg) - ($i | sin_deg)) as $x
        | 0.2 * (-$x * $x / ($z * $z * $alpha2) | exp_) / (4 * $pi * $alpha2) / (($i | cos_deg) * ($r | cos_deg) | sqrt);
    {dataset: {channels: [{scans: [(10, 25, 40, 55, 70) as $i | [range(-60; 76; 5)] as $r
        | {theta_i_deg: $i, theta_r_deg: $r, brdf: [$r[] | ward($i; .) * (0.985 + 0.005 * (((. + 100) / 5 * 3 + $i) % 7))]}]}]}}')
retro=$(jq -nc '{dataset: {channels: [{scans: [(10, 30, 50, 70) as $i | [range(-80; 81; 2)] as $r
    | {theta_i_deg: $i, theta_r_deg: $r, brdf: [$r[] | 0.01 + 3 * (-pow((. + $i) / 2; 2) | exp2) + 0.2 * (-pow((. + $i) / 20; 4) | exp2)]}]}]},
    models: ["lambert", "phong", "ward", "he_torrance"]}')
fits() { post_json /v1/fits "$(jq -c "$1" <<<"$surface")"; }

fits '.scene = {tolerance_log10: 0.02}'
answered "a scene" 200
holds "the simplest that does the job wins" '.channels[0].recommended | .model == "ward" and .submodel == "no diffuse term"'
holds "... and is a fit that is there" '.channels[0] as $c | $c.fits[$c.recommended.rank - 1] | .model == "ward" and .submodel == "no diffuse term"'
holds "... within the tolerance" '.channels[0] as $c | $c.fits[$c.recommended.rank - 1].log10_rmse <= 0.02'
holds "it is the cheapest that is, by the fits themselves" '.channels[0] as $c | $c.fits[$c.recommended.rank - 1].cost.single_ns as $ns
    | [$c.fits[] | select(.log10_rmse != null and .log10_rmse <= 0.02) | .cost.single_ns] | min == $ns'
holds "the front is of rising cost and falling error" '.channels[0].pareto | (map(.ns_per_evaluation) | . == sort)
    and (map(.log10_rmse) | . == (sort | reverse)) and length > 1'
holds "simpler forms are among the fits" '[.channels[0].fits[] | .submodel // empty] | unique
    == ["no diffuse term", "no effective roughness", "real index"]'
holds "each form once" '[.channels[0].fits[] | [.model, .lobes, .submodel]] | length == (unique | length)'
holds "the scene is told" '.scene == {theta_i_deg: [0, 90], theta_r_deg: [0, 90], outside_weight: 0, tolerance_log10: 0.02}'
get "$(jq -r .links.plots.brdf "$work/body")"
answered "plots of it" 200

fits '.scene = {tolerance_log10: 0.02, max_ns_per_evaluation: 1e-3}'
holds "none is cheap enough" '.channels[0].recommended | .model == null and (.reason | contains("cheap enough"))'
fits '.scene = {theta_i_deg: [20, 45], theta_r_deg: [0, 50]} | .models = ["ward"]'
holds "energy is judged where the scene sees" 'all(.channels[].fits[]; .physics.theta_i_deg == [20, 45]
    and .physics.at_theta_i_deg >= 20 and .physics.at_theta_i_deg <= 45 and ([.albedo[].theta_i_deg] == [25, 40]))'
holds "only what the scene sees is fitted" '.channels[0] | .samples == 42 and ([.fits[0].scans[].theta_i_deg] == [25, 40])'
fits '.scene = {theta_i_deg: [20, 45], theta_r_deg: [0, 50], outside_weight: 0.1} | .models = ["ward"]'
holds "or the rest weighs less, and is in no error" '.channels[0] | .samples == 140 and ([.fits[0].scans[].theta_i_deg] == [25, 40])'
fits '.scene = {require: ["reciprocal"]} | .models = ["phong", "ward"]'
holds "what is required" '.channels[0] | all(.fits[]; .model == "ward" and .physics.reciprocal) and (.failures | length > 0)
    and all(.failures[]; .model == "phong")'
fits '.scene = {theta_i_deg: [11, 12]}'
answered "a scene that sees nothing" 422
holds "... says where" '.errors[0].pointer == "/scene"'

post_json /v1/fits "$retro"
answered "a retro-reflector" 200
holds "no model here follows it" '.channels[0].recommended | .model == null and (.reason | contains("no model here is good enough"))'
fits '.options.judge = false'
holds "without judging nothing is recommended" '.channels[0] | has("recommended") or has("pareto") | not'
finish
