#!/usr/bin/env bash
# Searches that share a device's queue as fibres: the same bytes as one search a thread, alone and under load.
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"

# 31 channels about one surface with a lobe, each with a scatter of its own.
channels=$(jq -nc '
    [range(31) as $c | {name: "c\($c)", wavelength_nm: (400 + 10 * $c), scans: [(15, 45, 65) as $i | [range(-80; 81; 5)] as $r
        | {theta_i_deg: $i, theta_r_deg: $r,
           brdf: [$r[] | (0.1 + 0.004 * $c) * (1 + 0.03 * ((((. + 100) * 7 + $i + 3 * $c) % 11) / 11 - 0.5))
                         + 0.3 * (-pow((. - $i) / (6 + 0.3 * $c); 2) | exp2)]}]}]')
# with FILTER: a request for the channels that the filter picks, by all models.
with() {
    jq -c "{dataset: {channels: ($1)}, models: [\"lambert\", \"phong\", \"ward\", \"lafortune\", \"he_torrance\"],
            options: {time_limit_s: 300}}" <<<"$channels"
}
with '.[4:5]' >"$work/one"
with . >"$work/many"
# An answer, or its channel 4 alone, without ids, times and the device.
numbers() { normalised "$1" | jq -S 'del(.device)'; }
channel() { normalised "$1" | jq -S --argjson i "$2" '.channels[$i] | del(.fits[].links)'; }
ask() { curl -sS -m 300 -H 'Content-Type: application/json' -H "$patient" --data-binary "@$work/$1" -o "$2" "$url/v1/fits"; }

for device in basic pthread; do
    export POCL_DEVICES=$device
    require_server
    ask one "$work/one.$device"
    check "a fit on $device" jq -e '.state == "succeeded" and (.channels[0].fits | length == 5)' "$work/one.$device"
    ask many "$work/many.$device"
    check "31 channels on $device" jq -e '[.channels[].fits | length] == [range(31) | 5]' "$work/many.$device"
    check "... the one is the same among them" cmp <(channel "$work/one.$device" 0) <(channel "$work/many.$device" 4)
done
check "the device is PoCL's pthread" jq -e '.device.name | startswith("pthread") or startswith("cpu")' "$work/one.pthread"
check "one channel: the same numbers on both" cmp <(numbers "$work/one.basic") <(numbers "$work/one.pthread")
check "31 channels: the same numbers on both" cmp <(numbers "$work/many.basic") <(numbers "$work/many.pthread")

# ---- beside 8 others ----
others=()
for other in 1 2 3 4 5 6 7 8; do
    with ".[$other * 3:$other * 3 + 2]" >"$work/other.$other"
    ask "other.$other" "$work/answer.$other" &
    others+=($!)
done
ask one "$work/beside"
wait "${others[@]}"
check "beside 8 other requests: the same" cmp <(numbers "$work/one.pthread") <(numbers "$work/beside")
for other in 1 5 8; do
    check "... and the other $other is as among the 31" \
        cmp <(channel "$work/answer.$other" 0) <(channel "$work/many.pthread" $((other * 3)))
done

# ---- ends before their time ----
with . | jq -c '.options |= (.effort = "thorough" | .time_limit_s = 0.5)' >"$work/short"
SECONDS=0
ask short "$work/answer"
check "a time limit in mid-search is told" jq -e \
    '[.channels[].fits[].search.stop_reason] | length == 155 and any(. == "time_limit")' "$work/answer"
check "... and kept" test "$SECONDS" -le 20
with . | jq -c '.options |= (.effort = "thorough")' >"$work/long"
ask long "$work/cancelled" &
client=$!
sleep 1
kill "$server"
if wait_for_end "$server" 20; then check_equal "a server that searches heeds SIGTERM" "$status" 0
else fail "a server that searches heeds SIGTERM"; fi
wait "$client"
check "... and answers: with the whole, that it goes on later, or that the service stops" jq -e \
    '.status == 503 or .done == false or ([.channels[].fits | length] == [range(31) | 5] and
     all(.channels[].fits[]; .search.stop_reason != "cancelled"))' "$work/cancelled"
finish
