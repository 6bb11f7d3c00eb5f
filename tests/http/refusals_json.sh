#!/usr/bin/env bash
# JSON requests that are refused: each with its status, and where the mistake is.
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
require_server

base='{"dataset":{"name":"x","unit":"1/sr","channels":[{"name":"a","wavelength_nm":550,
  "scans":[{"theta_i_deg":15,"theta_r_deg":[-30,0,30,60],"brdf":[0.1,0.1,0.2,0.1],"sigma":[0.1,0.1,0.1,0.1]}],
  "samples":{"theta_i_deg":[15,15],"phi_i_deg":[0,0],"theta_r_deg":[30,40],"phi_r_deg":[180,90],"brdf":[0.2,0.1],"sigma":[0.1,0.1]}}]},
  "models":["ward",{"name":"lafortune","lobes":1,"fixed":{"k_d":0},"bounds":{"n_1":[1,500]}}],
  "options":{"loss":"chi2","effort":"draft","precision":"auto","seed":1,"time_limit_s":30}}'
post_json /v1/fits "$base"
answered "the request that the mistakes are made in" 200 || finish

# mistake NAME FILTER POINTER CODE: the request changed by the filter is refused with that error.
mistake() {
    post_json /v1/fits "$(jq -c "$2" <<<"$base")"
    refused "$1" 422 ".pointer == \"$3\" and .code == \"$4\""
}
# text NAME STATUS POINTER CODE BODY: the same for a body as it stands; line and column come with it.
text() {
    post_json /v1/fits "$5"
    refused "$1" "$2" ".pointer == \"$3\" and .code == \"$4\" ${6-}"
}
c=/dataset/channels/0

# ---- unknown keys, at each level ----
mistake "unknown key" '.opt = {}' /opt unknown_key
mistake "unknown key of the dataset" '.dataset.chanels = []' /dataset/chanels unknown_key
mistake "unknown key of a channel" '.dataset.channels[0].scan = []' $c/scan unknown_key
mistake "unknown key of a scan" '.dataset.channels[0].scans[0].phi_deg = 1' $c/scans/0/phi_deg unknown_key
mistake "unknown key of samples" '.dataset.channels[0].samples.phi_deg = 1' $c/samples/phi_deg unknown_key
mistake "unknown key of a model" '.models[1].lobe = 1' /models/1/lobe unknown_key
mistake "unknown option" '.options.los = "l2"' /options/los unknown_key
holds "the valid options are named" 'any(.errors[]; .detail | contains("loss") and contains("time_limit_s"))'
mistake "a key with / and ~" '.options["a/b~c"] = 1' /options/a~1b~0c unknown_key
mistake "unknown parameter, fixed" '.models[1].fixed.n = 1' /models/1/fixed/n unknown_parameter
mistake "unknown parameter, bounded" '.models[1].bounds.n_2 = [1, 2]' /models/1/bounds/n_2 unknown_parameter
mistake "lobes of a model without" '.models[0] = {name: "ward", lobes: 1}' /models/0/lobes unknown_key
mistake "unknown model" '.models[0] = "wart"' /models/0 unknown_model
holds "the valid models are named" \
    'any(.errors[]; .detail | contains("lambert, phong, ward") and contains("lafortune") and contains("he_torrance"))'
mistake "unknown model in an object" '.models[1].name = "Lafortune"' /models/1/name unknown_model

# ---- missing ----
mistake "no dataset" 'del(.dataset)' /dataset missing
mistake "no channels" 'del(.dataset.channels)' /dataset/channels missing
mistake "no measurements" 'del(.dataset.channels[0] | .scans, .samples)' $c missing
for key in theta_i_deg theta_r_deg brdf; do
    mistake "scan without $key" "del(.dataset.channels[0].scans[0].$key)" $c/scans/0/$key missing
    mistake "samples without $key" "del(.dataset.channels[0].samples.$key)" $c/samples/$key missing
done
mistake "samples without phi_r_deg" "del(.dataset.channels[0].samples.phi_r_deg)" $c/samples/phi_r_deg missing
mistake "a model without a name" 'del(.models[1].name)' /models/1/name missing
mistake "a stored dataset that there is not" '.dataset = "01930c1e"' /dataset unknown_dataset

# ---- wrong types ----
for value in 1 true null '[]' '"x"'; do
    post_json /v1/fits "$value"
    refused "$value as a request" 422 '.pointer == "" and .code == "wrong_type"'
done
mistake "a dataset that is a number" '.dataset = 1' /dataset wrong_type
mistake "a name that is a number" '.dataset.name = 1' /dataset/name wrong_type
mistake "channels that are an object" '.dataset.channels = {}' /dataset/channels wrong_type
mistake "no channel at all" '.dataset.channels = []' /dataset/channels wrong_type
mistake "a channel that is null" '.dataset.channels[0] = null' $c wrong_type
mistake "scans that are an object" '.dataset.channels[0].scans = {}' $c/scans wrong_type
mistake "a scan that is an array" '.dataset.channels[0].scans[0] = []' $c/scans/0 wrong_type
mistake "samples that are an array" '.dataset.channels[0].samples = []' $c/samples wrong_type
mistake "an angle that is text" '.dataset.channels[0].scans[0].theta_i_deg = "15"' $c/scans/0/theta_i_deg wrong_type
mistake "a column that is a number" '.dataset.channels[0].scans[0].brdf = 1' $c/scans/0/brdf wrong_type
mistake "a wavelength that is null" '.dataset.channels[0].wavelength_nm = null' $c/wavelength_nm wrong_type
mistake "models as text" '.models = "ward"' /models wrong_type
mistake "no model at all" '.models = []' /models wrong_type
mistake "a model that is a number" '.models[0] = 1' /models/0 wrong_type
mistake "fixed as an array" '.models[1].fixed = []' /models/1/fixed wrong_type
mistake "a fixed value as text" '.models[1].fixed.k_d = "0"' /models/1/fixed/k_d wrong_type
mistake "bounds of one" '.models[1].bounds.n_1 = [1]' /models/1/bounds/n_1 wrong_type
mistake "bounds with null" '.models[1].bounds.n_1 = [1, null]' /models/1/bounds/n_1 wrong_type
mistake "options as an array" '.options = []' /options wrong_type
mistake "a seed that is text" '.options.seed = "1"' /options/seed wrong_type
mistake "a loss that is a number" '.options.loss = 2' /options/loss wrong_type

# ---- values ----
mistake "unknown unit" '.dataset.unit = "1/sterad"' /dataset/unit unknown_value
mistake "unknown loss" '.options.loss = "l3"' /options/loss unknown_value
mistake "unknown effort" '.options.effort = "max"' /options/effort unknown_value
mistake "unknown precision" '.options.precision = "half"' /options/precision unknown_value
for seed in -1 1.5 9007199254740992; do mistake "seed $seed" ".options.seed = $seed" /options/seed out_of_range; done
for limit in 0 -1 3601; do mistake "time limit $limit" ".options.time_limit_s = $limit" /options/time_limit_s out_of_range; done
for lobes in 0 4 1.5 '"two"' null true; do mistake "lobes $lobes" ".models[1].lobes = $lobes" /models/1/lobes out_of_range; done
for angle in -1 90 91 1e30; do
    mistake "theta_i $angle" ".dataset.channels[0].scans[0].theta_i_deg = $angle" $c/scans/0/theta_i_deg out_of_range
    mistake "theta_i $angle of samples" ".dataset.channels[0].samples.theta_i_deg[1] = $angle" $c/samples/theta_i_deg/1 out_of_range
done
for angle in -90 90 180; do
    mistake "theta_r $angle" ".dataset.channels[0].scans[0].theta_r_deg[3] = $angle" $c/scans/0/theta_r_deg/3 out_of_range
    mistake "theta_r $angle of samples" ".dataset.channels[0].samples.theta_r_deg[0] = $angle" $c/samples/theta_r_deg/0 out_of_range
done
mistake "phi beyond a turn" '.dataset.channels[0].samples.phi_r_deg[1] = 361' $c/samples/phi_r_deg/1 out_of_range
mistake "a BRDF of 1e31" '.dataset.channels[0].scans[0].brdf[2] = 1e31' $c/scans/0/brdf/2 out_of_range
for sigma in 0 -0.1; do mistake "sigma $sigma" ".dataset.channels[0].scans[0].sigma[1] = $sigma" $c/scans/0/sigma/1 out_of_range; done
for nm in 0 -550 1e8; do mistake "wavelength $nm" ".dataset.channels[0].wavelength_nm = $nm" $c/wavelength_nm out_of_range; done
mistake "a sign that contradicts phi" '.dataset.channels[0].samples.theta_r_deg[0] = -30' $c/samples/theta_r_deg/0 contradiction
mistake "a name of 201 bytes" '.dataset.name = "x" * 201' /dataset/name too_long
mistake "two channels of one name" '.dataset.channels += [.dataset.channels[0]]' /dataset/channels/1/name duplicate
mistake "51 models" '.models = [range(51) | "ward"]' /models wrong_type

# ---- not finite: JSON has no such numbers, but people write them ----
for value in '"NaN"' '"Infinity"' null; do
    mistake "a BRDF of $value" ".dataset.channels[0].scans[0].brdf[1] = $value" $c/scans/0/brdf/1 wrong_type
done
for value in 1e999 -1e999; do
    text "a BRDF of $value" 422 $c/scans/0/brdf/1 not_finite \
        "{\"dataset\":{\"channels\":[{\"scans\":[{\"theta_i_deg\":0,\"theta_r_deg\":[1,2],\"brdf\":[1,$value]}]}]}}" \
        "and .line == 1 and .column > 80"
done
for value in NaN Infinity -Infinity .5 1. +1; do
    text "a BRDF of $value" 400 $c/scans/0/brdf/1 syntax \
        "{\"dataset\":{\"channels\":[{\"scans\":[{\"theta_i_deg\":0,\"theta_r_deg\":[1,2],\"brdf\":[1,$value]}]}]}}"
done

# ---- lengths ----
for key in brdf sigma; do
    mistake "a scan's $key too short" ".dataset.channels[0].scans[0].$key |= .[1:]" $c/scans/0/$key ragged
done
for key in theta_i_deg phi_i_deg phi_r_deg brdf sigma; do
    mistake "samples' $key too long" ".dataset.channels[0].samples.$key += [10]" $c/samples/$key ragged
done
mistake "a scan of nothing" '.dataset.channels[0].scans[0] |= (.theta_r_deg = [] | .brdf = [] | .sigma = [])' \
    $c/scans/0/theta_r_deg empty
mistake "no scan" '.dataset.channels[0] |= (.scans = [] | del(.samples))' $c empty

# ---- what does not go together ----
mistake "fewer samples than parameters" \
    'del(.dataset.channels[0].scans) | .dataset.channels[0].samples |= map_values(.[:2])' $c too_few_samples
mistake "fewer samples than any model has parameters" \
    'del(.models, .dataset.channels[0].scans) | .models = ["lambert", "phong"]' $c too_few_samples
mistake "bounds upside down" '.models[1].bounds.n_1 = [500, 1]' /models/1/bounds/n_1 out_of_range
mistake "bounds of no width" '.models[1].bounds.n_1 = [5, 5]' /models/1/bounds/n_1 out_of_range
mistake "bounds outside the domain" '.models[1].bounds.n_1 = [-1, 5]' /models/1/bounds/n_1 out_of_range
mistake "a fixed value outside the domain" '.models[1].fixed.k_d = -0.1' /models/1/fixed/k_d out_of_range
mistake "fixed and bounded" '.models[1].fixed.n_1 = 5' /models/1/bounds/n_1 contradiction
mistake "chi2 without sigma" 'del(.dataset.channels[0].scans[0].sigma)' /options/loss needs_sigma
mistake "several mistakes: the first" '.opt = 1 | .dataset.unit = "m" | .models[0] = "x"' /opt unknown_key
holds "several mistakes are told together" '[.errors[].pointer] | sort == ["/dataset/unit", "/models/0", "/opt"]'
mistake "a hundred mistakes" '.models = [range(50) | "x\(.)"] | .options = ([range(50) | {"y\(.)": 1}] | add)' /models/0 unknown_model
holds "at most 50 are told" '.errors | length == 50'

# ---- not JSON ----
for body in '' ' ' '{' '{"dataset":' '{"dataset" 1}' '{"a":1}x' '[1,]' "{'a':1}" '{"a":tru}' $'{"a":"\x01"}' $'{"a":"\xff"}' \
    '{"a":"\ud800"}' '// {}' '[01]' '[0x10]'; do
    post_json /v1/fits "$body"
    refused "not JSON: $body" 400 '.code == "syntax" and .line == 1 and .column >= 1'
done
text "truncated" 400 /dataset/channels/0/name syntax $'{"dataset":\n {"channels": [{"name": "re' 'and .line == 2 and .column > 20'
text "an error on the third line" 400 /b syntax $'{"a": 1,\n\n  "b": ?}' 'and .line == 3 and .column == 8'
text "a key twice" 400 /options/seed duplicate_key '{"options":{"seed":1,"seed":2}}' 'and .line == 1 and .column == 22'
text "a key twice, escaped" 400 /a duplicate_key '{"a":1,"\u0061":2}'
text "nested 17 deep" 400 "$(printf '/0%.0s' {1..16})" too_deep "$(printf '[%.0s' {1..17})" 'and .line == 1 and .column == 17'
printf '[%.0s' {1..1000000} | post_json /v1/fits -
refused "nested a million deep" 400 '.code == "too_deep"'
printf '{"models":["ward"]}\0{}' | post_json /v1/fits -
refused "text after a NUL byte" 400 '.code == "nul_byte" and .line == 1 and .column == 20'
get /health/live
answered "the service has survived" 200
finish
