#!/usr/bin/env bash
# The server as a process: port, signals, options, model files.
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
require_server
first=$server
port=${url##*:}

# ended NAME STATUS TEXT [option...]: brdfit serve with these options ends at once, and says the text.
ended() {
    local name=$1 expected=$2 text=$3
    shift 3
    timeout 60 "$BRDFIT" serve "$@" >"$work/ended" 2>&1
    check_equal "$name: status" $? "$expected"
    check "$name: says so" grep -q -- "$text" "$work/ended"
}
ended "a port that is taken" 1 "cannot bind 127.0.0.1:$port" --port "$port"
ended "an address that others reach" 1 "loopback" --host 0.0.0.0 --port 0
ended "a port that is none" 105 "port" --port 65536
ended "a device that there is not" 1 "device" --device no-such-device --port 0
ended "a folder that there is not" 105 "models" --models "$work/nowhere" --port 0
get /health/live
answered "the first server is still there" 200

# ---- model files ----
mkdir "$work/models"
sed -e 's/"title": "[^"]*"/"title": "a throw-away"/' -e 's/rho_/r_/g' "$repository/kernels/models/ward.cl" \
    >"$work/models/ward_again.cl"
start_server --models "$work/models" || { fail "a server with a further model starts" "$(cat "$log")"; finish; }
second=$server
get /v1/models/ward_again
answered "a further model" 200
holds "its title and parameters" '.title == "a throw-away" and [.parameters[].name] == ["r_d", "r_s", "alpha"]'
get /v1/models
holds "it stands beside the others" '[.models[].name] | length == 6 and .[5] == "ward_again"'
post_csv models=ward,ward_again "$samples/white_plastic.csv"
answered "it fits" 200
holds "... as the model does that it was copied from" '.channels[0].fits | .[0].loss == .[1].loss
    and [.[].parameters.alpha.value] as [$a, $b] | $a == $b'
post_csv '' "$samples/white_plastic.csv"
holds "... among all models" '.channels[0].fits | length == 6'

# refuse_model NAME TEXT FILTER [FILE]: a server does not start with Ward's model, its header changed by jq's filter.
refuse_model() {
    local source=$repository/kernels/models/ward.cl
    rm -rf "$work/refused"
    mkdir "$work/refused"
    {
        printf '/*%s*/\n' "$(sed '/^}\*\/$/q' "$source" | sed 's|^/\*||; s|\*/$||' | jq "$3")"
        sed '1,/^}\*\/$/d' "$source"
    } >"$work/refused/${4-bad}.cl"
    ended "$1" 1 "$2" --models "$work/refused" --port 0
}
refuse_model "a model with bounds upside down" 'bad.cl: alpha' '.parameters[2] |= (.min = 2 | .max = 1)'
refuse_model "a model with bounds outside its domain" 'bad.cl: rho_d' '.parameters[0].min = -1'
refuse_model "a model with an unknown key" 'bad.cl.*colour' '.colour = 1'
refuse_model "a model of which a term names no parameter" 'bad.cl.*beta' '.terms[1].of = ["beta"]'
refuse_model "a model named as another" 'ward.cl: there is a model of that name' . ward
echo '/*{"title":' >"$work/refused/ward.cl"
ended "a model file that is no JSON" 1 'ward.cl' --models "$work/refused" --port 0

# ---- signals ----
kill -TERM "$second"
status=none
wait_for_end "$second" 10
check_equal "SIGTERM" "$status" 0
check "SIGTERM is logged" grep -q 'stopping on signal 15' "$log"
request GET /health/live
check_equal "nobody answers there any more" "$status" 000
curl -sS -m 60 -o "$work/slow" -w '%{http_code}' -H 'Content-Type: text/csv' \
    --data-binary "@$samples/white_plastic.csv" "http://127.0.0.1:$port/v1/fits?effort=thorough" >"$work/slow.status" &
slow=$!
sleep 0.1
kill -INT "$first"
status=none
wait_for_end "$first" 15
check_equal "SIGINT while a request is fitted" "$status" 0
wait $slow
check "that request is answered: with its result, that it goes on later, or that the service stops" grep -qE '^(200|202|503)$' "$work/slow.status"

# A signal that comes as soon as it is waited for, while the workers' threads are made and the kernels are compiled.
# terminated_early [option...]: sets status.
terminated_early() {
    "$BRDFIT" serve --port 0 "$@" >"$work/early.log" 2>&1 &
    local early=$!
    servers+=("$early")
    for _ in {1..2000}; do
        grep -q '^SigBlk:.*4002$' "/proc/$early/status" 2>/dev/null && break
        sleep 0.002
    done
    sleep "0.0$((RANDOM % 4))$((RANDOM % 10))"
    kill -TERM "$early"
    status=none
    wait_for_end "$early" 60
}
terminated_early
check_equal "SIGTERM before it listens" "$status" 0
# With many workers the time in which they are made is long: one of fifteen such ends was a crash.
for _ in {1..25}; do
    terminated_early --workers 64
    [[ $status == 0 ]] || break
done
check_equal "SIGTERM while workers are made, again and again" "$status" 0
finish
