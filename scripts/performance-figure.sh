#!/usr/bin/env bash
# Measures speed, writes the tables of docs/performance.md and draws docs/figures/performance-growth.svg.
# usage: scripts/performance-figure.sh [PART...]    parts: kernels, device, fit; all without. Half an hour; keep the
#        machine free meanwhile. LENGTH=full in the environment: more repetitions, batches of 10000 datasets.
set -u -o pipefail
export LC_ALL=C.UTF-8
cd "$(dirname "${BASH_SOURCE[0]}")/.." || exit 1
readonly out=out page=docs/performance.md
. scripts/setup.sh
. scripts/page.sh

kernels() {
    configure bench
    compile bench
    local load
    load=$(load)
    build-bench/tests/bench/kernels_bench --benchmark_min_time=1 --benchmark_counters_tabular=true \
        --benchmark_out=$out/performance-kernels.json --benchmark_out_format=json || die "kernels_bench failed"
    {
        printf '%s\n\n' "$load"
        echo "| model | precision | ns, value | ns, with gradient | value / C++ | gradient / C++ | gradient / value |"
        echo "|---|---|---|---|---|---|---|"
        as_table $out/performance-kernels.json '
            def ratio($bar): if . > $bar then "**\(digits(3))**" else "\(digits(3))" end;
            [.benchmarks[] | (.name / "/") as [$model, $precision, $batch]
                | . + {$model, $precision, $batch} | select(.batch | IN("256", "1024"))]
            | group_by([.precision, .model])[] | sort_by(.batch | tonumber) | [.[0].model, .[0].precision,
                (map(.value_ns | digits(3)) | joined), (map(.gradient_ns | digits(3)) | joined),
                (map(.value_ratio | ratio(1.1)) | joined), (map(.gradient_ratio | ratio(1.1)) | joined),
                (map(.gradient_over_value | ratio(1.35)) | joined)]'
    } | put kernels
}

device() {
    local load
    load=$(load)
    build/brdfit bench device --seconds 1 --json >$out/performance-device.json || die "brdfit bench device failed"
    {
        jq -r '"Measured on \(.device.name). '"$load"' Millions of evaluations a second, by candidates in a launch:"' \
            $out/performance-device.json
        echo
        jq -r '"| model | precision | \([.precisions[0].models[0].launches[].candidates | tostring] | join(" | ")) | of exps | in exps |",
            "|---|---|\([.precisions[0].models[0].launches[] | "---|"] | add)---|---|"' $out/performance-device.json
        as_table $out/performance-device.json '.precisions[] | .precision as $precision | .models[]
            | [.model, $precision] + [.launches[].evaluations_per_s / 1e6 | digits(3)]
                + ["\(100 * .fraction_of_exps | digits(2)) %", (.exps | digits(3))]'
        echo
        jq -r '"Exponentials: \([.precisions[] | "\(.exps_per_s / 1e8 | round / 10)e9 a second in \(.precision) precision"] | join(", "))."' \
            $out/performance-device.json
    } | put device
}

fit() {
    local load
    load=$(load)
    build/brdfit bench fit --length "${LENGTH-standard}" --json >$out/performance-fit.json || die "brdfit bench fit failed"
    local head='| request | wall, ms | processor, ms | peak memory, MiB |' rule='|---|---|---|---|'
    {
        jq -r '"Measured on \(.device.name) with \(.threads) threads. '"$load"'"' $out/performance-fit.json
        printf '\n%s\n%s\n' "$head" "$rule"
        as_table $out/performance-fit.json '.timings[]
            | (if .growth == "models" and (.models | length | IN(1, 4)) then "500 samples: \(.models | joined)"
               elif .growth == "channels" and (.channels | IN(8, 31)) then "\(.channels) channels of 500 samples, four models"
               elif .growth == "samples" and .samples == 100000 then "100000 samples in and out of the plane, four models"
               elif .judge then "500 samples, four models, judged"
               elif .growth == "requests" then "requests at once: \(.requests), 500 samples, four models" else empty end)
            as $what | [$what, (.wall_s | ms), (.cpu_s | ms), (.peak_MiB | round)]'
        echo
        jq -r "$shared"'.batches[] | "A batch of \(.datasets) datasets of \(.samples) samples, phong and ward: \(.first_per_s | digits(3)) a second and \(.first_MiB | round) MiB resident in its first tenth, \(.last_per_s | digits(3)) a second and \(.last_MiB | round) MiB in its last."' \
            $out/performance-fit.json
    } | put fits
    {
        printf '%s\n%s\n' "$head" "$rule"
        as_table $out/performance-fit.json '.timings[] | select(.growth | IN("samples", "channels", "models", "effort"))
            | select(.growth != "models" or .models[0] == "phong")
            | [(if .growth == "models" then "models: \(.models | joined)" else "\(.growth): \(.[.growth])" end),
                (.wall_s | ms), (.cpu_s | ms), (.peak_MiB | round)]'
    } | put growth
    jq -r '.timings[] | select(.growth != "judge") | select(.growth != "models" or .models[0] == "phong")
        | [.growth, (if .growth == "models" then (.models | length) else .[.growth] end), .wall_s, .cpu_s] | @tsv' \
        $out/performance-fit.json >$out/performance-growth.tsv
    gnuplot -e "data='$out/performance-growth.tsv'; picture='docs/figures/performance-growth.svg'" \
        docs/figures/performance-growth.gp || die "gnuplot failed"
}

mkdir -p $out || exit 1
install_packages run test docs bench
configure release
compile release brdfit
(($#)) || set -- kernels device fit
for part; do
    [[ $part =~ ^(kernels|device|fit)$ ]] || die "no part $part; there are kernels, device, fit"
    say "Measuring: $part"
    "$part"
done
say $page docs/figures/performance-growth.svg
