#!/usr/bin/env bash
# Measures what effort and precision buy, writes the tables of docs/trade-offs.md and draws docs/figures/trade-*.svg.
# usage: [SEEDS=16] [SURFACES=24] scripts/trade-figure.sh [FILE.csv...]    samples/*.csv without; so many made-up surfaces.
#        Three minutes.
set -u -o pipefail
export LC_ALL=C.UTF-8
cd "$(dirname "${BASH_SOURCE[0]}")/.." || exit 1
readonly out=out page=docs/trade-offs.md
. scripts/setup.sh
. scripts/page.sh

# What the tables below share: figures of a cell, and of many.
readonly trades='
    def middle: sort | .[length / 2 | floor];
    def small: if . == null then "–" elif . < 1e-12 then "0" else digits(2) end;
    def origin: if .dataset | startswith("made up ") then "made up" else "samples" end;
    def origins: ["samples", "made up"];
    def percent: "\(100 * . | round) %";
    def efforts: ["draft", "standard", "thorough"];
    def precisions: ["auto", "single", "double", "single alone"];
    def models: [.cells[].model] | reduce .[] as $m ([]; if index([$m]) then . else . + [$m] end);
    # of all seeds of all datasets; times and evaluations are medians over datasets of medians over seeds
    def pooled: [(map(.cpu_s) | middle | ms), (map(.evaluations) | middle | round),
        (map(.distance) | max | small), (map(.worst_distance) | max | small),
        "\((map(.success * .seeds) | add) / (map(.seeds) | add) * 100 | digits(3)) %"];'
trade_table() { as_table $out/trade.json "$trades $1"; }

mkdir -p $out || exit 1
install_packages run docs
configure release
compile release brdfit
(($#)) || set -- samples/*.csv
load=$(load)
say "Measuring: $*"
build/brdfit bench trade --seeds "${SEEDS-16}" --made-up "${SURFACES-24}" --json "$@" >$out/trade.json || die "brdfit bench trade failed"

pooled_head="processor, ms | evaluations | median distance | worst | within 1e-3 |"
{
    jq -r '"Measured on \(.device.name), one thread, \(.seeds) seeds. '"$load"'"' $out/trade.json
    printf '\n| model | data | effort | %s\n|---|---|---|---|---|---|---|---|\n' "$pooled_head"
    trade_table '. as $all | models[] as $model | origins[] as $origin | efforts[] as $effort
        | [$all.cells[] | select(.model == $model and .effort == $effort and .precision == "auto" and origin == $origin)]
        | select(length > 0) | [$model, $origin, $effort] + pooled'
} | put effort
{
    printf '| model | data | precision | %s\n|---|---|---|---|---|---|---|---|\n' "$pooled_head"
    trade_table '. as $all | models[] as $model | origins[] as $origin | precisions[] as $precision
        | [$all.cells[] | select(.model == $model and .effort == "standard" and .precision == $precision and origin == $origin)]
        | select(length > 0) | [$model, $origin, $precision] + pooled'
} | put precision
{
    echo '| dataset | model | single: seeds | parameter | std errors | relative | single alone: seeds | parameter | std errors | relative |'
    echo '|---|---|---|---|---|---|---|---|---|---|'
    trade_table '[.shifts[] | select(origin == "samples")] | group_by([.dataset, .model])[]
        | sort_by(.precision) | [.[0].dataset, .[0].model]
            + ([.[] | [.seeds, .parameter // "–", (.std_errors | small), (.relative | small)]] | add)'
} | put shifts
{
    jq -r "$shared $trades"'"| precision | accuracy | ln(1/eps) |\([.series[] | select(origin == "samples") | .dataset] | unique | map(" \(.): error | ns |") | add)",
        "|---|---|---|\([.series[] | select(origin == "samples") | .dataset] | unique | map("---|---|") | add)"' $out/trade.json
    trade_table '[.series[] | select(origin == "samples")] | group_by([.accuracy == "dial", .precision, .accuracy, .log_epsilon])[]
        | sort_by(.dataset) | [.[0].precision, .[0].accuracy, .[0].log_epsilon // "–"]
            + ([.[] | [(.error | small), (.ns | digits(3))]] | add)'
} | put series
{
    echo 'Processor time in ms, evaluations, worst distance, part within 1e-3:'
    echo
    jq -r "$shared $trades"'"| dataset | model | effort |\(precisions | map(" \(.) |") | add)",
        "|---|---|---|\(precisions | map("---|") | add)"' $out/trade.json
    trade_table '[.cells[] | select(origin == "samples")] | group_by([.dataset, .model])[] | . as $of | efforts[] as $effort
        | [$of[] | select(.effort == $effort)] | select(length > 0) | . as $row
        | [.[0].dataset, .[0].model, $effort] + [precisions[] as $precision
            | [$row[] | select(.precision == $precision)] | if length == 0 then "–" else .[0]
                | "\(.cpu_s | ms), \(.evaluations | round), \(.worst_distance | small), \(.success | percent)" end]'
} | put cells

# Blocks by effort and precision, then series by dataset, for gnuplot.
jq -r "$shared $trades"'.cells[] | select(.model != "lambert") | [.model, .effort, .precision, 1e3 * .cpu_s, ([.worst_distance, 1e-13] | max)] | @tsv' \
    $out/trade.json >$out/trade-effort.tsv
jq -r "$shared $trades"'.series[] | select(origin == "samples") | [.dataset, .precision, .accuracy, .ns, ([.error, 1e-16] | max), .log_epsilon // 0] | @tsv' \
    $out/trade.json >$out/trade-series.tsv
for figure in effort series; do
    gnuplot -e "data='$out/trade-$figure.tsv'; picture='docs/figures/trade-$figure.svg'" "docs/figures/trade-$figure.gp" ||
        die "gnuplot failed"
done
say $page docs/figures/trade-effort.svg docs/figures/trade-series.svg
