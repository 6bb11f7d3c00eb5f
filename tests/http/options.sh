#!/usr/bin/env bash
# What a request may ask for, and what measurements may look like.
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
require_server

# A small surface: Ward's model over five incidence angles, as a request; filters below change it.
surface=$(jq -nc '
    def cos_deg: . * 0.017453292519943295 | cos;
    def sin_deg: . * 0.017453292519943295 | sin;
    def exp_: . * 1.4426950408889634 | exp2;
    3.141592653589793 as $pi | 0.04 as $alpha2
    | def ward($i; $r): (($i | cos_deg) + ($r | cos_deg)) as $z | (($r | sin_deg) - ($i | sin_deg)) as $x
        | 0.3 / $pi + 0.2 * (-$x * $x / ($z * $z * $alpha2) | exp_)
          / (4 * $pi * $alpha2) / (($i | cos_deg) * ($r | cos_deg) | sqrt);
    {dataset: {channels: [{scans: [(10, 25, 40, 55, 70) as $i | [range(-75; 76; 5)] as $r
        | {theta_i_deg: $i, theta_r_deg: $r, brdf: [$r[] | ward($i; .) * (0.97 + 0.01 * (((. + 100) / 5 * 3 + $i) % 7))]}]}]},
     models: ["ward"]}')
# fits FILTER: posts the surface changed by it.
fits() { post_json /v1/fits "$(jq -c "$1" <<<"$surface")"; }
value() { jq -r ".channels[0].fits[0].parameters.$1.value" "$work/body"; }

# ---- losses, efforts, precisions ----
for loss in cosine_l2 l2 log relative; do
    fits ".options.loss = \"$loss\""
    answered "loss $loss" 200
    holds "loss $loss finds the lobe" '.channels[0].fits[0].parameters
        | (.alpha.value - 0.2 | fabs) < 0.02 and (.rho_d.value - 0.3 | fabs) < 0.03'
done
fits '.options.loss = "chi2" | .dataset.channels[0].scans[] |= (.sigma = [.brdf[] | 0.02 * .])'
answered "loss chi2" 200
holds "chi2 is about 1 where sigma is the noise" '.channels[0].fits[0].loss | . > 0.2 and . < 2'
fits '.options = {loss: "cosine", cos_theta_i_exponent: 0, cos_theta_r_exponent: 1}'
answered "cosine with exponents" 200
cp "$work/body" "$work/cosine"
fits '.options.loss = "cosine_l2"'
check "exponents 0 and 1 are cosine_l2" jq -ne --slurpfile a "$work/cosine" --slurpfile b "$work/body" \
    '[$a, $b | .[0].channels[0].fits[0] | [.parameters, .loss]] | .[0] == .[1]'
fits '.options = {loss: "cosine", cos_theta_i_exponent: 1, cos_theta_r_exponent: -0.5}'
holds "exponents are told" '.channels[0].loss
    | .name == "cosine" and .cos_theta_i_exponent == 1 and .cos_theta_r_exponent == -0.5 and .robust == "none"'
fits '.options = {loss: "cosine", cos_theta_r_exponent: -1} | .dataset.channels[0].scans[0].theta_r_deg[0] = -89.9'
answered "a negative exponent beside a grazing angle" 422
fits '.options = {loss: "l2", cos_theta_r_exponent: 1}'
answered "exponents of another loss" 422
# Every twentieth value is ten times too large.
outliers='.dataset.channels[0].scans[].brdf |= (to_entries | map(if .key % 20 == 7 then 10 * .value else .value end))'
for robust in huber cauchy; do
    for loss in cosine_l2 l2 log relative; do
        fits "$outliers | .options = {loss: \"$loss\", robust: \"$robust\"}"
        answered "$robust $loss" 200
        holds "$robust $loss finds the lobe all the same" '.channels[0].fits[0].parameters
            | (.alpha.value - 0.2 | fabs) < 0.02 and (.rho_d.value - 0.3 | fabs) < 0.03'
        holds "$robust $loss counts the outliers" '.channels[0] | .loss.robust == $robust and .loss.robust_scale > 0
            and (.fits[0].outliers | .count > 5 and .count < 15 and (.samples | length) == .count)' --arg robust "$robust"
    done
done
fits "$outliers"' | .options = {loss: "chi2", robust: "huber", robust_threshold: 2} | .dataset.channels[0].scans[] |= (.sigma = [.brdf[] | 0.02 * .])'
holds "robust chi2 with a threshold" '.channels[0].loss.robust_threshold == 2'
fits '.options.robust_threshold = 2'
answered "a threshold without a robust loss" 422
fits '.options.loss = "l2"'
holds "l2's loss is the rmse" '.channels[0].fits[0] | (.loss - .rmse | fabs) <= 1e-9 * .rmse'
fits '.options.loss = "log"'
holds "log's loss is in decades" '.channels[0].fits[0] | (.loss - .log10_rmse | fabs) <= 1e-9 * .loss'
for effort in draft standard thorough; do
    fits ".options.effort = \"$effort\""
    answered "effort $effort" 200
    jq .channels[0].fits[0].search.evaluations "$work/body" >>"$work/evaluations"
done
check "more effort, more evaluations" sort -nc "$work/evaluations"
fits '.models = ["lambert", "phong", "ward", "lafortune", "he_torrance"]'
cp "$work/body" "$work/double"
fits '.models = ["lambert", "phong", "ward", "lafortune", "he_torrance"] | .options.precision = "single"'
answered "precision single" 200
holds "precision single: it is told, and all models fit" '.device.precision == "single" and (.channels[0].fits | length == 5)'
check "precision single finds the same losses to 1 %" jq -ne --slurpfile a "$work/double" --slurpfile b "$work/body" \
    '[$a, $b | .[0].channels[0].fits | map({(.model): .loss}) | add] as [$x, $y]
     | all($x | keys[]; $x[.] / $y[.] | . > 0.99 and . < 1.01)'
fits '.options.ledger = true | .models = ["ward", {name: "lafortune", lobes: 2}]'
answered "a ledger" 200
holds "a ledger: what each fit would have been with less" '.channels[0] | (has("warnings") | not) and all(.fits[].ledger;
    map(.change)[:4] == ["precision single", "effort draft", "stop after screening", "stop after descents"]
    and all(.loss_ratio >= 0.999999 and .evaluations >= 1)
    and all(.[:2][]; .time_s >= 0 and (.largest_shift | (.parameter | type) == "string" and .relative >= 0)))'
fits '.'
holds "no ledger unless it is asked for" 'all(.channels[0].fits[]; has("ledger") | not)'
fits '.options.time_limit_s = 1e-9'
answered "no time at all" 200
holds "no time at all: says so, or what it found" \
    'all(.channels[0].fits[]; .search.stop_reason == "time_limit") and (.channels[0] | (.fits + .failures) | length == 1)'

# ---- bounds and fixed values ----
fits '.models = [{name: "ward", bounds: {alpha: [0.3, 0.4]}}]'
check_equal "a bound that binds" "$(value alpha)" 0.3
holds "... is told" '.channels[0].fits[0].parameters.alpha | .at_bound and .std_error == null'
fits '.models = [{name: "ward", bounds: {rho_s: [0, 1000], alpha: [1e-4, 50]}}]'
holds "bounds wider than the model's own" '.channels[0].fits[0].parameters | .alpha.value > 0.15 and .alpha.value < 0.25'
fits '.models = [{name: "ward", fixed: {alpha: 0.25, rho_d: 0.31}}]'
holds "fixed values stay" '.channels[0].fits[0].parameters
    | .alpha.value == 0.25 and .rho_d.value == 0.31 and .alpha.fixed and .rho_d.fixed and (.rho_s | has("fixed") | not)'
fits '.models = [{name: "ward", fixed: {alpha: 0.25, rho_d: 0.31, rho_s: 0.2}}]'
answered "all fixed" 200
holds "all fixed: the errors at that point" '.channels[0].fits[0] | .loss > 0 and .parameters.rho_s.value == 0.2'
fits '.models = [{name: "he_torrance", fixed: {sigma: 0.25}, bounds: {tau: [1, 3]}}] | .dataset.channels[0].wavelength_nm = 500'
holds "lengths in micrometres beside a wavelength" '.channels[0].fits[0].parameters
    | .sigma.unit == "um" and (.sigma.value - 0.25 | fabs) < 1e-12 and .tau.unit == "um" and .tau.value >= 1 and .tau.value <= 3'
fits '.models = [{name: "he_torrance", fixed: {sigma: 0.5}, bounds: {tau: [2, 6]}}]'
holds "lengths in wavelengths without one" '.channels[0].fits[0].parameters
    | .sigma.unit == "lambda" and .sigma.value == 0.5 and .tau.value >= 2 and .tau.value <= 6'
holds "no wavelength: none is told" '.channels[0] | .name == "1" and (has("wavelength_nm") | not)'
fits '.models = ["ward", {name: "ward", fixed: {alpha: 1}}]'
holds "a model twice" '.channels[0].fits | length == 2 and .[1].parameters.alpha.fixed'

# ---- lobes ----
for lobes in 1 2 3; do
    fits ".models = [{name: \"lafortune\", lobes: $lobes}]"
    holds "lafortune with $lobes lobes" '.channels[0].fits[0] | .lobes == $l and (.parameters | length == 1 + 3 * $l)' \
        --argjson l $lobes
    holds "$lobes lobes in falling order of n" '[.channels[0].fits[0].parameters | to_entries[]
        | select(.key | startswith("n_")).value.value] | reverse | . == sort'
    jq .channels[0].fits[0].loss "$work/body" >>"$work/losses"
done
check "a further lobe is never worse" sort -grc "$work/losses"
fits '.models = [{name: "lafortune", lobes: "auto"}]'
holds "lobes auto" '.channels[0].fits[0].lobes | IN(1, 2)'
fits '.models = ["lafortune"]'
holds "lobes auto is the default" '.channels[0].fits[0].lobes | IN(1, 2)'

# ---- measurements ----
fits '.dataset.channels[0].scans[0].brdf[0, 1] = -0.001 | .dataset.channels[0].scans[1].brdf[0] = 0'
answered "values that are not positive" 200
holds "they are kept, and counted in a warning" \
    '.channels[0] | .samples == 155 and any(.warnings[]; startswith("3 of 155 "))'
fits '.dataset.channels[0].scans[0].brdf[0, 1] = -0.001 | .options.loss = "log"'
answered "loss log beside negative values" 200
holds "... and it fits" '.channels[0].fits[0].loss < 0.05'
fits '.'
holds "no warning where there is nothing to warn of" '.channels[0] | has("warnings") | not'

relative='.dataset.unit = "relative" | .models = ["lambert", "phong", "ward", {name: "lafortune", lobes: 1}, "he_torrance"]'
fits "$relative"
answered "relative data" 200
holds "relative data: unit and scale are told" '.dataset.unit == "relative" and all(.channels[0].fits[]; .scale > 0)'
cp "$work/body" "$work/once"
fits "$relative"' | .dataset.channels[0].scans[].brdf |= map(1000 * .)'
check "a factor of 1000 goes into the scale alone" jq -ne --slurpfile a "$work/once" --slurpfile b "$work/body" '
    def same($x; $y): ($x - $y | fabs) <= 1e-3 * ($x | fabs) + 1e-6;
    [$a, $b | .[0].channels[0].fits | map({(.model): .}) | add] as [$x, $y] | $x | keys[] as $m
    | same(1000 * $x[$m].scale; $y[$m].scale) and same($x[$m].relative_loss; $y[$m].relative_loss)
      and all($x[$m].parameters | keys[]; same($x[$m].parameters[.].value; $y[$m].parameters[.].value))'
fits '.'
holds "absolute data have no scale" 'all(.channels[0].fits[]; has("scale") | not)'

fits '.dataset.channels += [.dataset.channels[0] | .name = "grün & /\"<b>"] | .dataset.channels[0].name = "red"'
answered "two channels" 200
holds "two channels, in order" '[.channels[].name] == ["red", "grün & /\"<b>"]'
holds "links of plots name the channel" '.channels[1].fits[0].links.plot
    | endswith("?models=ward&channel=gr%C3%BCn%20%26%20%2F%22%3Cb%3E")'
get "$(jq -r '.channels[1].fits[0].links.plot' "$work/body")"
answered "plot of the second channel" 200
check "plot of the second channel: well-formed" xmllint --noout --nonet "$work/body"

post_json /v1/fits "$(jq -c '.dataset.channels[0] = {samples: (.dataset.channels[0].scans | {
    theta_i_deg: [.[] | .theta_i_deg as $i | .theta_r_deg[] | $i],
    theta_r_deg: [.[].theta_r_deg[] | fabs], phi_r_deg: [.[].theta_r_deg[] | if . < 0 then 0 else 180 end],
    brdf: [.[].brdf[]]})}' <<<"$surface")"
normalised "$work/body" >"$work/as_samples"
fits '.'
normalised "$work/body" >"$work/as_scans"
check "scans and samples of the same directions give the same answer" cmp "$work/as_samples" "$work/as_scans"

# ---- CSV ----
jq -r '"theta_i_deg,theta_r_deg,brdf_per_sr", (.dataset.channels[0].scans[] | .theta_i_deg as $i
    | [.theta_r_deg, .brdf] | transpose[] | "\($i),\(.[0]),\(.[1])")' <<<"$surface" >"$work/scan.csv"
post_csv models=ward "$work/scan.csv"
normalised "$work/body" >"$work/as_csv"
check "CSV gives the same answer as JSON" cmp "$work/as_csv" "$work/as_scans"
{ printf '\xEF\xBB\xBF# a comment\r\n\r\n'; sed 's/$/\r/; s/,/ , /g' "$work/scan.csv"; } >"$work/dos.csv"
post_csv models=ward "$work/dos.csv"
check_equal "byte order mark, CR LF, comments, empty lines and spaces" "$(normalised "$work/body")" "$(cat "$work/as_scans")"
awk -F, -v OFS=, 'NR == 1 {print "brdf_per_sr,phi_r_deg,theta_r_deg,phi_i_deg,theta_i_deg"; next}
                  {print $3, $2 < 0 ? 10 : 190, $2, 10, $1}' "$work/scan.csv" >"$work/phi.csv"
post_csv models=ward "$work/phi.csv"
check_equal "columns in another order, and phi beside the sign" "$(normalised "$work/body")" "$(cat "$work/as_scans")"
awk -F, 'NR == 1 {print $0 ",wavelength_nm,channel,sigma"; next} {print $0 ",550,\"a, b\",0.01"; print $0 ",650.5,red,0.02"}' \
    "$work/scan.csv" >"$work/two.csv"
post_csv 'models=ward,phong&loss=chi2&seed=7&effort=draft&precision=double&time_limit_s=20&name=two%20of%20them' "$work/two.csv"
answered "CSV with all columns and options" 200
holds "CSV: channels" '[.channels[] | [.name, .wavelength_nm, .samples]] == [["a, b", 550, 155], ["red", 650.5, 155]]'
holds "CSV: options" '.seed == 7 and .dataset.name == "two of them" and all(.channels[]; .fits | length == 2)'
post_csv 'models=ward&loss=cosine&cos_theta_i_exponent=1&cos_theta_r_exponent=2&robust=huber&robust_threshold=1.5' "$work/scan.csv"
holds "CSV: exponents and a robust loss" '.channels[0].loss | .cos_theta_i_exponent == 1 and .cos_theta_r_exponent == 2
    and .robust == "huber" and .robust_threshold == 1.5'
post_csv 'models=ward&unit=relative' "$work/scan.csv" -H 'Content-Type: Text/CSV; charset=utf-8'
request POST '/v1/fits?models=ward&unit=relative' --data-binary "@$work/scan.csv" -H "$patient" \
    -H 'Content-Type: Text/CSV; charset=utf-8'
answered "content type with a parameter" 200
holds "CSV: unit" '.dataset.unit == "relative"'
finish
