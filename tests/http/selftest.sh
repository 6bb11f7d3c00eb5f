#!/usr/bin/env bash
# The self-test: at the start of a server, in its answers, as a command; on this device and on worse ones.
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
# A device that takes the models' constants as floats, which only double precision notices, and one without a compiler
# that works.
rough_in_double=--build-options=-cl-single-precision-constant
useless=--build-options=-no-such-option
file=$samples/white_plastic.csv
evaluation='{"model":"ward","parameters":{"rho_d":0.3,"rho_s":0.1,"alpha":0.15},
    "geometry":{"theta_i_deg":[30],"theta_r_deg":[31]}}'
with_precision() { jq -c --arg p "$1" '.precision = $p' <<<"$evaluation"; }

# ---- this device ----
require_server
get /health/ready
answered "ready" 200
holds "ready says so" '.status == "ready" and .selftest.largest_error_eps == 32'
holds "every precision is tested, in the brief form" '.selftest.precisions | length >= 1
    and all(.form == "brief" and (.precision | IN("single", "double")) and .passed and (has("reason") | not))'
holds "every variant of every model" 'all(.selftest.precisions[]; [.models[] | "\(.model)\(.lobes // "")"] | sort
    == ["he_torrance", "lafortune1", "lafortune2", "lafortune3", "lambert", "phong", "ward"])'
holds "errors are told and small" 'all(.selftest.precisions[].models[];
    .points >= 3 and .value.eps <= 32 and .slope.eps <= 32 and .passed and (.value | has("at") | not))'
cp "$work/body" "$work/ready"
get /v1
holds "/v1 tells the same" '.selftest == $ready[0].selftest' --slurpfile ready "$work/ready"
request HEAD /health/ready
answered "HEAD" 200
has_double=$(jq 'any(.selftest.precisions[]; .precision == "double")' "$work/ready")

# ---- a device that is off in double precision ----
if $has_double; then
    start_server $rough_in_double || { fail "a server on a worse device starts" "$(cat "$log")"; finish; }
    get /health/ready
    answered "single precision is left: ready" 200
    holds "double precision failed, with its reason" '.status == "ready" and (.selftest.precisions
        | map({(.precision): .}) | add | .single.passed and (.double.passed | not)
        and (.double.reason | contains("double precision") and contains("phong is off by") and contains("32 eps are allowed")))'
    holds "the worst point is told, in hexadecimal" 'any(.selftest.precisions[].models[];
        .passed == false and (.value.at // "" | test("n=0x.*theta_i_deg=0x")))'
    check "the log says it" grep -q 'failed the self-test in double precision' "$log"
    post_json /v1/evaluate "$(with_precision double)"
    refused "a value in double precision" 422 '.pointer == "/precision" and .code == "unsupported"
        and (.detail | contains("failed the self-test in double precision"))'
    post_json /v1/evaluate "$(with_precision auto)"
    answered "a value in any precision" 200
    check "... is of single precision" test "$(jq -r '.values[0] | tostring | length' "$work/body")" -lt 14
    post_csv 'models=ward&precision=double' "$file"
    refused "a fit in double precision" 422 '.pointer == "/options/precision" and .code == "unsupported"'
    for precision in auto single; do
        post_csv "models=ward&precision=$precision" "$file"
        answered "a fit in precision $precision" 200
        holds "... is of single precision" '.device.precision == "single" and (.channels[0].fits | length == 1)'
    done
    "$BRDFIT" fit "$file" models=ward $rough_in_double >"$work/fit" 2>"$work/fit.error"
    check_equal "brdfit fit on that device" $? 0
    check "... says what is not used" grep -q 'failed the self-test in double precision' "$work/fit.error"
    "$BRDFIT" fit "$file" models=ward precision=double $rough_in_double >"$work/fit" 2>&1
    check_equal "brdfit fit in double precision" $? 1
fi

# ---- a device that is off in every precision ----
start_server $useless || { fail "a server on an unfit device starts" "$(cat "$log")"; finish; }
get /health/live
answered "it lives" 200
get /health/ready
answered "it is not ready" 503
holds "... with reasons" '.status == "unfit" and all(.selftest.precisions[]; (.passed | not) and (.reason | length > 0))'
get /v1/models
answered "what needs no device is answered" 200
post_json /v1/evaluate "$evaluation"
refused "a value" 503
holds "... says where to look" '.type == "/problems/unfit-device" and (.detail | contains("/health/ready"))'
post_csv models=ward "$file"
refused "a fit" 503
post_csv models=wart "$file"
refused "a mistake is told all the same" 422

# ---- the command ----
"$BRDFIT" selftest >"$work/table" 2>"$work/table.error"
check_equal "brdfit selftest" $? 0
check "a line a model" grep -qE '^ +lafortune \(3\) +(single|double) +[0-9]+ +[0-9.]+ +[0-9.]+ +[0-9.]+  passed$' "$work/table"
"$BRDFIT" selftest --json >"$work/body"
holds "as JSON" 'all(.precisions[]; .form == "whole" and .passed and all(.models[]; .model == "lambert" or .points >= 30))'
"$BRDFIT" selftest $useless >"$work/table" 2>&1
check_equal "brdfit selftest on an unfit device" $? 1
check "a line a model says so" grep -qE '^ +ward +single +0 +- +- .* FAILED$' "$work/table"
if $has_double; then
    "$BRDFIT" selftest $rough_in_double >"$work/table" 2>&1
    check_equal "brdfit selftest on a worse device" $? 1
    check "it says where" grep -qE '^ +value off by .* eps: .*n=0x.* theta_i_deg=0x' "$work/table"
fi
mkdir "$work/models"
sed -e 's/rho_/r_/g' "$repository/kernels/models/ward.cl" >"$work/models/mine.cl"
"$BRDFIT" selftest --models "$work/models" >"$work/table" 2>&1
check_equal "with a model of the user's" $? 0
check "that has no points" grep -qE '^ +mine +.* 0 +- +- .* no points$' "$work/table"
"$BRDFIT" selftest --device no-such-device >"$work/table" 2>&1
check_equal "a device that there is not" $? 1
finish
