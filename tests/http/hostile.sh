#!/usr/bin/env bash
# Bodies and names made to hurt: each is answered at once, in little, and what it names is shown harmless.
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
require_server
# resident: memory of the server, in KB.
resident() { awk '/^VmRSS/ { print $2 }' "/proc/$server/status"; }

# harmless NAME STATUS [FILTER]: the last answer is a small problem, and the service is well.
harmless() {
    refused "$@"
    check "$1: in little" test "$(wc -c <"$work/body")" -lt 65536
    local well
    well=$(curl -sS -m 5 -o /dev/null -w '%{http_code}' "$url/health/live")
    check_equal "$1: the service is well" "$well" 200
}
# quick NAME COMMAND...: within 10 s.
quick() {
    local name=$1 start=$EPOCHREALTIME
    shift
    "$@"
    check "$name: at once" awk -v a="$start" -v b="$EPOCHREALTIME" 'BEGIN { exit !(b - a < 10) }'
}
post_file() { request POST "$1" -H "Content-Type: $2" --data-binary "@$3"; }
json=application/json
before=$(resident)

# ---- JSON ----
awk 'BEGIN { printf "{"; for (i = 0; i < 1e6; ++i) printf "\"k%d\":%d,", i, i; print "\"k\":1}" }' >"$work/keys.json"
quick "a million keys" post_file /v1/fits $json "$work/keys.json"
harmless "a million keys" 422 '.pointer == "" and .code == "too_many"'
awk 'BEGIN { printf "{"; for (i = 0; i < 900; ++i) printf "\"k%d\":%d,", i, i; print "\"k\":1}" }' >"$work/keys.json"
quick "900 unknown keys" post_file /v1/fits $json "$work/keys.json"
harmless "900 unknown keys" 422 '.code == "unknown_key"'
holds "900 unknown keys: 50 errors" '.errors | length == 50'
{ printf '{"'; head -c 1000000 /dev/zero | tr '\0' k; printf '":1}'; } >"$work/long.json"
quick "a key of 1 MB" post_file /v1/fits $json "$work/long.json"
harmless "a key of 1 MB" 422 '.code == "unknown_key" and (.pointer | length) < 300'
awk 'BEGIN { printf "{"; for (i = 0; i < 60; ++i) { printf "\"%d", i; for (j = 0; j < 20000; ++j) printf "ä/~"; printf "\":1," } print "\"k\":1}" }' >"$work/long.json"
quick "60 keys of 100 KB to be escaped" post_file /v1/fits $json "$work/long.json"
harmless "60 keys of 100 KB to be escaped" 422 '.code == "unknown_key"'
for member in name unit channels; do
    { printf '{"dataset":{"%s":"' $member; head -c 1000000 /dev/zero | tr '\0' n; printf '"}}'; } >"$work/long.json"
    quick "a $member of 1 MB" post_file /v1/fits $json "$work/long.json"
    harmless "a $member of 1 MB" 422 ".pointer == \"/dataset/$member\""
done
{ printf '{"models":["'; head -c 1000000 /dev/zero | tr '\0' m; printf '"]}'; } >"$work/long.json"
quick "a model of 1 MB" post_file /v1/fits $json "$work/long.json"
harmless "a model of 1 MB" 422 '.pointer == "/models/0" and .code == "unknown_model"'
head -c 1000000 /dev/zero | tr '\0' '[' >"$work/deep.json"
quick "a million brackets" post_file /v1/fits $json "$work/deep.json"
harmless "a million brackets" 400 '.code == "too_deep"'
awk 'BEGIN { for (i = 0; i < 1e6; ++i) printf "{\"a\":" }' >"$work/deep.json"
quick "a million braces" post_file /v1/fits $json "$work/deep.json"
harmless "a million braces" 400 '.code == "too_deep"'
{ printf '['; awk 'BEGIN { for (i = 0; i < 2e6; ++i) printf "[]," }'; printf '[]]'; } >"$work/wide.json"
quick "two million arrays" post_file /v1/fits $json "$work/wide.json"
harmless "two million arrays" 422 '.pointer == "" and .code == "wrong_type"'
{ printf '['; awk 'BEGIN { for (i = 0; i < 4e6; ++i) printf "1," }'; printf '1]'; } >"$work/wide.json"
quick "four million numbers" post_file /v1/evaluate $json "$work/wide.json"
harmless "four million numbers" 422 '.pointer == "" and .code == "wrong_type"'
{ printf '{"dataset":{"name":'; head -c 1000000 /dev/zero | tr '\0' 9; printf '}}'; } >"$work/long.json"
quick "a number of a million digits" post_file /v1/fits $json "$work/long.json"
harmless "a number of a million digits" 422 '.pointer == "/dataset/name" and .code == "not_finite"'
for body in '{"a":"\ud800"}' '{"a":"\udc00\ud800"}' '{"a":"\ud800\u0041"}' $'{"a":"\xed\xa0\x80"}' $'{"a":"\xc0\x80"}' $'{"a":"\xf8\x88\x80\x80\x80"}'; do
    post_json /v1/fits "$body"
    harmless "no text: $body" 400 '.code == "syntax"'
done
post_json /v1/fits '{"dataset":{"name":"\u0000"}}'
harmless "a NUL byte, escaped" 422
printf '\xff\xfe{\0}\0' >"$work/utf16.json"
post_file /v1/fits $json "$work/utf16.json"
harmless "UTF-16" 400
for value in 1e400 -1e400 1e-400 123456789012345678901234567890; do
    post_json /v1/fits "{\"options\":{\"seed\":$value}}"
    harmless "a seed of $value" 422 '.pointer == "/options/seed" or .pointer == "/dataset"'
done

# ---- CSV ----
head=theta_i_deg,theta_r_deg,brdf_per_sr
# csv NAME TEXT [FILTER]: is refused so.
csv() {
    printf '%b' "$2" >"$work/bad.csv"
    quick "$1" post_file '/v1/fits?models=lambert' text/csv "$work/bad.csv"
    harmless "$1" 422 "${3-true}"
}
csv "decimal commas" "$head\n15,0,0,1\n" '.line == 2 and .code == "ragged"'
csv "decimal commas, semicolons between" 'theta_i_deg;theta_r_deg;brdf_per_sr\n15;0;0,1\n' '.line == 1 and .code == "unknown_key"'
csv "tabs" 'theta_i_deg\ttheta_r_deg\tbrdf_per_sr\n15\t0\t1\n' '.line == 1 and .code == "unknown_key"'
csv "line ends of an old Mac" "$head\r15,0,1\r" '.line == 1'
csv "line ends that differ, and a mistake" "# c\r\n$head\n15,0,1\r\n15,1,x\n" '.line == 4 and .column == 3'
csv "a sign that phi contradicts" "$head,phi_i_deg,phi_r_deg\n15,-30,0.2,0,180\n" '.line == 2 and .column == 2'
csv "thousands separated" "$head\n15,0,\"1,000\"\n" '.code == "not_a_number"'
csv "UTF-16" '\xff\xfet\0h\0e\0' '.line == 1'
csv "an array of formulas" "$head\n=1+1,0,1\n" '.code == "not_a_number"'
{ echo $head; head -c 2000000 /dev/zero | tr '\0' 1; } >"$work/bad.csv"
quick "a line of 2 MB" post_file /v1/fits text/csv "$work/bad.csv"
harmless "a line of 2 MB" 422 '.line == 2'
{ head -c 1000000 /dev/zero | tr '\0' x; echo; echo 1; } >"$work/bad.csv"
quick "a column's name of 1 MB" post_file /v1/fits text/csv "$work/bad.csv"
harmless "a column's name of 1 MB" 422 '.code == "unknown_key"'
{ echo $head,channel; printf '15,0,1,'; head -c 1000000 /dev/zero | tr '\0' x; } >"$work/bad.csv"
quick "a channel's name of 1 MB" post_file /v1/fits text/csv "$work/bad.csv"
harmless "a channel's name of 1 MB" 422 '.line == 2 and .column == 4 and .code == "too_long"'
head -c 2000000 /dev/zero | tr '\0' , >"$work/bad.csv"
quick "two million columns" post_file /v1/fits text/csv "$work/bad.csv"
harmless "two million columns" 422
awk -v h=$head 'BEGIN { print h; for (i = 0; i < 1e6 + 1; ++i) print "1,2,3" }' >"$work/bad.csv"
quick "a row too many" post_file '/v1/fits?models=lambert' text/csv "$work/bad.csv"
harmless "a row too many" 422 '.code == "too_many"'
rm -f "$work"/*.json "$work/bad.csv"

# ---- bodies as large as they may be ----
# in_little NAME STATUS TYPE FILTER: refuses the body that standard input has, and takes little memory over it.
in_little() {
    local base
    head -c 33554432 >"$work/large"
    base=$(resident)
    echo 5 >"/proc/$server/clear_refs" # the peak counts from here
    quick "$1" post_file /v1/fits "$3" "$work/large"
    harmless "$1" "$2" "$4"
    local peak=$(($(awk '/^VmHWM/ { print $2 }' "/proc/$server/status") - base))
    check "$1: less than 48 MB beside what it is" test $peak -lt $((32768 + 16384))
}
of() { yes "$1" | tr -d '\n'; }
of ' ' | in_little "32 MB of blanks" 400 $json '.code == "syntax" and .column == 33554433'
yes '' | in_little "32 MB of ends of line" 400 $json '.code == "syntax" and .line == 33554433'
{ printf '{"dataset":{"name":"'; of x; } | in_little "a string of 32 MB" 422 $json '.pointer == "/dataset/name" and .code == "too_long"'
{ printf '{"'; of x; } | in_little "a key of 32 MB" 422 $json '.code == "too_long"'
{ printf '{"seed":'; of 9; } | in_little "a number of 32 MB" 422 $json '.code == "too_long"'
{ printf '{"models":["a"'; of ',"b"'; } | in_little "millions of strings" 422 $json '.pointer == "/models" and .code == "wrong_type"'
{ printf '{"dataset":{"channels":[{"scans":[{}'; of ',{"a":1}'; } |
    in_little "millions of objects" 422 $json '.pointer == "/dataset/channels/0/scans/1/a" and .code == "unknown_key"'
{ printf '{"x":[['; of '1,' | head -c 1900000; printf '1]'; of ",[$(of 1, | head -c 90000)1]"; } |
    in_little "millions of numbers where none belong" 422 $json '.pointer == "/x" and .code == "unknown_key"'
of , | in_little "32 MB of commas" 422 text/csv '.code == "too_many"'
{ echo $head; yes 1,2,3; } | in_little "five million rows" 422 text/csv '.line == 1000002 and .code == "too_many"'
check "memory grew by less than 64 MB" test $(($(resident) - before)) -lt 65536

# ---- names ----
names=('<script>alert(1)</script>' "quotes ' \" and & < >" $'two\nlines\r\nSet-Cookie: x=1' $'over\xe2\x80\xaeride\xe2\x81\xa6' $'bell\a\e[31mred' '=HYPERLINK("http://x")')
for name in "${names[@]}"; do
    shown=$(jq -nc --arg n "$name" '$n')
    post_json /v1/fits "$(jq -nc --arg n "$name" '{dataset: {name: $n, channels: [{name: $n, scans: [{theta_i_deg: 30,
        theta_r_deg: [-30, 0, 30, 60], brdf: [0.1, 0.1, 0.2, 0.1]}]}]}, models: ["lambert"]}')"
    answered "a fit of $shown" 200 || continue
    holds "$shown is as it was given" '.dataset.name == $n and .channels[0].name == ($n | if . == "" then "1" else . end)' --arg n "$name"
    id=$(jq -r .id "$work/body")
    for kind in brdf residual summary; do
        get "/v1/fits/$id/plots/$kind.svg"
        check "$shown: $kind is well-formed" xmllint --noout --nonet "$work/body"
        check "$shown: $kind has no markup of a name" test "$(grep -cE '<script|<img|javascript:' "$work/body")" = 0
        check "$shown: $kind turns no text around" test "$(grep -acP '\xe2\x80[\xaa-\xae]|\xe2\x81[\xa6-\xa9]' "$work/body")" = 0
        check "$shown: $kind has no control characters" test "$(tr -d '\n\t' <"$work/body" | LC_ALL=C grep -c $'[\x01-\x1f]')" = 0
    done
    get "/v1/fits/$id/result" -H 'Accept: text/csv'
    answered "$shown: as CSV" 200
    check "$shown: no formula in the CSV" test "$(grep -cE '^[=+@-]|,[=+@]' "$work/body")" = 0
    check "$shown: a header of ours" grep -qE '^attachment; filename="[0-9a-f-]+\.csv"$' <<<"$(header Content-Disposition)"
    check "$shown: none of its own" test -z "$(header Set-Cookie)"
done
check "no name makes a line of the log" test "$(grep -cE '^Set-Cookie|^lines' "$log")" = 0
check "no control characters in the log" test "$(LC_ALL=C grep -c $'[\x01-\x08\x0b-\x1f]' "$log")" = 0
get '/v1/fits?state=%3Cscript%3E%0d%0aX:%20y'
harmless "a query of markup" 422
get "/v1/datasets/$(printf '%%2e%%2e%%2f%.0s' {1..20})etc/passwd"
harmless "a path that climbs" 404
finish
