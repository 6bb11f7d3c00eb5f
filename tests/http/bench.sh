#!/usr/bin/env bash
# The benchmarks as commands: every model and precision, figures that are figures.
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
every_model='["he_torrance", "lafortune (1)", "lafortune (2)", "lafortune (3)", "lambert", "phong", "ward"]'
# What `brdfit devices` says of the first device: double or single.
has() { "$BRDFIT" devices | head -n 1 | awk '{ print $2 }'; }

for devices in basic pthread; do
    export POCL_DEVICES=$devices
    "$BRDFIT" bench device --seconds 0.01 --json >"$work/body"
    check_equal "bench device on $devices" $? 0
    precisions='["single"]'
    [[ $(has) == single ]] || precisions='["double", "single"]'
    holds "every precision" '[.precisions[].precision] == $expected' --argjson expected "$precisions"
    holds "every model" 'all(.precisions[]; [.models[].model] | sort == $expected)' --argjson expected "$every_model"
    holds "positive rates" 'all(.precisions[]; .exps_per_s > 0 and all(.models[]; .fraction_of_exps > 0 and .exps > 0
        and .value_ns > 0 and (.under_load | type == "boolean")
        and (.launches | length == 5 and all(.evaluations_per_s > 0))))'
done
export POCL_DEVICES=basic
"$BRDFIT" bench device --seconds 0.01 >"$work/table"
check_equal "bench device" $? 0
check "a line a model" grep -qE '^ +he_torrance( +[0-9.]+){5} +[0-9.]+ % +[0-9.]+ +[0-9.]+(, under load)?$' "$work/table"
"$BRDFIT" bench device --device no-such-device >"$work/table" 2>&1
check_equal "bench device on a device that there is not" $? 1

"$BRDFIT" bench fit --length brief --only models --json >"$work/body"
check_equal "bench fit" $? 0
holds "each model, and all" '[.timings[].models | join(" ")] == ["phong", "ward", "lafortune", "he_torrance", "phong ward",
    "phong ward lafortune", "phong ward lafortune he_torrance"]'
holds "positive times" 'all(.timings[]; .wall_s > 0 and .cpu_s > 0 and .peak_MiB > 1 and .repetitions == 1)'
"$BRDFIT" bench fit --length brief --only batch --json >"$work/body"
check_equal "bench fit of a batch" $? 0
holds "positive rates" '.timings == [] and (.batches[0] | .datasets == 20 and .first_per_s > 0 and .last_per_s > 0
    and .first_MiB > 1 and .last_MiB > 1)'
"$BRDFIT" bench trade >"$work/table" 2>&1
check_equal "bench trade of nothing" $? 1
echo "theta_i_deg" >"$work/bad.csv"
"$BRDFIT" bench trade "$work/bad.csv" >"$work/table" 2>&1
check_equal "bench trade of a file without data" $? 2
check "the file is named" grep -q '^.*/bad.csv:' "$work/table"
if [[ ${BRDFIT_LONG-} == 1 ]]; then # a minute of compiling
    "$BRDFIT" bench trade "$samples/rough_metal.csv" --made-up 1 --seeds 2 --json >"$work/body"
    check_equal "bench trade" $? 0
    holds "every model, effort and precision" '.cells | length == 2 * 5 * 3 * 4'
    holds "figures are figures" 'all(.cells[]; .wall_s > 0 and .cpu_s > 0 and .evaluations >= 1 and .distance >= 0
        and .worst_distance >= .distance and .success >= 0 and .success <= 1)'
    holds "standard and thorough searches find this surface" 'all(.cells[] | select(.dataset == "rough_metal"
        and .effort != "draft" and .precision != "single alone"); .success == 1)'
    holds "a search in single precision moves no parameter that could be told" 'all(.shifts[]
        | select(.precision == "single" and .std_errors != null); .std_errors < 0.05)'
    holds "longer series, smaller errors" '[.series[] | select(.dataset == "rough_metal" and .accuracy == "dial")]
        | (map(.error) | . == (sort | reverse)) and .[0].error > 1e-6 and .[-1].error < 1e-12'
fi
"$BRDFIT" bench fit --length brief --only width >"$work/table" 2>&1
check_equal "bench fit of what does not grow" $? 1
finish
