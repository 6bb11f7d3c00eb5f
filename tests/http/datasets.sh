#!/usr/bin/env bash
# Datasets: kept under the hash of what they say, used by fits, listed, removed.
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
require_server
file=$samples/white_plastic.csv
# post_file PATH_QUERY FILE
post_file() { request POST "$1" -H 'Content-Type: text/csv' --data-binary "@$2"; }

post_file '/v1/datasets?name=plastic' "$file"
answered "a file" 201
id=$(jq -r .id "$work/body")
check "... has the hash of what it says" grep -qE '^[0-9a-f]{64}$' <<<"$id"
check_equal "... has a place" "$(header Location)" "/v1/datasets/$id"
rows=$(grep -cE '^[0-9]' "$file")
holds "... is told in short" '.name == "plastic" and .unit == "1/sr" and .samples == $rows and .channels[0].brdf.min > 0
    and (.channels[0].theta_i_deg | length) > 1 and .channels[0].out_of_plane == 0' --argjson rows "$rows"
post_file '/v1/datasets?name=plastic' "$file"
answered "the same again" 200
check_equal "... is the same" "$(jq -r .id "$work/body")" "$id"
{ grep '^#' "$file"; echo '# another comment'; grep -v '^#' "$file" | sed 's/$/\r/'; } >"$work/crlf.csv"
post_file '/v1/datasets?name=plastic' "$work/crlf.csv"
check_equal "... with other line ends and comments" "$(jq -r .id "$work/body")" "$id"
get "/v1/datasets/$id"
answered "the dataset" 200
holds "... with its measurements" '([.dataset.channels[].scans[].brdf[]] | length) == .samples'
jq .dataset "$work/body" >"$work/json"
get "/v1/datasets/$id" -H "If-None-Match: $(header ETag)"
answered "... is known by its tag" 304
post_json /v1/datasets - <"$work/json"
answered "its measurements posted as JSON" 200
check_equal "... are the same dataset" "$(jq -r .id "$work/body")" "$id"

# ---- out of the plane, and what rounding makes of it ----
post_json /v1/datasets '{"channels":[{"wavelength_nm":550.5,"samples":{"theta_i_deg":[10,20,30,40],"phi_i_deg":[0.1,350,0,0],
    "theta_r_deg":[30,40,50,60],"phi_r_deg":[180,33.3,0.7,180],"brdf":[0.1,0.2,-0.3,1e-20],"sigma":[1,2,3,4]}}]}'
answered "samples in any direction" 201
holds "... are told in short" '.channels[0] | .name == "550.5nm" and .samples == 4 and .out_of_plane == 3
    and .not_positive == 1 and .sigma'
other=$(jq -r .id "$work/body")
get "/v1/datasets/$other"
jq .dataset "$work/body" >"$work/json"
post_json /v1/datasets - <"$work/json"
check_equal "... keep their id as they are read and written" "$(jq -r .id "$work/body")" "$other"

# ---- only looked at ----
before=$(curl -sS "$url/v1/datasets" | jq '.items | length')
post_file '/v1/datasets/validate?unit=relative' "$samples/paper.csv"
answered "a file to be looked at" 200
holds "... is told in short" '.samples > 10 and .unit == "relative" and (has("id") | not)'
check_equal "... is not kept" "$(curl -sS "$url/v1/datasets" | jq '.items | length')" "$before"
for path in /v1/datasets /v1/datasets/validate; do
    printf 'theta_i_deg,theta_r_deg,brdf_per_sr\n30,-60,0,171\n30,91,x\n' >"$work/bad.csv"
    post_file $path "$work/bad.csv"
    refused "$path: decimal commas" 422 '.line == 2 and .code == "ragged"'
    holds "... and the next line's mistakes" 'any(.errors[]; .line == 3 and .column == 2 and .code == "out_of_range")
        and any(.errors[]; .line == 3 and .column == 3 and .code == "not_a_number")'
    post_json $path '{"channels":[{"scans":[{"theta_i_deg":95,"theta_r_deg":[1],"brdf":[1]}]}]}'
    refused "$path: an angle" 422 '.pointer == "/channels/0/scans/0/theta_i_deg"'
    post_json $path '{"channels":[{"scans":[]}]}'
    refused "$path: no samples" 422 '.pointer == "/channels/0"'
    request POST $path -H 'Content-Type: application/xml' --data '<x/>'
    refused "$path: XML" 415
    check_equal "$path: what is accepted" "$(header Accept-Post)" "application/json, text/csv"
done

# ---- fitted by its id ----
post_json /v1/fits "$(jq -nc --arg id "$id" '{dataset: $id, models: ["lambert", "ward"], options: {seed: 3}}')"
answered "a fit of a dataset by its id" 200
holds "... is of that dataset" '.dataset.name == "plastic" and .channels[0].samples == $rows' --argjson rows "$rows"
cp "$work/body" "$work/by_id"
fit=$(jq -r .id "$work/body")
post_csv "name=plastic&models=lambert,ward&seed=3" "$file"
check_equal "... as if it had come with it" "$(normalised "$work/body")" "$(normalised "$work/by_id")"
get "/v1/fits?dataset=$id"
holds "the dataset's fits" '[.items[].id] == [$fit] and .items[0].dataset == $id' --arg fit "$fit" --arg id "$id"
for wrong in "$(tr 0-9a-f 1-9a-f0 <<<"$id")" x ''; do
    post_json /v1/fits "$(jq -nc --arg id "$wrong" '{dataset: $id}')"
    refused "a fit of the dataset \"${wrong:0:5}\"" 422 '.pointer == "/dataset" and .code == "unknown_dataset"'
done
post_json /v1/fits "$(jq -nc --arg id "$id" '{dataset: $id, models: [{name: "ward", fixed: {alpha: -1}}]}')"
refused "a wrong value beside a dataset by its id" 422 '.pointer == "/models/0/fixed/alpha"'

# ---- listed, removed ----
get "/v1/datasets?limit=1"
holds "a page" '(.items | length) == 1 and .items[0].id == $id' --arg id "$other"
[[ $(header Link) =~ ^\<(.*)\>\;\ rel=\"next\"$ ]] && get "${BASH_REMATCH[1]}"
holds "the next page" '[.items[].id] == [$id] and .next_cursor == null' --arg id "$id"
request DELETE "/v1/datasets/$id"
answered "removed" 204
get "/v1/datasets/$id"
refused "... it is there no more" 404
request DELETE "/v1/datasets/$id"
refused "... nor can it be removed again" 404
get "/v1/fits/$fit/result"
answered "... its fit stays" 200
post_json /v1/fits "$(jq -nc --arg id "$id" '{dataset: $id}')"
refused "... and is not to be fitted again" 422 '.pointer == "/dataset"'
finish
